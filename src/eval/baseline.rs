//! Predictions that know nothing, or everything but one thing: what a score has to be held against.
//!
//! Each baseline is made from the ground truth itself, so its scores follow from the truth: the flat
//! one scores the spread of the heights, the shifted one what a known displacement costs (and tells
//! whether an alignment finds it), the blurred one what a resolution costs.

use super::inputs::{InputError, InputSettings, pair, read_truth};
use super::resize::{Resize, resize};
use super::run::EvalError;
use super::surface::Surface;
use crate::batch::write_atomic;
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// What a baseline predicts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Baseline {
    /// One height everywhere: the truth's median.
    Flat,
    /// The bare earth (`dtm`) of the truth.
    Ground,
    /// The truth after a Gaussian blur.
    Blurred {
        /// Standard deviation, metres on the ground.
        sigma_m: f64,
    },
    /// The truth displaced by whole pixels of the prediction.
    Shifted {
        /// Pixels east.
        east_px: i32,
        /// Pixels south.
        south_px: i32,
    },
}

/// What [`write_baselines`] did.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct BaselineSummary {
    /// Predictions written.
    pub written: u64,
    /// Ground truths that gave none, with the reason.
    pub failed: Vec<String>,
}

/// Writes a baseline prediction `<stem>.npz` (key `dsm`, metres, `size` x `size` pixels) for every
/// ground truth of a folder.
///
/// # Errors
/// [`EvalError`] when the folder cannot be read or a file not be written.
pub fn write_baselines(
    truth: &Path,
    out: &Path,
    baseline: Baseline,
    size: usize,
    settings: &InputSettings,
) -> Result<BaselineSummary, EvalError> {
    let pairs = pair(&[], truth)?;
    std::fs::create_dir_all(out)
        .map_err(|source| EvalError::Write { path: out.to_owned(), source })?;
    let results: Vec<Result<Result<PathBuf, InputError>, EvalError>> = pairs
        .par_iter()
        .filter_map(|pair| Some((pair.name.as_str(), pair.truth.as_deref()?)))
        .map(|(name, path)| {
            let surface = match predict(name, path, baseline, size, settings) {
                Ok(surface) => surface,
                Err(error) => return Ok(Err(error)),
            };
            let shape = [surface.height, surface.width];
            let array =
                NpyArray { name: "dsm", shape: &shape, data: NpyData::F32(&surface.values) };
            let file = out.join(format!("{name}.npz"));
            write_atomic(&file, &npz::encode(&[array], Compression::Fast))
                .map_err(|source| EvalError::Write { path: file.clone(), source })?;
            Ok(Ok(file))
        })
        .collect();
    let mut summary = BaselineSummary { written: 0, failed: Vec::new() };
    for result in results {
        match result? {
            Ok(_) => summary.written += 1,
            Err(error) => summary.failed.push(error.to_string()),
        }
    }
    Ok(summary)
}

fn predict(
    name: &str,
    path: &Path,
    baseline: Baseline,
    size: usize,
    settings: &InputSettings,
) -> Result<Surface, InputError> {
    let truth = read_truth(name, path, settings)?;
    let surface = resize(&truth.surface, size, size, Resize::Area);
    Ok(match baseline {
        Baseline::Flat => {
            let mut heights: Vec<f32> =
                surface.values.iter().copied().filter(|v| !v.is_nan()).collect();
            let middle = heights.len() / 2;
            if heights.is_empty() {
                return Err(InputError::content(path, "no pixel has a height at this size"));
            }
            let (_, median, _) = heights.select_nth_unstable_by(middle, f32::total_cmp);
            Surface::new(size, size, vec![*median; size * size])
        }
        Baseline::Ground => match &truth.ground {
            Some(ground) => resize(ground, size, size, Resize::Area),
            None => {
                return Err(InputError::content(
                    path,
                    "it has no bare earth (`dtm`); build the benchmark with --dtm",
                ));
            }
        },
        Baseline::Blurred { sigma_m } => {
            let Some((pixel, _)) = truth.place.pixel_m else {
                return Err(InputError::content(
                    path,
                    "its ground sample distance is unknown, so a blur in metres means nothing; say --gsd",
                ));
            };
            blur(&surface, sigma_m / (pixel * truth.surface.width as f64 / size as f64))
        }
        Baseline::Shifted { east_px, south_px } => shift(&surface, east_px, south_px),
    })
}

