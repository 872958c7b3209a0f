//! The pixel grid of one satellite image: a window of the Web-Mercator pixel plane.

use super::{GeoTransform, LonLat, PixelPoint, Projected};
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// Equatorial radius of the WGS 84 ellipsoid and radius of the Mercator sphere (EPSG:3857), metres.
pub const WGS84_A: f64 = 6_378_137.0;
/// Half the width of the EPSG:3857 square, `pi * a`, metres.
pub const MERCATOR_HALF_WORLD_M: f64 = PI * WGS84_A;
/// Latitude at which the Web-Mercator square ends: `atan(sinh(pi))`, degrees.
pub const MAX_LATITUDE_DEG: f64 = 85.051_128_779_806_59;

/// Why an image grid cannot exist.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GridError {
    /// The centre is no position on Earth, or lies beyond the square that Web Mercator covers.
    #[error(
        "latitude {lat_deg} is outside Web Mercator, which ends at +-{MAX_LATITUDE_DEG:.4} degrees"
    )]
    Latitude {
        /// Offending latitude, degrees.
        lat_deg: f64,
    },
    /// The longitude is not in [-180, 180].
    #[error("longitude {lon_deg} is not between -180 and 180 degrees")]
    Longitude {
        /// Offending longitude, degrees.
        lon_deg: f64,
    },
    /// The image reaches across the antimeridian or past the top or bottom of the square.
    #[error(
        "an image of {width} x {height} pixels at zoom {zoom} centred on {lat_deg}, {lon_deg} reaches past the {edge} of the Web-Mercator square"
    )]
    OffTheMap {
        /// Centre latitude, degrees.
        lat_deg: f64,
        /// Centre longitude, degrees.
        lon_deg: f64,
        /// Zoom level.
        zoom: u8,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// `antimeridian`, `north edge` or `south edge`.
        edge: &'static str,
    },
    /// A zero or absurd size, or a zoom above 30.
    #[error(
        "an image grid of {width} x {height} pixels at zoom {zoom} makes no sense (1 to 65536 pixels, zoom 0 to 30)"
    )]
    Size {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Zoom level.
        zoom: u8,
    },
}

/// A `width x height` window of the Web-Mercator pixel plane at one zoom, centred on a position.
///
/// World pixels run 256 * 2^zoom around, from 180 W and the north edge. The window's north-west
/// corner in world pixels is the centre minus half the size; it is in general not an integer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageGrid {
    center: LonLat,
    zoom: u8,
    width: u32,
    height: u32,
    west_px: f64,
    north_px: f64,
}

impl ImageGrid {
    /// The grid of an image centred on `center` (WGS 84).
    ///
    /// # Errors
    /// [`GridError`] when the centre or any corner is off the Web-Mercator square, or the size or
    /// zoom is out of range.
    pub fn new(center: LonLat, zoom: u8, width: u32, height: u32) -> Result<Self, GridError> {
        let LonLat { lon_deg, lat_deg } = center;
        if lat_deg.is_nan() || lat_deg.abs() > MAX_LATITUDE_DEG {
            return Err(GridError::Latitude { lat_deg });
        }
        if lon_deg.is_nan() || lon_deg.abs() > 180.0 {
            return Err(GridError::Longitude { lon_deg });
        }
        if width == 0 || height == 0 || width > 65_536 || height > 65_536 || zoom > 30 {
            return Err(GridError::Size { width, height, zoom });
        }
        let world = world_pixels(zoom);
        let at = world_pixel_of(center, world);
        let (last_x, last_y) = (world - f64::from(width), world - f64::from(height));
        let west_px = on_edge(at.x - f64::from(width) / 2.0, last_x, world);
        let north_px = on_edge(at.y - f64::from(height) / 2.0, last_y, world);
        let off = |edge| GridError::OffTheMap { lat_deg, lon_deg, zoom, width, height, edge };
        if west_px < 0.0 || west_px > last_x {
            return Err(off("antimeridian"));
        }
        if north_px < 0.0 {
            return Err(off("north edge"));
        }
        if north_px > last_y {
            return Err(off("south edge"));
        }
        Ok(Self { center, zoom, width, height, west_px, north_px })
    }

    /// Centre of the image.
    #[must_use]
    pub const fn center(&self) -> LonLat {
        self.center
    }

    /// Zoom level; the world is 256 * 2^zoom pixels around.
    #[must_use]
    pub const fn zoom(&self) -> u8 {
        self.zoom
    }

    /// Width in pixels.
    #[must_use]
    pub const fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    #[must_use]
    pub const fn height(&self) -> u32 {
        self.height
    }

