//! Where the light of a street view comes from: a panorama with its sky mask, a stored histogram, or a name.
//!
//! The network knows the light as a histogram of the sky's colours (MODEL_SPEC section 9.3). There is always one:
//! where nothing is said it is the sky called [`DEFAULT`], and [`Illumination::origin`] says so.

mod named;
mod panorama;

pub use named::{DEFAULT, NAMES};

use crate::model::illumination::HISTOGRAM_LEN;
use crate::model::render::padded_width;
use crate::model::scene::SkyParts;
use crate::model::{Grid, ModelError, Network};
use crate::plan::hex;
use crate::raster::npz::{self, NpzError};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Channels of a histogram, and the bins of each.
const CHANNELS: usize = 3;
const BINS: usize = HISTOGRAM_LEN / CHANNELS;
/// How far a channel's shares may be from a sum of 1: 90 of them, each rounded to `f32`, or written with a few
/// digits.
const SUM_TOLERANCE: f64 = 1e-3;

/// The illumination input of the network, with where it came from.
#[derive(Clone, Debug, PartialEq)]
pub struct Illumination {
    /// What the manifest says: a name of the bundled set, or the files.
    pub origin: String,
    /// 270 values; see [`crate::model::illumination::sky_histogram`].
    pub histogram: Vec<f32>,
}

/// Why there is no light.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IlluminationError {
    /// A picture that cannot be read.
    #[error("{}: {source}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: image::ImageError,
    },
    /// A histogram's file that cannot be read.
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// Values that are no histogram.
    #[error("{origin}: {why}")]
    Histogram {
        /// The file and row.
        origin: String,
        /// What is wrong, with the value.
        why: String,
    },
    /// A mask that marks no sky, or only black one.
    #[error(
        "{}: the mask {} leaves no sky that is brighter than a tenth; white in the mask is sky",
        panorama.display(), mask.display()
    )]
    NoSky {
        /// The panorama.
        panorama: PathBuf,
        /// The mask.
        mask: PathBuf,
    },
    /// A panorama without its mask.
    #[error(
        "--illumination {argument}: a panorama needs --sky-mask, a picture of its sky in white"
    )]
    NoMask {
        /// What was asked for.
        argument: String,
    },
    /// A mask without a panorama.
    #[error("--sky-mask {}: it belongs to a panorama, and --illumination is {illumination}", mask.display())]
    LoneMask {
        /// The mask.
        mask: PathBuf,
        /// What was asked for.
        illumination: String,
    },
    /// Neither a known name nor a kind of file that holds light.
    #[error(
        "--illumination {argument}: neither a bundled sky ({}) nor a panorama (.jpg, .png) or a histogram \
         (.npy, .npz)",
        NAMES.join(", ")
    )]
    Unknown {
        /// What was asked for.
        argument: String,
    },
}

impl Illumination {
    /// From what was asked for: a panorama with its mask, `FILE.npy` or `FILE.npy:ROW` (npz too), or a name
    /// of [`NAMES`]; the sky [`DEFAULT`] where nothing was.
    ///
    /// # Errors
    /// [`IlluminationError`] with the argument or file.
    pub fn parse(argument: Option<&str>, mask: Option<&Path>) -> Result<Self, IlluminationError> {
        let lone = |illumination: &str| {
            mask.map(|mask| IlluminationError::LoneMask {
                mask: mask.to_owned(),
                illumination: illumination.to_owned(),
            })
        };
        let Some(argument) = argument else {
            return match lone("not given") {
                Some(error) => Err(error),
                None => Self::named(DEFAULT)
                    .map(|sky| Self { origin: format!("{} (the default)", sky.origin), ..sky }),
            };
        };
        if NAMES.contains(&argument) {
            return lone(argument).map_or_else(|| Self::named(argument), Err);
        }
        let ends = |path: &str, endings: &[&str]| {
            let ending = Path::new(path).extension().map(|e| e.to_string_lossy().to_lowercase());
            ending.is_some_and(|ending| endings.contains(&ending.as_str()))
        };
        let arrays = ["npy", "npz"];
        let with_row = argument.rsplit_once(':').and_then(|(path, row)| {
            let row = row.parse().ok().filter(|_| ends(path, &arrays))?;
            Some((path, row))
        });
        if let Some((path, row)) = with_row {
            return lone(argument)
                .map_or_else(|| Self::from_histogram(Path::new(path), Some(row)), Err);
        }
        if ends(argument, &arrays) {
            return lone(argument)
                .map_or_else(|| Self::from_histogram(Path::new(argument), None), Err);
        }
        match mask {
            Some(mask) => Self::from_panorama(Path::new(argument), mask),
            None if ends(argument, &["jpg", "jpeg", "png"]) => {
                Err(IlluminationError::NoMask { argument: argument.to_owned() })
            }
            None => Err(IlluminationError::Unknown { argument: argument.to_owned() }),
        }
    }

    /// Of the sky in a street panorama, as the network was trained: both pictures are resized to 512 x 128,
    /// the panorama by Pillow's bicubic and the mask (white is sky) by its nearest neighbour.
    ///
    /// # Errors
    /// Pictures that cannot be read; [`IlluminationError::NoSky`].
    pub fn from_panorama(panorama: &Path, mask: &Path) -> Result<Self, IlluminationError> {
        let histogram = panorama::histogram(panorama, mask)?;
        if histogram.iter().all(|share| *share == 0.0) {
            let (panorama, mask) = (panorama.to_owned(), mask.to_owned());
            return Err(IlluminationError::NoSky { panorama, mask });
        }
        let origin = format!("panorama {} with sky mask {}", name(panorama), name(mask));
        Self::checked(origin, histogram)
    }

