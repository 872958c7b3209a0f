//! Why a view cannot be made.

use super::Place;
use super::lens::SIZE_LIMITS;
use crate::model::ModelError;

/// An error of a view; each says the value, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewError {
    /// A latitude and longitude on an image whose place is not known.
    #[error(
        "{place}: this image's place on Earth is not known; give a pixel (px:COLUMN,ROW) or metres \
         (m:EAST,NORTH,UP)"
    )]
    NoGeoreference {
        /// The place.
        place: Place,
    },
    /// The image's place cannot be used.
    #[error("{place}: {why}; give a pixel (px:COLUMN,ROW) or metres (m:EAST,NORTH,UP)")]
    Georeference {
        /// The place.
        place: Place,
        /// What is wrong with the image's place.
        why: String,
    },
    /// A pixel or a position on Earth that is not in the image.
    #[error(
        "{place} is not in the image: column {:.1}, row {:.1} of {} x {} pixels",
        pixel[0], pixel[1], size[0], size[1]
    )]
    OutsideImage {
        /// The place.
        place: Place,
        /// Column and row.
        pixel: [f64; 2],
        /// Columns and rows of the image.
        size: [u32; 2],
    },
    /// Metres that say how high, and a height.
    #[error("{place} says how high the camera stands already; leave --height {metres} out")]
    TwoHeights {
        /// The place.
        place: Place,
        /// The height.
        metres: f64,
    },
    /// No surface where a height above it was asked for.
    #[error(
        "no surface {east:.1} m east and {north:.1} m north of the crop's centre; give a place in metres (m:EAST,NORTH,UP)"
    )]
    NoSurface {
        /// Metres from the crop's centre.
        east: f64,
        /// Metres from the crop's centre.
        north: f64,
    },
    /// A camera that looks at the place where it stands.
    #[error("the camera stands at {target}, where it should look; move one of them")]
    SamePlace {
        /// What it looks at.
        target: Place,
    },
    /// A size that is not rendered.
    #[error(
        "a picture of {}x{} pixels; each side can have {} to {}",
        size[0], size[1], SIZE_LIMITS[0], SIZE_LIMITS[1]
    )]
    Size {
        /// Columns and rows.
        size: [u32; 2],
    },
    /// A field of view that no pinhole has.
    #[error("a field of view of {degrees} degrees; 1 to 179 can be rendered")]
    FieldOfView {
        /// The angle.
        degrees: f64,
    },
    /// Intrinsics that are no camera's.
    #[error("intrinsics {fx},{fy},{cx},{cy}: focal lengths are positive, all four are finite")]
    Intrinsics {
        /// Focal length across.
        fx: f64,
        /// Focal length down.
        fy: f64,
        /// Principal column.
        cx: f64,
        /// Principal row.
        cy: f64,
    },
    /// A scene without the light of its street views.
    #[error(
        "these views see the sky, and the scene has none; make the scene again with a street view asked for"
    )]
    NoSky,
    /// Super-resolution was asked for without the network that does it.
    #[error("these views take super-resolution, and no network was given")]
    NoNetwork,
    /// The network failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// An encoder refused.
    #[error("cannot write a {what}: {why}")]
    Encode {
        /// The format.
        what: &'static str,
        /// What it said.
        why: String,
    },
    /// What was rendered could not be handed on.
    #[error("{path}: {source}")]
    Write {
        /// The file.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
}
