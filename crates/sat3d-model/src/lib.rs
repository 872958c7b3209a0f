//! The Sat3DGen network in Rust: a satellite image becomes a radiance field; DSM, density grid, mesh
//! and street views are rendered from it.
//!
//! The crate knows nothing of maps, and of files only checkpoints and scenes.

pub mod field;
pub mod illumination;
pub mod render;
pub mod scene;
mod tensor;

pub use scene::Scene;
pub use tensor::Grid;
