//! Scoring predicted DSMs against the benchmark: alignment, metrics, aggregation, report.
//!
//! `error = prediction - (aligned truth - vertical offset)`; [`align`] says what is aligned and in
//! which order, [`summary`] holds what an evaluation says.

pub mod align;
mod protocol;
pub mod registration;
pub mod strata;
pub mod summary;
mod surface;

pub use protocol::{OffsetMethod, Protocol};
pub use surface::Surface;
