//! The one place where images are opened: RGB pixels, and where on Earth they lie.

use crate::footprint::{Footprint, Place};
use crate::grid::{GridError, ImageGrid};
use crate::model::Image8;
use crate::vigor::SatelliteName;
use image::{ImageDecoder, ImageReader};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Zoom of the images that VIGOR names stand for.
const ZOOM: u8 = 20;

/// Why an image cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum InputError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no image, or a damaged one.
    #[error("{}: not a readable image: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Its name states a place where no image can be.
    #[error("{}: {source}", path.display())]
    Grid {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: GridError,
    },
}

/// An open picture.
pub struct Picture {
    path: PathBuf,
    decoder: Box<dyn ImageDecoder>,
    size: [u32; 2],
    place: Option<Place>,
}

/// Opens a picture and reads its header; no pixels are read.
///
/// # Errors
/// [`InputError`].
pub fn open(path: &Path) -> Result<Picture, InputError> {
    let io = |source| InputError::Io { path: path.to_owned(), source };
    let unreadable = |error: image::ImageError| InputError::Unreadable {
        path: path.to_owned(),
        reason: error.to_string(),
    };
    let file = BufReader::new(File::open(path).map_err(io)?);
    let reader = ImageReader::new(file).with_guessed_format().map_err(io)?;
    let decoder = reader.into_decoder().map_err(unreadable)?;
    let (width, height) = decoder.dimensions();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let place = match SatelliteName::parse(&name) {
        Ok(name) => {
            let grid = ImageGrid::new(name.center(), ZOOM, width, height)
                .map_err(|source| InputError::Grid { path: path.to_owned(), source })?;
            Some(Place::WebMercator(grid))
        }
        Err(_) => None,
    };
    Ok(Picture { path: path.to_owned(), decoder: Box::new(decoder), size: [width, height], place })
}

impl Picture {
    /// Where it lies, if that is known.
    pub const fn place(&self) -> Option<&Place> {
        self.place.as_ref()
    }

    /// Place and size on the ground; `gsd_m` overrides what the place says. A picture with neither is
    /// taken to be as wide as those of the training.
    pub fn footprint(&self, gsd_m: Option<[f64; 2]>) -> Footprint {
        let mut footprint = match self.place {
            Some(Place::WebMercator(grid)) => Footprint::of_grid(grid),
            _ => Footprint::of_training(self.size),
        };
        if let Some(gsd_m) = gsd_m {
            footprint.gsd_m = gsd_m;
        }
        footprint
    }

    /// Reads the pixels: RGB, alpha dropped, 16 bits scaled to 8.
    ///
    /// # Errors
    /// [`InputError::Unreadable`].
    pub fn read(self) -> Result<Image8, InputError> {
        let unreadable =
            |reason: String| InputError::Unreadable { path: self.path.clone(), reason };
        let image = image::DynamicImage::from_decoder(self.decoder)
            .map_err(|error| unreadable(error.to_string()))?
            .into_rgb8();
        let [width, height] = self.size.map(|side| side as usize);
        Image8::new(width, height, 3, image.into_raw())
            .map_err(|error| InputError::Unreadable { path: self.path, reason: error.to_string() })
    }
}
