//! RGB GeoTIFF files of any size, written row by row: 8 bits a sample, without loss.

use super::predictor::{Compression, deflate};
use super::tags::{self, Directory, Format, Value};
use super::tiles::{Cut, Places};
use super::writer::GeoTiffSpec;
use super::{GeoTiffError, Layout};
use crate::batch::AtomicFile;
use rayon::prelude::*;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Bytes of a pixel.
const PIXEL: usize = 3;

/// Writes one RGB GeoTIFF row by row, north first; memory is that of two rows of tiles. The file appears
/// when [`finish`](Self::finish) returns, whole, or never.
///
/// It takes the specification of a [`super::GeoTiffWriter`]; with [`Compression::Deflate`] samples are stored as
/// differences from the pixel to the left (TIFF's predictor 2).
#[derive(Debug)]
pub struct RgbWriter {
    spec: GeoTiffSpec,
    path: PathBuf,
    file: AtomicFile,
    pub(super) format: Format,
    cut: Cut,
    places: Places,
    /// Where the next strip or tile goes.
    end: u64,
    /// Rows that wait for their tiles to be full.
    pending: Vec<u8>,
    /// Rows taken so far.
    rows: u64,
    /// Whether a call failed.
    failed: bool,
}

impl RgbWriter {
    /// Begins a file; nothing is seen at `path` yet.
    ///
    /// # Errors
    /// [`GeoTiffError::Spec`] for what GeoTIFF cannot hold and for strips (a picture is read in windows),
    /// [`GeoTiffError::Io`] when the folder cannot be written.
    pub fn create(path: &Path, spec: &GeoTiffSpec) -> Result<Self, GeoTiffError> {
        spec.check(path)?;
        if let Layout::Strips(rows) = spec.layout {
            return Err(GeoTiffError::Spec {
                path: path.to_owned(),
                item: "the rows of a strip",
                value: rows.to_string(),
                rule: "pictures are written in tiles",
            });
        }
        // The cut counts four bytes a pixel.
        let raw = spec.cut().raw_bytes() / 4 * PIXEL as u64;
        Self::create_as(path, spec, Format::of_raw(raw))
    }

    pub(super) fn create_as(
        path: &Path,
        spec: &GeoTiffSpec,
        format: Format,
    ) -> Result<Self, GeoTiffError> {
        let io = |source| GeoTiffError::Io { path: path.to_owned(), source };
        let cut = spec.cut();
        let mut file = AtomicFile::create(path).map_err(io)?;
        let room = directory(spec, &cut, &Places::unknown(&cut)).size(format);
        let end = format.header(0).len() as u64 + room;
        file.file().seek(SeekFrom::Start(end)).map_err(io)?;
        Ok(Self {
            spec: spec.clone(),
            path: path.to_owned(),
            file,
            format,
            cut,
            places: Places::default(),
            end,
            pending: Vec::new(),
            rows: 0,
            failed: false,
        })
    }

    /// Takes the next rows, any number of whole ones, three bytes a pixel, from north to south.
    ///
    /// # Errors
    /// [`GeoTiffError::PartialRow`], [`GeoTiffError::Rows`] for more rows than the raster has, and
    /// [`GeoTiffError::Io`]. After an error the file cannot be finished.
    pub fn write_rows(&mut self, rows: &[u8]) -> Result<(), GeoTiffError> {
        let outcome = self.take_rows(rows);
        self.failed |= outcome.is_err();
        outcome
    }

    fn take_rows(&mut self, mut bytes: &[u8]) -> Result<(), GeoTiffError> {
        let line = self.cut.width as usize * PIXEL;
        if !bytes.len().is_multiple_of(line) {
            return Err(GeoTiffError::PartialRow {
                path: self.path.clone(),
                samples: bytes.len(),
                width: self.cut.width,
            });
        }
        self.rows += (bytes.len() / line) as u64;
        if self.rows > u64::from(self.cut.height) {
            return Err(self.wrong_rows());
        }
        let band = self.cut.chunk_height as usize * line;
        while !bytes.is_empty() {
            let (now, later) = bytes.split_at(bytes.len().min(band - self.pending.len()));
            self.pending.extend_from_slice(now);
            bytes = later;
            if self.pending.len() == band {
                self.flush()
                    .map_err(|source| GeoTiffError::Io { path: self.path.clone(), source })?;
            }
        }
        Ok(())
    }

