//! Pictures of height rasters: height as colour, slope as light.
//!
//! The colours are [`colour::HEIGHT`].

use super::colour;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// Colours between the lowest and the highest height of the stretch.
const STEPS: usize = 1024;
/// Shares of the valid heights below and above which the colour no longer changes.
const STRETCH: [f64; 2] = [0.02, 0.98];
/// Direction to the sun, east, north, up: azimuth 315 degrees, elevation 45 degrees.
const SUN: [f64; 3] = [-0.5, 0.5, std::f64::consts::FRAC_1_SQRT_2];
/// Brightness of ground that the sun does not reach; flat ground has 1.
const AMBIENT: f64 = 0.4;

/// A hillshaded colour picture of a height raster, as the bytes of an RGBA PNG.
///
/// * `heights`: metres, row-major, `width` a row, row 0 north. What is not finite has no data and
///   is transparent, and so is what a slice shorter than `width * height` leaves out.
/// * `ground_pixel_m`: side of a pixel in metres on the ground. In Web Mercator that is the pixel's
///   size times the cosine of the latitude
///   ([`ImageGrid::ground_sample_distance`](crate::grid::ImageGrid::ground_sample_distance)). If it
///   is not a positive number there are no slopes, and colour alone is drawn.
///
/// Colour runs from the 2nd to the 98th percentile of the valid heights (exact, linear between
/// ranks); a constant surface has the middle colour. Slopes are Horn's (1981); a neighbour without
/// data is replaced by continuing the line through its opposite, so that planes keep their slope up
/// to the border. A grid without pixels gives one transparent pixel, since PNG knows no empty image.
#[must_use]
pub fn hillshade_png(heights: &[f32], width: usize, height: usize, ground_pixel_m: f64) -> Vec<u8> {
    let heights = if width == 0 || height == 0 { &[] } else { heights };
    let (width, height) = (width.max(1), height.max(1));
    let mut rgba = vec![0; width * height * 4];
    if let Some(stretch) = Stretch::of(heights) {
        let colours = colour::table::<STEPS>(&colour::HEIGHT);
        let light = Light::new(ground_pixel_m);
        let rows: Vec<&[f32]> = heights.chunks(width).take(height).collect();
        let row = |y: Option<usize>| y.and_then(|y| rows.get(y)).copied().unwrap_or_default();
        for (y, pixels) in rgba.chunks_exact_mut(width * 4).enumerate().take(rows.len()) {
            let around = [row(y.checked_sub(1)), rows[y], row(Some(y + 1))];
            for (x, (pixel, &z)) in pixels.chunks_exact_mut(4).zip(rows[y]).enumerate() {
                if z.is_finite() {
                    let light = light.on(&window(around, x, z));
                    let [r, g, b] = colours[stretch.step(z)].map(|value| lit(value, light));
                    pixel.copy_from_slice(&[r, g, b, 255]);
                }
            }
        }
    }
    png(&rgba, width, height)
}

/// The heights that the ends of the colour map stand for.
struct Stretch {
    low: f64,
    scale: f64,
}

impl Stretch {
    /// `None` when no height is valid.
    fn of(heights: &[f32]) -> Option<Self> {
        let mut valid: Vec<f32> = heights.iter().copied().filter(|z| z.is_finite()).collect();
        if valid.is_empty() {
            return None;
        }
        let [low, high] = STRETCH.map(|share| percentile(&mut valid, share));
        let scale = if high > low { (STEPS - 1) as f64 / (high - low) } else { 0.0 };
        Some(Self { low, scale })
    }

    /// Index into the colour table.
    fn step(&self, z: f32) -> usize {
        if self.scale > 0.0 {
            // The cast saturates, which is the clamp at 0.
            (((f64::from(z) - self.low) * self.scale + 0.5) as usize).min(STEPS - 1)
        } else {
            STEPS / 2
        }
    }
}

