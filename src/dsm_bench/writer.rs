//! Writing finished images: many files at once, one durable record for many files.

use super::item::Product;
use super::journal::{Journal, JournalError};
use super::record::Record;
use crate::batch::{AtomicFile, Interrupt, Progress, Status, sync_folder};
use std::io::{self, Write};
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Threads that write: they mostly wait for the disk, so there are more than cores.
pub const WRITERS: usize = 4;
/// Records kept back at most, in number and time, before the folder is synced for all of them.
const GROUP: usize = 64;
const GROUP_TIME: Duration = Duration::from_millis(500);

/// Takes products off the queue and writes their files; failures become failed records. A full
/// disk asks the whole run to stop, since every later image would fail the same way.
pub fn write_products(
    out: &Path,
    queue: &Arc<Mutex<Receiver<Product>>>,
    records: &Sender<Record>,
    stop: &Interrupt,
) {
    loop {
        let next = match queue.lock() {
            Ok(queue) => queue.recv(),
            Err(poisoned) => poisoned.into_inner().recv(),
        };
        let Ok(product) = next else { return };
        let mut record = product.record;
        for (name, bytes) in &product.files {
            if let Err(error) = write_file(&out.join(name), bytes) {
                if error.kind() == io::ErrorKind::StorageFull {
                    stop.request();
                }
                record.status = Status::Failed;
                record.reason = format!("cannot write {name}: {error}");
                record.outputs.clear();
                break;
            }
        }
        if records.send(record).is_err() {
            return;
        }
    }
}

fn write_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = AtomicFile::create(path)?;
    file.file().write_all(bytes)?;
    file.commit()
}

/// Collects records, makes their files durable in groups, journals them, and keeps them.
///
/// # Errors
/// The journal cannot be written; the files of the last group are then redone by the next run.
pub fn keep_records(
    out: &Path,
    records: &Receiver<Record>,
    journal: &mut Journal,
    progress: &Progress,
    mut keep: impl FnMut(Record),
) -> Result<(), JournalError> {
    let mut group: Vec<Record> = Vec::new();
    let mut since = Instant::now();
    loop {
        let wait = GROUP_TIME.saturating_sub(since.elapsed());
        let ended = match records.recv_timeout(wait) {
            Ok(record) => {
                if group.is_empty() {
                    since = Instant::now();
                }
                if record.status == Status::Failed {
                    progress.line(&format!("failed: {}: {}", record.name, record.reason));
                }
                group.push(record);
                progress.add(1);
                false
            }
            Err(RecvTimeoutError::Timeout) => false,
            Err(RecvTimeoutError::Disconnected) => true,
        };
        if !group.is_empty() && (ended || group.len() >= GROUP || since.elapsed() >= GROUP_TIME) {
            sync_folder(out).map_err(|source| JournalError::Io {
                action: "sync",
                path: out.to_owned(),
                source,
            })?;
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