    /// Compresses and writes the row of tiles that waits.
    fn flush(&mut self) -> io::Result<()> {
        let tiles: Vec<Vec<u8>> = (0..self.cut.chunks_across())
            .into_par_iter()
            .map(|column| {
                let mut tile = self.tile(column);
                if self.spec.compression == Compression::None {
                    return tile;
                }
                let line = self.cut.chunk_width as usize * PIXEL;
                tile.chunks_exact_mut(line).for_each(predict);
                deflate(&tile)
            })
            .collect();
        self.pending.clear();
        for tile in &tiles {
            self.places.offsets.push(self.end);
            // Tiles are under 1 GiB.
            self.places.counts.push(tile.len() as u32);
            self.end += tile.len() as u64;
            self.file.file().write_all(tile)?;
        }
        Ok(())
    }

    /// One tile of the rows that wait; black beyond the raster's edge.
    fn tile(&self, column: usize) -> Vec<u8> {
        let line = self.cut.width as usize * PIXEL;
        let width = self.cut.chunk_width as usize * PIXEL;
        let mut tile = vec![0; width * self.cut.chunk_height as usize];
        let first = column * width;
        let inside = width.min(line - first);
        for (row, out) in self.pending.chunks_exact(line).zip(tile.chunks_exact_mut(width)) {
            out[..inside].copy_from_slice(&row[first..first + inside]);
        }
        tile
    }

    /// Completes the file and puts it in place. The rename is durable after
    /// [`sync_folder`](crate::batch::sync_folder).
    ///
    /// # Errors
    /// [`GeoTiffError::Rows`] when rows are missing, [`GeoTiffError::Unfinished`] after a failed
    /// call, [`GeoTiffError::Io`]; the target is then as it was.
    pub fn finish(self) -> Result<(), GeoTiffError> {
        if self.failed {
            return Err(GeoTiffError::Unfinished { path: self.path });
        }
        if self.rows != u64::from(self.cut.height) {
            return Err(self.wrong_rows());
        }
        let path = self.path.clone();
        self.complete().map_err(|source| GeoTiffError::Io { path, source })
    }

    fn complete(mut self) -> io::Result<()> {
        if !self.pending.is_empty() {
            self.flush()?;
        }
        let start = self.format.header(0).len() as u64;
        let mut head = self.format.header(start);
        let directory = directory(&self.spec, &self.cut, &self.places);
        head.extend(directory.encode(self.format, start, 0));
        let file = self.file.file();
        file.seek(SeekFrom::Start(0))?;
        file.write_all(&head)?;
        self.file.commit()
    }

    fn wrong_rows(&self) -> GeoTiffError {
        let (path, height) = (self.path.clone(), self.cut.height);
        GeoTiffError::Rows { path, written: self.rows, height }
    }
}

/// What a raster of heights says of itself, but for the samples.
fn directory(spec: &GeoTiffSpec, cut: &Cut, places: &Places) -> Directory {
    let mut directory = spec.directory(cut, places);
    directory.set(tags::BITS_PER_SAMPLE, Value::Short(vec![8; PIXEL]));
    // RGB.
    directory.set(tags::PHOTOMETRIC, Value::Short(vec![2]));
    directory.set(tags::SAMPLES_PER_PIXEL, Value::Short(vec![PIXEL as u16]));
    // Whole numbers without sign.
    directory.set(tags::SAMPLE_FORMAT, Value::Short(vec![1; PIXEL]));
    if spec.compression == Compression::Deflate {
        directory.set(tags::PREDICTOR, Value::Short(vec![2]));
    }
    directory
}

