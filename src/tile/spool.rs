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
            io(io::Error::other(
                "was written and cannot be read again; does something else write to it?",
            ))
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
    pub fn rectangle(&self, [columns, rows]: [Range<u32>; 2]) -> io::Result<(Vec<u8>, Vec<bool>)> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture;
    use std::cell::Cell;

    /// A PNG with alpha: 0 where `hole` says so.
    fn write(path: &Path, size: [u32; 2], hole: impl Fn(u32, u32) -> bool) -> Vec<[u8; 4]> {
        let pixel = |i: u32| {
            let (x, y) = (i % size[0], i / size[0]);
            let noise = i.wrapping_mul(2_654_435_761) >> 8;
            let alpha = if hole(x, y) { 0 } else { 1 + (noise % 255) as u8 };
            [noise as u8, (noise >> 8) as u8, (noise >> 16) as u8, alpha]
        };
        let pixels: Vec<_> = (0..size[0] * size[1]).map(pixel).collect();
        let file = File::create(path).expect("a file");
        let mut encoder = png::Encoder::new(file, size[0], size[1]);
        encoder.set_color(png::ColorType::Rgba);
        let mut writer = encoder.write_header().expect("a header");
        writer.write_image_data(pixels.as_flattened()).expect("pixels");
        pixels
    }

    fn spool(path: &Path, size: [u32; 2], to: &Path) -> Result<Spool, SpoolError> {
        let picture = ResampledPicture::new(picture::open(path)?, size);
        Spool::create(picture, to, "print", |_| ControlFlow::Continue(()))
    }

    fn names(folder: &Path) -> Vec<String> {
        let items = std::fs::read_dir(folder).expect("a folder");
        items
            .map(|item| item.expect("an item").file_name().to_string_lossy().into_owned())
            .collect()
    }

    #[test]
    fn places_are_reflected_as_numpy_does() {
        // numpy.pad(range(n), (4, 5), "reflect")
        assert_eq!(reflected(-4, 14, 5), [4, 3, 2, 1, 0, 1, 2, 3, 4, 3, 2, 1, 0, 1]);
        assert_eq!(reflected(-4, 11, 2), [0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0]);
        assert_eq!(reflected(-4, 10, 1), [0; 10]);
        assert_eq!(reflected(-4, 12, 3), [0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1]);
        assert_eq!(reflected(i64::MIN, 2, 2).len(), 2);
        assert_eq!(reflected(i64::MAX, 3, 7).len(), 3);
    }

    #[test]
    fn windows_are_the_pictures_pixels_reflected_beyond_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, to) = (folder.path().join("a.png"), folder.path().join("a.spool"));
        for size in [[23, 17], [1, 9], [9, 1], [1, 1], [300, 2]] {
            let pixels = write(&path, size, |x, y| (x + 2 * y) % 5 == 0);
            let spool = spool(&path, size, &to).expect("a spool");
            assert_eq!(spool.size(), size);
            for (x, y, side) in [(0, 0, 4), (-3, -5, 16), (-40, 7, 64), (20, 90, 9), (3, 3, 1)] {
                let (image, valid) = spool.window(x, y, side).expect("a window");
                assert_eq!(
                    (image.width, image.height, image.channels),
                    (side as usize, side as usize, 3)
                );
                for (i, valid) in valid.iter().enumerate() {
                    let (i, side) = (i as i64, i64::from(side));
                    let at =
                        [(x + i % side, size[0]), (y + i / side, size[1])].map(|(mut at, n)| {
                            // One reflection after the other.
                            let n = i64::from(n);
                            while n > 1 && !(0..n).contains(&at) {
                                at = if at < 0 { -at } else { 2 * (n - 1) - at };
                            }
                            if n == 1 { 0 } else { at as usize }
                        });
                    let expected = pixels[at[1] * size[0] as usize + at[0]];
                    let colour = &image.data[i as usize * 3..][..3];
                    assert_eq!(*valid, expected[3] != 0, "{size:?} {x} {y} {i}");
                    let wanted = if *valid { &expected[..3] } else { &NO_DATA_COLOUR[..] };
                    assert_eq!(colour, wanted, "{size:?} {x} {y} {i}");
                }
            }
            let (rgb, valid) = spool.rectangle([0..size[0], 0..size[1]]).expect("all of it");
            let colours: Vec<_> = pixels.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
            assert!(rgb == colours, "colours without data stay in a rectangle");
            assert!(valid.iter().zip(&pixels).all(|(valid, pixel)| *valid == (pixel[3] != 0)));
            assert!(spool.rectangle([0..0, 0..1]).expect("nothing").0.is_empty());
            let error = spool.rectangle([0..size[0] + 1, 0..1]).expect_err("beyond").to_string();
            assert!(error.contains("a.spool") && error.contains("reach beyond"), "{error}");
        }
    }

    #[test]
    fn windows_may_be_read_by_many_threads() {
        use rayon::prelude::*;
        let folder = tempfile::tempdir().expect("a folder");
        let (path, to) = (folder.path().join("a.png"), folder.path().join("a.spool"));
        write(&path, [400, 300], |x, _| x == 7);
        let spool = spool(&path, [100, 75], &to).expect("a spool");
        let window = |i: i64| spool.window(i % 90 - 10, i % 71, 32).expect("a window");
        let alone: Vec<_> = (0..200).map(window).collect();
        let together: Vec<_> = (0..200).into_par_iter().map(window).collect();
        assert!(alone == together);
    }

    #[test]
    fn a_spool_is_found_again_by_its_print_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, to) = (folder.path().join("a.png"), folder.path().join("a.spool"));
        write(&path, [40, 30], |_, _| false);
        assert!(Spool::open(&to, "print").is_none());
        let made = spool(&path, [20, 15], &to).expect("a spool");
        let found = Spool::open(&to, "print").expect("the spool");
        assert_eq!(
            found.window(-3, 5, 30).expect("a window"),
            made.window(-3, 5, 30).expect("a window")
        );
        assert!(Spool::open(&to, "another").is_none());
        // Without alpha everything is valid; with a hole, all that its colour would reach is not.
        let (_, valid) = made.rectangle([0..20, 0..15]).expect("all");
        assert!(valid.iter().all(|valid| *valid));

        let bytes = std::fs::read(&to).expect("the file");
        for broken in [&bytes[..bytes.len() - 1], &bytes[..70], &bytes[..0], b"{}\n", b"\xff\xff"] {
            std::fs::write(&to, broken).expect("writes");
            assert!(Spool::open(&to, "print").is_none(), "{} bytes", broken.len());
        }
        let first = fingerprint(&path, [20, 15]).expect("a print");
        assert_eq!(first, fingerprint(&path, [20, 15]).expect("a print"));
        assert_ne!(first, fingerprint(&path, [20, 16]).expect("a print"));
        std::fs::write(&path, b"other").expect("writes");
        assert_ne!(first, fingerprint(&path, [20, 15]).expect("a print"));
    }

    #[test]
    fn what_fails_leaves_nothing_behind() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, to) = (folder.path().join("a.png"), folder.path().join("a.spool"));
        write(&path, [500, 3000], |_, _| false);
        let open = || ResampledPicture::new(picture::open(&path).expect("opens"), [250, 9000]);
        let heard = Cell::new(0);
        let stop = |rows| {
            heard.set(rows);
            ControlFlow::Break(())
        };
        let error = Spool::create(open(), &to, "print", stop).expect_err("stopped");
        assert!(
            matches!(error, SpoolError::Stopped) && heard.get() == 4194,
            "{error} {}",
            heard.get()
        );
        assert_eq!(names(folder.path()), ["a.png"]);

        let bytes = std::fs::read(&path).expect("reads");
        std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writes");
        let error = spool(&path, [250, 1500], &to).expect_err("truncated").to_string();
        assert!(
            error.contains("a.png") && error.contains("of 3000") && error.contains("row"),
            "{error}"
        );
        assert_eq!(names(folder.path()), ["a.png"]);
        let none = folder.path().join("none/a.spool");
        std::fs::write(&path, &bytes).expect("writes");
        let error = spool(&path, [250, 1500], &none).expect_err("no folder").to_string();
        assert!(error.contains("none/a.spool"), "{error}");
    }

    #[test]
    fn a_disk_without_room_is_found_before_anything_is_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, to) = (folder.path().join("a.png"), folder.path().join("a.spool"));
        write(&path, [2, 2], |_, _| false);
        // Nine terabytes; a disk that has them is told to stop at once.
        let size = [1_500_000; 2];
        let picture = ResampledPicture::new(picture::open(&path).expect("opens"), size);
        let error =
            Spool::create(picture, &to, "print", |_| ControlFlow::Break(())).expect_err("full");
        let text = error.to_string();
        assert!(matches!(error, SpoolError::Full { available: Some(_), .. }), "{text}");
        assert!(text.contains("a.spool") && text.contains("9000000000128 bytes"), "{text}");
        assert_eq!(names(folder.path()), ["a.png"]);
    }
}
