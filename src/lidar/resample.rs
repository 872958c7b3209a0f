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
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn kernel(resampling: Resampling) -> Kernel {
        Kernel::new(resampling, EdgeRule::Renormalise, (0.2, 0.2), (1e-9, 1e-9))
    }

    fn plane(width: usize, height: usize) -> Vec<f32> {
        (0..width * height)
            .map(|k| 2.0 * (k % width) as f32 - 3.0 * (k / width) as f32 + 7.0)
            .collect()
    }

    fn cells(data: &[f32], width: usize) -> Cells<'_> {
        Cells { data, col: 100, row: -50, width, height: data.len() / width }
    }

    #[test]
    fn keys_kernel_is_an_interpolating_partition_of_unity() {
        assert_eq!(keys(0.0), 1.0);
        for k in 1..3 {
            assert_eq!(keys(f64::from(k)), 0.0);
        }
        for k in 0..=100 {
            let f = f64::from(k) / 100.0;
            assert!((keys(1.0 + f) + keys(f) + keys(1.0 - f) + keys(2.0 - f) - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn a_valid_tap_that_is_not_the_nearest_does_not_bleed() {
        let mut data = plane(4, 4);
        data[5] = f32::NAN; // cell (101, -49)
        let cells = cells(&data, 4);
        let k = kernel(Resampling::Bilinear);
        assert!(k.at_point(&cells, 101.9, -48.1).value.is_nan(), "inside the invalid cell");
        let beside = k.at_point(&cells, 102.1, -48.5).value;
        assert_eq!(beside, 2.0 * 2.0 - 3.0 + 7.0, "only the valid neighbour counts");
        let strict = Kernel { edge: EdgeRule::Strict, ..k };
        assert!(strict.at_point(&cells, 102.1, -48.5).value.is_nan());
    }

    #[test]
    fn validity_that_hangs_on_rounding_is_noticed() {
        let mut data = plane(4, 4);
        data[5] = f32::NAN;
        let cells = cells(&data, 4);
        let k = kernel(Resampling::Bilinear);
        assert!(k.at_point(&cells, 102.0 + 1e-10, -48.5).flips);
        assert!(k.at_point(&cells, 102.0 - 1e-10, -48.5).flips);
        assert!(!k.at_point(&cells, 102.001, -48.5).flips);
    }

    #[test]
    fn a_border_hangs_on_rounding_along_both_axes_and_only_beside_another_validity() {
        let mut data = plane(4, 4);
        data[5] = f32::NAN; // cell (101, -49)
        let cells = cells(&data, 4);
        let k = Kernel { flip_x: 1e-3, flip_y: 0.1, ..kernel(Resampling::Nearest) };
        let flips = |x, y| k.at_point(&cells, x, y).flips;
        for (x, y) in [(101.5, -49.05), (101.5, -48.95), (101.5, -48.05), (101.5, -47.95)] {
            assert!(flips(x, y), "{x} {y}");
        }
        for (x, y) in
            [(102.000_5, -48.5), (101.999_5, -48.5), (101.000_5, -48.5), (100.999_5, -48.5)]
        {
            assert!(flips(x, y), "{x} {y}");
        }
        // Too far from the border, or beside cells that are alike.
        for (x, y) in
            [(101.5, -49.15), (101.5, -48.15), (102.05, -48.5), (100.95, -48.5), (102.95, -46.95)]
        {
            assert!(!flips(x, y), "{x} {y}");
        }
    }

    #[test]
    fn kernels_widen_beyond_095_pixels_per_cell_and_margins_hold_their_taps() {
        use Resampling::{Average, Bilinear, Cubic, Nearest};
        let margin = |r, cells| Kernel::new(r, EdgeRule::Strict, cells, (0.0, 0.0)).margin();
        let plain =
            |cells| Kernel::new(Bilinear, EdgeRule::Strict, cells, (0.0, 0.0)).is_plain_bilinear();
        assert!(plain((1.05, 1.05)) && !plain((1.06, 0.2)) && !plain((0.2, 1.06)));
        assert!(!kernel(Cubic).is_plain_bilinear());
        assert_eq!(margin(Nearest, (4.0, 4.0)), (1, 1));
        assert_eq!(margin(Average, (4.0, 4.0)), (1, 1));
        assert_eq!((margin(Bilinear, (0.1, 1.0)), margin(Cubic, (0.1, 1.0))), ((2, 2), (3, 3)));
        assert_eq!((margin(Bilinear, (2.5, 0.5)), margin(Cubic, (0.5, 2.25))), ((4, 2), (3, 6)));
    }

    #[test]
    fn a_widened_kernel_is_its_weighted_mean_over_all_valid_cells() {
        let mut data: Vec<f32> = (0..400).map(|k| ((k * 7919) % 1009) as f32 / 8.0).collect();
        for hole in [0, 105, 188, 191, 255] {
            data[hole] = f32::NAN;
        }
        let cells = cells(&data, 20);
        for resampling in [Resampling::Bilinear, Resampling::Cubic] {
            let ratio = (1.75, 2.5);
            let k = Kernel::new(resampling, EdgeRule::Renormalise, ratio, (0.0, 0.0));
            for (x, y) in [(110.2, -40.3), (109.9, -39.6), (106.5, -42.5), (113.0, -36.0)] {
                let weight = |d: f64| {
                    if resampling == Resampling::Cubic { keys(d) } else { (1.0 - d.abs()).max(0.0) }
                };
                let (mut sum, mut total) = (0.0, 0.0);
                for (at, value) in data.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
                    let (cx, cy) = ((at % 20) as f64 + 100.5, (at / 20) as f64 - 49.5);
                    let w = weight((cx - x) / ratio.0) * weight((cy - y) / ratio.1);
                    (sum, total) = (sum + w * f64::from(*value), total + w);
                }
                let found = k.at_point(&cells, x, y).value;
                assert!((found - sum / total).abs() < 1e-11, "{resampling:?} {x} {y}: {found}");
            }
        }
    }

    #[test]
    fn a_mean_hangs_on_rounding_where_a_sliver_of_a_cell_decides() {
        let mut data = plane(4, 4);
        data[5] = f32::NAN; // cell (101, -49)
        let cells = cells(&data, 4);
        let k = Kernel { flip_x: 0.01, flip_y: 0.1, ..kernel(Resampling::Average) };
        let mean = |x: (f64, f64), y: (f64, f64)| k.average(&cells, (x.0, y.0), (x.1, y.1));
        for (x, y, valid, flips) in [
            ((101.2, 101.8), (-48.8, -48.2), false, false),
            ((101.2, 101.995), (-48.8, -48.2), false, true),
            ((101.005, 101.8), (-48.8, -48.2), false, true),
            ((101.2, 101.8), (-48.95, -48.2), false, true),
            ((101.2, 101.8), (-48.8, -48.05), false, true),
            ((101.2, 102.005), (-48.8, -48.2), true, true),
            ((101.2, 102.02), (-48.8, -48.2), true, false),
            ((100.995, 101.8), (-48.8, -48.2), true, true),
            ((101.2, 101.8), (-49.05, -48.2), true, true),
            ((101.2, 101.8), (-49.15, -48.2), true, false),
        ] {
            let sample = mean(x, y);
            assert_eq!((!sample.value.is_nan(), sample.flips), (valid, flips), "{x:?} {y:?}");
            // The corners may come in any order.
            let turned = k.average(&cells, (x.1, y.0), (x.0, y.1));
            assert!(turned == sample || turned.value.is_nan() && turned.flips == flips);
        }
    }

    #[test]
    fn cubic_falls_back_to_bilinear_beside_a_hole() {
        let mut data: Vec<f32> = (0..64).map(|k| ((k * 37) % 17) as f32).collect();
        let full = data.clone();
        data[9] = f32::NAN;
        let (x, y) = (103.2, -46.9);
        let (c, b) = (kernel(Resampling::Cubic), kernel(Resampling::Bilinear));
        let value = c.at_point(&cells(&data, 8), x - 0.5, y - 0.5).value;
        assert_eq!(value, b.at_point(&cells(&data, 8), x - 0.5, y - 0.5).value);
        assert_ne!(value, c.at_point(&cells(&full, 8), x - 0.5, y - 0.5).value);
    }

    #[test]
    fn average_weighs_cells_by_coverage() {
        let data = [1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        let cells = Cells { data: &data, col: 0, row: 0, width: 3, height: 3 };
        let k = kernel(Resampling::Average);
        assert_eq!(k.average(&cells, (0.0, 0.0), (3.0, 3.0)).value, 5.0);
        assert_eq!(k.average(&cells, (0.5, 0.0), (2.0, 1.0)).value, (0.5 * 1.0 + 2.0) / 1.5);
        assert_eq!(k.average(&cells, (1.2, 1.2), (1.3, 1.3)).value, 5.0, "inside one cell");
        let mut hole = data;
        hole[4] = f32::NAN;
        let cells = Cells { data: &hole, ..cells };
        assert!(k.average(&cells, (1.2, 1.2), (1.3, 1.3)).value.is_nan());
        assert_eq!(k.average(&cells, (0.0, 0.0), (3.0, 3.0)).value, 5.0);
    }

    proptest! {
        #[test]
        fn every_kernel_reproduces_a_plane(x in 107.0..113.0_f64, y in -43.0..-37.0_f64, ratio in 0.1..2.5_f64) {
            let data = plane(20, 20);
            let cells = cells(&data, 20);
            // The value at the centre of cell (0, 0) is 7.
            let truth = 2.0 * (x - 100.5) - 3.0 * (y + 49.5) + 7.0;
            for resampling in [Resampling::Bilinear, Resampling::Cubic] {
                let k = Kernel::new(resampling, EdgeRule::Strict, (ratio, ratio), (0.0, 0.0));
                let value = k.at_point(&cells, x, y).value;
                // A widened kernel sampled at whole cells keeps the mean of a plane only nearly.
                let bound = if ratio > 1.0 / 0.95 { 0.7 } else { 1e-12 };
                prop_assert!((value - truth).abs() < bound, "{resampling:?} {ratio}: {value} {truth}");
            }
            let k = kernel(Resampling::Average);
            let value = k.average(&cells, (x - 0.5, y - 0.5), (x + 0.5, y + 0.5)).value;
            prop_assert!((value - truth).abs() < 1e-9);
        }

        #[test]
        fn the_quick_row_is_the_slow_point(
            points in proptest::collection::vec((101.0..118.9_f64, -49.0..-31.1_f64), 1..40),
            holes in proptest::collection::vec(0_usize..400, 0..60),
        ) {
            let mut data: Vec<f32> = (0..400).map(|k| ((k * 7919) % 1009) as f32 / 8.0).collect();
            for hole in holes {
                data[hole] = f32::NAN;
            }
            let cells = cells(&data, 20);
            let k = kernel(Resampling::Bilinear);
            let (xs, ys): (Vec<_>, Vec<_>) = points.into_iter().unzip();
            let mut out = vec![0.0_f32; xs.len()];
            bilinear_row(&k, &cells, &xs, &ys, 0.3048, &mut out);
            for ((out, &x), &y) in out.iter().zip(&xs).zip(&ys) {
                let slow = (k.at_point(&cells, x, y).value * 0.3048) as f32;
                prop_assert!(
                    (out.is_nan() && slow.is_nan()) || (out - slow).abs() <= 2e-5 * slow.abs().max(1.0),
                    "{out} {slow}"
                );
            }
        }
    }
}
