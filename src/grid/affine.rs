//! The affine grid of a north-up raster.

use super::{PixelPoint, Projected};
use serde::{Deserialize, Serialize};

/// GDAL's six coefficients: `x = c0 + col*c1 + row*c2`, `y = c3 + col*c4 + row*c5`, in CRS units,
/// for the corner of a pixel (PixelIsArea; PixelIsPoint is shifted on reading).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct GeoTransform(pub [f64; 6]);

impl GeoTransform {
    /// A north-up grid from the outer corner of its north-west pixel and its (positive) pixel size.
    #[must_use]
    pub const fn north_up(west: f64, north: f64, pixel_width: f64, pixel_height: f64) -> Self {
        Self([west, pixel_width, 0.0, north, 0.0, -pixel_height])
    }

    /// Whether rows run east-west and columns north-south, north up, with finite non-zero pixels.
    #[must_use]
    pub fn is_north_up(&self) -> bool {
        let c = &self.0;
        c.iter().all(|v| v.is_finite()) && c[2] == 0.0 && c[4] == 0.0 && c[1] > 0.0 && c[5] < 0.0
    }

    /// Position of a pixel coordinate, in CRS units.
    #[must_use]
    pub fn to_projected(&self, p: PixelPoint) -> Projected {
        let c = &self.0;
        Projected { x: c[0] + p.x * c[1] + p.y * c[2], y: c[3] + p.x * c[4] + p.y * c[5] }
    }

    /// Pixel coordinate of a position in CRS units (any invertible grid).
    #[must_use]
    pub fn to_pixel(&self, p: Projected) -> PixelPoint {
        let c = &self.0;
        let (dx, dy) = (p.x - c[0], p.y - c[3]);
        let determinant = c[1] * c[5] - c[2] * c[4];
        PixelPoint {
            x: (dx * c[5] - dy * c[2]) / determinant,
            y: (dy * c[1] - dx * c[4]) / determinant,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_and_position_are_inverse() {
        let grid = GeoTransform([1_166_191.026, 1.499, 0.1, 824_226.382, -0.2, -1.5]);
        let p = PixelPoint { x: 12.25, y: 700.5 };
        let back = grid.to_pixel(grid.to_projected(p));
        assert!((back.x - p.x).abs() < 1e-9 && (back.y - p.y).abs() < 1e-9);
        assert!(!grid.is_north_up());
        assert!(GeoTransform::north_up(0.0, 10.0, 1.5, 1.5).is_north_up());
    }

    #[test]
    fn each_coefficient_alone_can_spoil_a_north_up_grid() {
        let grid = GeoTransform::north_up(-3.0, 10.0, 1.5, 2.0);
        for (k, value) in [
            (0, f64::NAN),
            (1, 0.0),
            (1, -1.5),
            (2, 0.1),
            (3, f64::INFINITY),
            (4, -0.1),
            (5, 0.0),
            (5, 2.0),
        ] {
            let mut spoilt = grid;
            spoilt.0[k] = value;
            assert!(grid.is_north_up() && !spoilt.is_north_up(), "{k} {value}");
        }
    }
}
