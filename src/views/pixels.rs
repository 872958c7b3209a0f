//! Rendered colours as bytes, pictures as PNG.

use super::ViewError;
use crate::model::Grid;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// An RGB picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue of each pixel, row by row.
    pub rgb: Vec<u8>,
}

/// How a channel in [0, 1] becomes a byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rounding {
    /// `floor(255 v + 1/2)`: the reference's satellite view (torchvision's `save_image`).
    Nearest,
    /// `floor(255 v)`: the reference's street views (`(255 * v).astype(uint8)`).
    Down,
}

impl Rounding {
    fn byte(self, value: f32) -> u8 {
        // In f32, as in the reference. A float becomes a byte by cutting off; NaN becomes 0.
        let scaled = value.clamp(0.0, 1.0) * 255.0;
        match self {
            Self::Nearest => (scaled + 0.5) as u8,
            Self::Down => scaled as u8,
        }
    }
}

impl Picture {
    /// From the first three channels of rendered colours, the upper left `size` of them.
    ///
    /// # Panics
    /// When there are fewer channels or pixels.
    #[must_use]
    pub fn from_colours(colours: &Grid, rounding: Rounding, [width, height]: [usize; 2]) -> Self {
        let channels = [0, 1, 2].map(|channel| colours.channel(channel));
        let mut rgb = Vec::with_capacity(3 * width * height);
        for row in 0..height {
            for column in 0..width {
                let pixel = row * colours.width + column;
                rgb.extend(channels.map(|values| rounding.byte(values[pixel])));
            }
        }
        Self { width, height, rgb }
    }

    /// Left and right changed over.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        let mut rgb = Vec::with_capacity(self.rgb.len());
        for row in self.rgb.chunks_exact(3 * self.width) {
            rgb.extend(row.as_chunks::<3>().0.iter().rev().flatten());
        }
        Self { rgb, ..*self }
    }

    /// Pictures of one height, side by side.
    ///
    /// # Panics
    /// When their heights differ.
    #[must_use]
    pub fn row(pictures: &[Self]) -> Self {
        let height = pictures.first().map_or(0, |picture| picture.height);
        assert!(pictures.iter().all(|p| p.height == height), "pictures of {height} rows");
        let width = pictures.iter().map(|picture| picture.width).sum();
        let mut rgb = Vec::with_capacity(3 * width * height);
        for row in 0..height {
            for picture in pictures {
                rgb.extend_from_slice(&picture.rgb[3 * row * picture.width..][..3 * picture.width]);
            }
        }
        Self { width, height, rgb }
    }

    /// As the bytes of a PNG.
    ///
    /// # Errors
    /// [`ViewError::Encode`] when the encoder refuses.
    pub fn png(&self) -> Result<Vec<u8>, ViewError> {
        let fail = |why: String| ViewError::Encode { what: "PNG", why };
        let side = |side: usize| u32::try_from(side).map_err(|error| fail(error.to_string()));
        let mut bytes = Vec::new();
        PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
            .write_image(&self.rgb, side(self.width)?, side(self.height)?, ExtendedColorType::Rgb8)
            .map_err(|error| fail(error.to_string()))?;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_of_numpy_and_torchvision() {
        // numpy: (np.float32(v) * 255).astype(np.uint8); torch: mul(255).add(0.5).clamp(0, 255).
        for (value, down, nearest) in [
            (0.0, 0, 0),
            (0.002, 0, 1),
            (0.5, 127, 128),
            (0.998, 254, 254),
            (0.9999, 254, 255),
            (1.0, 255, 255),
            (1.5, 255, 255),
            (-0.5, 0, 0),
            (f32::NAN, 0, 0),
        ] {
            assert_eq!(Rounding::Down.byte(value), down, "{value}");
            assert_eq!(Rounding::Nearest.byte(value), nearest, "{value}");
        }
        // Every byte survives the way to a float and back by the nearest.
        for byte in 0..=255_u8 {
            assert_eq!(Rounding::Nearest.byte(f32::from(byte) / 255.0), byte);
        }
    }

    #[test]
    fn pictures_are_mirrored_joined_and_cut() {
        let data: Vec<f32> = [0.0, 1.0, 0.2, 0.4, 0.6, 0.8].repeat(3);
        let grid = Grid::new(3, 2, 3, data);
        let whole = Picture::from_colours(&grid, Rounding::Nearest, [3, 2]);
        let grey = |p: &Picture| p.rgb.iter().step_by(3).copied().collect::<Vec<u8>>();
        assert_eq!(grey(&whole), [0, 255, 51, 102, 153, 204]);
        assert_eq!(grey(&whole.mirrored()), [51, 255, 0, 204, 153, 102]);
        let cut = Picture::from_colours(&grid, Rounding::Nearest, [1, 2]);
        let row = Picture::row(&[cut.clone(), whole.clone()]);
        assert_eq!((row.width, row.height), (4, 2));
        assert_eq!(grey(&row), [0, 0, 255, 51, 102, 102, 153, 204]);
        let png = image::load_from_memory(&row.png().expect("encodes")).expect("a PNG");
        assert_eq!(png.to_rgb8().into_raw(), row.rgb);
    }
}
