//! Resampling kernels with GDAL's rules, NaN-aware.
//!
//! The rules, as `gdalwarp` 3.6 applies them (measured against it in `tests/suite/gdalwarp_parity.rs`):
//!
//! * `nearest`: the cell that holds the point.
//! * `bilinear`: the point's own cell must be valid; then the four taps, weights renormalised over
//!   the valid ones.
//! * `cubic` (Keys, a = -0.5): sixteen taps; where one is invalid, bilinear.
//! * `average`: the mean of the valid cells under the pixel, weighted by coverage along each axis;
//!   the pixel is the box between its projected north-west and south-east corners.
//! * Where the target is coarser than the source by more than 1/0.95, the bilinear and cubic
//!   kernels are widened by the ratio, weights renormalised over the valid cells.
//!
//! Arithmetic is `f64`; NaN means invalid throughout.

use serde::{Deserialize, Serialize};

/// Which kernel takes source cells to a target pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resampling {
    /// The cell that holds the point.
    Nearest,
    /// Four taps.
    Bilinear,
    /// Sixteen taps, Keys' cubic convolution.
    Cubic,
    /// Area-weighted mean.
    Average,
}

impl Resampling {
    /// Name on the command line, as GDAL's `-r`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Bilinear => "bilinear",
            Self::Cubic => "cubic",
            Self::Average => "average",
        }
    }

    /// Cells to each side of a point that the unwidened kernel touches.
    const fn radius(self) -> f64 {
        match self {
            Self::Nearest | Self::Average => 0.0,
            Self::Bilinear => 1.0,
            Self::Cubic => 2.0,
        }
    }
}

/// What happens at the border of valid data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EdgeRule {
    /// GDAL's: weights are renormalised over the valid taps.
    #[default]
    Renormalise,
    /// Every tap with weight must be valid, else the pixel is NaN.
    Strict,
}

/// A window of source cells; NaN marks cells without data.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cells<'a> {
    pub data: &'a [f32],
    pub col: i64,
    pub row: i64,
    pub width: usize,
    pub height: usize,
}

impl Cells<'_> {
    /// The value of a lattice cell; NaN outside the window.
    fn at(&self, col: i64, row: i64) -> f64 {
        let (c, r) = (col - self.col, row - self.row);
        if c < 0 || r < 0 || c >= self.width as i64 || r >= self.height as i64 {
            return f64::NAN;
        }
        f64::from(self.data[r as usize * self.width + c as usize])
    }
}

/// How many cells of a window have no data, as sums over the rectangle north-west of each corner.
#[derive(Clone, Debug, Default)]
pub(super) struct Holes {
    col: i64,
    row: i64,
    width: usize,
    height: usize,
    sums: Vec<u32>,
}

impl Holes {
    /// Counts those of a window.
    pub fn count(&mut self, cells: &Cells<'_>) {
        let Cells { data, col, row, width, height } = *cells;
        (self.col, self.row, self.width, self.height) = (col, row, width, height);
        self.sums.clear();
        self.sums.resize((width + 1) * (height + 1), 0);
        for (r, line) in data.chunks_exact(width).enumerate() {
            let mut sum = 0;
            for (c, value) in line.iter().enumerate() {
                sum += u32::from(value.is_nan());
                self.sums[(r + 1) * (width + 1) + c + 1] = self.sums[r * (width + 1) + c + 1] + sum;
            }
        }
    }

    /// Whether a rectangle (first and last column, first and last row) holds both cells with data
    /// and cells without; beyond the window there are none.
    fn mixed(&self, cols: (i64, i64), rows: (i64, i64)) -> bool {
        let inside = |v: i64, origin: i64, size: usize| (v - origin).clamp(0, size as i64) as usize;
        let (left, right) =
            (inside(cols.0, self.col, self.width), inside(cols.1 + 1, self.col, self.width));
        let (top, bottom) =
            (inside(rows.0, self.row, self.height), inside(rows.1 + 1, self.row, self.height));
        let sum = |r: usize, c: usize| self.sums[r * (self.width + 1) + c];
        let holes = sum(bottom, right) + sum(top, left) - sum(top, right) - sum(bottom, left);
        let data = ((right - left) * (bottom - top)) as u32 - holes;
        let all = (cols.1 + 1 - cols.0) * (rows.1 + 1 - rows.0);
        data > 0 && i64::from(data) < all
    }
}

/// A kernel made ready for one image: its form, widening, and how near an edge is too near to tell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Kernel {
    pub resampling: Resampling,
    pub edge: EdgeRule,
    /// Source cells per target pixel along columns where the kernel is widened, else 1.
    widen_x: f64,
    widen_y: f64,
    widened: bool,
    /// Displacement that could flip a pixel's validity, in cells.
    flip_x: f64,
    flip_y: f64,
    /// Holes are counted around each point, because more than its own taps decide.
    far: bool,
}

