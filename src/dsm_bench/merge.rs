//! Joining the shards of a benchmark into one.

use super::build::RunSummary;
use super::journal::{FolderLock, Header, Journals};
use super::record::Record;
use super::{BenchError, JournalError, manifest};
use crate::batch::{Shard, Status, sync_folder};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Joins shards into `out`: those that worked in `out` itself, and those of the folders `parts`,
/// whose files are copied after their hash is checked. Writes the manifest that one run over all
/// images would have written, byte for byte.
///
/// # Errors
/// Missing or unfinished shards, different plans, a file that is not what its journal says.
pub fn merge(out: &Path, parts: &[PathBuf], stac: bool) -> Result<RunSummary, BenchError> {
    std::fs::create_dir_all(out).map_err(BenchError::io("make the folder", out))?;
    let _lock = FolderLock::take(out, Shard::WHOLE)?;
    let mut header: Option<Header> = None;
    let mut records: BTreeMap<String, Record> = BTreeMap::new();
    let mut all = Journals::default();
    let same_place =
        |part: &Path| matches!((part.canonicalize(), out.canonicalize()), (Ok(a), Ok(b)) if a == b);
    let others = parts.iter().map(PathBuf::as_path).filter(|part| !same_place(part));
    for folder in std::iter::once(out).chain(others) {
        let journals = Journals::read(folder)?;
        let Some(found) = journals.header else {
            if folder == out && !parts.is_empty() {
                continue;
            }
            return Err(JournalError::Incomplete {
                path: folder.to_owned(),
                what: "no run has worked in this folder".into(),
            }
            .into());
        };
        match &header {
            Some(known) if known.plan_hash != found.plan_hash => {
                return Err(BenchError::Input(format!(
                    "{}: built with another plan than the other parts; parts of one benchmark need equal options and tiles",
                    folder.display()
                )));
            }
            Some(_) => {}
            None => header = Some(found.clone()),
        }
        all.header = Some(found);
        all.complete.extend(journals.complete);
        for (name, record) in journals.records {
            if folder != out {
                copy_outputs(folder, out, &record)?;
            }
            records.insert(name, record);
        }
    }
    all.check_complete(out)?;
    sync_folder(out).map_err(BenchError::io("sync", out))?;
    let expected = all.complete.iter().map(|(_, items)| *items).max().unwrap_or(0);
    if all.complete.iter().any(|(_, items)| *items != expected) {
        return Err(BenchError::Input(
            "the shards saw image lists of different lengths; run them again with the same --vigor or --images".into(),
        ));
    }
    let header = header.ok_or_else(|| BenchError::Input("nothing to merge".into()))?;
    let records: Vec<Record> = records.into_values().collect();
    let count = |status| records.iter().filter(|r| r.status == status).count();
    let summary = RunSummary {
        images: records.len(),
        done: count(Status::Done),
        kept: count(Status::Done),
        skipped: count(Status::Skipped),
        failed: count(Status::Failed),
        ..RunSummary::default()
    };
    manifest::write(out, &header, records, None, stac)?;
    Ok(summary)
}

fn copy_outputs(from: &Path, out: &Path, record: &Record) -> Result<(), BenchError> {
    for output in &record.outputs {
        let (source, target) = (from.join(&output.file), out.join(&output.file));
        let bytes = std::fs::read(&source).map_err(BenchError::io("read", &source))?;
        if crate::plan::hex(&Sha256::digest(&bytes)) != output.sha256 {
            return Err(BenchError::Input(format!(
                "{}: the file is not what its journal says; build that shard again with --verify hashes",
                source.display()
            )));
        }
        crate::batch::write_atomic(&target, &bytes).map_err(BenchError::io("write", &target))?;
    }
    Ok(())
}
