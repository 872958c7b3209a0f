//! From totals to the numbers that are printed.

use super::metrics::{
    BootstrapSettings, ComparedSet, ErrorSums, ImageSample, Quantiles, differences, intervals,
    mean_scores,
};
use super::protocol::{OffsetMethod, Protocol};
use super::registration;
use super::run::Prepared;
use super::score::is_unaligned;
use super::summary::{
    Evaluation, EvaluationSet, ImageCounts, PooledScores, PublishedScores, StratumGroup,
    StratumRow, ThresholdShare,
};
use super::tally::{Fine, Tally};
use crate::batch::Status;
use crate::plan::runs;
use std::collections::BTreeMap;

/// Confidence level of the intervals, per cent.
const LEVEL_PCT: f64 = 95.0;

/// The evaluation that a tally amounts to.
pub fn evaluation(
    prepared: &Prepared,
    model: &str,
    protocol: Protocol,
    offset: OffsetMethod,
    tally: &Tally,
    fine: &Fine,
) -> Evaluation {
    let thresholds = &prepared.settings.thresholds;
    let totals = tally.totals(&prepared.set, thresholds.len());
    let quantiles = Quantiles::pooled(&tally.coarse, &fine.all);
    let (per_image_mean, per_image_pct) = mean_scores(&tally.samples, thresholds.len());
    let sums = &totals.all.sums;
    let pooled = PooledScores {
        mae_m: sums.mae(),
        rmse_m: sums.rmse(),
        bias_m: sums.bias(),
        std_m: sums.std(),
        median_m: quantiles.median,
        nmad_m: quantiles.nmad,
        le68_m: quantiles.le68,
        le90_m: quantiles.le90,
        p95_m: quantiles.p95,
        max_m: sums.max_abs(),
        lt_2_5_m_pct: sums.below_pct(0),
        lt_7_5_m_pct: sums.below_pct(1),
        thresholds: shares(sums, &per_image_pct, thresholds),
        pixels: sums.pixels(),
        truth_pixels: totals.all.truth_pixels,
        completeness_pct: pct(sums.pixels(), totals.all.truth_pixels),
    };
    if prepared.options.replicates > 0 {
        runs("bootstrap");
    }
    Evaluation {
        schema: "sat3d-eval-1".into(),
        model: model.to_owned(),
        protocol,
        offset,
        seed: prepared.options.seed,
        conventions: conventions(prepared),
        images: counts(tally),
        reasons: tally.reasons.clone(),
        as_published: PublishedScores {
            mae_m: per_image_mean.mae_m,
            rmse_m: per_image_mean.rmse_m,
            lt_2_5_m_pct: pooled.lt_2_5_m_pct,
            lt_7_5_m_pct: pooled.lt_7_5_m_pct,
        },
        per_image_mean,
        intervals: intervals(&tally.samples, &quantiles, thresholds, &bootstrap(prepared)),
        strata: strata(prepared, tally, fine, &totals.strata, sums.pixels()),
        histogram: tally.histogram.clone().into(),
        by_position: tally.positions.map(),
        registration: registration::combine(&tally.registrations),
        per_image: tally.rows.clone(),
        pooled,
    }
}

/// Everything that one run found.
pub fn set(
    prepared: &Prepared,
    evaluations: Vec<Evaluation>,
    samples: &[Vec<ImageSample>],
) -> EvaluationSet {
    let sets: Vec<ComparedSet<'_>> = evaluations
        .iter()
        .zip(samples)
        .map(|(evaluation, images)| {
            let PooledScores { median_m, nmad_m, le68_m, le90_m, p95_m, .. } = evaluation.pooled;
            ComparedSet {
                model: &evaluation.model,
                protocol: evaluation.protocol,
                images,
                quantiles: Some(Quantiles {
                    median: median_m,
                    nmad: nmad_m,
                    le68: le68_m,
                    le90: le90_m,
                    p95: p95_m,
                }),
            }
        })
        .collect();
    if prepared.settings.models.len() > 1 {
        runs("differences");
    }
    let differences = differences(&sets, &prepared.settings.thresholds, &bootstrap(prepared));
    EvaluationSet { evaluations, differences, published: Vec::new() }
}

fn bootstrap(prepared: &Prepared) -> BootstrapSettings {
    BootstrapSettings {
        block_m: prepared.options.block_m,
        replicates: prepared.options.replicates,
        seed: prepared.options.seed,
        level_pct: LEVEL_PCT,
    }
}

