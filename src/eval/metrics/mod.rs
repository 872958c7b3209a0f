//! The numbers of an evaluation: sums, quantiles, intervals, differences.
//!
//! Everything takes errors (prediction - truth, metres) as finite `f64`; the caller has left out the
//! pixels without data. Everything merges; nothing depends on the number of threads.

mod bootstrap;
mod differences;
mod double;
#[cfg(test)]
mod hard_cases;
mod histogram;
mod key;
mod quantiles;
mod samples;
mod sketch;
mod student;
mod sums;

pub use bootstrap::{BootstrapSettings, block_of, intervals, lone_block};
pub(crate) use bootstrap::{draw, ends};
pub use differences::{ComparedSet, differences};
pub use histogram::Histogram;
pub use quantiles::{CoarseCounts, FineCounts, NMAD_FACTOR, Quantiles, Refinement};
pub use samples::{ImageSample, mean_scores};
pub use sketch::Sketch;
pub use sums::{ErrorSums, PUBLISHED_THRESHOLDS_M, threshold_list};
