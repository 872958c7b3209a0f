//! Why a scene cannot be read or made.

use crate::crs::CrsError;
use crate::grid::GridError;
use crate::raster::geotiff::GeoTiffError;
use std::path::PathBuf;

/// Why a scene cannot be read or made; each variant names the file or the key and the value.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The scene file is no TOML, has an unknown key, or a value of the wrong type.
    #[error("{}: {reason}", path.display())]
    Toml {
        /// The scene file.
        path: PathBuf,
        /// The parser's words, with line, column and the keys that exist.
        reason: String,
    },
    /// A value that makes no sense.
    #[error("{}: {key} = {value}: {reason}", path.display())]
    Value {
        /// The scene file.
        path: PathBuf,
        /// The key with its table, for example `sun.elevation_degrees`.
        key: String,
        /// The value found.
        value: String,
        /// What is wrong and what to do.
        reason: String,
    },
    /// No image fits into the scene.
    #[error(
        "no satellite image of {size} pixels ({metres:.0} m) fits into a scene of {width} x {height} m; make [extent] larger or [images] size_pixels smaller"
    )]
    NoImage {
        /// Side of an image, pixels.
        size: u32,
        /// Side of an image on the ground, metres.
        metres: f64,
        /// Width of the scene, metres.
        width: f64,
        /// Height of the scene, metres.
        height: f64,
    },
    /// The picture of the whole extent does not fit, or has no pixel.
    #[error(
        "a picture of {picture_width:.1} x {picture_height:.1} m does not fit upright into a scene of {width} x {height} m whose grid is turned by {turn_degrees:.2} degrees; make [extent] larger, or width_metres, height_metres and the pixels of [picture] smaller"
    )]
    NoPicture {
        /// Width of the picture, metres; of one without a given width, the least there can be.
        picture_width: f64,
        /// Height of the picture, metres.
        picture_height: f64,
        /// Width of the scene, metres.
        width: f64,
        /// Height of the scene, metres.
        height: f64,
        /// Angle from the scene's north to true north, degrees.
        turn_degrees: f64,
    },
    /// A position cannot be projected.
    #[error(transparent)]
    Crs(#[from] CrsError),
    /// An image grid cannot exist.
    #[error(transparent)]
    Grid(#[from] GridError),
    /// A lidar tile cannot be written.
    #[error(transparent)]
    GeoTiff(#[from] GeoTiffError),
    /// A picture cannot be encoded.
    #[error("{}: {reason}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// Ctrl-C; nothing half-written is left behind.
    #[error("interrupted; a second run writes everything again")]
    Interrupted,
}
