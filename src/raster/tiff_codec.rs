//! From the bytes of one strip or tile to samples in the machine's byte order.
//!
//! The `tiff` crate decodes chunks too, but it inverts min-is-white images, compacts extra samples
//! before it undoes the predictor, fails on sparse chunks, and reads zstd through C; so the steps
//! are put together here from one crate per compression.

use super::header::Rectangle;
use super::tiff_directory::TiffImage;
use ruzstd::decoding::{FrameDecoder, StreamingDecoder};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use weezl::BitOrder;
use zlib_rs::{Inflate, InflateFlush, Status};

/// Whether this build decodes what the image holds; otherwise what it cannot decode, in words.
pub(super) fn check_supported(image: &TiffImage) -> Result<(), String> {
    let compression = image.compression_name();
    if !matches!(image.compression, 1 | 5 | 8 | 32_773 | 32_946 | 50_000) {
        return Err(format!("compression `{compression}`"));
    }
    match (image.predictor, has_predictor(image), image.format, image.bits) {
        (_, false, ..) | (1, ..) | (2, _, _, 8 | 16 | 32 | 64) | (3, _, 3, 32 | 64) => {}
        (predictor, ..) => {
            return Err(format!(
                "predictor {predictor} on {}-bit samples of format {}",
                image.bits, image.format
            ));
        }
    }
    if image.fill_order == 2 {
        return Err("bits stored in reverse (FillOrder 2)".to_owned());
    }
    Ok(())
}

/// The other codecs have no predictor, whatever the tag says.
fn has_predictor(image: &TiffImage) -> bool {
    matches!(image.compression, 5 | 8 | 32_946 | 50_000)
}

/// A run of pixels in one row of a rectangle.
pub(super) struct Run<'a> {
    /// First column and row within the rectangle.
    pub(super) x: usize,
    pub(super) y: usize,
    /// Number of pixels.
    pub(super) width: usize,
    /// The row of the strip or tile, in the machine's byte order; `None` where it was never written.
    pub(super) row: Option<&'a [u8]>,
    /// Where the run begins in that row: the sample of the first pixel ...
    pub(super) first: usize,
    /// ... and samples from pixel to pixel.
    pub(super) stride: usize,
}

/// Reads one band of an image, strip by strip or tile by tile.
#[derive(Debug)]
pub(super) struct BandReader {
    pub(super) image: TiffImage,
    band: usize,
    decoder: ChunkDecoder,
    compressed: Vec<u8>,
    /// The chunk that was decoded last, which a mask in other strips than its image needs again.
    decoded: Option<usize>,
    bytes: Vec<u8>,
}

impl BandReader {
    /// `band` counts from 0.
    pub(super) fn new(image: TiffImage, band: usize) -> Self {
        Self {
            image,
            band,
            decoder: ChunkDecoder::new(),
            compressed: Vec::new(),
            decoded: None,
            bytes: Vec::new(),
        }
    }

    /// The band, counted from 0.
    pub(super) const fn band(&self) -> usize {
        self.band
    }

