//! Exact quantiles of any number of errors in flat memory: two passes over the data.
//!
//! The first pass counts errors (rounded to `f32`) by the upper 16 bits of their keys. That tells in
//! which of these coarse bins an order statistic lies, and, because the median's bins are then
//! known, also in which bins the errors can lie that decide the median of `|error - median|`
//! ([`Refinement`]). The second pass counts single `f32` numbers within these bins alone. Rounding
//! is monotone: an order statistic of the rounded errors is the rounded order statistic, so that a
//! quantile is off by the rounding of errors to `f32` (6e-8 of itself) and by nothing else. For
//! NMAD, errors much smaller than the distances in question are rounded to the spacing that `f32`
//! has at half the scale of the largest errors involved: it is off by 2e-7 of
//! `|median| + NMAD` at most.

use super::key::{COARSE, Grid, coarse, key, limits, mirrored, rounded};
use std::sync::Arc;

/// Makes the median absolute deviation of a normal distribution its standard deviation.
pub const NMAD_FACTOR: f64 = 1.4826;

/// Levels of the quantiles of absolute errors.
const ABSOLUTE_LEVELS: [f64; 3] = [0.68, 0.9, 0.95];

/// Quantiles of errors, metres. Between order statistics they are interpolated linearly, as numpy's
/// `median` and `percentile` do by default (type 7 of Hyndman and Fan); NaN without errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantiles {
    /// Median error.
    pub median: f64,
    /// [`NMAD_FACTOR`] times the median of `|error - median|`.
    pub nmad: f64,
    /// 68th percentile of the absolute errors.
    pub le68: f64,
    /// 90th percentile of the absolute errors.
    pub le90: f64,
    /// 95th percentile of the absolute errors.
    pub p95: f64,
}

/// The two order statistics (from 0) that a quantile of `count` numbers lies between, and how far
/// beyond the first.
pub(super) fn position(count: u64, level: f64) -> (u64, u64, f64) {
    let last = count.saturating_sub(1);
    let at = last as f64 * level;
    let first = (at as u64).min(last);
    (first, (first + 1).min(last), at - first as f64)
}

/// Linear interpolation, exact at both ends, as numpy computes it.
pub(super) fn between(a: f64, b: f64, share: f64) -> f64 {
    if share >= 0.5 { b - (b - a) * (1.0 - share) } else { a + (b - a) * share }
}

fn middle(a: f64, b: f64) -> f64 {
    (a + b) / 2.0
}

fn middle_ranks(count: u64) -> (u64, u64) {
    (count.saturating_sub(1) / 2, count / 2)
}

/// First pass: errors by the coarse bins of their keys (512 KiB).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CoarseCounts {
    counts: Vec<u64>,
}

impl Default for CoarseCounts {
    fn default() -> Self {
        Self::new()
    }
}

impl CoarseCounts {
    /// No errors yet.
    #[must_use]
    pub fn new() -> Self {
        Self { counts: vec![0; COARSE] }
    }

    /// Counts finite errors.
    pub fn add(&mut self, errors: &[f64]) {
        if let Ok(counts) = <&mut [u64; COARSE]>::try_from(self.counts.as_mut_slice()) {
            for error in errors {
                counts[coarse(key(rounded(*error)))] += 1;
            }
        }
    }

    /// Counts the errors of another part too.
    pub fn merge(&mut self, other: &Self) {
        for (count, more) in self.counts.iter_mut().zip(&other.counts) {
            *count += more;
        }
    }

