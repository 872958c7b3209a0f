//! One image: align, subtract, sum up.

use super::align::{AlignSettings, Aligner, Alignment, AlignmentFlag, Shift, apply_nearest};
use super::metrics::{ErrorSums, ImageSample, Quantiles, Sketch};
use super::options::EvalOptions;
use super::protocol::Protocol;
use super::strata::{Strata, StratumSet};
use super::summary::ImageScores;
use super::surface::Surface;
use crate::plan::runs;
use serde::{Deserialize, Serialize};

/// A class in [`Errors::classes`] for pixels that no bin of a group takes.
pub const NO_CLASS: u8 = u8::MAX;

/// What one image is scored from: the layers of the truth at the prediction's size.
#[derive(Clone, Debug)]
pub struct Layers {
    /// Ground truth, metres.
    pub truth: Surface,
    /// Bare earth, metres.
    pub ground: Option<Surface>,
    /// Classes of the mask.
    pub classes: Option<Vec<u16>>,
    /// Size of a pixel of the prediction on the ground, metres.
    pub pixel_m: Option<(f64, f64)>,
}

/// Prediction and truth after alignment.
#[derive(Clone, Debug)]
pub struct Compared {
    /// Aligned truth minus the vertical offset, metres.
    pub truth: Surface,
    /// Prediction - truth per pixel, metres; NaN where one of them is missing.
    pub errors: Vec<f64>,
}

/// The errors of one image and where they lie, as the pooled quantiles need them.
#[derive(Clone, Debug)]
pub struct Errors {
    /// Prediction - truth of the pixels that have both, in pixel order, metres.
    pub values: Vec<f64>,
    /// Per group of strata, the class of each of those pixels.
    pub classes: Vec<Vec<u8>>,
}

/// Sums over the pixels of one stratum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StratumSums {
    /// Of the errors.
    pub sums: ErrorSums,
    /// Pixels of the truth, with or without a prediction.
    pub truth_pixels: u64,
}

/// What one image under one protocol gives.
#[derive(Clone, Debug)]
pub struct Scored {
    /// Its row in the output.
    pub scores: ImageScores,
    /// Sums, for the totals and the bootstrap.
    pub sample: ImageSample,
    /// Sums by group and class.
    pub strata: Vec<Vec<StratumSums>>,
    /// The errors themselves.
    pub errors: Errors,
    /// The whole grid of errors with prediction and truth.
    pub compared: Compared,
}

/// Subtracts an aligned truth (without the vertical offset) from a prediction.
#[must_use]
pub fn compare(prediction: &Surface, mut aligned: Surface, alignment: &Alignment) -> Compared {
    let offset = alignment.vertical_offset_m;
    let errors = prediction
        .values
        .iter()
        .zip(&aligned.values)
        .map(|(&p, &t)| f64::from(p) - (f64::from(t) - offset))
        .collect();
    for height in &mut aligned.values {
        *height = (f64::from(*height) - offset) as f32;
    }
    Compared { truth: aligned, errors }
}

/// The strata of an image: the aligned truth's own, on its own heights.
fn strata_of(
    set: &StratumSet,
    layers: &Layers,
    alignment: &Alignment,
    compared: &Compared,
) -> Option<Strata> {
    let pixel_m = layers.pixel_m?;
    let (width, height) = layers.truth.size();
    runs("strata");
    let ground = layers.ground.as_ref().map(|ground| {
        runs("height-above-ground");
        let mut ground = super::align::apply(alignment, ground);
        for height in &mut ground.values {
            *height = (f64::from(*height) - alignment.vertical_offset_m) as f32;
        }
        ground
    });
    let classes = layers.classes.as_ref().map(|classes| {
        runs("classes");
        apply_nearest(alignment, width, height, classes, u16::MAX)
    });
    Some(set.classify(&compared.truth, ground.as_ref(), classes.as_deref(), pixel_m))
}

/// The errors that an image has under a known alignment, with their classes; `aligned` is its
/// truth, moved.
#[must_use]
pub fn errors_of(
    prediction: &Surface,
    layers: &Layers,
    alignment: &Alignment,
    aligned: Surface,
    set: &StratumSet,
) -> (Compared, Option<Strata>, Errors) {
    let compared = compare(prediction, aligned, alignment);
    let strata = strata_of(set, layers, alignment, &compared);
    let finite: Vec<usize> =
        (0..compared.errors.len()).filter(|&k| !compared.errors[k].is_nan()).collect();
    let values = finite.iter().map(|&k| compared.errors[k]).collect();
    let classes = set
        .groups()
        .iter()
        .enumerate()
        .map(|(group, _)| {
            let classes = strata
                .as_ref()
                .and_then(|s| s.groups.iter().find(|classes| classes.group == group));
            classes.map_or_else(Vec::new, |classes| {
                // There are fewer than 255 bins; a mask with more classes is refused on opening.
                let code = |k: &usize| u8::try_from(classes.classes[*k]).unwrap_or(NO_CLASS);
                finite.iter().map(code).collect()
            })
        })
        .collect();
    (compared, strata, Errors { values, classes })
}