    /// Hands the rectangle's pixels to `sink`, run by run, each exactly once.
    pub(super) fn read(
        &mut self,
        file: &mut File,
        file_size: u64,
        rectangle: Rectangle,
        mut sink: impl FnMut(Run<'_>),
    ) -> Result<(), String> {
        let (width, height) = (self.image.chunk_width as usize, self.image.chunk_height as usize);
        let (right, bottom) = (rectangle.x + rectangle.width, rectangle.y + rectangle.height);
        for chunk_y in rectangle.y / height..bottom.div_ceil(height) {
            for chunk_x in rectangle.x / width..right.div_ceil(width) {
                let written = self.load(file, file_size, chunk_x, chunk_y)?;
                let (left, top) = (chunk_x * width, chunk_y * height);
                let (x0, x1) = (left.max(rectangle.x), (left + width).min(right));
                let (y0, y1) = (top.max(rectangle.y), (top + height).min(bottom));
                let row_bytes = self.bytes.len() / self.rows(chunk_y);
                let stride = self.image.chunk_samples();
                let band = if self.image.planar { 0 } else { self.band };
                for y in y0..y1 {
                    let start = (y - top) * row_bytes;
                    sink(Run {
                        x: x0 - rectangle.x,
                        y: y - rectangle.y,
                        width: x1 - x0,
                        row: written.then(|| &self.bytes[start..start + row_bytes]),
                        first: (x0 - left) * stride + band,
                        stride,
                    });
                }
            }
        }
        Ok(())
    }

    /// Rows of a chunk that lie inside the image.
    fn rows(&self, chunk_y: usize) -> usize {
        let height = self.image.chunk_height as usize;
        (self.image.height as usize - chunk_y * height).min(height)
    }

    /// Decodes a chunk, unless it is decoded already; `false` where it was never written.
    fn load(
        &mut self,
        file: &mut File,
        file_size: u64,
        chunk_x: usize,
        chunk_y: usize,
    ) -> Result<bool, String> {
        let plane = if self.image.planar { self.band * self.image.chunks_per_band() } else { 0 };
        let index = plane + chunk_y * self.image.chunks_across() + chunk_x;
        if self.decoded == Some(index) {
            return Ok(true);
        }
        let (offset, count) = (self.image.offsets[index], self.image.counts[index]);
        if count == 0 {
            return Ok(false);
        }
        if offset.saturating_add(count) > file_size {
            return Err(format!(
                "its data (bytes {offset} to {}) lie beyond the file's end at {file_size}: the \
                 file is truncated; copy it again",
                offset.saturating_add(count)
            ));
        }
        self.decoded = None;
        self.compressed.resize(count as usize, 0);
        file.seek(SeekFrom::Start(offset))
            .and_then(|_| file.read_exact(&mut self.compressed))
            .map_err(|e| e.to_string())?;
        let rows = self.rows(chunk_y);
        self.decoder.decode(&self.image, &self.compressed, rows, &mut self.bytes)?;
        self.decoded = Some(index);
        Ok(true)
    }
}

/// Decoder states and buffers that are kept from chunk to chunk.
struct ChunkDecoder {
    inflate: Inflate,
    zstd: FrameDecoder,
    row: Vec<u8>,
}

impl std::fmt::Debug for ChunkDecoder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ChunkDecoder").finish_non_exhaustive()
    }
}

impl ChunkDecoder {
    fn new() -> Self {
        Self { inflate: Inflate::new(true, 15), zstd: FrameDecoder::new(), row: Vec::new() }
    }

    /// Decodes the first `rows` rows of a chunk into `out`, in the machine's byte order.
    fn decode(
        &mut self,
        image: &TiffImage,
        compressed: &[u8],
        rows: usize,
        out: &mut Vec<u8>,
    ) -> Result<(), String> {
        let row_bytes = usize::try_from(image.row_bytes()).map_err(|e| e.to_string())?;
        let wanted = row_bytes.checked_mul(rows).ok_or("the block is too large")?;
        out.clear();
        out.resize(wanted, 0);
        let got = self.decompress(image.compression, compressed, out)?;
        if got < wanted {
            return Err(format!("its data end after {got} of {wanted} bytes: the file is damaged"));
        }
        let bytes = usize::from(image.bits / 8);
        let swap = bytes > 1 && image.big_endian != cfg!(target_endian = "big");
        let predictor = if has_predictor(image) { image.predictor } else { 1 };
        let samples = image.chunk_samples();
        for row in out.chunks_exact_mut(row_bytes.max(1)) {
            match predictor {
                3 => undo_float_predictor(row, &mut self.row, samples, bytes),
                2 => {
                    if swap {
                        swap_bytes(row, bytes);
                    }
                    undo_horizontal_predictor(row, samples, bytes);
                }
                _ if swap => swap_bytes(row, bytes),
                _ => {}
            }
        }
        Ok(())
    }

    /// Fills `out` and returns how many bytes there were; more than that are left alone (a last
    /// strip may be stored whole).
    fn decompress(
        &mut self,
        compression: u16,
        compressed: &[u8],
        out: &mut [u8],
    ) -> Result<usize, String> {
        match compression {
            1 => {
                let length = compressed.len().min(out.len());
                out[..length].copy_from_slice(&compressed[..length]);
                Ok(length)
            }
            5 => unpack_lzw(compressed, out),
            8 | 32_946 => self.inflate(compressed, out),
            32_773 => Ok(unpack_bits(compressed, out)),
            50_000 => self.unpack_zstd(compressed, out),
            other => Err(format!("compression {other} is not supported")),
        }
    }

