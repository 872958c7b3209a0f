//! Where on the ground a scene stands, and how many metres a cube unit is.
//!
//! The network's scene is a cube without a place or a size. Its satellite crop fills `[-s, s]` in x and y
//! (s = 0.8 as released), and the image says how many metres that is; the height of the cube is a matter
//! of convention ([`VerticalScale`]). DSM, mesh, density and views of one run take both from here.

mod georeference;

pub use georeference::Georeference;

use crate::crs::{CrsError, CrsSpec};
use crate::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint};
use serde::{Deserialize, Serialize};

/// Why an image's place cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FootprintError {
    /// A rotated or mirrored grid.
    #[error("{reason}")]
    Grid {
        /// What is wrong with it and what to do.
        reason: String,
    },
    /// The CRS cannot be served, or is undefined there.
    #[error(transparent)]
    Crs(#[from] CrsError),
    /// The centre is no place on Earth.
    #[error(
        "the image's centre would lie at latitude {} and longitude {}, which is no place on Earth; are its          grid and its coordinate reference system right?",
        center.lat_deg, center.lon_deg
    )]
    OffEarth {
        /// The centre.
        center: LonLat,
    },
}

/// A raster over a footprint: what a COG of it says.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundGrid {
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// From its pixels to the CRS.
    pub geotransform: GeoTransform,
    /// The CRS.
    pub crs: CrsSpec,
}

/// Width on the ground of the crops that the released weights were trained with: 640 px of VIGOR's Seattle at
/// zoom 20, metres.
pub const TRAINING_WIDTH_M: f64 = 64.48;

/// How heights of the cube become metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum VerticalScale {
    /// The published scoring: the cube is as high as [`TRAINING_WIDTH_M`], 32.24 m per unit, whatever the image.
    #[default]
    Paper,
    /// The scene's true proportion: as many metres per unit as across (40.3 in Seattle).
    Isotropic,
}

/// Where on Earth an image lies.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// A window of the Web-Mercator pixel plane, as a VIGOR name states it.
    WebMercator(ImageGrid),
    /// A raster's own grid.
    Raster {
        /// From pixels of the image as it was given to the CRS.
        geotransform: GeoTransform,
        /// The CRS.
        crs: CrsSpec,
    },
}

/// The satellite image's place and size on the ground.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Footprint {
    /// Columns and rows of the image as it was given.
    pub size_px: [u32; 2],
    /// Ground metres per pixel, across and down.
    pub gsd_m: [f64; 2],
    /// Where it lies, if that is known.
    pub place: Option<Place>,
}

impl Footprint {
    /// Of an image on a Web-Mercator grid, measured at its centre.
    #[must_use]
    pub fn of_grid(grid: ImageGrid) -> Self {
        let gsd = grid.ground_sample_distance();
        Self {
            size_px: [grid.width(), grid.height()],
            gsd_m: [gsd, gsd],
            place: Some(Place::WebMercator(grid)),
        }
    }

    /// Of an image of `size_px` columns and rows at a place, measured at its centre.
    ///
    /// # Errors
    /// [`FootprintError`] for a rotated grid, a CRS that this build cannot serve, or a place off the Earth.
    pub fn of_place(size_px: [u32; 2], place: Place) -> Result<Self, FootprintError> {
        let gsd_m = Georeference::new(size_px, &place)?.gsd_m()?;
        Ok(Self { size_px, gsd_m, place: Some(place) })
    }

    /// Of an image without a place that is as wide and high as those of the training.
    #[must_use]
    pub fn of_training(size_px: [u32; 2]) -> Self {
        Self { size_px, gsd_m: size_px.map(|px| TRAINING_WIDTH_M / f64::from(px)), place: None }
    }

    /// Of an image whose ground sample distance is given, metres across and down.
    #[must_use]
    pub const fn of_gsd(size_px: [u32; 2], gsd_m: [f64; 2]) -> Self {
        Self { size_px, gsd_m, place: None }
    }

    /// Metres on the ground, across and down.
    #[must_use]
    pub fn ground_m(&self) -> [f64; 2] {
        [0, 1].map(|axis| f64::from(self.size_px[axis]) * self.gsd_m[axis])
    }

