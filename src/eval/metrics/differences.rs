//! Which of two sets of predictions is better, and whether that is more than noise.
//!
//! Both sets are scored on the images that both have, and both on the same drawn blocks, so that
//! what is hard for both cancels out.

use super::bootstrap::{BootstrapSettings, by_name, check_thresholds, draw, ends, transposed};
use super::quantiles::Quantiles;
use super::samples::{Centre, ImageSample, Units, Workspace, exact_scores, score_names};
use super::student::{expanded_level, unexpanded_level};
use crate::eval::protocol::Protocol;
use crate::eval::summary::{Difference, ScoreDifference};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Names the sequences of random numbers of this module.
const PURPOSE: u64 = 0x5041_4952;

/// What a difference must stay under to be more than noise, over all differences of a run.
const SIGNIFICANCE: f64 = 0.05;

/// Most replicates that are drawn to tell small p-values apart.
const MOST_REPLICATES: u32 = 20_000;

/// One set of predictions to compare.
#[derive(Clone, Copy, Debug)]
pub struct ComparedSet<'a> {
    /// Its name.
    pub model: &'a str,
    /// The protocol that it was scored under.
    pub protocol: Protocol,
    /// Its images.
    pub images: &'a [ImageSample],
    /// Exact quantiles over all of its images, if they are known.
    pub quantiles: Option<Quantiles>,
}

