//! Pictures of the log, as PNG.

use crate::model::Image8;
use crate::raster::colour;

/// Colours beside the transparent one.
const COLOURS: usize = 255;
/// Shares of the heights at which the colours end.
const STRETCH: [f64; 2] = [0.02, 0.98];

/// An RGB image as PNG.
#[must_use]
pub fn rgb(image: &Image8) -> Vec<u8> {
    encode(image.width, image.height, png::ColorType::Rgb, &image.data).unwrap_or_default()
}

/// A square of heights as an indexed PNG: `low` and below have the first colour of [`colour::HEIGHT`], `high` and
/// above the last; what is not finite is transparent.
#[must_use]
pub fn heights(values: &[f32], [low, high]: [f64; 2]) -> Vec<u8> {
    let side = values.len().isqrt();
    let scale = if high > low { (COLOURS - 1) as f64 / (high - low) } else { 0.0 };
    let index = |value: &f32| {
        if !value.is_finite() {
            return 0;
        }
        // The cast saturates at 0.
        1 + (((f64::from(*value) - low) * scale + 0.5) as usize).min(COLOURS - 1) as u8
    };
    let pixels: Vec<u8> = values[..side * side].iter().map(index).collect();
    encode(side, side, png::ColorType::Indexed, &pixels).unwrap_or_default()
}

/// The heights that the ends of the colours stand for: the 2nd and the 98th percentile, at least 3 m apart.
#[must_use]
pub fn range(values: &[f32]) -> [f64; 2] {
    let mut known: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    if known.is_empty() {
        return [0.0, 3.0];
    }
    known.sort_unstable_by(f32::total_cmp);
    let [low, high] =
        STRETCH.map(|share| f64::from(known[(share * (known.len() - 1) as f64).round() as usize]));
    [low, high.max(low + 3.0)]
}

fn encode(
    width: usize,
    height: usize,
    colour: png::ColorType,
    pixels: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let mut encoder = png::Encoder::new(&mut bytes, side(width), side(height));
    encoder.set_color(colour);
    encoder.set_depth(png::BitDepth::Eight);
    if colour == png::ColorType::Indexed {
        let mut palette = vec![0; 3];
        palette.extend(colour::table::<COLOURS>(&colour::HEIGHT).as_flattened());
        encoder.set_palette(palette);
        encoder.set_trns(vec![0]);
    }
    encoder.set_compression(png::Compression::Balanced);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_beyond_the_ends_have_the_ends_colours_and_nan_is_transparent() {
        let bytes = heights(&[-5.0, 0.0, 30.0, f32::NAN], [0.0, 10.0]);
        let picture = image::load_from_memory(&bytes).expect("a PNG").into_rgba8();
        let pixel = |i: u32| picture.get_pixel(i % 2, i / 2).0;
        let [low, high] = [colour::HEIGHT[0], colour::HEIGHT[16]];
        assert_eq!(pixel(0)[..3], low);
        assert_eq!(pixel(1)[..3], low);
        assert_eq!(pixel(2)[..3], high);
        assert_eq!((pixel(2)[3], pixel(3)[3]), (255, 0));
    }

    #[test]
    fn ranges_leave_out_the_extremes_and_are_never_empty() {
        let mut values: Vec<f32> = (0..1000).map(|i| i as f32 * 0.01).collect();
        values[5] = 1e9;
        values[6] = f32::NAN;
        let [low, high] = range(&values);
        assert!((0.1..0.3).contains(&low) && (9.7..9.9).contains(&high), "{low} {high}");
        assert_eq!(range(&[2.0; 4]), [2.0, 5.0]);
        assert_eq!(range(&[f32::NAN]), [0.0, 3.0]);
    }
}
