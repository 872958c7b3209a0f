//! Between pixels and positions on Earth, for every kind of place.

use super::{Footprint, FootprintError, Place};
use crate::crs::{
    CrsError, CrsSpec, Ellipsoid, ResolveOptions, ResolvedCrs, resolve, scale_factor,
};
use crate::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint, Projected, WGS84_A};

/// Web Mercator, which needs no PROJ.
const WEB_MERCATOR: u32 = 3857;
/// Geographic CRSs that are WGS 84.
const WGS84: [u32; 2] = [4326, 4979];

/// An image's place, ready for computing: made once, used for many positions.
#[derive(Clone, Debug)]
pub struct Georeference {
    size_px: [u32; 2],
    way: Way,
    warnings: Vec<String>,
}

/// From pixels to longitude and latitude.
#[derive(Clone, Debug)]
enum Way {
    Grid(ImageGrid),
    /// EPSG:3857.
    Mercator(GeoTransform),
    /// Longitude and latitude themselves.
    Degrees(GeoTransform),
    Projected(GeoTransform, Box<ResolvedCrs>),
}

impl Georeference {
    /// Of an image of `size_px` columns and rows.
    ///
    /// # Errors
    /// [`FootprintError::Grid`] for a grid that is not north-up, [`FootprintError::Crs`] for a CRS that this
    /// build cannot serve, [`FootprintError::OffEarth`] where the image's centre is no place on Earth.
    pub(super) fn new(size_px: [u32; 2], place: &Place) -> Result<Self, FootprintError> {
        let with = |way, warnings| Self { size_px, way, warnings };
        let georeference = match place {
            Place::WebMercator(grid) => with(Way::Grid(*grid), Vec::new()),
            Place::Raster { geotransform, crs } => {
                check(geotransform)?;
                if crs.epsg == Some(WEB_MERCATOR) {
                    with(Way::Mercator(*geotransform), Vec::new())
                } else if crs.geographic {
                    let same = crs.epsg.is_some_and(|code| WGS84.contains(&code));
                    let warning = format!(
                        "{}: its datum is taken to equal WGS 84, which may be off by a metre or two",
                        crs.label()
                    );
                    let warnings = if same { Vec::new() } else { vec![warning] };
                    with(Way::Degrees(*geotransform), warnings)
                } else {
                    Self::projected(size_px, *geotransform, crs)?
                }
            }
        };
        let center = georeference.center()?;
        // So written that NaN is refused too.
        if !(center.lat_deg.abs() < 90.0 && center.lon_deg.abs() <= 360.0) {
            return Err(FootprintError::OffEarth { center });
        }
        Ok(georeference)
    }

    fn projected(
        size_px: [u32; 2],
        geotransform: GeoTransform,
        crs: &CrsSpec,
    ) -> Result<Self, FootprintError> {
        let resolved = resolve(crs, &ResolveOptions::default())?;
        let first = Self {
            size_px,
            way: Way::Projected(geotransform, Box::new(resolved)),
            warnings: Vec::new(),
        };
        // Which datum operation is best hangs on where the image lies.
        let corners = [[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 0.0]];
        let mut area = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        for corner in corners {
            let at = first.lonlat_of_crop(corner)?;
            area = [
                area[0].min(at.lon_deg),
                area[1].min(at.lat_deg),
                area[2].max(at.lon_deg),
                area[3].max(at.lat_deg),
            ];
        }
        let sound = area.iter().all(|v| v.is_finite()) && area[2] - area[0] < 180.0;
        let options = ResolveOptions { area: sound.then_some(area), ..ResolveOptions::default() };
        let resolved = resolve(crs, &options)?;
        let warnings = resolved.warnings.clone();
        Ok(Self { way: Way::Projected(geotransform, Box::new(resolved)), warnings, ..first })
    }

    /// Things the user should know: a datum that is taken to equal WGS 84, a better operation.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The position of a pixel coordinate of the image as it was given.
    ///
    /// # Errors
    /// [`CrsError::Domain`] where the projection is undefined.
    pub fn lonlat_of_pixel(&self, pixel: PixelPoint) -> Result<LonLat, CrsError> {
        Ok(match &self.way {
            Way::Grid(grid) => grid.lonlat(pixel),
            Way::Mercator(grid) => {
                let at = grid.to_projected(pixel);
                LonLat {
                    lon_deg: (at.x / WGS84_A).to_degrees(),
                    lat_deg: libm::atan(libm::sinh(at.y / WGS84_A)).to_degrees(),
                }
            }
            Way::Degrees(grid) => {
                let at = grid.to_projected(pixel);
                LonLat { lon_deg: at.x, lat_deg: at.y }
            }
            Way::Projected(grid, resolved) => {
                resolved.projection.inverse(grid.to_projected(pixel))?
            }
        })
    }

