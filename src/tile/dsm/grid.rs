//! Where the pixels of a DSM lie: on the city's own grid, or north-up in another CRS.

use super::DsmError;
use crate::crs::{CrsError, CrsSpec, Projection};
use crate::footprint::GroundGrid;
use crate::grid::{GeoTransform, PixelPoint, Projected};
use crate::lidar::{
    EdgeRule, Lattice, LatticeWindow, PHASE_BITS, PixelMap, PixelToCrs, Placement, Resampling,
    TransformForm, WarpSettings, WindowSource, warp,
};
use crate::raster::RasterError;
use crate::tile::city::City;
use crate::tile::slabs::Slabs;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Columns of one piece of a warped band: small enough that a polynomial serves for the projection.
const BLOCK: u32 = 256;
/// Displacement that a polynomial in the place of one projection per pixel may cause, metres.
pub const TRANSFORM_BUDGET_M: f64 = 1e-6;
/// Positions on each side of the city from which its extent in another CRS is taken.
const SIDE_POINTS: u32 = 256;
/// An extent that reaches less than this into a further pixel does not get it.
const PIXEL_SLACK: f64 = 1e-6;
/// Pixels to each side of the centre over which the size of a pixel is measured.
const STEP_PX: f64 = 8.0;

/// The grid of a DSM and the way to its heights.
#[derive(Debug)]
pub struct DsmGrid {
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// From its pixels to the CRS; without a CRS, to metres from the north-west corner.
    pub geotransform: GeoTransform,
    /// The CRS; `None` where the city's place is not known.
    pub crs: Option<CrsSpec>,
    /// Ground metres per pixel, across and down, at the centre.
    pub gsd_m: [f64; 2],
    /// What the user should know.
    pub warnings: Vec<String>,
    warp: Option<Warp>,
}

impl DsmGrid {
    /// The grid of a city's DSM: its own, or one in `t_srs`.
    ///
    /// A grid in another CRS is north-up and covers the city. Its pixels are squares on the ground at the city's
    /// centre, as large as the city's own (the geometric mean of across and down), so there are about as many;
    /// in degrees they are therefore higher than wide. The north-west corner is that of the city's extent.
    /// The CRS that the city has already changes nothing.
    ///
    /// # Errors
    /// [`DsmError::NoPlace`] for `t_srs` of a city without a place, [`DsmError::Vertical`] for a compound CRS,
    /// [`DsmError::Crs`] for a CRS that this build cannot serve or that is undefined there.
    pub fn new(city: &City, t_srs: Option<&CrsSpec>) -> Result<Self, DsmError> {
        let Some(own) = city.grid() else {
            return match t_srs {
                Some(_) => Err(DsmError::NoPlace),
                None => Ok(Self::without_place(city)),
            };
        };
        match t_srs {
            Some(crs) if crs.vertical.is_some() => Err(DsmError::Vertical { crs: crs.label() }),
            Some(crs) if crs.epsg.is_none() || crs.epsg != own.crs.epsg => {
                let wrong = |source| DsmError::Crs { crs: crs.label(), source };
                Self::warped(city, &own, crs).map_err(wrong)
            }
            _ => Ok(Self::own(city, own)),
        }
    }

    fn own(city: &City, own: GroundGrid) -> Self {
        Self {
            size_px: own.size_px,
            geotransform: own.geotransform,
            warnings: no_code(&own.crs),
            crs: Some(own.crs),
            gsd_m: city.gsd_m(),
            warp: None,
        }
    }

    fn without_place(city: &City) -> Self {
        let gsd_m = city.gsd_m();
        let warning = "the picture's place is not known: the DSM has no CRS, and metres from the north-west corner";
        Self {
            size_px: city.size,
            geotransform: GeoTransform::north_up(0.0, 0.0, gsd_m[0], gsd_m[1]),
            crs: None,
            gsd_m,
            warnings: vec![warning.to_owned()],
            warp: None,
        }
    }

