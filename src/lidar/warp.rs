//! Warping a source onto an image grid, block by block, in bounded memory.

use super::resample::{Cells, EdgeRule, Holes, Kernel, Resampling, bilinear_row};
use super::{LatticeWindow, PixelMap};
use crate::crs::CrsError;
use crate::raster::RasterError;

/// Cells that are read window by window: one tile, or several on one lattice.
pub trait WindowSource {
    /// The lattice cells outside of which everything is NaN.
    fn extent(&self) -> LatticeWindow;

    /// Fills `out` (row-major) with a window; NaN where there is no data. With `ids`, also says of
    /// each cell which tile it came from (`u16::MAX` for none).
    ///
    /// # Errors
    /// [`RasterError`] naming the file.
    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        ids: Option<&mut [u16]>,
    ) -> Result<(), RasterError>;
}

/// How a source is warped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarpSettings {
    /// Kernel.
    pub resampling: Resampling,
    /// Rule at the border of valid data.
    pub edge: EdgeRule,
    /// Metres per unit of the source's heights.
    pub metres_per_unit: f64,
    /// Horizontal bound of all steps, CRS units: within it of a no-data edge, validity is uncertain.
    pub horizontal_bound: f64,
}

/// What was seen while warping.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpStatistics {
    /// Pixels with a value.
    pub valid: u64,
    /// Pixels for which the no-data cells around them decide, within the horizontal bound, whether
    /// they have a value, or by which rule.
    pub uncertain: u64,
    /// Steepest gradient between neighbouring source cells within the horizontal bound of the
    /// footprint, height units per CRS unit (columns and rows combined). Beside no-data, where
    /// weights are renormalised, twice the range of the valid cells among four stands for a step.
    pub steepest: f64,
    /// How much steeper than that the interpolated surface can be; `None` where it has steps.
    pub slope_factor: Option<f64>,
}

/// Why a warp failed.
#[derive(Debug, thiserror::Error)]
pub enum WarpError {
    /// A tile cannot be read.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// The projection is undefined in the image.
    #[error(transparent)]
    Crs(#[from] CrsError),
    /// One pixel covers more source cells than fit the memory set aside for a window.
    #[error(
        "one image pixel covers {cells} lidar cells, more than the {limit} that a window may hold: the zoom is too coarse for these tiles; build the benchmark from a coarser raster (for example gdalwarp -tr) or use a higher zoom"
    )]
    TooCoarse {
        /// Cells under one pixel.
        cells: u64,
        /// Cells that a window may hold.
        limit: usize,
    },
}

/// Most cells in one window: 16 MiB of `f32`.
const MAX_WINDOW_CELLS: usize = 1 << 22;
/// Pixel rows warped at a time: few enough that coordinates and cells stay in the cache.
const BLOCK_ROWS: u32 = 32;

/// A rectangle of image pixels.
#[derive(Clone, Copy, Debug)]
struct Block {
    x0: u32,
    x1: u32,
    y0: u32,
    y1: u32,
}

/// Warps `source` onto the image of `map`: `out` receives one height in metres per pixel, row-major,
/// NaN where there is none; `ids`, when given, the tile of each pixel's own cell.
///
/// # Errors
/// [`WarpError`]; `out` is then unspecified.
pub fn warp(
    map: &PixelMap,
    source: &dyn WindowSource,
    settings: &WarpSettings,
    out: &mut [f32],
    mut ids: Option<&mut [u16]>,
) -> Result<WarpStatistics, WarpError> {
    let (width, height) = map.size();
    debug_assert_eq!(out.len(), width as usize * height as usize);
    let lattice = map.lattice();
    let flip = |pixel: f64| settings.horizontal_bound / pixel;
    let kernel = Kernel::new(
        settings.resampling,
        settings.edge,
        map.cells_per_pixel()?,
        (flip(lattice.pixel_width), flip(lattice.pixel_height)),
    );
    let mut job = Job {
        map,
        source,
        kernel,
        metres_per_unit: settings.metres_per_unit,
        scratch: Scratch::default(),
        statistics: WarpStatistics::default(),
        slope: (0.0, 0.0),
        least_width: f64::INFINITY,
    };
    let mut blocks: Vec<Block> = (0..height)
        .step_by(BLOCK_ROWS as usize)
        .map(|y0| Block { x0: 0, x1: width, y0, y1: (y0 + BLOCK_ROWS).min(height) })
        .rev()
        .collect();
    while let Some(block) = blocks.pop() {
        if let Some([first, second]) = job.block(block, out, ids.as_deref_mut())? {
            blocks.push(second);
            blocks.push(first);
        }
    }
    let mut statistics = job.statistics;
    statistics.steepest =
        libm::hypot(job.slope.0 / lattice.pixel_width, job.slope.1 / lattice.pixel_height);
    statistics.slope_factor = job.kernel.slope_factor(job.least_width);
    statistics.valid = out.iter().filter(|v| !v.is_nan()).count() as u64;
    Ok(statistics)
}

