//! The distribution of one image's errors in a few hundred numbers: what quantiles are bootstrapped
//! from, where every replicate would otherwise need a pass over all pixels.

use super::key::rounded;
use serde::{Deserialize, Serialize};

/// Bits of the mantissa that tell bins apart: 16 bins for every doubling.
const MANTISSA_BITS: u32 = 4;
/// Below `2^-6` m (16 mm) bins are equal, `2^-10` m (1 mm) wide.
const FLOOR_BITS: u32 = (127 - 6) << 23;
const FLOOR_BIN: u32 = 1 << MANTISSA_BITS;
const EQUAL_BINS_PER_METRE: f32 = 1024.0;
/// One more than the bin of the largest `f32`.
const BINS: usize = (((0xFF << 23) - FLOOR_BITS) >> (23 - MANTISSA_BITS)) as usize + 16;

/// Numbers of errors in bins that grow with the error: 1 mm wide up to 16 mm, from there 1/16 to 1/32
/// (3 to 6 %) of the error. Bin `i >= 0` holds errors from [`bin_edge`]`(i)` up to `bin_edge(i + 1)`,
/// bin `-1 - i` those of opposite sign.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<u32>", into = "Vec<u32>")]
pub struct Sketch {
    /// Bins that hold errors, ascending, with their numbers.
    bins: Vec<(i16, u32)>,
}

#[inline(always)]
fn bin_of(error: f64) -> i16 {
    let value = rounded(error);
    let magnitude = value.to_bits() & 0x7FFF_FFFF;
    let bin = if magnitude >= FLOOR_BITS {
        ((magnitude - FLOOR_BITS) >> (23 - MANTISSA_BITS)) + FLOOR_BIN
    } else {
        (value.abs() * EQUAL_BINS_PER_METRE) as u32
    } as i16;
    if value < 0.0 { -1 - bin } else { bin }
}

/// Lower edge of a bin, metres; odd about bin 0.
#[must_use]
pub(super) fn bin_edge(bin: i32) -> f64 {
    let magnitude = bin.unsigned_abs();
    let edge = if magnitude >= FLOOR_BIN {
        let steps = magnitude - FLOOR_BIN;
        let within = f64::from(FLOOR_BIN + steps % FLOOR_BIN);
        within * libm::ldexp(1.0, (steps / FLOOR_BIN) as i32 - 10)
    } else {
        f64::from(magnitude) / f64::from(EQUAL_BINS_PER_METRE)
    };
    if bin < 0 { -edge } else { edge }
}

impl Sketch {
    /// The sketch of finite errors (metres).
    #[must_use]
    pub fn of(errors: &[f64]) -> Self {
        let mut counts = vec![0_u32; 2 * BINS];
        for error in errors {
            counts[(i32::from(bin_of(*error)) + BINS as i32) as usize] += 1;
        }
        let bins = counts
            .iter()
            .enumerate()
            .filter(|(_, count)| **count > 0)
            .map(|(place, count)| ((place as i32 - BINS as i32) as i16, *count))
            .collect();
        Self { bins }
    }

    /// Counts the errors of another sketch too.
    pub fn merge(&mut self, other: &Self) {
        let mut merged = Vec::with_capacity(self.bins.len() + other.bins.len());
        merged.extend_from_slice(&self.bins);
        merged.extend_from_slice(&other.bins);
        merged.sort_unstable_by_key(|(bin, _)| *bin);
        merged.dedup_by(|later, kept| {
            let same = later.0 == kept.0;
            if same {
                kept.1 = kept.1.saturating_add(later.1);
            }
            same
        });
        self.bins = merged;
    }

    /// Bins that hold errors, ascending, with their numbers of errors.
    pub(super) fn bins(&self) -> &[(i16, u32)] {
        &self.bins
    }
}

/// Pairs: how many bins further than the last one (from -32768 on), and how many errors.
impl From<Sketch> for Vec<u32> {
    fn from(sketch: Sketch) -> Self {
        let mut last = i32::from(i16::MIN);
        let mut numbers = Self::with_capacity(2 * sketch.bins.len());
        for (bin, count) in sketch.bins {
            numbers.push((i32::from(bin) - last) as u32);
            numbers.push(count);
            last = i32::from(bin);
        }
        numbers
    }
}

