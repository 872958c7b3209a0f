//! Finished slabs on disk: heights, colours and surface of 256 lines each, from which outputs are made.
//!
//! Three files per slab in the folder [`FOLDER`] of the output folder, numbered from 0:
//! `00012.heights` (f32, little-endian, metres, NaN = no surface) and `00012.colours` (red, green,
//! blue), both row-major over the slab's rectangle with north first, and `00012.surface`
//! ([`super::surface`]).

use super::city::City;
use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Folder of the slabs, in the output folder.
pub const FOLDER: &str = "slabs";

/// What a slab's files hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Heights, metres.
    Heights,
    /// Colours of the picture at model resolution.
    Colours,
    /// Tiles of the surface.
    Surface,
}

/// A slab's file, relative to the output folder.
#[must_use]
pub fn file_name(slab: u32, kind: Kind) -> String {
    let end = match kind {
        Kind::Heights => "heights",
        Kind::Colours => "colours",
        Kind::Surface => "surface",
    };
    format!("{FOLDER}/{slab:05}.{end}")
}

/// All slabs of a finished run, to be read.
#[derive(Debug)]
pub struct Slabs<'a> {
    /// The lattice.
    pub city: &'a City,
    /// The output folder.
    pub out: &'a Path,
}

impl Slabs<'_> {
    /// Path of a slab's file.
    #[must_use]
    pub fn path(&self, slab: u32, kind: Kind) -> PathBuf {
        self.out.join(file_name(slab, kind))
    }

    /// Heights of a rectangle of the city (columns, rows), metres, row-major, north first.
    ///
    /// # Errors
    /// A slab's file is missing or too short.
    pub fn heights(&self, [columns, rows]: [Range<u32>; 2]) -> io::Result<Vec<f32>> {
        let bytes = self.read(Kind::Heights, 4, [columns, rows])?;
        Ok(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }

    /// Colours of a rectangle of the city (columns, rows): red, green, blue, row-major, north first.
    ///
    /// # Errors
    /// As [`Slabs::heights`].
    pub fn colours(&self, rectangle: [Range<u32>; 2]) -> io::Result<Vec<u8>> {
        self.read(Kind::Colours, 3, rectangle)
    }

    fn read(
        &self,
        kind: Kind,
        size: usize,
        [columns, rows]: [Range<u32>; 2],
    ) -> io::Result<Vec<u8>> {
        let width = columns.len();
        let mut out = vec![0; width * rows.len() * size];
        for slab in 0..self.city.slabs() {
            let [x, y] = self.city.rectangle(slab);
            let (left, right) = (columns.start.max(x.start), columns.end.min(x.end));
            let (top, bottom) = (rows.start.max(y.start), rows.end.min(y.end));
            if left >= right || top >= bottom {
                continue;
            }
            let path = self.path(slab, kind);
            let named = |error: io::Error| {
                io::Error::new(error.kind(), format!("{}: {error}", path.display()))
            };
            let file = File::open(&path).map_err(named)?;
            for row in top..bottom {
                let from = (row - y.start) as u64 * x.len() as u64 + u64::from(left - x.start);
                let to = (row - rows.start) as usize * width + (left - columns.start) as usize;
                let part = &mut out[to * size..][..(right - left) as usize * size];
                file.read_exact_at(part, from * size as u64).map_err(named)?;
            }
        }
        Ok(out)
    }
}
