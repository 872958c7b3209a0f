//! What is known of one image after its work: a line of the journal, a row of the manifest.

use crate::batch::{self, OutputFile, Status, Words};
use serde::{Deserialize, Serialize};

/// Where an image's size on the ground comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GroundFrom {
    /// Its name or georeference, or the scene file.
    Place,
    /// `--gsd`.
    Option,
    /// Nothing says it: taken to be as large as the images of the training.
    Assumed,
}

impl GroundFrom {
    /// `place`, `option` or `assumed`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Place => "place",
            Self::Option => "option",
            Self::Assumed => "assumed",
        }
    }
}

/// How one image ended, with what is worth knowing of its DSM. Holds no times, hosts or thread counts:
/// the same input gives the same record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Stem of the image's name.
    pub name: String,
    /// Done, skipped or failed.
    pub status: Status,
    /// Why it failed; empty when done.
    pub reason: String,
    /// File name of the image.
    pub image: String,
    /// Fingerprint of the image: size and time. In the journal only, since times differ between
    /// machines.
    #[serde(default)]
    pub inputs: String,
    /// Columns and rows of the image.
    pub size_px: Option<[u32; 2]>,
    /// Latitude of the centre, degrees.
    pub lat_deg: Option<f64>,
    /// Longitude of the centre, degrees.
    pub lon_deg: Option<f64>,
    /// Metres on the ground, across and down.
    pub ground_m: Option<[f64; 2]>,
    /// What says so.
    pub ground_from: Option<GroundFrom>,
    /// Whether that is another size than the training's.
    pub other_ground: bool,
    /// Metres per 1.0 of `arr_0`.
    pub metres_per_unit: Option<f64>,
    /// Lowest height, metres above the bottom of the cube.
    pub min_m: Option<f64>,
    /// Highest height, metres.
    pub max_m: Option<f64>,
    /// Mean height, metres.
    pub mean_m: Option<f64>,
    /// Mean opacity, 0 to 1.
    pub opacity: Option<f64>,
    /// Pixels of the DSM whose ray met no surface (opacity under 0.05).
    pub no_surface_px: Option<u64>,
    /// Light of the street views, where there are any.
    #[serde(default)]
    pub light: Option<String>,
    /// Things to look at.
    pub flags: Vec<String>,
    /// Files written.
    pub outputs: Vec<OutputFile>,
}

impl Record {
    /// A record of an image before its work.
    #[must_use]
    pub fn new(name: &str, image: &str, inputs: String) -> Self {
        Self {
            name: name.to_owned(),
            status: Status::Done,
            reason: String::new(),
            image: image.to_owned(),
            inputs,
            size_px: None,
            lat_deg: None,
            lon_deg: None,
            ground_m: None,
            ground_from: None,
            other_ground: false,
            metres_per_unit: None,
            min_m: None,
            max_m: None,
            mean_m: None,
            opacity: None,
            no_surface_px: None,
            light: None,
            flags: Vec::new(),
            outputs: Vec::new(),
        }
    }
}

impl batch::Record for Record {
    const WORDS: &'static Words = &Words {
        command: "infer",
        holds: "predictions made",
        anew: "make them anew",
        other_part: "made with another plan than the other parts; parts of one run need equal options and weights",
        other_list: "the shards saw image lists of different lengths; run them again with the same input",
        redo: "run that shard again with --verify hashes",
    };

    fn name(&self) -> &str {
        &self.name
    }

    fn status(&self) -> Status {
        self.status
    }

    fn reason(&self) -> &str {
        &self.reason
    }

    fn outputs(&self) -> &[OutputFile] {
        &self.outputs
    }

    fn fail(&mut self, reason: String) {
        self.status = Status::Failed;
        self.reason = reason;
        self.outputs.clear();
    }
}
