//! DEFLATE (RFC 1951) for grids of heights: as small as zlib makes them, in a fraction of the time.
//!
//! A DSM of 640 x 640 `f32` samples takes zlib (level 6, what numpy writes) about 100 ms and this
//! encoder about 4 ms, at the same size; `docs/formats.md` has the table. Every byte that is written
//! depends on the data alone, never on the processor or on threads.

mod bits;
mod bytes;
mod huffman;
mod words;

use bits::BitWriter;
use huffman::{BlockPlan, Codes, END_OF_BLOCK};
use serde::{Deserialize, Serialize};

/// How hard to compress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Compression {
    /// Not at all.
    Stored,
    /// The encoder of this module.
    #[default]
    Fast,
    /// A general encoder that searches long: for archives, about 20 times slower and a few per cent
    /// smaller.
    Small,
}

/// What the bytes are; decides where matches are looked for, never what is decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// Little-endian 32-bit samples, aligned to the start of the data.
    Words32,
    /// Anything else.
    Bytes,
}

/// Why compressed data cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InflateError {
    /// Not a DEFLATE stream, or damaged.
    #[error("the compressed data is damaged")]
    Damaged,
    /// The stream stops before its end.
    #[error("the compressed data ends early, after {found} bytes of output")]
    Truncated {
        /// Bytes that could be decoded.
        found: usize,
    },
    /// More comes out than stated.
    #[error("the compressed data holds more than the {expected} bytes stated")]
    TooLong {
        /// Bytes that the container states.
        expected: usize,
    },
    /// Less comes out than stated.
    #[error("the compressed data holds {found} bytes, {expected} are stated")]
    TooShort {
        /// Bytes that came out.
        found: usize,
        /// Bytes that the container states.
        expected: usize,
    },
}

/// Compresses `data` to a raw DEFLATE stream.
#[must_use]
pub fn deflate(data: &[u8], samples: Samples, compression: Compression) -> Vec<u8> {
    let mut out = BitWriter::with_capacity(data.len() / 8 * 7 + 64);
    match compression {
        Compression::Stored => write_stored(&mut out, data, true),
        _ if data.is_empty() => write_stored(&mut out, data, true),
        Compression::Small => return small(data),
        Compression::Fast => match samples {
            Samples::Bytes => bytes::deflate(data, true, &mut out),
            Samples::Words32 => {
                let (words, rest) = data.split_at(data.len() & !3);
                words::deflate(words, rest.is_empty(), &mut out);
                if !rest.is_empty() {
                    bytes::deflate(rest, true, &mut out);
                }
            }
        },
    }
    out.finish()
}

/// Compresses `data` to a zlib stream (RFC 1950), as TIFF and PNG want it.
#[must_use]
pub fn zlib(data: &[u8], samples: Samples, compression: Compression) -> Vec<u8> {
    // 32 KB window; the level is a hint only, the last five bits make it a multiple of 31.
    let mut out = vec![0x78, 0x9c];
    out.extend_from_slice(&deflate(data, samples, compression));
    out.extend_from_slice(&adler32(data).to_be_bytes());
    out
}

/// Decodes a raw DEFLATE stream that holds exactly `expected` bytes.
///
/// # Errors
/// [`InflateError`]; memory beyond what is decoded is never taken, so a false `expected` costs
/// nothing.
pub fn inflate(data: &[u8], expected: usize) -> Result<Vec<u8>, InflateError> {
    let mut inflater = zlib_rs::Inflate::new(false, 15);
    // DEFLATE expands at most 1032-fold; a damaged size must not take the machine's memory.
    let most = data.len().saturating_mul(1032).min(expected);
    let mut out = vec![0; most + 1];
    let (mut read, mut written) = (0, 0);
    loop {
        let before = (read, written);
        let status = inflater
            .decompress(&data[read..], &mut out[written..], zlib_rs::InflateFlush::NoFlush)
            .map_err(|_| InflateError::Damaged)?;
        read = inflater.total_in() as usize;
        written = inflater.total_out() as usize;
        if written > most && written > expected {
            return Err(InflateError::TooLong { expected });
        }
        match status {
            zlib_rs::Status::StreamEnd => break,
            _ if (read, written) == before => {
                return Err(InflateError::Truncated { found: written });
            }
            _ => {}
        }
    }
    if written < expected {
        return Err(InflateError::TooShort { found: written, expected });
    }
    out.truncate(written);
    Ok(out)
}

