//! How imagery and ground truth lie to each other: shift, vertical zero, building lean. Estimated
//! and reported, never applied.
//!
//! A prediction shows the world as its image does. That image may be metres off, and if it is no
//! true orthophoto every roof is displaced in proportion to its height above ground. So the ground
//! truth is taken to where the image would show it: a point at height `h` above ground moves by
//! `shift + lean * h`, higher points hide lower ones. Shift, lean and vertical zero are
//! those for which that agrees best with the prediction, by iteratively reweighted least squares
//! (Huber weights) on the difference of heights. The start is the best shift on a grid of whole
//! pixels of about a metre, by correlation, for each of several leans.
//!
//! A prediction may be blurred and its roofs too low: both disturb the two sides of a building alike,
//! and cancel. An image gives an estimate only where the result explains its heights: correlation
//! over 0.4, a shift within 8 m, and a formal standard error under half a metre. What one image says
//! is uncertain beyond that formal error in ways that nobody can state, so the errors of the whole
//! are taken from how the images disagree. Images that overlap disagree too little.

mod fit;
#[cfg(test)]
mod hard_cases;
mod render;

use super::summary::{Estimate, Registration};
use super::surface::Surface;
use fit::{Fit, Parameters};
use render::Level;
use serde::{Deserialize, Serialize};

/// Pixel size of the level on which the start is sought, metres.
const COARSE_M: f64 = 1.0;
/// Pixel size of the level on which the estimate is made, metres.
const FINE_M: f64 = 0.5;
/// Farthest shift that is looked for, metres.
const FARTHEST_M: f64 = 8.0;
/// Least correlation of prediction and displaced ground truth.
const LEAST_CORRELATION: f64 = 0.4;
/// Iterations on the coarse level, which only has to come near.
const COARSE_ITERATIONS: u32 = 5;
/// Iterations at most on the fine level.
const ITERATIONS: u32 = 10;
/// Largest formal standard error of a shift, metres.
const LARGEST_ERROR_M: f64 = 0.5;
/// Largest formal standard error of a lean, metres per metre.
const LARGEST_LEAN_ERROR: f64 = 0.05;
/// Farthest lean that is believed, metres per metre (tan 27 degrees off nadir).
const FARTHEST_LEAN: f64 = 0.5;
/// Radius in which the lowest height stands for the ground where there is no bare earth, metres.
const GROUND_RADIUS_M: f64 = 16.0;

/// What one image says.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageRegistration {
    /// Shift that would bring the ground truth onto the prediction, metres east.
    pub east_m: f64,
    /// The same, metres north.
    pub north_m: f64,
    /// Median of displaced ground truth minus prediction, metres.
    pub vertical_m: f64,
    /// Displacement per metre of height above ground, east and north, where heights vary enough.
    pub lean: Option<(f64, f64)>,
    /// Correlation of the prediction with the displaced ground truth.
    pub correlation: f64,
}