/// What a kernel made of one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sample {
    /// Interpolated value or NaN.
    pub value: f64,
    /// What the no-data cells around the point decide would change within the horizontal bound
    /// (told for bounds under [`NEAR_CELLS`]; see [`Kernel::flips_far`]).
    pub flips: bool,
}

/// Reach, in cells, up to which the taps of a point show every cell that it could come to lie in.
pub(super) const NEAR_CELLS: f64 = 0.5;

/// What the cells without data make of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Support {
    /// No value.
    None,
    /// A value from a part of the taps: for `cubic`, the bilinear one.
    Part,
    /// A value as if there were no holes.
    Whole,
}

impl Kernel {
    pub fn new(
        resampling: Resampling,
        edge: EdgeRule,
        cells_per_pixel: (f64, f64),
        flip_cells: (f64, f64),
    ) -> Self {
        // GDAL keeps the plain four and sixteen taps down to 0.95 target pixels per cell.
        let wide = |cells: f64| cells > 1.0 / 0.95;
        let kernel_has_width = matches!(resampling, Resampling::Bilinear | Resampling::Cubic);
        let widened = kernel_has_width && (wide(cells_per_pixel.0) || wide(cells_per_pixel.1));
        let ratio = |cells: f64| if widened { cells.max(1.0) } else { 1.0 };
        let flip = flip_cells.0.max(flip_cells.1);
        let average = resampling == Resampling::Average;
        let far = flip >= NEAR_CELLS
            || (edge == EdgeRule::Strict && (widened || average))
            || (average && 4.0 * flip > cells_per_pixel.0.min(cells_per_pixel.1));
        Self {
            resampling,
            edge,
            far,
            widen_x: ratio(cells_per_pixel.0),
            widen_y: ratio(cells_per_pixel.1),
            widened,
            flip_x: flip_cells.0,
            flip_y: flip_cells.1,
        }
    }

    /// Cells needed beyond the points' bounding box, per axis: those that the kernel touches
    /// wherever within the horizontal bound a point may be.
    pub fn margin(&self) -> (i64, i64) {
        let cells = |ratio: f64, flip: f64| {
            (self.resampling.radius() * ratio).ceil() as i64 + (flip.ceil() as i64).max(1)
        };
        (cells(self.widen_x, self.flip_x), cells(self.widen_y, self.flip_y))
    }

    /// Largest slope of what is interpolated over the largest slope between neighbouring cells:
    /// 1 for bilinear; 2 where it is widened (normalised tents ripple: 1.95 at a ratio of 1.51);
    /// 2.5 for cubic (the sum over taps of |derivative| of Keys' kernel, in two dimensions, stays
    /// under that). A mean over `width` cells passes `1 / width` steps per cell, and one more where
    /// it ends within a cell. `None` where the surface has steps (nearest).
    pub fn slope_factor(&self, width: f64) -> Option<f64> {
        match self.resampling {
            Resampling::Nearest => None,
            Resampling::Bilinear if self.widened => Some(2.0),
            Resampling::Bilinear => Some(1.0),
            Resampling::Cubic => Some(2.5),
            Resampling::Average => Some(1.0 + 1.0 / width),
        }
    }

    /// Whether holes must be counted around each point ([`Self::flips_far`]): the horizontal bound is
    /// large, or a whole support decides whether there is a value.
    pub fn reaches_far(&self) -> bool {
        self.far
    }

    /// Whether every pixel takes the quick path of [`bilinear_row`].
    pub fn is_plain_bilinear(&self) -> bool {
        self.resampling == Resampling::Bilinear && !self.widened
    }

    /// The value at a point (every kernel but `average`).
    pub fn at_point(&self, cells: &Cells<'_>, x: f64, y: f64) -> Sample {
        let (col, row) = (x.floor() as i64, y.floor() as i64);
        let own = cells.at(col, row);
        let flips = self.flips_near(cells, x, y);
        let value = if own.is_nan() {
            f64::NAN
        } else {
            match self.resampling {
                Resampling::Nearest | Resampling::Average => own,
                _ if self.widened => self.wide(cells, x, y),
                Resampling::Bilinear => self.bilinear(cells, x, y),
                Resampling::Cubic => {
                    let value = cubic(cells, x, y);
                    match self.edge {
                        EdgeRule::Renormalise if value.is_nan() => self.bilinear(cells, x, y),
                        _ => value,
                    }
                }
            }
        };
        Sample { value, flips }
    }

