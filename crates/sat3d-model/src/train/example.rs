//! What a model learns from.

use crate::preprocess::Image8;
use crate::tensor::Grid;

/// One satellite image with everything that is known about its place. What is absent is `None`; a loss
/// that needs it is then an error for direct supervision, and left out of a batch otherwise.
#[derive(Clone, Debug, PartialEq)]
pub struct Example {
    /// Name for messages.
    pub name: String,
    /// The satellite image, RGB, north up, square.
    pub satellite: Image8,
    /// True heights, of simulated scenes.
    pub truth: Option<Truth>,
    /// What is seen from the street.
    pub street: Option<Street>,
    /// Relative depth from above, as Depth Anything gives it: `1 x side x side`, in [0, 1], larger is
    /// nearer to the satellite (higher).
    pub depth: Option<Grid>,
}

/// Exact heights of a simulated scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// Height of the surface over the mean bare earth of the crop, metres: `1 x side x side`, row 0 in
    /// the north; NaN where it is unknown.
    pub surface: Grid,
    /// Height of the bare earth over the same mean, metres, of the surface's size.
    pub ground: Grid,
    /// What the surface is, `side * side`, row-major.
    pub classes: Vec<Class>,
}

/// What a pixel of the surface is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Class {
    /// Bare earth, streets, cars, street furniture.
    Ground = 0,
    /// Buildings and other large structures.
    Building = 1,
    /// Trees and shrubs.
    Tree = 2,
    /// Water.
    Water = 3,
}

impl Class {
    /// Number of classes.
    pub const COUNT: usize = 4;
}

/// A panorama at a place of the crop.
#[derive(Clone, Debug, PartialEq)]
pub struct Street {
    /// Full panorama, RGB, equirectangular, width twice the height; its middle column looks north.
    pub panorama: Image8,
    /// Sky mask of the panorama's size, one channel: 255 sky, 0 not.
    pub sky: Image8,
    /// Place of the camera in the crop: down and right of its centre, [-1, 1], and the height in the
    /// cube before scaling (-0.85 in the release).
    pub position: [f32; 3],
}
