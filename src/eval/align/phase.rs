//! Phase correlation of two 8-bit images with sub-pixel refinement, by the rules of scikit-image's
//! `phase_cross_correlation` (Guizar-Sicairos, Thurman and Fienup 2008, <https://doi.org/10.1364/OL.33.000156>).
//!
//! Both images are real, so one complex transform gives both spectra, and half of the cross power
//! spectrum gives the whole correlation. The scalar transforms of `rustfft` are used: the vector ones
//! round differently from processor to processor.

use super::Shift;
use rustfft::num_complex::Complex64;
use rustfft::{Fft, FftPlannerScalar};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Steps per pixel of the refinement.
const UPSAMPLING: f64 = 10.0;
/// Steps on either side of the whole pixel that the refinement looks at: a region of
/// `ceil(1.5 * 10)` steps.
const REACH: usize = 7;
/// Waves of less than this part of an image's sum are the rounding of its transform, of which the
/// division by the amplitude would make waves like all others. (Those of 8-bit images that do not
/// repeat themselves exactly are 1e4 times larger and more.)
const ROUNDING: f64 = 1e-10;
/// Correlations closer to each other than this, relatively, differ by rounding.
const TIE: f64 = 1e-9;
/// Steps in all.
const REGION: usize = 2 * REACH + 1;

/// Transforms of one size.
struct Plans {
    size: (usize, usize),
    rows_forward: Arc<dyn Fft<f64>>,
    rows_inverse: Arc<dyn Fft<f64>>,
    columns_forward: Arc<dyn Fft<f64>>,
    columns_inverse: Arc<dyn Fft<f64>>,
}

/// Finds shifts; keeps transforms and buffers.
#[derive(Default)]
pub(super) struct PhaseCorrelator {
    plans: Option<Plans>,
    image: Vec<Complex64>,
    spectrum: Vec<Complex64>,
    power: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl PhaseCorrelator {
    /// The shift to apply to `moving` so that it lies on `reference`, in tenths of a pixel, wrapping
    /// around the edges.
    pub(super) fn shift(
        &mut self,
        reference: &[u8],
        moving: &[u8],
        width: usize,
        height: usize,
    ) -> Shift {
        self.cross_power(reference, moving, width, height);
        let (row, column) = self.peak(width, height);
        let (y, x) = (wrapped(row, height), wrapped(column, width));
        let (row_step, column_step) = self.refine(width, height, y, x);
        let refined = |whole: f64, step: usize, count: usize| {
            // An axis of one sample has nothing to shift.
            if count == 1 { 0.0 } else { whole + (step as f64 - REACH as f64) / UPSAMPLING }
        };
        Shift { x: refined(x, column_step, width), y: refined(y, row_step, height) }
    }

    /// Fills `power` with the cross power spectrum of unit amplitude, transposed (`width` lines of
    /// `height`).
    fn cross_power(&mut self, reference: &[u8], moving: &[u8], width: usize, height: usize) {
        let plans = match &mut self.plans {
            Some(plans) if plans.size == (width, height) => plans,
            plans => {
                let mut planner = FftPlannerScalar::new();
                plans.insert(Plans {
                    size: (width, height),
                    rows_forward: planner.plan_fft_forward(width),
                    rows_inverse: planner.plan_fft_inverse(width),
                    columns_forward: planner.plan_fft_forward(height),
                    columns_inverse: planner.plan_fft_inverse(height),
                })
            }
        };
        let zero = Complex64::default();
        let longest = [
            &plans.rows_forward,
            &plans.rows_inverse,
            &plans.columns_forward,
            &plans.columns_inverse,
        ]
        .map(|plan| plan.get_inplace_scratch_len())
        .into_iter()
        .fold(0, usize::max);
        self.scratch.resize(longest.max(self.scratch.len()), zero);
        self.image.clear();
        self.image.extend(
            reference.iter().zip(moving).map(|(a, b)| Complex64::new(f64::from(*a), f64::from(*b))),
        );
        plans.rows_forward.process_with_scratch(&mut self.image, &mut self.scratch);
        self.spectrum.resize(width * height, zero);
        transpose(&self.image, width, height, &mut self.spectrum);
        plans.columns_forward.process_with_scratch(&mut self.spectrum, &mut self.scratch);

        // The spectrum of a + ib at k, z, and at -k, m, holds both: a = (z + m*) / 2,
        // b = (z - m*) / 2i. The factors do not matter but for the smallest amplitude.
        self.power.resize(width * height, zero);
        // The first is the sum of one image plus i times that of the other.
        let sums = self.spectrum.first().map_or(0.0, |sums| (sums.re * sums.im).abs());
        let least = (100.0 * f64::EPSILON).max(ROUNDING * ROUNDING * sums);
        for column in 0..width {
            let mirrored = (width - column) % width;
            for row in 0..height {
                let z = self.spectrum[column * height + row];
                let m = self.spectrum[mirrored * height + (height - row) % height].conj();
                let a = (z + m) * 0.5;
                let d = (z - m) * 0.5;
                let b = Complex64::new(d.im, -d.re);
                let product = a * b.conj();
                let amplitude = product.norm_sqr().sqrt().max(least);
                self.power[column * height + row] = product / amplitude;
            }
        }
    }

    /// Row and column of the largest magnitude of the correlation. Of several that differ by rounding
    /// alone, as those of an image that repeats itself do, the one that stands for the shortest shift,
    /// and of these the first: rounding must not choose between shifts that are a period apart.
    fn peak(&mut self, width: usize, height: usize) -> (usize, usize) {
        let Some(plans) = &self.plans else { return (0, 0) };
        let half = width / 2 + 1;
        self.spectrum.clear();
        self.spectrum.extend_from_slice(&self.power[..half * height]);
        plans.columns_inverse.process_with_scratch(&mut self.spectrum, &mut self.scratch);
        // Each row is real, so two go into one transform: the second times i.
        let pairs = height.div_ceil(2);
        self.image.clear();
        self.image.resize(pairs * width, Complex64::default());
        for (pair, line) in self.image.chunks_exact_mut(width).enumerate() {
            let (upper, lower) = (2 * pair, 2 * pair + 1);
            for column in 0..half {
                let a = self.spectrum[column * height + upper];
                let b = if lower < height {
                    self.spectrum[column * height + lower]
                } else {
                    Complex64::default()
                };
                line[column] = Complex64::new(a.re - b.im, a.im + b.re);
                let mirrored = (width - column) % width;
                if mirrored >= half {
                    line[mirrored] = Complex64::new(a.re + b.im, b.re - a.im);
                }
            }
        }
        plans.rows_inverse.process_with_scratch(&mut self.image, &mut self.scratch);
        let magnitudes = || {
            (0..height).flat_map(|row| {
                let line = self.image[row / 2 * width..][..width].iter();
                line.map(move |value| if row % 2 == 0 { value.re } else { value.im }.abs())
            })
        };
        let largest = magnitudes().fold(0.0, f64::max);
        let mut best = (f64::INFINITY, (0, 0));
        for (at, value) in magnitudes().enumerate() {
            if value >= largest * (1.0 - TIE) {
                let (row, column) = (at / width, at % width);
                let length = libm::hypot(wrapped(row, height), wrapped(column, width));
                if length < best.0 {
                    best = (length, (row, column));
                }
            }
        }
        best.1
    }

    /// Steps (0..15 down and across) of the first largest magnitude of the correlation around a
    /// whole-pixel shift, by a matrix product with the needed part of a finer transform.
    fn refine(&mut self, width: usize, height: usize, y: f64, x: f64) -> (usize, usize) {
        let row_waves = Waves::new(height, y);
        let column_waves = Waves::new(width, x);
        let mut sums = [[Complex64::default(); REGION]; REGION];
        for column in 0..width {
            let line = &self.power[column * height..][..height];
            let along = row_waves.project(line);
            for (sums, along) in sums.iter_mut().zip(along) {
                column_waves.spread(column, along, sums);
            }
        }
        let mut best = (-1.0, (0, 0));
        for (row, sums) in sums.iter().enumerate() {
            for (column, sum) in sums.iter().enumerate() {
                let value = sum.norm_sqr().sqrt();
                if value > best.0 {
                    best = (value, (row, column));
                }
            }
        }
        best.1
    }
}

/// A position as a shift: the upper half of the positions are negative shifts.
fn wrapped(position: usize, count: usize) -> f64 {
    if position > count / 2 { position as f64 - count as f64 } else { position as f64 }
}

/// For each frequency of an axis: the phase at the whole-pixel shift, and the waves at the first
/// steps away from it; waves at steps the other way are their conjugates.
struct Waves {
    centre: Vec<Complex64>,
    steps: Vec<[Complex64; REACH]>,
}

impl Waves {
    fn new(count: usize, shift: f64) -> Self {
        let wave = |frequency: f64, at: f64| {
            let phase = TAU * frequency * at / count as f64;
            Complex64::new(libm::cos(phase), libm::sin(phase))
        };
        let frequencies = (0..count).map(|k| {
            // The middle frequency of an even count is the negative one.
            if k < count.div_ceil(2) { k as f64 } else { k as f64 - count as f64 }
        });
        Self {
            centre: frequencies.clone().map(|f| wave(f, shift)).collect(),
            steps: frequencies
                .map(|f| std::array::from_fn(|i| wave(f, (i + 1) as f64 / UPSAMPLING)))
                .collect(),
        }
    }

