//! `sat3d train`: settings, data, the loop with its checkpoints, and the log.
//!
//! The model crate's [`crate::model::train`] knows losses and gradients; here are files. Data flows one way:
//! [`Settings`] from a TOML file, [`data`] makes examples of them in a seeded order, the loop ([`run()`]) hands
//! them to a learner and writes checkpoints ([`checkpoint`]), the log and its page ([`report`]).
//!
//! The examples of a step, and everything random in it, are functions of the seed and the step's number alone. So
//! a run that was killed at any moment goes on from its newest checkpoint and ends with the same bytes.

pub mod checkpoint;
pub mod data;
mod error;
mod explain;
mod factory;
mod held_out;
pub mod journal;
mod live;
mod progress;
pub mod report;
pub mod run;
pub mod settings;

pub use error::TrainingError;
pub use explain::plan;
pub use factory::learner;
pub use live::duration;
pub use run::{Ending, Options, Summary, prepare, run};
pub use settings::Settings;