    fn warped(city: &City, own: &GroundGrid, crs: &CrsSpec) -> Result<Self, CrsError> {
        let [width, height] = own.size_px.map(f64::from);
        let source = Placement::of(&own.crs, None)?;
        // Which datum operation is best hangs on where the city lies.
        let mut area = Extent::EMPTY;
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.5)] {
            let pixel = PixelPoint { x: u * width, y: v * height };
            let at = source.projection.inverse(own.geotransform.to_projected(pixel))?;
            area.add(at.lon_deg, at.lat_deg);
        }
        let area = Some([area.west, area.south, area.east, area.north]);
        let (from, to) = (Placement::of(&own.crs, area)?, Placement::of(crs, area)?);
        let place = |x: f64, y: f64| {
            let at = own.geotransform.to_projected(PixelPoint { x, y });
            to.projection.forward(from.projection.inverse(at)?)
        };

        let mut extent = Extent::EMPTY;
        for k in 0..=SIDE_POINTS {
            let t = f64::from(k) / f64::from(SIDE_POINTS);
            let (x, y) = (t * width, t * height);
            for at in [place(x, 0.0)?, place(x, height)?, place(0.0, y)?, place(width, y)?] {
                extent.add(at.x, at.y);
            }
        }
        let side = (city.gsd_m()[0] * city.gsd_m()[1]).sqrt();
        let [pixel_width, pixel_height] = pixel_size(city, &place, [width, height], side)?;
        let size = |length: f64, pixel: f64| ((length / pixel - PIXEL_SLACK).ceil()).max(1.0);
        let size = [
            size(extent.east - extent.west, pixel_width),
            size(extent.north - extent.south, pixel_height),
        ];
        let lattice = Lattice::of(&own.geotransform, PHASE_BITS);
        let sound = size.iter().all(|pixels| *pixels < f64::from(i32::MAX));
        let Some((lattice, col, row)) = lattice.filter(|_| sound) else {
            return Err(CrsError::Domain {
                projection: crs.label(),
                what: "the whole of the city (its extent there is not finite)".to_owned(),
            });
        };
        let geotransform =
            GeoTransform::north_up(extent.west, extent.north, pixel_width, pixel_height);
        let warnings = [no_code(crs), from.warnings, to.warnings].concat();
        let window = LatticeWindow { col, row, width: width as usize, height: height as usize };
        Ok(Self {
            size_px: size.map(|pixels| pixels as u32),
            geotransform,
            crs: Some(crs.clone()),
            gsd_m: [side; 2],
            warnings,
            warp: Some(Warp {
                from: to.projection,
                to: from.projection,
                metres_per_unit: from.metres_per_unit,
                lattice,
                window,
            }),
        })
    }

    /// Whether the grid is the city's own.
    #[must_use]
    pub const fn is_own(&self) -> bool {
        self.warp.is_none()
    }

    /// Heights of some rows, metres, row-major: the slabs' own bits on the city's grid, bilinear with GDAL's
    /// rules elsewhere ([`crate::lidar::Resampling`]); NaN where there is no surface.
    ///
    /// # Errors
    /// [`DsmError::Slabs`] for a slab that cannot be read, [`DsmError::Warp`].
    pub fn rows(&self, slabs: &Slabs<'_>, rows: Range<u32>) -> Result<Vec<f32>, DsmError> {
        let width = self.size_px[0];
        let Some(warp) = &self.warp else {
            return slabs.heights([0..width, rows]).map_err(|source| DsmError::Slabs { source });
        };
        let starts: Vec<u32> = (0..width).step_by(BLOCK as usize).collect();
        let block = |&start: &u32| {
            let columns = start..(start + BLOCK).min(width);
            warp.block(&self.geotransform, slabs, [columns, rows.clone()])
        };
        let blocks: Vec<Vec<f32>> = starts.par_iter().map(block).collect::<Result<_, _>>()?;
        let mut out = Vec::with_capacity(width as usize * rows.len());
        for row in 0..rows.len() {
            for block in &blocks {
                let columns = block.len() / rows.len();
                out.extend_from_slice(&block[row * columns..][..columns]);
            }
        }
        Ok(out)
    }
}

/// Width and height of a square of `side` metres on the ground at the city's centre, in units of the CRS to
/// which `place` leads.
fn pixel_size(
    city: &City,
    place: &impl Fn(f64, f64) -> Result<Projected, CrsError>,
    [width, height]: [f64; 2],
    side: f64,
) -> Result<[f64; 2], CrsError> {
    let (x, y) = (width / 2.0, height / 2.0);
    let step =
        |a: Projected, b: Projected| [(b.x - a.x) / (2.0 * STEP_PX), (b.y - a.y) / (2.0 * STEP_PX)];
    // CRS units per pixel of the city's own, across and down.
    let [ax, ay] = step(place(x - STEP_PX, y)?, place(x + STEP_PX, y)?);
    let [dx, dy] = step(place(x, y - STEP_PX)?, place(x, y + STEP_PX)?);
    let area = ax * dy - ay * dx;
    let [across_m, down_m] = city.gsd_m();
    // Ground metres per CRS unit, along each of its axes, by the inverse.
    let east = libm::hypot(dy * across_m, ay * down_m) / area.abs();
    let north = libm::hypot(dx * across_m, ax * down_m) / area.abs();
    Ok([side / east, side / north])
}