/// Estimates shift, vertical zero and lean from one image.
///
/// `truth` is the ground truth on the prediction's grid, not aligned; `ground` its bare earth.
/// Without that, the lowest height within 16 m stands for it. `pixel_m` is the size of a pixel on
/// the ground, metres east-west and north-south.
///
/// `None` where there is nothing to go by: sizes that differ, too few heights, flat surfaces, a
/// prediction that the ground truth does not explain.
#[must_use]
pub fn of_image(
    prediction: &Surface,
    truth: &Surface,
    ground: Option<&Surface>,
    pixel_m: (f64, f64),
) -> Option<ImageRegistration> {
    let sizes = [Some(truth), ground].into_iter().flatten().all(|s| s.size() == prediction.size());
    let possible = |v: f64| v.is_finite() && v > 0.0;
    if !sizes || !possible(pixel_m.0) || !possible(pixel_m.1) {
        return None;
    }
    let level = |model_m: f64, size_m: f64| {
        let factor = |pixel: f64, size: f64| ((size / pixel).round() as usize).max(1);
        let model = (factor(pixel_m.0, model_m), factor(pixel_m.1, model_m));
        let of = (pixel_m.0 * model.0 as f64, pixel_m.1 * model.1 as f64);
        let more = (factor(of.0, size_m), factor(of.1, size_m));
        Level::new(prediction, truth, ground, pixel_m, model, more)
    };
    let coarse = level(FINE_M, COARSE_M);
    let mut best: Option<Fit> = None;
    for start in fit::starts(&coarse)? {
        let found = fit::refine(&coarse, start, true, COARSE_ITERATIONS)
            .or_else(|| fit::refine(&coarse, start, false, COARSE_ITERATIONS));
        if let Some(found) = found
            && best.as_ref().is_none_or(|best| found.correlation > best.correlation)
        {
            best = Some(found);
        }
    }
    let start = best?.parameters;
    let fine = level(0.0, FINE_M);
    let found = fit::refine(&fine, start, true, ITERATIONS).filter(|found| {
        let lean = found.parameters;
        found.errors.lean < LARGEST_LEAN_ERROR
            && libm::hypot(lean.lean_x, lean.lean_y) < FARTHEST_LEAN
    });
    let has_lean = found.is_some();
    let found = match found {
        Some(found) => found,
        None => {
            fit::refine(&fine, Parameters { lean_x: 0.0, lean_y: 0.0, ..start }, false, ITERATIONS)?
        }
    };
    let Parameters { x, y, lean_x, lean_y, .. } = found.parameters;
    let believed = found.correlation > LEAST_CORRELATION
        && found.errors.shift < LARGEST_ERROR_M
        && libm::hypot(x, y) < FARTHEST_M;
    believed.then_some(ImageRegistration {
        east_m: x,
        north_m: -y,
        vertical_m: found.vertical,
        // Not minus zero.
        lean: has_lean.then_some((lean_x, 0.0 - lean_y)),
        correlation: found.correlation,
    })
}

/// The whole set, from estimates in a fixed order (by name). `None` without any.
///
/// Where most images tell the lean, shifts are taken from those alone: in the others the lean is
/// part of the shift.
#[must_use]
pub fn combine(images: &[ImageRegistration]) -> Option<Registration> {
    if images.is_empty() {
        return None;
    }
    let leaning: Vec<&ImageRegistration> = images.iter().filter(|i| i.lean.is_some()).collect();
    let tells = 2 * leaning.len() >= images.len();
    let shifting: Vec<&ImageRegistration> =
        if tells { leaning.clone() } else { images.iter().collect() };
    let of = |from: &[&ImageRegistration], value: &dyn Fn(&ImageRegistration) -> f64| {
        estimate(&from.iter().map(|i| value(i)).collect::<Vec<_>>())
    };
    let all: Vec<&ImageRegistration> = images.iter().collect();
    let lean = |axis: fn((f64, f64)) -> f64| {
        tells.then(|| of(&leaning, &|i| i.lean.map_or(f64::NAN, axis)))
    };
    Some(Registration {
        images: images.len() as u64,
        east_m: of(&shifting, &|i| i.east_m),
        north_m: of(&shifting, &|i| i.north_m),
        vertical_m: of(&all, &|i| i.vertical_m),
        lean_east: lean(|lean| lean.0),
        lean_north: lean(|lean| lean.1),
    })
}

/// Mean of the values within three NMAD of the median, its standard error, and the NMAD. The error
/// of one value is unknown (NaN).
fn estimate(values: &[f64]) -> Estimate {
    let middle = median(values.to_vec());
    let spread = 1.4826 * median(values.iter().map(|v| (v - middle).abs()).collect());
    // Values that agree to rounding have no outliers.
    let limit = (3.0 * spread).max(1e-9);
    let kept: Vec<f64> = values.iter().copied().filter(|v| (v - middle).abs() <= limit).collect();
    let count = kept.len() as f64;
    let mean = kept.iter().sum::<f64>() / count;
    let squares: f64 = kept.iter().map(|v| (v - mean) * (v - mean)).sum();
    let standard_error = (squares / (count - 1.0) / count).sqrt();
    Estimate { value: mean, standard_error, spread }
}

/// The middle value, or the mean of the middle two; NaN of none.
fn median(mut values: Vec<f64>) -> f64 {
    let count = values.len();
    if count == 0 {
        return f64::NAN;
    }
    let (below, middle, _) = values.select_nth_unstable_by(count / 2, f64::total_cmp);
    if count % 2 == 1 {
        return *middle;
    }
    let low = below.iter().copied().max_by(f64::total_cmp).unwrap_or(*middle);
    f64::midpoint(low, *middle)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests;
