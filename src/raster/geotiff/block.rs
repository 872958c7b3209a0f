//! From samples to the bytes of one tile or strip: padding, predictor, compression.

use super::TiffCompression;
use crate::raster::deflate::{Compression, Samples, zlib};

/// A sample type that GeoTIFF files are written with.
pub trait Sample: Copy + Send + Sync + 'static {
    /// The type's name in a specification.
    const TYPE: SampleType;

    /// Appends the sample, little-endian.
    #[doc(hidden)]
    fn append_row(row: &[Self], out: &mut Vec<u8>);

    /// Appends a row of pixels of `bands` samples, each the difference to the pixel before, in the
    /// form that TIFF's predictor 2 (integers) or 3 (floats) has.
    #[doc(hidden)]
    fn append_differences(row: &[Self], bands: usize, out: &mut Vec<u8>);

    /// The sample that stands for no data.
    #[doc(hidden)]
    fn or_nodata(self, nodata: Option<f64>) -> Self;
}

/// Stored sample types.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SampleType {
    /// 32-bit floats.
    #[default]
    F32,
    /// Bytes.
    U8,
    /// Unsigned 16-bit integers.
    U16,
}

impl SampleType {
    pub(super) const fn bits(self) -> u16 {
        match self {
            Self::F32 => 32,
            Self::U8 => 8,
            Self::U16 => 16,
        }
    }

    /// TIFF's SampleFormat: 1 unsigned, 3 float.
    pub(super) const fn format(self) -> u16 {
        match self {
            Self::F32 => 3,
            Self::U8 | Self::U16 => 1,
        }
    }

    /// TIFF's Predictor that suits the type.
    pub(super) const fn predictor(self) -> u16 {
        match self {
            Self::F32 => 3,
            Self::U8 | Self::U16 => 2,
        }
    }
}

impl Sample for f32 {
    const TYPE: SampleType = SampleType::F32;

    fn append_row(row: &[Self], out: &mut Vec<u8>) {
        row.iter().for_each(|value| out.extend_from_slice(&value.to_le_bytes()));
    }

    fn append_differences(row: &[Self], bands: usize, out: &mut Vec<u8>) {
        // The bytes of the row are sorted by significance, highest first, then each byte becomes
        // its difference to the one `bands` before, across the borders of the four groups.
        let n = row.len();
        let start = out.len();
        out.resize(start + 4 * n, 0);
        let bytes = &mut out[start..];
        for (plane, shift) in [24, 16, 8, 0].into_iter().enumerate() {
            for (byte, value) in bytes[plane * n..(plane + 1) * n].iter_mut().zip(row) {
                *byte = (value.to_bits() >> shift) as u8;
            }
        }
        for i in (bands..4 * n).rev() {
            bytes[i] = bytes[i].wrapping_sub(bytes[i - bands]);
        }
    }

    fn or_nodata(self, nodata: Option<f64>) -> Self {
        match nodata {
            Some(value) if self.is_nan() => value as Self,
            _ => self,
        }
    }
}

macro_rules! integer_sample {
    ($type:ty, $variant:ident) => {
        impl Sample for $type {
            const TYPE: SampleType = SampleType::$variant;

            fn append_row(row: &[Self], out: &mut Vec<u8>) {
                row.iter().for_each(|value| out.extend_from_slice(&value.to_le_bytes()));
            }

            fn append_differences(row: &[Self], bands: usize, out: &mut Vec<u8>) {
                for (i, value) in row.iter().enumerate() {
                    let before = if i < bands { 0 } else { row[i - bands] };
                    out.extend_from_slice(&value.wrapping_sub(before).to_le_bytes());
                }
            }

            fn or_nodata(self, _: Option<f64>) -> Self {
                self
            }
        }
    };
}
integer_sample!(u8, U8);
integer_sample!(u16, U16);

/// Where a block lies in the rows at hand.
#[derive(Clone, Copy, Debug)]
pub(super) struct Window {
    /// First column, in pixels.
    pub column: usize,
    /// First row.
    pub row: usize,
    /// Width and height of the block, which may reach past the raster.
    pub width: usize,
    pub height: usize,
}

/// Encodes one block of `rows` (`raster_width` pixels of `bands` samples each). What lies beyond the
/// raster repeats its last column and row, which costs next to nothing after the predictor.
pub(super) fn encode<T: Sample>(
    rows: &[T],
    raster_width: usize,
    bands: usize,
    window: Window,
    nodata: Option<f64>,
    compression: TiffCompression,
) -> Vec<u8> {
    let line = raster_width * bands;
    let last_row = rows.len() / line - 1;
    let mut bytes =
        Vec::with_capacity(window.width * window.height * bands * usize::from(T::TYPE.bits()) / 8);
    let inside = window.width.min(raster_width - window.column);
    let mut row = Vec::with_capacity(window.width * bands);
    for y in window.row..window.row + window.height {
        let from = y.min(last_row) * line + window.column * bands;
        row.clear();
        row.extend(rows[from..from + inside * bands].iter().map(|v| v.or_nodata(nodata)));
        let last_pixel = row.len() - bands;
        for _ in inside..window.width {
            row.extend_from_within(last_pixel..last_pixel + bands);
        }
        match compression {
            TiffCompression::None => T::append_row(&row, &mut bytes),
            TiffCompression::Deflate => T::append_differences(&row, bands, &mut bytes),
        }
    }
    match compression {
        TiffCompression::None => bytes,
        TiffCompression::Deflate => zlib(&bytes, Samples::Bytes, Compression::Fast),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn predictors_follow_their_definitions() {
        let mut out = Vec::new();
        u16::append_differences(&[10, 300, 299], 1, &mut out);
        assert_eq!(out, [10, 0, 34, 1, 255, 255]);
        out.clear();
        u8::append_differences(&[1, 2, 3, 11, 1, 3], 3, &mut out);
        assert_eq!(out, [1, 2, 3, 10, 255, 0]);
        out.clear();
        // 1.0 is 3f 80 00 00 and -2.0 is c0 00 00 00.
        f32::append_differences(&[1.0, -2.0], 1, &mut out);
        assert_eq!(out, [0x3f, 0x81, 0xc0, 0x80, 0, 0, 0, 0]);
    }
}