fn no_code(crs: &CrsSpec) -> Vec<String> {
    let warning =
        || format!("the CRS {} has no EPSG code: the DSM has its coordinates and no CRS", crs.name);
    if crs.epsg.is_none() { vec![warning()] } else { Vec::new() }
}

/// A box in a CRS.
#[derive(Clone, Copy, Debug)]
struct Extent {
    west: f64,
    south: f64,
    east: f64,
    north: f64,
}

impl Extent {
    const EMPTY: Self = Self {
        west: f64::INFINITY,
        south: f64::INFINITY,
        east: f64::NEG_INFINITY,
        north: f64::NEG_INFINITY,
    };

    fn add(&mut self, x: f64, y: f64) {
        (self.west, self.east) = (self.west.min(x), self.east.max(x));
        (self.south, self.north) = (self.south.min(y), self.north.max(y));
    }
}

/// From a grid in another CRS to the city's own.
#[derive(Debug)]
struct Warp {
    /// Between WGS 84 and the DSM's CRS.
    from: Arc<dyn Projection>,
    /// Between WGS 84 and the city's CRS.
    to: Arc<dyn Projection>,
    /// Metres per unit of the city's CRS.
    metres_per_unit: f64,
    /// The city's own pixels.
    lattice: Lattice,
    window: LatticeWindow,
}

impl Warp {
    fn block(
        &self,
        grid: &GeoTransform,
        slabs: &Slabs<'_>,
        [columns, rows]: [Range<u32>; 2],
    ) -> Result<Vec<f32>, DsmError> {
        let wrong = |source: CrsError| DsmError::Warp { source: source.into() };
        let corner = PixelPoint { x: f64::from(columns.start), y: f64::from(rows.start) };
        let corner = grid.to_projected(corner);
        let exact = PixelToCrs::Raster {
            geotransform: GeoTransform::north_up(corner.x, corner.y, grid.0[1], -grid.0[5]),
            width: columns.len() as u32,
            height: rows.len() as u32,
            from: Arc::clone(&self.from),
            to: Arc::clone(&self.to),
        };
        let map = PixelMap::fit(exact, self.lattice, TransformForm::Chebyshev).map_err(wrong)?;
        // So written that NaN is exact too.
        let near = map.errors().chebyshev * self.metres_per_unit <= TRANSFORM_BUDGET_M;
        let map = if near { map } else { map.with_form(TransformForm::Exact).map_err(wrong)? };
        let settings = WarpSettings {
            resampling: Resampling::Bilinear,
            edge: EdgeRule::Renormalise,
            metres_per_unit: 1.0,
            horizontal_bound: 0.0,
        };
        let mut out = vec![f32::NAN; columns.len() * rows.len()];
        let source = Source { slabs, window: self.window };
        warp(&map, &source, &settings, &mut out, None)
            .map_err(|source| DsmError::Warp { source })?;
        Ok(out)
    }
}

/// The slabs as cells of the city's lattice.
struct Source<'a> {
    slabs: &'a Slabs<'a>,
    window: LatticeWindow,
}

impl WindowSource for Source<'_> {
    fn extent(&self) -> LatticeWindow {
        self.window
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        _: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        out.fill(f32::NAN);
        let Some(part) = window.intersection(&self.window) else { return Ok(()) };
        // Inside the city, whose sides are 32-bit numbers.
        let inside = |from: i64, to: i64, first: i64| (from - first) as u32..(to - first) as u32;
        let columns = inside(part.col, part.right(), self.window.col);
        let rows = inside(part.row, part.bottom(), self.window.row);
        let heights = self.slabs.heights([columns, rows]).map_err(|source| {
            let path = self.slabs.out.join(crate::tile::slabs::FOLDER);
            RasterError::Io { path, source }
        })?;
        let (left, top) = ((part.col - window.col) as usize, (part.row - window.row) as usize);
        for (row, heights) in heights.chunks_exact(part.width).enumerate() {
            out[(top + row) * window.width + left..][..part.width].copy_from_slice(heights);
        }
        Ok(())
    }
}
