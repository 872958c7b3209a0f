//! What is known of one image after its work: a line of the journal, a row of the manifest.

use crate::batch::{self, OutputFile, Status, Words};
use serde::{Deserialize, Serialize};

/// How one image ended, with what is worth knowing of its DSM. Holds no times, hosts or thread
/// counts: the same input gives the same record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Stem of the image's name.
    pub name: String,
    /// Done, skipped or failed.
    pub status: Status,
    /// Why it was skipped or failed; empty when done.
    pub reason: String,
    /// Latitude of the centre, degrees.
    pub lat_deg: Option<f64>,
    /// Longitude of the centre, degrees.
    pub lon_deg: Option<f64>,
    /// Fingerprint of the inputs: candidate tiles with size and time. In the journal only, since
    /// times differ between machines.
    #[serde(default)]
    pub inputs: String,
    /// File names of the tiles that gave pixels.
    pub tiles: Vec<String>,
    /// Number of tiles whose outline meets the image's.
    pub candidates: u64,
    /// Pixels without data, per cent.
    pub nan_pct: Option<f64>,
    /// Pixels without data in the best mosaic of the candidates, where `best-tile` was not enough.
    pub mosaic_nan_pct: Option<f64>,
    /// Form of the transform used.
    pub transform: Option<String>,
    /// Bound on the displacement of the transform, metres.
    pub transform_bound_m: Option<f64>,
    /// Lowest height, metres.
    pub min_m: Option<f64>,
    /// Highest height, metres.
    pub max_m: Option<f64>,
    /// Mean height, metres.
    pub mean_m: Option<f64>,
    /// Steepest gradient between neighbouring lidar cells within the horizontal bounds of the
    /// footprint, metres per metre; beside no-data twice the range of the valid ones among four
    /// cells stands for a step.
    pub steepest: Option<f64>,
    /// Bound on the error of height that all steps together make, metres, for pixels that are not
    /// counted in `uncertain_px`; with `average` and with widened kernels also only for pixels whose
    /// support has no cell without data. `None` for `nearest`, which steps from cell to cell.
    pub height_bound_m: Option<f64>,
    /// Pixels for which the no-data cells around them decide, within the horizontal bounds, whether
    /// they have a value, or by which rule.
    pub uncertain_px: Option<u64>,
    /// Pixels without bare-earth data, per cent, where a `dtm` was asked for.
    pub dtm_nan_pct: Option<f64>,
    /// Things to look at, for example heights implausible for the unit.
    pub flags: Vec<String>,
    /// Files written.
    pub outputs: Vec<OutputFile>,
}

impl Record {
    /// A record of an image that gave nothing.
    #[must_use]
    pub fn without_output(name: &str, status: Status, reason: String) -> Self {
        Self {
            name: name.to_owned(),
            status,
            reason,
            lat_deg: None,
            lon_deg: None,
            inputs: String::new(),
            tiles: Vec::new(),
            candidates: 0,
            nan_pct: None,
            mosaic_nan_pct: None,
            transform: None,
            transform_bound_m: None,
            min_m: None,
            max_m: None,
            mean_m: None,
            steepest: None,
            height_bound_m: None,
            uncertain_px: None,
            dtm_nan_pct: None,
            flags: Vec::new(),
            outputs: Vec::new(),
        }
    }
}

impl batch::Record for Record {
    const WORDS: &'static Words = &Words {
        command: "dsm-bench build",
        holds: "a benchmark built",
        anew: "build it anew",
        other_part: "built with another plan than the other parts; parts of one benchmark need equal options and tiles",
        other_list: "the shards saw image lists of different lengths; run them again with the same --vigor or --images",
        redo: "build that shard again with --verify hashes",
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
