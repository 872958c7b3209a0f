//! Writing GeoTIFF in pure Rust: [`GeoTiffWriter`] streams rasters of any size into a file,
//! [`CogWriter`] does so as Cloud Optimized GeoTIFF, [`encode_cog`] makes one in memory. One band of
//! 32-bit floats; the same bytes on every machine and for any number of threads. [`RgbWriter`] streams
//! pictures in the same way. See `docs/formats.md`.

mod cog;
mod cog_writer;
mod geographic;
mod geokeys;
mod predictor;
mod pyramid;
mod rgb;
mod tags;
mod tiles;
mod writer;

#[cfg(test)]
mod cog_tests;
#[cfg(test)]
mod tests;

pub use cog::{CogSpec, encode_cog};
pub use cog_writer::CogWriter;
pub use predictor::Compression;
pub use rgb::RgbWriter;
pub use writer::{GeoTiffSpec, GeoTiffWriter, Layout};

use crate::units::LinearUnit;
use std::path::PathBuf;

/// Why a GeoTIFF cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum GeoTiffError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The specification describes no raster.
    #[error("{}: cannot be written as GeoTIFF: {item} is {value}, and {rule}", path.display())]
    Spec {
        /// The file.
        path: PathBuf,
        /// The field of the specification.
        item: &'static str,
        /// What it says.
        value: String,
        /// What it has to be.
        rule: &'static str,
    },
    /// The samples given are not whole rows.
    #[error("{}: {samples} samples are no whole rows of {width}", path.display())]
    PartialRow {
        /// The file.
        path: PathBuf,
        /// Samples in the call.
        samples: usize,
        /// Samples of a row.
        width: u32,
    },
    /// More or fewer rows were written than the raster has.
    #[error("{}: {written} rows were written of {height}; no file was made", path.display())]
    Rows {
        /// The file.
        path: PathBuf,
        /// Rows given, those refused included.
        written: u64,
        /// Rows of the raster.
        height: u32,
    },
    /// An earlier call failed, and the file cannot be finished.
    #[error("{}: an earlier write failed; no file was made", path.display())]
    Unfinished {
        /// The file.
        path: PathBuf,
    },
}

/// How GDAL's band metadata calls a unit of heights. A bare `foot` is read as the foot of the
/// horizontal CRS by some, so the international foot says its whole name.
const fn unit_name(unit: LinearUnit) -> &'static str {
    match unit {
        LinearUnit::Metre => "metre",
        LinearUnit::Foot => "international foot",
        LinearUnit::UsSurveyFoot => "US survey foot",
    }
}