    /// Position of a pixel coordinate of this image (centres at `+0.5`).
    #[must_use]
    pub fn lonlat(&self, p: PixelPoint) -> LonLat {
        let world = world_pixels(self.zoom);
        // Relative to the middle of the square, so that the subtraction is exact and the
        // argument of the exponential is not the difference of two large numbers.
        let half = world / 2.0;
        let east = (self.west_px - half) + p.x;
        let south = (self.north_px - half) + p.y;
        LonLat {
            lon_deg: 360.0 * east / world,
            lat_deg: latitude_of_mercator(-2.0 * PI * south / world),
        }
    }

    /// Pixel coordinate of a position in this image; may lie outside it.
    #[must_use]
    pub fn pixel(&self, at: LonLat) -> PixelPoint {
        let p = world_pixel_of(at, world_pixels(self.zoom));
        PixelPoint { x: p.x - self.west_px, y: p.y - self.north_px }
    }

    /// EPSG:3857 coordinates (metres) of a pixel coordinate.
    #[must_use]
    pub fn mercator(&self, p: PixelPoint) -> Projected {
        self.geotransform().to_projected(p)
    }

    /// The grid as an affine grid in EPSG:3857, metres.
    #[must_use]
    pub fn geotransform(&self) -> GeoTransform {
        let world = world_pixels(self.zoom);
        let pixel = 2.0 * MERCATOR_HALF_WORLD_M / world;
        let half = world / 2.0;
        GeoTransform::north_up(
            (self.west_px - half) * pixel,
            (half - self.north_px) * pixel,
            pixel,
            pixel,
        )
    }

    /// Ground sample distance at the centre of the image, metres: EPSG:3857 pixel size times the
    /// cosine of the latitude (on the sphere; the ellipsoid changes it by up to 0.7 %).
    #[must_use]
    pub fn ground_sample_distance(&self) -> f64 {
        2.0 * MERCATOR_HALF_WORLD_M / world_pixels(self.zoom)
            * libm::cos(self.center.lat_deg.to_radians())
    }
}

/// The first pixel of an image, which is on the edge of the square where it is beyond by no more than
/// a centre in doubles can tell: the outermost tiles of most zooms are.
fn on_edge(first_px: f64, last_px: f64, world: f64) -> f64 {
    // A latitude of 85 degrees is known to 1.2e-16 radians, which Mercator stretches twelvefold: one
    // epsilon of the world; Mercator's own rounding is another.
    let rounding = 4.0 * f64::EPSILON * world;
    if first_px < 0.0 && first_px >= -rounding {
        0.0
    } else if first_px > last_px && first_px <= last_px + rounding {
        last_px
    } else {
        first_px
    }
}

/// Pixels around the world at a zoom level: `256 * 2^zoom`.
fn world_pixels(zoom: u8) -> f64 {
    (256_u64 << zoom) as f64
}

fn world_pixel_of(at: LonLat, world: f64) -> PixelPoint {
    let half = world / 2.0;
    PixelPoint {
        x: half + at.lon_deg / 360.0 * world,
        y: half - mercator_of_latitude(at.lat_deg) / (2.0 * PI) * world,
    }
}

/// Spherical Mercator ordinate for unit radius: `atanh(sin(lat))`.
pub(crate) fn mercator_of_latitude(lat_deg: f64) -> f64 {
    // asinh(tan) keeps full relative precision near the equator and towards the limit, where
    // ln(tan(pi/4 + lat/2)) loses digits.
    libm::asinh(libm::tan(lat_deg.to_radians()))
}

