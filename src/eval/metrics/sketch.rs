//! The distribution of one image's errors in a few hundred numbers: what quantiles are bootstrapped
//! from, where every replicate would otherwise need a pass over all pixels.

use super::key::rounded;
use serde::{Deserialize, Serialize};

/// Bits of the mantissa that tell bins apart, for numbers from `2^exponent` to twice that.
///
/// Fine in proportion where most errors are; not coarser than 0.5 m up to 512 m and 0.1 % up to
/// 16 km, so that the spread of errors is still told about a large offset (a wrong datum).
const fn mantissa_bits(exponent: i32) -> u32 {
    match exponent {
        -10..=-7 => (exponent + 10) as u32,
        3..=8 => exponent as u32 + 1,
        9..=13 => 10,
        _ => 4,
    }
}

/// The exponent, as `f32` holds it, from which on there is more than one bin: that of `2^-10`.
const FINEST: usize = 127 - 10;

/// For every exponent, as `f32` holds it, its first bin and the bits of the mantissa to leave out.
static BINNING: [(u16, u8); 256] = {
    let mut binning = [(0, 23); 256];
    let mut first = 1;
    let mut exponent = FINEST;
    while exponent < 256 {
        let bits = mantissa_bits(exponent as i32 - 127);
        binning[exponent] = (first, 23 - bits as u8);
        first += 1 << bits;
        exponent += 1;
    }
    binning
};
/// One more than the bin of the largest `f32`.
const BINS: usize = 6288 + 114 * 16;

/// Numbers of errors in bins that grow with the error: 1 mm wide up to 16 mm, from there 1/16 to 1/32
/// (3 to 6 %) of the error up to 8 m, then 0.5 m up to 512 m, 0.05 to 0.1 % up to 16 km and 3 to 6 %
/// again beyond.
///
/// In JSON: pairs of numbers, how many bins further than the last one (from -32768 on; bins of
/// negative errors are counted downwards from -1) and how many errors.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<u32>", into = "Vec<u32>")]
pub struct Sketch {
    /// Bins that hold errors, ascending, with their numbers.
    bins: Vec<(i16, u32)>,
}

/// Bin `i >= 0` holds errors from `bin_edge(i)` up to `bin_edge(i + 1)`, bin `-1 - i` those of
/// opposite sign.
#[inline(always)]
fn bin_of(error: f64) -> i16 {
    let value = rounded(error);
    let bits = value.to_bits();
    let (first, left_out) = BINNING[(bits >> 23 & 0xFF) as usize];
    let bin = (first + ((bits & 0x007F_FFFF) >> left_out) as u16) as i16;
    // -1 - bin for negative errors, without a branch.
    bin ^ -i16::from(value < 0.0)
}

