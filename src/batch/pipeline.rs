//! Running a batch: items are worked on in several threads, their files written by others, and their
//! records kept in groups, each durable before it counts.

use super::journal::{Journal, JournalError, io_error};
use super::record::{Product, Record};
use super::{AtomicFile, Interrupt, Progress, Status, sync_folder};
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Threads that write: they mostly wait for the disk, so there are more than cores.
const WRITERS: usize = 4;
/// Records kept back at most, in number and time, before the folder is synced for all of them.
const GROUP: usize = 64;
const GROUP_TIME: Duration = Duration::from_millis(500);

/// The surroundings of a batch at work.
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    /// Output folder; the caller holds its lock.
    pub out: &'a Path,
    /// Threads that work on items.
    pub threads: usize,
    /// Counts finished items and prints failures.
    pub progress: &'a Progress,
    /// Asks to stop after the items in hand.
    pub stop: &'a Interrupt,
    /// Set by the batch when the disk is full, which stops it too.
    pub disk_full: &'a Interrupt,
}

impl Batch<'_> {
    /// Works on `todo`: `build` makes each item's record and files (and says in the record what went
    /// wrong, if anything did), or nothing where it saw in time that it should stop; records end in
    /// `journal` and then in `keep`, in the order in which items finish.
    ///
    /// # Errors
    /// The journal cannot be written; the items of the last group are then redone by the next run.
    pub fn run<T: Sync, R: Record>(
        &self,
        todo: &[T],
        build: impl Fn(&T) -> Option<Product<R>> + Sync,
        journal: &mut Journal<R>,
        keep: impl FnMut(R),
    ) -> Result<(), JournalError> {
        let next = AtomicUsize::new(0);
        // A short queue: finished products wait in memory for the disk.
        let (products, queue) = sync_channel::<Product<R>>(2 * WRITERS);
        let queue = Arc::new(Mutex::new(queue));
        let (finished, incoming) = channel::<R>();
        let (next, build) = (&next, &build);
        std::thread::scope(|scope| {
            for _ in 0..WRITERS {
                let (queue, finished) = (Arc::clone(&queue), finished.clone());
                scope.spawn(move || write_products(self.out, &queue, &finished, self.disk_full));
            }
            drop(finished);
            for _ in 0..self.threads.max(1) {
                let products = products.clone();
                scope.spawn(move || {
                    while !self.stop.requested() && !self.disk_full.requested() {
                        let Some(item) = todo.get(next.fetch_add(1, Ordering::Relaxed)) else {
                            return;
                        };
                        let Some(product) = build(item) else { return };
                        if products.send(product).is_err() {
                            return;
                        }
                    }
                });
            }
            drop(products);
            let result = keep_records(self.out, &incoming, journal, self.progress, keep);
            if result.is_err() {
                // The journal cannot be kept: let the others run out instead of working in vain.
                self.disk_full.request();
                while incoming.recv().is_ok() {}
            }
            result
        })
    }
}

/// Takes products off the queue and writes their files; failures become failed records. A full
/// disk asks the whole run to stop, since every later item would fail the same way.
fn write_products<R: Record>(
    out: &Path,
    queue: &Mutex<Receiver<Product<R>>>,
    records: &Sender<R>,
    disk_full: &Interrupt,
) {
    loop {
        let next = match queue.lock() {
            Ok(queue) => queue.recv(),
            Err(poisoned) => poisoned.into_inner().recv(),
        };
        let Ok(product) = next else { return };
        let mut record = product.record;
        for (name, bytes) in &product.files {
            if let Err(error) = write_file(out, name, bytes) {
                if error.kind() == io::ErrorKind::StorageFull {
                    disk_full.request();
                }
                record.fail(format!("cannot write {name}: {error}"));
                break;
            }
        }
        if records.send(record).is_err() {
            return;
        }
    }
}

/// Writes a file below `out`, making its folder; what lies in a folder of its own is durable at once, since
/// only `out` is synced for many.
fn write_file(out: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    let path = out.join(name);
    let below = path.parent().filter(|folder| *folder != out);
    if let Some(folder) = below {
        std::fs::create_dir_all(folder)?;
    }
    let mut file = AtomicFile::create(&path)?;
    file.file().write_all(bytes)?;
    file.commit()?;
    below.map_or(Ok(()), sync_folder)
}

