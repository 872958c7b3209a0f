//! A picture of a grid of heights: colour by height, relief by light from the north-west.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// The viridis colour map (S. van der Walt and N. Smith, CC0) at ten even steps: equal differences
/// of height are equal differences to the eye, for the colour-blind too.
const VIRIDIS: [[u8; 3]; 10] = [
    [68, 1, 84],
    [72, 40, 120],
    [62, 73, 137],
    [49, 104, 142],
    [38, 130, 142],
    [31, 158, 137],
    [53, 183, 121],
    [109, 205, 89],
    [180, 222, 44],
    [253, 231, 37],
];

/// Shares of the heights below and above which colours no longer change.
const STRETCH: (f64, f64) = (0.02, 0.98);
/// Direction to the light, east, north and up: azimuth 315 degrees, altitude 45 degrees.
const LIGHT: [f64; 3] = [-0.5, 0.5, std::f64::consts::FRAC_1_SQRT_2];
/// Brightness of what no light reaches.
const AMBIENT: f64 = 0.35;

/// Draws heights (metres, row-major, row 0 in the north, NaN = no data) as a PNG of one pixel each.
///
/// `ground_pixel_m` is the size of a pixel on the ground in metres, so that slopes are true: in Web
/// Mercator that is the pixel size times the cosine of the latitude. Colours run from the 2nd to the
/// 98th percentile; pixels without data are transparent.
///
/// # Panics
/// Where `heights` are not `width * height` values, at least one, or the pixel size is not positive:
/// mistakes of the caller, never of the data.
#[must_use]
pub fn hillshade_png(heights: &[f32], width: usize, height: usize, ground_pixel_m: f64) -> Vec<u8> {
    let rgba = hillshade(heights, width, height, ground_pixel_m);
    let mut png = Vec::with_capacity(rgba.len() / 2);
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive)
        .write_image(&rgba, width as u32, height as u32, ExtendedColorType::Rgba8)
        .expect("a PNG in memory has no reason to fail");
    png
}

/// [`hillshade_png`] as pixels: red, green, blue and opacity.
fn hillshade(heights: &[f32], width: usize, height: usize, ground_pixel_m: f64) -> Vec<u8> {
    assert!(!heights.is_empty() && heights.len() == width * height, "{width} x {height} heights");
    assert!(ground_pixel_m > 0.0, "pixels of {ground_pixel_m} m");
    let (low, high) = stretch(heights);
    // A flat picture has the middle colour.
    let (offset, scale) = if high > low { (low, 1.0 / (high - low)) } else { (low - 0.5, 1.0) };
    let mut rgba = Vec::with_capacity(4 * heights.len());
    for y in 0..height {
        for x in 0..width {
            let h = f64::from(heights[y * width + x]);
            if !h.is_finite() {
                rgba.extend_from_slice(&[0; 4]);
                continue;
            }
            let light = illumination(heights, width, height, (x, y), ground_pixel_m);
            let colour = viridis((h - offset) * scale);
            // A level surface keeps its colour; slopes towards the light become a little brighter.
            let brightness = AMBIENT + (1.0 - AMBIENT) * light / LIGHT[2];
            rgba.extend(colour.map(|c| (c * brightness).round().clamp(0.0, 255.0) as u8));
            rgba.push(255);
        }
    }
    rgba
}

/// Heights between which colours change.
fn stretch(heights: &[f32]) -> (f64, f64) {
    let mut valid: Vec<f32> = heights.iter().copied().filter(|h| h.is_finite()).collect();
    if valid.is_empty() {
        return (0.0, 0.0);
    }
    let last = valid.len() - 1;
    let mut at = |share: f64| {
        let n = (share * last as f64).round() as usize;
        f64::from(*valid.select_nth_unstable_by(n, f32::total_cmp).1)
    };
    (at(STRETCH.0), at(STRETCH.1))
}

