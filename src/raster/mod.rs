//! Rasters: reading lidar tiles block by block, writing npz, GeoTIFF and PNG.
//!
//! Reading has two backends that give the same header and the same samples, bit for bit, on every
//! file that both can read: `GdalReader` (feature `gdal`: whatever GDAL reads, VRT included) and
//! [`TiffReader`] (pure Rust: GeoTIFF). [`open`] takes the one that the build has.

pub mod colour;
#[cfg(feature = "gdal")]
mod gdal_colours;
#[cfg(feature = "gdal")]
mod gdal_reader;
#[cfg(feature = "gdal")]
mod gdal_setup;
pub mod geotiff;
mod header;
mod list;
pub mod palette;
pub mod preview;
mod sample;
mod tiff_codec;
mod tiff_colours;
mod tiff_directory;
mod tiff_reader;
mod vertical_unit;

#[cfg(feature = "gdal")]
pub use gdal_reader::GdalReader;
pub use list::list_tiles;
pub use sample::UndeclaredNodata;
pub use tiff_reader::TiffReader;
pub(crate) use tiff_reader::{beside, world_file};

#[cfg(feature = "gdal")]
pub(crate) use gdal_colours::GdalColours;
#[cfg(feature = "gdal")]
pub(crate) use gdal_setup::limit_gdal_cache;
pub(crate) use header::Rectangle;
pub(crate) use tiff_colours::TiffColours;

pub mod deflate;
pub mod npz;

use crate::crs::CrsSpec;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

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

/// How a raster is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OpenOptions {
    /// How the no-data value is decided.
    pub nodata: NodataRule,
    /// Most bytes that reading one block may take (its stored samples and its heights). A raster
    /// with larger strips or tiles is refused by name.
    pub memory_limit: usize,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self { nodata: NodataRule::FromFile, memory_limit: 256 << 20 }
    }
}

/// Opens a raster with the build's backend and reads its header; no pixels are read.
///
/// # Errors
/// [`RasterError`] when the file cannot be opened, is no raster, or has blocks beyond
/// [`OpenOptions::memory_limit`]. A raster that opens need not be usable as a tile: see
/// [`RasterHeader::check_usable`].
pub fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn RasterReader>, RasterError> {
    #[cfg(feature = "gdal")]
    let reader = GdalReader::open(path, options)?;
    #[cfg(not(feature = "gdal"))]
    let reader = TiffReader::open(path, options)?;
    Ok(Box::new(reader))
}

/// How the no-data value is decided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum NodataRule {
    /// The file's own marking (value, mask, alpha band). Undeclared -9999, -32768 (in `Int16`) and
    /// anything beyond 1e38 count too, with a warning; the first two only where scale and offset do
    /// nothing, because a stored -9999 can be a height of -99.99 otherwise.
    #[default]
    FromFile,
    /// This value instead (`--nodata V`), in the raster's stored units; beside it only samples
    /// beyond 1e38 are no data.
    Value(f64),
    /// Every finite sample is valid (`--nodata none`), masked ones too.
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

    /// The values that no one declared as no-data and that the blocks read so far held.
    fn undeclared_nodata(&self) -> UndeclaredNodata;
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
    /// A block is damaged or missing.
    #[error("{}: block ({column}, {row}) cannot be read: {reason}", path.display())]
    Block {
        /// The file.
        path: PathBuf,
        /// The block's place in a row of blocks.
        column: u32,
        /// The row of blocks.
        row: u32,
        /// What is wrong.
        reason: String,
    },
    /// A strip or tile does not fit into the memory given.
    #[error(
        "{}: one {what} takes {bytes} bytes to read, and {limit} are allowed; allow more memory, \
         or rewrite the file in tiles (gdal_translate -co TILED=YES -co COMPRESS=DEFLATE in.tif out.tif)",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The strip or tile, in words.
        what: String,
        /// What reading it takes.
        bytes: u64,
        /// What is allowed.
        limit: u64,
    },
    /// The file is a sound raster that cannot serve as a tile.
    #[error("{}: {reason}", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// Why, and what to do.
        reason: String,
    },
    /// There is nothing to read.
    #[error("{}: {reason}", path.display())]
    NoTiles {
        /// The folder or file asked for.
        path: PathBuf,
        /// What was looked for.
        reason: String,
    },
}
