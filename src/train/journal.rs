//! `log.jsonl`: one line per logged step. No times are in it, so that a training that was interrupted leaves the
//! same log as one that was not.

use super::error::TrainingError;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Name of the log in the output folder.
pub const LOG: &str = "log.jsonl";

/// Errors on held-out examples, metres; the vertical offset of each is taken out as the published scoring does.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Examples.
    pub examples: usize,
    /// Mean absolute error.
    pub mae_m: f64,
    /// Root of the mean squared error, over all pixels.
    pub rmse_m: f64,
    /// RMSE of flat ground, the same for every step.
    pub flat_rmse_m: f64,
    /// MAE of flat ground.
    pub flat_mae_m: f64,
}

/// One line of the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Steps that were done.
    pub step: u64,
    /// Examples that were learnt from until then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub images: Option<u64>,
    /// Means of the terms, weights included, since the last line; the first is the total.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub terms: Map<String, Value>,
    /// Errors on held-out examples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<Scores>,
    /// Why the batch of this step was skipped.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skipped: Option<String>,
}

impl Line {
    /// A line of nothing yet.
    #[must_use]
    pub fn at(step: u64) -> Self {
        Self { step, images: None, terms: Map::new(), held_out: None, skipped: None }
    }
}

/// The log, open for appending.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
    bytes: u64,
}

impl Journal {
    /// Opens the log of a folder and cuts off what is beyond `bytes`: lines of steps that are done again.
    ///
    /// # Errors
    /// [`TrainingError::Io`].
    pub fn open(out: &Path, bytes: u64) -> Result<Self, TrainingError> {
        let path = out.join(LOG);
        let open = || {
            let mut file =
                OpenOptions::new().create(true).truncate(false).write(true).open(&path)?;
            let there = file.metadata()?.len();
            if there < bytes {
                tracing::warn!(
                    "{}: {} bytes are missing; the log has a gap",
                    path.display(),
                    bytes - there
                );
            }
            let bytes = bytes.min(there);
            file.set_len(bytes)?;
            file.seek(SeekFrom::Start(bytes))?;
            Ok((file, bytes))
        };
        let (file, bytes) = open().map_err(TrainingError::io(&path))?;
        Ok(Self { file, path, bytes })
    }

    /// Adds a line.
    ///
    /// # Errors
    /// [`TrainingError::Io`].
    pub fn add(&mut self, line: &Line) -> Result<(), TrainingError> {
        let mut text = serde_json::to_vec(line)
            .map_err(|error| TrainingError::io(&self.path)(error.into()))?;
        text.push(b'\n');
        self.file.write_all(&text).map_err(TrainingError::io(&self.path))?;
        self.bytes += text.len() as u64;
        Ok(())
    }

    /// Makes the log durable; its size in bytes.
    ///
    /// # Errors
    /// [`TrainingError::Io`].
    pub fn sync(&mut self) -> Result<u64, TrainingError> {
        self.file.sync_all().map_err(TrainingError::io(&self.path))?;
        Ok(self.bytes)
    }
}

/// All lines of the log in a folder; what is no line is left out.
#[must_use]
pub fn read(out: &Path) -> Vec<Line> {
    let text = std::fs::read_to_string(out.join(LOG)).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_beyond_the_checkpoint_are_cut_off() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut journal = Journal::open(folder.path(), 0).expect("opens");
        let line = |step| Line { images: Some(step * 8), ..Line::at(step) };
        journal.add(&line(10)).expect("writes");
        let bytes = journal.sync().expect("syncs");
        journal.add(&line(20)).expect("writes");
        drop(journal);
        assert_eq!(read(folder.path()), [line(10), line(20)]);
        let mut journal = Journal::open(folder.path(), bytes).expect("opens");
        journal.add(&Line { skipped: Some("NaN".into()), ..Line::at(15) }).expect("writes");
        let text = std::fs::read_to_string(folder.path().join(LOG)).expect("reads");
        assert_eq!(text, "{\"step\":10,\"images\":80}\n{\"step\":15,\"skipped\":\"NaN\"}\n");
        // Longer than it is: what is there stays.
        let journal = Journal::open(folder.path(), 10_000).expect("opens");
        assert_eq!(journal.bytes, text.len() as u64);
    }
}