    /// Whether what the no-data cells make of a point changes within a bound under [`NEAR_CELLS`].
    /// It can only where a border or a middle of a cell is that near.
    fn flips_near(&self, cells: &Cells<'_>, x: f64, y: f64) -> bool {
        let near = |v: f64, bound: f64| (2.0 * v - (2.0 * v).round()).abs() <= 2.0 * bound;
        if self.far || !(near(x, self.flip_x) || near(y, self.flip_y)) {
            return false;
        }
        let here = self.support(cells, x, y);
        [-1.0, 0.0, 1.0].into_iter().any(|j| {
            [-1.0, 0.0, 1.0]
                .into_iter()
                .any(|i| self.support(cells, x + i * self.flip_x, y + j * self.flip_y) != here)
        })
    }

    fn support(&self, cells: &Cells<'_>, x: f64, y: f64) -> Support {
        if cells.at(x.floor() as i64, y.floor() as i64).is_nan() {
            return Support::None;
        }
        let reach = self.resampling.radius() as i64;
        let matters = !self.widened
            && (self.edge == EdgeRule::Strict || self.resampling == Resampling::Cubic);
        if !matters || reach == 0 {
            return Support::Whole;
        }
        let (left, top) = ((x - 0.5).floor() as i64, (y - 0.5).floor() as i64);
        let whole = (top + 1 - reach..=top + reach)
            .all(|row| (left + 1 - reach..=left + reach).all(|col| !cells.at(col, row).is_nan()));
        match (whole, self.edge) {
            (true, _) => Support::Whole,
            (false, EdgeRule::Renormalise) => Support::Part,
            (false, EdgeRule::Strict) => Support::None,
        }
    }

    /// Whether the horizontal bound takes a point, or the box between two, both to cells with data
    /// and to cells without.
    pub fn flips_far(&self, holes: &Holes, a: (f64, f64), b: (f64, f64)) -> bool {
        let taps = match (self.edge, self.resampling) {
            (EdgeRule::Strict, _) | (_, Resampling::Cubic) => self.resampling.radius(),
            _ => 0.0,
        };
        let cells = |a: f64, b: f64, flip: f64, widen: f64| {
            let reach = flip + taps * widen;
            ((a.min(b) - reach).floor() as i64, (a.max(b) + reach).floor() as i64)
        };
        let (left, right) = cells(a.0, b.0, self.flip_x, self.widen_x);
        let (top, bottom) = cells(a.1, b.1, self.flip_y, self.widen_y);
        holes.mixed((left, right), (top, bottom))
    }

    fn bilinear(&self, cells: &Cells<'_>, x: f64, y: f64) -> f64 {
        let (left, top) = ((x - 0.5).floor(), (y - 0.5).floor());
        let (fx, fy) = (x - 0.5 - left, y - 0.5 - top);
        let (left, top) = (left as i64, top as i64);
        let taps = [
            (cells.at(left, top), (1.0 - fx) * (1.0 - fy)),
            (cells.at(left + 1, top), fx * (1.0 - fy)),
            (cells.at(left, top + 1), (1.0 - fx) * fy),
            (cells.at(left + 1, top + 1), fx * fy),
        ];
        self.weighted(taps)
    }

    /// Mean over valid taps, or NaN under the strict rule when one with weight is invalid.
    fn weighted(&self, taps: impl IntoIterator<Item = (f64, f64)>) -> f64 {
        let (mut sum, mut total) = (0.0, 0.0);
        for (value, weight) in taps {
            if !value.is_nan() {
                sum += value * weight;
                total += weight;
            } else if self.edge == EdgeRule::Strict && weight != 0.0 {
                return f64::NAN;
            }
        }
        // GDAL's threshold: cubic weights are negative in places and can cancel.
        if total < 1e-6 { f64::NAN } else { sum / total }
    }

    /// The widened kernel: taps weighted by the kernel at distance over ratio.
    fn wide(&self, cells: &Cells<'_>, x: f64, y: f64) -> f64 {
        let weight: fn(f64) -> f64 = match self.resampling {
            Resampling::Cubic => keys,
            _ => |d: f64| (1.0 - d.abs()).max(0.0),
        };
        let span = |v: f64, ratio: f64| {
            let first = (v - 0.5).floor();
            let radius = (self.resampling.radius() * ratio).ceil() as i64;
            let fraction = v - 0.5 - first;
            let first = first as i64;
            (1 - radius..=radius).map(move |i| (first + i, weight((i as f64 - fraction) / ratio)))
        };
        self.weighted(span(y, self.widen_y).flat_map(|(row, wy)| {
            span(x, self.widen_x).map(move |(col, wx)| (cells.at(col, row), wx * wy))
        }))
    }

