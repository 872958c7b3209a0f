//! From satellite images to DSMs and what else a scene can be rendered to, one image or a city.
//!
//! [`InferOptions`] are resolved to a [`Plan`](crate::plan::Plan) by [`prepare`], and
//! [`Prepared::run`] executes it: decode, network, field, DSM, files. Images pass the network one after
//! another, since each takes all cores; the next is decoded and the last is written meanwhile.

mod explain;
mod item;
mod list;
mod manifest;
mod options;
mod outputs;
mod record;
mod renders;
mod run;

pub use list::{Entry, Kind};
pub use options::{InferOptions, MeshRequest, Outputs, VolumeFormat, VolumeRequest};
pub use record::Record;
pub use run::{Counted, Prepared, RunSummary, merge, prepare};

use crate::batch::JournalError;
use crate::illumination::IlluminationError;
use crate::model::ModelError;
use crate::weights::WeightsError;
use std::path::PathBuf;

/// Width or height on the ground that differs from the training's by more than this share is said.
pub const GROUND_TOLERANCE: f64 = 0.05;

/// Why a run cannot be planned, made or merged. Errors of single images are not here: they are recorded
/// with the image.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The checkpoint or the device cannot be used.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The operating system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried, for example `read`.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// No weights were found.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// There is no light for street views.
    #[error(transparent)]
    Light(#[from] IlluminationError),
    /// The journal in the output folder cannot be used.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A manifest cannot be read or written as a table.
    #[error("{}: {reason}", path.display())]
    Table {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Input that makes the whole run pointless or ambiguous; the text says what to do.
    #[error("{0}")]
    Input(String),
}

impl InferError {
    pub(crate) fn io(
        action: &'static str,
        path: impl Into<PathBuf>,
    ) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }
}
