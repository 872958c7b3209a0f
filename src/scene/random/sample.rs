//! A square picture of a scene with its heights and classes.

use super::Kind;
use crate::scene::frame::Frame;
use crate::scene::object::{Class, Epoch};
use crate::scene::pixels::PixelPositions;
use crate::scene::surface::Scene;

/// A square of a scene, true north up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crop {
    /// Its middle, ground metres east of the scene's centre.
    pub east: f64,
    /// Its middle, ground metres north of the scene's centre.
    pub north: f64,
    /// Its side, ground metres.
    pub metres: f64,
}

impl Crop {
    /// The square of a side about the scene's centre.
    #[must_use]
    pub const fn centred(metres: f64) -> Self {
        Self { east: 0.0, north: 0.0, metres }
    }

    /// The point of the local frame at a position: down and right of the crop's middle, -1 to 1.
    #[must_use]
    pub fn local(&self, frame: &Frame, position: [f64; 2]) -> [f64; 2] {
        let half = self.metres / 2.0;
        frame.from_ground([self.east + half * position[1], self.north - half * position[0]])
    }
}

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
    /// Samples a square of a scene on `side` pixels. Heights are those of the lidar's time, when broad-leaved
    /// trees bear leaves; what is thinner than a lidar cell (wires, fences) is not in them.
    #[must_use]
    pub fn new(scene: &Scene, kind: Kind, side: usize, crop: &Crop) -> Self {
        let pixels =
            PixelPositions::square(&scene.frame, side, [crop.east, crop.north], crop.metres);
        let seed = [crop.east, crop.north, crop.metres].map(f64::to_bits);
        let seed = crate::random::key(&[scene.spec.seed, seed[0], seed[1], seed[2]]);
        let rgb = scene.render(&pixels, seed);
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
