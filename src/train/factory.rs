//! The learner that the settings name: the one place that knows all of them.

use super::settings::{ModelKind, Settings};
use crate::model::Device;
use crate::model::train::{Learner, TrainError};

/// Makes the learner. `seed` is that of the training: of the first weights and of every random number in a step.
///
/// # Errors
/// [`TrainError::Setting`] for a combination of model and objective that is not served; those of the device and of
/// the weights to start from.
pub fn learner(
    settings: &Settings,
    device: &Device,
    seed: u64,
) -> Result<Box<dyn Learner>, TrainError> {
    let _ = (device, seed);
    Err(TrainError::Setting {
        key: "model.kind",
        value: format!("{:?}", settings.model.kind).to_lowercase(),
        why: "this model has no learner in this build".to_owned(),
    })
}

/// Parameters of the network, where they can be told without making it.
#[must_use]
pub fn parameters(settings: &Settings) -> Option<usize> {
    match settings.model.kind {
        ModelKind::Mini => None,
        ModelKind::Reference => None,
    }
}
