//! A TIFF writer for tests that writes what it is told, sound or not: directories first, so that
//! cutting the end off loses pixels only.

#![allow(dead_code, reason = "each test binary uses its own part of this")]

use sat3d::raster::{RasterError, RasterReader};
use std::path::Path;

/// The values of a tag.
#[derive(Clone, Debug)]
pub enum Tag {
    Short(Vec<u16>),
    Long(Vec<u32>),
    Long8(Vec<u64>),
    Double(Vec<f64>),
    Ascii(String),
}

/// One image: its tags and its strips or tiles. An empty chunk is one that was never written.
#[derive(Clone, Debug, Default)]
pub struct Image {
    tags: Vec<(u16, Tag)>,
    chunks: Vec<Vec<u8>>,
}

/// A whole file.
#[derive(Clone, Debug, Default)]
pub struct Tiff {
    pub images: Vec<Image>,
    pub big_tiff: bool,
    pub big_endian: bool,
}

/// EPSG:2927 in GeoKeys: model type projected, raster type area, projected CRS 2927.
pub const KEYS_2927: [u16; 16] = [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 2927];
/// EPSG:4326: model type geographic.
pub const KEYS_4326: [u16; 16] = [1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, 1, 2048, 0, 1, 4326];

impl Image {
    /// A single-band image of floats of 32 bits in strips of `rows` rows, uncompressed, in EPSG:2927.
    pub fn floats(width: u32, height: u32, rows: u32, values: &[f32], big_endian: bool) -> Self {
        let bytes = |v: &f32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        let strips = values
            .chunks((width * rows).max(1) as usize)
            .map(|strip| strip.iter().flat_map(bytes).collect())
            .collect();
        Self::default()
            .tag(256, Tag::Long(vec![width]))
            .tag(257, Tag::Long(vec![height]))
            .tag(258, Tag::Short(vec![32]))
            .tag(259, Tag::Short(vec![1]))
            .tag(262, Tag::Short(vec![1]))
            .tag(277, Tag::Short(vec![1]))
            .tag(278, Tag::Long(vec![rows]))
            .tag(339, Tag::Short(vec![3]))
            .tag(33550, Tag::Double(vec![1.5, 1.5, 0.0]))
            .tag(33922, Tag::Double(vec![0.0, 0.0, 0.0, 1_180_000.0, 840_000.0, 0.0]))
            .tag(34735, Tag::Short(KEYS_2927.to_vec()))
            .chunks(strips)
    }

    /// Sets a tag.
    pub fn tag(mut self, tag: u16, value: Tag) -> Self {
        self = self.without(tag);
        self.tags.push((tag, value));
        self
    }

    /// Removes a tag.
    pub fn without(mut self, tag: u16) -> Self {
        self.tags.retain(|(t, _)| *t != tag);
        self
    }

    /// Replaces the strips or tiles.
    pub fn chunks(mut self, chunks: Vec<Vec<u8>>) -> Self {
        self.chunks = chunks;
        self
    }

    /// Makes tiles of it.
    pub fn tiled(self, width: u32, height: u32) -> Self {
        self.without(278).tag(322, Tag::Long(vec![width])).tag(323, Tag::Long(vec![height]))
    }

    fn is_tiled(&self) -> bool {
        self.tags.iter().any(|(tag, _)| *tag == 322)
    }
}

impl Tiff {
    /// A file with one image.
    pub fn of(image: Image) -> Self {
        Self { images: vec![image], ..Self::default() }
    }

    fn integer(&self, value: u64, bytes: usize) -> Vec<u8> {
        if self.big_endian {
            value.to_be_bytes()[8 - bytes..].to_vec()
        } else {
            value.to_le_bytes()[..bytes].to_vec()
        }
    }

    /// Type number, count and bytes of a tag's values.
    fn encode(&self, tag: &Tag) -> (u64, u64, Vec<u8>) {
        let all = |values: Vec<u64>, bytes: usize| {
            values.into_iter().flat_map(|v| self.integer(v, bytes)).collect::<Vec<u8>>()
        };
        match tag {
            Tag::Short(v) => {
                (3, v.len() as u64, all(v.iter().copied().map(u64::from).collect(), 2))
            }
            Tag::Long(v) => (4, v.len() as u64, all(v.iter().copied().map(u64::from).collect(), 4)),
            Tag::Long8(v) => (16, v.len() as u64, all(v.clone(), 8)),
            Tag::Double(v) => (12, v.len() as u64, all(v.iter().map(|v| v.to_bits()).collect(), 8)),
            Tag::Ascii(v) => (2, v.len() as u64 + 1, [v.as_bytes(), &[0]].concat()),
        }
    }

