//! What keeps a training from its work.

use crate::batch::JournalError;
use crate::model::ModelError;
use crate::model::train::TrainError;
use crate::vigor::LayoutError;
use std::io;
use std::path::{Path, PathBuf};

/// An error of `sat3d train`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainingError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The settings are no TOML, or hold a key or a value that is not served.
    #[error("{}:{line}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong, with the key and what is served.
        message: String,
    },
    /// `--set` of something that is no setting.
    #[error("--set {change}: {why}")]
    Change {
        /// As written.
        change: String,
        /// What is wrong, and what is served.
        why: String,
    },
    /// A setting contradicts another one or makes no training.
    #[error("{}: `{key}` = {value}: {why}", path.display())]
    Setting {
        /// The file.
        path: PathBuf,
        /// Path of the key, as `run.batch`.
        key: String,
        /// The value found.
        value: String,
        /// What is served.
        why: String,
    },
    /// The data folder is no VIGOR folder.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The data hold nothing that can be learnt from.
    #[error("nothing to learn from in {what}: {why}")]
    NothingLeft {
        /// The data.
        what: String,
        /// What was found instead, with the counts of the reasons.
        why: String,
    },
    /// A thread that made examples ended early.
    #[error("making example {draw} failed: {why}")]
    Example {
        /// Number of the draw.
        draw: u64,
        /// What it said.
        why: String,
    },
    /// The output folder is in use, or cannot be.
    #[error(transparent)]
    Folder(#[from] JournalError),
    /// The folder holds a training with other settings.
    #[error(
        "{} holds a training with another `{key}` ({stored}, now {now}); set it back, or give another folder with --out",
        folder.display()
    )]
    Differs {
        /// The output folder.
        folder: PathBuf,
        /// The first setting that differs.
        key: String,
        /// Its value when the training began.
        stored: String,
        /// Its value now.
        now: String,
    },
    /// Too many batches in a row were not finite.
    #[error(
        "{count} batches in a row were skipped, the last at step {step} ({why}): the training does not go on; lower \
         the learning rate, or look at the data"
    )]
    NotFinite {
        /// Batches in a row.
        count: u64,
        /// Step of the last.
        step: u64,
        /// What was not finite.
        why: String,
    },
    /// The learner refused.
    #[error("step {step}: {source}")]
    Learner {
        /// The step.
        step: u64,
        /// Why.
        source: TrainError,
    },
    /// The learner cannot be made, stored or restored.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The model cannot be opened.
    #[error(transparent)]
    Model(#[from] ModelError),
}

impl TrainingError {
    /// An [`TrainingError::Io`] for `map_err`.
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }
}
