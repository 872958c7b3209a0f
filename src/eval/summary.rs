//! What an evaluation says: the types behind `--json`, the table, the report.
//!
//! `error = prediction - (aligned truth - vertical offset)`, metres. Numbers that cannot be computed
//! (no pixels) are NaN here and `null` in JSON.

use super::align::{AlignmentFlag, Coregistration, Shift};
use super::protocol::{OffsetMethod, Protocol};
use crate::batch::Status;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One set of predictions under one protocol.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// `sat3d-eval-1`.
    pub schema: String,
    /// Name of the set of predictions: its folder's, made unique.
    pub model: String,
    /// The protocol.
    pub protocol: Protocol,
    /// How vertical offsets were found.
    pub offset: OffsetMethod,
    /// Seed of everything random.
    pub seed: u64,
    /// How to read the numbers.
    pub conventions: BTreeMap<String, String>,
    /// How many images there were and what became of them.
    pub images: ImageCounts,
    /// Why images were skipped or failed, or flagged: reason -> images.
    pub reasons: BTreeMap<String, u64>,
    /// Scores per image, then the mean over images. Every image counts the same.
    pub per_image_mean: MeanScores,
    /// Scores over all pixels of all images. Every pixel counts the same.
    pub pooled: PooledScores,
    /// The four numbers of the paper's table, averaged as the paper averages them.
    pub as_published: PublishedScores,
    /// 95 % bootstrap intervals.
    pub intervals: Intervals,
    /// Scores by kind of place.
    pub strata: Vec<StratumGroup>,
    /// Distribution of the errors over all pixels.
    pub histogram: ErrorHistogram,
    /// Where in the images the errors are.
    pub by_position: PositionMap,
    /// Offset between images and ground truth, estimated and not applied.
    pub registration: Option<Registration>,
    /// One row per image that either side has, sorted by name.
    pub per_image: Vec<ImageScore>,
}

/// How many images there were and what became of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageCounts {
    /// Names that either side has.
    pub found: u64,
    /// Scored.
    pub evaluated: u64,
    /// Left out for a reason that is no error (no partner).
    pub skipped: u64,
    /// Could not be scored (unreadable, wrong shape, nothing in common).
    pub failed: u64,
    /// Scored without alignment, because none within the limits was found.
    pub unaligned: u64,
}

/// Means over images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeanScores {
    /// Mean of the images' mean absolute errors, metres (as published).
    pub mae_m: f64,
    /// Mean of the images' root mean square errors, metres (as published).
    pub rmse_m: f64,
    /// Mean of the images' shares of pixels under 2.5 m, per cent (not as published).
    pub lt_2_5_m_pct: f64,
    /// Mean of the images' shares of pixels under 7.5 m, per cent (not as published).
    pub lt_7_5_m_pct: f64,
    /// Mean of the images' mean errors, metres.
    pub bias_m: f64,
    /// Mean of the images' completeness, per cent.
    pub completeness_pct: f64,
}

/// Scores over pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PooledScores {
    /// Mean absolute error, metres (not as published).
    pub mae_m: f64,
    /// Root mean square error, metres (not as published).
    pub rmse_m: f64,
    /// Mean error, metres.
    pub bias_m: f64,
    /// Population standard deviation of the errors, metres.
    pub std_m: f64,
    /// Median error, metres.
    pub median_m: f64,
    /// 1.4826 times the median absolute deviation from the median, metres.
    pub nmad_m: f64,
    /// 68th percentile of the absolute errors, metres.
    pub le68_m: f64,
    /// 90th percentile of the absolute errors, metres.
    pub le90_m: f64,
    /// 95th percentile of the absolute errors, metres.
    pub p95_m: f64,
    /// Largest absolute error, metres.
    pub max_m: f64,
    /// Share of pixels under 2.5 m, per cent (as published).
    pub lt_2_5_m_pct: f64,
    /// Share of pixels under 7.5 m, per cent (as published).
    pub lt_7_5_m_pct: f64,
    /// Further thresholds.
    pub thresholds: Vec<ThresholdShare>,
    /// Pixels compared.
    pub pixels: u64,
    /// Pixels of the aligned ground truth that have a height.
    pub truth_pixels: u64,
    /// Share of those that have a prediction, per cent.
    pub completeness_pct: f64,
}

