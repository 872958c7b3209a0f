//! Pictures of tiles: the city's colours, averaged for the coarser levels.

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

/// Pixels across a picture at most.
pub(super) const MOST: u32 = 512;
/// Of JPEG, 1 to 100: hardly to be told from the original, a fifth of a PNG.
const QUALITY: u8 = 90;

/// A tile's picture while its parent may need it: values are not rounded before they are stored.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Texture {
    /// Columns and rows.
    pub(super) size: [u32; 2],
    /// Red, green and blue, 0 to 255, row by row.
    values: Vec<[f32; 3]>,
}

impl Texture {
    /// Of a part of the city's picture as it is.
    pub(super) fn of_colours(size: [u32; 2], colours: &[u8]) -> Self {
        let values = colours.as_chunks::<3>().0.iter().map(|value| value.map(f32::from)).collect();
        Self { size, values }
    }

    /// A picture that others are put into.
    pub(super) fn blank(size: [u32; 2]) -> Self {
        Self { size, values: vec![[0.0; 3]; size[0] as usize * size[1] as usize] }
    }

    /// Puts a child's picture at a place, every `factor` x `factor` of its pixels (1 or 2) as their mean. At the
    /// city's edge it is the mean of those that there are.
    pub(super) fn put(&mut self, child: &Self, [left, top]: [u32; 2], factor: u32) {
        let [width, height] = child.size;
        for row in 0..height.div_ceil(factor).min(self.size[1].saturating_sub(top)) {
            for column in 0..width.div_ceil(factor).min(self.size[0].saturating_sub(left)) {
                let rows = row * factor..((row + 1) * factor).min(height);
                let (mut sum, mut count) = ([0.0_f32; 3], 0.0_f32);
                for y in rows {
                    for x in column * factor..((column + 1) * factor).min(width) {
                        let value = child.values[(y * width + x) as usize];
                        for (sum, value) in sum.iter_mut().zip(value) {
                            *sum += value;
                        }
                        count += 1.0;
                    }
                }
                let at = (top + row) * self.size[0] + left + column;
                self.values[at as usize] = sum.map(|sum| sum / count);
            }
        }
    }

    /// As JPEG.
    pub(super) fn jpeg(&self) -> image::ImageResult<Vec<u8>> {
        let pixels: Vec<u8> =
            self.values.iter().flat_map(|value| value.map(|v| v.round() as u8)).collect();
        let mut bytes = Vec::new();
        let [width, height] = self.size;
        JpegEncoder::new_with_quality(&mut bytes, QUALITY).encode(
            &pixels,
            width,
            height,
            ExtendedColorType::Rgb8,
        )?;
        Ok(bytes)
    }
}

/// Model pixels per pixel of the picture of a tile of a level.
pub(super) fn texel(level: u32) -> u32 {
    // No city has sides of 2^32 pixels, so that it fits.
    ((u64::from(super::super::surface::TILE) << level) / u64::from(MOST)).max(1) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coarse_pictures_are_means() {
        let child = Texture::of_colours(
            [3, 2],
            &[10, 0, 0, 20, 0, 0, 50, 0, 8, 30, 0, 0, 40, 4, 0, 70, 0, 9],
        );
        let mut parent = Texture::blank([4, 3]);
        parent.put(&child, [1, 1], 2);
        // Four pixels, and at the edge the two that there are.
        assert_eq!(parent.values[5], [25.0, 1.0, 0.0]);
        assert_eq!(parent.values[6], [60.0, 0.0, 8.5]);
        assert_eq!(parent.values.iter().filter(|value| value[0] > 0.0).count(), 2);
        let mut same = Texture::blank([3, 2]);
        same.put(&child, [0, 0], 1);
        assert_eq!(same, child);
    }

    #[test]
    fn no_picture_is_larger_than_the_limit() {
        assert_eq!([0, 1, 2, 3].map(texel), [1, 1, 2, 4]);
        assert!((0..20).all(|level| (256_u64 << level) / u64::from(texel(level)) <= 512));
    }

    #[test]
    fn a_jpeg_is_the_picture() {
        let colours: Vec<u8> = (0..64 * 48).flat_map(|_| [200, 100, 50]).collect();
        let bytes = Texture::of_colours([64, 48], &colours).jpeg().expect("encodes");
        let image = image::load_from_memory(&bytes).expect("decodes").to_rgb8();
        assert_eq!((image.width(), image.height()), (64, 48));
        for (found, expected) in image.get_pixel(30, 20).0.into_iter().zip([200_u8, 100, 50]) {
            assert!(found.abs_diff(expected) <= 2, "{found} {expected}");
        }
    }
}
