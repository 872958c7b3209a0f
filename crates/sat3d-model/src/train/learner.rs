//! A model that learns.

use super::error::TrainError;
use super::example::Example;

/// A tensor by its name.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor {
    /// Name, unique within its list.
    pub name: String,
    /// Shape; empty for a scalar.
    pub shape: Vec<usize>,
    /// Values, row-major.
    pub values: Vec<f32>,
}

/// One scalar of a step, as it is logged.
#[derive(Clone, Debug, PartialEq)]
pub struct Term {
    /// Name, as `depth` or `discriminator.satellite`.
    pub name: &'static str,
    /// Its value, weight included.
    pub value: f32,
}

/// What became of a step.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The weights were updated. The first term is the total.
    Stepped(Vec<Term>),
    /// A loss or a gradient was not finite: the weights are as before.
    Skipped(String),
}

/// A trained model, as a checkpoint folder holds it.
#[derive(Clone, Debug, PartialEq)]
pub struct Exported {
    /// Text of `config.json`.
    pub config: String,
    /// The weights themselves (`vqmodel`).
    pub model: Vec<NamedTensor>,
    /// Their moving average (`vqmodel_ema`).
    pub average: Vec<NamedTensor>,
}

/// A model that learns from batches of examples.
///
/// Everything random in a step is a function of the learner's seed and the step's number, so that a
/// restored learner goes on exactly as the one that was stored.
pub trait Learner: Send {
    /// One step of optimisation. `step` counts from 0.
    ///
    /// # Errors
    /// [`TrainError::Example`] for an example that lacks what the losses need.
    fn step(&mut self, step: u64, batch: &[Example]) -> Result<Outcome, TrainError>;

    /// Everything that a resumed run needs: weights, averages, the optimiser's moments.
    ///
    /// # Errors
    /// Those of the device.
    fn state(&self) -> Result<Vec<NamedTensor>, TrainError>;

    /// Goes back to a stored state.
    ///
    /// # Errors
    /// [`TrainError::State`] where a tensor is missing, left over or of another shape.
    fn restore(&mut self, state: &[NamedTensor]) -> Result<(), TrainError>;

    /// The model as it would be used.
    ///
    /// # Errors
    /// Those of the device.
    fn export(&self) -> Result<Exported, TrainError>;
}