fn pct(part: u64, whole: u64) -> f64 {
    100.0 * part as f64 / whole as f64
}

fn counts(tally: &Tally) -> ImageCounts {
    let with = |status| tally.rows.iter().filter(|row| row.status == status).count() as u64;
    let scores = tally.rows.iter().filter_map(|row| row.scores.as_ref());
    ImageCounts {
        found: tally.rows.len() as u64,
        evaluated: with(Status::Done),
        skipped: with(Status::Skipped),
        failed: with(Status::Failed),
        unaligned: scores.filter(|scores| is_unaligned(&scores.flags)).count() as u64,
    }
}

fn shares(all: &ErrorSums, per_image_pct: &[f64], thresholds: &[f64]) -> Vec<ThresholdShare> {
    let further = thresholds.iter().zip(per_image_pct).enumerate().skip(2);
    further
        .map(|(k, (&threshold_m, &per_image_mean_pct))| ThresholdShare {
            threshold_m,
            pooled_pct: all.below_pct(k),
            per_image_mean_pct,
        })
        .collect()
}

fn strata(
    prepared: &Prepared,
    tally: &Tally,
    fine: &Fine,
    sums: &[Vec<super::score::StratumSums>],
    all_pixels: u64,
) -> Vec<StratumGroup> {
    let groups = prepared.set.groups().iter().enumerate();
    groups
        // A group whose cause is absent (no bare earth, no mask, no ground sample distance).
        .filter(|(group, _)| sums[*group].iter().any(|s| s.truth_pixels > 0))
        .map(|(group, definition)| {
            let rows = definition.labels.iter().enumerate().map(|(class, label)| {
                let stratum = &sums[group][class];
                let coarse = &tally.coarse_strata[group][class];
                let quantiles = Quantiles::pooled(coarse, &fine.strata[group][class]);
                let sums = &stratum.sums;
                StratumRow {
                    label: label.clone(),
                    pixels: sums.pixels(),
                    share_pct: pct(sums.pixels(), all_pixels),
                    truth_pixels: stratum.truth_pixels,
                    completeness_pct: pct(sums.pixels(), stratum.truth_pixels),
                    mae_m: sums.mae(),
                    rmse_m: sums.rmse(),
                    bias_m: sums.bias(),
                    median_m: quantiles.median,
                    nmad_m: quantiles.nmad,
                    le90_m: quantiles.le90,
                    lt_2_5_m_pct: sums.below_pct(0),
                    lt_7_5_m_pct: sums.below_pct(1),
                }
            });
            StratumGroup {
                name: definition.name.to_string(),
                unit: definition.unit.to_string(),
                description: definition.description.to_string(),
                rows: rows.collect(),
            }
        })
        .collect()
}

fn conventions(prepared: &Prepared) -> BTreeMap<String, String> {
    let settings = &prepared.settings;
    let scale = settings.metres_per_unit.map_or_else(
        || "as the file says, else 64.48".to_owned(),
        |scale| format!("{scale}, over what files say"),
    );
    let resize = match settings.resize {
        super::resize::Resize::Reference => "bilinear without antialiasing",
        super::resize::Resize::Area => "mean over the area of a pixel",
    };
    let entries = [
        ("error", "prediction - (aligned ground truth - vertical offset), metres".to_owned()),
        (
            "shift",
            "applied to the ground truth; +x east, +y south, pixels of the prediction".into(),
        ),
        (
            "rotation",
            "applied to the ground truth after the shift, degrees, sign of scipy.ndimage.rotate"
                .into(),
        ),
        ("vertical_offset", "subtracted from the ground truth, metres".into()),
        ("per_image_mean", "score per image, then the mean over images".into()),
        ("pooled", "score over all pixels of all images".into()),
        ("as_published", "MAE and RMSE as per_image_mean, percentages as pooled".into()),
        ("thresholds", "share of |error| strictly below".into()),
        ("nmad", "1.4826 * median(|error - median(error)|)".into()),
        ("le68, le90, p95", "percentiles of |error|, linear between order statistics".into()),
        ("metres_per_unit", scale),
        ("resize", resize.to_owned()),
    ];
    entries.into_iter().map(|(key, text)| (key.to_owned(), text)).collect()
}
