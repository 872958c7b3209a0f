//! What is learnt from.

use super::{ObjectiveKind, Settings};
use crate::train::error::TrainingError;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Where examples come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DataSource {
    /// Simulated scenes, made while the training runs.
    #[default]
    Simulated,
    /// The VIGOR data set, or a folder laid out like it.
    Vigor,
}

/// What is learnt from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataSettings {
    /// Where examples come from.
    pub source: DataSource,
    /// Settings of `source = "simulated"`.
    pub simulated: SimulatedSettings,
    /// Settings of `source = "vigor"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vigor: Option<VigorSettings>,
    /// Threads that make examples; 0 takes half of the cores.
    pub threads: usize,
    /// Batches that are made ahead of the one that is learnt from.
    pub ahead: usize,
    /// Held-out examples that are looked at for the log.
    pub held_out: usize,
}

impl Default for DataSettings {
    fn default() -> Self {
        Self {
            source: DataSource::Simulated,
            simulated: SimulatedSettings::default(),
            vigor: None,
            threads: 0,
            ahead: 3,
            held_out: 8,
        }
    }
}

/// Simulated scenes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatedSettings {
    /// Seed of the scenes.
    pub seed: u64,
    /// Scenes in the pool from which crops are cut.
    pub scenes: usize,
    /// Passes over the pool until it is replaced by new scenes; 0 keeps it.
    pub passes: u64,
    /// Side of a scene, pixels.
    pub scene_side: usize,
    /// Side of a crop, pixels: what the network sees.
    pub side: usize,
    /// Ground size of a pixel, metres. VIGOR's Seattle images have 0.252 at 256 pixels.
    pub pixel_m: f64,
    /// How crops are turned and mirrored.
    pub symmetries: Symmetries,
    /// Strength of the colour changes: 0 none; 0.1 moves brightness, contrast and tints by about a tenth.
    pub colour: f64,
    /// Panoramas of each scene, where the objective learns from them; 0 for none.
    pub views: usize,
    /// Columns of a panorama; half as many rows.
    pub panorama_width: usize,
    /// Seed of the held-out scenes; another one than `seed`.
    pub held_out_seed: u64,
    /// Memory for the pool, MiB; scenes that do not fit are made again, or read from `cache`.
    pub memory_mib: usize,
    /// Folder that keeps scenes between runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cache: Option<PathBuf>,
}

impl Default for SimulatedSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            scenes: 1500,
            passes: 0,
            scene_side: 384,
            side: 256,
            pixel_m: 0.252,
            symmetries: Symmetries::Mirror,
            colour: 0.1,
            views: 4,
            panorama_width: 512,
            held_out_seed: 1_000_003,
            memory_mib: 4096,
            cache: None,
        }
    }
}

/// Symmetries of the square under which an example is still one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Symmetries {
    /// North stays up.
    None,
    /// East and west change places: north stays up and the sun in the south, as in real pictures.
    #[default]
    Mirror,
    /// All eight: the sun may come from anywhere.
    Square,
}

/// Which labels of a VIGOR folder count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LabelChoice {
    /// Sat3DGen's split files where there are some, else corrected labels, else the original ones.
    #[default]
    Best,
    /// VIGOR's own.
    Original,
    /// SliceMatch's corrected labels.
    Corrected,
    /// Sat3DGen's split files.
    Sat3dgen,
}

/// Where a panorama's camera is taken to stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Position {
    /// Where the label says, as the reference has it; a label without offsets is the centre.
    #[default]
    Label,
    /// Where its name says, on the image's Web-Mercator grid.
    Exact,
}

/// The VIGOR data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VigorSettings {
    /// VIGOR's root, or one city's folder.
    pub folder: PathBuf,
    /// `manifest.csv` of `sat3d vigor ingest`; without it the label files are read as that command reads them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub manifest: Option<PathBuf>,
    /// Cities; all where none are named.
    pub cities: Vec<String>,
    /// Part of the data that is learnt from: train, val, test, all.
    pub split: String,
    /// Part of the data that the log shows.
    pub held_out_split: String,
    /// Which labels count.
    pub labels: LabelChoice,
    /// Where cameras stand.
    pub position: Position,
    /// Height of the cameras in the cube, before scaling.
    pub camera_z: f32,
    /// Whether panoramas and sky masks are read; without them only the satellite images are learnt from.
    pub street: bool,
    /// Folder of the sky masks beside `panorama/`.
    pub sky_masks: String,
    /// Folder of the depth labels beside `satellite/`; empty for none.
    pub depth: String,
    /// Side of the satellite image, pixels: what the network sees.
    pub side: usize,
    /// Size of the files of satellite images, pixels; labels count in these.
    pub image_side: u32,
}

