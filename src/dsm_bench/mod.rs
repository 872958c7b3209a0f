//! The ground-truth DSM benchmark: one DSM per satellite image out of lidar tiles.
//!
//! Algorithm 1 of the paper, on the image's exact pixel grid: index the tiles -> candidates of an
//! image -> warp each onto the grid -> keep the best coverage (or mosaic them) -> metres -> discard
//! when more than 5 % of the pixels are without data -> save.
//!
//! [`BuildOptions`] are resolved to a [`Plan`](crate::plan::Plan) by [`prepare`], and
//! [`Prepared::run`] executes it.

mod build;
mod compare;
mod images;
mod item;
mod layers;
mod manifest;
mod merge;
mod options;
mod plan;
mod record;
mod stac;
mod tiles;

pub use build::{Prepared, RunSummary, TransformMeasure, prepare};
pub use compare::{CompareError, Comparison, ErrorSummary, compare};
pub use images::{ImageEntry, ImageSource};
pub use layers::Coverage;
pub use merge::merge;
pub use options::{BuildOptions, GridKind, Quantisation, TransformChoice};
pub use record::Record;
pub use tiles::{Tile, TileSet};

pub use crate::batch::{JournalError, OutputFile, Verify};

use crate::crs::CrsError;
use crate::raster::RasterError;
use std::path::PathBuf;

/// Why a benchmark cannot be planned, built or merged. Errors of single images are not here: they
/// are recorded with the image.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A raster cannot be used.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A coordinate system cannot be served.
    #[error("{}: {source}", path.display())]
    Crs {
        /// The tile.
        path: PathBuf,
        /// What is wrong with its CRS.
        source: CrsError,
    },
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
    /// The journal in the output folder cannot be used.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// Input that makes the whole run pointless or ambiguous; the text says what to do.
    #[error("{0}")]
    Input(String),
}

impl BenchError {
    pub(crate) fn io(
        action: &'static str,
        path: impl Into<PathBuf>,
    ) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }
}