/// Buffers kept between blocks.
#[derive(Default)]
struct Scratch {
    cols: Vec<f64>,
    rows: Vec<f64>,
    cells: Vec<f32>,
    ids: Vec<u16>,
    holes: Holes,
}

struct Job<'a> {
    map: &'a PixelMap,
    source: &'a dyn WindowSource,
    kernel: Kernel,
    metres_per_unit: f64,
    scratch: Scratch,
    statistics: WarpStatistics,
    /// Largest step between neighbouring cells, along columns and rows.
    slope: (f64, f64),
    /// Shortest side of a box that was averaged, cells.
    least_width: f64,
}

impl Job<'_> {
    /// Warps one block, or says into which two it must be cut.
    fn block(
        &mut self,
        block: Block,
        out: &mut [f32],
        ids: Option<&mut [u16]>,
    ) -> Result<Option<[Block; 2]>, WarpError> {
        let image_width = self.map.size().0 as usize;
        let average = self.kernel.resampling == Resampling::Average;
        self.coordinates(block, average)?;
        let window = self.window();
        let Some(window) = window.filter(|w| w.intersection(&self.source.extent()).is_some())
        else {
            for y in block.y0..block.y1 {
                let line = y as usize * image_width;
                out[line + block.x0 as usize..line + block.x1 as usize].fill(f32::NAN);
            }
            if let Some(ids) = ids {
                for y in block.y0..block.y1 {
                    let line = y as usize * image_width;
                    ids[line + block.x0 as usize..line + block.x1 as usize].fill(u16::MAX);
                }
            }
            return Ok(None);
        };
        let area = window.width as u64 * window.height as u64;
        if area > MAX_WINDOW_CELLS as u64 {
            return split(block)
                .map(Some)
                .ok_or(WarpError::TooCoarse { cells: area, limit: MAX_WINDOW_CELLS });
        }
        let Scratch { cells, ids: cell_ids, .. } = &mut self.scratch;
        cells.clear();
        cells.resize(area as usize, f32::NAN);
        if ids.is_some() {
            cell_ids.clear();
            cell_ids.resize(area as usize, u16::MAX);
        }
        self.source.read(window, cells, ids.is_some().then_some(&mut cell_ids[..]))?;
        self.measure_slope(window);
        self.fill(block, window, out, ids);
        Ok(None)
    }

    /// Coordinates of every pixel of a block: centres, or corners (one more each way) for averages.
    fn coordinates(&mut self, block: Block, corners: bool) -> Result<(), WarpError> {
        let (extra, offset) = if corners { (1, 0.0) } else { (0, 0.5) };
        let Scratch { cols, rows, .. } = &mut self.scratch;
        cols.clear();
        rows.clear();
        for y in block.y0..block.y1 + extra {
            self.map.fill_row(y, block.x0..block.x1 + extra, offset, cols, rows)?;
        }
        Ok(())
    }

    /// The cells that the block's kernel touches; `None` if a coordinate is not finite.
    fn window(&self) -> Option<LatticeWindow> {
        // Beyond 2^52 neighbouring cells could not be told apart.
        let range = |values: &[f64]| {
            let (low, high) = extremes(values);
            (low.abs() < 4.5e15 && high.abs() < 4.5e15).then_some((low, high))
        };
        let (left, right) = range(&self.scratch.cols)?;
        let (top, bottom) = range(&self.scratch.rows)?;
        let (margin_x, margin_y) = self.kernel.margin();
        let col = left.floor() as i64 - margin_x;
        let row = top.floor() as i64 - margin_y;
        Some(LatticeWindow {
            col,
            row,
            width: (right.floor() as i64 + margin_x + 1 - col) as usize,
            height: (bottom.floor() as i64 + margin_y + 1 - row) as usize,
        })
    }

    fn measure_slope(&mut self, window: LatticeWindow) {
        let cells = &self.scratch.cells;
        for line in cells.chunks_exact(window.width) {
            self.slope.0 = self.slope.0.max(f64::from(steepest_step(line, &line[1..])));
        }
        self.slope.1 = self.slope.1.max(f64::from(steepest_step(cells, &cells[window.width..])));
        if matches!(self.kernel.resampling, Resampling::Bilinear | Resampling::Cubic) {
            let beside = 2.0 * f64::from(range_beside_holes(cells, window.width));
            self.slope = (self.slope.0.max(beside), self.slope.1.max(beside));
        }
    }

    fn fill(
        &mut self,
        block: Block,
        window: LatticeWindow,
        out: &mut [f32],
        mut ids: Option<&mut [u16]>,
    ) {
        let image_width = self.map.size().0 as usize;
        let LatticeWindow { col, row, width, height } = window;
        let far = self.kernel.reaches_far();
        if far {
            let Scratch { cells: data, holes, .. } = &mut self.scratch;
            holes.count(&Cells { data, col, row, width, height });
        }
        let scratch = &self.scratch;
        let cells = Cells { data: &scratch.cells, col, row, width, height };
        let columns = (block.x1 - block.x0) as usize;
        let average = self.kernel.resampling == Resampling::Average;
        let stride = columns + usize::from(average);
        for (k, y) in (block.y0..block.y1).enumerate() {
            let line = y as usize * image_width + block.x0 as usize;
            let out = &mut out[line..line + columns];
            let points = k * stride..k * stride + stride;
            let (xs, ys) = (&scratch.cols[points.clone()], &scratch.rows[points.clone()]);
            let mut uncertain = 0;
            if average {
                let next = points.start + stride..points.end + stride;
                let (next_xs, next_ys) = (&scratch.cols[next.clone()], &scratch.rows[next]);
                for (x, out) in out.iter_mut().enumerate() {
                    let sample = self.kernel.average(
                        &cells,
                        (xs[x], ys[x]),
                        (next_xs[x + 1], next_ys[x + 1]),
                    );
                    uncertain += u32::from(sample.flips);
                    let sides = (next_xs[x + 1] - xs[x]).abs().min((next_ys[x + 1] - ys[x]).abs());
                    self.least_width = self.least_width.min(sides);
                    *out = (sample.value * self.metres_per_unit) as f32;
                }
            } else if self.kernel.is_plain_bilinear() {
                uncertain = bilinear_row(&self.kernel, &cells, xs, ys, self.metres_per_unit, out);
            } else {
                for ((out, &x), &y) in out.iter_mut().zip(xs).zip(ys) {
                    let sample = self.kernel.at_point(&cells, x, y);
                    uncertain += u32::from(sample.flips);
                    *out = (sample.value * self.metres_per_unit) as f32;
                }
            }
            if far {
                let far_corner = |x: usize| {
                    let k = points.start + x + if average { stride + 1 } else { 0 };
                    (scratch.cols[k], scratch.rows[k])
                };
                let flips = |x: &usize| {
                    self.kernel.flips_far(&scratch.holes, (xs[*x], ys[*x]), far_corner(*x))
                };
                uncertain = (0..columns).filter(flips).count() as u32;
            }
            self.statistics.uncertain += u64::from(uncertain);
            if let Some(ids) = ids.as_deref_mut() {
                let half = if average { 0.5 } else { 0.0 };
                for (x, id) in ids[line..line + columns].iter_mut().enumerate() {
                    let c = ((xs[x] + half).floor() as i64 - col) as usize;
                    let r = ((ys[x] + half).floor() as i64 - row) as usize;
                    let cell = if out[x].is_nan() { None } else { scratch.ids.get(r * width + c) };
                    *id = cell.copied().unwrap_or(u16::MAX);
                }
            }
        }
    }
}