impl Default for VigorSettings {
    fn default() -> Self {
        Self {
            folder: PathBuf::new(),
            manifest: None,
            cities: Vec::new(),
            split: "train".into(),
            held_out_split: "test".into(),
            labels: LabelChoice::Best,
            position: Position::Label,
            camera_z: -0.85,
            street: true,
            sky_masks: "pano_sky_mask".into(),
            depth: "sat_depth".into(),
            side: 256,
            image_side: 640,
        }
    }
}

impl DataSettings {
    /// Threads that make examples.
    #[must_use]
    pub fn threads(&self) -> usize {
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        if self.threads > 0 { self.threads } else { (cores() / 2).max(1) }
    }

    pub(super) fn check(&self, settings: &Settings) -> Result<(), TrainingError> {
        if self.held_out > 64 {
            return Err(settings.wrong("data.held_out", self.held_out, "at most 64"));
        }
        match (self.source, &self.vigor) {
            (DataSource::Simulated, Some(_)) => Err(settings.wrong(
                "data.source",
                self.source,
                "there is a table [data.vigor]; give source = \"vigor\", or take the table out",
            )),
            (DataSource::Simulated, None) => self.simulated.check(settings),
            (DataSource::Vigor, None) => {
                Err(settings.wrong("data.vigor.folder", "", "name VIGOR's root or a city's folder"))
            }
            (DataSource::Vigor, Some(vigor)) => {
                if settings.objective.kind == ObjectiveKind::Heights {
                    return Err(settings.wrong(
                        "objective.kind",
                        "heights",
                        "VIGOR has no heights to learn from; give kind = \"paper\", or data.source = \"simulated\"",
                    ));
                }
                vigor.check(settings)
            }
        }
    }
}

impl SimulatedSettings {
    fn check(&self, settings: &Settings) -> Result<(), TrainingError> {
        let key = |name: &str| format!("data.simulated.{name}");
        if self.scenes == 0 {
            return Err(settings.wrong(&key("scenes"), self.scenes, "at least 1"));
        }
        if !(16..=4096).contains(&self.side) {
            return Err(settings.wrong(&key("side"), self.side, "from 16 to 4096 pixels"));
        }
        if !(self.side..=8192).contains(&self.scene_side) {
            let why = format!("from the side of a crop, {}, to 8192 pixels", self.side);
            return Err(settings.wrong(&key("scene_side"), self.scene_side, why));
        }
        if !(self.pixel_m > 0.01 && self.pixel_m < 10.0) {
            return Err(settings.wrong(&key("pixel_m"), self.pixel_m, "from 0.01 to 10 m"));
        }
        if !(0.0..=1.0).contains(&self.colour) {
            return Err(settings.wrong(&key("colour"), self.colour, "from 0 to 1"));
        }
        if self.views > 64 {
            return Err(settings.wrong(&key("views"), self.views, "at most 64"));
        }
        if !(8..=8192).contains(&self.panorama_width) || !self.panorama_width.is_multiple_of(8) {
            let why = "a multiple of 8, from 8 to 8192";
            return Err(settings.wrong(&key("panorama_width"), self.panorama_width, why));
        }
        if self.seed == self.held_out_seed {
            let why =
                "must differ from data.simulated.seed, or the log looks at scenes that were learnt";
            return Err(settings.wrong(&key("held_out_seed"), self.held_out_seed, why));
        }
        Ok(())
    }
}

impl VigorSettings {
    fn check(&self, settings: &Settings) -> Result<(), TrainingError> {
        let key = |name: &str| format!("data.vigor.{name}");
        if self.folder.as_os_str().is_empty() || !self.folder.is_dir() {
            let why = "is no folder; name VIGOR's root or a city's folder";
            return Err(settings.wrong(&key("folder"), &self.folder, why));
        }
        if let Some(manifest) = &self.manifest
            && !manifest.is_file()
        {
            let why = "is no file; `sat3d vigor ingest` writes it";
            return Err(settings.wrong(&key("manifest"), manifest, why));
        }
        for (name, split) in [("split", &self.split), ("held_out_split", &self.held_out_split)] {
            if !["train", "val", "test", "all"].contains(&split.as_str()) {
                return Err(settings.wrong(&key(name), split, "one of train, val, test, all"));
            }
        }
        if !(16..=4096).contains(&self.side) {
            return Err(settings.wrong(&key("side"), self.side, "from 16 to 4096 pixels"));
        }
        if !(16..=65_536).contains(&self.image_side) {
            return Err(settings.wrong(
                &key("image_side"),
                self.image_side,
                "from 16 to 65536 pixels",
            ));
        }
        if !(-1.0..=1.0).contains(&self.camera_z) {
            return Err(settings.wrong(&key("camera_z"), self.camera_z, "from -1 to 1"));
        }
        Ok(())
    }
}