/// Share of errors under a threshold of `--thresholds`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ThresholdShare {
    /// Threshold, metres; errors equal to it do not count.
    pub threshold_m: f64,
    /// Share of all pixels, per cent.
    pub pooled_pct: f64,
    /// Mean over images of their shares, per cent.
    pub per_image_mean_pct: f64,
}

/// The four numbers of the paper's table.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PublishedScores {
    /// Mean over images, metres.
    pub mae_m: f64,
    /// Mean over images, metres.
    pub rmse_m: f64,
    /// Over pixels, per cent.
    pub lt_2_5_m_pct: f64,
    /// Over pixels, per cent.
    pub lt_7_5_m_pct: f64,
}

/// Bootstrap intervals of the scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intervals {
    /// Side of the blocks that are drawn as a whole, metres.
    pub block_m: f64,
    /// Number of blocks that hold images.
    pub blocks: u64,
    /// Draws.
    pub replicates: u32,
    /// Confidence level, per cent.
    pub level_pct: f64,
    /// One per score.
    pub scores: Vec<Interval>,
}

/// Interval of one score.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Path of the score in this document, for example `pooled.lt_2_5_m_pct`.
    pub score: String,
    /// The score itself.
    pub value: f64,
    /// Drawing blocks: ends of the interval. NaN where there are fewer than two blocks.
    pub low: f64,
    /// See `low`.
    pub high: f64,
    /// Drawing single images, as if they were independent (they overlap, so this is too narrow).
    pub naive_low: f64,
    /// See `naive_low`.
    pub naive_high: f64,
}

/// Scores by kind of place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StratumGroup {
    /// `slope`, `edge_distance`, `height_above_ground` or `class`.
    pub name: String,
    /// Unit of the limits: `degrees`, `metres` or empty.
    pub unit: String,
    /// What it is, in a sentence.
    pub description: String,
    /// One per bin or class; pixels that no bin takes are in none.
    pub rows: Vec<StratumRow>,
}

/// Scores of one bin or class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StratumRow {
    /// For people: `5 to 15`, `building`.
    pub label: String,
    /// Pixels compared.
    pub pixels: u64,
    /// Share of all pixels compared, per cent.
    pub share_pct: f64,
    /// Pixels of the aligned ground truth, with or without a prediction.
    pub truth_pixels: u64,
    /// Share of those with a prediction, per cent.
    pub completeness_pct: f64,
    /// Over pixels, metres.
    pub mae_m: f64,
    /// Over pixels, metres.
    pub rmse_m: f64,
    /// Over pixels, metres.
    pub bias_m: f64,
    /// Over pixels, metres.
    pub median_m: f64,
    /// Over pixels, metres.
    pub nmad_m: f64,
    /// Over pixels, metres.
    pub le90_m: f64,
    /// Over pixels, per cent.
    pub lt_2_5_m_pct: f64,
    /// Over pixels, per cent.
    pub lt_7_5_m_pct: f64,
}

/// Counts of errors in equal bins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorHistogram {
    /// Lower edge of the first bin, metres.
    pub low_m: f64,
    /// Width of a bin, metres.
    pub bin_m: f64,
    /// Pixels per bin; a bin holds its lower edge.
    pub counts: Vec<u64>,
    /// Pixels below the first bin.
    pub below: u64,
    /// Pixels above the last.
    pub above: u64,
}

/// Mean errors by place in the image, over all images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PositionMap {
    /// Cells across and down.
    pub cells: u32,
    /// Mean absolute error per cell, row-major from the north-west, metres.
    pub mae_m: Vec<f64>,
    /// Mean error per cell, metres.
    pub bias_m: Vec<f64>,
}

/// Offset between the images and the ground truth, estimated over the whole set and not applied.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Registration {
    /// Images that gave an estimate.
    pub images: u64,
    /// Shift that would bring the ground truth onto the predictions, metres east (robust mean over
    /// images) and its standard error.
    pub east_m: Estimate,
    /// The same, metres north.
    pub north_m: Estimate,
    /// Truth minus prediction, metres (predictions have an arbitrary zero; the spread tells of the
    /// datum and of the heights' zero from image to image).
    pub vertical_m: Estimate,
    /// Displacement per metre of height above ground, east: building lean of imagery that is no
    /// true orthophoto.
    pub lean_east: Option<Estimate>,
    /// The same, north.
    pub lean_north: Option<Estimate>,
}

