//! One georeferenced raster, brought onto image grids: a prediction, a mask.
//!
//! A lidar tile has to be in a projected CRS; other rasters come in whatever people export, so
//! Web Mercator and longitude/latitude are served here too, in closed form and in every build.

use super::{
    EdgeRule, Lattice, LatticeWindow, PHASE_BITS, PixelMap, PixelToCrs, Resampling, TileStore,
    TransformForm, WarpError, WarpSettings, WindowSource, warp,
};
use crate::crs::{CrsError, CrsSpec, Projection, ResolveOptions, resolve};
use crate::grid::{
    GeoTransform, ImageGrid, LonLat, PixelPoint, Projected, WGS84_A, latitude_of_mercator,
    mercator_of_latitude,
};
use crate::raster::{OpenOptions, RasterError, RasterHeader};
use crate::units::LinearUnit;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Bytes of decoded blocks that one raster keeps.
const CACHE_BYTES: usize = 64 << 20;
/// Displacement that a polynomial in the place of one projection per pixel may cause, metres.
const TRANSFORM_BUDGET_M: f64 = 1e-6;
/// A raster whose corners are this near to the grid's, in pixels, lies on the grid.
const ON_GRID_PX: f64 = 1e-6;
/// Metres on the ground in one degree of the equator.
const DEGREE_M: f64 = WGS84_A * std::f64::consts::PI / 180.0;

/// Geographic CRSs that agree with WGS 84 to about 2 m, which is what a null shift costs (EPSG).
const LIKE_WGS84: [(u32, &str); 17] = [
    (4152, "NAD83(HARN)"),
    (4167, "NZGD2000"),
    (4258, "ETRS89"),
    (4269, "NAD83"),
    (4283, "GDA94"),
    (4490, "CGCS2000"),
    (4612, "JGD2000"),
    (4617, "NAD83(CSRS)"),
    (4674, "SIRGAS 2000"),
    (4759, "NAD83(NSRS2007)"),
    (4937, "ETRS89"),
    (4957, "NAD83(HARN)"),
    (6318, "NAD83(2011)"),
    (6319, "NAD83(2011)"),
    (6668, "JGD2011"),
    (7844, "GDA2020"),
    (8999, "ITRF2014"),
];

/// Codes under which Web Mercator goes: EPSG's own, and those that it had before.
const WEB_MERCATOR: [u32; 5] = [3857, 3785, 900_913, 102_100, 102_113];

/// Why a raster cannot be brought onto a grid.
#[derive(Debug, thiserror::Error)]
pub enum SingleRasterError {
    /// It cannot be read, or has no usable grid.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// It does not say where it lies.
    #[error(
        "{}: the raster has no coordinate system; state it, for example EPSG:26910, or write it into the file with gdal_edit.py -a_srs",
        path.display()
    )]
    NoCrs {
        /// The file.
        path: PathBuf,
    },
    /// Its CRS cannot be served.
    #[error("{}: {source}", path.display())]
    Crs {
        /// The file.
        path: PathBuf,
        /// Why.
        source: CrsError,
    },
    /// The warp failed.
    #[error("{}: {source}", path.display())]
    Warp {
        /// The file.
        path: PathBuf,
        /// Why.
        source: WarpError,
    },
}

/// Where positions of a CRS lie.
#[derive(Clone, Debug)]
pub struct Placement {
    /// The way from WGS 84 to the CRS and back; degrees where the CRS is geographic.
    pub projection: Arc<dyn Projection>,
    /// Metres on the ground in one unit of the CRS, at most.
    pub metres_per_unit: f64,
    /// Whether the CRS is EPSG:3857.
    pub web_mercator: bool,
    /// What the user should know.
    pub warnings: Vec<String>,
}

