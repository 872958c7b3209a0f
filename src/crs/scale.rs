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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::{CrsSpec, ResolveOptions, resolve};

    #[test]
    fn scale_is_map_metres_per_ground_metre_in_any_unit() {
        let scale = |code, lon_deg, lat_deg| {
            let crs = resolve(&CrsSpec::from_epsg(code), &ResolveOptions::default());
            scale_factor(&crs.expect("in the table"), LonLat { lon_deg, lat_deg })
        };
        let meridian = scale(32_610, -123.0, 47.6).expect("in the domain");
        assert!((meridian.east - 0.9996).abs() < 1e-9 && (meridian.north - 0.9996).abs() < 1e-9);
        // US survey feet; a standard parallel of EPSG:6597, 1e-10 of the flattening away.
        let parallel = scale(6597, -121.7, 47.5).expect("in the domain");
        let (east, north) = (parallel.east, parallel.north);
        assert!((east - north).abs() < 1e-8 && (east - 1.0).abs() < 1e-8, "{parallel:?}");
        assert!(scale(32_610, 0.0, 90.0).is_err() && scale(32_610, 0.0, -90.0).is_err());
        // The outermost place is 20 m from the pole.
        assert!(scale(32_610, -123.0, 89.999).is_ok() && scale(32_610, -123.0, 89.9999).is_err());
    }

    #[test]
    fn distances_are_lengths_of_arcs_across_the_antimeridian_too() {
        let at = |lon_deg, lat_deg| LonLat { lon_deg, lat_deg };
        let wgs84 = Ellipsoid::WGS84;
        let (east, north) = (wgs84.parallel_radius(60.0), wgs84.meridian_radius(60.0));
        let arc = 0.006_f64.to_radians();
        assert!(
            (ground_distance_m(at(-10.002, 60.0), at(-10.008, 60.0)) - east * arc).abs() < 1e-6
        );
        assert!(
            (ground_distance_m(at(179.997, 60.0), at(-179.997, 60.0)) - east * arc).abs() < 1e-6
        );
        assert!((ground_distance_m(at(5.0, 60.003), at(5.0, 59.997)) - north * arc).abs() < 1e-6);
        let slanted = ground_distance_m(at(5.0, 60.003), at(5.006, 59.997));
        assert!((slanted - libm::hypot(east, north) * arc).abs() < 1e-6, "{slanted}");
    }
}
