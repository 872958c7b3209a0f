//! Evaluation: alignment protocols, vertical offsets, resizing, bootstrap.

use super::clock::{Findings, Judged, Subject, Way};
use super::report::Quantity;
use super::truth::{Place, SIDE, ZOOM, heights, quantile, rms};
use super::{Setup, TradeoffError};
use crate::eval::align::{AlignSettings, Aligner, Shift};
use crate::eval::metrics::{
    BootstrapSettings, ErrorSums, ImageSample, PUBLISHED_THRESHOLDS_M, Quantiles, Sketch,
    intervals, lone_block,
};
use crate::eval::{EvalOptions, OffsetMethod, Protocol, Resize, Surface, resize};
use crate::random::{Draw, key, normal, unit};
use crate::scene::Scene;
use crate::scene::pixels::PixelPositions;
use std::path::PathBuf;

pub(super) const PROTOCOL: &str = "a prediction has an arbitrary zero and may be shifted";
pub(super) const OFFSET: &str = "a prediction has an arbitrary zero and gross errors";
pub(super) const RESIZE: &str = "truth and prediction have different pixels";
pub(super) const BOOTSTRAP: &str = "a score comes from a sample of images";

/// Pixels of a prediction, as the network gives them.
const PREDICTED: usize = 256;
/// Ground metres of such a pixel.
const PIXEL_M: f64 = 0.252;
/// Standard deviation of the errors that a made-up prediction has once it is aligned, metres.
const NOISE_M: f64 = 0.5;
/// Where its zero lies, metres.
const ZERO_M: f64 = 7.3;
/// Where it is shifted to, pixels east and south.
const SHIFT: [f64; 2] = [3.4, -2.2];
/// Gross errors: their share, and how much too high they are, metres.
const GROSS: (f64, f64) = (0.15, 8.0);

/// What an evaluation does unless told otherwise.
fn defaults() -> EvalOptions {
    EvalOptions::new(Vec::new(), PathBuf::new())
}

/// A truth and a made-up prediction of the same ground.
struct Pair {
    truth: Surface,
    prediction: Surface,
}

/// Heights of a square about a place of the scene, metres.
fn look(scene: &Scene, [east, north]: [f64; 2]) -> Surface {
    let metres = PREDICTED as f64 * PIXEL_M;
    let pixels = PixelPositions::square(&scene.frame, PREDICTED, [east, north], metres);
    Surface::new(PREDICTED, PREDICTED, heights(scene, &pixels))
}

/// Pairs in several parts of the scene. `change` makes a prediction's height from a true one and the pixel's
/// own random number.
fn pairs(
    place: &Place,
    count: usize,
    [right, down]: [f64; 2],
    change: impl Fn(f64, u64) -> f64,
) -> Vec<Pair> {
    (0..count)
        .map(|k| {
            let mut draw = Draw::new(&[11, k as u64]);
            let (east, north) = (draw.range(-45.0, 45.0), draw.range(-45.0, 45.0));
            // What lies `right` pixels to the left in the truth lies here in the prediction.
            let moved = [east - right * PIXEL_M, north + down * PIXEL_M];
            let mut prediction = look(&place.scene, moved);
            for (i, height) in (0_u64..).zip(&mut prediction.values) {
                *height = change(f64::from(*height), key(&[13, k as u64, i])) as f32;
            }
            Pair { truth: look(&place.scene, [east, north]), prediction }
        })
        .collect()
}

fn align_settings(protocol: Protocol, offset: OffsetMethod) -> AlignSettings {
    AlignSettings {
        protocol,
        offset,
        seed: 1,
        pixel_m: (PIXEL_M, PIXEL_M),
        max_shift_px: 20.0,
        max_rotation_deg: 10.0,
    }
}