    /// The mean under a pixel whose projected north-west and south-east corners are given.
    pub fn average(&self, cells: &Cells<'_>, a: (f64, f64), b: (f64, f64)) -> Sample {
        let (x0, x1) = (a.0.min(b.0), a.0.max(b.0));
        let (y0, y1) = (a.1.min(b.1), a.1.max(b.1));
        let value = self.box_mean(cells, (x0, x1), (y0, y1));
        let grown = |by: f64| {
            let (dx, dy) = (by * self.flip_x, by * self.flip_y);
            self.box_mean(
                cells,
                (x0 - dx, (x1 + dx).max(x0 - dx)),
                (y0 - dy, (y1 + dy).max(y0 - dy)),
            )
        };
        let flips = if value.is_nan() { !grown(1.0).is_nan() } else { grown(-1.0).is_nan() };
        Sample { value, flips }
    }

    fn box_mean(&self, cells: &Cells<'_>, (x0, x1): (f64, f64), (y0, y1): (f64, f64)) -> f64 {
        // A border within 1e-10 cells of a cell's edge does not reach into the next cell.
        const EPSILON: f64 = 1e-10;
        let span = |low: f64, high: f64| {
            let first = (low + EPSILON).floor() as i64;
            let last = ((high - EPSILON).ceil() as i64).max(first + 1);
            (first..last).map(move |i| {
                let covered = high.min((i + 1) as f64) - low.max(i as f64);
                // A box inside one cell, however thin, has that cell's value.
                (i, if last == first + 1 { 1.0 } else { covered })
            })
        };
        self.weighted(
            span(y0, y1).flat_map(|(row, wy)| {
                span(x0, x1).map(move |(col, wx)| (cells.at(col, row), wx * wy))
            }),
        )
    }
}

/// Keys' cubic convolution kernel with a = -0.5.
fn keys(distance: f64) -> f64 {
    let d = distance.abs();
    if d <= 1.0 {
        (1.5 * d - 2.5) * d * d + 1.0
    } else if d < 2.0 {
        ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
    } else {
        0.0
    }
}

/// Sixteen taps; NaN when one of them is.
fn cubic(cells: &Cells<'_>, x: f64, y: f64) -> f64 {
    let (left, top) = ((x - 0.5).floor(), (y - 0.5).floor());
    let weights = |f: f64| [keys(1.0 + f), keys(f), keys(1.0 - f), keys(2.0 - f)];
    let (wx, wy) = (weights(x - 0.5 - left), weights(y - 0.5 - top));
    let (left, top) = (left as i64 - 1, top as i64 - 1);
    let mut sum = 0.0;
    for (j, wy) in wy.into_iter().enumerate() {
        let mut line = 0.0;
        for (i, wx) in wx.into_iter().enumerate() {
            line += wx * cells.at(left + i as i64, top + j as i64);
        }
        sum += wy * line;
    }
    sum
}

/// A row of pixels by plain bilinear interpolation, in metres; pixels near invalid cells go through
/// [`Kernel::at_point`]. Returns how many pixels' validity could flip.
///
/// This is the loop in which the benchmark's time goes: the window holds every tap of every point
/// (the caller made it so, with a margin of one cell), and a NaN among four taps makes the sum NaN.
pub(super) fn bilinear_row(
    kernel: &Kernel,
    cells: &Cells<'_>,
    cols: &[f64],
    rows: &[f64],
    metres_per_unit: f64,
    out: &mut [f32],
) -> u32 {
    let (origin_x, origin_y) = (cells.col as f64 + 0.5, cells.row as f64 + 0.5);
    let mut flips = 0;
    for ((out, &x), &y) in out.iter_mut().zip(cols).zip(rows) {
        let (dx, dy) = (x - origin_x, y - origin_y);
        // Never negative by the margin, so truncation is floor.
        let (left, top) = (dx as usize, dy as usize);
        let (fx, fy) = (dx - left as f64, dy - top as f64);
        let start = top * cells.width + left;
        let value = match (
            cells.data.get(start..start + 2),
            cells.data.get(start + cells.width..start + cells.width + 2),
        ) {
            (Some(&[a, b]), Some(&[c, d])) => {
                let (a, b, c, d) = (f64::from(a), f64::from(b), f64::from(c), f64::from(d));
                let upper = a + fx * (b - a);
                let lower = c + fx * (d - c);
                upper + fy * (lower - upper)
            }
            _ => f64::NAN,
        };
        *out = if value.is_nan() {
            let sample = kernel.at_point(cells, x, y);
            flips += u32::from(sample.flips);
            (sample.value * metres_per_unit) as f32
        } else {
            // Only the strict rule looks beyond the four taps.
            flips += u32::from(kernel.edge == EdgeRule::Strict && kernel.flips_near(cells, x, y));
            (value * metres_per_unit) as f32
        };
    }
    flips
}

#[cfg(test)]
mod tests;