/// Settings of the alignment of one image.
#[must_use]
pub fn align_settings(
    options: &EvalOptions,
    protocol: Protocol,
    name: &str,
    pixel_m: Option<(f64, f64)>,
) -> AlignSettings {
    let letters: Vec<u64> = name.bytes().map(u64::from).collect();
    AlignSettings {
        protocol,
        offset: options.offset_for(protocol),
        // A draw depends on the image's name and the seed, not on the order of the work.
        seed: crate::random::key(&[options.seed, crate::random::key(&letters)]),
        pixel_m: pixel_m.unwrap_or((1.0, 1.0)),
        max_shift_px: 20.0,
        max_rotation_deg: 10.0,
    }
}

/// Scores one image.
///
/// # Errors
/// Why it cannot be scored, in words.
pub fn score(
    aligner: &mut Aligner,
    prediction: &Surface,
    layers: &Layers,
    settings: &AlignSettings,
    set: &StratumSet,
    thresholds: &[f64],
) -> Result<Scored, String> {
    let (alignment, aligned) = aligner
        .align_and_apply(prediction, &layers.truth, settings)
        .map_err(|error| error.to_string())?;
    let (compared, strata, errors) = errors_of(prediction, layers, &alignment, aligned, set);
    if errors.values.is_empty() {
        return Err("no pixel has both a prediction and a ground truth".into());
    }
    runs("sums");
    let mut sums = ErrorSums::new(thresholds.len());
    sums.add(&errors.values, thresholds);
    let quantiles = Quantiles::of(&errors.values, &mut Vec::new());
    let truth_pixels = compared.truth.valid();
    let pixel = layers.pixel_m.unwrap_or((f64::NAN, f64::NAN));
    let shift = alignment.shift_px;
    let scores = ImageScores {
        mae_m: sums.mae(),
        rmse_m: sums.rmse(),
        lt_2_5_m_pct: sums.below_pct(0),
        lt_7_5_m_pct: sums.below_pct(1),
        bias_m: sums.bias(),
        median_m: quantiles.median,
        nmad_m: quantiles.nmad,
        le68_m: quantiles.le68,
        le90_m: quantiles.le90,
        p95_m: quantiles.p95,
        max_m: sums.max_abs(),
        pixels: sums.pixels(),
        truth_pixels,
        completeness_pct: 100.0 * sums.pixels() as f64 / truth_pixels as f64,
        shift_px: shift,
        shift_m: layers.pixel_m.map(|_| Shift { x: shift.x * pixel.0, y: shift.y * pixel.1 }),
        rotation_deg: alignment.rotation_deg,
        vertical_offset_m: alignment.vertical_offset_m,
        correlation: alignment.correlation,
        inliers: alignment.inliers,
        coregistration: alignment.coregistration,
        flags: alignment.flags,
        notes: Vec::new(),
    };
    let strata = sums_by_class(set, &errors, &compared, strata.as_ref(), thresholds);
    let sample = ImageSample {
        name: String::new(),
        block: (0, 0),
        sketch: Sketch::of(&errors.values),
        sums,
        truth_pixels,
    };
    Ok(Scored { scores, sample, strata, errors, compared })
}

/// Whether an image was left where it is although its protocol aligns.
#[must_use]
pub fn is_unaligned(flags: &[AlignmentFlag]) -> bool {
    flags.iter().any(|flag| {
        matches!(
            flag,
            AlignmentFlag::ShiftBeyondLimit
                | AlignmentFlag::NoTexture
                | AlignmentFlag::NoInformation
                | AlignmentFlag::NotConverged
        )
    })
}

/// The alignment that a row of scores tells of.
#[must_use]
pub fn alignment_of(scores: &ImageScores) -> Alignment {
    Alignment {
        shift_px: scores.shift_px,
        rotation_deg: scores.rotation_deg,
        vertical_offset_m: scores.vertical_offset_m,
        // These two decide how `apply` interpolates.
        correlation: scores.correlation,
        flags: scores.flags.clone(),
        ..Alignment::default()
    }
}

fn sums_by_class(
    set: &StratumSet,
    errors: &Errors,
    compared: &Compared,
    strata: Option<&Strata>,
    thresholds: &[f64],
) -> Vec<Vec<StratumSums>> {
    set.groups()
        .iter()
        .enumerate()
        .map(|(group, definition)| {
            let mut buckets = vec![Vec::new(); definition.labels.len()];
            bucket(errors, group, &mut buckets);
            let mut truth_pixels = vec![0_u64; definition.labels.len()];
            let whole = strata.and_then(|s| s.groups.iter().find(|classes| classes.group == group));
            if let Some(whole) = whole {
                for (&class, height) in whole.classes.iter().zip(&compared.truth.values) {
                    if !height.is_nan()
                        && let Some(count) = truth_pixels.get_mut(usize::from(class))
                    {
                        *count += 1;
                    }
                }
            }
            let classes = truth_pixels.into_iter().zip(&buckets);
            classes
                .map(|(truth_pixels, bucket)| {
                    let mut sums = ErrorSums::new(thresholds.len());
                    sums.add(bucket, thresholds);
                    StratumSums { sums, truth_pixels }
                })
                .collect()
        })
        .collect()
}

/// Sorts the errors of an image into the classes of a group.
pub(super) fn bucket(errors: &Errors, group: usize, buckets: &mut [Vec<f64>]) {
    buckets.iter_mut().for_each(Vec::clear);
    for (&class, &error) in errors.classes[group].iter().zip(&errors.values) {
        if let Some(bucket) = buckets.get_mut(usize::from(class)) {
            bucket.push(error);
        }
    }
}
