//! Sums of errors from which the means come: mergeable, and as good as exact.

use super::double::{Double, sums};
use serde::{Deserialize, Serialize};

/// The thresholds that are always counted, metres: those of the published table. They are the first
/// two of every list of thresholds.
pub const PUBLISHED_THRESHOLDS_M: [f64; 2] = [2.5, 7.5];

/// Errors worked on at a time; they stay in the nearest cache between the two passes over them.
const CHUNK: usize = 2048;

/// The published thresholds, then further ones: the list that everything here counts by.
#[must_use]
pub fn threshold_list(further_m: &[f64]) -> Vec<f64> {
    PUBLISHED_THRESHOLDS_M.iter().chain(further_m).copied().collect()
}

/// Number, sum, sum of absolute values, squared deviations from the mean, largest absolute value
/// and counts under thresholds of errors (metres).
///
/// The sums are held to about 106 bits, the squared deviations are merged by the formula of Chan,
/// Golub and LeVeque (1983) around means of that precision; no difference of large numbers is ever
/// taken, so that every score agrees with exact arithmetic to about 1e-15 of itself (the bias: of
/// the mean absolute error times 1e-16 where positive and negative errors cancel out), whatever the
/// offset and the number of pixels. Deviations under 1e-150 m count as 0 when squared. The result
/// depends on the order of `add` and `merge` only in its last bits, and on nothing else.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorSums {
    pixels: u64,
    sum: Double,
    absolute: Double,
    squared_deviations: Double,
    max_abs: f64,
    below: Vec<u64>,
}

impl ErrorSums {
    /// No errors yet, `thresholds` thresholds (the two published ones among them).
    #[must_use]
    pub fn new(thresholds: usize) -> Self {
        Self {
            pixels: 0,
            sum: Double::default(),
            absolute: Double::default(),
            squared_deviations: Double::default(),
            max_abs: 0.0,
            below: vec![0; thresholds],
        }
    }

    /// Adds finite errors (metres, at most 1e140).
    ///
    /// # Panics
    /// When the number of thresholds is not that given to [`Self::new`].
    pub fn add(&mut self, errors: &[f64], thresholds: &[f64]) {
        assert_eq!(thresholds.len(), self.below.len(), "thresholds");
        for chunk in errors.chunks(CHUNK) {
            self.add_chunk(chunk, thresholds);
        }
    }

    fn add_chunk(&mut self, chunk: &[f64], thresholds: &[f64]) {
        let [sum, absolute] = sums(chunk, |error| [error, error.abs()]);
        let count = chunk.len() as f64;
        let mean = sum.over(count);
        let [squares] = sums(chunk, |error| [(error - mean.high) * (error - mean.high)]);
        // The squares are about the rounded mean; `mean.low` is how far it is from the mean.
        let squared_deviations = squares.plus_single(-(count * mean.low * mean.low));
        for (below, threshold) in self.below.iter_mut().zip(thresholds) {
            let mut counts = [0_u64; 4];
            let (groups, rest) = chunk.as_chunks::<4>();
            for group in groups {
                for lane in 0..4 {
                    counts[lane] += u64::from(group[lane].abs() < *threshold);
                }
            }
            let rest = rest.iter().filter(|error| error.abs() < *threshold).count();
            *below += counts.iter().sum::<u64>() + rest as u64;
        }
        let max_abs = chunk.iter().fold(0.0_f64, |max, error| larger(max, error.abs()));
        self.absorb(chunk.len() as u64, sum, absolute, squared_deviations, max_abs);
    }

    /// Adds what another part of the errors came to.
    ///
    /// # Panics
    /// When the two count by different numbers of thresholds.
    pub fn merge(&mut self, other: &Self) {
        assert_eq!(other.below.len(), self.below.len(), "thresholds");
        for (below, more) in self.below.iter_mut().zip(&other.below) {
            *below += more;
        }
        self.absorb(
            other.pixels,
            other.sum,
            other.absolute,
            other.squared_deviations,
            other.max_abs,
        );
    }

    fn absorb(&mut self, pixels: u64, sum: Double, absolute: Double, squares: Double, max: f64) {
        if pixels == 0 {
            return;
        }
        let mut squared_deviations = self.squared_deviations.plus(squares);
        if self.pixels > 0 {
            let (here, there) = (self.pixels as f64, pixels as f64);
            let apart = sum.over(there).minus_rounded(self.sum.over(here));
            let weight = here / (here + there) * there;
            squared_deviations = squared_deviations.plus_single(apart * apart * weight);
        }
        self.pixels += pixels;
        self.sum = self.sum.plus(sum);
        self.absolute = self.absolute.plus(absolute);
        self.squared_deviations = squared_deviations;
        self.max_abs = larger(self.max_abs, max);
    }

    /// Number of errors.
    #[must_use]
    pub fn pixels(&self) -> u64 {
        self.pixels
    }

    /// Mean absolute error, metres; NaN without errors, as all that follow.
    #[must_use]
    pub fn mae(&self) -> f64 {
        self.absolute.over(self.pixels as f64).high
    }

    /// Root mean square error, metres.
    #[must_use]
    pub fn rmse(&self) -> f64 {
        if self.pixels == 0 {
            return f64::NAN;
        }
        let bias = self.bias();
        let mean_square = self.variance() + bias * bias;
        // It lies between these by definition; the root of squares that vanish need not.
        mean_square.sqrt().clamp(self.mae().min(self.max_abs), self.max_abs)
    }

    /// Mean error, metres.
    #[must_use]
    pub fn bias(&self) -> f64 {
        self.sum.over(self.pixels as f64).high
    }

    fn variance(&self) -> f64 {
        let variance = self.squared_deviations.over(self.pixels as f64).high;
        if variance < 0.0 { 0.0 } else { variance }
    }

    /// Standard deviation of the errors about their mean (of the population: divided by their
    /// number), metres.
    #[must_use]
    pub fn std(&self) -> f64 {
        self.variance().sqrt()
    }

    /// Largest absolute error, metres.
    #[must_use]
    pub fn max_abs(&self) -> f64 {
        if self.pixels == 0 { f64::NAN } else { self.max_abs }
    }

    /// Number of errors of absolute value under a threshold (not equal to it), by its place in the
    /// list.
    #[must_use]
    pub fn below(&self, threshold: usize) -> u64 {
        self.below[threshold]
    }

    /// The same as a share of all errors, per cent.
    #[must_use]
    pub fn below_pct(&self, threshold: usize) -> f64 {
        100.0 * self.below[threshold] as f64 / self.pixels as f64
    }

    /// Number of thresholds.
    #[must_use]
    pub fn thresholds(&self) -> usize {
        self.below.len()
    }
}

/// The larger of two numbers that are not NaN.
#[inline(always)]
fn larger(a: f64, b: f64) -> f64 {
    if b > a { b } else { a }
}

/// Mean to about 106 bits of finite numbers; NaN when there are none.
#[must_use]
pub(super) fn mean(values: &[f64]) -> f64 {
    let [sum] = sums(values, |value| [value]);
    sum.over(values.len() as f64).high
}

#[cfg(test)]
#[path = "sums_tests.rs"]
mod tests;
