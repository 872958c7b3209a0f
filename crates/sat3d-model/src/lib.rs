//! The Sat3DGen network in Rust: a satellite image becomes a radiance field; DSM, density grid, mesh
//! and street views are rendered from it.
//!
//! The crate knows nothing of maps, and of files only checkpoints and scenes.

pub mod config;
mod error;
#[cfg(test)]
mod exact;
pub mod field;
pub mod illumination;
pub mod mesh;
mod model;
pub mod network;
#[cfg(feature = "parity")]
pub mod parity;
pub mod preprocess;
pub mod random;
pub mod render;
pub mod scene;
mod tensor;
#[cfg(feature = "train")]
pub mod train;
pub mod weights;

pub use config::Config;
pub use error::{Mismatch, ModelError};
pub use model::Model;
pub use network::{Device, Network};
pub use preprocess::Image8;
pub use scene::Scene;
pub use tensor::Grid;
pub use weights::Checkpoint;