    /// Sums of a line of the spectrum times the waves of each step.
    fn project(&self, line: &[Complex64]) -> [Complex64; REGION] {
        // With value p and wave c + is: p (c + is) and p (c - is) share their products.
        let mut centre = Complex64::default();
        let mut cosines = [Complex64::default(); REACH];
        let mut sines = [Complex64::default(); REACH];
        for ((value, phase), steps) in line.iter().zip(&self.centre).zip(&self.steps) {
            let value = value * phase;
            centre += value;
            for i in 0..REACH {
                cosines[i] += value * steps[i].re;
                sines[i] += value * steps[i].im;
            }
        }
        let mut out = [centre; REGION];
        for i in 0..REACH {
            let turned = Complex64::new(-sines[i].im, sines[i].re);
            out[REACH + 1 + i] = cosines[i] + turned;
            out[REACH - 1 - i] = cosines[i] - turned;
        }
        out
    }

    /// Adds a value times the waves of one frequency.
    fn spread(&self, frequency: usize, value: Complex64, sums: &mut [Complex64; REGION]) {
        let value = value * self.centre[frequency];
        sums[REACH] += value;
        for (i, step) in self.steps[frequency].iter().enumerate() {
            sums[REACH + 1 + i] += value * step;
            sums[REACH - 1 - i] += value * step.conj();
        }
    }
}

/// Turns lines of `width` into lines of `height`, in blocks that stay in the cache.
fn transpose(from: &[Complex64], width: usize, height: usize, to: &mut [Complex64]) {
    const BLOCK: usize = 16;
    for top in (0..height).step_by(BLOCK) {
        for left in (0..width).step_by(BLOCK) {
            for row in top..(top + BLOCK).min(height) {
                for column in left..(left + BLOCK).min(width) {
                    to[column * height + row] = from[row * width + column];
                }
            }
        }
    }
}