    /// Ground metres per cube unit, across (x) and down (y), for a crop that fills `[-scale, scale]`.
    #[must_use]
    pub fn metres_per_unit(&self, scale: f64) -> [f64; 2] {
        self.ground_m().map(|metres| metres / (2.0 * scale))
    }

    /// Metres of height per cube unit.
    #[must_use]
    pub fn vertical_metres_per_unit(&self, vertical: VerticalScale, scale: f64) -> f64 {
        match vertical {
            VerticalScale::Paper => TRAINING_WIDTH_M / 2.0,
            VerticalScale::Isotropic => {
                let [across, down] = self.metres_per_unit(scale);
                (across * down).sqrt()
            }
        }
    }

    /// The crop position `(row, column)`, each in `[-1, 1]` inside the image, of a pixel coordinate of the
    /// image as it was given.
    #[must_use]
    pub fn crop_of_pixel(&self, pixel: PixelPoint) -> [f64; 2] {
        let relative = |value: f64, size: u32| 2.0 * value / f64::from(size) - 1.0;
        [relative(pixel.y, self.size_px[1]), relative(pixel.x, self.size_px[0])]
    }

    /// The crop position of a place on Earth; `None` where the image's own place is not known or cannot be
    /// used. For many positions, and to know why: [`Footprint::georeference`].
    #[must_use]
    pub fn crop_of_lonlat(&self, at: LonLat) -> Option<[f64; 2]> {
        self.georeference().ok()??.crop_of_lonlat(at).ok()
    }

    /// A raster of `size_px` columns and rows over the same ground, in the image's own CRS; `None` where the
    /// image's place is not known.
    #[must_use]
    pub fn ground_grid(&self, size_px: [u32; 2]) -> Option<GroundGrid> {
        let (geotransform, crs) = match self.place.as_ref()? {
            Place::WebMercator(grid) => (grid.geotransform(), CrsSpec::from_epsg(3857)),
            Place::Raster { geotransform, crs } => (*geotransform, crs.clone()),
        };
        let [x, y] = [0, 1].map(|axis| f64::from(self.size_px[axis]) / f64::from(size_px[axis]));
        let c = geotransform.0;
        let geotransform = GeoTransform([c[0], c[1] * x, c[2] * y, c[3], c[4] * x, c[5] * y]);
        Some(GroundGrid { size_px, geotransform, crs })
    }

    /// [`Footprint::ground_grid`] of a square DSM.
    #[must_use]
    pub fn dsm_grid(&self, size: u32) -> Option<GroundGrid> {
        self.ground_grid([size; 2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seattle() -> Footprint {
        let center = LonLat { lon_deg: -122.33, lat_deg: 47.6 };
        Footprint::of_grid(ImageGrid::new(center, 20, 640, 640).expect("a grid"))
    }

    #[test]
    fn seattle_has_the_published_scales() {
        let footprint = seattle();
        let [across, down] = footprint.metres_per_unit(0.8);
        assert!((across - 40.27).abs() < 0.05 && across == down, "{across}");
        assert_eq!(footprint.vertical_metres_per_unit(VerticalScale::Paper, 0.8), 32.24);
        let isotropic = footprint.vertical_metres_per_unit(VerticalScale::Isotropic, 0.8);
        assert!((isotropic - across).abs() < 1e-9);
        let training = Footprint::of_training([256, 256]);
        assert!((training.metres_per_unit(0.8)[0] - 40.3).abs() < 1e-9);
    }

    #[test]
    fn places_are_where_the_image_has_them() {
        let footprint = seattle();
        let Some(Place::WebMercator(grid)) = footprint.place else { panic!("a grid") };
        let center = grid.center();
        let middle = footprint.crop_of_lonlat(center).expect("a place");
        assert!(middle.iter().all(|v| v.abs() < 1e-6), "{middle:?}");
        let north_east = LonLat { lon_deg: center.lon_deg + 1e-4, lat_deg: center.lat_deg + 1e-4 };
        let [row, column] = footprint.crop_of_lonlat(north_east).expect("a place");
        assert!(row < 0.0 && column > 0.0);
        assert_eq!(footprint.crop_of_pixel(PixelPoint { x: 640.0, y: 0.0 }), [-1.0, 1.0]);
        assert_eq!(Footprint::of_training([9, 9]).crop_of_lonlat(center), None);
    }
}