    fn inflate(&mut self, compressed: &[u8], out: &mut [u8]) -> Result<usize, String> {
        self.inflate.reset(true);
        let (mut read, mut written) = (0, 0);
        while written < out.len() {
            let (consumed, produced) = (self.inflate.total_in(), self.inflate.total_out());
            let status = self
                .inflate
                .decompress(&compressed[read..], &mut out[written..], InflateFlush::NoFlush)
                .map_err(|e| format!("its deflate data are damaged ({})", e.as_str()))?;
            let consumed = (self.inflate.total_in() - consumed) as usize;
            let produced = (self.inflate.total_out() - produced) as usize;
            (read, written) = (read + consumed, written + produced);
            if status == Status::StreamEnd || (consumed == 0 && produced == 0) {
                return Ok(written);
            }
        }
        // With the output full, the stream's check sum is still to be read and compared.
        self.inflate
            .decompress(&compressed[read..], &mut [], InflateFlush::NoFlush)
            .map_err(|e| format!("its deflate data are damaged ({})", e.as_str()))?;
        Ok(written)
    }

    fn unpack_zstd(&mut self, compressed: &[u8], out: &mut [u8]) -> Result<usize, String> {
        let damaged = |e: &dyn std::fmt::Display| format!("its zstd data are damaged ({e})");
        let mut stream = StreamingDecoder::new_with_decoder(compressed, &mut self.zstd)
            .map_err(|e| damaged(&e))?;
        let mut written = 0;
        while written < out.len() {
            match stream.read(&mut out[written..]).map_err(|e| damaged(&e))? {
                0 => break,
                n => written += n,
            }
        }
        Ok(written)
    }
}

/// TIFF's LZW: most significant bit first, codes grow one entry early.
fn unpack_lzw(compressed: &[u8], out: &mut [u8]) -> Result<usize, String> {
    let mut decoder = weezl::decode::Decoder::with_tiff_size_switch(BitOrder::Msb, 8);
    let (mut read, mut written) = (0, 0);
    while written < out.len() {
        let step = decoder.decode_bytes(&compressed[read..], &mut out[written..]);
        read += step.consumed_in;
        written += step.consumed_out;
        match step.status {
            Ok(weezl::LzwStatus::Ok) => {}
            Ok(_) => break,
            Err(e) => return Err(format!("its LZW data are damaged ({e})")),
        }
    }
    Ok(written)
}

/// PackBits: a count byte, then that many literal bytes, or one byte to repeat.
fn unpack_bits(compressed: &[u8], out: &mut [u8]) -> usize {
    let (mut input, mut written) = (compressed, 0);
    while written < out.len()
        && let Some((&count, rest)) = input.split_first()
    {
        input = rest;
        let free = out.len() - written;
        if count < 128 {
            let length = (usize::from(count) + 1).min(rest.len());
            let take = length.min(free);
            out[written..written + take].copy_from_slice(&rest[..take]);
            input = &rest[length..];
            written += take;
        } else if count > 128
            && let Some((&value, rest)) = rest.split_first()
        {
            let take = (257 - usize::from(count)).min(free);
            out[written..written + take].fill(value);
            input = rest;
            written += take;
        }
    }
    written
}

fn swap_bytes(row: &mut [u8], bytes: usize) {
    match bytes {
        2 => row.as_chunks_mut::<2>().0.iter_mut().for_each(|s| s.reverse()),
        4 => row.as_chunks_mut::<4>().0.iter_mut().for_each(|s| s.reverse()),
        8 => row.as_chunks_mut::<8>().0.iter_mut().for_each(|s| s.reverse()),
        _ => {}
    }
}

/// Predictor 2: each sample is stored as its difference, as an integer, from the one before it in
/// the same band.
fn undo_horizontal_predictor(row: &mut [u8], samples: usize, bytes: usize) {
    macro_rules! accumulate {
        ($int:ty, $n:literal) => {{
            let row = row.as_chunks_mut::<$n>().0;
            if samples == 1 {
                let mut sum: $int = 0;
                for sample in row {
                    sum = sum.wrapping_add(<$int>::from_ne_bytes(*sample));
                    *sample = sum.to_ne_bytes();
                }
            } else {
                for i in samples..row.len() {
                    let before = <$int>::from_ne_bytes(row[i - samples]);
                    let sum = before.wrapping_add(<$int>::from_ne_bytes(row[i]));
                    row[i] = sum.to_ne_bytes();
                }
            }
        }};
    }
    match bytes {
        1 => accumulate!(u8, 1),
        2 => accumulate!(u16, 2),
        4 => accumulate!(u32, 4),
        8 => accumulate!(u64, 8),
        _ => {}
    }
}