    /// The pixel coordinate of a position; it may lie outside the image.
    ///
    /// # Errors
    /// [`CrsError::Domain`] where the projection is undefined.
    pub fn pixel_of_lonlat(&self, at: LonLat) -> Result<PixelPoint, CrsError> {
        Ok(match &self.way {
            Way::Grid(grid) => grid.pixel(at),
            Way::Mercator(grid) => grid.to_pixel(Projected {
                x: at.lon_deg.to_radians() * WGS84_A,
                y: libm::asinh(libm::tan(at.lat_deg.to_radians())) * WGS84_A,
            }),
            Way::Degrees(grid) => grid.to_pixel(Projected { x: at.lon_deg, y: at.lat_deg }),
            Way::Projected(grid, resolved) => grid.to_pixel(resolved.projection.forward(at)?),
        })
    }

    /// The crop position `(row, column)` of a position, each in `[-1, 1]` inside the image.
    ///
    /// # Errors
    /// [`CrsError::Domain`] where the projection is undefined.
    pub fn crop_of_lonlat(&self, at: LonLat) -> Result<[f64; 2], CrsError> {
        let pixel = self.pixel_of_lonlat(at)?;
        let relative = |value: f64, size: u32| 2.0 * value / f64::from(size) - 1.0;
        Ok([relative(pixel.y, self.size_px[1]), relative(pixel.x, self.size_px[0])])
    }

    /// The position of a crop position `(row, column)`.
    ///
    /// # Errors
    /// [`CrsError::Domain`] where the projection is undefined.
    pub fn lonlat_of_crop(&self, [row, column]: [f64; 2]) -> Result<LonLat, CrsError> {
        let pixel = |value: f64, size: u32| (value + 1.0) / 2.0 * f64::from(size);
        self.lonlat_of_pixel(PixelPoint {
            x: pixel(column, self.size_px[0]),
            y: pixel(row, self.size_px[1]),
        })
    }

    /// The position of the image's centre: the origin of its mesh.
    ///
    /// # Errors
    /// [`CrsError::Domain`] where the projection is undefined.
    pub fn center(&self) -> Result<LonLat, CrsError> {
        match &self.way {
            Way::Grid(grid) => Ok(grid.center()),
            _ => self.lonlat_of_crop([0.0, 0.0]),
        }
    }

    /// Ground metres per pixel at the centre, across and down. In Web Mercator pixel size times the cosine of
    /// the latitude, on the sphere, as for every image of VIGOR; elsewhere on the ellipsoid.
    pub(super) fn gsd_m(&self) -> Result<[f64; 2], FootprintError> {
        let center = self.center()?;
        let size = |grid: &GeoTransform| [grid.0[1].abs(), grid.0[5].abs()];
        let gsd = match &self.way {
            Way::Grid(grid) => [grid.ground_sample_distance(); 2],
            Way::Mercator(grid) => {
                let cosine = libm::cos(center.lat_deg.to_radians());
                size(grid).map(|pixel| pixel * cosine)
            }
            Way::Degrees(grid) => {
                let [x, y] = size(grid).map(f64::to_radians);
                let earth = Ellipsoid::WGS84;
                [
                    x * earth.parallel_radius(center.lat_deg),
                    y * earth.meridian_radius(center.lat_deg),
                ]
            }
            Way::Projected(grid, resolved) => {
                let scale = scale_factor(resolved, center)?;
                let [x, y] = size(grid).map(|pixel| pixel * resolved.metres_per_unit);
                [x / scale.east, y / scale.north]
            }
        };
        match gsd.iter().all(|metres| metres.is_finite() && *metres > 0.0) {
            true => Ok(gsd),
            false => Err(FootprintError::OffEarth { center }),
        }
    }
}

impl Footprint {
    /// The image's place, ready for computing; `None` where it is not known.
    ///
    /// # Errors
    /// [`FootprintError`] for a place that cannot be used.
    pub fn georeference(&self) -> Result<Option<Georeference>, FootprintError> {
        self.place.as_ref().map(|place| Georeference::new(self.size_px, place)).transpose()
    }
}

/// Refuses grids that a scene cannot be laid on.
fn check(geotransform: &GeoTransform) -> Result<(), FootprintError> {
    let c = &geotransform.0;
    let reason = if c.iter().any(|v| !v.is_finite()) {
        format!("the image's georeference is not finite (geotransform {c:?})")
    } else if c[2] != 0.0 || c[4] != 0.0 {
        format!("the image's grid is rotated (geotransform {c:?}); make it north-up with gdalwarp")
    } else if !geotransform.is_north_up() {
        format!(
            "the image is stored south up or mirrored (pixel size {} x {}); make it north-up with gdalwarp",
            c[1], c[5]
        )
    } else {
        return Ok(());
    };
    Err(FootprintError::Grid { reason })
}
