//! Rasters of any size, row by row.

use super::block::{self, Window};
use super::georeference;
use super::tags::{Directory, Flavour};
use super::{GeoTiffError, GeoTiffSpec, Image, Layout, Sample, SampleType};
use crate::batch::AtomicFile;
use rayon::prelude::*;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Writes a GeoTIFF row by row, holding one row of blocks in memory. The file appears whole when it
/// is [finished](Self::finish); dropped before, it leaves nothing.
///
/// The bytes depend on the specification and the samples alone, not on how many rows come at a time
/// nor on threads.
///
/// ```no_run
/// use sat3d::raster::geotiff::{GeoTiffSpec, GeoTiffWriter};
/// let spec = GeoTiffSpec { width: 4, height: 2, nodata: Some(-9999.0), ..Default::default() };
/// let mut writer = GeoTiffWriter::create("x.tif".as_ref(), &spec)?;
/// writer.write_rows(&[1.0_f32, 2.0, f32::NAN, 4.0])?;
/// writer.write_rows(&[5.0_f32, 6.0, 7.0, 8.0])?;
/// writer.finish()?;
/// # Ok::<(), sat3d::raster::geotiff::GeoTiffError>(())
/// ```
#[derive(Debug)]
pub struct GeoTiffWriter<T: Sample = f32> {
    path: PathBuf,
    spec: GeoTiffSpec,
    flavour: Flavour,
    file: AtomicFile,
    /// Rows that do not fill a row of blocks yet.
    pending: Vec<T>,
    /// Rows given so far.
    rows: u64,
    /// Where the next block goes.
    at: u64,
    offsets: Vec<u64>,
    sizes: Vec<u64>,
}

impl<T: Sample> GeoTiffWriter<T> {
    /// Opens a temporary file beside `path`; the folder must exist.
    ///
    /// # Errors
    /// [`GeoTiffError::Spec`] where the specification describes no file, [`GeoTiffError::Io`] where
    /// the folder cannot be written to.
    pub fn create(path: &Path, spec: &GeoTiffSpec) -> Result<Self, GeoTiffError> {
        check(spec, T::TYPE)
            .map_err(|reason| GeoTiffError::Spec { path: path.to_owned(), reason })?;
        let (block_width, block_height) = spec.block();
        let blocks = u64::from(spec.width.div_ceil(block_width))
            * u64::from(spec.height.div_ceil(block_height));
        Self::start(path, spec, blocks, flavour_for(spec, T::TYPE, blocks))
    }

    fn start(
        path: &Path,
        spec: &GeoTiffSpec,
        blocks: u64,
        flavour: Flavour,
    ) -> Result<Self, GeoTiffError> {
        let file = AtomicFile::create(path)
            .map_err(|source| GeoTiffError::Io { path: path.to_owned(), source })?;
        let mut writer = Self {
            path: path.to_owned(),
            spec: spec.clone(),
            flavour,
            file,
            pending: Vec::new(),
            rows: 0,
            at: 0,
            offsets: vec![0; blocks as usize],
            sizes: vec![0; blocks as usize],
        };
        // The directory goes to the front: its length is known, its content when all is written.
        let header = flavour.header(DIRECTORY_AT);
        writer.at = DIRECTORY_AT + writer.directory().byte_len(flavour);
        let mut front = header;
        front.resize(writer.at as usize, 0);
        writer.io(|file| file.write_all(&front))?;
        writer.offsets.clear();
        writer.sizes.clear();
        Ok(writer)
    }

    /// Starts again as BigTIFF, which `create` chooses only for files that no test can write.
    #[cfg(test)]
    pub(super) fn make_big(&mut self) -> Result<(), GeoTiffError> {
        let (width, height) = self.spec.block();
        let blocks = self.spec.width.div_ceil(width) * self.spec.height.div_ceil(height);
        *self = Self::start(&self.path, &self.spec, u64::from(blocks), Flavour::Big)?;
        Ok(())
    }

    /// Appends any number of whole rows, row-major from the north, bands of a pixel together.
    ///
    /// # Errors
    /// [`GeoTiffError::Rows`] where the samples are no whole rows or more than the height,
    /// [`GeoTiffError::Io`] where the disk is full or gone.
    pub fn write_rows(&mut self, rows: &[T]) -> Result<(), GeoTiffError> {
        let line = self.spec.width as usize * usize::from(self.spec.bands);
        if !rows.len().is_multiple_of(line) {
            return Err(self.rows_error(format!("{} samples are no rows of {line}", rows.len())));
        }
        let total = self.rows + (rows.len() / line) as u64;
        if total > u64::from(self.spec.height) {
            return Err(self.rows_error(format!("{total} rows for a height of {}", self.spec.height)));
        }
        self.rows = total;
        let stripe = line * self.spec.block().1 as usize;
        let mut rest = rows;
        while !rest.is_empty() {
            // Whole rows of blocks are packed where they are, without a copy.
            if self.pending.is_empty() && rest.len() >= stripe {
                let (now, later) = rest.split_at(stripe);
                self.write_blocks(now)?;
                rest = later;
                continue;
            }
            let (now, later) = rest.split_at(rest.len().min(stripe - self.pending.len()));
            self.pending.extend_from_slice(now);
            rest = later;
            if self.pending.len() == stripe {
                self.write_pending()?;
            }
        }
        Ok(())
    }

