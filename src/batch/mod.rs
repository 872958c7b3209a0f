//! Work in many items: outcomes, exit codes, atomic outputs, resume, shards, progress.
//!
//! A batch never dies of one item: each ends as done, skipped (with a reason) or failed (with an
//! error), and the exit code says which happened.
//!
//! A subcommand brings its [`Record`] and a function from an item to a [`Product`]; [`Batch::run`] does
//! the rest: threads, whole files, a [`Journal`] from which a second run continues. [`join()`] makes one
//! batch of its shards.

mod atomic;
mod exit;
mod folder;
mod interrupt;
mod join;
mod journal;
mod pipeline;
mod progress;
mod record;
mod shard;

pub use atomic::{AtomicFile, sync_folder, write_atomic};
pub use exit::ExitCode;
pub use folder::AtomicFolder;
pub use interrupt::Interrupt;
pub use join::{Joined, join};
pub use journal::{FolderLock, Header, Journal, JournalError, Journals, STATE_FOLDER};
pub use pipeline::{Batch, remove_leftovers};
pub use progress::Progress;
pub use record::{
    OutputFile, Product, Record, Verify, Words, count_reasons, count_status, fingerprint,
};
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