/// `b - a` for all pairs of sets of the same protocol (`a` before `b` in the list).
///
/// Every score of [`super::intervals`] is compared; quantiles only where the two sets have the same
/// images and their exact quantiles are given, because only then are their values known exactly.
/// The p-value is twice the smaller of the shares `(1 + n) / (replicates + 1)` of replicates at or
/// below, and at or above, no difference, corrected for small numbers of blocks as the ends of the
/// interval are (see `metrics::bootstrap`): with two blocks nothing is significant. `significant`
/// is Holm's correction at 5 % over all pairs of sets, score by score: scores are not independent
/// questions (one model is better than another in most of them or in none), pairs are. There are at least
/// `settings.replicates` replicates, and up to 20,000 where smaller p-values must be told apart for
/// that many differences. Ends and p-value are NaN where the images lie in one block.
///
/// # Panics
/// When `thresholds` (metres) are not those that the images were counted by.
#[must_use]
pub fn differences(
    sets: &[ComparedSet<'_>],
    thresholds: &[f64],
    settings: &BootstrapSettings,
) -> Vec<Difference> {
    let sorted: Vec<Vec<&ImageSample>> = sets
        .iter()
        .map(|set| {
            check_thresholds(set.images, thresholds);
            by_name(set.images)
        })
        .collect();
    let mut pairs = Vec::new();
    for (at, a) in sets.iter().enumerate() {
        for (beyond, b) in sets[at + 1..].iter().enumerate() {
            if a.protocol == b.protocol {
                pairs.push(Pair::new((a, &sorted[at]), (b, &sorted[at + 1 + beyond])));
            }
        }
    }
    let tests = pairs.len();
    let mut found: Vec<Difference> =
        pairs.iter().map(|pair| pair.compare(thresholds.len(), tests, settings)).collect();
    holm(&mut found);
    found
}

struct Pair<'a> {
    a: &'a ComparedSet<'a>,
    b: &'a ComparedSet<'a>,
    /// Images that both have, in the same order.
    images: [Vec<&'a ImageSample>; 2],
    /// Quantiles over these images.
    quantiles: Option<[Quantiles; 2]>,
}

impl<'a> Pair<'a> {
    fn new(
        (a, images_a): (&'a ComparedSet<'a>, &[&'a ImageSample]),
        (b, images_b): (&'a ComparedSet<'a>, &[&'a ImageSample]),
    ) -> Self {
        let (mut both_a, mut both_b) = (Vec::new(), Vec::new());
        for image in images_a {
            if let Ok(at) = images_b.binary_search_by(|other| other.name.cmp(&image.name)) {
                both_a.push(*image);
                both_b.push(images_b[at]);
            }
        }
        let same = both_a.len() == images_a.len() && both_a.len() == images_b.len();
        let quantiles = match (a.quantiles, b.quantiles) {
            (Some(of_a), Some(of_b)) if same => Some([of_a, of_b]),
            _ => None,
        };
        Self { a, b, images: [both_a, both_b], quantiles }
    }

    fn names(&self, thresholds: usize) -> Vec<String> {
        score_names(thresholds, self.quantiles.is_some())
    }

    fn compare(&self, thresholds: usize, tests: usize, settings: &BootstrapSettings) -> Difference {
        // Blocks are those of `a`: the same image lies in the same place in both.
        let placed: Vec<ImageSample> = self.images[1]
            .iter()
            .zip(&self.images[0])
            .filter(|(of_b, of_a)| of_b.block != of_a.block)
            .map(|(of_b, of_a)| ImageSample { block: of_a.block, ..(*of_b).clone() })
            .collect();
        let images_b: Vec<&ImageSample> = self.images[1]
            .iter()
            .map(|image| {
                let moved = placed.binary_search_by(|other| other.name.cmp(&image.name));
                moved.map_or(*image, |at| &placed[at])
            })
            .collect();
        let units =
            [Units::blocks(&self.images[0], thresholds), Units::blocks(&images_b, thresholds)];
        let values = [0, 1].map(|side| {
            let quantiles = self.quantiles.as_ref().map(|both| &both[side]);
            exact_scores(&self.images[side], thresholds, quantiles)
        });
        let blocks = units[0].len();
        let count = enough_replicates(settings.replicates, tests, blocks);
        let replicates = transposed(&self.replicates(&units, count, settings.seed));
        let scores = self
            .names(thresholds)
            .into_iter()
            .enumerate()
            .map(|(at, score)| {
                let (a, b) = (values[0][at], values[1][at]);
                let mut drawn = replicates.get(at).cloned().unwrap_or_default();
                let (low, high) = ends(&mut drawn, blocks, settings.level_pct);
                let p_value = p_value(&drawn, blocks);
                ScoreDifference {
                    score,
                    a,
                    b,
                    difference: b - a,
                    low,
                    high,
                    p_value,
                    significant: false,
                }
            })
            .collect();
        Difference {
            a: self.a.model.into(),
            b: self.b.model.into(),
            protocol: self.a.protocol,
            images: self.images[0].len() as u64,
            scores,
        }
    }

    /// Replicates of the differences of all scores.
    fn replicates(&self, units: &[Units<'_>; 2], count: u32, seed: u64) -> Vec<Vec<f64>> {
        let centres = self.quantiles.as_ref().map(|both| {
            [0, 1].map(|side| Centre::new(&both[side], &units[side], &mut Workspace::default()))
        });
        (0..count)
            .into_par_iter()
            .map_init(
                || (Workspace::default(), vec![0; units[0].len()], [Vec::new(), Vec::new()]),
                |(workspace, weights, scores), replicate| {
                    draw(&[seed, PURPOSE, u64::from(replicate)], weights);
                    for side in [0, 1] {
                        units[side].scores(weights, workspace, &mut scores[side]);
                        if let Some(centres) = &centres {
                            let found =
                                units[side].quantiles(std::slice::from_ref(weights), workspace);
                            scores[side]
                                .extend(found.iter().flat_map(|q| centres[side].replicate(*q)));
                        }
                    }
                    scores[1].iter().zip(&scores[0]).map(|(b, a)| b - a).collect()
                },
            )
            .collect()
    }
}

/// As many replicates as let one of `tests` differences, the clearest one, pass Holm's correction
/// with a margin of four.
fn enough_replicates(wanted: u32, tests: usize, blocks: usize) -> u32 {
    if blocks < 2 || tests == 0 {
        return wanted;
    }
    let smallest = 2.0 * expanded_level(SIGNIFICANCE / 8.0 / tests as f64, blocks as u64);
    let needed = (2.0 / smallest).min(f64::from(MOST_REPLICATES)) as u32;
    wanted.max(needed)
}

/// Two-sided p-value of no difference, from replicates of the difference; NaN where there are none
/// or fewer than two blocks.
fn p_value(replicates: &[f64], blocks: usize) -> f64 {
    if blocks < 2 || replicates.is_empty() {
        return f64::NAN;
    }
    let share = |count: usize| (1 + count) as f64 / (1 + replicates.len()) as f64;
    let low = share(replicates.iter().filter(|value| **value <= 0.0).count());
    let high = share(replicates.iter().filter(|value| **value >= 0.0).count());
    let tail = low.min(high);
    if tail >= 0.5 { 1.0 } else { (2.0 * unexpanded_level(tail, blocks as u64)).min(1.0) }
}

/// Holm (1979): the smallest p-value must be under a share of the level, the next under a larger one,
/// until one is not. Differences without a p-value are no tests.
fn holm(differences: &mut [Difference]) {
    let mut families: BTreeMap<String, Vec<&mut ScoreDifference>> = BTreeMap::new();
    for score in differences.iter_mut().flat_map(|difference| &mut difference.scores) {
        if !score.p_value.is_nan() {
            families.entry(score.score.clone()).or_default().push(score);
        }
    }
    for mut tests in families.into_values() {
        tests.sort_by(|a, b| a.p_value.total_cmp(&b.p_value));
        let count = tests.len();
        for (rank, score) in tests.into_iter().enumerate() {
            if score.p_value > SIGNIFICANCE / (count - rank) as f64 {
                break;
            }
            score.significant = true;
        }
    }
}

#[cfg(test)]
#[path = "differences_tests.rs"]
mod tests;
