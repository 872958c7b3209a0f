//! Rasters: reading lidar tiles block by block, writing npz, GeoTIFF and PNG.

pub mod deflate;
pub mod npz;

use crate::crs::CrsSpec;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Everything that a tile's header says; opening reads no pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RasterHeader {
    /// The file.
    pub path: PathBuf,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixel corner grid in CRS units; files with PixelIsPoint are already shifted by half a pixel.
    pub geotransform: GeoTransform,
    /// The CRS, if the file has one.
    pub crs: Option<CrsSpec>,
    /// Name of the stored sample type, as GDAL calls it: `Byte`, `Int16`, `Float32`, ...
    pub sample_type: String,
    /// The no-data value as declared by the file, if any.
    pub nodata: Option<f64>,
    /// Height = stored * scale + offset.
    pub scale: f64,
    /// See `scale`.
    pub offset: f64,
    /// Vertical unit that the file states, and where it does.
    pub vertical_unit: Option<(LinearUnit, String)>,
    /// Width of the block in which readers hand out samples, pixels.
    pub block_width: u32,
    /// Height of that block.
    pub block_height: u32,
    /// Compression as the file names it (`none`, `deflate`, `lzw`, ...).
    pub compression: String,
    /// Number of overview levels, which are never read.
    pub overviews: u32,
    /// Number of bands; the first is read.
    pub bands: u32,
    /// Whether a mask band marks valid pixels.
    pub has_mask: bool,
    /// Bytes of the file and its modification time (seconds since 1970, nanoseconds).
    pub size_bytes: u64,
    /// See `size_bytes`.
    pub modified: (u64, u32),
    /// Things the user should know (an undeclared no-data value that looks like one, ...).
    pub warnings: Vec<String>,
}

/// How the no-data value is decided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum NodataRule {
    /// The file's own marking; undeclared -9999 and +-3.4e38 count too, with a warning.
    #[default]
    FromFile,
    /// This value instead (`--nodata V`).
    Value(f64),
    /// Every finite sample is valid (`--nodata none`).
    None,
}

/// One open raster, read block by block. Not shared between threads; each thread opens its own.
pub trait RasterReader: Send {
    /// What the header says.
    fn header(&self) -> &RasterHeader;

    /// Reads block (`bx`, `by`) into `out`, row-major, `block_width` samples a row, rows and columns
    /// beyond the raster's edge cut off at the bottom and filled with NaN at the right. Samples are
    /// `stored * scale + offset` in the file's vertical unit, `f32`; NaN is the only no-data value.
    ///
    /// # Errors
    /// [`RasterError`] naming the file and the block.
    fn read_block(&mut self, bx: u32, by: u32, out: &mut Vec<f32>) -> Result<(), RasterError>;
}

/// Why a raster cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no raster, is damaged, or uses something that this build cannot read.
    #[error("{}: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
}
