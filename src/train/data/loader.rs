//! Examples made ahead of time, handed out in the order of their draws.

use super::{Skip, Source};
use crate::model::train::Example;
use crate::train::error::TrainingError;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// The examples of one step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// The examples, in the order of their draws.
    pub examples: Vec<Example>,
    /// Items that were no good, in the same order; another one took the place of each.
    pub skips: Vec<Skip>,
}

/// What became of a draw.
enum Made {
    Example(Box<Example>, Vec<Skip>),
    /// No item of the source is any good.
    Nothing(Vec<Skip>),
    Panicked(String),
}

#[derive(Default)]
struct State {
    /// The next draw that a thread takes.
    next: u64,
    /// The draw that is waited for.
    wanted: u64,
    made: BTreeMap<u64, Made>,
    stop: bool,
}

struct Shared {
    source: Arc<dyn Source>,
    /// Draws after the last of the training.
    end: u64,
    /// Most draws that are made or in the making.
    ahead: u64,
    state: Mutex<State>,
    /// Something was made.
    made: Condvar,
    /// There is room.
    room: Condvar,
}

/// Makes examples on threads of its own, at most a few batches ahead of the one that is asked for.
pub struct Loader {
    shared: Arc<Shared>,
    batch: u64,
    /// Its threads: pools of one each, so that what is parallel inside an example stays on its thread. In a pool
    /// of several, a thread that waits for a part of its scene would take up another example, and could wait there
    /// for a scene that only it can finish. They end with the loader.
    _threads: Vec<rayon::ThreadPool>,
}

impl std::fmt::Debug for Loader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loader").field("batch", &self.batch).finish_non_exhaustive()
    }
}

/// Locks; what a panicked thread left is whole, as every change is one assignment.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Loader {
    /// Starts at a step; `steps` is where the training ends. `batch` examples make a step, `threads` threads make
    /// them, `ahead` batches in advance.
    ///
    /// # Errors
    /// [`TrainingError::Example`] where the system gives no threads.
    pub fn start(
        source: Arc<dyn Source>,
        step: u64,
        steps: u64,
        batch: usize,
        threads: usize,
        ahead: usize,
    ) -> Result<Self, TrainingError> {
        let batch = batch.max(1) as u64;
        let threads = threads.max(1);
        let first = step * batch;
        let shared = Arc::new(Shared {
            source,
            end: steps * batch,
            ahead: (batch * (1 + ahead as u64)).max(threads as u64),
            state: Mutex::new(State { next: first, wanted: first, ..State::default() }),
            made: Condvar::new(),
            room: Condvar::new(),
        });
        let start = |index: usize| {
            let thread = rayon::ThreadPoolBuilder::new()
                .num_threads(1)
                .thread_name(move |_| format!("examples-{index}"))
                .build()?;
            let shared = Arc::clone(&shared);
            thread.spawn(move || shared.work());
            Ok(thread)
        };
        let threads = (0..threads).map(start).collect::<Result<_, rayon::ThreadPoolBuildError>>();
        let threads = threads
            .map_err(|error| TrainingError::Example { draw: first, why: error.to_string() })?;
        Ok(Self { shared, batch, _threads: threads })
    }

    /// The examples of the next step.
    ///
    /// # Errors
    /// [`TrainingError::NothingLeft`] when no item of the data is any good; [`TrainingError::Example`] when a
    /// thread panicked.
    pub fn take(&mut self) -> Result<Batch, TrainingError> {
        let mut batch = Batch::default();
        for _ in 0..self.batch {
            let mut state = lock(&self.shared.state);
            let draw = state.wanted;
            let made = loop {
                if let Some(made) = state.made.remove(&draw) {
                    break made;
                }
                state = self.shared.made.wait(state).unwrap_or_else(PoisonError::into_inner);
            };
            state.wanted = draw + 1;
            drop(state);
            self.shared.room.notify_all();
            match made {
                Made::Example(example, skips) => {
                    batch.examples.push(*example);
                    batch.skips.extend(skips);
                }
                Made::Nothing(skips) => {
                    return Err(TrainingError::NothingLeft {
                        what: self.shared.source.describe(),
                        why: counted(&skips),
                    });
                }
                Made::Panicked(why) => return Err(TrainingError::Example { draw, why }),
            }
        }
        Ok(batch)
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        lock(&self.shared.state).stop = true;
        self.shared.room.notify_all();
    }
}

impl Shared {
    fn work(&self) {
        loop {
            let mut state = lock(&self.state);
            let draw = loop {
                if state.stop || state.next >= self.end {
                    return;
                }
                if state.next < state.wanted + self.ahead {
                    break state.next;
                }
                state = self.room.wait(state).unwrap_or_else(PoisonError::into_inner);
            };
            state.next = draw + 1;
            drop(state);
            let made = catch_unwind(AssertUnwindSafe(|| make(self.source.as_ref(), draw)))
                .unwrap_or_else(|panic| Made::Panicked(said(panic.as_ref())));
            lock(&self.state).made.insert(draw, made);
            self.made.notify_all();
        }
    }
}

fn make(source: &dyn Source, draw: u64) -> Made {
    let mut skips = Vec::new();
    for attempt in 0..source.len() {
        match source.example(draw, attempt) {
            Ok(example) => return Made::Example(Box::new(example), skips),
            Err(skip) => skips.push(skip),
        }
    }
    Made::Nothing(skips)
}

fn said(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("unknown cause")
        .to_owned()
}

/// `all 12 items are no good: 10 panorama missing, 2 sky mask of another size; the first: ...`.
fn counted(skips: &[Skip]) -> String {
    let mut counts = BTreeMap::<String, usize>::new();
    for skip in skips {
        *counts.entry(skip.reason.kind()).or_default() += 1;
    }
    let list: Vec<String> = counts.iter().map(|(kind, count)| format!("{count} {kind}")).collect();
    let first = skips.first().map(|skip| format!("; the first: {}: {}", skip.item, skip.reason));
    format!(
        "none of {} items is any good ({}){}",
        skips.len(),
        list.join(", "),
        first.unwrap_or_default()
    )
}

#[cfg(test)]
#[path = "loader_tests.rs"]
mod tests;
