//! What can go wrong.

/// Why oneDNN cannot be used on this machine.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LoadError {
    /// No library of that name.
    #[error(
        "oneDNN 2.6 is not on this machine ({tried}: {why}); on Debian 12: apt-get install libdnnl2"
    )]
    Missing {
        /// The names that were tried.
        tried: String,
        /// The loader's reason.
        why: String,
    },
    /// A version with another binary interface.
    #[error("{file} is oneDNN {found}; versions 2.6 and 2.7 are served")]
    Version {
        /// Its name.
        file: String,
        /// The version that it says.
        found: String,
    },
    /// It is there and does not start.
    #[error("{file}: {why}")]
    Start {
        /// Its name.
        file: String,
        /// What failed.
        why: String,
    },
}

/// Why an operation was refused or failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The library has no implementation of it on this processor.
    #[error("oneDNN has no {operation} on this processor")]
    Unimplemented {
        /// Which operation.
        operation: String,
    },
    /// The library refused or failed.
    #[error("oneDNN: {operation} failed with status {status}")]
    Failed {
        /// Which operation.
        operation: String,
        /// `dnnl_status_t`.
        status: i32,
    },
    /// A memory of another shape, type or layout than the operation was made for.
    #[error("oneDNN: the {role} of {operation} has another layout than it was made for")]
    Layout {
        /// Which operation.
        operation: String,
        /// Which of its memories.
        role: &'static str,
    },
    /// Values for a memory of another size.
    #[error("{found} values for a memory of {expected}")]
    Length {
        /// As many as there are.
        found: usize,
        /// As many as there should be.
        expected: usize,
    },
}
