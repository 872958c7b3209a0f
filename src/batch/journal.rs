//! The journal of an output folder: what is finished, so that a later run continues.
//!
//! `.sat3d/journal.<i>-of-<n>.jsonl` holds a header (the plan's hash and what goes into the file that
//! describes the whole run), then one [`Record`] per finished item, then a line that says that the
//! shard is complete. Records are appended only after their outputs are durable. A line torn by a
//! crash is cut off on the next start.

use super::record::{Record, Words};
use super::{Shard, Status, sync_folder};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::HashMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Seek, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Folder for the journal and the locks, inside the output folder.
pub const STATE_FOLDER: &str = ".sat3d";

/// Why an output folder cannot be worked in.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The operating system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Another process works in the folder.
    #[error("{}: another sat3d run is working in this folder; wait for it, or use another --out", path.display())]
    Locked {
        /// The output folder.
        path: PathBuf,
    },
    /// The folder holds results of another plan.
    #[error("{}: this folder holds {} with another plan ({difference}); use another --out, or --overwrite to {}", path.display(), words.holds, words.anew)]
    OtherPlan {
        /// The output folder.
        path: PathBuf,
        /// The subcommand's words.
        words: &'static Words,
        /// Which parameters differ, old and new.
        difference: String,
    },
    /// The folder holds results of another subcommand.
    #[error("{}: this folder holds results of `sat3d {command}`; use another --out", path.display())]
    OtherCommand {
        /// The output folder.
        path: PathBuf,
        /// The subcommand.
        command: String,
    },
    /// Parts of different plans.
    #[error("{}: {}", path.display(), words.other_part)]
    OtherPart {
        /// The part that differs from those before it.
        path: PathBuf,
        /// The subcommand's words.
        words: &'static Words,
    },
    /// Shards that worked on different lists of items.
    #[error("{}", words.other_list)]
    OtherList {
        /// The subcommand's words.
        words: &'static Words,
    },
    /// A file whose hash is not the one in its journal.
    #[error("{}: the file is not what its journal says; {}", path.display(), words.redo)]
    Changed {
        /// The file.
        path: PathBuf,
        /// The subcommand's words.
        words: &'static Words,
    },
    /// A journal line that is not ours.
    #[error("{}: line {line} is no journal entry ({source}); remove the file to start anew", path.display())]
    Damaged {
        /// The journal.
        path: PathBuf,
        /// 1-based line.
        line: usize,
        /// What is wrong.
        source: serde_json::Error,
    },
    /// Shards that are missing or unfinished.
    #[error("{}: {what}", path.display())]
    Incomplete {
        /// The output folder.
        path: PathBuf,
        /// Which shards, in words.
        what: String,
    },
}

pub(super) fn io_error(
    action: &'static str,
    path: &Path,
) -> impl FnOnce(io::Error) -> JournalError {
    let path = path.to_owned();
    move |source| JournalError::Io { action, path, source }
}

/// First line of a journal.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Header {
    /// Hash of the plan.
    pub plan_hash: String,
    /// What the file that describes the run will say: the plan under `plan`, inputs, software.
    #[serde(alias = "benchmark")]
    pub description: Value,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Line<R> {
    Header(Header),
    Image(Box<R>),
    Complete { shard: Shard, items: u64 },
}

/// All journals of a folder, read.
#[derive(Debug)]
pub struct Journals<R> {
    /// The header of the first journal.
    pub header: Option<Header>,
    /// The last record of each item.
    pub records: HashMap<String, R>,
    /// Shards that ran to their end, with the number of items of the whole batch.
    pub complete: Vec<(Shard, u64)>,
}

impl<R> Default for Journals<R> {
    fn default() -> Self {
        Self { header: None, records: HashMap::new(), complete: Vec::new() }
    }
}