impl TryFrom<Vec<u32>> for Sketch {
    type Error = String;

    fn try_from(numbers: Vec<u32>) -> Result<Self, String> {
        let (pairs, rest) = numbers.as_chunks::<2>();
        let mut last = i64::from(i16::MIN);
        let mut bins = Vec::with_capacity(pairs.len());
        for [step, count] in pairs {
            last += i64::from(*step);
            let bin = i16::try_from(last)
                .ok()
                .filter(|bin| (-(BINS as i64)..BINS as i64).contains(&i64::from(*bin)));
            match bin {
                Some(bin) if *step > 0 => bins.push((bin, *count)),
                _ => return Err(format!("a sketch of errors has no bin {last}")),
            }
        }
        if rest.is_empty() {
            Ok(Self { bins })
        } else {
            Err("a sketch of errors is cut off".into())
        }
    }
}

/// Quantiles of a merged sketch, metres, errors taken as spread evenly within a bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SketchQuantiles {
    pub median: f64,
    /// Median of `|error - median|`, without a factor.
    pub deviation: f64,
    pub le68: f64,
    pub le90: f64,
}

/// A piecewise linear distribution function.
struct Distribution<'a> {
    edges: &'a [f64],
    cumulative: &'a [f64],
}

impl Distribution<'_> {
    /// Number of errors up to `at`.
    fn up_to(&self, at: f64) -> f64 {
        let next = self.edges.partition_point(|edge| *edge <= at);
        if next == 0 {
            return 0.0;
        }
        if next == self.edges.len() {
            return self.cumulative[next - 1];
        }
        let (low, high) = (self.edges[next - 1], self.edges[next]);
        let (before, after) = (self.cumulative[next - 1], self.cumulative[next]);
        before + (after - before) * ((at - low) / (high - low))
    }

    /// Where `number` errors are reached.
    fn reaches(&self, number: f64) -> f64 {
        let next = self.cumulative.partition_point(|reached| *reached < number);
        if next == 0 || next == self.edges.len() {
            return self.edges[next.min(self.edges.len() - 1)];
        }
        let (low, high) = (self.edges[next - 1], self.edges[next]);
        let (before, after) = (self.cumulative[next - 1], self.cumulative[next]);
        low + (high - low) * ((number - before) / (after - before))
    }

    /// Half the width of the interval about `centre` that holds `number` errors.
    fn half_width(&self, centre: f64, number: f64) -> f64 {
        let last = self.edges[self.edges.len() - 1];
        let (mut low, mut high) = (0.0, (centre - self.edges[0]).max(last - centre));
        // To 1e-9 of the width or of the finest bin; from the range of `f32` that takes 160 halvings.
        while high - low > 1e-9 * high.max(1e-3) {
            let half = 0.5 * (low + high);
            if self.up_to(centre + half) - self.up_to(centre - half) < number {
                low = half;
            } else {
                high = half;
            }
        }
        high
    }
}

/// Quantiles from counts of consecutive bins, `edges[i]` the lower edge of bin `i` and one edge more.
/// `cumulative` is overwritten. NaN without errors.
pub(super) fn quantiles(
    counts: &[f64],
    edges: &[f64],
    cumulative: &mut Vec<f64>,
) -> SketchQuantiles {
    cumulative.clear();
    cumulative.push(0.0);
    let mut total = 0.0;
    for count in counts {
        total += count;
        cumulative.push(total);
    }
    if total <= 0.0 {
        let nan = f64::NAN;
        return SketchQuantiles { median: nan, deviation: nan, le68: nan, le90: nan };
    }
    let distribution = Distribution { edges, cumulative };
    let median = distribution.reaches(0.5 * total);
    SketchQuantiles {
        median,
        deviation: distribution.half_width(median, 0.5 * total),
        le68: distribution.half_width(0.0, 0.68 * total),
        le90: distribution.half_width(0.0, 0.9 * total),
    }
}
