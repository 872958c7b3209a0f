//! Writing GeoTIFF: a Cloud Optimized GeoTIFF of one grid in memory ([`encode_cog`]), and rasters of
//! any size row by row ([`GeoTiffWriter`]).
//!
//! Pure Rust and the same bytes in every build, for any number of threads. References: TIFF 6.0,
//! its technical note 3 (floating-point predictor), BigTIFF, OGC 19-008r4 (GeoTIFF 1.1) and GDAL's
//! description of its COG layout.

mod block;
mod cog;
mod georeference;
mod tags;
mod writer;

pub use block::{Sample, SampleType};
pub use cog::{CogSpec, encode_cog};
pub use writer::GeoTiffWriter;

use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use georeference::CrsKeys;
use std::path::PathBuf;
use tags::{
    BITS_PER_SAMPLE, COMPRESSION, Directory, IMAGE_LENGTH, IMAGE_WIDTH, PHOTOMETRIC,
    PLANAR_CONFIGURATION, PREDICTOR, ROWS_PER_STRIP, SAMPLE_FORMAT, SAMPLES_PER_PIXEL,
    STRIP_BYTE_COUNTS, STRIP_OFFSETS, TILE_BYTE_COUNTS, TILE_LENGTH, TILE_OFFSETS, TILE_WIDTH,
    Value,
};

/// How samples are packed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TiffCompression {
    /// Not at all, for readers that map files into memory.
    None,
    /// DEFLATE after predictor 3 (floats) or 2 (integers).
    #[default]
    Deflate,
}

/// How a raster is cut into blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Square tiles of this many pixels, a multiple of 16.
    Tiles(u32),
    /// Strips of this many rows.
    Strips(u32),
}

impl Default for Layout {
    fn default() -> Self {
        Self::Tiles(256)
    }
}

/// What a GeoTIFF file shall be.
#[derive(Clone, Debug, PartialEq)]
pub struct GeoTiffSpec {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bands, pixel-interleaved; three bands of bytes are marked as RGB.
    pub bands: u16,
    /// The pixel corner grid in CRS units (PixelIsArea).
    pub geotransform: GeoTransform,
    /// EPSG code of the horizontal CRS.
    pub epsg: u32,
    /// Whether `epsg` is a geographic CRS (axes in degrees).
    pub geographic: bool,
    /// Unit of the axes, written beside the code of a projected CRS where given.
    pub linear_unit: Option<LinearUnit>,
    /// EPSG code of the vertical CRS, which makes the CRS a compound one.
    pub vertical_epsg: Option<u32>,
    /// Sample that marks no data; NaN samples are written as this. For integers it is declared only.
    pub nodata: Option<f64>,
    /// Unit of the samples.
    pub unit: Option<LinearUnit>,
    /// Tiles or strips.
    pub layout: Layout,
    /// How they are packed.
    pub compression: TiffCompression,
    /// Free metadata; GDAL's `TIFFTAG_SOFTWARE` and its like become TIFF's own tags.
    pub metadata: Vec<(String, String)>,
}

impl Default for GeoTiffSpec {
    fn default() -> Self {
        Self {
            width: 0,
            height: 0,
            bands: 1,
            geotransform: GeoTransform::north_up(0.0, 0.0, 1.0, 1.0),
            epsg: 3857,
            geographic: false,
            linear_unit: None,
            vertical_epsg: None,
            nodata: None,
            unit: None,
            layout: Layout::default(),
            compression: TiffCompression::default(),
            metadata: Vec::new(),
        }
    }
}

/// Why a GeoTIFF cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum GeoTiffError {
    /// The operating system refused.
    #[error("{}: cannot write: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The specification describes no possible file.
    #[error("{}: {reason}", path.display())]
    Spec {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The rows given are not those of the specification.
    #[error("{}: {reason}", path.display())]
    Rows {
        /// The file.
        path: PathBuf,
        /// What is wrong with them.
        reason: String,
    },
}

impl GeoTiffSpec {
    /// Width and height of a block, pixels.
    const fn block(&self) -> (u32, u32) {
        match self.layout {
            Layout::Tiles(size) => (size, size),
            Layout::Strips(rows) => (self.width, rows),
        }
    }

    const fn crs_keys(&self) -> CrsKeys {
        CrsKeys {
            epsg: self.epsg,
            geographic: self.geographic,
            linear_unit: self.linear_unit,
            vertical_epsg: self.vertical_epsg,
            vertical_unit: self.unit,
        }
    }
}

/// Shape and packing of one image of a file.
#[derive(Clone, Copy, Debug)]
struct Image {
    width: u32,
    height: u32,
    bands: u16,
    sample: SampleType,
    compression: TiffCompression,
    layout: Layout,
}

impl Image {
    /// The directory of an image whose blocks lie at `offsets` and have `sizes` bytes.
    fn directory(&self, offsets: Vec<u64>, sizes: Vec<u64>) -> Directory {
        let mut directory = Directory::default();
        let rgb = self.bands == 3 && self.sample == SampleType::U8;
        let per_band = |value: u16| Value::Short(vec![value; usize::from(self.bands)]);
        directory.set(IMAGE_WIDTH, Value::long(self.width));
        directory.set(IMAGE_LENGTH, Value::long(self.height));
        directory.set(BITS_PER_SAMPLE, per_band(self.sample.bits()));
        directory.set(PHOTOMETRIC, Value::short(if rgb { 2 } else { 1 }));
        directory.set(SAMPLES_PER_PIXEL, Value::short(self.bands));
        directory.set(PLANAR_CONFIGURATION, Value::short(1));
        directory.set(SAMPLE_FORMAT, per_band(self.sample.format()));
        let grey = if rgb { 3 } else { 1 };
        if self.bands > grey {
            // ExtraSamples: unspecified.
            directory.set(338, Value::Short(vec![0; usize::from(self.bands - grey)]));
        }
        match self.compression {
            TiffCompression::None => directory.set(COMPRESSION, Value::short(1)),
            TiffCompression::Deflate => {
                directory.set(COMPRESSION, Value::short(8));
                directory.set(PREDICTOR, Value::short(self.sample.predictor()));
            }
        }
        match self.layout {
            Layout::Tiles(size) => {
                directory.set(TILE_WIDTH, Value::long(size));
                directory.set(TILE_LENGTH, Value::long(size));
                directory.set(TILE_OFFSETS, Value::Words(offsets));
                directory.set(TILE_BYTE_COUNTS, Value::Words(sizes));
            }
            Layout::Strips(rows) => {
                directory.set(ROWS_PER_STRIP, Value::long(rows));
                directory.set(STRIP_OFFSETS, Value::Words(offsets));
                directory.set(STRIP_BYTE_COUNTS, Value::Words(sizes));
            }
        }
        directory
    }
}

#[cfg(test)]
mod tests;
