//! Cloud Optimized GeoTIFF of any size, written row by row.

use super::cog::{CogSpec, head};
use super::pyramid::{self, Level};
use super::tags::Format;
use super::{GeoTiffError, GeoTiffSpec};
use crate::batch::AtomicFile;
use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

/// Writes one Cloud Optimized GeoTIFF row by row, north first: the bytes of
/// [`encode_cog`](super::encode_cog), in the memory of some rows of tiles.
///
/// Directories and overviews lie before the full resolution in such a file, and their size is known only at
/// the end. So compressed tiles wait in temporary files without a name in the target's folder, one per
/// resolution, and are copied into place by [`finish`](Self::finish): for that time the disk holds them
/// twice. The target appears when `finish` returns, whole, or never; a killed process leaves nothing but
/// an unfinished `.part` file at worst.
#[derive(Debug)]
pub struct CogWriter {
    spec: CogSpec,
    path: PathBuf,
    file: AtomicFile,
    format: Format,
    levels: Vec<Level<BufWriter<File>>>,
    /// Rows taken so far.
    rows: u64,
    /// Whether a call failed.
    failed: bool,
}

impl CogWriter {
    /// Begins a file; nothing is seen at `path` yet.
    ///
    /// # Errors
    /// [`GeoTiffError::Spec`] for what GeoTIFF cannot hold, [`GeoTiffError::Io`] when the folder cannot be
    /// written.
    pub fn create(path: &Path, spec: &CogSpec) -> Result<Self, GeoTiffError> {
        // A CRS that GeoKeys cannot hold is cited.
        let plain = GeoTiffSpec {
            width: spec.width,
            height: spec.height,
            geotransform: spec.geotransform,
            ..GeoTiffSpec::default()
        };
        plain.check(path)?;
        Self::create_as(path, spec, Format::of_raw(pyramid::raw_bytes(spec.width, spec.height)))
    }

    pub(super) fn create_as(
        path: &Path,
        spec: &CogSpec,
        format: Format,
    ) -> Result<Self, GeoTiffError> {
        let io = |source| GeoTiffError::Io { path: path.to_owned(), source };
        // First, so that a folder that is missing is known before any work.
        let file = AtomicFile::create(path).map_err(io)?;
        // In the same folder, where there is room for the result.
        let folder = file.path().parent().unwrap_or(Path::new("."));
        let spool = || Ok(BufWriter::new(tempfile::tempfile_in(folder)?));
        let levels = pyramid::levels(spec.width, spec.height, spool).map_err(io)?;
        let (spec, path) = (spec.clone(), path.to_owned());
        Ok(Self { spec, path, file, format, levels, rows: 0, failed: false })
    }

    /// Takes the next rows, any number of whole ones, row-major from north to south; NaN is no data.
    ///
    /// # Errors
    /// [`GeoTiffError::PartialRow`], [`GeoTiffError::Rows`] for more rows than the raster has, and
    /// [`GeoTiffError::Io`]. After an error the file cannot be finished.
    pub fn write_rows(&mut self, rows: &[f32]) -> Result<(), GeoTiffError> {
        let outcome = self.take_rows(rows);
        self.failed |= outcome.is_err();
        outcome
    }

    fn take_rows(&mut self, samples: &[f32]) -> Result<(), GeoTiffError> {
        let width = self.spec.width as usize;
        if !samples.len().is_multiple_of(width) {
            let (path, width) = (self.path.clone(), self.spec.width);
            return Err(GeoTiffError::PartialRow { path, samples: samples.len(), width });
        }
        self.rows += (samples.len() / width) as u64;
        if self.rows > u64::from(self.spec.height) {
            return Err(self.wrong_rows());
        }
        pyramid::take_rows(&mut self.levels, samples)
            .map_err(|source| GeoTiffError::Io { path: self.path.clone(), source })
    }

    /// Completes the file and puts it in place. The rename is durable after
    /// [`sync_folder`](crate::batch::sync_folder).
    ///
    /// # Errors
    /// [`GeoTiffError::Rows`] when rows are missing, [`GeoTiffError::Unfinished`] after a failed call,
    /// [`GeoTiffError::Io`]; the target is then as it was.
    pub fn finish(self) -> Result<(), GeoTiffError> {
        if self.failed {
            return Err(GeoTiffError::Unfinished { path: self.path });
        }
        if self.rows != u64::from(self.spec.height) {
            return Err(self.wrong_rows());
        }
        let path = self.path.clone();
        self.complete().map_err(|source| GeoTiffError::Io { path, source })
    }

    fn complete(mut self) -> io::Result<()> {
        pyramid::finish(&mut self.levels)?;
        let head = head(&mut self.levels, &self.spec, self.format);
        self.file.file().write_all(&head)?;
        while let Some(level) = self.levels.pop() {
            let mut spool = level.spool.into_inner().map_err(io::IntoInnerError::into_error)?;
            spool.rewind()?;
            // Dropped after the copy, which gives its space back.
            io::copy(&mut spool, self.file.file())?;
        }
        self.file.commit()
    }

    fn wrong_rows(&self) -> GeoTiffError {
        let (path, height) = (self.path.clone(), self.spec.height);
        GeoTiffError::Rows { path, written: self.rows, height }
    }
}