/// Lower edge of a bin, metres; odd about bin 0.
#[must_use]
pub(super) fn bin_edge(bin: i32) -> f64 {
    let magnitude = bin.unsigned_abs();
    if magnitude == 0 {
        return 0.0;
    }
    let exponent = BINNING.partition_point(|(first, _)| u32::from(*first) <= magnitude) - 1;
    let (first, left_out) = BINNING[exponent];
    let steps = magnitude - u32::from(first);
    let within = 1.0 + f64::from(steps) / f64::from(1_u32 << (23 - left_out));
    let edge = libm::ldexp(within, exponent as i32 - 127);
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]

    use super::*;
    use crate::eval::metrics::{NMAD_FACTOR, Quantiles};
    use crate::random::{key, normal};
    use proptest::prelude::*;

    fn quantiles_of(sketch: &Sketch) -> SketchQuantiles {
        let lowest = i32::from(sketch.bins[0].0);
        let highest = i32::from(sketch.bins[sketch.bins.len() - 1].0);
        let mut counts = vec![0.0; (highest - lowest + 1) as usize];
        for (bin, count) in &sketch.bins {
            counts[(i32::from(*bin) - lowest) as usize] += f64::from(*count);
        }
        let edges: Vec<f64> = (lowest..=highest + 1).map(bin_edge).collect();
        quantiles(&counts, &edges, &mut Vec::new())
    }

    /// Width of the bin that holds an error.
    fn width(error: f64) -> f64 {
        let bin = i32::from(bin_of(error));
        bin_edge(bin + 1) - bin_edge(bin)
    }

    #[test]
    fn bins_hold_their_errors_and_are_as_narrow_as_stated() {
        let mut errors: Vec<f64> = (0..4000).map(|i| f64::from(i) * 0.01 + 0.003).collect();
        errors.extend([
            1e-45, 1e-3, 0.0156, 0.015_625, 1.0, 1.99, 2.0, 511.9, 512.0, 4000.1, 16_383.0,
            16_384.0, 3.4e38, 7e38,
        ]);
        for error in errors.iter().flat_map(|e| [*e, -e]) {
            let held = f64::from(rounded(error));
            let bin = i32::from(bin_of(error));
            let (low, high) = (bin_edge(bin), bin_edge(bin + 1));
            let inside =
                if error < 0.0 { low < held && held <= high } else { low <= held && held < high };
            assert!(inside, "{error} in {low} {high}");
            let widest = match held.abs() {
                0.0..8.0 => (held.abs() / 16.0).max(1.0 / 1024.0),
                8.0..512.0 => 0.5,
                512.0..16_384.0 => held.abs() / 1024.0,
                _ => held.abs() / 16.0,
            };
            assert!(high - low <= widest && high - low > 0.0, "{error} in {low} {high}");
        }
        for (start, first) in
            [(2f64.powi(-10), 1), (2f64.powi(-6), 16), (8.0, 160), (512.0, 1168), (16_384.0, 6288)]
        {
            assert_eq!((bin_edge(first), bin_edge(-first)), (start, -start));
            assert_eq!(i32::from(bin_of(start)), first);
            let before = f64::from((start as f32).next_down());
            assert_eq!(i32::from(bin_of(before)), first - 1);
            assert_eq!(i32::from(bin_of(-before)), -first);
        }
        assert_eq!(usize::from(BINNING[255].0), BINS);
        assert!((bin_of(7e38) as usize) < BINS);
        assert_eq!(bin_of(0.0), 0);
        assert_eq!(bin_of(-0.0), 0);
    }

    #[test]
    fn quantiles_are_within_their_bins() {
        for (mean, spread) in
            [(0.0, 2.0), (0.3, 5.0), (-4.0, 0.5), (0.0, 0.004), (-90.0, 4.0), (4000.0, 30.0)]
        {
            let errors: Vec<f64> =
                (0..20_000).map(|i| mean + spread * normal(key(&[3, i]))).collect();
            let exact = Quantiles::of(&errors, &mut Vec::new());
            let found = quantiles_of(&Sketch::of(&errors));
            // Smooth errors: a tenth of a bin (0.3 to 0.6 % of the error) and 0.1 mm.
            for (found, exact, share) in [
                (found.median, exact.median, 0.1),
                (found.le68, exact.le68, 0.1),
                (found.le90, exact.le90, 0.1),
            ] {
                let bound = share * width(exact) + 1e-4;
                assert!((found - exact).abs() <= bound, "{mean} {spread}: {found} {exact}");
            }
            let deviation = exact.nmad / NMAD_FACTOR;
            let widest = width(exact.median.abs() + deviation);
            assert!((found.deviation - deviation).abs() <= 0.3 * widest + 1e-4, "{mean} {spread}");
        }
    }

    #[test]
    fn extreme_errors_do_not_blunt_the_quantiles_of_others() {
        let mut errors: Vec<f64> = (0..2000).map(|i| normal(key(&[4, i]))).collect();
        errors.extend([7e38, -7e38, 1e-45]);
        let exact = Quantiles::of(&errors, &mut Vec::new());
        let found = quantiles_of(&Sketch::of(&errors));
        assert!((found.le90 / exact.le90 - 1.0).abs() < 0.01);
        assert!((found.deviation * NMAD_FACTOR / exact.nmad - 1.0).abs() < 0.03);
    }

    #[test]
    fn damaged_sketches_are_refused() {
        for text in ["[1]", "[0,5]", "[40000,1,0,1]", "[4294967295,1]", "[1,1]", "[60000,1]"] {
            assert!(serde_json::from_str::<Sketch>(text).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn any_quantile_is_within_a_bin_and_sketches_merge_and_return(
            errors in proptest::collection::vec(
                prop_oneof![-50.0..50.0_f64, (-9..9_i32).prop_map(f64::from), -0.1..0.1_f64],
                1..300,
            ),
            split in 0..300_usize,
        ) {
            let split = split.min(errors.len());
            let whole = Sketch::of(&errors);
            let mut merged = Sketch::of(&errors[..split]);
            merged.merge(&Sketch::of(&errors[split..]));
            prop_assert_eq!(&merged, &whole);
            let text = serde_json::to_string(&whole).unwrap();
            prop_assert_eq!(&serde_json::from_str::<Sketch>(&text).unwrap(), &whole);

            // The sketch's le90 lies in or between the bins of the order statistics around it.
            let mut absolute: Vec<f64> = errors.iter().map(|e| e.abs()).collect();
            absolute.sort_by(f64::total_cmp);
            let rank = 0.9 * absolute.len() as f64;
            let low = absolute[(rank - 1.0).max(0.0).floor() as usize];
            let high = absolute[(rank.ceil() as usize).min(absolute.len() - 1)];
            let found = quantiles_of(&whole).le90;
            prop_assert!(found >= low - width(low) - 1e-9 && found <= high + width(high) + 1e-9);
        }
    }
}
