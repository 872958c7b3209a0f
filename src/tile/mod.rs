//! A city from one big picture: windows, averaged densities, one seamless surface.

pub mod city;
mod column;
mod engine;
#[cfg(test)]
mod engine_tests;
mod explain;
mod finish;
pub mod frame;
pub mod ground;
#[cfg(test)]
mod hard_cases;
mod job;
pub mod layout;
mod network;
mod options;
mod record;
mod run;
pub mod slabs;
mod sums;
pub mod surface;
pub mod tiles3d;
mod volume;
mod writer;

pub mod dsm;
pub mod seams;
pub mod spool;

pub use column::ColumnIntegral;
pub use engine::{Engine, LineSink, Outcome, WindowModel, WindowSource};
pub use finish::{CityFacts, CityOutput};
pub use job::Job;
pub use network::{NetworkWindows, TileLattice};
pub use options::{
    CityMeshRequest, DsmRequest, ISOVALUE, TILES3D_ERROR_M, TileOptions, TileOutputs,
    Tiles3dRequest,
};
pub use record::SlabRecord;
pub use run::{Prepared, TileSummary, merge, prepare};
pub use surface::output::CityMeshColour;

use crate::batch::JournalError;
use crate::model::ModelError;
use crate::weights::WeightsError;
use std::path::PathBuf;

/// Why a city cannot be planned, made or joined.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TileError {
    /// Arguments that make the run pointless or ambiguous; the text says what to do.
    #[error("{0}")]
    Input(String),
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
    /// The picture at model resolution cannot be read back.
    #[error("cannot read the picture at model resolution: {0}")]
    Picture(std::io::Error),
    /// Open lines cannot be kept in their file.
    #[error("cannot keep the sums of open lines in a file: {0}")]
    Sums(std::io::Error),
    /// The network failed on a window.
    #[error("the window at column {x}, row {y} (model pixels): {reason}")]
    Window {
        /// First column.
        x: i64,
        /// First row.
        y: i64,
        /// What the network says.
        reason: String,
    },
    /// The checkpoint or the device cannot be used.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// No weights were found.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The journal in the output folder cannot be used.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// Windows cannot be laid out.
    #[error(transparent)]
    Layout(#[from] layout::LayoutError),
    /// The picture cannot be opened.
    #[error(transparent)]
    Open(#[from] crate::picture::PictureError),
    /// The picture has no usable size on the ground.
    #[error("{}: {source}", path.display())]
    Ground {
        /// The picture.
        path: PathBuf,
        /// Why.
        source: ground::GroundError,
    },
    /// The picture cannot be brought to model resolution.
    #[error(transparent)]
    Spool(#[from] spool::SpoolError),
    /// The density volume cannot be written.
    #[error(transparent)]
    Volume(#[from] crate::volume::VolumeError),
    /// The surface cannot be extracted.
    #[error(transparent)]
    Surface(#[from] crate::model::mesh::MeshError),
    /// The DSM cannot be written.
    #[error(transparent)]
    Dsm(#[from] dsm::DsmError),
    /// The mesh cannot be written.
    #[error(transparent)]
    Mesh(#[from] surface::output::CityMeshError),
    /// 3D Tiles cannot be written.
    #[error(transparent)]
    Tiles3d(#[from] tiles3d::Tiles3dError),
    /// The surface cannot be read back.
    #[error(transparent)]
    Store(#[from] surface::store::StoreError),
    /// The city's place cannot be used.
    #[error(transparent)]
    Place(#[from] crate::footprint::FootprintError),
}

impl TileError {
    pub(crate) fn io(
        action: &'static str,
        path: impl Into<PathBuf>,
    ) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    fn picture(error: std::io::Error) -> Self {
        Self::Picture(error)
    }

    fn sums(error: std::io::Error) -> Self {
        Self::Sums(error)
    }
}
