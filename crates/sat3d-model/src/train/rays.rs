//! Rays of the training views (MODEL_SPEC sections 8 and 11), and everything random about them.

use crate::random::{Draw, key};
use crate::render::frames::Vector;
use crate::render::{Angles, Camera, Intrinsics, Pose};
use serde::{Deserialize, Serialize};

/// How large the training views are and where cameras look.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ViewSettings {
    /// Rays along each side of the whole crop (256).
    pub ortho_grid: usize,
    /// Rays along each side of the window of it that a step renders (128).
    pub ortho_window: usize,
    /// Columns of rays of a panorama (256).
    pub panorama_width: usize,
    /// Rows of rays of a panorama (64).
    pub panorama_height: usize,
    /// Rays along each side of a perspective view (128).
    pub perspective: usize,
    /// Fields of view of a perspective view, degrees; one is drawn for each axis.
    pub fields_of_view: Vec<f64>,
    /// Pitch is drawn between minus this and this, degrees.
    pub pitch: f64,
    /// Yaw is drawn between these, degrees.
    pub yaw: [f64; 2],
    /// Coarse samples along a ray (48).
    pub coarse_samples: usize,
    /// Importance samples along a ray (48); 0 for none.
    pub fine_samples: usize,
    /// Whether samples are shaken within their cells. Otherwise they lie in the middle, as when the
    /// program renders.
    pub jitter: bool,
    /// Panoramas are shrunk with a wide kernel before a perspective view of much coarser pixels is cut
    /// from them. The release does not, and has no need to at its sizes.
    pub antialias: bool,
}

impl ViewSettings {
    /// As the release trains.
    #[must_use]
    pub fn release() -> Self {
        Self {
            ortho_grid: 256,
            ortho_window: 128,
            panorama_width: 256,
            panorama_height: 64,
            perspective: 128,
            fields_of_view: vec![90.0, 105.0, 120.0],
            pitch: 20.0,
            yaw: [-179.0, 179.0],
            coarse_samples: 48,
            fine_samples: 48,
            jitter: true,
            antialias: false,
        }
    }

    /// As the paper says: other ranges of the perspective views.
    #[must_use]
    pub fn paper() -> Self {
        Self { pitch: 30.0, yaw: [-79.0, 179.0], ..Self::release() }
    }

    /// Sizes that one processor trains a small network with.
    #[must_use]
    pub fn small() -> Self {
        Self {
            ortho_grid: 64,
            ortho_window: 32,
            panorama_width: 64,
            panorama_height: 16,
            perspective: 32,
            coarse_samples: 24,
            fine_samples: 0,
            antialias: true,
            ..Self::release()
        }
    }

    /// What is wrong with these settings: the key, its value, what is asked for.
    pub(crate) fn fault(&self) -> Option<(&'static str, String, &'static str)> {
        let sides = [
            ("views.ortho_window", self.ortho_window),
            ("views.panorama_width", self.panorama_width),
            ("views.panorama_height", self.panorama_height),
            ("views.perspective", self.perspective),
        ];
        if let Some((key, side)) = sides.into_iter().find(|(_, side)| !(2..=4096).contains(side)) {
            return Some((key, side.to_string(), "2 to 4096"));
        }
        if !(self.ortho_window..=4096).contains(&self.ortho_grid) {
            let why = "at least `views.ortho_window`, at most 4096";
            return Some(("views.ortho_grid", self.ortho_grid.to_string(), why));
        }
        if !(4..=512).contains(&self.coarse_samples) {
            return Some(("views.coarse_samples", self.coarse_samples.to_string(), "4 to 512"));
        }
        if self.fine_samples > 512 {
            return Some(("views.fine_samples", self.fine_samples.to_string(), "0 to 512"));
        }
        let seen = |degrees: &f64| *degrees > 0.0 && *degrees < 180.0;
        if self.fields_of_view.is_empty() || !self.fields_of_view.iter().all(seen) {
            let value = format!("{:?}", self.fields_of_view);
            return Some(("views.fields_of_view", value, "one or more, between 0 and 180 degrees"));
        }
        if !(0.0..=90.0).contains(&self.pitch) {
            return Some(("views.pitch", self.pitch.to_string(), "0 to 90 degrees"));
        }
        let [low, high] = self.yaw;
        if !(low <= high && low >= -360.0 && high <= 360.0) {
            return Some(("views.yaw", format!("{:?}", self.yaw), "ascending, within one turn"));
        }
        None
    }
}

