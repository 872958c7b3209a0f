//! Training: losses, differentiable rendering, optimisation (paper section 4; MODEL_SPEC section 11).
//!
//! * [`Example`]: one satellite image with what is known about it, in plain memory.
//! * [`losses`]: every term of the objectives, as functions of tensors.
//! * [`Learner`]: a model that learns from batches of examples. It knows nothing of files.

mod blend;
mod discriminator;
mod error;
mod example;
mod field;
mod generator;
mod heights;
mod learner;
pub mod losses;
pub mod mini;
pub mod optimiser;
mod paper;
mod parameters;
mod rays;
mod render;
mod targets;

pub use error::TrainError;
pub use example::{Class, Example, Street, Truth};
pub use generator::{MapNetwork, MiniMap, ReleasedMap};
pub use heights::{HeightLearner, HeightSettings};
pub use learner::{Exported, Learner, NamedTensor, Outcome, Term};
pub use paper::{
    AdversarialWeights, Form, PaperLearner, PaperSettings, PerceptualMeasure, Photometric,
    TermWeights,
};
pub use rays::ViewSettings;
