//! The local frame: metres of EPSG:2927 from an origin, and the ways to WGS 84 and to feet.
//!
//! The origin is a corner of the lidar lattice near the scene's centre. Local x is easting, y
//! northing, both counted in metres of the projection from there, so a lidar cell's centre is an
//! exact point of the frame and an image pixel comes in through the projection.

use super::error::SceneError;
use crate::crs::{CrsSpec, Projection, ResolveOptions, ResolvedCrs, resolve};
use crate::grid::{LonLat, Projected, WGS84_A};
use crate::units::US_SURVEY_FOOT_M;
use std::sync::Arc;

/// The CRS of Washington's lidar deliveries: NAD83(HARN) / Washington South (ftUS).
pub const LIDAR_CRS: u32 = 2927;
/// Square of the eccentricity of the WGS 84 ellipsoid.
const WGS84_E2: f64 = 0.006_694_379_990_141_316;

/// The local frame of a scene.
#[derive(Clone, Debug)]
pub struct Frame {
    origin_feet: [f64; 2],
    projection: Arc<dyn Projection>,
    datum_shift_m: f64,
    north: [f64; 2],
    scale: f64,
}

impl Frame {
    /// The frame around a place, its origin on the lattice of `pixel_feet` (US survey feet).
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection cannot serve the place.
    pub fn new(place: LonLat, pixel_feet: f64, with_datum: bool) -> Result<Self, SceneError> {
        let spec = CrsSpec::from_user_input(&format!("EPSG:{LIDAR_CRS}"))?;
        let area = [place.lon_deg, place.lat_deg, place.lon_deg, place.lat_deg];
        let options = ResolveOptions {
            without_datum_step: !with_datum,
            area: Some(area),
            ..ResolveOptions::default()
        };
        let ResolvedCrs { projection, operation, .. } = resolve(&spec, &options)?;
        let at = projection.forward(place)?;
        let snap = |v: f64| (v / pixel_feet).round() * pixel_feet;
        // A hundred metres of meridian in the grid: its direction is true north, its length the scale.
        let step = 1e-3_f64;
        let up = LonLat { lat_deg: place.lat_deg + step, ..place };
        let down = LonLat { lat_deg: place.lat_deg - step, ..place };
        let (n, s) = (projection.forward(up)?, projection.forward(down)?);
        let (dx, dy) = ((n.x - s.x) * US_SURVEY_FOOT_M, (n.y - s.y) * US_SURVEY_FOOT_M);
        let length = libm::hypot(dx, dy);
        let sin = libm::sin(place.lat_deg.to_radians());
        let w = 1.0 - WGS84_E2 * sin * sin;
        let meridian_radius = WGS84_A * (1.0 - WGS84_E2) / (w * w.sqrt());
        Ok(Self {
            origin_feet: [snap(at.x), snap(at.y)],
            projection,
            datum_shift_m: operation.datum_shift_m,
            north: [dx / length, dy / length],
            scale: length / (meridian_radius * (2.0 * step).to_radians()),
        })
    }

    /// Easting and northing of the origin, US survey feet.
    #[must_use]
    pub const fn origin_feet(&self) -> [f64; 2] {
        self.origin_feet
    }

    /// How far the datum step moves positions, metres; 0 when it is left out.
    #[must_use]
    pub const fn datum_shift_m(&self) -> f64 {
        self.datum_shift_m
    }

    /// Direction of true north at the centre, unit vector in the local frame.
    #[must_use]
    pub const fn true_north(&self) -> [f64; 2] {
        self.north
    }

    /// Angle from grid north to true north at the centre, radians, clockwise positive.
    #[must_use]
    pub fn convergence(&self) -> f64 {
        libm::atan2(self.north[0], self.north[1])
    }

    /// Metres of the projection per metre on the ellipsoid at the centre.
    #[must_use]
    pub const fn scale(&self) -> f64 {
        self.scale
    }

    /// Local position of a WGS 84 position.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection is undefined.
    pub fn to_local(&self, at: LonLat) -> Result<[f64; 2], SceneError> {
        Ok(self.from_feet(self.projection.forward(at)?))
    }

    /// Local position of an easting and northing in US survey feet.
    #[must_use]
    pub fn from_feet(&self, at: Projected) -> [f64; 2] {
        [
            (at.x - self.origin_feet[0]) * US_SURVEY_FOOT_M,
            (at.y - self.origin_feet[1]) * US_SURVEY_FOOT_M,
        ]
    }

    /// Local position of a place so many ground metres east and north of the origin, near which the
    /// projection is taken as affine.
    #[must_use]
    pub fn from_ground(&self, [east, north]: [f64; 2]) -> [f64; 2] {
        let [nx, ny] = self.north;
        [self.scale * (east * ny + north * nx), self.scale * (north * ny - east * nx)]
    }

    /// WGS 84 position of a local position.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection is undefined.
    pub fn to_lonlat(&self, x: f64, y: f64) -> Result<LonLat, SceneError> {
        let feet = Projected {
            x: self.origin_feet[0] + x / US_SURVEY_FOOT_M,
            y: self.origin_feet[1] + y / US_SURVEY_FOOT_M,
        };
        Ok(self.projection.inverse(feet)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seattle() -> Frame {
        let place = LonLat { lon_deg: -122.3129, lat_deg: 47.5903 };
        Frame::new(place, 1.5, true).expect("a frame")
    }

    #[test]
    fn the_origin_is_the_published_check_point_on_the_lattice() {
        let frame = seattle();
        // PROJ: -122.3129, 47.5903 -> EPSG:2927 (1193067.570541287, 828235.9760536137) ftUS.
        let [x, y] = frame.origin_feet();
        assert_eq!((x, y), (1_193_067.0, 828_235.5));
        let at = frame.to_local(LonLat { lon_deg: -122.3129, lat_deg: 47.5903 }).expect("projects");
        assert!((at[0] - 0.570_541_287 * US_SURVEY_FOOT_M).abs() < 1e-6);
        assert!((at[1] - 0.476_053_613_7 * US_SURVEY_FOOT_M).abs() < 1e-6);
        assert!((frame.datum_shift_m() - 1.28).abs() < 0.02);
    }

    #[test]
    fn true_north_leans_and_lengths_are_nearly_those_of_the_ground() {
        let frame = seattle();
        // Washington South: n = 0.7263, central meridian 120.5 W. West of it true north lies to
        // the east of grid north.
        let expected = 0.726_3 * (122.3129_f64 - 120.5).to_radians();
        assert!((frame.convergence() - expected).abs() < 2e-4, "{}", frame.convergence());
        assert!((frame.scale() - 1.0).abs() < 2e-4 && frame.scale() > 1.0, "{}", frame.scale());
    }

    #[test]
    fn there_and_back() {
        let frame = seattle();
        let at = frame.to_lonlat(120.0, -75.0).expect("inverse");
        let back = frame.to_local(at).expect("forward");
        assert!((back[0] - 120.0).abs() < 1e-7 && (back[1] + 75.0).abs() < 1e-7);
    }
}