/// Collects records, makes their files durable in groups, journals them, and keeps them.
///
/// # Errors
/// The journal cannot be written; the files of the last group are then redone by the next run.
fn keep_records<R: Record>(
    out: &Path,
    records: &Receiver<R>,
    journal: &mut Journal<R>,
    progress: &Progress,
    mut keep: impl FnMut(R),
) -> Result<(), JournalError> {
    let mut group: Vec<R> = Vec::new();
    let mut since = Instant::now();
    loop {
        let wait = GROUP_TIME.saturating_sub(since.elapsed());
        let ended = match records.recv_timeout(wait) {
            Ok(record) => {
                if group.is_empty() {
                    since = Instant::now();
                }
                if record.status() == Status::Failed {
                    progress.line(&format!("failed: {}: {}", record.name(), record.reason()));
                }
                group.push(record);
                progress.add(1);
                false
            }
            Err(RecvTimeoutError::Timeout) => false,
            Err(RecvTimeoutError::Disconnected) => true,
        };
        if !group.is_empty() && (ended || group.len() >= GROUP || since.elapsed() >= GROUP_TIME) {
            sync_folder(out).map_err(io_error("sync", out))?;
            journal.record(group.clone())?;
            group.drain(..).for_each(&mut keep);
        }
        if group.is_empty() {
            since = Instant::now();
        }
        if ended {
            return Ok(());
        }
    }
}

/// Removes temporary files (and folders, of volumes) that a killed run left in `out` and in the folders
/// of its items; `ours` says whether a target, named relative to `out`, is one that the batch writes, or a
/// folder of such. The caller holds the folder's lock.
pub fn remove_leftovers(out: &Path, ours: impl Fn(&str) -> bool) {
    remove_below(out, "", &ours);
}

fn remove_below(folder: &Path, prefix: &str, ours: &impl Fn(&str) -> bool) {
    let Ok(items) = std::fs::read_dir(folder) else { return };
    for item in items.filter_map(Result::ok) {
        let name = item.file_name().to_string_lossy().into_owned();
        let (path, below) = (item.path(), format!("{prefix}{name}"));
        let Some(target) = leftover_of(&name) else {
            if path.is_dir() && ours(&below) {
                remove_below(&path, &format!("{below}/"), ours);
            }
            continue;
        };
        if !ours(&format!("{prefix}{target}")) {
            continue;
        }
        let removed = match path.is_dir() {
            true => std::fs::remove_dir_all(&path),
            false => std::fs::remove_file(&path),
        };
        if let Err(error) = removed {
            tracing::warn!("cannot remove the leftover {below}: {error}");
        }
    }
}

/// The target of a temporary file `.<target>.<six characters>.part`, or of a folder that was being replaced
/// (`.old`).
fn leftover_of(name: &str) -> Option<&str> {
    let hidden = name.strip_prefix('.')?;
    let hidden = hidden.strip_suffix(".part").or_else(|| hidden.strip_suffix(".old"))?;
    hidden.rsplit_once('.').map(|(target, _)| target)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leftovers_are_known_by_their_target() {
        let folder = tempfile::tempdir().expect("a folder");
        let left = AtomicFile::create(&folder.path().join("a.npz")).expect("opens");
        let name = left.path().file_name().expect("a name").to_string_lossy().into_owned();
        assert_eq!(leftover_of(&name), Some("a.npz"));
        for other in ["a.npz", ".a.part", "a.npz.x.part", ".a.npz.x.partial"] {
            assert_eq!(leftover_of(other), None, "{other}");
        }
        remove_leftovers(folder.path(), |target| target == "b.npz");
        assert!(left.path().exists());
        remove_leftovers(folder.path(), |target| target == "a.npz");
        assert!(!left.path().exists());
        // In the folder of an item, and nowhere else.
        for name in ["a_path", "b_path"] {
            std::fs::create_dir(folder.path().join(name)).expect("makes");
            std::fs::write(folder.path().join(name).join(".1.png.abcdef.part"), b"")
                .expect("writes");
        }
        remove_leftovers(folder.path(), |target| ["a_path", "a_path/1.png"].contains(&target));
        let left = |name: &str| folder.path().join(name).join(".1.png.abcdef.part").exists();
        assert!(!left("a_path") && left("b_path"));
    }
}