/// What is aligned before a prediction is scored.
pub(super) fn protocol(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let noisy = |height: f64, lot: u64| height - ZERO_M + NOISE_M * normal(lot);
    let pairs = pairs(&place, setup.either(3, 8), SHIFT, noisy);
    let pairs = &pairs;
    let ways = Protocol::ALL
        .into_iter()
        .map(|protocol| {
            let settings = align_settings(protocol, defaults().offset_for(protocol));
            let mut aligner = Aligner::new();
            Way::new(protocol.name(), protocol == Protocol::default(), move || {
                let mut found = Vec::with_capacity(pairs.len());
                for Pair { truth, prediction } in pairs {
                    let (alignment, aligned) =
                        aligner.align_and_apply(prediction, truth, &settings)?;
                    let zero = alignment.vertical_offset_m as f32;
                    let moved: Vec<f32> = aligned.values.iter().map(|t| t - zero).collect();
                    found.push((rms(&prediction.values, &moved), alignment.shift_px));
                }
                Ok(found)
            })
        })
        .collect();
    let subject = Subject {
        truth: "predictions made of true heights: shifted by (3.4, -2.2) px, lowered by 7.3 m, with normal \
                errors of 0.5 m; their RMSE is 0.5 m where all that is found",
        error: Quantity::new("error of the RMSE", "m"),
        work: "aligning one pair of 256 x 256 px".into(),
        units: pairs.len() as f64,
    };
    setup.clock.measure(subject, ways, |found: &Vec<(f64, Shift)>| {
        let mean = |errors: &mut dyn Iterator<Item = f64>| errors.sum::<f64>() / found.len() as f64;
        let rmse = mean(&mut found.iter().map(|(rmse, _)| (rmse - NOISE_M).abs()));
        let away = |shift: &Shift| libm::hypot(shift.x - SHIFT[0], shift.y - SHIFT[1]);
        let shift = mean(&mut found.iter().map(|(_, shift)| away(shift)));
        Ok(Judged::new(rmse).also("error of the shift", "px", shift))
    })
}

/// How the vertical offset is found.
pub(super) fn offset(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let (share, rise) = GROSS;
    let grown = |height: f64, lot: u64| {
        let gross = if unit(key(&[lot])) < share { rise } else { 0.0 };
        height - ZERO_M + gross + NOISE_M * normal(lot)
    };
    let pairs = pairs(&place, setup.either(3, 8), [0.0; 2], grown);
    let pairs = &pairs;
    let usual = defaults().offset_for(Protocol::default());
    let methods = [
        ("ransac", OffsetMethod::Ransac),
        ("median", OffsetMethod::Median),
        ("mean", OffsetMethod::Mean),
    ];
    let ways = methods
        .into_iter()
        .map(|(name, method)| {
            let settings = align_settings(Protocol::Vertical, method);
            let mut aligner = Aligner::new();
            Way::new(name, method == usual, move || {
                let mut offsets = Vec::with_capacity(pairs.len());
                for Pair { truth, prediction } in pairs {
                    offsets.push(aligner.align(prediction, truth, &settings)?.vertical_offset_m);
                }
                Ok(offsets)
            })
        })
        .collect();
    let subject = Subject {
        truth: "predictions made of true heights: lowered by 7.3 m, with normal errors of 0.5 m, and 15 % of the \
                pixels 8 m too high",
        error: Quantity::new("error of the offset", "m"),
        work: "the offset of one pair of 256 x 256 px".into(),
        units: pairs.len() as f64,
    };
    setup.clock.measure(subject, ways, |offsets: &Vec<f64>| {
        let apart = offsets.iter().map(|offset| (offset - ZERO_M).abs());
        Ok(Judged::new(apart.sum::<f64>() / offsets.len() as f64))
    })
}

