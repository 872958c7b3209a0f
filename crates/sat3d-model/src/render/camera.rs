//! Cameras: which ray each pixel looks along (MODEL_SPEC section 8).

use super::frames::{Angles, Matrix, Vector, flip_y, inside_cube, look_at, normalised, rotate};

/// One ray, map frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where the camera is.
    pub origin: Vector,
    /// Unit direction.
    pub direction: Vector,
    /// Distances at which the ray enters the cube (0 from inside it) and leaves it; `None` where it
    /// misses the cube.
    pub inside: Option<(f64, f64)>,
}

/// Pixels to directions of a perspective camera: `((u - cx) / fx, (v - cy) / fy, 1)`; the centre of pixel
/// (u, v) is at the integers (u, v), as in the reference.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Intrinsics {
    /// Focal length in x, pixels.
    pub fx: f64,
    /// Focal length in y, pixels.
    pub fy: f64,
    /// Column of the optical axis.
    pub cx: f64,
    /// Row of the optical axis.
    pub cy: f64,
}

impl Intrinsics {
    /// Of a ray grid of `width x height` with the given horizontal and vertical fields of view
    /// (degrees), by the reference's rule: the intrinsics of an image of twice the size, whose axis is at
    /// its middle pixel position `(2 * size - 1) / 2`, halved. For 128 x 128 and 120 degrees:
    /// fx = 36.95, cx = 63.75.
    #[must_use]
    pub fn from_field_of_view(width: usize, height: usize, horizontal: f64, vertical: f64) -> Self {
        let focal =
            |size: usize, degrees: f64| size as f64 / libm::tan(degrees.to_radians() / 2.0) / 2.0;
        let centre = |size: usize| (2.0 * size as f64 - 1.0) / 4.0;
        Self {
            fx: focal(width, horizontal),
            fy: focal(height, vertical),
            cx: centre(width),
            cy: centre(height),
        }
    }
}

/// Where a camera is and how it is turned: camera frame to camera-world frame.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Pose {
    /// Camera-world frame, cube units.
    pub position: Vector,
    /// Rotation.
    pub rotation: Matrix,
}

impl Pose {
    /// At a crop position `(row, column, z)` ([`super::frames`]), turned by angles.
    #[must_use]
    pub fn on_crop(position: Vector, angles: Angles, scale: f64) -> Self {
        Self { position: super::frames::from_crop(position, scale), rotation: angles.rotation() }
    }

    /// At `eye`, looking at `target` with a level horizon; both in the camera-world frame.
    /// `None` where the two are the same point.
    #[must_use]
    pub fn looking_at(eye: Vector, target: Vector) -> Option<Self> {
        Some(Self { position: eye, rotation: look_at(eye, target)? })
    }
}

/// A view of the scene.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Camera {
    /// Straight down on the crop: `size x size` rays from z = 1, row 0 north, column 0 west.
    Ortho {
        /// Rays along each side.
        size: usize,
    },
    /// All directions: the centre looks north, three quarters east, both edges south.
    Panorama {
        /// Columns.
        width: usize,
        /// Rows, the first at the zenith.
        height: usize,
        /// Camera-world frame, cube units.
        position: Vector,
    },
    /// A pinhole camera.
    Perspective {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Pixels to directions.
        intrinsics: Intrinsics,
        /// Where it is.
        pose: Pose,
    },
}

impl Camera {
    /// The released panorama, 256 x 64 rays, from a crop position `(row, column, z)`.
    #[must_use]
    pub fn panorama(position: Vector, scale: f64) -> Self {
        let position = super::frames::from_crop(position, scale);
        Self::Panorama { width: 256, height: 64, position }
    }

    /// The released perspective view, 128 x 128 rays with 120 degrees of view.
    #[must_use]
    pub fn perspective(pose: Pose) -> Self {
        let intrinsics = Intrinsics::from_field_of_view(128, 128, 120.0, 120.0);
        Self::Perspective { width: 128, height: 128, intrinsics, pose }
    }

    /// Columns and rows.
    #[must_use]
    pub fn size(&self) -> (usize, usize) {
        match *self {
            Self::Ortho { size } => (size, size),
            Self::Panorama { width, height, .. } | Self::Perspective { width, height, .. } => {
                (width, height)
            }
        }
    }

    /// The ray of the pixel in this row and column, for a crop that covers `[-scale, scale]`.
    #[must_use]
    pub fn ray(&self, row: usize, column: usize, scale: f64) -> Ray {
        match *self {
            Self::Ortho { size } => {
                let x = f64::from(crop_coordinate(column, size, scale));
                let y = f64::from(crop_coordinate(row, size, scale));
                let inside = Some((0.0, 2.0));
                Ray { origin: [x, y, 1.0], direction: [0.0, 0.0, -1.0], inside }
            }
            Self::Panorama { width, height, position } => {
                let direction = panorama_direction(row, column, width, height);
                to_map(position, &Angles::default().rotation(), direction)
            }
            Self::Perspective { intrinsics, pose, .. } => {
                let Intrinsics { fx, fy, cx, cy } = intrinsics;
                let direction = [(column as f64 - cx) / fx, (row as f64 - cy) / fy, 1.0];
                to_map(pose.position, &pose.rotation, direction)
            }
        }
    }
}

/// x of a column (or y of a row) of the satellite view: `scale * ((index + 0.5) / (size / 2) - 1)`.
pub(crate) fn crop_coordinate(index: usize, size: usize, scale: f64) -> f32 {
    (scale * ((index as f64 + 0.5) / (size as f64 / 2.0) - 1.0)) as f32
}

/// Camera-frame direction of a panorama's pixel.
///
/// The angles are `f32` on purpose: in the first and last row the cosine of `f32(pi/2)` is -4.4e-8,
/// not zero, so that the azimuth at the zenith comes out turned by 180 degrees. The network was
/// trained on sky colours looked up that way.
fn panorama_direction(row: usize, column: usize, width: usize, height: usize) -> Vector {
    let pi = std::f32::consts::PI;
    // A single column or row looks along the middle.
    let part = |index: usize, count: usize| {
        if count > 1 { index as f32 / (count - 1) as f32 } else { 0.5 }
    };
    let phi = -(part(column, width) - 0.5) * 2.0 * pi + pi / 2.0;
    let theta = -(0.5 - part(row, height)) * pi;
    let (sin_phi, cos_phi) = (libm::sinf(phi), libm::cosf(phi));
    let (sin_theta, cos_theta) = (libm::sinf(theta), libm::cosf(theta));
    [f64::from(cos_theta * cos_phi), f64::from(sin_theta), f64::from(cos_theta * sin_phi)]
}

fn to_map(position: Vector, rotation: &Matrix, direction: Vector) -> Ray {
    let direction = normalised(rotate(rotation, direction)).unwrap_or([f64::NAN; 3]);
    let (origin, direction) = (flip_y(position), flip_y(direction));
    Ray { origin, direction, inside: inside_cube(origin, direction) }
}
