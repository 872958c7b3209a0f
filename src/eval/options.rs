//! What an evaluation is asked for.

use super::inputs::InputSettings;
use super::protocol::{OffsetMethod, Protocol};
use super::resize::Resize;
use super::strata::MaskOptions;
use crate::batch::Shard;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Everything that decides an evaluation.
#[derive(Clone, Debug)]
pub struct EvalOptions {
    /// One or more sets of predictions: folders, or files.
    pub predictions: Vec<PathBuf>,
    /// Names of the sets; those missing are taken from the folders.
    pub names: Vec<String>,
    /// The ground truth: a folder, or a file.
    pub truth: PathBuf,
    /// Protocols, each at most once.
    pub protocols: Vec<Protocol>,
    /// How vertical offsets are found; by default RANSAC for `paper`, the median otherwise.
    pub offset: Option<OffsetMethod>,
    /// How truths are brought to the predictions' size.
    pub resize: Resize,
    /// How files are read.
    pub inputs: InputSettings,
    /// Thresholds beside 2.5 m and 7.5 m, metres.
    pub thresholds: Vec<f64>,
    /// Classes of places.
    pub mask: Option<(PathBuf, MaskOptions)>,
    /// Side of the blocks of the bootstrap, metres.
    pub block_m: f64,
    /// Draws of the bootstrap.
    pub replicates: u32,
    /// Seed of everything random.
    pub seed: u64,
    /// At most so many images give the registration estimate; 0 leaves it out.
    pub registration_images: usize,
    /// Folder for rasters of the errors.
    pub errors: Option<PathBuf>,
    /// What is made of the scores; decides no number.
    pub outputs: Outputs,
    /// The part of the images that this run does.
    pub shard: Shard,
    /// Worker threads; the result does not depend on it.
    pub threads: usize,
    /// Bytes for errors that are kept between the two passes.
    pub memory: usize,
    /// No progress.
    pub quiet: bool,
}

/// What is made of the scores beside what is printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// A table with a row per image.
    pub table: bool,
    /// The HTML report.
    pub report: bool,
    /// Published rows beside the scores.
    pub published: bool,
}

/// What two runs must share so that their parts can be merged; the parts' identity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Names of the sets of predictions.
    pub models: Vec<String>,
    /// Protocols.
    pub protocols: Vec<Protocol>,
    /// How vertical offsets are found, if stated.
    pub offset: Option<OffsetMethod>,
    /// How truths are resized.
    pub resize: Resize,
    /// Metres per unit, if stated.
    pub metres_per_unit: Option<f64>,
    /// Zoom level of the images.
    pub zoom: u8,
    /// Pixels of the images.
    pub size: u32,
    /// Ground sample distance, if stated.
    pub gsd_m: Option<f64>,
    /// All thresholds, 2.5 and 7.5 first.
    pub thresholds: Vec<f64>,
    /// Labels of the mask's classes.
    pub classes: Vec<String>,
    /// Side of the bootstrap's blocks, metres.
    pub block_m: f64,
    /// Draws of the bootstrap.
    pub replicates: u32,
    /// Seed.
    pub seed: u64,
    /// Images of the registration estimate.
    pub registration_images: usize,
}

impl EvalOptions {
    /// Defaults, for one set of predictions.
    #[must_use]
    pub fn new(predictions: Vec<PathBuf>, truth: PathBuf) -> Self {
        Self {
            predictions,
            names: Vec::new(),
            truth,
            protocols: vec![Protocol::Paper],
            offset: None,
            resize: Resize::default(),
            inputs: InputSettings::default(),
            thresholds: Vec::new(),
            mask: None,
            block_m: 500.0,
            replicates: 2000,
            seed: 1,
            registration_images: 256,
            errors: None,
            outputs: Outputs::default(),
            shard: Shard::WHOLE,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory: 1024 << 20,
            quiet: false,
        }
    }

    /// All thresholds: the paper's, then the others in the order given, none twice.
    #[must_use]
    pub fn all_thresholds(&self) -> Vec<f64> {
        let mut all = vec![2.5, 7.5];
        for &threshold in &self.thresholds {
            if !all.contains(&threshold) {
                all.push(threshold);
            }
        }
        all
    }

    /// How vertical offsets are found under a protocol.
    #[must_use]
    pub fn offset_for(&self, protocol: Protocol) -> OffsetMethod {
        self.offset.unwrap_or(match protocol {
            Protocol::Paper => OffsetMethod::Ransac,
            _ => OffsetMethod::Median,
        })
    }

    /// A name for each set of predictions: the one given, else the folder's, made unique.
    #[must_use]
    pub fn model_names(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for (k, path) in self.predictions.iter().enumerate() {
            let own = |path: &std::path::Path| {
                let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
                let stem = if path.is_dir() { path.file_name() } else { path.file_stem() };
                stem.map_or_else(|| "predictions".to_owned(), |n| n.to_string_lossy().into_owned())
            };
            let name = self.names.get(k).cloned().unwrap_or_else(|| own(path));
            let mut unique = name.clone();
            let mut number = 2;
            while names.contains(&unique) {
                unique = format!("{name} ({number})");
                number += 1;
            }
            names.push(unique);
        }
        names
    }

    /// What decides the numbers, without folders and threads.
    #[must_use]
    pub fn settings(&self, classes: Vec<String>) -> Settings {
        Settings {
            models: self.model_names(),
            protocols: self.protocols.clone(),
            offset: self.offset,
            resize: self.resize,
            metres_per_unit: self.inputs.metres_per_unit,
            zoom: self.inputs.zoom,
            size: self.inputs.size,
            gsd_m: self.inputs.gsd_m,
            thresholds: self.all_thresholds(),
            classes,
            block_m: self.block_m,
            replicates: self.replicates,
            seed: self.seed,
            registration_images: self.registration_images,
        }
    }
}
