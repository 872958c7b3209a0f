//! Joining the shards of a batch into one.

use super::journal::{FolderLock, Header, JournalError, Journals, io_error};
use super::record::Record;
use super::{Shard, sync_folder, write_atomic};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A batch made of its shards; the folder stays locked as long as this lives.
#[derive(Debug)]
pub struct Joined<R> {
    /// The header that all parts share.
    pub header: Header,
    /// The records, by name.
    pub records: Vec<R>,
    _lock: FolderLock,
}

/// Joins shards into `out`: those that worked in `out` itself, and those of the folders `parts`, whose
/// files are copied after their hash is checked.
///
/// # Errors
/// Missing or unfinished shards, different plans, a file that is not what its journal says.
pub fn join<R: Record>(out: &Path, parts: &[PathBuf]) -> Result<Joined<R>, JournalError> {
    std::fs::create_dir_all(out).map_err(io_error("make the folder", out))?;
    let lock = FolderLock::take(out, Shard::WHOLE)?;
    let mut header: Option<Header> = None;
    let mut records: BTreeMap<String, R> = BTreeMap::new();
    let mut all = Journals::<R>::default();
    let same_place =
        |part: &Path| matches!((part.canonicalize(), out.canonicalize()), (Ok(a), Ok(b)) if a == b);
    let others = parts.iter().map(PathBuf::as_path).filter(|part| !same_place(part));
    let no_run = |folder: &Path| JournalError::Incomplete {
        path: folder.to_owned(),
        what: "no run has worked in this folder".into(),
    };
    for folder in std::iter::once(out).chain(others) {
        let journals = Journals::<R>::read(folder)?;
        let Some(found) = journals.header else {
            if folder == out && !parts.is_empty() {
                continue;
            }
            return Err(no_run(folder));
        };
        match &header {
            Some(known) if known.plan_hash != found.plan_hash => {
                return Err(JournalError::OtherPart { path: folder.to_owned(), words: R::WORDS });
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
    sync_folder(out).map_err(io_error("sync", out))?;
    let expected = all.complete.iter().map(|(_, items)| *items).max().unwrap_or(0);
    if all.complete.iter().any(|(_, items)| *items != expected) {
        return Err(JournalError::OtherList { words: R::WORDS });
    }
    let header = header.ok_or_else(|| no_run(out))?;
    Ok(Joined { header, records: records.into_values().collect(), _lock: lock })
}

fn copy_outputs<R: Record>(from: &Path, out: &Path, record: &R) -> Result<(), JournalError> {
    for output in record.outputs() {
        let (source, target) = (from.join(&output.file), out.join(&output.file));
        let bytes = std::fs::read(&source).map_err(io_error("read", &source))?;
        if crate::plan::hex(&Sha256::digest(&bytes)) != output.sha256 {
            return Err(JournalError::Changed { path: source, words: R::WORDS });
        }
        if let Some(folder) = target.parent() {
            std::fs::create_dir_all(folder).map_err(io_error("make the folder", folder))?;
        }
        write_atomic(&target, &bytes).map_err(io_error("write", &target))?;
    }
    Ok(())
}