/// The value below which `share` of the values lie, linear between ranks (numpy's default).
/// Reorders `values`, which must not be empty or hold NaN.
fn percentile(values: &mut [f32], share: f64) -> f64 {
    let rank = share * (values.len() - 1) as f64;
    let (below, fraction) = (rank as usize, rank - rank.floor());
    let (_, &mut low, above) = values.select_nth_unstable_by(below, f32::total_cmp);
    let low = f64::from(low);
    match above.iter().copied().min_by(f32::total_cmp) {
        Some(high) if fraction > 0.0 => low + fraction * (f64::from(high) - low),
        _ => low,
    }
}

/// The 3 x 3 heights around column `x` of the middle row, whose height is `z`. What has no data or
/// lies outside is continued from the opposite neighbour, or else level.
fn window(rows: [&[f32]; 3], x: usize, z: f32) -> [[f64; 3]; 3] {
    let here =
        rows.map(|row| row.get(x.wrapping_sub(1)..x + 2).and_then(|taps| taps.first_chunk::<3>()));
    if let [Some(above), Some(row), Some(below)] = here {
        let taps = [*above, *row, *below].map(|taps| taps.map(f64::from));
        // One sum instead of nine questions: it is finite only if all nine are (f32 cannot
        // overflow f64).
        if taps.iter().flatten().sum::<f64>().is_finite() {
            return taps;
        }
    }
    let z = f64::from(z);
    let known = rows.map(|row| {
        [x.checked_sub(1), Some(x), Some(x + 1)]
            .map(|x| row.get(x?).copied().filter(|z| z.is_finite()).map(f64::from))
    });
    let reflected = |dy: usize, dx: usize| {
        known[dy][dx].or_else(|| known[2 - dy][2 - dx].map(|opposite| 2.0 * z - opposite))
    };
    std::array::from_fn(|dy| {
        std::array::from_fn(|dx| {
            // At the corner of a grid neither diagonal neighbour is known: the plane through the
            // straight ones gives it.
            let beside = || reflected(dy, 1).unwrap_or(z) + reflected(1, dx).unwrap_or(z) - z;
            reflected(dy, dx).unwrap_or_else(|| if dy == 1 || dx == 1 { z } else { beside() })
        })
    })
}

/// Sunlight on a slope.
struct Light {
    /// Turns Horn's sums of differences into slopes.
    per_m: f64,
}

impl Light {
    fn new(ground_pixel_m: f64) -> Self {
        let usable = ground_pixel_m.is_finite() && ground_pixel_m > 0.0;
        Self { per_m: if usable { 1.0 / (8.0 * ground_pixel_m) } else { 0.0 } }
    }

    /// Brightness of the middle of a 3 x 3 window: 1 where it is flat, [`AMBIENT`] where the sun
    /// does not reach it, up to 1.25 where it faces the sun.
    fn on(&self, [a, b, c]: &[[f64; 3]; 3]) -> f64 {
        let east = ((a[2] + 2.0 * b[2] + c[2]) - (a[0] + 2.0 * b[0] + c[0])) * self.per_m;
        let north = ((a[0] + 2.0 * a[1] + a[2]) - (c[0] + 2.0 * c[1] + c[2])) * self.per_m;
        let facing = SUN[2] - east * SUN[0] - north * SUN[1];
        let cosine = (facing / (1.0 + east * east + north * north).sqrt()).max(0.0);
        AMBIENT + (1.0 - AMBIENT) * cosine / SUN[2]
    }
}

/// A channel of a colour under light: below 1 it goes towards black, above towards white.
fn lit(value: u8, light: f64) -> u8 {
    let value = f64::from(value);
    let lit = if light <= 1.0 { value * light } else { value + (255.0 - value) * (light - 1.0) };
    (lit + 0.5) as u8
}

fn png(rgba: &[u8], width: usize, height: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let size = |pixels| {
        u32::try_from(pixels).expect("a raster that fits memory has fewer than 2^32 columns")
    };
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(rgba, size(width), size(height), ExtendedColorType::Rgba8)
        .expect("writing a well-formed picture to memory cannot fail");
    bytes
}

#[cfg(test)]
mod tests;
