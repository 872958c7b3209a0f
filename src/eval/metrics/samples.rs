//! Images as a bootstrap sees them: one row of sums each, added up by blocks.

use super::quantiles::Quantiles;
use super::sketch::{self, Sketch, SketchQuantiles, bin_edge};
use super::sums::{ErrorSums, mean};
use crate::eval::summary::MeanScores;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One image for [`super::intervals()`] and [`super::differences()`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageSample {
    /// Its name, which no other image has.
    pub name: String,
    /// The block that it lies in ([`super::block_of`], [`super::lone_block`]).
    pub block: (i64, i64),
    /// Sums of its errors.
    pub sums: ErrorSums,
    /// Pixels of the aligned ground truth that have a height.
    pub truth_pixels: u64,
    /// Distribution of its errors.
    pub sketch: Sketch,
}

impl ImageSample {
    /// Share of the ground truth that has a prediction, per cent; NaN without ground truth.
    #[must_use]
    pub fn completeness_pct(&self) -> f64 {
        100.0 * self.sums.pixels() as f64 / self.truth_pixels as f64
    }
}

/// Means over images of their scores, and of their shares under each of the thresholds (all of the
/// list, per cent). An image without a pixel, or without ground truth, has no such score and is left
/// out of its mean.
#[must_use]
pub fn mean_scores(images: &[ImageSample], thresholds: usize) -> (MeanScores, Vec<f64>) {
    mean_scores_of(&images.iter().collect::<Vec<_>>(), thresholds)
}

fn mean_scores_of(images: &[&ImageSample], thresholds: usize) -> (MeanScores, Vec<f64>) {
    let mean_of = |score: &dyn Fn(&ImageSample) -> f64| {
        let values: Vec<f64> =
            images.iter().map(|image| score(image)).filter(|value| !value.is_nan()).collect();
        mean(&values)
    };
    let below: Vec<f64> =
        (0..thresholds).map(|at| mean_of(&|image| image.sums.below_pct(at))).collect();
    let scores = MeanScores {
        mae_m: mean_of(&|image| image.sums.mae()),
        rmse_m: mean_of(&|image| image.sums.rmse()),
        lt_2_5_m_pct: below.first().copied().unwrap_or(f64::NAN),
        lt_7_5_m_pct: below.get(1).copied().unwrap_or(f64::NAN),
        bias_m: mean_of(&|image| image.sums.bias()),
        completeness_pct: mean_of(&ImageSample::completeness_pct),
    };
    (scores, below)
}

/// Columns of a row of sums; shares under thresholds (sum of per cent, then counts) follow.
mod column {
    pub const IMAGES: usize = 0;
    pub const MAE: usize = 1;
    pub const RMSE: usize = 2;
    pub const BIAS: usize = 3;
    pub const TRUTH_IMAGES: usize = 4;
    pub const COMPLETENESS: usize = 5;
    pub const PIXELS: usize = 6;
    pub const ABSOLUTE: usize = 7;
    pub const SQUARE: usize = 8;
    pub const SUM: usize = 9;
    pub const TRUTH: usize = 10;
    pub const BELOW: usize = 11;
}

/// Names of the scores in the order in which [`scores`] gives them; quantiles follow.
pub(super) fn score_names(thresholds: usize, quantiles: bool) -> Vec<String> {
    let mut names: Vec<String> = [
        "per_image_mean.mae_m",
        "per_image_mean.rmse_m",
        "per_image_mean.lt_2_5_m_pct",
        "per_image_mean.lt_7_5_m_pct",
        "per_image_mean.bias_m",
        "per_image_mean.completeness_pct",
        "pooled.mae_m",
        "pooled.rmse_m",
        "pooled.bias_m",
        "pooled.lt_2_5_m_pct",
        "pooled.lt_7_5_m_pct",
        "pooled.completeness_pct",
    ]
    .map(String::from)
    .into();
    for further in 0..thresholds.saturating_sub(2) {
        names.push(format!("pooled.thresholds[{further}].pooled_pct"));
        names.push(format!("pooled.thresholds[{further}].per_image_mean_pct"));
    }
    if quantiles {
        names.extend(["median_m", "nmad_m", "le68_m", "le90_m"].map(|n| format!("pooled.{n}")));
    }
    names
}

/// Scores of single images are summed up as what they are above those of one of them, so that scores
/// that are all equal have a mean that is equal to them.
fn origin(images: &[&ImageSample], thresholds: usize) -> Vec<f64> {
    let nothing = vec![0.0; column::BELOW + 2 * thresholds];
    let complete = images.iter().find(|image| image.sums.pixels() > 0 && image.truth_pixels > 0);
    let mut origin = complete.map_or(nothing.clone(), |image| row(image, &nothing, thresholds));
    origin[column::IMAGES] = 0.0;
    origin[column::TRUTH_IMAGES] = 0.0;
    origin[column::PIXELS..column::BELOW].fill(0.0);
    origin[column::BELOW + thresholds..].fill(0.0);
    origin
}

fn row(image: &ImageSample, origin: &[f64], thresholds: usize) -> Vec<f64> {
    let mut row = vec![0.0; column::BELOW + 2 * thresholds];
    let (sums, pixels) = (&image.sums, image.sums.pixels() as f64);
    if sums.pixels() > 0 {
        row[column::IMAGES] = 1.0;
        row[column::MAE] = sums.mae() - origin[column::MAE];
        row[column::RMSE] = sums.rmse() - origin[column::RMSE];
        row[column::BIAS] = sums.bias() - origin[column::BIAS];
        row[column::PIXELS] = pixels;
        row[column::ABSOLUTE] = sums.mae() * pixels;
        row[column::SQUARE] = sums.rmse() * sums.rmse() * pixels;
        row[column::SUM] = sums.bias() * pixels;
        for threshold in 0..thresholds {
            let at = column::BELOW + threshold;
            row[at] = sums.below_pct(threshold) - origin[at];
            row[column::BELOW + thresholds + threshold] = sums.below(threshold) as f64;
        }
    }
    if image.truth_pixels > 0 {
        row[column::TRUTH_IMAGES] = 1.0;
        row[column::COMPLETENESS] = image.completeness_pct() - origin[column::COMPLETENESS];
        row[column::TRUTH] = image.truth_pixels as f64;
    }
    row
}

/// Scores from a row of sums, in the order of [`score_names`].
fn scores(row: &[f64], origin: &[f64], thresholds: usize, into: &mut Vec<f64>) {
    use column::*;
    let by_image = |at: usize| origin[at] + row[at] / row[IMAGES];
    let by_pixel = |at: usize| row[at] / row[PIXELS];
    into.clear();
    into.extend([
        by_image(MAE),
        by_image(RMSE),
        by_image(BELOW),
        by_image(BELOW + 1),
        by_image(BIAS),
        origin[COMPLETENESS] + row[COMPLETENESS] / row[TRUTH_IMAGES],
        by_pixel(ABSOLUTE),
        by_pixel(SQUARE).sqrt(),
        by_pixel(SUM),
        100.0 * by_pixel(BELOW + thresholds),
        100.0 * by_pixel(BELOW + thresholds + 1),
        100.0 * row[PIXELS] / row[TRUTH],
    ]);
    for threshold in 2..thresholds {
        into.push(100.0 * by_pixel(BELOW + thresholds + threshold));
        into.push(by_image(BELOW + threshold));
    }
}

/// The scores themselves, from sums that lose nothing.
pub(super) fn exact_scores(
    images: &[&ImageSample],
    thresholds: usize,
    quantiles: Option<&Quantiles>,
) -> Vec<f64> {
    let (means, below) = mean_scores_of(images, thresholds);
    let mut pooled = ErrorSums::new(thresholds);
    let mut truth = 0;
    for image in images {
        pooled.merge(&image.sums);
        truth += image.truth_pixels;
    }
    let mut scores = vec![
        means.mae_m,
        means.rmse_m,
        means.lt_2_5_m_pct,
        means.lt_7_5_m_pct,
        means.bias_m,
        means.completeness_pct,
        pooled.mae(),
        pooled.rmse(),
        pooled.bias(),
        pooled.below_pct(0),
        pooled.below_pct(1),
        100.0 * pooled.pixels() as f64 / truth as f64,
    ];
    for (threshold, mean_pct) in below.iter().enumerate().skip(2) {
        scores.push(pooled.below_pct(threshold));
        scores.push(*mean_pct);
    }
    scores.extend(quantiles.iter().flat_map(|q| [q.median, q.nmad, q.le68, q.le90]));
    scores
}

/// Rows of sums and sketches of the units that are drawn: blocks, or single images.
pub(super) struct Units<'a> {
    columns: usize,
    /// See [`origin`].
    origin: Vec<f64>,
    rows: Vec<f64>,
    sketches: Sketches<'a>,
    /// The lowest bin that any unit uses.
    lowest: i32,
    /// Edges of all bins between the lowest and the highest that any unit uses.
    edges: Vec<f64>,
    thresholds: usize,
}