/// Moves a surface by whole pixels; what comes in from outside is empty.
fn shift(surface: &Surface, east: i32, south: i32) -> Surface {
    let (width, height) = surface.size();
    let mut moved = Surface::empty(width, height);
    for y in 0..height {
        for x in 0..width {
            let from = (x as i64 - i64::from(east), y as i64 - i64::from(south));
            if (0..width as i64).contains(&from.0) && (0..height as i64).contains(&from.1) {
                moved.values[y * width + x] =
                    surface.values[from.1 as usize * width + from.0 as usize];
            }
        }
    }
    moved
}

/// Gaussian blur over the valid pixels, cut at four standard deviations; empty pixels stay empty.
fn blur(surface: &Surface, sigma_px: f64) -> Surface {
    if sigma_px <= 0.0 {
        return surface.clone();
    }
    let reach = (4.0 * sigma_px).ceil() as usize;
    let weights: Vec<f64> = (0..=reach)
        .map(|k| libm::exp(-0.5 * (k as f64 / sigma_px) * (k as f64 / sigma_px)))
        .collect();
    let (width, height) = surface.size();
    // Value times validity and validity are blurred alike; their ratio is the mean of valid pixels.
    let mut values: Vec<f64> =
        surface.values.iter().map(|&v| if v.is_nan() { 0.0 } else { f64::from(v) }).collect();
    let mut valid: Vec<f64> =
        surface.values.iter().map(|&v| if v.is_nan() { 0.0 } else { 1.0 }).collect();
    for grid in [&mut values, &mut valid] {
        convolve(grid, (height, width, width, 1), &weights);
        convolve(grid, (width, height, 1, width), &weights);
    }
    let ratio = values
        .iter()
        .zip(&valid)
        .zip(&surface.values)
        .map(|((sum, share), &own)| if own.is_nan() { f32::NAN } else { (sum / share) as f32 });
    Surface::new(width, height, ratio.collect())
}

/// Convolves every line of a grid with a symmetric kernel: `lines` lines `line_step` apart, of
/// `length` samples `step` apart.
fn convolve(
    grid: &mut [f64],
    (lines, length, line_step, step): (usize, usize, usize, usize),
    weights: &[f64],
) {
    let mut line = vec![0.0; length];
    for l in 0..lines {
        let start = l * line_step;
        for (k, value) in line.iter_mut().enumerate() {
            *value = grid[start + k * step];
        }
        for k in 0..length {
            let mut sum = weights[0] * line[k];
            for (d, weight) in weights.iter().enumerate().skip(1) {
                let left = k.checked_sub(d).map_or(0.0, |at| line[at]);
                let right = line.get(k + d).copied().unwrap_or(0.0);
                sum += weight * (left + right);
            }
            grid[start + k * step] = sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blur_keeps_constants_and_holes_and_spreads_a_spike_as_the_gaussian_does() {
        let mut flat = Surface::new(40, 30, vec![7.25; 1200]);
        flat.values[100] = f32::NAN;
        let blurred = blur(&flat, 3.0);
        assert!(blurred.values[100].is_nan());
        assert!(blurred.values.iter().all(|v| v.is_nan() || *v == 7.25));
        let mut spike = Surface::new(81, 81, vec![0.0; 81 * 81]);
        spike.values[40 * 81 + 40] = 1.0;
        let blurred = blur(&spike, 4.0);
        let at = |x: usize, y: usize| f64::from(blurred.values[y * 81 + x]);
        let expected = |r2: f64| libm::exp(-r2 / 32.0) / (std::f64::consts::TAU * 16.0);
        // Cut at four sigma, the kernel lacks 6e-5 of its weight per axis.
        for (x, y) in [(40, 40), (44, 40), (40, 47), (36, 43)] {
            let r2 =
                ((x as f64 - 40.0) * (x as f64 - 40.0)) + (y as f64 - 40.0) * (y as f64 - 40.0);
            assert!((at(x, y) / expected(r2) - 1.0).abs() < 1e-3, "{x} {y}");
        }
    }

    #[test]
    fn a_shift_moves_east_and_south() {
        let surface = Surface::new(3, 2, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let moved = shift(&surface, 1, 1);
        assert_eq!(moved.values[4..], [1.0, 2.0]);
        assert!(moved.values[..4].iter().all(|v| v.is_nan()));
        assert_eq!(shift(&surface, -2, 0).values[0], 3.0);
    }
}
