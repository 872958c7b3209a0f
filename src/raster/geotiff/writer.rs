//! GeoTIFF files of any size, written row by row.

use super::predictor::Compression;
use super::tags::{self, Directory, Format, Value};
use super::tiles::{Cut, Places};
use super::{GeoTiffError, geokeys, unit_name};
use crate::batch::AtomicFile;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Rows that are compressed at once at least, so that strips keep all cores busy too.
const BATCH_ROWS: u32 = 256;
/// A strip or tile above this is a mistake: readers have to hold one whole.
const MAX_CHUNK_BYTES: u64 = 1 << 30;

/// How the samples lie in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Square tiles of this many pixels, a multiple of 16.
    Tiles(u32),
    /// Strips of this many rows.
    Strips(u32),
}

/// What a [`GeoTiffWriter`] writes. `GeoTiffSpec { width, height, ..GeoTiffSpec::default() }` is a
/// raster without CRS and no-data value, one CRS unit a pixel, in compressed tiles of 256 pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct GeoTiffSpec {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixel corner grid in CRS units; rotated ones too.
    pub geotransform: GeoTransform,
    /// EPSG code of the horizontal CRS; 0 writes no CRS (and no vertical one).
    pub epsg: u32,
    /// EPSG code of the vertical CRS, which makes the CRS a compound one.
    pub vertical_epsg: Option<u32>,
    /// The value that marks pixels without data. Samples are written as they are.
    pub nodata: Option<f64>,
    /// Unit of the heights, written as the band's unit.
    pub unit: Option<LinearUnit>,
    /// Tiles or strips.
    pub layout: Layout,
    /// Compression.
    pub compression: Compression,
    /// Metadata items of the dataset; `TIFFTAG_SOFTWARE` goes into TIFF's own tag.
    pub metadata: Vec<(String, String)>,
}

impl Default for GeoTiffSpec {
    fn default() -> Self {
        Self {
            width: 0,
            height: 0,
            geotransform: GeoTransform::north_up(0.0, 0.0, 1.0, 1.0),
            epsg: 0,
            vertical_epsg: None,
            nodata: None,
            unit: None,
            layout: Layout::Tiles(256),
            compression: Compression::Deflate,
            metadata: Vec::new(),
        }
    }
}

impl GeoTiffSpec {
    pub(super) fn check(&self, path: &Path) -> Result<(), GeoTiffError> {
        let fail = |item, value: String, rule| {
            Err(GeoTiffError::Spec { path: path.to_owned(), item, value, rule })
        };
        for (item, pixels) in [("the width", self.width), ("the height", self.height)] {
            if pixels == 0 || i32::try_from(pixels).is_err() {
                return fail(item, pixels.to_string(), "it has to be 1 to 2147483647 pixels");
            }
        }
        let c = &self.geotransform.0;
        let area = c[1] * c[5] - c[2] * c[4];
        if !c.iter().all(|v| v.is_finite()) || !area.is_normal() {
            return fail("the geotransform", format!("{c:?}"), "pixels have to have an area");
        }
        for (item, code) in [("the CRS", Some(self.epsg)), ("the vertical CRS", self.vertical_epsg)]
        {
            if let Some(code) = code.filter(|code| *code != 0 && !geokeys::is_code(*code)) {
                let rule = "GeoTIFF holds EPSG codes from 1 to 32766";
                return fail(item, format!("EPSG:{code}"), rule);
            }
        }
        match self.layout {
            Layout::Tiles(size) if size == 0 || size % 16 != 0 => {
                return fail("the tile size", size.to_string(), "it has to be a multiple of 16");
            }
            Layout::Strips(0) => {
                return fail("the rows of a strip", "0".to_owned(), "there has to be one at least");
            }
            _ => {}
        }
        let cut = self.cut();
        let bytes = u64::from(cut.chunk_width) * u64::from(cut.chunk_height) * 4;
        if bytes > MAX_CHUNK_BYTES {
            let rule = "readers have to hold one whole, so 1 GiB is the most; use smaller ones";
            return fail("one strip or tile", format!("{bytes} bytes"), rule);
        }
        Ok(())
    }

    pub(super) fn cut(&self) -> Cut {
        let (chunk_width, chunk_height, tiled) = match self.layout {
            Layout::Tiles(size) => (size, size, true),
            Layout::Strips(rows) => (self.width, rows.min(self.height), false),
        };
        Cut { width: self.width, height: self.height, chunk_width, chunk_height, tiled }
    }

    pub(super) fn directory(&self, cut: &Cut, places: &Places) -> Directory {
        let mut directory = Directory::default();
        cut.set_layout(&mut directory, self.compression, places);
        geokeys::set_geotransform(&mut directory, &self.geotransform);
        geokeys::set_crs(&mut directory, self.epsg, self.vertical_epsg);
        set_metadata(&mut directory, self.unit, &self.metadata);
        if let Some(nodata) = self.nodata {
            directory.set(tags::GDAL_NODATA, tags::nodata(nodata));
        }
        directory
    }
}

