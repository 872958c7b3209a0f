//! Seven-parameter datum steps between geographic coordinates, as PROJ computes them.
//!
//! PROJ's pipeline for a horizontal CRS is `push v_3, cart, helmert, inverse cart, pop v_3`: the
//! position is taken at ellipsoidal height 0, shifted, and the height that comes out is dropped.
//! Rotations are small angles (`exact` off), and the inverse uses the transpose of the rotation
//! matrix, so forward and inverse differ by the square of the rotations: about 1e-7 m.

use super::CrsError;
use super::ellipsoid::{Ellipsoid, on_globe, wrap_degrees};
use crate::grid::LonLat;

/// How the rotations count (EPSG:9607 and EPSG:9606).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Convention {
    /// The axes rotate (EPSG:9607).
    CoordinateFrame,
    /// The position vector rotates (EPSG:9606).
    PositionVector,
}

/// A Helmert transformation between geocentric coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Helmert {
    /// Translation, metres.
    pub translation_m: [f64; 3],
    /// Rotations about x, y and z, seconds of arc.
    pub rotation_arcsec: [f64; 3],
    /// Scale difference, parts per million.
    pub scale_ppm: f64,
    /// Sense of the rotations.
    pub convention: Convention,
}

/// A datum step in geographic coordinates: Helmert between two ellipsoids at height 0.
#[derive(Clone, Debug, PartialEq)]
pub struct DatumStep {
    source: Ellipsoid,
    target: Ellipsoid,
    helmert: Helmert,
    matrix: [[f64; 3]; 3],
}

impl DatumStep {
    /// The step whose forward direction leads from a datum on `source` to one on `target`.
    #[must_use]
    pub fn new(source: Ellipsoid, target: Ellipsoid, helmert: Helmert) -> Self {
        let [x, y, z] = helmert.rotation_arcsec.map(|r| (r / 3600.0).to_radians());
        let frame = [[1.0, z, -y], [-z, 1.0, x], [y, -x, 1.0]];
        let matrix = match helmert.convention {
            Convention::CoordinateFrame => frame,
            Convention::PositionVector => transpose(frame),
        };
        Self { source, target, helmert, matrix }
    }

    /// From the source datum to the target datum.
    ///
    /// # Errors
    /// [`CrsError::Domain`] beyond 90 degrees of latitude, and for NaN or infinity.
    pub fn forward(&self, at: LonLat) -> Result<LonLat, CrsError> {
        let scale = 1.0 + self.helmert.scale_ppm * 1e-6;
        let turned = multiply(&self.matrix, geocentric(&self.source, at)?);
        let t = self.helmert.translation_m;
        let moved = [0, 1, 2].map(|i| t[i] + scale * turned[i]);
        Ok(geographic(&self.target, moved))
    }

    /// From the target datum to the source datum.
    ///
    /// # Errors
    /// [`CrsError::Domain`] beyond 90 degrees of latitude, and for NaN or infinity.
    pub fn inverse(&self, at: LonLat) -> Result<LonLat, CrsError> {
        let scale = 1.0 + self.helmert.scale_ppm * 1e-6;
        let position = geocentric(&self.target, at)?;
        let t = self.helmert.translation_m;
        let moved = [0, 1, 2].map(|i| (position[i] - t[i]) / scale);
        Ok(geographic(&self.source, multiply(&transpose(self.matrix), moved)))
    }
}

fn transpose(m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| m[j][i]))
}

fn multiply(m: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| m[i][0] * v[0] + m[i][1] * v[1] + m[i][2] * v[2])
}

/// Geocentric coordinates of a position at ellipsoidal height 0, metres.
fn geocentric(ellipsoid: &Ellipsoid, at: LonLat) -> Result<[f64; 3], CrsError> {
    let LonLat { lon_deg, lat_deg } = at;
    if !on_globe(at) {
        return Err(CrsError::Domain {
            projection: "the datum step".to_owned(),
            what: format!("longitude {lon_deg}, latitude {lat_deg}"),
        });
    }
    let (phi, lambda) = (lat_deg.to_radians(), lon_deg.to_radians());
    let (s, c) = (libm::sin(phi), libm::cos(phi));
    let normal = ellipsoid.a / (1.0 - ellipsoid.e2() * s * s).sqrt();
    Ok([
        normal * c * libm::cos(lambda),
        normal * c * libm::sin(lambda),
        normal * (1.0 - ellipsoid.e2()) * s,
    ])
}

/// Geographic coordinates of a geocentric position near the ellipsoid; its height is dropped.
///
/// Bowring's formula (1976), one step: its error at the heights that datum shifts make (below
/// 200 m) is under 1e-12 degrees.
fn geographic(ellipsoid: &Ellipsoid, [x, y, z]: [f64; 3]) -> LonLat {
    let (a, b, e2) = (ellipsoid.a, ellipsoid.b(), ellipsoid.e2());
    let p = libm::hypot(x, y);
    // Sine and cosine of the reduced latitude of the starting value.
    let norm = libm::hypot(z * a, p * b);
    let (s, c) = (z * a / norm, p * b / norm);
    let second_e2 = e2 / (1.0 - e2);
    let lat = libm::atan2(z + second_e2 * b * s * s * s, p - e2 * a * c * c * c);
    LonLat { lon_deg: wrap_degrees(libm::atan2(y, x).to_degrees()), lat_deg: lat.to_degrees() }
}
