//! The whole ingest: read, look at the images, measure, summarise, write.

use super::dataset::Dataset;
use super::images::{Expected, Verify, check};
use super::kinds::{ImageSize, ImageStatus};
use super::layout::{Layout, LayoutError};
use super::manifest;
use super::measure::{Measured, measure};
use super::problem::{Problem, ProblemKind};
use super::summary::{BadImage, ImageCounts, Summary};
use crate::batch::{ExitCode, Interrupt, Progress, write_atomic};
use crate::crs::CrsError;
use crate::table::{Layer, Table, TableError, write_geopackage};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeSet, HashMap};
use std::io;
use std::path::{Path, PathBuf};

/// What to ingest and how.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct IngestOptions {
    /// Size of the satellite images.
    pub size: ImageSize,
    /// How closely images are looked at.
    pub verify: Verify,
    /// Replaces the cities' resolutions in the UTM formula, metres per pixel.
    pub resolution_m: Option<f64>,
}

/// Why an ingest cannot be done at all.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// The folder is no VIGOR folder.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The UTM projection is not available.
    #[error("the UTM formula of the labels needs a projection that is not available: {0}")]
    Crs(#[from] CrsError),
    /// There are files, and nothing in them could be used.
    #[error("nothing could be read of the {files} text files in {}; {first}", root.display())]
    NothingRead {
        /// The folder.
        root: PathBuf,
        /// Text files looked at.
        files: usize,
        /// The first problem, or what was expected.
        first: String,
    },
    /// The manifest could not be made or written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// An output could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
}

/// A data set that was read, checked and measured.
#[derive(Debug)]
pub struct Ingest {
    /// The data.
    pub dataset: Dataset,
    /// One entry per pair.
    pub measured: Vec<Measured>,
    /// What `summary.json` says.
    pub summary: Summary,
}

impl Ingest {
    /// Reads, checks and measures what `layout` holds.
    ///
    /// # Errors
    /// [`IngestError`] when nothing can be read or the user interrupts; what is wrong with single
    /// lines and images is in the summary.
    pub fn run(
        layout: &Layout,
        options: &IngestOptions,
        interrupt: &Interrupt,
        quiet: bool,
    ) -> Result<Self, IngestError> {
        let mut dataset = Dataset::read(layout, options.size);
        let images = check_images(layout, &mut dataset, options, interrupt, quiet)?;
        if dataset.pairs.is_empty() && dataset.satellites.is_empty() {
            let first = dataset.problems.first().map_or_else(
                || "expected VIGOR's labels, Sat3DGen's splits or a satellite_list.txt".to_owned(),
                |problem| format!("the first problem: {problem}"),
            );
            let (root, files) = (layout.root.clone(), dataset.files.len());
            return Err(IngestError::NothingRead { root, files, first });
        }
        let measured = measure(&dataset, options.resolution_m)?;
        let summary = Summary::new(&dataset, &measured, options, images);
        Ok(Self { dataset, measured, summary })
    }

    /// The manifest as a table.
    ///
    /// # Errors
    /// [`TableError`], see [`manifest::table`].
    pub fn table(&self) -> Result<Table, TableError> {
        manifest::table(&self.dataset, &self.measured)
    }

    /// Writes `manifest.parquet`, `manifest.csv` and `summary.json` into a folder, which is made if
    /// it does not exist. The summary comes last: where it is, the manifests are whole.
    ///
    /// # Errors
    /// [`IngestError::Write`] or [`IngestError::Table`].
    pub fn write(&self, folder: &Path) -> Result<(), IngestError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| IngestError::Write { path, source }
        };
        std::fs::create_dir_all(folder).map_err(failed(folder))?;
        let table = self.table()?;
        let (parquet, csv) = rayon::join(
            || table.write_parquet(&folder.join("manifest.parquet")),
            || table.write_csv(&folder.join("manifest.csv")),
        );
        parquet.and(csv)?;
        let path = folder.join("summary.json");
        write_atomic(&path, self.summary.to_json().as_bytes()).map_err(failed(&path))
    }

    /// Writes a GeoPackage with the panoramas as points and the satellite images as footprints.
    ///
    /// # Errors
    /// [`TableError`] when it cannot be written, or in builds without GDAL.
    pub fn write_geopackage(&self, path: &Path) -> Result<(), TableError> {
        let panoramas = manifest::panorama_layer(&self.dataset, &self.measured)?;
        let satellites = manifest::satellite_layer(&self.dataset)?;
        write_geopackage(
            path,
            &[
                // QGIS draws the first layer on top.
                Layer {
                    name: "panoramas",
                    description: "True positions of the panoramas",
                    table: &panoramas,
                },
                Layer {
                    name: "satellite_images",
                    description: "Footprints of the satellite images",
                    table: &satellites,
                },
            ],
        )
    }

    /// Success, or that some lines or images failed. Missing images are no failure: labels alone
    /// are a supported input.
    #[must_use]
    pub fn exit_code(&self) -> ExitCode {
        let bad_image = self.summary.cities.iter().any(|city| {
            [&city.satellite_images, &city.panorama_images]
                .into_iter()
                .flatten()
                .any(|images| images.bad > 0)
        });
        if bad_image || self.dataset.problems.iter().any(|p| p.kind.is_failure()) {
            ExitCode::SomeFailed
        } else {
            ExitCode::Success
        }
    }
}