/// Writes the band's unit and the metadata items.
pub(super) fn set_metadata(
    directory: &mut Directory,
    unit: Option<LinearUnit>,
    metadata: &[(String, String)],
) {
    let (software, items): (Vec<_>, Vec<_>) =
        metadata.iter().cloned().partition(|(key, _)| key.starts_with("TIFFTAG_SOFTWARE"));
    if let Some((_, software)) = software.into_iter().next() {
        directory.set(tags::SOFTWARE, Value::Ascii(software));
    }
    if let Some(xml) = tags::gdal_metadata(unit.map(unit_name), &items) {
        directory.set(tags::GDAL_METADATA, xml);
    }
}

/// Writes one GeoTIFF row by row, north first; memory is that of one row of tiles. The file appears
/// when [`finish`](Self::finish) returns, whole, or never.
#[derive(Debug)]
pub struct GeoTiffWriter {
    spec: GeoTiffSpec,
    path: PathBuf,
    file: AtomicFile,
    pub(super) format: Format,
    cut: Cut,
    places: Places,
    /// Where the next strip or tile goes.
    end: u64,
    /// Rows that wait for a batch to be full.
    pending: Vec<f32>,
    /// Rows taken so far.
    rows: u64,
    /// Whether a call failed.
    failed: bool,
}

impl GeoTiffWriter {
    /// Begins a file; nothing is seen at `path` yet.
    ///
    /// # Errors
    /// [`GeoTiffError::Spec`] for what GeoTIFF cannot hold, [`GeoTiffError::Io`] when the folder
    /// cannot be written.
    pub fn create(path: &Path, spec: &GeoTiffSpec) -> Result<Self, GeoTiffError> {
        spec.check(path)?;
        Self::create_as(path, spec, Format::of_raw(spec.cut().raw_bytes()))
    }

    pub(super) fn create_as(
        path: &Path,
        spec: &GeoTiffSpec,
        format: Format,
    ) -> Result<Self, GeoTiffError> {
        let io = |source| GeoTiffError::Io { path: path.to_owned(), source };
        let cut = spec.cut();
        let mut file = AtomicFile::create(path).map_err(io)?;
        // The directory comes first, where readers look; its room is known, its content is not.
        let room = spec.directory(&cut, &Places::unknown(&cut)).size(format);
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

    /// Takes the next rows, any number of whole ones, row-major from north to south.
    ///
    /// # Errors
    /// [`GeoTiffError::PartialRow`], [`GeoTiffError::Rows`] for more rows than the raster has, and
    /// [`GeoTiffError::Io`]. After an error the file cannot be finished.
    pub fn write_rows(&mut self, rows: &[f32]) -> Result<(), GeoTiffError> {
        let outcome = self.take_rows(rows);
        self.failed |= outcome.is_err();
        outcome
    }

    fn take_rows(&mut self, mut samples: &[f32]) -> Result<(), GeoTiffError> {
        let width = self.cut.width as usize;
        if !samples.len().is_multiple_of(width) {
            return Err(GeoTiffError::PartialRow {
                path: self.path.clone(),
                samples: samples.len(),
                width: self.cut.width,
            });
        }
        self.rows += (samples.len() / width) as u64;
        if self.rows > u64::from(self.cut.height) {
            return Err(self.wrong_rows());
        }
        let batch = self.cut.chunk_height * (BATCH_ROWS / self.cut.chunk_height).max(1);
        let batch = batch as usize * width;
        while !samples.is_empty() {
            let (now, later) = samples.split_at(samples.len().min(batch - self.pending.len()));
            self.pending.extend_from_slice(now);
            samples = later;
            if self.pending.len() == batch {
                self.flush().map_err(|source| self.io(source))?;
            }
        }
        Ok(())
    }

    /// Compresses and writes the rows that wait.
    fn flush(&mut self) -> io::Result<()> {
        let chunks = self.cut.compress(&self.pending, self.spec.compression);
        self.pending.clear();
        for chunk in &chunks {
            self.places.offsets.push(self.end);
            // Chunks are under 1 GiB.
            self.places.counts.push(chunk.len() as u32);
            self.end += chunk.len() as u64;
        }
        self.file.file().write_all(&chunks.concat())
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
        head.extend(self.spec.directory(&self.cut, &self.places).encode(self.format, start, 0));
        let file = self.file.file();
        file.seek(SeekFrom::Start(0))?;
        file.write_all(&head)?;
        self.file.commit()
    }

    fn wrong_rows(&self) -> GeoTiffError {
        let (path, height) = (self.path.clone(), self.cut.height);
        GeoTiffError::Rows { path, written: self.rows, height }
    }

    fn io(&self, source: io::Error) -> GeoTiffError {
        GeoTiffError::Io { path: self.path.clone(), source }
    }
}
