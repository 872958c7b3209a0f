//! What a pixel grid is: pure mathematics, no files.
//!
//! * [`ImageGrid`]: the Web-Mercator pixel grid of one satellite image (EPSG:3857, zoom, size).
//! * [`GeoTransform`]: the affine grid of a raster in a projected CRS.
//!
//! Pixel `(i, j)` covers `[i, i+1) x [j, j+1)`; its centre is at `+0.5`; row 0 is north.

mod affine;
#[cfg(test)]
mod hard_cases;
mod web_mercator;

pub use affine::GeoTransform;
pub use web_mercator::{GridError, ImageGrid, MAX_LATITUDE_DEG, MERCATOR_HALF_WORLD_M, WGS84_A};
pub(crate) use web_mercator::{latitude_of_mercator, mercator_of_latitude};

use serde::{Deserialize, Serialize};

/// A WGS 84 position (EPSG:4326), degrees, longitude first in the name and in the fields.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LonLat {
    /// Longitude in degrees, east positive.
    pub lon_deg: f64,
    /// Latitude in degrees, north positive.
    pub lat_deg: f64,
}

/// A position in a projected CRS, in that CRS's own linear unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Projected {
    /// Easting.
    pub x: f64,
    /// Northing.
    pub y: f64,
}

/// A position on a pixel grid: `x` to the right (east), `y` down (south); centres are at `+0.5`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PixelPoint {
    /// Column coordinate.
    pub x: f64,
    /// Row coordinate.
    pub y: f64,
}
