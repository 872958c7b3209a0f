//! A benchmark against a known truth: what `make demo` ends with.
//!
//! The truth of a simulated scene has, beside the exact heights `dsm`, a mask `smooth` of the pixels
//! whose surroundings are smooth: there, a difference is an error of the program; at walls, it is
//! what the lidar's pixel size leaves open.

use crate::raster::npz::{self, NpzError};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Why a comparison is impossible.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// An array file cannot be read.
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// A folder cannot be listed.
    #[error("cannot read the folder {}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing to compare, or arrays that do not fit.
    #[error("{}: {what}", path.display())]
    Mismatch {
        /// The file or folder.
        path: PathBuf,
        /// What does not fit.
        what: String,
    },
}

/// Differences benchmark - truth over a set of pixels, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ErrorSummary {
    /// Pixels valid in both.
    pub pixels: u64,
    /// Mean difference.
    pub mean_m: f64,
    /// Root mean square difference.
    pub rmse_m: f64,
    /// Mean absolute difference.
    pub mae_m: f64,
    /// Largest absolute difference.
    pub max_m: f64,
}

/// Sums of an [`ErrorSummary`] in the making: f64, one image at a time, in a fixed order.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    count: u64,
    sum: f64,
    squares: f64,
    absolute: f64,
    max: f64,
}

impl Sums {
    fn add(&mut self, difference: f64) {
        self.count += 1;
        self.sum += difference;
        self.squares += difference * difference;
        self.absolute += difference.abs();
        self.max = self.max.max(difference.abs());
    }

    fn merge(&mut self, other: Self) {
        self.count += other.count;
        self.sum += other.sum;
        self.squares += other.squares;
        self.absolute += other.absolute;
        self.max = self.max.max(other.max);
    }

    fn summary(self) -> ErrorSummary {
        let n = self.count.max(1) as f64;
        ErrorSummary {
            pixels: self.count,
            mean_m: self.sum / n,
            rmse_m: (self.squares / n).sqrt(),
            mae_m: self.absolute / n,
            max_m: self.max,
        }
    }
}

/// The comparison of a benchmark with the truth.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Images compared.
    pub images: u64,
    /// Truth files without a DSM.
    pub missing: Vec<String>,
    /// Over pixels whose surroundings are smooth.
    pub smooth: ErrorSummary,
    /// Over all pixels.
    pub all: ErrorSummary,
}

/// Compares every `<stem>_dsm.npz` of `truth` (keys `dsm`, `smooth`) with that of `dsm`.
///
/// # Errors
/// [`CompareError`]; a truth without a DSM is no error but listed.
pub fn compare(dsm: &Path, truth: &Path) -> Result<Comparison, CompareError> {
    let mut names: Vec<String> = std::fs::read_dir(truth)
        .map_err(|source| CompareError::Folder { path: truth.to_owned(), source })?
        .filter_map(Result::ok)
        .map(|item| item.file_name().to_string_lossy().into_owned())
        .filter(|name| name.ends_with("_dsm.npz"))
        .collect();
    names.sort_unstable();
    let (mut smooth, mut all) = (Sums::default(), Sums::default());
    let mut comparison = Comparison {
        images: 0,
        missing: Vec::new(),
        smooth: ErrorSummary::default(),
        all: ErrorSummary::default(),
    };
    for name in names {
        let (built, exact) = (dsm.join(&name), truth.join(&name));
        if !built.exists() {
            comparison.missing.push(name);
            continue;
        }
        let heights = array(&built, "dsm")?;
        let truth_heights = array(&exact, "dsm")?;
        let mask = array(&exact, "smooth")?;
        if heights.len() != truth_heights.len() || mask.len() != heights.len() {
            let what = format!("{} pixels, the truth has {}", heights.len(), truth_heights.len());
            return Err(CompareError::Mismatch { path: built, what });
        }
        let (mut image_smooth, mut image_all) = (Sums::default(), Sums::default());
        for ((height, exact), mask) in heights.iter().zip(&truth_heights).zip(&mask) {
            let difference = height - exact;
            if difference.is_nan() {
                continue;
            }
            image_all.add(difference);
            if *mask != 0.0 {
                image_smooth.add(difference);
            }
        }
        smooth.merge(image_smooth);
        all.merge(image_all);
        comparison.images += 1;
    }
    if comparison.images == 0 {
        return Err(CompareError::Mismatch {
            path: dsm.to_owned(),
            what: format!("no DSM here has a truth in {}", truth.display()),
        });
    }
    comparison.smooth = smooth.summary();
    comparison.all = all.summary();
    Ok(comparison)
}

fn array(path: &Path, key: &str) -> Result<Vec<f64>, CompareError> {
    let found = npz::read(path)?.into_iter().find(|(name, _)| name == key);
    let missing =
        || CompareError::Mismatch { path: path.to_owned(), what: format!("no array `{key}`") };
    Ok(found.ok_or_else(missing)?.1.to_f64())
}