    /// Number of errors counted.
    #[must_use]
    pub fn pixels(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// What the second pass must count.
    #[must_use]
    pub fn refinement(&self) -> Refinement {
        let total = self.pixels();
        if total == 0 {
            return Refinement::none();
        }
        let (first, second) = middle_ranks(total);
        let (first_bin, second_bin) = (self.bin_of_rank(first), self.bin_of_rank(second));
        let mut exact = vec![false; COARSE];
        exact[first_bin] = true;
        exact[second_bin] = true;
        for level in ABSOLUTE_LEVELS {
            let (first, second, _) = position(total, level);
            for rank in [first, second] {
                let bin = self.bin_of_absolute_rank(rank);
                exact[bin] = true;
                exact[mirrored(bin)] = true;
            }
        }
        let (first, second) = (limits(first_bin), limits(second_bin));
        let median = (
            middle(f64::from(first.0), f64::from(second.0)),
            middle(f64::from(first.1), f64::from(second.1)),
        );
        let (grid, near) = self.deciding_deviations(median);
        Refinement {
            exact: Arc::new(Cells::new(Grid::EXACT, &exact)),
            deviation: Arc::new(Cells::new(grid, &near)),
        }
    }

    fn bin_of_rank(&self, rank: u64) -> usize {
        let mut before = 0;
        self.counts
            .iter()
            .position(|count| {
                before += count;
                before > rank
            })
            .unwrap_or(COARSE - 1)
    }

    /// The bin, on the side of positive errors, of an order statistic of the absolute errors.
    fn bin_of_absolute_rank(&self, rank: u64) -> usize {
        let mut before = 0;
        (COARSE / 2..COARSE)
            .find(|bin| {
                before += self.counts[*bin] + self.counts[mirrored(*bin)];
                before > rank
            })
            .unwrap_or(COARSE - 1)
    }

    /// The bins that can hold an error whose distance from the median is one of the two middle ones,
    /// given the ends between which the median lies, and the grid to count them on.
    ///
    /// Every bin gives a smallest and a largest possible distance. An order statistic of the
    /// distances lies between the order statistics of the same rank of the smallest and of the
    /// largest ones, and a bin whose distances all lie outside cannot hold it. Subtraction in `f64` is
    /// monotone, so that this holds for distances as computed, not just for exact ones.
    fn deciding_deviations(&self, median: (f64, f64)) -> (Grid, Vec<bool>) {
        let occupied: Vec<usize> = (0..COARSE).filter(|bin| self.counts[*bin] > 0).collect();
        // First on numbers as they are, to learn the scale; then on those of the grid.
        let scale = self
            .middle_distances(&occupied, median, Grid::EXACT)
            .into_iter()
            .fold(median.0.abs().max(median.1.abs()), |scale, (_, high)| scale.max(high));
        let grid = Grid::for_scale(rounded(scale).max(f32::from_bits(1)));
        let middles = self.middle_distances(&occupied, median, grid);
        let mut near = vec![false; COARSE];
        for bin in occupied {
            let (low, high) = distances(bin, median, grid);
            near[bin] = middles.iter().any(|middle| low <= middle.1 && high >= middle.0);
        }
        (grid, near)
    }

    /// Ends between which the two middle order statistics of the distances lie.
    fn middle_distances(
        &self,
        occupied: &[usize],
        median: (f64, f64),
        grid: Grid,
    ) -> [(f64, f64); 2] {
        let bounds: Vec<(f64, f64)> =
            occupied.iter().map(|bin| distances(*bin, median, grid)).collect();
        let sorted = |end: fn(&(f64, f64)) -> f64| {
            let mut ends: Vec<(f64, u64)> =
                bounds.iter().zip(occupied).map(|(b, bin)| (end(b), self.counts[*bin])).collect();
            ends.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            ends
        };
        let (low, high) = (sorted(|b| b.0), sorted(|b| b.1));
        let (first, second) = middle_ranks(self.pixels());
        [first, second].map(|rank| (weighted_rank(&low, rank), weighted_rank(&high, rank)))
    }
}

/// Smallest and largest distance of a bin's numbers, brought to a grid, from a median between two
/// ends.
fn distances(bin: usize, median: (f64, f64), grid: Grid) -> (f64, f64) {
    let (low, high) = limits(bin);
    let (low, high) = (grid.value(grid.code(low)), grid.value(grid.code(high)));
    let nearest = (low - median.1).max(median.0 - high).max(0.0);
    (nearest, (high - median.0).abs().max((median.1 - low).abs()))
}

/// The number at a rank of a sorted list of numbers with their counts.
fn weighted_rank(sorted: &[(f64, u64)], rank: u64) -> f64 {
    let mut before = 0;
    let found = sorted.iter().find(|(_, count)| {
        before += count;
        before > rank
    });
    found.or(sorted.last()).map_or(f64::NAN, |(value, _)| *value)
}

/// Cells that single numbers of some coarse bins are counted in.
#[derive(Debug, PartialEq, Eq)]
struct Cells {
    grid: Grid,
    /// Per coarse bin: add a number's code to find its cell. `i64::MIN` where a bin is not refined.
    base: Vec<i64>,
    /// Code of the first cell of every run of consecutive codes, and its cell.
    runs: Vec<(i64, usize)>,
    /// Number of cells.
    cells: usize,
}

impl Cells {
    fn new(grid: Grid, refined: &[bool]) -> Self {
        let mut made = Self { grid, base: vec![i64::MIN; COARSE], runs: Vec::new(), cells: 0 };
        let mut next_code = i64::MIN;
        for bin in (0..COARSE).filter(|bin| refined[*bin]) {
            let (low, high) = limits(bin);
            let (low, high) = (grid.code(low), grid.code(high));
            if next_code < low {
                made.runs.push((low, made.cells));
                next_code = low;
            }
            // Bins that are rounded to the same code at their common edge share its cell.
            made.base[bin] = made.cells as i64 - next_code;
            made.cells += (high + 1 - next_code).max(0) as usize;
            next_code = next_code.max(high + 1);
        }
        made
    }