/// How a truth is brought to a prediction's pixels.
pub(super) fn resizing(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let side = SIDE as usize;
    let fine = Surface::new(side, side, place.heights(&place.image(ZOOM, SIDE)?)?);
    // 1280 is the least number of pixels that 640 and 256 both divide.
    let parts: u32 = setup.either(2, 8);
    let common = place.image(ZOOM + parts.trailing_zeros() as u8, SIDE * parts)?;
    let points = place.heights(&common)?;
    let truth = super::truth::block_means(
        &points,
        (SIDE * parts) as usize,
        (SIDE * parts) as usize / PREDICTED,
    );
    let fine = &fine;
    let ways = [("reference", Resize::Reference), ("area", Resize::Area)]
        .into_iter()
        .map(|(name, how)| {
            Way::new(name, how == Resize::default(), move || {
                Ok(resize(fine, PREDICTED, PREDICTED, how))
            })
        })
        .collect();
    let subject = Subject {
        truth: "true mean heights of a simulated city over each of the 256 x 256 pixels",
        error: Quantity::new("RMS height error", "m"),
        work: "resizing one DSM of 640 x 640 px to 256 x 256".into(),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |resized: &Surface| {
        Ok(Judged::new(rms(&resized.values, &truth)).also(
            "95 % quantile",
            "m",
            quantile(&resized.values, &truth, 0.95),
        ))
    })
}

/// Images of a made-up evaluation: each has a level of its own.
fn scored_images(count: u64) -> (Vec<ImageSample>, Quantiles) {
    let mut all = Vec::new();
    let images = (0..count)
        .map(|k| {
            let level = 1.0 + 2.0 * unit(key(&[17, k]));
            let errors: Vec<f64> = (0..4096).map(|i| level * normal(key(&[19, k, i]))).collect();
            let mut sums = ErrorSums::new(PUBLISHED_THRESHOLDS_M.len());
            sums.add(&errors, &PUBLISHED_THRESHOLDS_M);
            let sketch = Sketch::of(&errors);
            let truth_pixels = errors.len() as u64;
            all.extend(errors);
            ImageSample {
                name: format!("{k:06}"),
                block: lone_block(k),
                sums,
                truth_pixels,
                sketch,
            }
        })
        .collect();
    (images, Quantiles::of(&all, &mut Vec::new()))
}

/// Images of the bootstrap.
const SCORED: u64 = 60;
/// The score whose interval is looked at.
const SCORE: &str = "per_image_mean.rmse_m";

/// Half the width of its interval, metres.
fn half_width(images: &[ImageSample], exact: &Quantiles, replicates: u32, seed: u64) -> f64 {
    let settings = BootstrapSettings { block_m: 500.0, replicates, seed, level_pct: 95.0 };
    let found = intervals(images, exact, &PUBLISHED_THRESHOLDS_M, &settings);
    let score = found.scores.iter().find(|interval| interval.score == SCORE);
    score.map_or(f64::NAN, |interval| (interval.high - interval.low) / 2.0)
}

/// How many replicates give an interval.
pub(super) fn bootstrap(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let (images, exact) = scored_images(SCORED);
    let (images, exact) = (&images, &exact);
    let truth = half_width(images, exact, setup.either(20_000, 200_000), 99);
    let seeds = setup.either(8, 30);
    let default = defaults().replicates;
    let counts: &[u32] =
        if setup.quick { &[100, 500, 2000] } else { &[100, 250, 500, 1000, 2000, 5000, 10_000] };
    let ways = counts
        .iter()
        .map(|&replicates| {
            Way::new(replicates.to_string(), replicates == default, move || {
                Ok((replicates, half_width(images, exact, replicates, 1)))
            })
        })
        .collect();
    let subject = Subject {
        truth: "the half width of the interval of the mean RMSE of 60 images by very many replicates",
        error: Quantity::new("mean error of the half width", "%"),
        work: "all intervals of one evaluation of 60 images".into(),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |&(replicates, first): &(u32, f64)| {
        let others = (2..=seeds).map(|seed| half_width(images, exact, replicates, seed));
        let apart = std::iter::once(first).chain(others).map(|half| (half / truth - 1.0).abs());
        Ok(Judged::new(100.0 * apart.sum::<f64>() / seeds as f64))
    })
}
