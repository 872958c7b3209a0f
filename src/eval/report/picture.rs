//! Pictures of surfaces for the report: indexed PNGs, no data transparent.

use crate::eval::Surface;
use crate::raster::colour;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

/// Most pixels across or down; larger surfaces are averaged over blocks.
const LARGEST: usize = 256;
/// Colours beside the transparent one.
const COLOURS: usize = 255;

/// A surface as the data URI of a PNG. Heights at or beyond `low` and `high` have the first and the
/// last colour of `map`, NaN is transparent.
///
/// # Errors
/// What the encoder says.
pub(super) fn data_uri(
    surface: &Surface,
    [low, high]: [f64; 2],
    map: &[[u8; 3]],
) -> Result<String, png::EncodingError> {
    let surface = small(surface);
    let mut palette = vec![0; 3];
    palette.extend(colour::table::<COLOURS>(map).as_flattened());
    let scale = if high > low { (COLOURS - 1) as f64 / (high - low) } else { 0.0 };
    let index = |value: &f32| {
        if value.is_nan() {
            return 0;
        }
        let step = if scale > 0.0 { (f64::from(*value) - low) * scale } else { 127.0 };
        // The cast saturates at 0.
        1 + ((step + 0.5) as usize).min(COLOURS - 1) as u8
    };
    let pixels: Vec<u8> = surface.values.iter().map(index).collect();

    let mut bytes = Vec::new();
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let mut encoder = png::Encoder::new(&mut bytes, side(surface.width), side(surface.height));
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    encoder.set_trns(vec![0]);
    encoder.set_compression(png::Compression::Balanced);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(format!("data:image/png;base64,{}", STANDARD.encode(bytes)))
}

/// Means of equal blocks that make the surface at most [`LARGEST`] pixels wide and high; NaN only
/// where a whole block is.
pub(super) fn small(surface: &Surface) -> Surface {
    let block = surface.width.max(surface.height).div_ceil(LARGEST).max(1);
    if block == 1 {
        return surface.clone();
    }
    let (width, height) = (surface.width.div_ceil(block), surface.height.div_ceil(block));
    let mut values = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut pixels) = (0.0, 0_u32);
            for row in y * block..((y + 1) * block).min(surface.height) {
                for column in x * block..((x + 1) * block).min(surface.width) {
                    let value = surface.values[row * surface.width + column];
                    if !value.is_nan() {
                        sum += f64::from(value);
                        pixels += 1;
                    }
                }
            }
            values.push((sum / f64::from(pixels)) as f32);
        }
    }
    Surface { width, height, values }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode(uri: &str) -> (u32, u32, Vec<u8>) {
        let base64 = uri.strip_prefix("data:image/png;base64,").expect("a data URI");
        let bytes = STANDARD.decode(base64).expect("base64");
        let picture = image::load_from_memory(&bytes).expect("a PNG").into_rgba8();
        (picture.width(), picture.height(), picture.into_raw())
    }

    #[test]
    fn ends_have_the_ends_of_the_map_and_nan_is_transparent() {
        let surface = Surface::new(5, 1, vec![-9.0, 0.0, 10.0, 1e30, f32::NAN]);
        let (width, height, rgba) =
            decode(&data_uri(&surface, [0.0, 10.0], &colour::HEIGHT).expect("encodes"));
        assert_eq!((width, height), (5, 1));
        let [low, high] = [colour::HEIGHT[0], colour::HEIGHT[16]];
        for (pixel, colour) in [(0, low), (1, low), (2, high), (3, high)] {
            assert_eq!(rgba[4 * pixel..4 * pixel + 3], colour);
            assert_eq!(rgba[4 * pixel + 3], 255);
        }
        assert_eq!(rgba[19], 0);
    }

    #[test]
    fn a_scale_without_extent_and_infinities_are_drawn() {
        let surface = Surface::new(3, 1, vec![1.0, f32::INFINITY, f32::NEG_INFINITY]);
        let flat = data_uri(&surface, [1.0, 1.0], &colour::DIVERGING).expect("encodes");
        assert_eq!(decode(&flat).2.len(), 12);
        let some = data_uri(&surface, [0.0, 2.0], &colour::DIVERGING).expect("encodes");
        assert_eq!(decode(&some).2[4..7], colour::DIVERGING[16]);
    }

    #[test]
    fn large_surfaces_are_averaged_without_their_holes() {
        let (width, height) = (600, 2);
        let mut values: Vec<f32> = (0..width * height).map(|i| (i % width) as f32).collect();
        values[0] = f32::NAN;
        values[3..6].fill(f32::NAN);
        values[603..606].fill(f32::NAN);
        let small = small(&Surface::new(width, height, values));
        assert_eq!((small.width, small.height), (200, 1));
        // (1 + 2 + 0 + 1 + 2) / 5: one of the six has no height.
        assert!((small.values[0] - 1.2).abs() < 1e-6);
        assert!(small.values[1].is_nan());
        assert_eq!(small.values[2], 7.0);
    }
}