impl<R: Record> Journals<R> {
    /// Reads every journal in `out`; a folder without any gives an empty value.
    ///
    /// # Errors
    /// [`JournalError`]: unreadable, damaged, or journals of different plans side by side.
    pub fn read(out: &Path) -> Result<Self, JournalError> {
        let mut all = Self::default();
        let mut paths = journal_paths(out)?;
        paths.sort_unstable();
        for path in paths {
            let bytes = std::fs::read(&path).map_err(io_error("read", &path))?;
            let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |end| end + 1);
            for (k, line) in bytes[..whole].split(|&b| b == b'\n').enumerate() {
                if line.is_empty() {
                    continue;
                }
                let parsed: Line<R> = serde_json::from_slice(line).map_err(|source| {
                    JournalError::Damaged { path: path.clone(), line: k + 1, source }
                })?;
                match parsed {
                    Line::Header(header) => {
                        check_command::<R>(out, &header)?;
                        match &all.header {
                            Some(known) if known.plan_hash != header.plan_hash => {
                                return Err(other_plan::<R>(out, known, &header));
                            }
                            Some(_) => {}
                            None => all.header = Some(header),
                        }
                    }
                    Line::Image(record) => {
                        let better = all.records.get(record.name()).is_none_or(|known| {
                            // A shard's failure must not hide another run's success.
                            !(known.status() == Status::Done && record.status() == Status::Failed)
                        });
                        if better {
                            all.records.insert(record.name().to_owned(), *record);
                        }
                    }
                    Line::Complete { shard, items } => all.complete.push((shard, items)),
                }
            }
        }
        Ok(all)
    }

    /// Whether the shards that ran to their end make up a whole batch.
    ///
    /// # Errors
    /// [`JournalError::Incomplete`] naming the missing ones.
    pub fn check_complete(&self, out: &Path) -> Result<(), JournalError> {
        let incomplete = |what: String| JournalError::Incomplete { path: out.to_owned(), what };
        if self.header.is_none() {
            return Err(incomplete("no run has worked in this folder".into()));
        }
        let done: Vec<Shard> = self.complete.iter().map(|(shard, _)| *shard).collect();
        if done.iter().any(|shard| shard.is_whole()) {
            return Ok(());
        }
        let count = done.iter().map(|shard| shard.count).max().unwrap_or(1);
        let missing: Vec<String> = (1..=count)
            .map(|index| Shard { index, count })
            .filter(|shard| !done.contains(shard))
            .map(|shard| shard.to_string())
            .collect();
        if missing.is_empty() {
            Ok(())
        } else {
            Err(incomplete(format!("shards not finished: {}", missing.join(", "))))
        }
    }
}

fn other_plan<R: Record>(out: &Path, known: &Header, header: &Header) -> JournalError {
    JournalError::OtherPlan {
        path: out.to_owned(),
        words: R::WORDS,
        difference: difference(&known.description, &header.description),
    }
}

/// A folder belongs to one subcommand: records of another cannot even be read.
fn check_command<R: Record>(out: &Path, header: &Header) -> Result<(), JournalError> {
    match header.description["plan"]["command"].as_str() {
        Some(command) if command != R::WORDS.command => {
            Err(JournalError::OtherCommand { path: out.to_owned(), command: command.to_owned() })
        }
        _ => Ok(()),
    }
}

fn journal_paths(out: &Path) -> Result<Vec<PathBuf>, JournalError> {
    let folder = out.join(STATE_FOLDER);
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let mut paths = Vec::new();
    for item in std::fs::read_dir(&folder).map_err(io_error("read the folder", &folder))? {
        let path = item.map_err(io_error("read the folder", &folder))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with("journal.") && name.ends_with(".jsonl") {
            paths.push(path);
        }
    }
    Ok(paths)
}

/// Which parameters of two plans differ, for people.
fn difference(old: &Value, new: &Value) -> String {
    let parameters = |v: &Value| v["plan"]["parameters"].clone();
    let (old_parameters, new_parameters) = (parameters(old), parameters(new));
    let mut parts = Vec::new();
    if let (Value::Object(a), Value::Object(b)) = (&old_parameters, &new_parameters) {
        for (key, value) in b {
            let before = a.get(key).unwrap_or(&Value::Null);
            if before != value {
                parts.push(format!("{key}: {before} there, {value} now"));
            }
        }
    }
    if parts.is_empty() {
        let tolerance = |v: &Value| v["plan"]["tolerance_m"].to_string();
        if tolerance(old) == tolerance(new) {
            "its steps have other bounds".to_owned()
        } else {
            format!("tolerance: {} there, {} now", tolerance(old), tolerance(new))
        }
    } else {
        parts.join("; ")
    }
}

/// Sole right to work in an output folder, or in one shard of it; ends with the process.
#[derive(Debug)]
pub struct FolderLock {
    _files: Vec<File>,
}

