//! The vertical offset between two surfaces: median, mean, or the published RANSAC.

use super::{AlignError, AlignSettings, Alignment, AlignmentFlag};
use crate::eval::{OffsetMethod, Surface};
use crate::random::Draw;

/// Draws of RANSAC.
const DRAWS: usize = 150;
/// Pixels per draw.
const SAMPLE: usize = 50;
/// A difference is an inlier when it is closer than this to the draw's median, metres.
const INLIER_M: f64 = 1.5;
/// Fewer inliers than these leave the best draw's median as it is.
const LEAST_INLIERS: usize = 20;
/// Names RANSAC's numbers among all that come from one seed.
const PURPOSE: u64 = 0x5241_4E53_4143;

/// Finds vertical offsets and keeps its buffer.
#[derive(Default)]
pub(super) struct OffsetFinder {
    differences: Vec<f64>,
}

impl OffsetFinder {
    /// Writes the offset (and what RANSAC says) into `alignment`.
    pub(super) fn find(
        &mut self,
        prediction: &Surface,
        aligned: &Surface,
        settings: &AlignSettings,
        alignment: &mut Alignment,
    ) -> Result<(), AlignError> {
        let differences = &mut self.differences;
        differences.clear();
        differences.extend(
            aligned
                .values
                .iter()
                .zip(&prediction.values)
                .map(|(truth, prediction)| f64::from(*truth) - f64::from(*prediction))
                .filter(|d| !d.is_nan()),
        );
        let needed = if settings.offset == OffsetMethod::Ransac { SAMPLE } else { 1 };
        if differences.len() < needed {
            return Err(AlignError::TooFewPixels {
                pixels: differences.len() as u64,
                needed: needed as u64,
            });
        }
        alignment.vertical_offset_m = match settings.offset {
            OffsetMethod::Median => median(differences),
            OffsetMethod::Mean => differences.iter().sum::<f64>() / differences.len() as f64,
            OffsetMethod::Ransac => {
                let found = ransac(differences, settings.seed);
                alignment.inliers = Some(found.inliers as u64);
                if found.inliers < LEAST_INLIERS {
                    alignment.flags.push(AlignmentFlag::FewInliers);
                }
                found.offset_m
            }
        };
        Ok(())
    }
}

/// Median by selection (the mean of the middle two of an even count); NaN for an empty list.
/// Reorders the list.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    let even = values.len().is_multiple_of(2);
    let (below, upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    if even {
        let lower = below.iter().copied().max_by(f64::total_cmp).unwrap_or(*upper);
        // Halves first: two huge values must not overflow.
        0.5 * lower + 0.5 * *upper
    } else {
        *upper
    }
}

/// What RANSAC found.
struct Consensus {
    offset_m: f64,
    inliers: usize,
}

/// The published RANSAC. Sorts the differences once: then the median of a draw is a matter of ranks
/// and the count of inliers one of two binary searches. A draw of ranks is as good as a draw of
/// pixels, and independent of where the pixels are.
fn ransac(differences: &mut [f64], seed: u64) -> Consensus {
    sort(differences);
    let differences = &*differences;
    let mut draw = Draw::new(&[seed, PURPOSE]);
    let mut ranks = Vec::with_capacity(SAMPLE);
    let mut best = (0.0, 0..0);
    for attempt in 0..DRAWS {
        sample(&mut draw, differences.len(), &mut ranks);
        ranks.sort_unstable();
        let candidate =
            0.5 * differences[ranks[SAMPLE / 2 - 1]] + 0.5 * differences[ranks[SAMPLE / 2]];
        let inliers = within(differences, candidate);
        if attempt == 0 || inliers.len() > best.1.len() {
            best = (candidate, inliers);
        }
    }
    let (candidate, range) = best;
    let inliers = &differences[range];
    let offset_m = if inliers.len() < LEAST_INLIERS {
        candidate
    } else {
        // About the candidate, which keeps digits.
        candidate + inliers.iter().map(|d| d - candidate).sum::<f64>() / inliers.len() as f64
    };
    Consensus { offset_m, inliers: inliers.len() }
}

