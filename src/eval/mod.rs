//! Scoring predicted DSMs against the benchmark: alignment, metrics, aggregation, report.
//!
//! `error = prediction - (aligned truth - vertical offset)`.
//!
//! | module | what happens there |
//! |---|---|
//! | [`inputs`] | files are paired and read: metres, NaN for no data |
//! | [`align`] | the truth is brought onto the prediction |
//! | [`metrics`] | sums, exact quantiles in flat memory, bootstrap |
//! | [`strata`] | slope, edges, height above ground, classes of a mask |
//! | [`registration`] | the offset between images and truth, estimated and not applied |
//! | [`prepare`], [`Prepared::run`], [`merge`] | a whole evaluation, in two passes, in parts or at once |
//! | [`summary`] | what an evaluation says |
//! | [`report`] | how it is shown: terminal, JSON, tables, HTML |
//! | [`write_baselines`] | predictions to hold a score against |

pub mod align;
mod baseline;
mod error_raster;
mod finish;
#[cfg(test)]
mod hard_cases;
pub mod inputs;
pub mod metrics;
mod options;
mod part;
mod plan;
mod protocol;
pub mod published;
pub mod registration;
pub mod report;
mod resize;
mod run;
mod score;
pub mod strata;
pub mod summary;
mod surface;
mod tally;

pub use baseline::{Baseline, BaselineSummary, write_baselines};
pub use options::{EvalOptions, Outputs, Settings};
pub use part::merge;
pub use protocol::{OffsetMethod, Protocol};
pub use resize::{Resize, resize};
pub use run::{EvalError, Prepared, prepare};
pub use strata::MaskOptions;
pub use surface::Surface;
