//! Lengths on the ground beside lengths on the map.

use super::ellipsoid::{Ellipsoid, wrap_degrees};
use super::{CrsError, ResolvedCrs};
use crate::grid::{LonLat, Projected};
use serde::{Deserialize, Serialize};

/// Metres on the map per metre on the ground, along the two axes of the ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScaleFactor {
    /// For a short way east.
    pub east: f64,
    /// For a short way north.
    pub north: f64,
}

/// Scale of a projected CRS at a position, by central differences over some 20 m (relative error
/// below 1e-9). Conformal projections, which all closed forms are, have one scale in all directions.
///
/// # Errors
/// [`CrsError::Domain`] where the projection is undefined, and within 20 m of a pole.
pub fn scale_factor(resolved: &ResolvedCrs, at: LonLat) -> Result<ScaleFactor, CrsError> {
    const STEP_M: f64 = 10.0;
    let wgs84 = Ellipsoid::WGS84;
    let north_deg = (STEP_M / wgs84.meridian_radius(at.lat_deg)).to_degrees();
    let east_deg = (STEP_M / wgs84.parallel_radius(at.lat_deg)).to_degrees();
    let limit = 90.0 - 2.0 * north_deg;
    if !(-limit..limit).contains(&at.lat_deg) {
        return Err(CrsError::Domain {
            projection: resolved.spec.name.clone(),
            what: format!("latitude {} (its scale is asked for)", at.lat_deg),
        });
    }
    let project = |east: f64, north: f64| {
        let at = LonLat { lon_deg: at.lon_deg + east, lat_deg: at.lat_deg + north };
        resolved.projection.forward(at)
    };
    let length = |a: Projected, b: Projected| {
        libm::hypot(a.x - b.x, a.y - b.y) * resolved.metres_per_unit / (2.0 * STEP_M)
    };
    Ok(ScaleFactor {
        east: length(project(east_deg, 0.0)?, project(-east_deg, 0.0)?),
        north: length(project(0.0, north_deg)?, project(0.0, -north_deg)?),
    })
}

/// Metres between two positions that are near each other (up to some kilometres), on the WGS 84
/// ellipsoid.
pub(crate) fn ground_distance_m(a: LonLat, b: LonLat) -> f64 {
    let lat = 0.5 * (a.lat_deg + b.lat_deg);
    let east =
        wrap_degrees(a.lon_deg - b.lon_deg).to_radians() * Ellipsoid::WGS84.parallel_radius(lat);
    let north = (a.lat_deg - b.lat_deg).to_radians() * Ellipsoid::WGS84.meridian_radius(lat);
    libm::hypot(east, north)
}
