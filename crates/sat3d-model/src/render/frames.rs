//! The conventions of space, in one place (MODEL_SPEC sections 1 and 8).
//!
//! **Map frame**: the frame of the field. x east, **y south**, z up; the scene is the cube
//! `[-1, 1]^3`. It is left-handed. The satellite crop covers x and y in `[-s, s]`, where s is the
//! position scale factor (0.8 as released); row 0 of the crop is y = -s (north), column 0 is x = -s (west).
//!
//! **Camera-world frame**: x east, **y north**, z up: the map frame with y negated, right-handed.
//! Cameras are stated in it, and normals are given in it.
//!
//! **Camera frame**: x right, y down, z forward.
//!
//! **Crop position**: where a camera stands relative to the crop, `(row, column, z)` with row and column in
//! `[-1, 1]` (row downwards, so southwards). In the camera-world frame that is `(column, -row, z)` times
//! s; z is scaled too, so that the released street camera at z = -0.85 stands at -0.68.
//!
//! **Angles**, degrees: with all at zero a camera looks north, level. Positive yaw turns right (east),
//! positive pitch looks down. `camera to world = Rz(-yaw) Rx(-pitch) Ry(-roll) Rx(-90 degrees)`.

/// Three coordinates.
pub type Vector = [f64; 3];

/// A rotation matrix, rows first.
pub type Matrix = [[f64; 3]; 3];

/// From the camera-world frame to the map frame, or back: y changes its sign.
#[must_use]
pub fn flip_y([x, y, z]: Vector) -> Vector {
    [x, -y, z]
}

/// A crop position `(row, column, z)` in the camera-world frame.
#[must_use]
pub fn from_crop([row, column, z]: Vector, scale: f64) -> Vector {
    [column * scale, -row * scale, z * scale]
}

/// How a camera is turned, degrees.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Angles {
    /// About the viewing direction.
    pub roll: f64,
    /// Positive looks down.
    pub pitch: f64,
    /// Positive turns right: 0 north, 90 east.
    pub yaw: f64,
}

impl Angles {
    /// The rotation from the camera frame to the camera-world frame.
    #[must_use]
    pub fn rotation(self) -> Matrix {
        let level = product(about_y(-self.roll), about_x(-90.0));
        product(about_z(-self.yaw), product(about_x(-self.pitch), level))
    }
}

/// The rotation of a camera at `eye` that looks at `target` with its horizon level; both in the
/// camera-world frame. A camera that looks straight up or down has north at the top of its picture or
/// at the bottom, as a camera that pitches there from the north has.
///
/// `None` where the two are the same point or not finite.
#[must_use]
pub fn look_at(eye: Vector, target: Vector) -> Option<Matrix> {
    let forward = normalised([0, 1, 2].map(|axis| target[axis] - eye[axis]))?;
    // Forward x up; the vertical has none, and takes east.
    let right = normalised([forward[1], -forward[0], 0.0]).unwrap_or([1.0, 0.0, 0.0]);
    let down = [
        forward[1] * right[2] - forward[2] * right[1],
        forward[2] * right[0] - forward[0] * right[2],
        forward[0] * right[1] - forward[1] * right[0],
    ];
    Some([0, 1, 2].map(|axis| [right[axis], down[axis], forward[axis]]))
}

/// `matrix` applied to `vector`.
#[must_use]
pub fn rotate(matrix: &Matrix, vector: Vector) -> Vector {
    [0, 1, 2].map(|row| (0..3).map(|k| matrix[row][k] * vector[k]).sum())
}

/// The unit vector of a direction; `None` where there is none.
#[must_use]
pub fn normalised(vector: Vector) -> Option<Vector> {
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    (length > 0.0 && length.is_finite()).then(|| vector.map(|v| v / length))
}

fn product(a: Matrix, b: Matrix) -> Matrix {
    [0, 1, 2].map(|row| [0, 1, 2].map(|column| (0..3).map(|k| a[row][k] * b[k][column]).sum()))
}

/// Sine and cosine of an angle in degrees, exact at whole quarter turns.
fn sin_cos(degrees: f64) -> (f64, f64) {
    let turned = degrees % 360.0;
    match turned.abs() {
        0.0 => (0.0, 1.0),
        90.0 => (turned.signum(), 0.0),
        180.0 => (0.0, -1.0),
        270.0 => (-turned.signum(), 0.0),
        _ => {
            let radians = turned.to_radians();
            (libm::sin(radians), libm::cos(radians))
        }
    }
}