impl Default for ViewSettings {
    fn default() -> Self {
        Self::release()
    }
}

/// What a number is drawn for; the first of its key's parts after the seed.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    /// The window of the satellite view.
    Window = 1,
    /// Shaking of samples.
    Jitter,
    /// A perspective camera.
    Camera,
    /// The encoder's positions.
    Positions,
    /// The real satellite crops that discriminators see.
    RealWindow,
}

/// The sequence of one purpose in one step.
pub(crate) fn draw(seed: u64, step: u64, purpose: Purpose, parts: &[u64]) -> Draw {
    Draw::new(&[seed, purpose as u64, step, key(parts)])
}

/// Rays of one view of one image, map frame.
#[derive(Clone, Debug)]
pub(crate) struct Rays {
    /// Rows of the view.
    pub height: usize,
    /// Columns of the view.
    pub width: usize,
    /// Where each ray starts.
    pub origins: Vec<[f32; 3]>,
    /// Unit directions.
    pub directions: Vec<Vector>,
    /// How far each goes within the cube; 0 where it misses it.
    pub lengths: Vec<f64>,
    /// Whether all of them go straight down from z = 1.
    pub vertical: bool,
}

impl Rays {
    /// All rays of a camera, for a crop that covers `[-scale, scale]`.
    pub(crate) fn of_camera(camera: &Camera, scale: f64) -> Self {
        let (width, height) = camera.size();
        Self::window(camera, scale, [0, 0], [height, width])
    }

    /// Those of a window of its pixels: first row and column, rows and columns.
    pub(crate) fn window(
        camera: &Camera,
        scale: f64,
        [top, left]: [usize; 2],
        [height, width]: [usize; 2],
    ) -> Self {
        let count = width * height;
        let mut rays = Self {
            height,
            width,
            origins: Vec::with_capacity(count),
            directions: Vec::with_capacity(count),
            lengths: Vec::with_capacity(count),
            vertical: matches!(camera, Camera::Ortho { .. }),
        };
        for row in top..top + height {
            for column in left..left + width {
                let ray = camera.ray(row, column, scale);
                let (near, far) = ray.inside.unwrap_or((0.0, 0.0));
                let start = [0, 1, 2].map(|k| (ray.origin[k] + near * ray.direction[k]) as f32);
                rays.origins.push(start);
                rays.directions.push(ray.direction);
                rays.lengths.push(far - near);
            }
        }
        rays
    }

    /// Number of rays.
    pub(crate) fn count(&self) -> usize {
        self.lengths.len()
    }
}

/// First row and column of a random window; one for a whole batch, as in the release.
pub(crate) fn random_window(views: &ViewSettings, mut draw: Draw) -> [usize; 2] {
    let places = views.ortho_grid - views.ortho_window;
    // The release draws from 0..128 of 0..=128 places.
    [0, 1].map(|_| draw.index(places))
}

/// A perspective view of a panorama.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    /// Horizontal and vertical field of view, degrees.
    pub field_of_view: [f64; 2],
    /// Positive looks down, degrees.
    pub pitch: f64,
    /// Positive turns right from north, degrees.
    pub yaw: f64,
}

impl Look {
    /// One drawn within the settings.
    pub(crate) fn random(views: &ViewSettings, mut draw: Draw) -> Self {
        let field_of_view =
            [0, 1].map(|_| views.fields_of_view[draw.index(views.fields_of_view.len())]);
        let pitch = draw.range(-views.pitch, views.pitch);
        let yaw = draw.range(views.yaw[0], views.yaw[1]);
        Self { field_of_view, pitch, yaw }
    }

    /// Intrinsics of an image of `side` pixels: its axis lies at the middle of its pixel positions.
    pub(crate) fn intrinsics(&self, side: usize) -> Intrinsics {
        let [fx, fy] = self
            .field_of_view
            .map(|degrees| 0.5 * side as f64 / libm::tan(degrees.to_radians() / 2.0));
        let centre = (side as f64 - 1.0) / 2.0;
        Intrinsics { fx, fy, cx: centre, cy: centre }
    }