impl Placement {
    /// The way to any CRS that this build can serve: Web Mercator and geographic CRSs that agree
    /// with WGS 84 to 2 m in closed form, all others by [`resolve`]. `area` (west, south, east,
    /// north, degrees) decides among datum operations.
    ///
    /// # Errors
    /// [`CrsError`] naming the CRS and what to do.
    pub fn of(spec: &CrsSpec, area: Option<[f64; 4]>) -> Result<Self, CrsError> {
        if is_web_mercator(spec) {
            return Ok(Self {
                projection: Arc::new(SphericalMercator),
                metres_per_unit: 1.0,
                web_mercator: true,
                warnings: Vec::new(),
            });
        }
        if spec.geographic {
            return Ok(Self {
                projection: Arc::new(LongitudeLatitude),
                metres_per_unit: DEGREE_M,
                web_mercator: false,
                warnings: geographic_warnings(spec)?,
            });
        }
        let options = ResolveOptions { area, ..ResolveOptions::default() };
        let resolved = resolve(spec, &options)?;
        Ok(Self {
            projection: resolved.projection,
            metres_per_unit: resolved.metres_per_unit,
            web_mercator: false,
            warnings: resolved.warnings,
        })
    }
}

fn is_web_mercator(spec: &CrsSpec) -> bool {
    if spec.geographic {
        return false;
    }
    let name = spec.name.to_ascii_lowercase();
    spec.epsg.map_or_else(
        || name.contains("pseudo-mercator") || name.contains("web_mercator_auxiliary_sphere"),
        |code| WEB_MERCATOR.contains(&code),
    )
}

/// What a null shift costs; refused where it would cost more than a pixel or two.
fn geographic_warnings(spec: &CrsSpec) -> Result<Vec<String>, CrsError> {
    let name = spec.name.to_ascii_uppercase();
    let is_wgs84 = matches!(spec.epsg, Some(4326 | 4979))
        || (spec.epsg.is_none()
            && (name.contains("CRS84")
                || matches!(&name[..], "WGS 84" | "WGS84" | "GCS_WGS_1984")));
    if is_wgs84 {
        return Ok(Vec::new());
    }
    if spec.epsg.is_some_and(|code| LIKE_WGS84.iter().any(|(known, _)| *known == code)) {
        let label = spec.label();
        return Ok(vec![format!(
            "{label}: its datum is taken to equal WGS 84; positions are good to about 2 m"
        )]);
    }
    Err(CrsError::Unsupported {
        name: spec.label(),
        reason: "its longitudes and latitudes are on another datum than WGS 84; reproject the file (gdalwarp or ogr2ogr -t_srs EPSG:4326)".to_owned(),
    })
}

/// Longitude and latitude in degrees, as they are.
#[derive(Debug)]
struct LongitudeLatitude;

impl Projection for LongitudeLatitude {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        Ok(Projected { x: at.lon_deg, y: at.lat_deg })
    }

    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        Ok(LonLat { lon_deg: at.x, lat_deg: at.y })
    }
}

/// EPSG:3857: the sphere's Mercator projection of WGS 84 longitude and latitude (EPSG method 1024).
#[derive(Debug)]
struct SphericalMercator;

impl Projection for SphericalMercator {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        let LonLat { lon_deg, lat_deg } = at;
        let inside = lat_deg.abs() < 90.0 && lon_deg.is_finite();
        if !inside {
            return Err(CrsError::Domain {
                projection: "Web Mercator".to_owned(),
                what: format!("longitude {lon_deg}, latitude {lat_deg}"),
            });
        }
        let y = WGS84_A * mercator_of_latitude(lat_deg);
        Ok(Projected { x: WGS84_A * lon_deg.to_radians(), y })
    }

    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        Ok(LonLat {
            lon_deg: (at.x / WGS84_A).to_degrees(),
            lat_deg: latitude_of_mercator(at.y / WGS84_A),
        })
    }
}

/// One georeferenced raster, opened once and read by any number of threads through one bounded
/// block cache (64 MiB).
#[derive(Debug)]
pub struct SingleRaster {
    store: TileStore,
    placement: Placement,
    lattice: Lattice,
    window: LatticeWindow,
    metres_per_height: f64,
    warnings: Vec<String>,
}