/// Predictor 3: the bytes of a row are stored most significant first, all first bytes together,
/// then all second ones, each as its difference from the byte `samples` before it.
fn undo_float_predictor(row: &mut [u8], planes: &mut Vec<u8>, samples: usize, bytes: usize) {
    planes.clear();
    planes.extend_from_slice(row);
    if samples == 1 {
        let mut sum = 0_u8;
        for byte in planes.iter_mut() {
            sum = sum.wrapping_add(*byte);
            *byte = sum;
        }
    } else {
        for i in samples..planes.len() {
            planes[i] = planes[i].wrapping_add(planes[i - samples]);
        }
    }
    let count = planes.len() / bytes.max(1);
    match bytes {
        4 => {
            let (a, rest) = planes.split_at(count);
            let (b, rest) = rest.split_at(count);
            let (c, d) = rest.split_at(count);
            let planes = a.iter().zip(b).zip(c).zip(d);
            for (sample, (((a, b), c), d)) in row.as_chunks_mut::<4>().0.iter_mut().zip(planes) {
                *sample = u32::from_be_bytes([*a, *b, *c, *d]).to_ne_bytes();
            }
        }
        8 => {
            for (i, sample) in row.as_chunks_mut::<8>().0.iter_mut().enumerate() {
                let big_endian = std::array::from_fn(|plane| planes[plane * count + i]);
                *sample = u64::from_be_bytes(big_endian).to_ne_bytes();
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn pack_bits_follow_the_specification() {
        // The example of TIFF 6.0, section 9.
        let packed = [
            0xFE, 0xAA, 0x02, 0x80, 0x00, 0x2A, 0xFD, 0xAA, 0x03, 0x80, 0x00, 0x2A, 0x22, 0xF7,
            0xAA,
        ];
        let unpacked = [
            0xAA, 0xAA, 0xAA, 0x80, 0x00, 0x2A, 0xAA, 0xAA, 0xAA, 0xAA, 0x80, 0x00, 0x2A, 0x22,
            0xAA, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA,
        ];
        let mut out = [0; 24];
        assert_eq!(unpack_bits(&packed, &mut out), 24);
        assert_eq!(out, unpacked);
        // 128 does nothing; data may end anywhere; output may be shorter than a run.
        assert_eq!(unpack_bits(&[128, 0, 7, 0xFE], &mut out), 1);
        assert_eq!(unpack_bits(&[5, 1, 2], &mut out), 2);
        assert_eq!(unpack_bits(&[0x81, 9], &mut out[..3]), 3);
    }

    /// The plain statement of predictor 3, byte by byte (Adobe's Technical Note 3).
    fn float_predictor(samples: &[f32], per_pixel: usize) -> Vec<u8> {
        let mut planes = vec![0; samples.len() * 4];
        for (i, sample) in samples.iter().enumerate() {
            for (plane, byte) in sample.to_be_bytes().into_iter().enumerate() {
                planes[plane * samples.len() + i] = byte;
            }
        }
        for i in (per_pixel..planes.len()).rev() {
            planes[i] = planes[i].wrapping_sub(planes[i - per_pixel]);
        }
        planes
    }

    proptest! {
        #[test]
        fn predictors_are_undone(
            bits in proptest::collection::vec(any::<u32>(), 1..40),
            per_pixel in 1usize..4,
        ) {
            let samples: Vec<f32> = bits.iter().map(|b| f32::from_bits(*b)).collect();
            let plain: Vec<u8> = bits.iter().flat_map(|b| b.to_ne_bytes()).collect();

            let mut row = float_predictor(&samples, per_pixel);
            undo_float_predictor(&mut row, &mut Vec::new(), per_pixel, 4);
            prop_assert_eq!(&row, &plain);

            let mut differences = bits.clone();
            for i in (per_pixel..bits.len()).rev() {
                differences[i] = bits[i].wrapping_sub(bits[i - per_pixel]);
            }
            let mut row: Vec<u8> = differences.iter().flat_map(|b| b.to_ne_bytes()).collect();
            undo_horizontal_predictor(&mut row, per_pixel, 4);
            prop_assert_eq!(&row, &plain);
        }

        #[test]
        fn damaged_data_give_an_error_or_bytes_but_never_a_panic(
            data in proptest::collection::vec(any::<u8>(), 0..300),
            compression in proptest::sample::select(vec![1_u16, 5, 8, 32_773, 50_000]),
        ) {
            let image = TiffImage {
                width: 16, height: 16, samples: 1, bits: 32, format: 3, compression,
                predictor: 3, chunk_width: 16, chunk_height: 16, ..TiffImage::default()
            };
            let mut out = Vec::new();
            match ChunkDecoder::new().decode(&image, &data, 16, &mut out) {
                Ok(()) => prop_assert_eq!(out.len(), 1024),
                Err(reason) => prop_assert!(reason.contains("damaged"), "{}", reason),
            }
        }
    }
}
