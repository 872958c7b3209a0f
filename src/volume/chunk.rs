//! One chunk as bytes: little-endian floats, gzip around them.

use crate::raster::deflate::{Compression, Samples, deflate, inflate};

/// gzip's header (RFC 1952): no name, no time, an operating system that nobody knows, so that the same
/// values give the same bytes everywhere.
const HEADER: [u8; 10] = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255];

/// The bytes of a chunk's file.
pub(super) fn encode(values: &[f32], compression: Compression) -> Vec<u8> {
    let mut raw = Vec::with_capacity(values.len() * 4);
    for value in values {
        raw.extend_from_slice(&value.to_le_bytes());
    }
    if compression == Compression::Stored {
        return raw;
    }
    let mut bytes = HEADER.to_vec();
    bytes.extend_from_slice(&deflate(&raw, Samples::Words32, compression));
    bytes.extend_from_slice(&crc32fast::hash(&raw).to_le_bytes());
    bytes.extend_from_slice(&(raw.len() as u32).to_le_bytes());
    bytes
}

/// The values of a chunk's file, of which there must be `count`.
pub(super) fn decode(
    bytes: &[u8],
    count: usize,
    compression: Compression,
) -> Result<Vec<f32>, String> {
    let raw = if compression == Compression::Stored {
        bytes.to_vec()
    } else {
        let body = bytes.strip_prefix(&HEADER).ok_or("its header is none of ours")?;
        let (body, tail) = body.split_last_chunk::<8>().ok_or("it is cut short")?;
        let raw = inflate(body, count * 4).map_err(|error| error.to_string())?;
        if crc32fast::hash(&raw).to_le_bytes() != tail[..4] {
            return Err("its check sum does not fit".to_owned());
        }
        raw
    };
    if raw.len() != count * 4 {
        return Err(format!("it holds {} bytes, not {}", raw.len(), count * 4));
    }
    Ok(raw.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
}
