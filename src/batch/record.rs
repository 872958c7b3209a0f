//! What a batch keeps of each item: a line of the journal, a row of the manifest.

use super::Status;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt::Debug;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::time::UNIX_EPOCH;

/// One file written for an item.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputFile {
    /// Path relative to the output folder, `/` between parts.
    pub file: String,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256, hexadecimal.
    pub sha256: String,
}

impl OutputFile {
    /// Of a file that is about to be written.
    #[must_use]
    pub fn of(file: &str, bytes: &[u8]) -> Self {
        Self {
            file: file.to_owned(),
            bytes: bytes.len() as u64,
            sha256: crate::plan::hex(&Sha256::digest(bytes)),
        }
    }

    /// Of a file that stands in `folder`, which may be larger than memory.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn measure(folder: &Path, file: &str) -> io::Result<Self> {
        let mut from = File::open(folder.join(file))?;
        let (mut hash, mut bytes, mut buffer) = (Sha256::new(), 0, vec![0; 1 << 20]);
        loop {
            let count = from.read(&mut buffer)?;
            if count == 0 {
                break;
            }
            hash.update(&buffer[..count]);
            bytes += count as u64;
        }
        Ok(Self { file: file.to_owned(), bytes, sha256: crate::plan::hex(&hash.finalize()) })
    }

    /// Whether the file in `folder` is still what was written, as far as `verify` looks.
    #[must_use]
    pub fn holds(&self, folder: &Path, verify: Verify) -> bool {
        match verify {
            Verify::Quick => std::fs::metadata(folder.join(&self.file))
                .is_ok_and(|metadata| metadata.len() == self.bytes),
            Verify::Hashes => Self::measure(folder, &self.file).is_ok_and(|found| found == *self),
        }
    }
}

/// Name, size and time of an input; empty where there is no such file.
#[must_use]
pub fn fingerprint(path: &Path) -> String {
    let Ok(metadata) = std::fs::metadata(path) else { return String::new() };
    let time = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    format!("{name}:{}:{}", metadata.len(), time.map_or(0, |time| time.as_nanos()))
}

/// How much of an earlier run is checked before its items count as done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verify {
    /// Size and time of inputs, size of outputs.
    #[default]
    Quick,
    /// And the SHA-256 of every output.
    Hashes,
}

/// The words of one subcommand in messages that all batches share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Words {
    /// The subcommand, as its plan names it.
    pub command: &'static str,
    /// What an output folder holds: `this folder holds` ... `with another plan`.
    pub holds: &'static str,
    /// What `--overwrite` does: `or --overwrite to` ...
    pub anew: &'static str,
    /// Why parts do not belong together.
    pub other_part: &'static str,
    /// What to do when the shards worked on different lists.
    pub other_list: &'static str,
    /// What to do about a file that is not what its journal says.
    pub redo: &'static str,
}

/// What is known of one item after its work. Holds no times, hosts or thread counts: the same input
/// gives the same record.
pub trait Record: Clone + Debug + Send + Serialize + DeserializeOwned {
    /// The subcommand's words.
    const WORDS: &'static Words;

    /// Name of the item, unique in the batch.
    fn name(&self) -> &str;

    /// How it ended.
    fn status(&self) -> Status;

    /// Why it was skipped or failed; empty when done.
    fn reason(&self) -> &str;

    /// Files written for it.
    fn outputs(&self) -> &[OutputFile];

    /// Turns it into a failure without outputs.
    fn fail(&mut self, reason: String);
}

/// An item that is finished but for its files.
#[derive(Debug)]
pub struct Product<R> {
    /// What is known of it.
    pub record: R,
    /// Its files: path in the output folder, and content.
    pub files: Vec<(String, Vec<u8>)>,
}

/// Reasons of the items that are not done with their number of items, most frequent first; `generic`
/// takes from a reason what differs from item to item.
pub fn count_reasons<R: Record>(
    records: &[R],
    generic: impl Fn(&str) -> String,
) -> Vec<(String, usize)> {
    let mut counts = std::collections::BTreeMap::<String, usize>::new();
    for record in records.iter().filter(|record| record.status() != Status::Done) {
        let text = format!("{}: {}", record.status().name(), generic(record.reason()));
        *counts.entry(text).or_default() += 1;
    }
    let mut reasons: Vec<(String, usize)> = counts.into_iter().collect();
    reasons.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    reasons
}

/// Items that ended in a certain way.
pub fn count_status<R: Record>(records: &[R], status: Status) -> usize {
    records.iter().filter(|record| record.status() == status).count()
}
