//! PNG row by row.

use super::source::RowSource;
use png::{ColorType, Decoder, DecodingError, Limits, Reader, Transformations};
use std::fs::File;
use std::io::BufReader;

/// A PNG picture, read from the top; an interlaced one is held as a whole.
pub(super) struct PngRows {
    reader: Reader<BufReader<File>>,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Whether its rows do not come in order.
    pub(super) interlaced: bool,
    samples: usize,
    deep: bool,
    row: Vec<u8>,
    next_row: usize,
    /// All pixels of an interlaced picture, as they are stored.
    whole: Vec<u8>,
}

impl PngRows {
    /// Reads everything up to the pixels. `memory_limit` is what a picture may take that has to be held as
    /// a whole.
    pub(super) fn open(file: File, memory_limit: u64) -> Result<Self, String> {
        // A row and what is around it; the decoder holds no more than that.
        let limits = Limits { bytes: usize::try_from(memory_limit).unwrap_or(usize::MAX) };
        let mut decoder = Decoder::new_with_limits(BufReader::new(file), limits);
        // Palettes and fewer bits than 8 become bytes; 16 bits are rounded below.
        decoder.set_transformations(Transformations::EXPAND);
        decoder.set_ignore_text_chunk(true);
        decoder.set_ignore_iccp_chunk(true);
        let reader = decoder.read_info().map_err(|error| explain(&error))?;
        let info = reader.info();
        let (width, height, interlaced) = (info.width, info.height, info.interlaced);
        let (colour, depth) = reader.output_color_type();
        let samples = match colour {
            ColorType::Grayscale | ColorType::Indexed => 1,
            ColorType::GrayscaleAlpha => 2,
            ColorType::Rgb => 3,
            ColorType::Rgba => 4,
        };
        let deep = depth == png::BitDepth::Sixteen;
        let bytes =
            u64::from(width) * u64::from(height) * samples as u64 * if deep { 2 } else { 1 };
        if interlaced && bytes > memory_limit {
            return Err(format!(
                "is an interlaced PNG of {width} x {height} pixels, whose rows do not come in order: it takes \
                 {bytes} bytes to read, and {memory_limit} are allowed; write it without interlacing \
                 (gdal_translate -of PNG in.png out.png)"
            ));
        }
        let line = reader.output_line_size(width).ok_or("has rows that are too long")?;
        Ok(Self {
            reader,
            width,
            height,
            interlaced,
            samples,
            deep,
            row: vec![0; line],
            next_row: 0,
            whole: Vec::new(),
        })
    }
}

impl RowSource for PngRows {
    fn next_row(&mut self, out: &mut [u8], valid: Option<&mut [u8]>) -> Result<(), String> {
        let row = if self.interlaced {
            if self.whole.is_empty() {
                let size = self.reader.output_buffer_size().ok_or("is too large")?;
                let mut whole = vec![0; size];
                self.reader.next_frame(&mut whole).map_err(|error| explain(&error))?;
                self.whole = whole;
            }
            let line = self.row.len();
            self.whole.get(self.next_row * line..).and_then(|rest| rest.get(..line))
        } else {
            let found = self.reader.read_row(&mut self.row).map_err(|error| explain(&error))?;
            if self.next_row + 1 == self.height as usize {
                // Only what follows the last row says whether the check sums are right.
                self.reader.read_row(&mut []).map_err(|error| explain(&error))?;
            }
            found.map(|_| &self.row[..])
        };
        let row = row.ok_or("has no more rows")?;
        self.next_row += 1;
        if self.deep {
            let row = row.as_chunks::<2>().0;
            convert(row, self.samples, |v| round(u16::from_be_bytes(v)), out);
            mark(row, self.samples, [0; 2], valid);
        } else {
            convert(row, self.samples, |value| value, out);
            mark(row, self.samples, 0, valid);
        }
        Ok(())
    }

    fn has_mask(&self) -> bool {
        // Transparent colours and palettes have become alpha as well.
        has_alpha(self.samples)
    }

    fn rewind(&mut self) -> bool {
        if self.whole.is_empty() {
            return false;
        }
        self.next_row = 0;
        true
    }
}

/// Pixels of shades or colours, with alpha or without, to RGB; alpha is dropped.
fn convert<T: Copy>(row: &[T], samples: usize, byte: impl Fn(T) -> u8, out: &mut [u8]) {
    for (pixel, from) in out.chunks_exact_mut(3).zip(row.chunks_exact(samples)) {
        match *from {
            [shade] | [shade, _] => pixel.fill(byte(shade)),
            [red, green, blue, ..] => {
                pixel.copy_from_slice(&[byte(red), byte(green), byte(blue)]);
            }
            [] => {}
        }
    }
}

fn has_alpha(samples: usize) -> bool {
    matches!(samples, 2 | 4)
}

/// Marks the pixels whose alpha, the last sample, is not zero.
fn mark<T: PartialEq>(row: &[T], samples: usize, zero: T, valid: Option<&mut [u8]>) {
    if let Some(valid) = valid.filter(|_| has_alpha(samples)) {
        for (valid, pixel) in valid.iter_mut().zip(row.chunks_exact(samples)) {
            *valid = if pixel.last() == Some(&zero) { 0 } else { 255 };
        }
    }
}

/// 16 bits to 8: value / 257, rounded (65535 is 255).
fn round(value: u16) -> u8 {
    ((u32::from(value) + 128) / 257) as u8
}

/// What a PNG error means to the user.
fn explain(error: &DecodingError) -> String {
    match error {
        DecodingError::IoError(source) if source.kind() == std::io::ErrorKind::UnexpectedEof => {
            "the file ends early: it is truncated; copy it again".to_owned()
        }
        DecodingError::IoError(source) => source.to_string(),
        DecodingError::LimitsExceeded => {
            "its rows take more memory than is allowed; the size in its header may be damaged"
                .to_owned()
        }
        other => format!("the PNG is damaged or not understood: {other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bits_are_rounded_to_the_nearest_of_256_shades() {
        for value in 0..=u16::MAX {
            let exact = f64::from(value) / 257.0;
            assert!((f64::from(round(value)) - exact).abs() <= 0.5, "{value}");
        }
    }
}