/// Latitude in degrees of a spherical Mercator ordinate: `atan(sinh(y))`.
pub(crate) fn latitude_of_mercator(y: f64) -> f64 {
    libm::atan(libm::sinh(y)).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn seattle() -> ImageGrid {
        let center = LonLat { lon_deg: -122.332_163, lat_deg: 47.610_335 };
        ImageGrid::new(center, 20, 640, 640).expect("a grid")
    }

    #[test]
    fn centre_of_the_image_is_the_centre_of_its_name() {
        let grid = seattle();
        assert_eq!((grid.zoom(), grid.width(), grid.height()), (20, 640, 640));
        let at = grid.lonlat(PixelPoint { x: 320.0, y: 320.0 });
        assert!((at.lon_deg - grid.center().lon_deg).abs() < 1e-13);
        assert!((at.lat_deg - grid.center().lat_deg).abs() < 1e-13);
    }

    #[test]
    fn ground_sample_distance_is_a_tenth_of_a_metre_at_seattle() {
        assert!((seattle().ground_sample_distance() - 0.100_647).abs() < 1e-5);
    }

    #[test]
    fn limits_of_the_square_are_refused_with_their_cause() {
        let at = |lon_deg, lat_deg| ImageGrid::new(LonLat { lon_deg, lat_deg }, 20, 640, 640);
        assert!(matches!(at(0.0, 85.06), Err(GridError::Latitude { .. })));
        assert!(matches!(at(0.0, f64::NAN), Err(GridError::Latitude { .. })));
        assert!(matches!(at(181.0, 0.0), Err(GridError::Longitude { .. })));
        assert!(matches!(at(180.0, 0.0), Err(GridError::OffTheMap { edge: "antimeridian", .. })));
        assert!(matches!(at(-179.9999, 0.0), Err(GridError::OffTheMap { .. })));
        assert!(matches!(at(0.0, 85.0511), Err(GridError::OffTheMap { edge: "north edge", .. })));
        assert!(matches!(at(0.0, -85.0511), Err(GridError::OffTheMap { edge: "south edge", .. })));
        let sized = |zoom, w| ImageGrid::new(LonLat { lon_deg: 0.0, lat_deg: 0.0 }, zoom, w, 1);
        assert!(matches!(sized(31, 1), Err(GridError::Size { .. })));
        assert!(matches!(sized(3, 0), Err(GridError::Size { .. })));
        assert!(sized(0, 256).is_ok());
        assert!(sized(30, 640).is_ok());
    }

    #[test]
    fn the_largest_sizes_and_the_whole_world_are_grids() {
        let at = |lon_deg, lat_deg, zoom, width, height| {
            ImageGrid::new(LonLat { lon_deg, lat_deg }, zoom, width, height)
        };
        assert!(at(0.0, 0.0, 20, 65_536, 65_536).is_ok());
        for (width, height) in [(65_537, 1), (1, 65_537), (1, 0)] {
            assert!(matches!(at(0.0, 0.0, 20, width, height), Err(GridError::Size { .. })));
        }
        assert!(matches!(at(f64::NAN, 0.0, 20, 1, 1), Err(GridError::Longitude { .. })));
        // All of the square, corner to corner.
        let world = at(0.0, 0.0, 0, 256, 256).expect("a grid");
        assert_eq!((world.width(), world.height(), world.zoom()), (256, 256, 0));
        let corner = world.lonlat(PixelPoint { x: 0.0, y: 256.0 });
        assert!(
            (corner.lon_deg + 180.0).abs() < 1e-12
                && (corner.lat_deg + MAX_LATITUDE_DEG).abs() < 1e-12
        );
        let transform = world.geotransform();
        let pixel = MERCATOR_HALF_WORLD_M / 128.0;
        assert_eq!(
            transform.0,
            [-MERCATOR_HALF_WORLD_M, pixel, 0.0, MERCATOR_HALF_WORLD_M, 0.0, -pixel]
        );
        let equator = world.ground_sample_distance();
        assert!((equator - std::f64::consts::TAU * WGS84_A / 256.0).abs() < 1e-9, "{equator}");
    }

    proptest! {
        #[test]
        fn pixel_and_position_are_inverse(
            lon_deg in -179.0..179.0_f64, lat_deg in -84.9..84.9_f64, zoom in 8_u8..24,
            x in -10.0..266.0_f64, y in -10.0..266.0_f64,
        ) {
            // At zoom 8 an image may reach past the edge; those are refused, not wrapped.
            if let Ok(grid) = ImageGrid::new(LonLat { lon_deg, lat_deg }, zoom, 256, 256) {
                let back = grid.pixel(grid.lonlat(PixelPoint { x, y }));
                // Half a double's step in a world of 256 * 2^zoom pixels, a few times over.
                let bound = 8.0 * f64::EPSILON * world_pixels(zoom);
                prop_assert!((back.x - x).abs() < bound, "{} {}", back.x, x);
                prop_assert!((back.y - y).abs() < bound, "{} {}", back.y, y);
            }
        }

        #[test]
        fn mercator_metres_agree_with_the_affine_grid(
            lon_deg in -170.0..170.0_f64, lat_deg in -80.0..80.0_f64, x in 0.0..640.0_f64, y in 0.0..640.0_f64,
        ) {
            let grid = ImageGrid::new(LonLat { lon_deg, lat_deg }, 20, 640, 640).expect("a grid");
            let p = PixelPoint { x, y };
            let (m, at) = (grid.mercator(p), grid.lonlat(p));
            prop_assert!((m.x - at.lon_deg.to_radians() * WGS84_A).abs() < 2e-8);
            prop_assert!((m.y - mercator_of_latitude(at.lat_deg) * WGS84_A).abs() < 4e-8);
        }
    }
}