/// Cosine between the surface's normal and the light, 0 where it is turned away. Slopes are Horn's
/// (weighted differences over 3 x 3 pixels); a neighbour without data counts as level.
fn illumination(
    heights: &[f32],
    width: usize,
    height: usize,
    (x, y): (usize, usize),
    pixel_m: f64,
) -> f64 {
    let centre = heights[y * width + x];
    let at = |dx: usize, dy: usize| {
        // Beyond the edge the edge itself counts.
        let column = (x + dx).saturating_sub(1).min(width - 1);
        let row = (y + dy).saturating_sub(1).min(height - 1);
        let h = heights[row * width + column];
        f64::from(if h.is_finite() { h } else { centre })
    };
    let east = (at(2, 0) + 2.0 * at(2, 1) + at(2, 2)) - (at(0, 0) + 2.0 * at(0, 1) + at(0, 2));
    let south = (at(0, 2) + 2.0 * at(1, 2) + at(2, 2)) - (at(0, 0) + 2.0 * at(1, 0) + at(2, 0));
    let (slope_east, slope_north) = (east / (8.0 * pixel_m), -south / (8.0 * pixel_m));
    let length = (1.0 + slope_east * slope_east + slope_north * slope_north).sqrt();
    let cosine = (LIGHT[2] - slope_east * LIGHT[0] - slope_north * LIGHT[1]) / length;
    cosine.max(0.0)
}

/// Colour at `t` from 0 to 1, from 0 to 255 each.
fn viridis(t: f64) -> [f64; 3] {
    let steps = VIRIDIS.len() - 1;
    let position = t.clamp(0.0, 1.0) * steps as f64;
    let step = (position as usize).min(steps - 1);
    let share = position - step as f64;
    std::array::from_fn(|i| {
        let (a, b) = (f64::from(VIRIDIS[step][i]), f64::from(VIRIDIS[step + 1][i]));
        a + (b - a) * share
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(east: f64, north: f64) -> Vec<f32> {
        (0..25).map(|i| (east * f64::from(i % 5) - north * f64::from(i / 5)) as f32).collect()
    }

    #[test]
    fn light_on_a_plane_is_the_cosine_of_its_angle_to_the_light() {
        let level = illumination(&plane(0.0, 0.0), 5, 5, (2, 2), 1.0);
        assert!((level - 0.5_f64.sqrt()).abs() < 1e-12);
        // A slope of 45 degrees that faces north-west lies straight to the light.
        let s = 0.5_f64.sqrt();
        let facing = illumination(&plane(s, -s), 5, 5, (2, 2), 1.0);
        assert!((facing - 1.0).abs() < 1e-6, "{facing}");
        let away = illumination(&plane(-s, s), 5, 5, (2, 2), 1.0);
        assert!(away.abs() < 1e-6, "{away}");
        // On pixels of 2 m the same heights are half as steep.
        let gentler = illumination(&plane(2.0 * s, -2.0 * s), 5, 5, (2, 2), 2.0);
        assert!((gentler - facing).abs() < 1e-6);
    }

    #[test]
    fn voids_are_transparent_and_cast_no_edges() {
        let mut heights = vec![10.0; 25];
        heights[12] = f32::NAN;
        let rgba = hillshade(&heights, 5, 5, 0.1);
        assert_eq!(&rgba[4 * 12..4 * 13], [0; 4]);
        assert!(rgba.chunks(4).enumerate().all(|(i, p)| i == 12 || p == &rgba[..4]));
        assert_eq!(rgba[3], 255);
        assert!(hillshade(&[f32::NAN], 1, 1, 0.1).iter().all(|&b| b == 0));
        assert!(hillshade(&[f32::INFINITY], 1, 1, 0.1).iter().all(|&b| b == 0));
    }

    #[test]
    fn colours_span_the_map_and_outliers_do_not_stretch_it() {
        // Level terraces of 100 pixels, so that colour is all that differs inside them.
        let mut heights: Vec<f32> = (0..10_000).map(|i| (i / 100 / 10) as f32).collect();
        heights[5050] = 1e6;
        let rgba = hillshade(&heights, 100, 100, 1e9);
        assert_eq!(rgba[..3], VIRIDIS[0]);
        assert_eq!(rgba[4 * 9999..4 * 9999 + 3], VIRIDIS[9]);
        // Half way between the fifth and the sixth.
        assert_eq!(viridis(0.5), [34.5, 144.0, 139.5]);
    }

    #[test]
    fn the_png_holds_the_pixels() {
        let heights: Vec<f32> = (0..600).map(|i| if i % 7 == 0 { f32::NAN } else { i as f32 }).collect();
        let png = hillshade_png(&heights, 30, 20, 0.1);
        let back = image::load_from_memory(&png).expect("a PNG").to_rgba8();
        assert_eq!((back.width(), back.height()), (30, 20));
        assert_eq!(back.into_raw(), hillshade(&heights, 30, 20, 0.1));
    }
}
