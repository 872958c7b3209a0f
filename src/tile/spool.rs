//! The picture at model resolution on disk: any window in any order, in constant memory.
//!
//! A picture is read once, from the top, resized, and written as red, green, blue and validity. Windows
//! overlap, and bands may go against the picture's rows: without this file a PNG would be decoded many
//! times. The file begins with a header of one line of JSON, padded with spaces to a multiple of 64 bytes
//! and closed by a line feed; the pixels follow, four bytes each, row-major, north first.

use crate::batch::AtomicFile;
use crate::model::Image8;
use crate::picture::{PictureError, ResampledPicture};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Read, Write};
use std::ops::{ControlFlow, Range};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// What a window holds where the picture has no data: ImageNet's mean colour, next to zero for the network.
pub const NO_DATA_COLOUR: [u8; 3] = [124, 116, 104];
/// Bytes of a pixel: red, green, blue, validity (255 or 0).
const PIXEL: usize = 4;
/// What the header's length is a multiple of.
const ALIGNMENT: usize = 64;
/// No header is longer.
const LONGEST_HEADER: usize = 1 << 16;
/// Pixels that are written at once.
const BATCH: usize = 1 << 20;
const KIND: &str = "sat3d picture at model resolution";

/// Why a spool cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum SpoolError {
    /// The picture cannot be read.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// The system refused to write.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The disk has no room for it.
    #[error(
        "{}: the picture at model resolution takes {needed} bytes, and the disk has {} bytes left; make room, write to \
         another disk, or take larger model pixels (--window-gsd)",
        path.display(), available.map_or_else(|| "no".to_owned(), |bytes| bytes.to_string())
    )]
    Full {
        /// The file.
        path: PathBuf,
        /// What it takes.
        needed: u64,
        /// What the disk had before; `None` where it filled up while writing.
        available: Option<u64>,
    },
    /// It was told to stop; nothing is left behind.
    #[error("stopped")]
    Stopped,
}

/// The first line of the file.
#[derive(Debug, Serialize, Deserialize)]
struct Header {
    kind: String,
    width: u32,
    height: u32,
    fingerprint: String,
}

impl Header {
    fn bytes(&self) -> io::Result<Vec<u8>> {
        let mut bytes = serde_json::to_vec(self)?;
        if bytes.len() >= LONGEST_HEADER {
            return Err(io::Error::other("the fingerprint is too long"));
        }
        bytes.resize((bytes.len() + 1).next_multiple_of(ALIGNMENT) - 1, b' ');
        bytes.push(b'\n');
        Ok(bytes)
    }
}

/// A picture at model resolution, on disk. Threads may read from it at once.
#[derive(Debug)]
pub struct Spool {
    path: PathBuf,
    file: File,
    size: [u32; 2],
    /// Where the pixels begin.
    start: u64,
}

/// What a spool is made of: the picture's name, size and time of change, and the size at model resolution. Of a VRT,
/// changes of the files behind it are not seen.
///
/// # Errors
/// The file cannot be looked at.
pub fn fingerprint(picture: &Path, size: [u32; 2]) -> io::Result<String> {
    let metadata = std::fs::metadata(picture)?;
    let age = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let (seconds, nanoseconds) = age.map_or((0, 0), |age| (age.as_secs(), age.subsec_nanos()));
    let path = std::path::absolute(picture)?;
    let [width, height] = size;
    Ok(format!(
        "{} {} bytes {seconds}.{nanoseconds:09} {width} x {height}",
        path.display(),
        metadata.len()
    ))
}