/// Values compared side by side, so that no comparison waits for the one before.
const LANES: usize = 8;

/// Lowest and highest of some finite values; not finite if one is not.
fn extremes(values: &[f64]) -> (f64, f64) {
    let (mut low, mut high) = ([f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]);
    // A NaN or an infinity makes its lane's sum NaN for good.
    let mut poison = [0.0_f64; LANES];
    for group in values.chunks(LANES) {
        for (lane, &value) in group.iter().enumerate() {
            low[lane] = if value < low[lane] { value } else { low[lane] };
            high[lane] = if value > high[lane] { value } else { high[lane] };
            poison[lane] += 0.0 * value;
        }
    }
    let poison: f64 = poison.iter().sum();
    (
        low.into_iter().fold(f64::INFINITY, f64::min) + poison,
        high.into_iter().fold(f64::NEG_INFINITY, f64::max) + poison,
    )
}

/// Largest absolute difference of cells in the same place; a step into a hole is no step, because
/// comparisons with NaN are false.
fn steepest_step(a: &[f32], b: &[f32]) -> f32 {
    let mut top = [0.0_f32; LANES];
    for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
        for (lane, (a, b)) in a.iter().zip(b).enumerate() {
            let step = (a - b).abs();
            top[lane] = if step > top[lane] { step } else { top[lane] };
        }
    }
    top.into_iter().fold(0.0, f32::max)
}

/// Largest range of the valid cells among 2 x 2, of which some have data and some have none.
fn range_beside_holes(cells: &[f32], width: usize) -> f32 {
    let mut top: f32 = 0.0;
    for (above, below) in cells.chunks_exact(width).zip(cells[width..].chunks_exact(width)) {
        for (a, b) in above.windows(2).zip(below.windows(2)) {
            let four = [a[0], a[1], b[0], b[1]];
            // The sum is NaN if one is; with none or one left, the range is 0 or below.
            if four.iter().sum::<f32>().is_nan() {
                let (low, high) = four
                    .iter()
                    .filter(|v| !v.is_nan())
                    .fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
                top = top.max(high - low);
            }
        }
    }
    top
}

/// Cuts a block across its longer side; a single pixel cannot be cut.
fn split(block: Block) -> Option<[Block; 2]> {
    let (width, height) = (block.x1 - block.x0, block.y1 - block.y0);
    if width.max(height) < 2 {
        return None;
    }
    Some(if width >= height {
        let x = block.x0 + width / 2;
        [Block { x1: x, ..block }, Block { x0: x, ..block }]
    } else {
        let y = block.y0 + height / 2;
        [Block { y1: y, ..block }, Block { y0: y, ..block }]
    })
}

#[cfg(test)]
mod tests;
