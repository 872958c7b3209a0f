//! A square picture of a scene with its heights and classes.

use super::Kind;
use crate::scene::object::{Class, Epoch};
use crate::scene::pixels::PixelPositions;
use crate::scene::surface::Scene;

/// A square picture with exact heights; row 0 is the northernmost.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// Pixels of a side.
    pub side: usize,
    /// Red, green, blue of each pixel: `side * side * 3` bytes.
    pub rgb: Vec<u8>,
    /// Height of the surface at each pixel's centre over [`Self::datum`], metres.
    pub surface: Vec<f32>,
    /// Height of the bare earth (of the water over water) over [`Self::datum`], metres.
    pub ground: Vec<f32>,
    /// 0 ground and all that is none of these, 1 building, 2 tree or shrub, 3 water.
    pub classes: Vec<u8>,
    /// Mean height of the bare earth in the square (NAVD88), metres.
    pub datum: f64,
    /// Azimuth (clockwise from north) and elevation of the sun, degrees; `None` under an overcast sky.
    pub sun: Option<[f64; 2]>,
    /// What kind of place it is.
    pub kind: Kind,
}

impl Sample {
    /// Samples a square of `side` pixels and `metres` ground metres about the centre of a scene.
    /// Heights are those of the lidar's time, when broad-leaved trees bear leaves.
    #[must_use]
    pub fn new(scene: &Scene, kind: Kind, side: usize, metres: f64) -> Self {
        let pixels = PixelPositions::square(&scene.frame, side, metres);
        let rgb = scene.render(&pixels, scene.spec.seed);
        let count = side * side;
        let (mut top, mut low) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut classes = Vec::with_capacity(count);
        for row in 0..side {
            for p in pixels.row(row) {
                let surface = scene.surface(Epoch::Lidar, p[0], p[1]);
                top.push(surface.height);
                low.push(surface.ground.z);
                let class = match surface.solid {
                    Some((solid, _)) => scene.world(Epoch::Lidar).solids[solid as usize].class,
                    None if surface.ground.water => Class::Water,
                    None => Class::Ground,
                };
                classes.push(class_number(class));
            }
        }
        let datum = low.iter().sum::<f64>() / count.max(1) as f64;
        let over = |heights: &[f64]| heights.iter().map(|z| (z - datum) as f32).collect();
        let sun = scene.spec.sun.map(|s| [s.azimuth_degrees, s.elevation_degrees]);
        Self { side, rgb, surface: over(&top), ground: over(&low), classes, datum, sun, kind }
    }
}

const fn class_number(class: Class) -> u8 {
    match class {
        Class::Building => 1,
        Class::Tree => 2,
        Class::Water => 3,
        Class::Ground | Class::Street | Class::Car | Class::Structure => 0,
    }
}