    /// From an array of 270 values, or of one such row a sky, as the reference's `histo.npy`.
    ///
    /// # Errors
    /// A file that cannot be read, another shape, a row that does not exist, values that are no histogram.
    pub fn from_histogram(path: &Path, row: Option<usize>) -> Result<Self, IlluminationError> {
        let fail = |why: String| {
            Err(IlluminationError::Histogram { origin: path.display().to_string(), why })
        };
        let arrays = npz::read(path)?;
        let [(_, array)] = &arrays[..] else {
            return fail(format!("{} arrays; one is needed", arrays.len()));
        };
        let shape: Vec<usize> = array.shape.iter().copied().filter(|&n| n != 1).collect();
        let rows = match shape[..] {
            [HISTOGRAM_LEN] => 1,
            [rows, HISTOGRAM_LEN] => rows,
            _ => {
                return fail(format!(
                    "shape {:?}; {HISTOGRAM_LEN} values, or rows of {HISTOGRAM_LEN}, are needed",
                    array.shape
                ));
            }
        };
        let chosen = match row {
            Some(row) if row < rows => row,
            Some(row) => return fail(format!("row {row} of {rows}; the first is 0")),
            None if rows == 1 => 0,
            None => {
                return fail(format!("{rows} rows; name one, as in {}:0", name(path)));
            }
        };
        let values = array.to_f32()[chosen * HISTOGRAM_LEN..][..HISTOGRAM_LEN].to_vec();
        let origin = match row {
            Some(row) => format!("histogram {} row {row}", name(path)),
            None => format!("histogram {}", name(path)),
        };
        Self::checked(origin, values)
    }

    /// A bundled sky ([`NAMES`]).
    ///
    /// # Errors
    /// [`IlluminationError::Unknown`] with the names that there are.
    pub fn named(name: &str) -> Result<Self, IlluminationError> {
        match named::histogram(name) {
            Some(histogram) => Self::checked(format!("bundled sky {name}"), histogram),
            None => Err(IlluminationError::Unknown { argument: name.to_owned() }),
        }
    }

    /// Checks that 270 values are shares of three channels.
    ///
    /// # Errors
    /// [`IlluminationError::Histogram`] for another number of values, for one that is negative or not
    /// finite, and for a channel whose sum is neither 0 nor 1.
    pub fn checked(origin: String, histogram: Vec<f32>) -> Result<Self, IlluminationError> {
        let why = if histogram.len() != HISTOGRAM_LEN {
            Some(format!("{} values; {HISTOGRAM_LEN} are needed", histogram.len()))
        } else if let Some(index) = histogram.iter().position(|v| !(v.is_finite() && *v >= 0.0)) {
            Some(format!("value {index} is {}; shares are 0 to 1", histogram[index]))
        } else {
            let sums = histogram
                .chunks_exact(BINS)
                .map(|channel| channel.iter().map(|share| f64::from(*share)).sum::<f64>());
            let wrong = |sum: &f64| *sum != 0.0 && (sum - 1.0).abs() > SUM_TOLERANCE;
            let mut named = ["red", "green", "blue"].into_iter().zip(sums);
            named.find(|(_, sum)| wrong(sum)).map(|(channel, sum)| {
                format!(
                    "the shares of {channel} sum to {sum:.4}; each channel's sum is 1 (0 without sky)"
                )
            })
        };
        match why {
            Some(why) => Err(IlluminationError::Histogram { origin, why }),
            None => Ok(Self { origin, histogram }),
        }
    }

    /// SHA-256 of the values as little-endian `f32`, for a plan: equal digests give equal light.
    #[must_use]
    pub fn sha256(&self) -> String {
        let bytes: Vec<u8> = self.histogram.iter().flat_map(|value| value.to_le_bytes()).collect();
        hex(&Sha256::digest(&bytes))
    }

    /// What a plan's parameters say: `{"origin": ..., "sha256": ...}`.
    #[must_use]
    pub fn parameters(&self) -> serde_json::Value {
        serde_json::json!({ "origin": self.origin, "sha256": self.sha256() })
    }
}

/// The sky of a scene in this light: the style code, and the decoder's map without its empty columns.
///
/// # Errors
/// Those of the network; [`ModelError::Shape`] where its map is not one with empty columns.
pub fn sky(network: &dyn Network, illumination: &Illumination) -> Result<SkyParts, ModelError> {
    let style = network.style(&illumination.histogram)?;
    let whole = network.sky(&style)?;
    let Some(width) = (1..=whole.width).find(|width| padded_width(*width) == whole.width) else {
        return Err(ModelError::Shape {
            what: "sky map",
            expected: "w + 0.8 w columns".to_owned(),
            found: format!("{} columns", whole.width),
        });
    };
    let rows = whole.data.chunks_exact(whole.width);
    let data = rows.flat_map(|row| &row[..width]).copied().collect();
    Ok(SkyParts { style, map: Grid::new(whole.channels, whole.height, width, data) })
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests;