    /// Completes the file: it appears under its name, flushed to disk.
    ///
    /// # Errors
    /// [`GeoTiffError::Rows`] where rows are missing, [`GeoTiffError::Io`] as above; no file appears
    /// then.
    pub fn finish(mut self) -> Result<(), GeoTiffError> {
        if self.rows < u64::from(self.spec.height) {
            let reason = format!("{} of {} rows were written", self.rows, self.spec.height);
            return Err(self.rows_error(reason));
        }
        if !self.pending.is_empty() {
            self.write_pending()?;
        }
        let mut bytes = Vec::new();
        self.directory().append(self.flavour, DIRECTORY_AT, 0, &mut bytes);
        self.io(|file| {
            file.seek(SeekFrom::Start(DIRECTORY_AT))?;
            file.write_all(&bytes)
        })?;
        let Self { file, path, .. } = self;
        file.commit().map_err(|source| GeoTiffError::Io { path, source })
    }

    fn write_pending(&mut self) -> Result<(), GeoTiffError> {
        let rows = std::mem::take(&mut self.pending);
        self.write_blocks(&rows)?;
        self.pending = rows;
        self.pending.clear();
        Ok(())
    }

    /// Packs one row of blocks in parallel and writes them in order.
    fn write_blocks(&mut self, rows: &[T]) -> Result<(), GeoTiffError> {
        let (width, bands) = (self.spec.width as usize, usize::from(self.spec.bands));
        let (block_width, block_height) = self.spec.block();
        let (block_width, block_height) = (block_width as usize, block_height as usize);
        // The last strip has the rows that are left, tiles are always whole.
        let height = match self.spec.layout {
            Layout::Tiles(_) => block_height,
            Layout::Strips(_) => rows.len() / (width * bands),
        };
        let (nodata, compression) = (self.spec.nodata, self.spec.compression);
        let blocks: Vec<Vec<u8>> = (0..width.div_ceil(block_width))
            .into_par_iter()
            .map(|n| {
                let window = Window { column: n * block_width, row: 0, width: block_width, height };
                block::encode(rows, width, bands, window, nodata, compression)
            })
            .collect();
        for block in blocks {
            self.io(|file| file.write_all(&block))?;
            self.offsets.push(self.at);
            self.sizes.push(block.len() as u64);
            self.at += block.len() as u64;
        }
        Ok(())
    }

    fn directory(&self) -> Directory {
        let spec = &self.spec;
        let image = Image {
            width: spec.width,
            height: spec.height,
            bands: spec.bands,
            sample: T::TYPE,
            compression: spec.compression,
            layout: spec.layout,
        };
        let mut directory = image.directory(self.offsets.clone(), self.sizes.clone());
        georeference::set_georeference(&mut directory, &spec.geotransform, &spec.crs_keys());
        georeference::set_metadata(&mut directory, &spec.metadata, spec.unit, spec.bands);
        if let Some(nodata) = spec.nodata {
            georeference::set_nodata(&mut directory, nodata);
        }
        directory
    }

    fn io<R>(
        &mut self,
        action: impl FnOnce(&mut std::fs::File) -> std::io::Result<R>,
    ) -> Result<R, GeoTiffError> {
        action(self.file.file())
            .map_err(|source| GeoTiffError::Io { path: self.path.clone(), source })
    }

    fn rows_error(&self, reason: String) -> GeoTiffError {
        GeoTiffError::Rows { path: self.path.clone(), reason }
    }
}

/// The directory follows the header: 8 bytes of a classic TIFF, 16 of a BigTIFF.
const DIRECTORY_AT: u64 = 16;

/// BigTIFF where the file could pass 4 GB, however badly the samples compress.
pub(super) fn flavour_for(spec: &GeoTiffSpec, sample: SampleType, blocks: u64) -> Flavour {
    let (width, height) = spec.block();
    let block = u64::from(width)
        * u64::from(height)
        * u64::from(spec.bands)
        * u64::from(sample.bits() / 8);
    // Stored DEFLATE blocks add less than one byte in a thousand and 64 per tile; offsets and sizes 16.
    let most = blocks.saturating_mul(block + block / 1000 + 80);
    // A mebibyte for everything else.
    if most.saturating_add(1 << 20) > u64::from(u32::MAX) { Flavour::Big } else { Flavour::Classic }
}

fn check(spec: &GeoTiffSpec, sample: SampleType) -> Result<(), String> {
    let GeoTiffSpec { width, height, bands, .. } = *spec;
    if width == 0 || height == 0 || bands == 0 {
        return Err(format!("{width} x {height} pixels of {bands} bands are no raster"));
    }
    match spec.layout {
        Layout::Tiles(size) if size == 0 || !size.is_multiple_of(16) => {
            return Err(format!("tiles of {size} pixels: TIFF wants a multiple of 16"));
        }
        Layout::Strips(0) => return Err("strips of no rows".to_owned()),
        _ => {}
    }
    for code in [Some(spec.epsg), spec.vertical_epsg].into_iter().flatten() {
        // 0 is undefined, 32767 user-defined.
        if !(1..32_767).contains(&code) {
            return Err(format!("EPSG:{code} does not fit into a GeoTIFF (1 to 32766)"));
        }
    }
    if !spec.geotransform.0.iter().all(|c| c.is_finite()) {
        return Err(format!("the grid {:?} is not finite", spec.geotransform.0));
    }
    if sample == SampleType::F32
        && let Some(nodata) = spec.nodata
        && nodata.is_finite()
        && f64::from(nodata as f32) != nodata
    {
        return Err(format!(
            "the no-data value {nodata} is no 32-bit float; use {}",
            f64::from(nodata as f32)
        ));
    }
    Ok(())
}