enum Sketches<'a> {
    /// Of single images, as they are: there are many.
    Images(Vec<&'a [(i16, u32)]>),
    /// Of blocks.
    Blocks(Vec<Vec<(i16, f64)>>),
}

/// Room for one replicate.
#[derive(Default)]
pub(super) struct Workspace {
    row: Vec<f64>,
    counts: Vec<f64>,
    cumulative: Vec<f64>,
}

impl<'a> Units<'a> {
    /// Every image is a unit.
    pub fn images(images: &[&'a ImageSample], thresholds: usize) -> Self {
        let sketches = images.iter().map(|image| image.sketch.bins()).collect();
        let origin = origin(images, thresholds);
        let rows = images.iter().flat_map(|image| row(image, &origin, thresholds)).collect();
        Self::new(images, origin, rows, Sketches::Images(sketches), thresholds)
    }

    /// Every block is a unit, in the order of their places.
    pub fn blocks(images: &[&'a ImageSample], thresholds: usize) -> Self {
        let origin = origin(images, thresholds);
        let mut blocks = BTreeMap::<(i64, i64), (Vec<f64>, BTreeMap<i16, f64>)>::new();
        for image in images {
            let (sum, bins) = blocks.entry(image.block).or_default();
            sum.resize(column::BELOW + 2 * thresholds, 0.0);
            for (total, value) in sum.iter_mut().zip(row(image, &origin, thresholds)) {
                *total += value;
            }
            for (bin, count) in image.sketch.bins() {
                *bins.entry(*bin).or_insert(0.0) += f64::from(*count);
            }
        }
        let (rows, sketches): (Vec<_>, Vec<_>) = blocks
            .into_values()
            .map(|(row, bins)| (row, bins.into_iter().collect::<Vec<_>>()))
            .unzip();
        Self::new(images, origin, rows.concat(), Sketches::Blocks(sketches), thresholds)
    }

    fn new(
        images: &[&'a ImageSample],
        origin: Vec<f64>,
        rows: Vec<f64>,
        sketches: Sketches<'a>,
        thresholds: usize,
    ) -> Self {
        let bins =
            images.iter().flat_map(|image| image.sketch.bins()).map(|(bin, _)| i32::from(*bin));
        let (lowest, highest) =
            bins.fold((i32::MAX, i32::MIN), |(low, high), bin| (low.min(bin), high.max(bin)));
        let (lowest, highest) = if lowest <= highest { (lowest, highest) } else { (0, 0) };
        Self {
            columns: column::BELOW + 2 * thresholds,
            origin,
            rows,
            sketches,
            lowest,
            edges: (lowest..=highest + 1).map(bin_edge).collect(),
            thresholds,
        }
    }

    pub fn len(&self) -> usize {
        self.rows.len() / self.columns
    }

    /// Scores when every unit is there as many times as `weights` says.
    pub fn scores(&self, weights: &[u32], workspace: &mut Workspace, into: &mut Vec<f64>) {
        workspace.row.clear();
        workspace.row.resize(self.columns, 0.0);
        for (row, weight) in self.rows.chunks_exact(self.columns).zip(weights) {
            if *weight > 0 {
                for (total, value) in workspace.row.iter_mut().zip(row) {
                    *total += f64::from(*weight) * value;
                }
            }
        }
        scores(&workspace.row, &self.origin, self.thresholds, into);
    }

    /// Quantiles in the same case, for each of some lists of weights: the sketches of all units are
    /// far larger than a cache, so that they are read once for all lists. Counts are whole numbers:
    /// their sums are exact.
    pub fn quantiles(
        &self,
        weights: &[Vec<u32>],
        workspace: &mut Workspace,
    ) -> Vec<SketchQuantiles> {
        let bins = self.edges.len() - 1;
        workspace.counts.clear();
        workspace.counts.resize(bins * weights.len(), 0.0);
        for unit in 0..self.len() {
            for (weights, counts) in weights.iter().zip(workspace.counts.chunks_exact_mut(bins)) {
                let weight = f64::from(weights[unit]);
                if weight > 0.0 {
                    let place = |bin: i16| (i32::from(bin) - self.lowest) as usize;
                    match &self.sketches {
                        Sketches::Images(sketches) => {
                            for (bin, errors) in sketches[unit] {
                                counts[place(*bin)] += weight * f64::from(*errors);
                            }
                        }
                        Sketches::Blocks(sketches) => {
                            for (bin, errors) in &sketches[unit] {
                                counts[place(*bin)] += weight * errors;
                            }
                        }
                    }
                }
            }
        }
        workspace
            .counts
            .chunks_exact(bins)
            .map(|counts| sketch::quantiles(counts, &self.edges, &mut workspace.cumulative))
            .collect()
    }
}

/// Where replicates of the quantiles are taken to: the exact value, moved as the sketch's moved.
#[derive(Clone, Copy)]
pub(super) struct Centre {
    exact: Quantiles,
    sketched: SketchQuantiles,
}

impl Centre {
    /// From the exact quantiles and those of the sketch of all images.
    pub fn new(exact: &Quantiles, units: &Units<'_>, workspace: &mut Workspace) -> Self {
        let weights = [vec![1; units.len()]];
        Self { exact: *exact, sketched: units.quantiles(&weights, workspace)[0] }
    }

    /// A replicate's median, NMAD, LE68 and LE90. The last three are scales: they move in proportion,
    /// so that they stay above 0.
    pub fn replicate(&self, found: SketchQuantiles) -> [f64; 4] {
        let scaled = |exact: f64, found: f64, sketched: f64| {
            if sketched > 0.0 { exact * (found / sketched) } else { exact }
        };
        [
            self.exact.median + (found.median - self.sketched.median),
            scaled(self.exact.nmad, found.deviation, self.sketched.deviation),
            scaled(self.exact.le68, found.le68, self.sketched.le68),
            scaled(self.exact.le90, found.le90, self.sketched.le90),
        ]
    }
}
