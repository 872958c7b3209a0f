//! Parity with the reference: the whole program against what the authors' own code computed.
//!
//! [`verify`] runs a network whose weights follow a rule ([`crate::weights::rule`]), so that no file is
//! needed, on a synthetic image, and holds every stage against the published numbers: preprocessing,
//! encoder, decoder, sky, points, rays, satellite view and DSM, panorama, perspective, super-resolution (of
//! our own rendering, end to end), density grid, and the conventions of cameras and illumination.
//!
//! Two limits hold for every tensor: the relative L2 error, and the largest single error, which may be twenty
//! times that of an independent NumPy implementation of the same network (`fixtures/oracle.tsv`; its script
//! is beside it).
//!
//! ```no_run
//! use sat3d_model::Device;
//! use sat3d_model::parity::{Set, verify};
//!
//! let all = verify(Set::Tiny, &Device::Cpu.into(), None, &mut |comparison| println!("{comparison}"))?;
//! assert!(all.iter().all(|comparison| comparison.passes()));
//! # Ok::<(), sat3d_model::parity::ParityError>(())
//! ```

mod golden;
mod ledger;
mod network;
mod views;

use crate::config::{Config, RELEASED};
use crate::error::ModelError;
use crate::field::FieldError;
use crate::illumination::IlluminationError;
use crate::network::{Execution, Precision};
use crate::weights::rule::{Override, full_overrides, tiny_overrides};
use golden::Goldens;
use ledger::Ledger;
use std::fmt;
use std::path::{Path, PathBuf};

/// Which network is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Set {
    /// 1.2 million parameters, one plane and one line; a few seconds.
    Tiny,
    /// The same with three planes; a few seconds.
    TinyTriplane,
    /// The released network, 381 million parameters; minutes, and 1.5 GB of weights alone.
    Full,
}

impl Set {
    /// All of them, the smallest first.
    pub const ALL: [Self; 3] = [Self::Tiny, Self::TinyTriplane, Self::Full];

    /// The set's folder in the published data: `tiny`, `tiny_triplane`, `full`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Tiny => "tiny",
            Self::TinyTriplane => "tiny_triplane",
            Self::Full => "full",
        }
    }

    fn config(self) -> Result<Config, ModelError> {
        Config::from_json(match self {
            Self::Tiny => include_str!("../../fixtures/tiny/model/config.json"),
            Self::TinyTriplane => include_str!("../../fixtures/tiny_triplane/model/config.json"),
            Self::Full => RELEASED,
        })
    }

    fn overrides(self) -> Vec<Override> {
        match self {
            Self::Tiny | Self::TinyTriplane => tiny_overrides(),
            Self::Full => full_overrides(),
        }
    }
}

impl fmt::Display for Set {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// One tensor beside the reference's.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// The stage that it belongs to, as `encoder` or `panorama`.
    pub stage: &'static str,
    /// Which tensor of the set, as `tiny 06_pano depth`.
    pub what: String,
    /// `|ours - reference| / |reference|`, both in the L2 norm over all compared values; NaN where one of
    /// them is.
    pub relative_l2: f64,
    /// What that may be.
    pub tolerance: f64,
    /// The largest `|ours - reference|` of a single value; NaN where one of them is.
    pub largest: f64,
    /// What that may be; NaN (nothing passes) where no limit is known.
    pub largest_allowed: f64,
}

impl Comparison {
    /// Whether both errors are within their limits. A NaN anywhere fails.
    #[must_use]
    pub fn passes(&self) -> bool {
        self.relative_l2 <= self.tolerance && self.largest <= self.largest_allowed
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "{:4} {:52} relative L2 {:.2e} (<= {:.1e})  largest {:.2e} (<= {:.1e})",
            if self.passes() { "ok" } else { "FAIL" },
            self.what,
            self.relative_l2,
            self.tolerance,
            self.largest,
            self.largest_allowed,
        )
    }
}

/// Why a comparison could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ParityError {
    /// The full network's numbers are not built in.
    #[error("the set `{0}` is not built in: name the folder of the published parity data")]
    NotBuiltIn(Set),
    /// A file of the parity data could not be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// A file of the parity data does not hold what it should.
    #[error("{origin}: {item}: {why}")]
    Damaged {
        /// The file, or "built in".
        origin: String,
        /// The tensor in it.
        item: String,
        /// What is wrong with it.
        why: String,
    },
    /// Our tensor and the reference's have different shapes.
    #[error("{what}: the reference has {expected}, we computed {found}")]
    Shape {
        /// Which tensor.
        what: String,
        /// The reference's shape, or number of values.
        expected: String,
        /// Ours.
        found: String,
    },
    /// The network failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The network's output makes no field.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// The built-in images make no histogram.
    #[error(transparent)]
    Illumination(#[from] IlluminationError),
}

/// Runs one set on a device, by an engine, and compares every stage with the reference; `each` sees each comparison as it is
/// made, and all of them come back in that order.
///
/// `goldens` is the folder of the published parity data (the one with `tiny` and `full` inside). `None` takes
/// the samples of it that are built into the program, which exist for the tiny sets; with the folder every
/// value is compared that the data holds. Field and renderer always run on the CPU; they are compared where the
/// network calculates in direct 32-bit floats. In another precision its stages are held to that one's bounds.
///
/// A comparison that fails is no error: see [`Comparison::passes`].
///
/// # Errors
/// [`ParityError::NotBuiltIn`] for the full set without a folder; [`ParityError::Io`] and
/// [`ParityError::Damaged`] for a folder that is not whole; those of the network, as
/// [`ModelError::Device`].
pub fn verify(
    set: Set,
    execution: &Execution,
    goldens: Option<&Path>,
    each: &mut dyn FnMut(&Comparison),
) -> Result<Vec<Comparison>, ParityError> {
    let goldens = match goldens {
        Some(folder) => Goldens::Folder(folder.into()),
        None if set == Set::Full => return Err(ParityError::NotBuiltIn(set)),
        None => Goldens::BuiltIn,
    };
    let mut ledger = Ledger::new(set, each);
    let made = network::compare(set, execution, &goldens, &mut ledger)?;
    if execution.precision == Precision::Fp32 {
        views::compare(set, &goldens, &made, &mut ledger)?;
    }
    Ok(ledger.into_all())
}
