//! Sub-pixel co-registration after Nuth and Kaab (2011, <https://doi.org/10.5194/tc-5-271-2011>).
//!
//! They fit the cosine `dh / tan(slope) = |shift| cos(direction - aspect) + c`. Multiplied by
//! `tan(slope)` and written by components it is linear in the shift, `dh = c - gradient . shift`, and
//! needs neither an angle nor a threshold on slopes; that is what is fitted here, robustly, again and
//! again until the shift stands still, from coarse grids to the full one so that shifts of many
//! pixels are found, too.
//!
//! Noise in the heights makes the gradients look steeper than they are. Products of the two surfaces'
//! gradients do not have that flaw, since their noise is independent; the smallest ratio of the two
//! second moments over all directions (`shared`) says how much of the relief both surfaces share in
//! the direction that is determined worst. It is 1 for equal surfaces and about 0 for planes and
//! noise, where a shift would be invented.

use super::fit::{Fit, fit};
use super::offset::median;
use super::resample::{Weightless, shift_heights};
use super::{AlignSettings, Alignment, AlignmentFlag, Coregistration, Residuals, Shift};
use crate::eval::Surface;

/// Factors by which the grids are reduced, one after the other.
const FACTORS: [usize; 4] = [8, 4, 2, 1];
/// A reduced grid has at least this many pixels along each axis.
const LEAST_SIDE: usize = 32;
/// Iterations per grid.
const ITERATIONS: [u32; 4] = [12, 12, 12, 60];
/// Standing still: the next step is shorter, pixels of the full grid.
const SETTLED_PX: f64 = 0.002;
/// A shift along an axis that is this close to whole pixels is taken as whole: then heights are kept
/// as they are instead of being blended with a neighbour that has almost no weight.
const WHOLE_PX: f64 = 0.005;
/// Longest step, pixels of the grid: the fit is linear and knows only the neighbourhood.
const LONGEST_STEP_PX: f64 = 1.5;
/// Smallest share of common relief that counts.
const LEAST_SHARED: f64 = 0.1;
/// The same in units of its standard error.
const LEAST_SIGNIFICANCE: f64 = 4.0;
/// Largest standard error of a shift that counts as found, pixels.
const LARGEST_ERROR_PX: f64 = 0.5;
/// A shift must not make the mean deviation larger than by this factor.
const WORSE: f64 = 1.01;

/// Finds the shift and writes it, with what was done, into `alignment`; `after` is filled in by the
/// caller, who knows the vertical offset.
pub(super) fn coregister(
    prediction: &Surface,
    truth: &Surface,
    settings: &AlignSettings,
    alignment: &mut Alignment,
) {
    let before = residuals(prediction, truth, 0.0);
    let mut search =
        Search { shift: Shift::default(), iterations: 0, limit: settings.max_shift_px };
    let (width, height) = prediction.size();
    let mut error = Shift { x: width as f64, y: height as f64 };
    match search.run(prediction, truth) {
        Ok(found) => {
            error = found;
            alignment.shift_px = search.shift;
        }
        Err(flag) => alignment.flags.push(flag),
    }
    alignment.coregistration = Some(Coregistration {
        iterations: search.iterations,
        before,
        after: before,
        shift_error_px: error,
    });
}

/// Residuals `prediction - (aligned - offset)` over the pixels that have both.
pub(super) fn residuals(prediction: &Surface, aligned: &Surface, offset_m: f64) -> Residuals {
    let mut errors: Vec<f64> = differences(prediction, aligned).map(|d| d + offset_m).collect();
    let n = errors.len() as f64;
    let mean_m = errors.iter().sum::<f64>() / n;
    let variance = errors.iter().map(|e| (e - mean_m) * (e - mean_m)).sum::<f64>() / n;
    let median_m = median(&mut errors);
    for error in &mut errors {
        *error = (*error - median_m).abs();
    }
    Residuals {
        pixels: errors.len() as u64,
        mean_m,
        median_m,
        std_m: variance.sqrt(),
        nmad_m: 1.4826 * median(&mut errors),
    }
}

/// `prediction - truth` where both are.
fn differences<'a>(prediction: &'a Surface, truth: &'a Surface) -> impl Iterator<Item = f64> + 'a {
    prediction
        .values
        .iter()
        .zip(&truth.values)
        .map(|(p, t)| f64::from(*p) - f64::from(*t))
        .filter(|d| !d.is_nan())
}

/// Mean absolute deviation from the median, metres; NaN without common pixels.
fn deviation(prediction: &Surface, truth: &Surface) -> f64 {
    let mut values: Vec<f64> = differences(prediction, truth).collect();
    let middle = median(&mut values);
    values.iter().map(|v| (v - middle).abs()).sum::<f64>() / values.len() as f64
}