/// The first `count` bytes of a raw DEFLATE stream, or as many as its beginning `data` gives.
#[must_use]
pub fn inflate_beginning(data: &[u8], count: usize) -> Vec<u8> {
    let mut inflater = zlib_rs::Inflate::new(false, 15);
    let mut out = vec![0; count];
    // What was decoded before an error is good.
    let _ = inflater.decompress(data, &mut out, zlib_rs::InflateFlush::NoFlush);
    out.truncate(inflater.total_out() as usize);
    out
}

/// Adler-32 (RFC 1950).
#[must_use]
pub fn adler32(data: &[u8]) -> u32 {
    const MODULUS: u32 = 65_521;
    let (mut a, mut b) = (1_u32, 0_u32);
    // 5552 bytes are the most for which `b` cannot overflow.
    for chunk in data.chunks(5552) {
        let (blocks, rest) = chunk.as_chunks::<32>();
        for block in blocks {
            // b gains 32 times the old a, and each byte as often as it is summed.
            b += 32 * a;
            let (mut plain, mut weighted) = (0_u32, 0_u32);
            for (i, &byte) in block.iter().enumerate() {
                plain += u32::from(byte);
                weighted += u32::from(byte) * (32 - i as u32);
            }
            a += plain;
            b += weighted;
        }
        for &byte in rest {
            a += u32::from(byte);
            b += a;
        }
        a %= MODULUS;
        b %= MODULUS;
    }
    b << 16 | a
}

fn small(data: &[u8]) -> Vec<u8> {
    let level = zlib_rs::DeflateConfig { level: 9, window_bits: -15, ..Default::default() };
    let mut out = vec![0; zlib_rs::compress_bound(data.len()) + 64];
    let (written, _) = zlib_rs::compress_slice(&mut out, data, level);
    let len = written.len();
    out.truncate(len);
    out
}

/// Writes one block as planned; `body` writes its symbols but the end of the block.
fn write_block(
    out: &mut BitWriter,
    plan: &BlockPlan,
    raw: &[u8],
    last: bool,
    body: impl FnOnce(&Codes, &mut BitWriter),
) {
    let codes = match plan {
        BlockPlan::Stored => return write_stored(out, raw, last),
        BlockPlan::Fixed { codes, bits } => {
            out.reserve_bits(*bits);
            out.put(u64::from(last) | 1 << 1, 3);
            codes
        }
        BlockPlan::Dynamic { codes, header, bits } => {
            out.reserve_bits(*bits);
            out.put(u64::from(last) | 2 << 1, 3);
            header.write(out);
            codes
        }
    };
    body(codes, out);
    let end = codes.litlen[END_OF_BLOCK];
    out.put(u64::from(end.bits), u32::from(end.len));
}

fn write_stored(out: &mut BitWriter, raw: &[u8], last: bool) {
    let mut rest = raw;
    loop {
        let (piece, after) = rest.split_at(rest.len().min(65_535));
        out.reserve_bits(64);
        out.put(u64::from(last && after.is_empty()), 3);
        out.align();
        let len = piece.len() as u16;
        out.put_bytes(&len.to_le_bytes());
        out.put_bytes(&(!len).to_le_bytes());
        out.put_bytes(piece);
        rest = after;
        if rest.is_empty() {
            break;
        }
    }
}

#[cfg(test)]
mod tests;
