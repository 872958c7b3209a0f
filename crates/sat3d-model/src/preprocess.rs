//! From an image to the network's input: Pillow's bicubic in its fixed point, and normalisation.
//!
//! The released weights saw images resized by Pillow. Its arithmetic is integer from the
//! coefficients on, so it can be equalled bit for bit (MODEL_SPEC section 2).

use crate::error::ModelError;
use crate::tensor::Grid;
use rayon::prelude::*;

/// Per-channel mean of the training images (ImageNet), in [0, 1].
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Per-channel standard deviation (ImageNet).
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// Fraction bits of a coefficient: 32 less 8 for the pixel, less 2 for overshoot.
const PRECISION_BITS: u32 = 22;

/// An 8-bit image: rows from the top, channels fastest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image8 {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Channels per pixel (3 for RGB, 1 for a mask).
    pub channels: usize,
    /// `height * width * channels` values.
    pub data: Vec<u8>,
}

impl Image8 {
    /// An image of the given size.
    ///
    /// # Errors
    /// [`ModelError::Shape`] where a side is 0 or `data` has another length.
    pub fn new(
        width: usize,
        height: usize,
        channels: usize,
        data: Vec<u8>,
    ) -> Result<Self, ModelError> {
        let size = width.checked_mul(height).and_then(|area| area.checked_mul(channels));
        if size != Some(data.len()) || data.is_empty() {
            return Err(ModelError::Shape {
                what: "image",
                expected: format!("{width} x {height} x {channels} values, at least one"),
                found: format!("{} values", data.len()),
            });
        }
        Ok(Self { width, height, channels, data })
    }
}

/// The taps of one output pixel of [`resize_bicubic`] along one axis.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Taps {
    /// The first source pixel.
    pub first: usize,
    /// One weight for it and each that follows, in units of 2^-22.
    pub weights: Vec<i32>,
}

/// Cubic convolution kernel with a = -0.5 (Keys 1981), the factors in Pillow's order.
fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        (((x - 5.0) * x + 8.0) * x - 4.0) * A
    } else {
        0.0
    }
}

/// Taps for resizing `source` pixels to `target`; the kernel widens when the image shrinks. First pixels
/// and last pixels both never step back from one output pixel to the next.
#[must_use]
pub fn bicubic_taps(source: usize, target: usize) -> Vec<Taps> {
    let scale = source as f64 / target as f64;
    let filter_scale = scale.max(1.0);
    let support = 2.0 * filter_scale;
    let inverse = 1.0 / filter_scale;
    (0..target)
        .map(|index| {
            let center = (index as f64 + 0.5) * scale;
            // A negative value truncates to 0 either way.
            let first = (center - support + 0.5).max(0.0) as usize;
            let last = ((center + support + 0.5) as usize).min(source);
            let raw: Vec<f64> =
                (first..last).map(|pixel| cubic((pixel as f64 - center + 0.5) * inverse)).collect();
            // Summed in order, as Pillow does: the rounding below hangs on the last bit.
            let mut sum = 0.0;
            for value in &raw {
                sum += value;
            }
            let fixed = |value: f64| {
                let value = if sum == 0.0 { value } else { value / sum };
                let scaled = value * f64::from(1_u32 << PRECISION_BITS);
                (if value < 0.0 { scaled - 0.5 } else { scaled + 0.5 }) as i32
            };
            Taps { first, weights: raw.into_iter().map(fixed).collect() }
        })
        .collect()
}

fn clip(sum: i32) -> u8 {
    (sum >> PRECISION_BITS).clamp(0, 255) as u8
}

const HALF: i32 = 1 << (PRECISION_BITS - 1);

