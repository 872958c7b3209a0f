//! Work in many items: outcomes, exit codes, atomic outputs, resume, shards, progress.
//!
//! A batch never dies of one item: each ends as done, skipped (with a reason) or failed (with an
//! error), and the exit code says which happened.

mod atomic;
mod exit;
mod interrupt;
mod progress;
mod shard;

pub use atomic::{AtomicFile, sync_folder, write_atomic};
pub use exit::ExitCode;
pub use interrupt::Interrupt;
pub use progress::Progress;
pub use shard::Shard;

use serde::{Deserialize, Serialize};

/// How one item of a batch ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// All its outputs exist.
    Done,
    /// Left out for a stated reason that is no error (too little coverage, no tile).
    Skipped,
    /// An error; a later run tries again.
    Failed,
}

impl Status {
    /// `done`, `skipped` or `failed`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Skipped => "skipped",
            Self::Failed => "failed",
        }
    }
}