impl FolderLock {
    /// Takes the folder (or the shard), making it if need be.
    ///
    /// # Errors
    /// [`JournalError::Locked`] when another process has it; I/O errors.
    pub fn take(out: &Path, shard: Shard) -> Result<Self, JournalError> {
        let folder = out.join(STATE_FOLDER);
        std::fs::create_dir_all(&folder).map_err(io_error("make the folder", &folder))?;
        let open = |name: String| {
            let path = folder.join(name);
            let file = OpenOptions::new()
                .create(true)
                .truncate(false)
                .write(true)
                .open(&path)
                .map_err(io_error("open", &path))?;
            Ok::<_, JournalError>((file, path))
        };
        let taken = |result: Result<(), TryLockError>, path: &Path| match result {
            Ok(()) => Ok(()),
            Err(TryLockError::WouldBlock) => Err(JournalError::Locked { path: out.to_owned() }),
            Err(TryLockError::Error(source)) => {
                // Some network file systems have no locks; the user is told and goes on alone.
                tracing::warn!(
                    "{}: cannot lock ({source}); do not start two runs here",
                    path.display()
                );
                Ok(())
            }
        };
        let (whole, whole_path) = open("lock".into())?;
        if shard.is_whole() {
            taken(whole.try_lock(), &whole_path)?;
            return Ok(Self { _files: vec![whole] });
        }
        taken(whole.try_lock_shared(), &whole_path)?;
        let (part, part_path) = open(format!("lock.{}-of-{}", shard.index, shard.count))?;
        taken(part.try_lock(), &part_path)?;
        Ok(Self { _files: vec![whole, part] })
    }
}

/// A journal open for appending.
#[derive(Debug)]
pub struct Journal<R> {
    file: File,
    path: PathBuf,
    records: PhantomData<fn(R)>,
}

