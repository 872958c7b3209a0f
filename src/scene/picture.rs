//! Encoding pictures as PNG: 8-bit RGB, a palette of 256 colours as VIGOR's files have, or grey.

use super::error::SceneError;
use super::spec::ImageColours;
use crate::raster::palette::Palette;
use std::path::Path;

/// Encodes a square RGB picture.
///
/// # Errors
/// [`SceneError::Write`] when the encoder refuses, with `path` for the message.
pub fn encode(
    rgb: &[u8],
    size: u32,
    colours: ImageColours,
    path: &Path,
) -> Result<Vec<u8>, SceneError> {
    let fail =
        |e: png::EncodingError| SceneError::Write { path: path.to_owned(), reason: e.to_string() };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, size, size);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let indexed;
    let data = match colours {
        ImageColours::Rgb => {
            encoder.set_color(png::ColorType::Rgb);
            rgb
        }
        ImageColours::Palette => {
            crate::plan::runs("palette");
            let palette = Palette::of(&[rgb]);
            indexed = palette.indices(rgb);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_palette(palette.colours().concat());
            &indexed[..]
        }
    };
    let mut writer = encoder.write_header().map_err(fail)?;
    writer.write_image_data(data).map_err(fail)?;
    writer.finish().map_err(fail)?;
    Ok(bytes)
}

/// Encodes a grey picture.
///
/// # Errors
/// [`SceneError::Write`] when the encoder refuses, with `path` for the message.
pub fn encode_grey(
    grey: &[u8],
    width: u32,
    height: u32,
    path: &Path,
) -> Result<Vec<u8>, SceneError> {
    let fail =
        |e: png::EncodingError| SceneError::Write { path: path.to_owned(), reason: e.to_string() };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(fail)?;
    writer.write_image_data(grey).map_err(fail)?;
    writer.finish().map_err(fail)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::mix;

    fn decode(bytes: &[u8]) -> image::DynamicImage {
        image::load_from_memory(bytes).expect("a PNG")
    }

    #[test]
    fn rgb_survives_and_a_palette_comes_close() {
        // Smooth colours with noise, like ground.
        let rgb: Vec<u8> = (0..64 * 64 * 3_u64)
            .map(|i| (40 + (i / 192) * 2 + (i % 3) * 30 + mix(i) % 12) as u8)
            .collect();
        let path = Path::new("x.png");
        let exact = encode(&rgb, 64, ImageColours::Rgb, path).expect("encodes");
        assert_eq!(decode(&exact).to_rgb8().into_raw(), rgb);
        let small = encode(&rgb, 64, ImageColours::Palette, path).expect("encodes");
        // Colour type 3 in the header is a palette.
        assert_eq!(small[25], 3);
        let near = decode(&small).to_rgb8().into_raw();
        let worst = near.iter().zip(&rgb).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst < Some(16), "{worst:?}");
    }

    #[test]
    fn a_picture_of_few_colours_keeps_them() {
        let rgb: Vec<u8> =
            (0..256).flat_map(|i| if i % 7 == 0 { [255, 0, 9] } else { [3, 200, 77] }).collect();
        let bytes = encode(&rgb, 16, ImageColours::Palette, Path::new("x.png")).expect("encodes");
        assert_eq!(decode(&bytes).to_rgb8().into_raw(), rgb);
    }
}
