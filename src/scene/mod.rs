//! Simulated scenes: truth for tests, demos and measurements.
//!
//! A scene is a pure function of position: [`Scene::surface`] and [`Scene::ground`] give the exact
//! height at any point, from analytic terrain and solids in closed form. Lidar tiles, truth
//! rasters and pictures are all samples of it, and each sample depends on nothing but the scene
//! file and its position: no stream of random numbers is shared, so that the bytes do not depend
//! on the number of threads.
//!
//! * [`SceneSpec`]: what a scene file says ([`spec`]), checked (`validate`).
//! * [`effects`]: the plan; each effect has a bound, a cost and a cause.
//! * [`terrain`], [`streets`], [`layout`], [`solid`], [`world`], `epoch`: the scene itself.
//! * `render`, `camera`, `ground`, `materials`, `shadows`: pictures; [`street`]: those from a street.
//! * [`random`]: scenes drawn at random, to learn from.
//! * [`lidar`], [`truth`], [`vigor_files`], [`whole`], [`simulate()`]: what is written.

mod camera;
pub mod effects;
mod epoch;
mod error;
pub mod frame;
mod ground;
mod index;
pub mod layout;
pub mod lidar;
mod materials;
mod noise;
pub mod object;
mod picture;
pub mod pixels;
pub mod random;
mod render;
mod shadows;
pub mod shape;
mod simulate;
pub mod solid;
pub mod spec;
pub mod street;
pub mod streets;
pub mod surface;
pub mod terrain;
pub mod truth;
mod validate;
pub mod vigor_files;
pub mod whole;
pub mod world;

pub use effects::{Effect, Options};
pub use error::SceneError;
pub use simulate::{Summary, simulate};
pub use spec::SceneSpec;
pub use surface::{Scene, Surface};

/// Width of the land around the extent on which objects stand, metres: their shadows and crowns
/// reach into the scene.
const MARGIN_M: f64 = 40.0;

/// Purposes of random numbers: the second part of every key, after the seed.
mod purpose {
    pub const TERRAIN: u64 = 1;
    pub const STREETS: u64 = 2;
    pub const USES: u64 = 3;
    pub const LOTS: u64 = 4;
    pub const TRAFFIC: u64 = 5;
    pub const CHANGE: u64 = 6;
    pub const NOISE: u64 = 7;
    pub const PULSES: u64 = 8;
    pub const CROWNS: u64 = 9;
    pub const GAPS: u64 = 10;
    pub const PANORAMAS: u64 = 11;
    pub const SENSOR: u64 = 12;
    pub const PICTURE: u64 = 13;
}
