//! What is known of one slab after its work: a line of the journal.

use crate::batch::{self, OutputFile, Status, Words};
use serde::{Deserialize, Serialize};

/// How one slab ended. Holds no times, hosts or thread counts: the same input gives the same record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SlabRecord {
    /// The slab's number, in five digits.
    pub name: String,
    /// Done or failed.
    pub status: Status,
    /// Why it failed; empty when done.
    pub reason: String,
    /// Fingerprint of the picture: name, size and time.
    pub inputs: String,
    /// Windows that begin in the slab and were run.
    pub windows: u64,
    /// Windows that begin in the slab and hold no data.
    pub empty_windows: u64,
    /// Columns of the slab.
    pub columns: u64,
    /// Columns with a height.
    pub heights: u64,
    /// Columns over pixels without data.
    pub no_data: u64,
    /// Sum of the heights, metres.
    pub sum_m: f64,
    /// Lowest height, metres.
    pub min_m: Option<f64>,
    /// Greatest height, metres.
    pub max_m: Option<f64>,
    /// Triangles of the surface, before simplification.
    pub triangles: u64,
    /// Files written for it.
    pub outputs: Vec<OutputFile>,
}

impl SlabRecord {
    /// An empty record.
    #[must_use]
    pub fn new(slab: u32, inputs: &str) -> Self {
        Self {
            name: Self::name_of(slab),
            status: Status::Done,
            reason: String::new(),
            inputs: inputs.to_owned(),
            windows: 0,
            empty_windows: 0,
            columns: 0,
            heights: 0,
            no_data: 0,
            sum_m: 0.0,
            min_m: None,
            max_m: None,
            triangles: 0,
            outputs: Vec::new(),
        }
    }

    /// The name of a slab's record.
    #[must_use]
    pub fn name_of(slab: u32) -> String {
        format!("{slab:05}")
    }
}

impl batch::Record for SlabRecord {
    const WORDS: &'static Words = &Words {
        command: "tile",
        holds: "slabs of a city made",
        anew: "make them anew",
        other_part: "made with another plan than the other parts; parts of one city need the same picture, options and weights",
        other_list: "the shards saw pictures of different sizes; run them again with the same picture",
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
