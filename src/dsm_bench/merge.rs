//! Joining the shards of a benchmark into one.

use super::build::RunSummary;
use super::record::Record;
use super::{BenchError, manifest};
use crate::batch::{Status, count_status, join};
use std::path::{Path, PathBuf};

/// Joins shards into `out`: those that worked in `out` itself, and those of the folders `parts`,
/// whose files are copied after their hash is checked. Writes the manifest that one run over all
/// images would have written, byte for byte.
///
/// # Errors
/// Missing or unfinished shards, different plans, a file that is not what its journal says.
pub fn merge(out: &Path, parts: &[PathBuf], stac: bool) -> Result<RunSummary, BenchError> {
    let mut joined = join::<Record>(out, parts)?;
    let records = std::mem::take(&mut joined.records);
    let count = |status| count_status(&records, status);
    let summary = RunSummary {
        images: records.len(),
        done: count(Status::Done),
        kept: count(Status::Done),
        skipped: count(Status::Skipped),
        failed: count(Status::Failed),
        ..RunSummary::default()
    };
    manifest::write(out, &joined.header, records, None, stac)?;
    Ok(summary)
}
