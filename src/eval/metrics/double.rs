//! Unevaluated sums of two `f64` (about 106 bits): what the sums of errors are kept in.
//!
//! Dekker, "A floating-point technique for extending the available precision" (1971); Knuth, "The
//! Art of Computer Programming", volume 2, 4.2.2, theorem B.

use serde::{Deserialize, Serialize};

/// A number `high + low`, `low` no more than half a unit in the last place of `high`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "[f64; 2]", into = "[f64; 2]")]
pub(super) struct Double {
    pub high: f64,
    pub low: f64,
}

impl From<[f64; 2]> for Double {
    fn from([high, low]: [f64; 2]) -> Self {
        Self { high, low }
    }
}

impl From<Double> for [f64; 2] {
    fn from(number: Double) -> Self {
        [number.high, number.low]
    }
}

/// `a + b` and what its rounding lost.
#[inline(always)]
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let part = sum - a;
    (sum, (a - (sum - part)) + (b - part))
}

impl Double {
    /// The sum of two numbers of which the first is the larger or 0.
    fn normal(high: f64, low: f64) -> Self {
        let sum = high + low;
        Self { high: sum, low: low - (sum - high) }
    }

    /// The sum.
    pub fn plus(self, other: Self) -> Self {
        let (high, lost) = two_sum(self.high, other.high);
        let (low, lost_low) = two_sum(self.low, other.low);
        let first = Self::normal(high, lost + low);
        Self::normal(first.high, first.low + lost_low)
    }

    /// The sum with one `f64`.
    pub fn plus_single(self, other: f64) -> Self {
        self.plus(Self { high: other, low: 0.0 })
    }

    /// The difference, rounded to `f64`.
    pub fn minus_rounded(self, other: Self) -> f64 {
        self.plus(Self { high: -other.high, low: -other.low }).high
    }

    /// Divided by a number other than 0.
    pub fn over(self, divisor: f64) -> Self {
        let quotient = self.high / divisor;
        let rest = libm::fma(-quotient, divisor, self.high);
        Self::normal(quotient, (rest + self.low) / divisor)
    }
}

/// Lanes of the sums below: fixed, so that the order of additions does not depend on the machine.
const LANES: usize = 4;

/// A sum in four interleaved lanes that keeps what every addition loses.
#[derive(Clone, Copy, Default)]
pub(super) struct LaneSum {
    high: [f64; LANES],
    low: [f64; LANES],
}

impl LaneSum {
    #[inline(always)]
    fn add(&mut self, values: [f64; LANES]) {
        for ((high, low), value) in self.high.iter_mut().zip(&mut self.low).zip(values) {
            let (sum, lost) = two_sum(*high, value);
            *high = sum;
            *low += lost;
        }
    }

    fn total(self) -> Double {
        (0..LANES).fold(Double::default(), |sum, lane| {
            sum.plus_single(self.high[lane]).plus_single(self.low[lane])
        })
    }
}

/// Sums of several functions of the values, each in its own lanes.
#[inline(always)]
pub(super) fn sums<const N: usize>(values: &[f64], terms: impl Fn(f64) -> [f64; N]) -> [Double; N] {
    let mut lanes = [LaneSum::default(); N];
    let (groups, rest) = values.as_chunks::<LANES>();
    for group in groups {
        let mut by_term = [[0.0; LANES]; N];
        for (lane, value) in group.iter().enumerate() {
            let at_lane = terms(*value);
            for term in 0..N {
                by_term[term][lane] = at_lane[term];
            }
        }
        for term in 0..N {
            lanes[term].add(by_term[term]);
        }
    }
    for (lane, value) in rest.iter().enumerate() {
        let at_lane = terms(*value);
        for term in 0..N {
            let mut padded = [0.0; LANES];
            padded[lane] = at_lane[term];
            lanes[term].add(padded);
        }
    }
    lanes.map(LaneSum::total)
}