impl SingleRaster {
    /// Opens a raster of heights; `crs` replaces what the file says about its CRS. Heights become
    /// metres where the file states another unit for them.
    ///
    /// # Errors
    /// [`SingleRasterError`]: unreadable, rotated or without georeference, no CRS or one that this
    /// build cannot serve.
    pub fn open(
        path: &Path,
        options: &OpenOptions,
        crs: Option<&str>,
    ) -> Result<Self, SingleRasterError> {
        let wrong_crs = |source| SingleRasterError::Crs { path: path.to_owned(), source };
        let mut store = TileStore::new(CACHE_BYTES, *options);
        store.add(path)?;
        let header = store.header(0);
        header.check_grid()?;
        let spec = match crs {
            Some(text) => CrsSpec::from_user_input(text).map_err(wrong_crs)?,
            None => header
                .crs
                .clone()
                .ok_or_else(|| SingleRasterError::NoCrs { path: path.to_owned() })?,
        };
        let placement = Placement::of(&spec, None).map_err(wrong_crs)?;
        let placement = match bounds(header, &*placement.projection) {
            // The operation that serves the raster's own place.
            Some(area) => Placement::of(&spec, Some(area)).map_err(wrong_crs)?,
            None => placement,
        };
        let unusable = |reason: String| RasterError::Unusable { path: path.to_owned(), reason };
        let (lattice, col, row) = Lattice::of(&header.geotransform, PHASE_BITS)
            .ok_or_else(|| unusable("the raster's grid is not north-up".to_owned()))?;
        let window = LatticeWindow {
            col,
            row,
            width: header.width as usize,
            height: header.height as usize,
        };
        let stated = header
            .vertical_unit
            .as_ref()
            .map(|(unit, _)| *unit)
            .or_else(|| spec.vertical.as_ref().and_then(|vertical| vertical.unit));
        let mut warnings = header.warnings.clone();
        warnings.extend(placement.warnings.iter().cloned());
        if stated.is_none()
            && let Some(unit) = spec.linear_unit.filter(|unit| *unit != LinearUnit::Metre)
        {
            warnings.push(format!(
                "{}: coordinates are in {unit}, and nothing says in what unit heights are; they are taken as metres",
                path.display()
            ));
        }
        let metres_per_height = stated.unwrap_or(LinearUnit::Metre).metres_per_unit();
        Ok(Self { store, placement, lattice, window, metres_per_height, warnings })
    }

    /// Values as the file gives them, for rasters that hold no heights (classes).
    #[must_use]
    pub fn without_unit(mut self) -> Self {
        self.metres_per_height = 1.0;
        self
    }

    /// The file's header.
    #[must_use]
    pub fn header(&self) -> &RasterHeader {
        self.store.header(0)
    }

    /// What the user should know about the file, its CRS and its unit.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The raster on an image grid, row-major, NaN where it has no data. A raster that lies on the
    /// grid already comes back as it is, bit for bit (where its heights are in metres).
    ///
    /// # Errors
    /// [`SingleRasterError`] when a block cannot be read, or one pixel covers too many cells.
    pub fn on_grid(
        &self,
        grid: &ImageGrid,
        resampling: Resampling,
        edge: EdgeRule,
    ) -> Result<Vec<f32>, SingleRasterError> {
        let (width, height) = (grid.width() as usize, grid.height() as usize);
        let mut out = vec![f32::NAN; width * height];
        if self.lies_on(grid) {
            self.store.read_window(0, 0, 0, width, height, &mut out)?;
            self.to_metres(&mut out);
            return Ok(out);
        }
        match self.warp(grid, resampling, edge, &mut out) {
            Ok(()) => Ok(out),
            // Where the CRS cannot express a position, the raster has no pixel.
            Err(WarpError::Crs(CrsError::Domain { .. })) => {
                out.fill(f32::NAN);
                Ok(out)
            }
            Err(WarpError::Raster(source)) => Err(source.into()),
            Err(source) => {
                Err(SingleRasterError::Warp { path: self.header().path.clone(), source })
            }
        }
    }

