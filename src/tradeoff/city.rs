//! Tiling: windows over a small city, from picture to DSM.

use super::clock::{Findings, Judged, Subject, Way};
use super::report::Quantity;
use super::truth::spec;
use super::{Setup, TradeoffError};
use crate::batch::Interrupt;
use crate::eval::align::median;
use crate::raster::{OpenOptions, open};
use crate::scene::spec::{CameraSpec, PictureSpec, SunSpec};
use crate::scene::whole::{PICTURE_FILE, TRUTH_FILE};
use crate::scene::{Options, Scene, simulate};
use crate::tile::layout::{Blend, WindowOptions};
use crate::tile::{DsmRequest, TileLattice, TileOptions, TileSummary, prepare};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

pub(super) const STRIDE: &str = "neighbouring windows disagree";
pub(super) const BLEND: &str = "a window knows least at its border";
pub(super) const TRIM: &str = "a window knows least at its border";
pub(super) const LATTICE: &str = "the released grid drifts from the pixels";

/// Ground metres of a model pixel.
const PIXEL_M: f64 = 0.252;
/// Name of the DSM in a run's folder.
const DSM: &str = "dsm.tif";

/// A picture of a small city with its true heights.
struct City {
    folder: TempDir,
    truth: Vec<f32>,
    km2: f64,
}

/// What one run gave.
struct Made {
    out: PathBuf,
    summary: TileSummary,
}

/// A raster in one piece.
fn whole(path: &Path) -> Result<Vec<f32>, TradeoffError> {
    let mut reader = open(path, &OpenOptions::default())?;
    let header = reader.header();
    let (width, height) = (header.width as usize, header.height as usize);
    let (wide, high) = (header.block_width as usize, header.block_height as usize);
    let mut values = vec![f32::NAN; width * height];
    let mut block = Vec::new();
    for by in 0..height.div_ceil(high) {
        for bx in 0..width.div_ceil(wide) {
            reader.read_block(bx as u32, by as u32, &mut block)?;
            let columns = wide.min(width - bx * wide);
            for (row, line) in block.chunks_exact(wide).enumerate() {
                let to = (by * high + row) * width + bx * wide;
                if let Some(to) = values.get_mut(to..to + columns) {
                    to.copy_from_slice(&line[..columns]);
                }
            }
        }
    }
    Ok(values)
}

impl City {
    fn new(setup: &Setup<'_>) -> Result<Self, TradeoffError> {
        let folder = tempfile::tempdir().map_err(TradeoffError::io("make a folder for a city"))?;
        // Wide enough that each stride has other windows: 440 and 480 pixels for windows of 256.
        let metres = setup.either(113.0, 125.0);
        let mut spec = spec(metres + 20.0);
        spec.sun = Some(SunSpec { azimuth_degrees: 160.0, elevation_degrees: 45.0 });
        spec.camera = Some(CameraSpec::default());
        spec.picture = Some(PictureSpec {
            pixel_metres: Some(PIXEL_M),
            width_metres: Some(metres),
            height_metres: Some(metres),
            ..PictureSpec::default()
        });
        let scene = Scene::new(spec, &Options::default())?;
        simulate(&scene, folder.path(), true, &Interrupt::default())?;
        let truth = whole(&folder.path().join(TRUTH_FILE))?;
        let km2 = truth.len() as f64 * PIXEL_M * PIXEL_M / 1e6;
        Ok(Self { folder, truth, km2 })
    }

    fn make(
        &self,
        setup: &Setup<'_>,
        name: &str,
        windows: WindowOptions,
        lattice: TileLattice,
    ) -> Result<Made, TradeoffError> {
        let out = self.folder.path().join("runs").join(name);
        let picture = self.folder.path().join(PICTURE_FILE);
        let mut options = TileOptions::new(picture, setup.weights.clone(), out.clone());
        let dsm = DsmRequest { file: DSM.into(), preview: false, t_srs: None };
        options.outputs.dsm = Some(dsm);
        options.window_gsd_m = Some(PIXEL_M);
        options.windows = windows;
        options.lattice = lattice;
        options.threads = setup.threads;
        options.overwrite = true;
        options.quiet = true;
        let summary = prepare(options)?.run(&Interrupt::default())?;
        Ok(Made { out, summary })
    }

    /// RMS of the height errors whose median is taken out, metres.
    fn judge(&self, made: &Made) -> Result<Judged, TradeoffError> {
        let heights = whole(&made.out.join(DSM))?;
        if heights.len() != self.truth.len() {
            return Err(TradeoffError::Input(format!(
                "{} heights of a city and {} true ones",
                heights.len(),
                self.truth.len()
            )));
        }
        let mut apart: Vec<f64> = (heights.iter().zip(&self.truth))
            .map(|(a, b)| f64::from(*a) - f64::from(*b))
            .filter(|apart| !apart.is_nan())
            .collect();
        let middle = median(&mut apart);
        let square: f64 = apart.iter().map(|e| (e - middle) * (e - middle)).sum();
        let facts = made.summary.facts.clone().unwrap_or_default();
        let seams = facts.seams.and_then(|seams| seams.ratio).unwrap_or(f64::NAN);
        Ok(Judged::new((square / apart.len() as f64).sqrt())
            .also("jumps at borders over jumps inside", "", seams)
            .also("windows", "", facts.windows as f64))
    }
}

/// A setting: name, windows, lattice.
type Position = (String, WindowOptions, TileLattice);

fn study(setup: &Setup<'_>, positions: Vec<Position>) -> Result<Findings, TradeoffError> {
    let city = City::new(setup)?;
    let city = &city;
    let usual = (WindowOptions::default(), TileLattice::default());
    let ways = positions
        .into_iter()
        .map(|(name, windows, lattice)| {
            Way::new(name.clone(), (windows, lattice) == usual, move || {
                city.make(setup, &name, windows, lattice)
            })
        })
        .collect();
    let subject = Subject {
        truth: "true heights of a simulated city; the median of the errors is taken out",
        error: Quantity::new("RMS height error", "m"),
        work: "one square kilometre, from picture to DSM, by the time of a small city".into(),
        units: city.km2,
    };
    setup.clock.measure(subject, ways, |made: &Made| city.judge(made))
}

/// Pixels from one window to the next.
pub(super) fn stride(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let strides: &[u32] = if setup.quick { &[256, 128] } else { &[256, 128, 96, 64, 32] };
    let position = |&stride: &u32| {
        let windows = WindowOptions { stride, ..WindowOptions::default() };
        (format!("stride {stride}"), windows, TileLattice::default())
    };
    study(setup, strides.iter().map(position).collect())
}

/// Weights where windows overlap.
pub(super) fn blend(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let position = |blend: Blend| {
        let windows = WindowOptions { blend, ..WindowOptions::default() };
        (blend.name().to_owned(), windows, TileLattice::default())
    };
    study(setup, [Blend::Mean, Blend::Hann, Blend::Gaussian].map(position).into())
}

/// Pixels that are dropped along each side of a window.
pub(super) fn trim(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let position = |trim: u32| {
        let windows = WindowOptions { trim, ..WindowOptions::default() };
        (format!("trim {trim}"), windows, TileLattice::default())
    };
    study(setup, [0, 16, 32, 64].map(position).into())
}

/// Where densities are taken.
pub(super) fn lattice(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let position =
        |lattice: TileLattice| (lattice.name().to_owned(), WindowOptions::default(), lattice);
    study(setup, [TileLattice::Pixels, TileLattice::Reference].map(position).into())
}