/// A search under way.
struct Search {
    /// Pixels of the full grid.
    shift: Shift,
    iterations: u32,
    limit: f64,
}

impl Search {
    /// Finds the shift; returns its standard error.
    fn run(&mut self, prediction: &Surface, truth: &Surface) -> Result<Shift, AlignmentFlag> {
        let (width, height) = prediction.size();
        for (factor, iterations) in FACTORS.into_iter().zip(ITERATIONS) {
            if factor == 1 {
                return self.finish(prediction, truth, iterations);
            }
            if width.min(height) / factor >= LEAST_SIDE {
                self.approach(prediction, truth, factor, iterations);
            }
        }
        Err(AlignmentFlag::NoInformation)
    }

    /// Comes closer on a reduced grid; a result that does not fit better is thrown away.
    fn approach(&mut self, prediction: &Surface, truth: &Surface, factor: usize, iterations: u32) {
        let (prediction, truth) = (reduce(prediction, factor), reduce(truth, factor));
        let start = self.shift;
        let before = deviation(&prediction, &moved(&truth, start, factor));
        self.iterate(&prediction, &truth, factor, iterations);
        let after = deviation(&prediction, &moved(&truth, self.shift, factor));
        // Written so that NaN (nothing left in common) is no improvement.
        if !(after < before && self.within_limit()) {
            self.shift = start;
        }
    }

    /// The full grid, and whether what came out is to be believed.
    fn finish(
        &mut self,
        prediction: &Surface,
        truth: &Surface,
        iterations: u32,
    ) -> Result<Shift, AlignmentFlag> {
        let settled = self.iterate(prediction, truth, 1, iterations);
        for axis in [&mut self.shift.x, &mut self.shift.y] {
            if (*axis - axis.round()).abs() < WHOLE_PX {
                // Plus zero, so that it is not -0.
                *axis = axis.round() + 0.0;
            }
        }
        let aligned = moved(truth, self.shift, 1);
        let last = fit(prediction, &aligned).ok_or(AlignmentFlag::NoInformation)?;
        if !last.is_determined(LEAST_SHARED, LEAST_SIGNIFICANCE, LARGEST_ERROR_PX) {
            return Err(AlignmentFlag::NoInformation);
        }
        if !self.within_limit() {
            return Err(AlignmentFlag::ShiftBeyondLimit);
        }
        let worse = deviation(prediction, &aligned) > WORSE * deviation(prediction, truth);
        if !settled || worse {
            return Err(AlignmentFlag::NotConverged);
        }
        Ok(last.error)
    }

    fn within_limit(&self) -> bool {
        self.shift.x.abs() <= self.limit && self.shift.y.abs() <= self.limit
    }

    /// Fits and shifts until the shift stands still; returns whether it does.
    fn iterate(
        &mut self,
        prediction: &Surface,
        truth: &Surface,
        factor: usize,
        iterations: u32,
    ) -> bool {
        let size = Shift { x: prediction.width as f64, y: prediction.height as f64 };
        for _ in 0..iterations {
            let Some(Fit { step, .. }) = fit(prediction, &moved(truth, self.shift, factor)) else {
                return false;
            };
            self.iterations += 1;
            let length = libm::hypot(step.x, step.y);
            let scale = factor as f64 * (LONGEST_STEP_PX / length).min(1.0);
            self.shift.x += scale * step.x;
            self.shift.y += scale * step.y;
            if length * (factor as f64) < SETTLED_PX * if factor == 1 { 1.0 } else { 50.0 } {
                return true;
            }
            let reach = factor as f64 / 2.0;
            if !(self.shift.x.abs() < size.x * reach && self.shift.y.abs() < size.y * reach) {
                return false;
            }
        }
        false
    }
}

/// The truth shifted by pixels of the full grid.
fn moved(truth: &Surface, shift: Shift, factor: usize) -> Surface {
    if shift == Shift::default() {
        return truth.clone();
    }
    let factor = factor as f64;
    let shift = Shift { x: shift.x / factor, y: shift.y / factor };
    shift_heights(truth, shift, Weightless::Ignored)
}

/// Means of blocks of `factor x factor` pixels of which at least half have a height; incomplete
/// blocks at the east and south edge are left out.
fn reduce(surface: &Surface, factor: usize) -> Surface {
    let (width, height) = (surface.width / factor, surface.height / factor);
    let mut values = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let (mut sum, mut count) = (0.0, 0_usize);
            for line in 0..factor {
                let start = (row * factor + line) * surface.width + column * factor;
                for value in &surface.values[start..start + factor] {
                    if !value.is_nan() {
                        sum += f64::from(*value);
                        count += 1;
                    }
                }
            }
            values.push(if 2 * count >= factor * factor {
                (sum / count as f64) as f32
            } else {
                f32::NAN
            });
        }
    }
    Surface::new(width, height, values)
}
