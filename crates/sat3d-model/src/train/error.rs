//! What can go wrong in training.

use crate::error::ModelError;

/// An error of training.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// An example lacks something that a loss needs, or has it in another size.
    #[error("{example}: {what}")]
    Example {
        /// Name of the example.
        example: String,
        /// What is missing or does not fit, with the value found.
        what: String,
    },
    /// A setting makes no sense.
    #[error("`{key}` = {value}: {why}")]
    Setting {
        /// Name of the setting.
        key: &'static str,
        /// The value found.
        value: String,
        /// What is asked for.
        why: String,
    },
    /// A stored state does not belong to this model.
    #[error("stored state: {0}")]
    State(String),
    /// The model or its device.
    #[error(transparent)]
    Model(#[from] ModelError),
}
