//! Which panorama goes with which satellite image: from the manifest that `sat3d vigor ingest` wrote, or from
//! the label files themselves.

use crate::train::error::TrainingError;
use crate::train::settings::{LabelChoice, Position, VigorSettings};
use crate::vigor::{Dataset, ImageSize, LabelKind, Layout, canonical_name};
use serde::Deserialize;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// A panorama with its satellite image, and what belongs to them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Item {
    /// Name of the panorama.
    pub(super) name: String,
    pub(super) satellite: PathBuf,
    pub(super) panorama: PathBuf,
    pub(super) sky_mask: PathBuf,
    /// Where the depth label would be.
    pub(super) depth: Option<PathBuf>,
    /// Down and right of the image's centre, half sides of the image.
    pub(super) position: [f64; 2],
}

/// One row of the manifest, as far as it is used here.
#[derive(Clone, Debug, Deserialize)]
struct Row {
    city: String,
    split: String,
    labels: String,
    role: String,
    panorama: String,
    satellite: String,
    label_d0: Option<f64>,
    label_d1: Option<f64>,
    x_px: f64,
    y_px: f64,
    sky_mask: Option<String>,
}

/// Pairs by the part of the data that they belong to.
#[derive(Debug)]
pub(super) struct Pairs {
    rows: Vec<Row>,
    layout: Layout,
}

impl Pairs {
    /// Reads the manifest or the label files.
    pub(super) fn read(settings: &VigorSettings) -> Result<Self, TrainingError> {
        let layout = Layout::find(&settings.folder, None, &[])?;
        let rows = match &settings.manifest {
            Some(manifest) => from_manifest(manifest)?,
            None => from_labels(&layout, settings),
        };
        let wanted: Vec<String> = settings.cities.iter().map(|city| canonical_name(city)).collect();
        let rows: Vec<Row> = rows
            .into_iter()
            .filter(|row| row.role == "positive")
            .filter(|row| wanted.is_empty() || wanted.contains(&row.city))
            .collect();
        Ok(Self { rows, layout })
    }

    /// The items of one part of the data, each panorama once.
    pub(super) fn items(&self, split: &str, settings: &VigorSettings) -> Vec<Item> {
        let rows = || self.rows.iter().filter(|row| split == "all" || row.split == split);
        // One kind for all: a split file leaves panoramas out on purpose, and other labels would bring them back.
        let kind = match settings.labels {
            LabelChoice::Best => [LabelKind::Sat3dgen, LabelKind::Corrected, LabelKind::Original]
                .into_iter()
                .find(|kind| rows().any(|row| row.labels == kind.name())),
            LabelChoice::Original => Some(LabelKind::Original),
            LabelChoice::Corrected => Some(LabelKind::Corrected),
            LabelChoice::Sat3dgen => Some(LabelKind::Sat3dgen),
        };
        let Some(kind) = kind else { return Vec::new() };
        let mut seen = HashSet::new();
        rows()
            .filter(|row| row.labels == kind.name())
            .filter(|row| seen.insert((&row.city, &row.panorama)))
            .map(|row| self.item(row, settings))
            .collect()
    }

    fn item(&self, row: &Row, settings: &VigorSettings) -> Item {
        let default = self.layout.root.join(&row.city);
        let folders = self.layout.cities.get(&row.city);
        let folder = |known: Option<&PathBuf>, name: &str| {
            known.cloned().unwrap_or_else(|| default.join(name))
        };
        let satellites = folder(folders.and_then(|f| f.satellite.as_ref()), "satellite");
        let panoramas = folder(folders.and_then(|f| f.panorama.as_ref()), "panorama");
        let sky_mask = match &row.sky_mask {
            Some(named) => self.layout.root.join(named),
            None => beside(&panoramas, "panorama")
                .join(&settings.sky_masks)
                .join(Path::new(&row.panorama).with_extension("png")),
        };
        let stem = Path::new(&row.satellite).file_stem().unwrap_or_default().to_string_lossy();
        let depth = (!settings.depth.is_empty()).then(|| {
            beside(&satellites, "satellite").join(&settings.depth).join(format!("{stem}_depth.png"))
        });
        let half = f64::from(settings.image_side) / 2.0;
        let position = match settings.position {
            // d0 counts south, d1 west.
            Position::Label => {
                [row.label_d0.unwrap_or(0.0) / half, -row.label_d1.unwrap_or(0.0) / half]
            }
            Position::Exact => [row.y_px / half - 1.0, row.x_px / half - 1.0],
        };
        // An offset of zero west is zero, not minus zero.
        let position = position.map(|value| value + 0.0);
        Item {
            name: row.panorama.clone(),
            satellite: satellites.join(&row.satellite),
            panorama: panoramas.join(&row.panorama),
            sky_mask,
            depth,
            position,
        }
    }
}

/// The folder that others lie in beside an image folder; images may lie in the city's folder itself.
fn beside<'a>(folder: &'a Path, name: &str) -> &'a Path {
    match (folder.file_name(), folder.parent()) {
        (Some(last), Some(parent)) if last == name => parent,
        _ => folder,
    }
}

fn from_manifest(path: &Path) -> Result<Vec<Row>, TrainingError> {
    let wrong = |line: u64, message: String| TrainingError::Syntax {
        path: path.to_owned(),
        line: line as usize,
        message: format!("{message}; `sat3d vigor ingest` writes the manifest that is expected"),
    };
    let mut reader = csv::Reader::from_path(path).map_err(|error| wrong(1, error.to_string()))?;
    let line = |error: &csv::Error| error.position().map_or(1, csv::Position::line);
    reader
        .deserialize()
        .map(|row| row.map_err(|error| wrong(line(&error), error.to_string())))
        .collect()
}

fn from_labels(layout: &Layout, settings: &VigorSettings) -> Vec<Row> {
    let size = ImageSize { pixels: settings.image_side, ..ImageSize::default() };
    let dataset = Dataset::read(layout, size);
    for problem in dataset.problems.iter().filter(|problem| problem.kind.is_failure()).take(10) {
        tracing::warn!("{problem}");
    }
    let row = |pair: &crate::vigor::Pair| {
        let file = &dataset.files[pair.file as usize];
        let panorama = &dataset.panoramas[pair.panorama as usize];
        let satellite = &dataset.satellites[pair.satellite as usize];
        let pixel = satellite.grid.pixel(panorama.position);
        Row {
            city: dataset.cities[satellite.city as usize].clone(),
            split: file.split.name().to_owned(),
            labels: file.labels.map_or("", LabelKind::name).to_owned(),
            role: if pair.is_positive() { "positive" } else { "semi" }.to_owned(),
            panorama: panorama.name.clone(),
            satellite: satellite.name.clone(),
            label_d0: pair.offset.map(|offset| offset[0]),
            label_d1: pair.offset.map(|offset| offset[1]),
            x_px: pixel.x,
            y_px: pixel.y,
            sky_mask: pair.sky_mask.map(|index| dataset.sky_masks[index as usize].clone()),
        }
    };
    dataset.pairs.iter().map(row).collect()
}
