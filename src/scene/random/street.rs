//! A panorama at a drawn place of a random scene.

use super::sample::Crop;
use crate::random::Draw;
use crate::scene::object::{Class, Epoch};
use crate::scene::solid::Ray;
use crate::scene::street::{CAMERA_HEIGHT_M, Panorama};
use crate::scene::surface::Scene;

/// How often a place is looked for: on a carriageway in the middle of the crop, on one anywhere, on
/// any open ground.
const ATTEMPTS: usize = 150;
/// Room that the camera needs on all sides, metres.
const ROOM_M: f64 = 1.1;
/// Room that it needs over the ground, metres.
const HEADROOM_M: f64 = CAMERA_HEIGHT_M + 0.8;

/// What is seen from a street of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Street {
    /// The panorama with its sky.
    pub panorama: Panorama,
    /// Where the camera stands in the crop: down and right of its middle, -1 to 1.
    pub position: [f64; 2],
    /// Whether it stands on a carriageway.
    pub on_street: bool,
}

impl Street {
    /// The panorama at a position of a crop (down and right of its middle, -1 to 1), [`CAMERA_HEIGHT_M`] over the
    /// ground, `width` columns.
    #[must_use]
    pub fn at(scene: &Scene, crop: &Crop, position: [f64; 2], width: usize) -> Self {
        let [x, y] = crop.local(&scene.frame, position);
        Self {
            panorama: scene.panorama([x, y], CAMERA_HEIGHT_M, width),
            position,
            on_street: on_carriageway(scene, [x, y]),
        }
    }

    /// The panorama at a drawn position: on a carriageway if one passes through the crop, else on any
    /// open ground. `None` where there is neither, as on open water.
    #[must_use]
    pub fn drawn(scene: &Scene, crop: &Crop, draw: &mut Draw, width: usize) -> Option<Self> {
        let position = draw_position(scene, crop, draw)?;
        Some(Self::at(scene, crop, position, width))
    }
}

/// A position of a crop where a camera can stand, as [`Street::drawn`] takes it.
#[must_use]
pub fn draw_position(scene: &Scene, crop: &Crop, draw: &mut Draw) -> Option<[f64; 2]> {
    for (reach, street) in [(0.5, true), (0.95, true), (0.6, false), (0.95, false)] {
        for _ in 0..ATTEMPTS {
            let position = [draw.range(-reach, reach), draw.range(-reach, reach)];
            let at = crop.local(&scene.frame, position);
            if (!street || on_carriageway(scene, at)) && is_free(scene, at) {
                return Some(position);
            }
        }
    }
    None
}

fn on_carriageway(scene: &Scene, [x, y]: [f64; 2]) -> bool {
    scene.is_street(x, y) && scene.streets.locate(x, y).kerb < -ROOM_M
}

/// Whether a camera has room: no solid beside or over it, and land below.
fn is_free(scene: &Scene, [x, y]: [f64; 2]) -> bool {
    let r = ROOM_M;
    [(0.0, 0.0), (r, 0.0), (-r, 0.0), (0.0, r), (0.0, -r)].iter().all(|(dx, dy)| {
        let (x, y) = (x + dx, y + dy);
        let ground = scene.terrain.at(x, y);
        // From below the foundations up to the headroom.
        let up = Ray { from: [x, y, ground.z - 30.0], step: [0.0, 0.0, 1.0] };
        let world = scene.world(Epoch::Image);
        !ground.water
            && world.hit(&up, 0.0, 30.0 + HEADROOM_M).is_none()
            && world.top(x, y, |class| class == Class::Building).is_none()
    })
}
