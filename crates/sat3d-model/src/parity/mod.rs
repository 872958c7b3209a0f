//! Parity with the reference: what the command line is written against until the comparison itself
//! is merged.

use crate::network::Device;
use std::path::Path;

/// Which network is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Set {
    /// 1.2 million parameters, one plane and one line.
    Tiny,
    /// The same with three planes.
    TinyTriplane,
    /// The released network.
    Full,
}

/// One tensor beside the reference's.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// The stage that it belongs to.
    pub stage: &'static str,
    /// Which tensor.
    pub what: String,
    /// Relative error, L2.
    pub relative_l2: f64,
    /// What that may be.
    pub tolerance: f64,
    /// The largest error of a single value.
    pub largest: f64,
    /// What that may be.
    pub largest_allowed: f64,
}

impl Comparison {
    /// Whether both errors are within their limits. A NaN anywhere fails.
    #[must_use]
    pub fn passes(&self) -> bool {
        self.relative_l2 <= self.tolerance && self.largest <= self.largest_allowed
    }
}

/// Why a comparison could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ParityError {
    /// The comparison is not part of this program.
    #[error("the parity set is not built into this program")]
    NotBuilt,
}

/// Compares a set with the reference; `each` sees each comparison as it is made.
///
/// # Errors
/// [`ParityError::NotBuilt`].
pub fn verify(
    _set: Set,
    _device: &Device,
    _goldens: Option<&Path>,
    _each: &mut dyn FnMut(&Comparison),
) -> Result<Vec<Comparison>, ParityError> {
    Err(ParityError::NotBuilt)
}