fn about_x(degrees: f64) -> Matrix {
    let (s, c) = sin_cos(degrees);
    [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
}

fn about_y(degrees: f64) -> Matrix {
    let (s, c) = sin_cos(degrees);
    [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
}

fn about_z(degrees: f64) -> Matrix {
    let (s, c) = sin_cos(degrees);
    [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
}

/// The part of a ray that lies inside the cube `[-1, 1]^3`: distances of entry (0 from inside) and exit.
/// `None` for a ray that misses the cube or only touches it. The same in both world frames.
#[must_use]
pub fn inside_cube(origin: Vector, direction: Vector) -> Option<(f64, f64)> {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let (o, d) = (origin[axis], direction[axis]);
        if d == 0.0 {
            // Parallel to the slab: inside it all along (its faces included), or never.
            if !(-1.0..=1.0).contains(&o) {
                return None;
            }
            continue;
        }
        let (a, b) = ((-1.0 - o) / d, (1.0 - o) / d);
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    (near < far && far.is_finite()).then_some((near, far))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;

    fn close(a: Vector, b: Vector) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    }

    #[test]
    fn zero_looks_north_yaw_turns_east_pitch_looks_down() {
        let forward =
            |roll, pitch, yaw| rotate(&Angles { roll, pitch, yaw }.rotation(), [0.0, 0.0, 1.0]);
        assert!(close(forward(0.0, 0.0, 0.0), [0.0, 1.0, 0.0]));
        assert!(close(forward(0.0, 0.0, 90.0), [1.0, 0.0, 0.0]));
        assert!(close(forward(0.0, 0.0, 180.0), [0.0, -1.0, 0.0]));
        assert!(close(forward(30.0, 90.0, 0.0), [0.0, 0.0, -1.0]));
        let matrix = Angles::default().rotation();
        assert!(close(rotate(&matrix, [1.0, 0.0, 0.0]), [1.0, 0.0, 0.0]), "right is east");
        assert!(close(rotate(&matrix, [0.0, 1.0, 0.0]), [0.0, 0.0, -1.0]), "down is down");
    }

    #[test]
    fn look_at_agrees_with_angles() {
        for (pitch, yaw) in [(0.0, 0.0), (10.0, 35.0), (-20.0, -120.0), (89.0, 170.0), (90.0, 0.0)]
        {
            let want = Angles { roll: 0.0, pitch, yaw }.rotation();
            let forward = rotate(&want, [0.0, 0.0, 2.0]);
            let eye = [0.1, -0.2, 0.3];
            let got = look_at(eye, [0, 1, 2].map(|k| eye[k] + forward[k])).unwrap();
            for row in 0..3 {
                assert!(close(got[row], want[row]), "{pitch} {yaw}: {got:?} {want:?}");
            }
        }
        assert_eq!(look_at([0.5; 3], [0.5; 3]), None);
        assert_eq!(look_at([0.5; 3], [f64::NAN; 3]), None);
    }

    #[test]
    fn rays_and_the_cube() {
        assert_eq!(inside_cube([0.0; 3], [1.0, 0.0, 0.0]), Some((0.0, 1.0)));
        assert_eq!(inside_cube([-3.0, 0.0, 0.0], [1.0, 0.0, 0.0]), Some((2.0, 4.0)));
        assert_eq!(inside_cube([3.0, 0.0, 0.0], [1.0, 0.0, 0.0]), None);
        assert_eq!(inside_cube([0.0, 1.5, 0.0], [1.0, 0.0, 0.0]), None);
        // Along a face and along an edge: inside; leaving from a face: nothing.
        assert_eq!(inside_cube([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]), Some((0.0, 1.0)));
        assert_eq!(inside_cube([0.0, 1.0, -1.0], [-1.0, 0.0, -0.0]), Some((0.0, 1.0)));
        assert_eq!(inside_cube([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]), None);
        assert_eq!(inside_cube([0.0, 0.0, 1.0], [0.0, 0.0, -1.0]), Some((0.0, 2.0)));
        assert_eq!(inside_cube([f64::NAN; 3], [1.0, 0.0, 0.0]), None);
        assert_eq!(inside_cube([0.0; 3], [0.0; 3]), None);
    }
}
