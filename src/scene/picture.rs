//! Encoding pictures as PNG: 8-bit RGB, or a palette of 256 colours as VIGOR's files have.

use super::error::SceneError;
use super::spec::ImageColours;
use std::path::Path;

/// Colours of a palette.
const PALETTE: usize = 256;
/// Bits per channel of the histogram from which the palette is made.
const BITS: u32 = 5;

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
            let palette = Palette::of(rgb);
            indexed = palette.indices(rgb);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_palette(palette.colours.concat());
            &indexed[..]
        }
    };
    let mut writer = encoder.write_header().map_err(fail)?;
    writer.write_image_data(data).map_err(fail)?;
    writer.finish().map_err(fail)?;
    Ok(bytes)
}

/// A palette made by median cut over a histogram of 15-bit colours.
struct Palette {
    colours: Vec<[u8; 3]>,
    /// Palette index of each 15-bit colour that occurs.
    index: Vec<u8>,
}

/// The bin of a colour.
fn bin(rgb: [u8; 3]) -> usize {
    rgb.iter().fold(0, |sum, c| (sum << BITS) | usize::from(c >> (8 - BITS)))
}

/// One occupied bin: its place, how many pixels, and the sum of their colours.
#[derive(Clone, Copy)]
struct Bin {
    place: usize,
    count: u64,
    sum: [u64; 3],
}

impl Bin {
    fn level(&self, channel: usize) -> u64 {
        self.sum[channel] / self.count
    }
}

impl Palette {
    fn of(rgb: &[u8]) -> Self {
        let mut bins: Vec<Bin> =
            (0..1 << (3 * BITS)).map(|place| Bin { place, count: 0, sum: [0; 3] }).collect();
        for pixel in rgb.as_chunks::<3>().0 {
            let b = &mut bins[bin(*pixel)];
            b.count += 1;
            for (sum, &level) in b.sum.iter_mut().zip(pixel) {
                *sum += u64::from(level);
            }
        }
        bins.retain(|b| b.count > 0);
        let mut boxes = vec![bins];
        while boxes.len() < PALETTE {
            // The box with the widest spread of levels, weighted by its pixels, is cut next.
            let widest = (0..boxes.len()).filter(|k| boxes[*k].len() > 1).max_by_key(|k| {
                let (channel, spread) = widest_channel(&boxes[*k]);
                let count: u64 = boxes[*k].iter().map(|b| b.count).sum();
                (spread * spread * count.isqrt(), channel, std::cmp::Reverse(*k))
            });
            let Some(k) = widest else { break };
            let mut whole = boxes.swap_remove(k);
            let (channel, _) = widest_channel(&whole);
            whole.sort_by_key(|b| (b.level(channel), b.place));
            let total: u64 = whole.iter().map(|b| b.count).sum();
            let mut sum = 0;
            let half = whole
                .iter()
                .position(|b| {
                    sum += b.count;
                    2 * sum >= total
                })
                .map_or(1, |i| (i + 1).clamp(1, whole.len() - 1));
            let upper = whole.split_off(half);
            boxes.push(whole);
            boxes.push(upper);
        }
        let mut index = vec![0; 1 << (3 * BITS)];
        let colours = boxes
            .iter()
            .zip(0_u8..=255)
            .map(|(bins, number)| {
                let count: u64 = bins.iter().map(|b| b.count).sum();
                for b in bins {
                    index[b.place] = number;
                }
                [0, 1, 2].map(|i| {
                    let sum: u64 = bins.iter().map(|b| b.sum[i]).sum();
                    ((sum + count / 2) / count.max(1)) as u8
                })
            })
            .collect();
        Self { colours, index }
    }

    fn indices(&self, rgb: &[u8]) -> Vec<u8> {
        rgb.as_chunks::<3>().0.iter().map(|pixel| self.index[bin(*pixel)]).collect()
    }
}

/// The channel in which a box's colours differ most, and by how many levels.
fn widest_channel(bins: &[Bin]) -> (usize, u64) {
    (0..3)
        .map(|channel| {
            let levels = bins.iter().map(|b| b.level(channel));
            let low = levels.clone().min().unwrap_or(0);
            (channel, levels.max().unwrap_or(0) - low)
        })
        .max_by_key(|(channel, spread)| (*spread, std::cmp::Reverse(*channel)))
        .unwrap_or((0, 0))
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