    /// The camera of a ray grid `side / enlarged` rays wide, whose rays are those of an image of `side`
    /// pixels with its intrinsics divided by `enlarged`, as in the release.
    pub(crate) fn camera(
        &self,
        side: usize,
        enlarged: usize,
        position: Vector,
        scale: f64,
    ) -> Camera {
        let part = 1.0 / enlarged as f64;
        let whole = self.intrinsics(side);
        let intrinsics = Intrinsics {
            fx: whole.fx * part,
            fy: whole.fy * part,
            cx: whole.cx * part,
            cy: whole.cy * part,
        };
        let angles = Angles { roll: 0.0, pitch: self.pitch, yaw: self.yaw };
        let pose = Pose::on_crop(position, angles, scale);
        Camera::Perspective { width: side / enlarged, height: side / enlarged, intrinsics, pose }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn released_views_are_those_of_the_cameras() {
        let position = [0.25, -0.3, -0.85];
        let look = Look { field_of_view: [120.0, 120.0], pitch: 10.0, yaw: 35.0 };
        let camera = look.camera(256, 2, position, 0.8);
        let angles = Angles { roll: 0.0, pitch: 10.0, yaw: 35.0 };
        let Camera::Perspective { intrinsics, pose, width, height } = camera else {
            panic!("{camera:?}")
        };
        let wanted = Intrinsics::from_field_of_view(128, 128, 120.0, 120.0);
        assert!((intrinsics.fx - wanted.fx).abs() < 1e-12 && intrinsics.cx == wanted.cx);
        assert_eq!((width, height, pose), (128, 128, Pose::on_crop(position, angles, 0.8)));
        let rays = Rays::window(&Camera::Ortho { size: 8 }, 0.8, [2, 3], [4, 5]);
        assert_eq!((rays.count(), rays.vertical), (20, true));
        // Row 3, column 5 of the whole view.
        let x = (0.8 * (5.5 / 4.0 - 1.0)) as f32;
        let y = (0.8 * (3.5 / 4.0 - 1.0)) as f32;
        assert_eq!(rays.origins[5 + 2], [x, y, 1.0]);
        assert!(rays.lengths.iter().all(|length| *length == 2.0));
    }

    #[test]
    fn a_ray_that_misses_the_cube_has_no_length() {
        let camera = Camera::Panorama { width: 8, height: 4, position: [1.5, 0.0, 0.0] };
        let rays = Rays::of_camera(&camera, 0.8);
        assert!(rays.lengths.contains(&0.0) && rays.lengths.iter().any(|length| *length > 1.0));
        assert!(rays.origins.iter().flatten().all(|value| value.is_finite()));
    }

    #[test]
    fn draws_stay_in_range_and_are_named_by_their_step() {
        let views = ViewSettings::release();
        let mut yaws = Vec::new();
        for step in 0..200 {
            let look = Look::random(&views, draw(7, step, Purpose::Camera, &[3]));
            assert!(look.pitch.abs() <= 20.0 && look.yaw.abs() <= 179.0);
            assert!(look.field_of_view.iter().all(|fov| [90.0, 105.0, 120.0].contains(fov)));
            let [top, left] = random_window(&views, draw(7, step, Purpose::Window, &[]));
            assert!(top < 128 && left < 128);
            yaws.push(look.yaw);
            assert_eq!(look, Look::random(&views, draw(7, step, Purpose::Camera, &[3])));
        }
        yaws.sort_by(f64::total_cmp);
        yaws.dedup();
        assert_eq!(yaws.len(), 200);
        let whole = ViewSettings { ortho_window: 256, ..views };
        assert_eq!(random_window(&whole, draw(7, 0, Purpose::Window, &[])), [0, 0]);
    }

    #[test]
    fn settings_that_make_no_view_are_named() {
        assert_eq!(ViewSettings::release().fault(), None);
        assert_eq!(ViewSettings::small().fault(), None);
        assert_eq!(ViewSettings::paper().fault(), None);
        let faults = [
            ViewSettings { ortho_window: 300, ..ViewSettings::release() },
            ViewSettings { coarse_samples: 3, ..ViewSettings::release() },
            ViewSettings { fields_of_view: vec![], ..ViewSettings::release() },
            ViewSettings { yaw: [10.0, f64::NAN], ..ViewSettings::release() },
            ViewSettings { perspective: 0, ..ViewSettings::release() },
        ];
        assert!(faults.iter().all(|settings| settings.fault().is_some()));
    }
}