/// A value with its standard error and its spread from image to image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The estimate.
    pub value: f64,
    /// Its standard error.
    pub standard_error: f64,
    /// NMAD over the images.
    pub spread: f64,
}

/// One image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageScore {
    /// Stem of the prediction.
    pub name: String,
    /// Done, skipped or failed.
    pub status: Status,
    /// Why it was skipped or failed; empty when done.
    pub reason: String,
    /// Latitude of the image's centre, degrees, where its name says it.
    pub lat_deg: Option<f64>,
    /// Longitude, degrees.
    pub lon_deg: Option<f64>,
    /// The scores; absent unless done.
    #[serde(flatten)]
    pub scores: Option<ImageScores>,
}

/// Scores of one image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageScores {
    /// Mean absolute error, metres.
    pub mae_m: f64,
    /// Root mean square error, metres.
    pub rmse_m: f64,
    /// Share under 2.5 m, per cent.
    pub lt_2_5_m_pct: f64,
    /// Share under 7.5 m, per cent.
    pub lt_7_5_m_pct: f64,
    /// Mean error, metres.
    pub bias_m: f64,
    /// Median error, metres.
    pub median_m: f64,
    /// NMAD, metres.
    pub nmad_m: f64,
    /// 68th percentile of the absolute errors, metres.
    pub le68_m: f64,
    /// 90th percentile of the absolute errors, metres.
    pub le90_m: f64,
    /// 95th percentile of the absolute errors, metres.
    pub p95_m: f64,
    /// Largest absolute error, metres.
    pub max_m: f64,
    /// Pixels compared.
    pub pixels: u64,
    /// Pixels of the aligned ground truth with a height.
    pub truth_pixels: u64,
    /// Share of those with a prediction, per cent.
    pub completeness_pct: f64,
    /// Shift applied to the ground truth, pixels of the prediction.
    pub shift_px: Shift,
    /// The same on the ground, metres east and south, where the size of a pixel is known.
    pub shift_m: Option<Shift>,
    /// Rotation applied to the ground truth, degrees.
    pub rotation_deg: f64,
    /// Subtracted from the ground truth, metres.
    pub vertical_offset_m: f64,
    /// Correlation at the rotation found.
    pub correlation: Option<f64>,
    /// Inliers of RANSAC.
    pub inliers: Option<u64>,
    /// What Nuth and Kaab's method did.
    pub coregistration: Option<Coregistration>,
    /// What a reader should know.
    pub flags: Vec<AlignmentFlag>,
    /// Infinite or absurd values that were taken as no data, and the like.
    pub notes: Vec<String>,
}

/// Paired difference of two sets of predictions on the images that both have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// First set (`a`), as [`Evaluation::model`].
    pub a: String,
    /// Second set (`b`).
    pub b: String,
    /// Protocol of both.
    pub protocol: Protocol,
    /// Images that both have.
    pub images: u64,
    /// One per score.
    pub scores: Vec<ScoreDifference>,
}

/// `b - a` of one score over the images that both have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreDifference {
    /// Path of the score, as in [`Interval::score`].
    pub score: String,
    /// Score of `a` on these images.
    pub a: f64,
    /// Score of `b` on these images.
    pub b: f64,
    /// `b - a`.
    pub difference: f64,
    /// Ends of the 95 % interval of the difference, drawing blocks.
    pub low: f64,
    /// See `low`.
    pub high: f64,
    /// Two-sided bootstrap p-value.
    pub p_value: f64,
    /// Whether the difference is more than noise at 5 %, after Holm's correction over all
    /// pairs of sets, score by score.
    pub significant: bool,
}

/// A row of a published table.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PublishedRow {
    /// The method.
    pub method: &'static str,
    /// Where the numbers are from.
    pub source: &'static str,
    /// The numbers.
    pub scores: PublishedScores,
}

/// Everything that one run of `sat3d eval` found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationSet {
    /// Every set of predictions under every protocol, in the order asked for.
    pub evaluations: Vec<Evaluation>,
    /// Paired differences between sets under the same protocol.
    pub differences: Vec<Difference>,
    /// Published rows to stand beside (`--against paper`).
    pub published: Vec<PublishedRow>,
}
