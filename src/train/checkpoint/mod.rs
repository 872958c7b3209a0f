//! Checkpoints: folders that appear whole or not at all, in the layout that the reference loads.
//!
//! ```text
//! checkpoint-2000/
//!   vqmodel/       config.json, diffusion_pytorch_model.safetensors: the weights
//!   vqmodel_ema/   the same of their moving average, which `sat3d infer --weights` takes
//!   state.safetensors   everything that the learner needs to go on
//!   train.json     step, settings, counters, size and SHA-256 of the other files
//! ```

mod tensors;

pub use tensors::{read_tensors, write_tensors};

use super::error::TrainingError;
use super::progress::Progress;
use crate::batch::{AtomicFolder, OutputFile, Verify};
use crate::model::train::{Exported, NamedTensor};
use crate::model::weights::WEIGHTS_FILE;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Number of the format of `train.json`.
const FORMAT: u32 = 1;
/// Name of the description in a checkpoint folder.
pub const DESCRIPTION: &str = "train.json";
/// Name of the learner's state in a checkpoint folder.
pub const STATE: &str = "state.safetensors";

/// What `train.json` says. No times and no machine are in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// Number of this format.
    pub format: u32,
    /// The program.
    pub software: String,
    /// Steps that were done.
    pub step: u64,
    /// Seed of the training.
    pub seed: u64,
    /// SHA-256 of `settings`.
    pub settings_hash: String,
    /// Everything that the weights depend on.
    pub settings: Value,
    /// Bytes of `log.jsonl` that belong to these steps.
    pub log_bytes: u64,
    /// What was counted on the way.
    pub progress: Progress,
    /// The other files of the folder.
    pub files: Vec<OutputFile>,
}

/// A checkpoint on disk whose files are what its description says.
#[derive(Clone, Debug)]
pub struct Stored {
    /// Its folder.
    pub folder: PathBuf,
    /// Its `train.json`.
    pub description: Description,
}

/// SHA-256 of settings.
#[must_use]
pub fn settings_hash(settings: &Value) -> String {
    use sha2::{Digest, Sha256};
    crate::plan::hex(&Sha256::digest(settings.to_string().as_bytes()))
}

/// Name of the folder after so many steps.
#[must_use]
pub fn name(step: u64) -> String {
    format!("checkpoint-{step}")
}

/// The step in the name of a checkpoint folder.
#[must_use]
pub fn step_of(name: &str) -> Option<u64> {
    name.strip_prefix("checkpoint-")?.parse().ok()
}

/// Writes a checkpoint into the folder `out`; `description` gets the list of files.
///
/// # Errors
/// [`TrainingError::Io`], when the disk is full for example: nothing is left of the new checkpoint then, and older
/// ones are as they were.
pub fn write(
    out: &Path,
    mut description: Description,
    exported: &Exported,
    state: &[NamedTensor],
) -> Result<PathBuf, TrainingError> {
    let target = out.join(name(description.step));
    let io = |source| TrainingError::Io { path: target.clone(), source };
    let folder = AtomicFolder::create(&target).map_err(io)?;
    for (inside, weights) in [("vqmodel", &exported.model), ("vqmodel_ema", &exported.average)] {
        folder.write(&format!("{inside}/config.json"), exported.config.as_bytes()).map_err(io)?;
        let file = format!("{inside}/{WEIGHTS_FILE}");
        folder.file(&file, |path| write_tensors(path, weights)).map_err(io)?;
    }
    folder.file(STATE, |path| write_tensors(path, state)).map_err(io)?;
    description.format = FORMAT;
    description.files = ["vqmodel", "vqmodel_ema"]
        .into_iter()
        .flat_map(|inside| [format!("{inside}/config.json"), format!("{inside}/{WEIGHTS_FILE}")])
        .chain([STATE.to_owned()])
        .map(|file| OutputFile::measure(folder.path(), &file))
        .collect::<Result<_, _>>()
        .map_err(io)?;
    let text = serde_json::to_string_pretty(&description).map_err(|error| io(error.into()))?;
    folder.write(DESCRIPTION, (text + "\n").as_bytes()).map_err(io)?;
    folder.commit().map_err(io)?;
    Ok(target)
}

/// The steps of all folders in `out` that are named like checkpoints, newest first.
///
/// # Errors
/// [`TrainingError::Io`] when the folder cannot be listed.
pub fn list(out: &Path) -> Result<Vec<u64>, TrainingError> {
    let mut steps = Vec::new();
    for item in std::fs::read_dir(out).map_err(TrainingError::io(out))? {
        let item = item.map_err(TrainingError::io(out))?;
        if let Some(step) = item.file_name().to_str().and_then(step_of)
            && item.path().is_dir()
        {
            steps.push(step);
        }
    }
    steps.sort_unstable_by(|a, b| b.cmp(a));
    Ok(steps)
}

/// The newest checkpoint in `out` whose files are whole. What is damaged is named in a warning and left where it
/// is.
///
/// # Errors
/// [`TrainingError::Io`] when the folder cannot be listed.
pub fn newest(out: &Path) -> Result<Option<Stored>, TrainingError> {
    for step in list(out)? {
        let folder = out.join(name(step));
        match open(&folder) {
            Ok(description) => return Ok(Some(Stored { folder, description })),
            Err(why) => {
                tracing::warn!(
                    "{}: not a whole checkpoint: {why}; an older one is taken",
                    folder.display()
                );
            }
        }
    }
    Ok(None)
}

/// Reads a checkpoint's description and checks its files against it.
fn open(folder: &Path) -> Result<Description, String> {
    let path = folder.join(DESCRIPTION);
    let text = std::fs::read(&path).map_err(|error| format!("{DESCRIPTION}: {error}"))?;
    let description: Description =
        serde_json::from_slice(&text).map_err(|error| format!("{DESCRIPTION}: {error}"))?;
    if description.format != FORMAT {
        return Err(format!("{DESCRIPTION} has format {}, not {FORMAT}", description.format));
    }
    let bad = description.files.iter().find(|file| !file.holds(folder, Verify::Hashes));
    bad.map_or(Ok(description.clone()), |file| {
        Err(format!("{} is not what was written", file.file))
    })
}

/// Removes all but the newest `keep` checkpoints; 0 keeps all. What cannot be removed is named in a warning.
pub fn prune(out: &Path, keep: usize) {
    let steps = match list(out) {
        Ok(steps) if keep > 0 => steps,
        _ => return,
    };
    for step in steps.into_iter().skip(keep) {
        let folder = out.join(name(step));
        // Renamed first: a folder that is half removed must not look like a checkpoint.
        let hidden = out.join(format!(".{}.removed.old", name(step)));
        let removed =
            std::fs::rename(&folder, &hidden).and_then(|()| std::fs::remove_dir_all(&hidden));
        if let Err(error) = removed {
            tracing::warn!("{}: cannot be removed: {error}", folder.display());
        }
    }
}

#[cfg(test)]
mod tests;
