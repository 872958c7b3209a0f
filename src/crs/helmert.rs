//! Seven-parameter datum steps between geographic coordinates, as PROJ computes them.
//!
//! PROJ's pipeline for a horizontal CRS is `push v_3, cart, helmert, inverse cart, pop v_3`: the
//! position is taken at ellipsoidal height 0, shifted, and the height that comes out is dropped.
//! Rotations are small angles (`exact` off), and the inverse uses the transpose of the rotation
//! matrix, so forward and inverse undo each other to some micrometres only.

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
    Ok(ellipsoid.geocentric(at, 0.0))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::scale::ground_distance_m;
    use proptest::prelude::*;

    fn step(rotation_arcsec: [f64; 3], convention: Convention) -> DatumStep {
        let translation_m = [-0.991, 1.9072, 0.5129];
        let helmert = Helmert { translation_m, rotation_arcsec, scale_ppm: 0.01, convention };
        DatumStep::new(Ellipsoid::GRS80, Ellipsoid::WGS84, helmert)
    }

    #[test]
    fn conventions_differ_by_the_sign_of_the_rotations() {
        let r = [-0.025_789_9, -0.009_650_1, -0.011_659_9];
        let at = LonLat { lon_deg: -122.3, lat_deg: 47.6 };
        let frame = step(r, Convention::CoordinateFrame).forward(at).expect("on the globe");
        let vector = step(r.map(|x| -x), Convention::PositionVector).forward(at);
        assert_eq!(Ok(frame), vector);
    }

    #[test]
    fn a_turn_about_the_axis_turns_longitudes() {
        let helmert = Helmert {
            translation_m: [0.0; 3],
            rotation_arcsec: [0.0, 0.0, 1.0],
            scale_ppm: 0.0,
            convention: Convention::PositionVector,
        };
        let turn = DatumStep::new(Ellipsoid::WGS84, Ellipsoid::WGS84, helmert);
        let at = LonLat { lon_deg: 10.0, lat_deg: 50.0 };
        let moved = turn.forward(at).expect("on the globe");
        assert!((moved.lon_deg - at.lon_deg - 1.0 / 3600.0).abs() < 1e-12, "{moved:?}");
        // Small angles stretch by half their square: 1.2e-11 of 50 degrees.
        assert!((moved.lat_deg - at.lat_deg).abs() < 1e-9, "{moved:?}");
    }

    #[test]
    fn poles_and_the_antimeridian_are_ordinary() {
        let step = step([0.1, 0.2, 0.3], Convention::CoordinateFrame);
        for (lon_deg, lat_deg) in [(0.0, 90.0), (77.0, -90.0), (180.0, 0.0), (-180.0, 45.0)] {
            let at = LonLat { lon_deg, lat_deg };
            let moved = step.forward(at).expect("on the globe");
            let back = step.inverse(moved).expect("on the globe");
            assert!((back.lat_deg - lat_deg).abs() < 1e-9, "{at:?} {moved:?} {back:?}");
            assert!(moved.lon_deg.abs() <= 180.0);
        }
        assert!(step.forward(LonLat { lon_deg: 0.0, lat_deg: 90.1 }).is_err());
        assert!(step.inverse(LonLat { lon_deg: f64::NAN, lat_deg: 0.0 }).is_err());
    }

    proptest! {
        #[test]
        fn there_and_back_is_within_micrometres(
            lon_deg in -180.0..180.0_f64, lat_deg in -89.9..89.9_f64,
        ) {
            let at = LonLat { lon_deg, lat_deg };
            let step = step([-0.0258, -0.009_65, -0.011_66], Convention::CoordinateFrame);
            let back = step.inverse(step.forward(at).expect("valid")).expect("valid");
            prop_assert!(ground_distance_m(at, back) < 2e-6, "{back:?}");
        }

        #[test]
        fn geocentric_and_geographic_are_inverse_at_the_ellipsoid(
            lon_deg in -180.0..180.0_f64, lat_deg in -90.0..90.0_f64,
        ) {
            let at = LonLat { lon_deg, lat_deg };
            let e = Ellipsoid::WGS84;
            let back = geographic(&e, geocentric(&e, at).expect("valid"));
            prop_assert!(ground_distance_m(at, back) < 5e-9, "{back:?}");
        }
    }
}