/// What was found of a city's satellite images and of its panoramas, by index of the city.
pub(super) type CityImages = HashMap<u32, [Option<ImageCounts>; 2]>;

/// A file to look at.
struct Job {
    panorama: bool,
    index: usize,
    path: PathBuf,
}

/// Lists the image folders, takes in images that no list names, and checks every file.
fn check_images(
    layout: &Layout,
    dataset: &mut Dataset,
    options: &IngestOptions,
    interrupt: &Interrupt,
    quiet: bool,
) -> Result<CityImages, IngestError> {
    let mut counts = CityImages::new();
    let mut jobs = Vec::new();
    for city in 0..dataset.cities.len() as u32 {
        let name = &dataset.cities[city as usize];
        let Some(folder) = layout.cities.get(name).cloned() else { continue };
        let entry = counts.entry(city).or_default();
        if let Some(path) = &folder.satellite {
            entry[0] = list_images(layout, dataset, city, path, false, &mut jobs);
        }
        if let Some(path) = &folder.panorama {
            entry[1] = list_images(layout, dataset, city, path, true, &mut jobs);
        }
    }
    let size = options.size.pixels;
    let progress = Progress::new("checking images", "images", jobs.len(), quiet);
    let results: Vec<Option<Result<(), String>>> = jobs
        .par_iter()
        .map(|job| {
            if interrupt.requested() {
                return None;
            }
            let expected = Expected { size: (!job.panorama).then_some((size, size)) };
            let result = check(&job.path, options.verify, expected);
            progress.add(1);
            Some(result.map_err(|problem| problem.to_string()))
        })
        .collect();
    progress.finish();
    let good = if options.verify == Verify::None { ImageStatus::Found } else { ImageStatus::Good };
    for (job, result) in jobs.iter().zip(results) {
        let result = result.ok_or(IngestError::Interrupted)?;
        let status = if result.is_ok() { good } else { ImageStatus::Bad };
        let (city, name) = if job.panorama {
            let panorama = &mut dataset.panoramas[job.index];
            panorama.status = status;
            (panorama.city, &panorama.name)
        } else {
            let satellite = &mut dataset.satellites[job.index];
            satellite.status = status;
            (satellite.city, &satellite.name)
        };
        let entry = counts.get_mut(&city).and_then(|both| both[usize::from(job.panorama)].as_mut());
        if let Some(counts) = entry {
            match result {
                Ok(()) => counts.good += 1,
                Err(problem) => {
                    counts.bad += 1;
                    counts.bad_files.push(BadImage { file: name.clone(), problem });
                }
            }
        }
    }
    Ok(counts)
}

/// Compares a folder with the names known; adds the files to look at to `jobs`.
fn list_images(
    layout: &Layout,
    dataset: &mut Dataset,
    city: u32,
    folder: &Path,
    panorama: bool,
    jobs: &mut Vec<Job>,
) -> Option<ImageCounts> {
    let names = match list(folder) {
        Ok(names) => names,
        Err(error) => {
            let shown = folder.strip_prefix(&layout.root).unwrap_or(folder);
            let file = shown.to_string_lossy().replace('\\', "/");
            let message = format!("the folder cannot be listed: {error}");
            dataset.problems.push(Problem::of_file(&file, ProblemKind::Unreadable, message));
            return None;
        }
    };
    let mut counts = ImageCounts { in_folder: names.len() as u64, ..ImageCounts::default() };
    let mut known = BTreeSet::new();
    let mut look = |index: usize, name: &str, status: &mut ImageStatus| {
        if names.contains(name) {
            jobs.push(Job { panorama, index, path: folder.join(name) });
        } else {
            *status = ImageStatus::Missing;
            counts.missing += 1;
            counts.missing_files.push(name.to_owned());
        }
        known.insert(name.to_owned());
    };
    if panorama {
        let all = dataset.panoramas.iter_mut().enumerate();
        for (index, image) in all.filter(|(_, p)| p.city == city) {
            look(index, &image.name, &mut image.status);
        }
        counts.not_in_lists = names.difference(&known).count() as u64;
        return Some(counts);
    }
    let all = dataset.satellites.iter_mut().enumerate();
    for (index, image) in all.filter(|(_, s)| s.city == city) {
        look(index, &image.name, &mut image.status);
    }
    // Images that no list and no label names are images all the same.
    for name in names.difference(&known) {
        match dataset.satellite(city, name) {
            Ok(index) => {
                counts.not_in_lists += 1;
                jobs.push(Job { panorama, index: index as usize, path: folder.join(name) });
            }
            Err(_) => counts.other_files += 1,
        }
    }
    Some(counts)
}

/// Names in a folder; hidden files, and what GDAL keeps beside an image, left out.
fn list(folder: &Path) -> io::Result<BTreeSet<String>> {
    let mut names = BTreeSet::new();
    for entry in std::fs::read_dir(folder)? {
        if let Ok(name) = entry?.file_name().into_string()
            && !name.starts_with('.')
        {
            names.insert(name);
        }
    }
    let all = names.clone();
    names.retain(|name| name.strip_suffix(".aux.xml").is_none_or(|image| !all.contains(image)));
    Ok(names)
}