/// Sorts by value.
fn sort(values: &mut [f64]) {
    values.sort_unstable_by(f64::total_cmp);
}

/// Different numbers below `count` (Floyd's method), unsorted.
fn sample(draw: &mut Draw, count: usize, ranks: &mut Vec<usize>) {
    ranks.clear();
    for last in count - SAMPLE..count {
        let rank = draw.index(last + 1);
        ranks.push(if ranks.contains(&rank) { last } else { rank });
    }
}

/// Range of the sorted differences that are closer than the limit to a candidate. The condition is
/// the one that a count over all would use, and it is monotone on each side of the candidate, so the
/// range is exact.
fn within(sorted: &[f64], candidate: f64) -> std::ops::Range<usize> {
    let close = |d: f64| (d - candidate).abs() < INLIER_M;
    let begin = sorted.partition_point(|d| *d < candidate && !close(*d));
    let end = sorted.partition_point(|d| *d <= candidate || close(*d));
    begin..end.max(begin)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counting_by_search_is_counting() {
        let mut draw = Draw::new(&[5]);
        for round in 0..200 {
            let scale = [1e-6, 1.0, 1.5, 3.0, 1e6, 1e30][round % 6];
            let mut values: Vec<f64> = (0..400)
                .map(|_| {
                    let value = draw.range(-2.0, 2.0) * scale;
                    // Many equal ones, and many exactly at the limit.
                    if draw.chance(0.5) { (value * 2.0).round() / 2.0 } else { value }
                })
                .collect();
            sort(&mut values);
            for _ in 0..20 {
                let candidate = values[draw.index(values.len())];
                let direct = values.iter().filter(|d| (**d - candidate).abs() < INLIER_M).count();
                assert_eq!(within(&values, candidate).len(), direct);
            }
        }
    }

    #[test]
    fn samples_are_different_and_cover_all() {
        let mut draw = Draw::new(&[6]);
        let mut ranks = Vec::new();
        let mut seen = [0_u32; 60];
        for _ in 0..600 {
            sample(&mut draw, 60, &mut ranks);
            ranks.sort_unstable();
            ranks.dedup();
            assert_eq!(ranks.len(), SAMPLE);
            for rank in &ranks {
                seen[*rank] += 1;
            }
        }
        // 500 expected each, standard deviation 9.
        assert!(seen.iter().all(|n| (440..560).contains(n)), "{seen:?}");
        sample(&mut draw, SAMPLE, &mut ranks);
        ranks.sort_unstable();
        assert_eq!(ranks, (0..SAMPLE).collect::<Vec<_>>());
    }

    #[test]
    fn ransac_ignores_outliers_and_says_when_nothing_agrees() {
        let mut draw = Draw::new(&[7]);
        let mut values: Vec<f64> = (0..4000)
            .map(|i| if i % 3 == 0 { draw.range(8.0, 60.0) } else { 5.0 + draw.range(-1.0, 1.0) })
            .collect();
        let found = ransac(&mut values, 1);
        assert!((found.offset_m - 5.0).abs() < 0.05, "{}", found.offset_m);
        assert!((2660..2700).contains(&found.inliers), "{}", found.inliers);
        let mut sparse: Vec<f64> = (0..100).map(|i| f64::from(i) * 1000.0).collect();
        assert!(ransac(&mut sparse, 1).inliers <= 1);
    }

    #[test]
    fn medians() {
        assert!(median(&mut []).is_nan());
        assert_eq!(median(&mut [3.0]), 3.0);
        assert_eq!(median(&mut [4.0, 1.0]), 2.5);
        assert_eq!(median(&mut [4.0, 1.0, -7.0]), 1.0);
        assert_eq!(median(&mut [f64::MAX, f64::MAX]), f64::MAX);
    }
}