    #[inline(always)]
    fn cell(&self, value: f32) -> Option<usize> {
        let base = self.base[coarse(key(value))];
        (base != i64::MIN).then(|| (base + self.grid.code(value)) as usize)
    }

    /// Numbers and counts of the cells that are not empty, ascending.
    fn occupied<'a>(&'a self, counts: &'a [u64]) -> impl Iterator<Item = (f64, u64)> + 'a {
        let ends = self.runs.iter().skip(1).map(|run| run.1).chain([self.cells]);
        self.runs.iter().zip(ends).flat_map(move |(&(code, start), end)| {
            (start..end)
                .filter(|cell| counts[*cell] > 0)
                .map(move |cell| (self.grid.value(code + (cell - start) as i64), counts[cell]))
        })
    }

    fn is_refined(&self, bin: usize) -> bool {
        self.base[bin] != i64::MIN
    }
}

/// Which coarse bins the second pass counts single numbers of: those that can hold an order
/// statistic that is wanted. Cheap to clone.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refinement {
    exact: Arc<Cells>,
    deviation: Arc<Cells>,
}

impl Refinement {
    fn none() -> Self {
        let none = Arc::new(Cells::new(Grid::EXACT, &vec![false; COARSE]));
        Self { exact: Arc::clone(&none), deviation: none }
    }

    /// Number of counters of the second pass: 8 bytes each, of which the operating system hands out
    /// only those that are written to.
    #[must_use]
    pub fn cells(&self) -> usize {
        self.exact.cells + self.deviation.cells
    }
}

/// Second pass: single numbers within the bins of a [`Refinement`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FineCounts {
    refinement: Refinement,
    exact: Vec<u64>,
    deviation: Vec<u64>,
}

impl FineCounts {
    /// No errors yet.
    #[must_use]
    pub fn new(refinement: &Refinement) -> Self {
        Self {
            refinement: refinement.clone(),
            exact: vec![0; refinement.exact.cells],
            deviation: vec![0; refinement.deviation.cells],
        }
    }

    /// Counts finite errors: the same as in the first pass, in any order.
    pub fn add(&mut self, errors: &[f64]) {
        for error in errors {
            let value = rounded(*error);
            if let Some(cell) = self.refinement.exact.cell(value) {
                self.exact[cell] += 1;
            }
            if let Some(cell) = self.refinement.deviation.cell(value) {
                self.deviation[cell] += 1;
            }
        }
    }

    /// Counts the errors of another part too.
    ///
    /// # Panics
    /// When the two are not of the same refinement.
    pub fn merge(&mut self, other: &Self) {
        assert!(self.refinement == other.refinement, "parts of one second pass");
        for (count, more) in self.exact.iter_mut().zip(&other.exact) {
            *count += more;
        }
        for (count, more) in self.deviation.iter_mut().zip(&other.deviation) {
            *count += more;
        }
    }
}

impl Quantiles {
    /// NaN everywhere: quantiles of nothing.
    pub const NONE: Self =
        Self { median: f64::NAN, nmad: f64::NAN, le68: f64::NAN, le90: f64::NAN, p95: f64::NAN };

