//! Reading predictions and ground truths: metres, on the same kind of grid, whatever the file.
//!
//! | file | prediction | ground truth |
//! |---|---|---|
//! | npz | `dsm`: metres; else `arr_0`: height in the scene cube, [0, 1], times metres per unit | `dsm`: metres; `dtm`: bare earth |
//! | npy | metres, or height in the scene cube with `--metres-per-unit` | metres |
//! | raster | metres (feet are converted), on the grid that the name implies | the same |
//!
//! The name `satellite_<lat>_<lon>` implies the Web-Mercator image grid at `--zoom`. Files without
//! such a name are laid over each other by their georeference, else by their pixels.

mod arrays;
mod demands;
mod pairs;
mod rasters;

pub use demands::{Demands, demands};
pub use pairs::{Pair, pair};

use super::surface::Surface;
use crate::crs::CrsError;
use crate::grid::{GridError, ImageGrid, LonLat};
use crate::raster::RasterError;
use crate::raster::npz::NpzError;
use crate::vigor::SatelliteName;
use std::path::{Path, PathBuf};

/// Metres per unit of the published scoring: the image's width on the ground in Seattle.
pub const PAPER_METRES_PER_UNIT: f64 = 64.48;

/// How files are read.
#[derive(Clone, Debug, PartialEq)]
pub struct InputSettings {
    /// Metres of one unit of `arr_0`, over what the file says.
    pub metres_per_unit: Option<f64>,
    /// Zoom level of the images that names stand for.
    pub zoom: u8,
    /// Pixels across and down of those images, where the truth is a raster that does not say it.
    pub size: u32,
    /// Ground sample distance of the truth, metres, where neither name nor georeference says it.
    pub gsd_m: Option<f64>,
}

impl Default for InputSettings {
    fn default() -> Self {
        Self { metres_per_unit: None, zoom: 20, size: 640, gsd_m: None }
    }
}

/// Where a surface lies.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// The image grid that the name implies, with as many pixels as the truth has.
    pub grid: Option<ImageGrid>,
    /// Centre, where known.
    pub center: Option<LonLat>,
    /// Pixel of the truth on the ground, metres east-west and north-south, where known.
    pub pixel_m: Option<(f64, f64)>,
    /// Georeference of a truth whose name implies no grid.
    pub frame: Option<rasters::Frame>,
}

/// A ground truth as read.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Heights, metres.
    pub surface: Surface,
    /// Bare earth on the same grid, metres.
    pub ground: Option<Surface>,
    /// Where it lies.
    pub place: Place,
    /// What a reader should know.
    pub notes: Vec<String>,
}

/// A prediction as read.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// Heights, metres above an arbitrary zero.
    pub surface: Surface,
    /// What a reader should know.
    pub notes: Vec<String>,
}

/// Why a file, or a folder, gives nothing to score.
#[derive(Debug, thiserror::Error)]
pub enum InputError {
    /// A folder cannot be listed.
    #[error("cannot read {}: {source}; --pred and --gt take folders or files", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder holds nothing that could be scored.
    #[error("{}: no file that could be scored (*.{kinds})", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
        /// The file endings looked for.
        kinds: String,
    },
    /// An array file cannot be read.
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// A raster cannot be read.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A raster's CRS cannot be served.
    #[error("{}: {source}", path.display())]
    Crs {
        /// The raster.
        path: PathBuf,
        /// Why.
        source: CrsError,
    },
    /// A raster cannot be brought onto the grid.
    #[error("{}: {reason}", path.display())]
    Warp {
        /// The raster.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A name implies a grid that does not exist.
    #[error(transparent)]
    Grid(#[from] GridError),
    /// What the file holds is no surface that could be scored.
    #[error("{}: {reason}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
}

impl InputError {
    pub(super) fn content(path: &Path, reason: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), reason: reason.into() }
    }

    /// The cause without the file, so that a thousand files with one fault make one line.
    #[must_use]
    pub fn kind(&self) -> String {
        match self {
            Self::Folder { .. } => "a folder cannot be read".into(),
            Self::Empty { .. } => "an empty folder".into(),
            Self::Npz(NpzError::Io { source, .. }) => format!("cannot be read: {source}"),
            Self::Npz(NpzError::Damaged { .. }) => "a damaged npz or npy file".into(),
            Self::Npz(NpzError::Array { name, .. }) => format!("array `{name}` cannot be read"),
            Self::Npz(NpzError::Missing { name, .. }) => format!("no array `{name}`"),
            Self::Raster(_) => "a raster that cannot be read".into(),
            Self::Crs { .. } => "a raster whose CRS cannot be served".into(),
            Self::Warp { .. } => "a raster that cannot be brought onto the image's grid".into(),
            Self::Grid(_) => "a name that implies no grid".into(),
            Self::Content { reason, .. } => reason.clone(),
        }
    }
}

