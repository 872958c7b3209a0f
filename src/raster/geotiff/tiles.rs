//! Cutting rows of a raster into strips or tiles, compressed in parallel and kept in order.

use super::predictor::Compression;
use super::tags::{self, Directory, Value};
use rayon::prelude::*;

/// How a raster is cut: strips are as wide as the raster, tiles have a fixed size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Cut {
    /// Size of the raster, pixels.
    pub(super) width: u32,
    pub(super) height: u32,
    /// Size of a strip or tile, pixels.
    pub(super) chunk_width: u32,
    pub(super) chunk_height: u32,
    pub(super) tiled: bool,
}

impl Cut {
    pub(super) const fn chunks_across(&self) -> usize {
        self.width.div_ceil(self.chunk_width) as usize
    }

    /// Strips or tiles of the raster.
    pub(super) const fn chunks(&self) -> usize {
        self.chunks_across() * self.height.div_ceil(self.chunk_height) as usize
    }

    /// Bytes of the raster's samples as stored without compression, padding included.
    pub(super) fn raw_bytes(&self) -> u64 {
        let rows = if self.tiled {
            u64::from(self.height.div_ceil(self.chunk_height)) * u64::from(self.chunk_height)
        } else {
            u64::from(self.height)
        };
        self.chunks_across() as u64 * u64::from(self.chunk_width) * rows * 4
    }

    /// What every directory says about size, samples and layout; `places` are the offsets and byte
    /// counts of the strips or tiles.
    pub(super) fn set_layout(
        &self,
        directory: &mut Directory,
        compression: Compression,
        places: &Places,
    ) {
        let short = |value| Value::Short(vec![value]);
        directory.set(tags::IMAGE_WIDTH, Value::Long(vec![self.width]));
        directory.set(tags::IMAGE_LENGTH, Value::Long(vec![self.height]));
        directory.set(tags::BITS_PER_SAMPLE, short(32));
        directory.set(tags::COMPRESSION, short(compression.code()));
        // The smallest value is black.
        directory.set(tags::PHOTOMETRIC, short(1));
        directory.set(tags::SAMPLES_PER_PIXEL, short(1));
        directory.set(tags::PLANAR_CONFIGURATION, short(1));
        if compression == Compression::Deflate {
            directory.set(tags::PREDICTOR, short(3));
        }
        // Floating point.
        directory.set(tags::SAMPLE_FORMAT, short(3));
        let (offsets, counts) =
            (Value::Offsets(places.offsets.clone()), Value::Long(places.counts.clone()));
        if self.tiled {
            directory.set(tags::TILE_WIDTH, Value::Long(vec![self.chunk_width]));
            directory.set(tags::TILE_LENGTH, Value::Long(vec![self.chunk_height]));
            directory.set(tags::TILE_OFFSETS, offsets);
            directory.set(tags::TILE_BYTE_COUNTS, counts);
        } else {
            directory.set(tags::ROWS_PER_STRIP, Value::Long(vec![self.chunk_height]));
            directory.set(tags::STRIP_OFFSETS, offsets);
            directory.set(tags::STRIP_BYTE_COUNTS, counts);
        }
    }

    /// Compresses whole rows of the raster that begin with a row of strips or tiles: the stored bytes
    /// of each, in the file's order.
    pub(super) fn compress(&self, rows: &[f32], compression: Compression) -> Vec<Vec<u8>> {
        let (width, across) = (self.width as usize, self.chunks_across());
        let band = width * self.chunk_height as usize;
        let down = rows.len().div_ceil(band);
        (0..down * across)
            .into_par_iter()
            .map(|chunk| {
                let start = chunk / across * band;
                let rows = &rows[start..rows.len().min(start + band)];
                if !self.tiled {
                    return compression.encode(rows, width);
                }
                let tile = self.tile(rows, chunk % across);
                compression.encode(&tile, self.chunk_width as usize)
            })
            .collect()
    }

    /// One tile of a row of tiles. Beyond the raster's edge the last column and row are repeated:
    /// nobody reads that, and it costs the fewest bytes.
    fn tile(&self, rows: &[f32], column: usize) -> Vec<f32> {
        let width = self.chunk_width as usize;
        let first = column * width;
        let mut tile = Vec::with_capacity(width * self.chunk_height as usize);
        for row in rows.chunks_exact(self.width as usize) {
            let inside = &row[first..row.len().min(first + width)];
            tile.extend_from_slice(inside);
            let last = inside.last().copied().unwrap_or(f32::NAN);
            tile.extend(std::iter::repeat_n(last, width - inside.len()));
        }
        let last_row = tile.len() - width;
        while tile.len() < width * self.chunk_height as usize {
            tile.extend_from_within(last_row..last_row + width);
        }
        tile
    }
}

/// Where strips or tiles lie in the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Places {
    pub(super) offsets: Vec<u64>,
    pub(super) counts: Vec<u32>,
}

impl Places {
    /// As many as the raster has, all unknown: for the size of a directory.
    pub(super) fn unknown(cut: &Cut) -> Self {
        Self { offsets: vec![0; cut.chunks()], counts: vec![0; cut.chunks()] }
    }
}