    /// Quantiles of all errors that two passes over them counted.
    ///
    /// # Panics
    /// When the second pass saw other errors than the first.
    #[must_use]
    pub fn pooled(coarse: &CoarseCounts, fine: &FineCounts) -> Self {
        let total = coarse.pixels();
        if total == 0 {
            return Self::NONE;
        }
        let cells = &fine.refinement.exact;
        let outside = |bin: usize| if cells.is_refined(bin) { 0 } else { coarse.counts[bin] };

        // What is not refined stands in at its lower edge: its rank counts, its number is not used.
        let mut signed: Vec<(f64, u64)> = (0..COARSE)
            .filter(|bin| outside(*bin) > 0)
            .map(|bin| (f64::from(limits(bin).0), outside(bin)))
            .chain(cells.occupied(&fine.exact))
            .collect();
        signed.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let counted: u64 = signed.iter().map(|(_, count)| count).sum();
        assert_eq!(counted, total, "both passes must see the same errors");
        let (first, second) = middle_ranks(total);
        let median = middle(weighted_rank(&signed, first), weighted_rank(&signed, second));

        let mut absolute: Vec<(f64, u64)> = (0..COARSE)
            .filter(|bin| outside(*bin) > 0)
            .map(|bin| (f64::from(limits(bin.max(mirrored(bin))).0), outside(bin)))
            .chain(cells.occupied(&fine.exact).map(|(value, count)| (value.abs(), count)))
            .collect();
        absolute.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let [le68, le90, p95] = ABSOLUTE_LEVELS.map(|level| {
            let (first, second, share) = position(total, level);
            between(weighted_rank(&absolute, first), weighted_rank(&absolute, second), share)
        });

        let cells = &fine.refinement.deviation;
        let mut deviations: Vec<(f64, u64)> = (0..COARSE)
            .filter(|bin| !cells.is_refined(*bin) && coarse.counts[*bin] > 0)
            .map(|bin| (distances(bin, (median, median), cells.grid).0, coarse.counts[bin]))
            .chain(
                cells
                    .occupied(&fine.deviation)
                    .map(|(value, count)| ((value - median).abs(), count)),
            )
            .collect();
        deviations.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let deviation =
            middle(weighted_rank(&deviations, first), weighted_rank(&deviations, second));
        Self { median, nmad: NMAD_FACTOR * deviation, le68, le90, p95 }
    }

    /// Quantiles of finite errors in memory, exact to the bit of numpy's; `scratch` is overwritten.
    #[must_use]
    pub fn of(errors: &[f64], scratch: &mut Vec<f64>) -> Self {
        if errors.is_empty() {
            return Self::NONE;
        }
        scratch.clear();
        scratch.extend(errors.iter().map(|error| error + 0.0));
        let median = median_of(scratch);
        scratch.clear();
        scratch.extend(errors.iter().map(|error| (error - median).abs()));
        let nmad = NMAD_FACTOR * median_of(scratch);
        scratch.clear();
        scratch.extend(errors.iter().map(|error| error.abs()));
        // From the highest level down: lower ones lie before it once it is in its place.
        let [mut le68, mut le90, mut p95] = [0.0; 3];
        let (mut end, mut value, mut next) = (scratch.len(), 0.0, 0.0);
        for (level, result) in
            ABSOLUTE_LEVELS.into_iter().zip([&mut le68, &mut le90, &mut p95]).rev()
        {
            let (first, _, share) = position(errors.len() as u64, level);
            let first = first as usize;
            if first < end {
                let part = (end + 1).min(scratch.len());
                value = *scratch[..end].select_nth_unstable_by(first, f64::total_cmp).1;
                next = smallest(&scratch[first + 1..part]).unwrap_or(value);
                end = first;
            }
            *result = between(value, next, share);
        }
        Self { median, nmad, le68, le90, p95 }
    }
}

/// Median of numbers, which are reordered; there must be some.
fn median_of(values: &mut [f64]) -> f64 {
    let (first, second) = middle_ranks(values.len() as u64);
    let (_, low, above) = values.select_nth_unstable_by(first as usize, f64::total_cmp);
    if first == second { *low } else { middle(*low, smallest(above).unwrap_or(*low)) }
}

/// The smallest of numbers none of which is NaN.
fn smallest(values: &[f64]) -> Option<f64> {
    let (&first, rest) = values.split_first()?;
    Some(rest.iter().fold(first, |least, value| if *value < least { *value } else { least }))
}

#[cfg(test)]
#[path = "quantiles_tests.rs"]
mod tests;