/// Resizes one row of pixels, as the first pass of [`resize_bicubic`] does: `out` has `taps.len()` pixels.
///
/// # Panics
/// When `source` or `out` is shorter than the taps want.
pub fn resize_row(source: &[u8], channels: usize, taps: &[Taps], out: &mut [u8]) {
    for (pixel, taps) in out.chunks_exact_mut(channels).zip(taps) {
        let span = &source[taps.first * channels..];
        for (channel, value) in pixel.iter_mut().enumerate() {
            let mut sum = HALF;
            for (tap, &weight) in taps.weights.iter().enumerate() {
                sum += i32::from(span[tap * channels + channel]) * weight;
            }
            *value = clip(sum);
        }
    }
}

/// One output row of the second pass of [`resize_bicubic`]: the rows that its taps name, from the first on,
/// each times its weight.
pub fn blend_rows<'a>(rows: impl Iterator<Item = &'a [u8]>, weights: &[i32], out: &mut [u8]) {
    let mut sums = vec![HALF; out.len()];
    for (row, &weight) in rows.zip(weights) {
        for (sum, &value) in sums.iter_mut().zip(row) {
            *sum += i32::from(value) * weight;
        }
    }
    for (value, sum) in out.iter_mut().zip(sums) {
        *value = clip(sum);
    }
}

fn horizontal(image: &Image8, width: usize) -> Image8 {
    let taps = bicubic_taps(image.width, width);
    let channels = image.channels;
    let mut data = vec![0; width * image.height * channels];
    data.par_chunks_mut(width * channels).enumerate().for_each(|(row, out)| {
        let source = &image.data[row * image.width * channels..][..image.width * channels];
        resize_row(source, channels, &taps, out);
    });
    Image8 { width, height: image.height, channels, data }
}

fn vertical(image: &Image8, height: usize) -> Image8 {
    let taps = bicubic_taps(image.height, height);
    let stride = image.width * image.channels;
    let mut data = vec![0; stride * height];
    data.par_chunks_mut(stride).zip(&taps).for_each(|(out, taps)| {
        let rows = image.data[taps.first * stride..].chunks_exact(stride);
        blend_rows(rows, &taps.weights, out);
    });
    Image8 { width: image.width, height, channels: image.channels, data }
}

/// Resizes as Pillow's `resize(size, BICUBIC)` does: columns first, each pass rounded to bytes, the
/// kernel widened where the image shrinks. The aspect ratio is not kept.
///
/// Pillow from 13 on takes the rows of tall images first, which changes a few pixels by one step of
/// rounding; earlier ones, and this, never do.
///
/// # Panics
/// When `width` or `height` is 0.
#[must_use]
pub fn resize_bicubic(image: &Image8, width: usize, height: usize) -> Image8 {
    assert!(width > 0 && height > 0, "an image of {width} x {height}");
    let rows = |image: &Image8| {
        if image.height == height { image.clone() } else { vertical(image, height) }
    };
    if image.width == width { rows(image) } else { rows(&horizontal(image, width)) }
}

/// Normalises an RGB image to the network's input, `3 x height x width`: `(v/255 - mean) / std`
/// with the ImageNet statistics, in f32 as the reference does.
///
/// # Errors
/// [`ModelError::Shape`] where the image does not have 3 channels.
pub fn normalise(image: &Image8) -> Result<Grid, ModelError> {
    if image.channels != 3 {
        return Err(ModelError::Shape {
            what: "satellite image",
            expected: "3 channels (RGB)".into(),
            found: format!("{} channels", image.channels),
        });
    }
    let area = image.width * image.height;
    let mut data = vec![0.0; 3 * area];
    for (channel, plane) in data.chunks_exact_mut(area).enumerate() {
        for (value, pixel) in plane.iter_mut().zip(image.data.chunks_exact(3)) {
            let unit = f32::from(pixel[channel]) / 255.0;
            *value = (unit - MEAN[channel]) / DEVIATION[channel];
        }
    }
    Ok(Grid::new(3, image.height, image.width, data))
}

/// A satellite image of any size to the network's input of `side x side` pixels.
///
/// # Errors
/// As [`normalise`].
pub fn satellite(image: &Image8, side: usize) -> Result<Grid, ModelError> {
    normalise(&resize_bicubic(image, side, side))
}

#[cfg(test)]
mod tests;