impl<R: Record> Journal<R> {
    /// Opens this shard's journal for appending, beginning it with the header if it is new. The
    /// caller holds the [`FolderLock`].
    ///
    /// # Errors
    /// The folder holds another plan's results and `overwrite` is off; I/O errors.
    pub fn open(
        out: &Path,
        shard: Shard,
        header: &Header,
        overwrite: bool,
    ) -> Result<(Self, Journals<R>), JournalError> {
        let mut earlier = match Journals::read(out) {
            Err(JournalError::OtherPlan { .. } | JournalError::Damaged { .. }) if overwrite => {
                Journals::default()
            }
            other => other?,
        };
        let same = earlier.header.as_ref().is_some_and(|known| known.plan_hash == header.plan_hash);
        if let (Some(known), false, false) = (&earlier.header, same, overwrite) {
            return Err(other_plan::<R>(out, known, header));
        }
        if overwrite {
            for path in journal_paths(out)? {
                std::fs::remove_file(&path).map_err(io_error("remove", &path))?;
            }
            earlier = Journals::default();
        }
        let folder = out.join(STATE_FOLDER);
        let path = folder.join(format!("journal.{}-of-{}.jsonl", shard.index, shard.count));
        let mut file = OpenOptions::new()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path)
            .map_err(io_error("open", &path))?;
        let bytes = std::fs::read(&path).map_err(io_error("read", &path))?;
        let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |end| end as u64 + 1);
        file.set_len(whole).map_err(io_error("truncate", &path))?;
        file.seek(io::SeekFrom::End(0)).map_err(io_error("seek in", &path))?;
        let mut journal = Self { file, path, records: PhantomData };
        if whole == 0 {
            journal.append(&[Line::Header(header.clone())])?;
            sync_folder(&folder).map_err(io_error("sync", &folder))?;
        }
        Ok((journal, earlier))
    }

    /// Appends finished items and makes them durable.
    ///
    /// # Errors
    /// I/O errors; what was appended before stays.
    pub fn record(&mut self, records: Vec<R>) -> Result<(), JournalError> {
        let lines: Vec<Line<R>> = records.into_iter().map(|r| Line::Image(Box::new(r))).collect();
        self.append(&lines)
    }

    /// Notes that this shard of a batch of `items` items ran to its end.
    ///
    /// # Errors
    /// I/O errors.
    pub fn complete(&mut self, shard: Shard, items: u64) -> Result<(), JournalError> {
        self.append(&[Line::Complete { shard, items }])
    }

    fn append(&mut self, lines: &[Line<R>]) -> Result<(), JournalError> {
        let mut bytes = Vec::new();
        for line in lines {
            serde_json::to_writer(&mut bytes, line).map_err(|error| JournalError::Io {
                action: "write",
                path: self.path.clone(),
                source: error.into(),
            })?;
            bytes.push(b'\n');
        }
        self.file
            .write_all(&bytes)
            .and_then(|()| self.file.sync_data())
            .map_err(io_error("write", &self.path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[derive(Clone, Debug, Serialize, Deserialize)]
    struct Entry {
        name: String,
        status: Status,
    }

    impl Record for Entry {
        const WORDS: &'static Words = &Words {
            command: "test",
            holds: "things made",
            anew: "make them anew",
            other_part: "another part",
            other_list: "another list",
            redo: "do it again",
        };

        fn name(&self) -> &str {
            &self.name
        }

        fn status(&self) -> Status {
            self.status
        }

        fn reason(&self) -> &str {
            ""
        }

        fn outputs(&self) -> &[super::super::OutputFile] {
            &[]
        }

        fn fail(&mut self, _: String) {
            self.status = Status::Failed;
        }
    }

    fn header(zoom: u32) -> Header {
        let parameters = json!({"zoom": zoom});
        let plan = json!({"command": "test", "tolerance_m": 1e-6, "parameters": parameters});
        Header { plan_hash: format!("hash{zoom}"), description: json!({"plan": plan}) }
    }

    fn record(name: &str, status: Status) -> Entry {
        Entry { name: name.to_owned(), status }
    }

    fn open(
        out: &Path,
        shard: Shard,
        zoom: u32,
        overwrite: bool,
    ) -> Result<(Journal<Entry>, Journals<Entry>), JournalError> {
        Journal::open(out, shard, &header(zoom), overwrite)
    }

    #[test]
    fn what_was_recorded_is_found_again_and_a_torn_line_is_cut() {
        let out = tempfile::tempdir().expect("folder");
        let _lock = FolderLock::take(out.path(), Shard::WHOLE).expect("locks");
        let (mut journal, earlier) = open(out.path(), Shard::WHOLE, 20, false).expect("opens");
        assert!(earlier.records.is_empty());
        journal
            .record(vec![record("a", Status::Done), record("b", Status::Failed)])
            .expect("records");
        let path = journal.path.clone();
        drop(journal);
        let mut bytes = std::fs::read(&path).expect("reads");
        bytes.extend_from_slice(b"{\"image\":{\"name\":\"c\"");
        std::fs::write(&path, bytes).expect("writes");
        let (mut journal, earlier) = open(out.path(), Shard::WHOLE, 20, false).expect("opens");
        assert_eq!(earlier.records.len(), 2);
        journal.record(vec![record("c", Status::Done)]).expect("records");
        journal.complete(Shard::WHOLE, 3).expect("completes");
        let all = Journals::<Entry>::read(out.path()).expect("reads");
        assert_eq!(all.records.len(), 3);
        all.check_complete(out.path()).expect("complete");
    }

    #[test]
    fn another_plan_is_refused_with_the_difference_and_overwrite_starts_anew() {
        let out = tempfile::tempdir().expect("folder");
        let _lock = FolderLock::take(out.path(), Shard::WHOLE).expect("locks");
        let (mut journal, _) = open(out.path(), Shard::WHOLE, 20, false).expect("opens");
        journal.record(vec![record("a", Status::Done)]).expect("records");
        let error = open(out.path(), Shard::WHOLE, 19, false).expect_err("refuses");
        let text = error.to_string();
        assert!(text.contains("holds things made with another plan"), "{text}");
        assert!(text.contains("zoom: 20 there, 19 now"), "{text}");
        assert!(text.ends_with("or --overwrite to make them anew"), "{text}");
        let (_, earlier) = open(out.path(), Shard::WHOLE, 19, true).expect("opens");
        assert!(earlier.records.is_empty());
    }

    #[test]
    fn a_folder_belongs_to_one_run_or_to_distinct_shards() {
        let out = tempfile::tempdir().expect("folder");
        let shard = |index| Shard { index, count: 3 };
        let first = FolderLock::take(out.path(), shard(1)).expect("locks");
        let second = FolderLock::take(out.path(), shard(2)).expect("locks");
        assert!(matches!(FolderLock::take(out.path(), shard(1)), Err(JournalError::Locked { .. })));
        assert!(matches!(
            FolderLock::take(out.path(), Shard::WHOLE),
            Err(JournalError::Locked { .. })
        ));
        drop((first, second));
        FolderLock::take(out.path(), Shard::WHOLE).expect("locks");
    }

    #[test]
    fn a_folder_of_another_subcommand_is_left_alone_even_with_overwrite() {
        let out = tempfile::tempdir().expect("folder");
        let _lock = FolderLock::take(out.path(), Shard::WHOLE).expect("locks");
        let mut other = header(20);
        other.description["plan"]["command"] = json!("dsm-bench build");
        Journal::<Entry>::open(out.path(), Shard::WHOLE, &other, false).expect("opens");
        for overwrite in [false, true] {
            let error = open(out.path(), Shard::WHOLE, 20, overwrite).expect_err("refuses");
            assert!(error.to_string().contains("results of `sat3d dsm-bench build`"), "{error}");
        }
    }

    #[test]
    fn missing_shards_are_named() {
        let out = tempfile::tempdir().expect("folder");
        for index in [1, 3] {
            let shard = Shard { index, count: 3 };
            let _lock = FolderLock::take(out.path(), shard).expect("locks");
            let (mut journal, _) = open(out.path(), shard, 20, false).expect("opens");
            journal.complete(shard, 9).expect("completes");
        }
        let error = Journals::<Entry>::read(out.path()).expect("reads").check_complete(out.path());
        assert!(error.expect_err("incomplete").to_string().contains("not finished: 2/3"));
    }
}