impl Spool {
    /// Reads the picture to its end and writes it to `path`, whose folder must exist; the file appears whole or
    /// not at all. `progress` hears after each batch of rows how many are done, and may stop it.
    ///
    /// # Errors
    /// [`SpoolError`]; nothing is left behind.
    pub fn create(
        mut picture: ResampledPicture,
        path: &Path,
        fingerprint: &str,
        mut progress: impl FnMut(u32) -> ControlFlow<()>,
    ) -> Result<Self, SpoolError> {
        let [width, height] = picture.size();
        let io = |source| SpoolError::Io { path: path.to_owned(), source };
        let header = Header {
            kind: KIND.to_owned(),
            width: width as u32,
            height: height as u32,
            fingerprint: fingerprint.to_owned(),
        };
        let header = header.bytes().map_err(io)?;
        let needed = (width * PIXEL) as u64 * height as u64 + header.len() as u64;
        let mut output = AtomicFile::create(path).map_err(io)?;
        if let Some(available) = free(output.path()).filter(|available| *available < needed) {
            let available = Some(available);
            return Err(SpoolError::Full { path: path.to_owned(), needed, available });
        }
        let written = |result: io::Result<()>| {
            result.map_err(|source| match source.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                    SpoolError::Full { path: path.to_owned(), needed, available: None }
                }
                _ => SpoolError::Io { path: path.to_owned(), source },
            })
        };
        written(output.file().write_all(&header))?;
        let rows = (BATCH / width).clamp(1, height);
        let (mut rgb, mut valid) = (vec![0; rows * width * 3], vec![0; rows * width]);
        let mut pixels = vec![0; rows * width * PIXEL];
        let mut done = 0;
        loop {
            let count = picture.next_rows_masked(&mut rgb, &mut valid)?;
            if count == 0 {
                break;
            }
            let pixels = &mut pixels[..count * width * PIXEL];
            for ((pixel, rgb), valid) in
                pixels.chunks_exact_mut(PIXEL).zip(rgb.chunks_exact(3)).zip(&valid)
            {
                pixel.copy_from_slice(&[rgb[0], rgb[1], rgb[2], *valid]);
            }
            written(output.file().write_all(pixels))?;
            done += count;
            if progress(done as u32).is_break() {
                return Err(SpoolError::Stopped);
            }
        }
        written(output.commit())?;
        Self::open(path, fingerprint).ok_or_else(|| {
            io(io::Error::other("was written and cannot be read again; does something else write to it?"))
        })
    }

    /// Opens a spool that an earlier run made of the same picture; `None` where there is none, or it is of
    /// another picture or damaged: make it anew.
    #[must_use]
    pub fn open(path: &Path, fingerprint: &str) -> Option<Self> {
        let file = File::open(path).ok()?;
        let mut start = Vec::new();
        (&file).take(LONGEST_HEADER as u64).read_to_end(&mut start).ok()?;
        let end = start.iter().position(|byte| *byte == b'\n')?;
        let header: Header = serde_json::from_slice(&start[..end]).ok()?;
        let start = end as u64 + 1;
        let bytes = u64::from(header.width) * u64::from(header.height) * PIXEL as u64 + start;
        let same = header.kind == KIND && header.fingerprint == fingerprint;
        let sound = header.width > 0 && header.height > 0 && file.metadata().ok()?.len() == bytes;
        let size = [header.width, header.height];
        (same && sound).then(|| Self { path: path.to_owned(), file, size, start })
    }

    /// Columns and rows, model pixels.
    #[must_use]
    pub const fn size(&self) -> [u32; 2] {
        self.size
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Colours (red, green, blue) and validity of a rectangle of columns and rows, row-major. Pixels without
    /// data have the colours that the picture has there.
    ///
    /// # Errors
    /// A rectangle that reaches beyond the picture; what the system says, with the file's name.
    pub fn rectangle(
        &self,
        [columns, rows]: [Range<u32>; 2],
    ) -> io::Result<(Vec<u8>, Vec<bool>)> {
        let pixels = self.read([columns, rows])?;
        let rgb = pixels.chunks_exact(PIXEL).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]);
        let valid = pixels.chunks_exact(PIXEL).map(|pixel| pixel[3] != 0);
        Ok((rgb.collect(), valid.collect()))
    }

    /// A square window of `size` model pixels from column `x` and row `y` on, which may lie beyond the picture:
    /// there it is reflected about its outermost pixels (which are not repeated), again and again if need be, and
    /// a reflected pixel is as valid as the one that it shows; a picture that is one pixel wide shows that
    /// pixel. Pixels without data are [`NO_DATA_COLOUR`].
    ///
    /// # Errors
    /// What the system says, with the file's name.
    pub fn window(&self, x: i64, y: i64, size: u32) -> io::Result<(Image8, Vec<bool>)> {
        let columns = reflected(x, size, self.size[0]);
        let rows = reflected(y, size, self.size[1]);
        // What lies between the first and the last is all looked at.
        let span = |places: &[u32]| {
            let first = places.iter().copied().min().unwrap_or(0);
            first..places.iter().copied().max().map_or(0, |last| last + 1)
        };
        let (across, down) = (span(&columns), span(&rows));
        let pixels = self.read([across.clone(), down.clone()])?;
        let mut data = Vec::with_capacity(columns.len() * rows.len() * 3);
        let mut valid = Vec::with_capacity(columns.len() * rows.len());
        for row in &rows {
            let row = &pixels[(row - down.start) as usize * across.len() * PIXEL..];
            for column in &columns {
                let pixel = &row[(column - across.start) as usize * PIXEL..][..PIXEL];
                valid.push(pixel[3] != 0);
                data.extend_from_slice(if pixel[3] == 0 { &NO_DATA_COLOUR } else { &pixel[..3] });
            }
        }
        let side = size as usize;
        Ok((Image8 { width: side, height: side, channels: 3, data }, valid))
    }

    fn read(&self, [columns, rows]: [Range<u32>; 2]) -> io::Result<Vec<u8>> {
        let [width, height] = self.size;
        let named = |error: io::Error| {
            io::Error::new(error.kind(), format!("{}: {error}", self.path.display()))
        };
        if columns.end > width || rows.end > height {
            let what = format!(
                "columns {columns:?} and rows {rows:?} reach beyond the picture of {width} x {height} model pixels"
            );
            return Err(named(io::Error::new(io::ErrorKind::InvalidInput, what)));
        }
        let line = columns.len() * PIXEL;
        let mut pixels = vec![0; rows.len() * line];
        let at = |row: u32| {
            let pixel = u64::from(row) * u64::from(width) + u64::from(columns.start);
            self.start + pixel * PIXEL as u64
        };
        if columns.len() == width as usize {
            self.file.read_exact_at(&mut pixels, at(rows.start)).map_err(named)?;
        } else if line > 0 {
            for (row, out) in rows.zip(pixels.chunks_exact_mut(line)) {
                self.file.read_exact_at(out, at(row)).map_err(named)?;
            }
        }
        Ok(pixels)
    }
}

/// The pixels that `count` places from `first` on show, of `length` pixels: numpy's `reflect`.
fn reflected(first: i64, count: u32, length: u32) -> Vec<u32> {
    let last = i128::from(length) - 1;
    (0..i128::from(count))
        .map(|i| {
            let at = (i128::from(first) + i).rem_euclid((2 * last).max(1));
            at.min(2 * last - at).max(0) as u32
        })
        .collect()
}

/// Bytes that may still be written beside a file, where the system says so.
fn free(file: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(file).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}