    /// The bytes of the file.
    pub fn bytes(&self) -> Vec<u8> {
        let word = if self.big_tiff { 8 } else { 4 };
        let (count_bytes, entry_bytes) = if self.big_tiff { (8, 20) } else { (2, 12) };
        // Offsets depend on sizes only, so two passes settle them.
        let mut data_start = 0;
        let mut out = Vec::new();
        for _ in 0..2 {
            out = if self.big_endian { b"MM".to_vec() } else { b"II".to_vec() };
            out.extend(self.integer(if self.big_tiff { 43 } else { 42 }, 2));
            if self.big_tiff {
                out.extend(self.integer(8, 2));
                out.extend(self.integer(0, 2));
            }
            let first = out.len() + word;
            out.extend(self.integer(first as u64, word));
            let mut data = data_start;
            for (i, image) in self.images.iter().enumerate() {
                let (mut offsets, mut counts) = (Vec::new(), Vec::new());
                for chunk in &image.chunks {
                    offsets.push(if chunk.is_empty() { 0 } else { data as u64 });
                    counts.push(chunk.len() as u64);
                    data += chunk.len();
                }
                let long = |v: Vec<u64>| {
                    if self.big_tiff {
                        Tag::Long8(v)
                    } else {
                        Tag::Long(v.into_iter().map(|v| v as u32).collect())
                    }
                };
                let mut tags = image.tags.clone();
                let numbers = if image.is_tiled() { (324, 325) } else { (273, 279) };
                tags.push((numbers.0, long(offsets)));
                tags.push((numbers.1, long(counts)));
                tags.sort_by_key(|(tag, _)| *tag);

                let mut values_at = out.len() + count_bytes + tags.len() * entry_bytes + word;
                let mut values = Vec::new();
                out.extend(self.integer(tags.len() as u64, count_bytes));
                for (tag, value) in &tags {
                    let (kind, count, mut bytes) = self.encode(value);
                    out.extend(self.integer(u64::from(*tag), 2));
                    out.extend(self.integer(kind, 2));
                    out.extend(self.integer(count, word));
                    if bytes.len() <= word {
                        bytes.resize(word, 0);
                        out.extend(bytes);
                    } else {
                        out.extend(self.integer(values_at as u64, word));
                        values_at += bytes.len();
                        values.extend(bytes);
                    }
                }
                let last = i + 1 == self.images.len();
                out.extend(self.integer(if last { 0 } else { values_at as u64 }, word));
                out.extend(values);
            }
            data_start = out.len();
        }
        for chunk in self.images.iter().flat_map(|image| &image.chunks) {
            out.extend(chunk);
        }
        out
    }

    /// Writes the file.
    pub fn write(&self, path: &Path) {
        std::fs::write(path, self.bytes()).expect("a file is written");
    }
}

/// Every sample of a raster, through its reader's blocks.
pub fn read_all(reader: &mut dyn RasterReader) -> Result<Vec<f32>, RasterError> {
    let header = reader.header().clone();
    let (width, height) = (header.width as usize, header.height as usize);
    let (block_width, block_height) = (header.block_width as usize, header.block_height as usize);
    let mut all = vec![0.0; width * height];
    let mut block = Vec::new();
    for by in 0..height.div_ceil(block_height) {
        for bx in 0..width.div_ceil(block_width) {
            reader.read_block(bx as u32, by as u32, &mut block)?;
            let rows = block_height.min(height - by * block_height);
            assert_eq!(block.len(), rows * block_width);
            for (row, samples) in block.chunks_exact(block_width).enumerate() {
                let columns = block_width.min(width - bx * block_width);
                assert!(samples[columns..].iter().all(|v| v.is_nan()), "beyond the right edge");
                let start = (by * block_height + row) * width + bx * block_width;
                all[start..start + columns].copy_from_slice(&samples[..columns]);
            }
        }
    }
    Ok(all)
}

/// Samples as bits, so that NaN equals itself.
pub fn bits(samples: &[f32]) -> Vec<u32> {
    samples.iter().map(|v| v.to_bits()).collect()
}

/// A terrain with some structure.
pub fn height(x: usize, y: usize) -> f64 {
    let (x, y) = (x as f64, y as f64);
    100.0 + 20.0 * libm::sin(x / 9.0) * libm::cos(y / 13.0) + x * 0.01
}