    fn warp(
        &self,
        grid: &ImageGrid,
        resampling: Resampling,
        edge: EdgeRule,
        out: &mut [f32],
    ) -> Result<(), WarpError> {
        let exact = PixelToCrs::WebMercator {
            grid: *grid,
            projection: Arc::clone(&self.placement.projection),
        };
        let map = PixelMap::fit(exact, self.lattice, TransformForm::Chebyshev)?;
        let form = [TransformForm::Affine, TransformForm::Separable, TransformForm::Chebyshev]
            .into_iter()
            .find(|form| {
                map.errors().of(*form) * self.placement.metres_per_unit <= TRANSFORM_BUDGET_M
            })
            .unwrap_or(TransformForm::Exact);
        let map = if form == TransformForm::Chebyshev { map } else { map.with_form(form)? };
        let settings = WarpSettings {
            resampling,
            edge,
            metres_per_unit: self.metres_per_height,
            horizontal_bound: TRANSFORM_BUDGET_M / self.placement.metres_per_unit,
        };
        warp(&map, self, &settings, out, None)?;
        Ok(())
    }

    /// The whole raster on its own grid, row-major, NaN where it has no data.
    ///
    /// # Errors
    /// [`SingleRasterError`] when a block cannot be read.
    pub fn whole(&self) -> Result<Vec<f32>, SingleRasterError> {
        let (width, height) = (self.window.width, self.window.height);
        let mut out = vec![f32::NAN; width * height];
        self.store.read_window(0, 0, 0, width, height, &mut out)?;
        self.to_metres(&mut out);
        Ok(out)
    }

    /// How the raster lies on the globe.
    #[must_use]
    pub const fn placement(&self) -> &Placement {
        &self.placement
    }

    fn to_metres(&self, heights: &mut [f32]) {
        if self.metres_per_height != 1.0 {
            for value in heights {
                *value = (f64::from(*value) * self.metres_per_height) as f32;
            }
        }
    }

    /// Whether the raster's pixels are the grid's.
    fn lies_on(&self, grid: &ImageGrid) -> bool {
        let header = self.header();
        let corners = |grid: &GeoTransform, width: u32, height: u32| {
            let at = |x: f64, y: f64| grid.to_projected(PixelPoint { x, y });
            [at(0.0, 0.0), at(f64::from(width), f64::from(height))]
        };
        let own = corners(&header.geotransform, header.width, header.height);
        let target = grid.geotransform();
        let pixel = target.0[1];
        self.placement.web_mercator
            && (header.width, header.height) == (grid.width(), grid.height())
            && own.iter().zip(corners(&target, grid.width(), grid.height())).all(|(a, b)| {
                (a.x - b.x).abs() < ON_GRID_PX * pixel && (a.y - b.y).abs() < ON_GRID_PX * pixel
            })
    }
}

impl WindowSource for SingleRaster {
    fn extent(&self) -> LatticeWindow {
        self.window
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        ids: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        let (col, row) = (window.col - self.window.col, window.row - self.window.row);
        self.store.read_window(0, col, row, window.width, window.height, out)?;
        if let Some(ids) = ids {
            for (id, value) in ids.iter_mut().zip(out.iter()) {
                *id = if value.is_nan() { u16::MAX } else { 0 };
            }
        }
        Ok(())
    }
}

/// West, south, east, north of a raster from its corners; `None` where they cannot be placed.
fn bounds(header: &RasterHeader, projection: &dyn Projection) -> Option<[f64; 4]> {
    let (width, height) = (f64::from(header.width), f64::from(header.height));
    let mut area = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    for (x, y) in [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)] {
        let at = header.geotransform.to_projected(PixelPoint { x, y });
        let LonLat { lon_deg, lat_deg } = projection.inverse(at).ok()?;
        area[0] = area[0].min(lon_deg);
        area[1] = area[1].min(lat_deg);
        area[2] = area[2].max(lon_deg);
        area[3] = area[3].max(lat_deg);
    }
    area.iter().all(|v| v.is_finite()).then_some(area)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests;