/// Reads the ground truth of an image.
///
/// # Errors
/// [`InputError`] naming the file.
pub fn read_truth(name: &str, path: &Path, settings: &InputSettings) -> Result<Truth, InputError> {
    let center = SatelliteName::parse(name).ok().map(|name| name.center());
    let mut truth = if is_array(path) {
        arrays::truth(path)?
    } else {
        match center {
            Some(center) => {
                let grid = ImageGrid::new(center, settings.zoom, settings.size, settings.size)?;
                let surface = rasters::on_image_grid(path, &grid)?;
                Truth { surface, ground: None, place: Place::unknown(), notes: Vec::new() }
            }
            None => rasters::truth(path)?,
        }
    };
    if let Some(center) = center {
        let (width, height) = truth.surface.size();
        let grid = ImageGrid::new(center, settings.zoom, width as u32, height as u32)?;
        let pixel = grid.ground_sample_distance();
        truth.place = Place {
            grid: Some(grid),
            center: Some(center),
            pixel_m: Some((pixel, pixel)),
            frame: None,
        };
    }
    if let (None, Some(gsd)) = (truth.place.pixel_m, settings.gsd_m) {
        truth.place.pixel_m = Some((gsd, gsd));
    }
    clean(&mut truth.surface, path, &mut truth.notes)?;
    if let Some(ground) = &mut truth.ground {
        drop_infinities(ground);
    }
    Ok(truth)
}

/// Reads a prediction for a ground truth that was read.
///
/// # Errors
/// [`InputError`] naming the file.
pub fn read_prediction(
    path: &Path,
    truth: &Truth,
    settings: &InputSettings,
) -> Result<Prediction, InputError> {
    let mut prediction = if is_array(path) {
        arrays::prediction(path, settings)?
    } else if let Some(grid) = &truth.place.grid {
        let surface = rasters::on_image_grid(path, grid)?;
        Prediction { surface, notes: Vec::new() }
    } else {
        rasters::prediction(path, truth)?
    };
    clean(&mut prediction.surface, path, &mut prediction.notes)?;
    let (width, height) = prediction.surface.size();
    let (truth_width, truth_height) = truth.surface.size();
    // A pixel more or less on a side is what rounding a size does; more is another footprint.
    let skew = width as f64 * truth_height as f64 / (height as f64 * truth_width as f64);
    if (skew - 1.0).abs() > 0.01 {
        return Err(InputError::content(
            path,
            format!(
                "{width} x {height} pixels cannot be laid over a ground truth of {truth_width} x {truth_height}: the sides are in another proportion"
            ),
        ));
    }
    Ok(prediction)
}

impl Place {
    pub(super) const fn unknown() -> Self {
        Self { grid: None, center: None, pixel_m: None, frame: None }
    }
}

fn is_array(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz") || e.eq_ignore_ascii_case("npy"))
}

/// Infinities become no data, with a note; a surface without any height is refused.
fn clean(surface: &mut Surface, path: &Path, notes: &mut Vec<String>) -> Result<(), InputError> {
    let infinite = drop_infinities(surface);
    if infinite > 0 {
        notes.push(format!("{infinite} infinite heights taken as no data"));
    }
    if surface.values.iter().all(|v| v.is_nan()) {
        return Err(InputError::content(path, "no pixel has a height"));
    }
    Ok(())
}

fn drop_infinities(surface: &mut Surface) -> usize {
    let mut infinite = 0;
    for value in &mut surface.values {
        if value.is_infinite() {
            *value = f32::NAN;
            infinite += 1;
        }
    }
    infinite
}
