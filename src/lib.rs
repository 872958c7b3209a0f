//! sat3d: metric street-level 3-D from one overhead satellite image, at city scale, and the
//! benchmark that proves how good it is.
//!
//! Data flows one way: the command line -> a module here -> `raster`, `crs`, `grid` -> `units`.
//! See `docs/ARCHITECTURE.md` for the map.

pub mod batch;
pub mod crs;
pub mod dsm_bench;
pub mod eval;
pub mod footprint;
pub mod grid;
mod html;
pub mod illumination;
pub mod infer;
pub mod lidar;
pub mod mesh_file;
#[cfg(test)]
mod oracle;
pub mod picture;
pub mod plan;
pub mod raster;
pub mod recipe;
pub mod scene;
pub mod score;
pub mod stac;
pub mod table;
pub mod tile;
pub mod tradeoff;
#[cfg(feature = "train")]
pub mod train;
pub mod units;
pub mod viewer;
pub mod views;
pub mod vigor;
pub mod volume;
pub mod weights;

pub use sat3d_model::random;

/// The network, its radiance field and what is rendered from it.
pub use sat3d_model as model;