/// Predictor 2: each sample as its difference from the same colour of the pixel before.
fn predict(row: &mut [u8]) {
    for i in (PIXEL..row.len()).rev() {
        row[i] = row[i].wrapping_sub(row[i - PIXEL]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::GeoTransform;
    use crate::picture;
    use crate::random::mix;

    fn pixels(width: u32, height: u32) -> Vec<u8> {
        let width = u64::from(width);
        (0..width * u64::from(height) * 3)
            .map(|i| ((i / 3 % width) + 40 * (i % 3) + mix(i) % 16) as u8)
            .collect()
    }

    fn spec(width: u32, height: u32) -> GeoTiffSpec {
        GeoTiffSpec {
            width,
            height,
            geotransform: GeoTransform::north_up(-13_618_000.0, 6_041_000.0, 0.25, 0.25),
            epsg: 3857,
            layout: Layout::Tiles(64),
            ..GeoTiffSpec::default()
        }
    }

    #[test]
    fn what_is_written_is_read_back_in_both_formats_and_any_pieces() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut files = Vec::new();
        for (width, height) in [(1, 1), (64, 64), (130, 200), (127, 65)] {
            let data = pixels(width, height);
            for compression in [Compression::Deflate, Compression::None] {
                for format in [Format::Classic, Format::Big] {
                    let spec = GeoTiffSpec { compression, ..spec(width, height) };
                    for rows in [1, 7, 100, 1000] {
                        let path = folder.path().join("p.tif");
                        let mut writer =
                            RgbWriter::create_as(&path, &spec, format).expect("begins");
                        for part in data.chunks(width as usize * 3 * rows) {
                            writer.write_rows(part).expect("writes");
                        }
                        writer.finish().expect("finishes");
                        files.push(std::fs::read(&path).expect("reads"));
                        let mut picture = picture::open(&path).expect("opens");
                        assert_eq!(picture.size(), [width, height]);
                        assert!(picture.warnings().is_empty(), "{:?}", picture.warnings());
                        assert_eq!(picture.read().expect("reads").data, data);
                        let footprint = picture.footprint(None).expect("a place");
                        let gsd = footprint.gsd_m;
                        assert!(gsd.iter().all(|g| (g - 0.17).abs() < 0.01), "{gsd:?}");
                    }
                    let same = std::mem::take(&mut files);
                    assert!(same.windows(2).all(|pair| pair[0] == pair[1]));
                }
            }
        }
    }

    #[test]
    fn the_predictor_keeps_colours_apart() {
        let mut row = [10, 20, 30, 11, 19, 30, 0, 255, 31];
        predict(&mut row);
        assert_eq!(row, [10, 20, 30, 1, 255, 0, 245, 236, 1]);
    }

    #[test]
    fn wrong_rows_strips_and_folders_are_refused_and_leave_no_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.tif");
        let create = || RgbWriter::create(&path, &spec(8, 4)).expect("begins");
        let mut writer = create();
        writer.write_rows(&[0; 8 * 3 * 3]).expect("writes");
        let error = writer.finish().expect_err("a row is missing");
        assert!(matches!(error, GeoTiffError::Rows { written: 3, height: 4, .. }), "{error}");
        let mut writer = create();
        let error = writer.write_rows(&[0; 8 * 3 * 5]).expect_err("too many rows");
        assert!(matches!(error, GeoTiffError::Rows { written: 5, .. }), "{error}");
        assert!(matches!(writer.finish(), Err(GeoTiffError::Unfinished { .. })));
        let error = create().write_rows(&[0; 8]).expect_err("no whole row");
        assert!(matches!(error, GeoTiffError::PartialRow { samples: 8, .. }), "{error}");
        let strips = GeoTiffSpec { layout: Layout::Strips(8), ..spec(8, 4) };
        let error = RgbWriter::create(&path, &strips).expect_err("strips").to_string();
        assert!(error.contains("tiles"), "{error}");
        let missing = folder.path().join("no").join("p.tif");
        assert!(RgbWriter::create(&missing, &spec(8, 4)).is_err());
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 0);
    }

    #[test]
    fn three_and_a_half_gigabytes_of_pixels_make_a_big_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.tif");
        let made = |side| {
            let spec = GeoTiffSpec { layout: Layout::Tiles(512), ..spec(side, side) };
            RgbWriter::create(&path, &spec).expect("begins").format
        };
        assert_eq!(made(512 * 66), Format::Classic);
        assert_eq!(made(512 * 67), Format::Big);
    }
}
