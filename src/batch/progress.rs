//! Progress of long work: a bar on a terminal, plain lines elsewhere, nothing when asked for quiet.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Seconds between two plain lines when standard error is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);

/// Progress of a known number of items; shared by all threads; written to standard error.
#[derive(Debug)]
pub struct Progress {
    bar: ProgressBar,
    title: &'static str,
    unit: &'static str,
    total: u64,
    done: AtomicU64,
    started: Instant,
    /// When the last plain line was written; `None` when a bar is drawn or progress is off.
    plain: Option<Mutex<Instant>>,
}

impl Progress {
    /// Starts counting `total` items of a `unit` (plural, for example `images`).
    #[must_use]
    pub fn new(title: &'static str, unit: &'static str, total: usize, quiet: bool) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = if quiet || !terminal {
            ProgressBar::with_draw_target(Some(total as u64), ProgressDrawTarget::hidden())
        } else {
            ProgressBar::new(total as u64)
        };
        let style = "{msg} [{bar:32}] {pos}/{len} {prefix}  {per_sec}  ETA {eta}";
        if let Ok(style) = ProgressStyle::with_template(style) {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_message(title);
        bar.set_prefix(unit);
        let started = Instant::now();
        let plain = (!quiet && !terminal).then(|| Mutex::new(started));
        Self { bar, title, unit, total: total as u64, done: AtomicU64::new(0), started, plain }
    }

    /// Counts `items` more as finished.
    pub fn add(&self, items: u64) {
        self.bar.inc(items);
        let done = self.done.fetch_add(items, Ordering::Relaxed) + items;
        let Some(Ok(mut last)) = self.plain.as_ref().map(Mutex::lock) else { return };
        if last.elapsed() >= PLAIN_INTERVAL {
            *last = Instant::now();
            let seconds = self.started.elapsed().as_secs_f64();
            let rate = done as f64 / seconds;
            let left = (self.total.saturating_sub(done)) as f64 / rate;
            self.line(&format!(
                "{}: {done}/{} {} ({rate:.1}/s, about {left:.0} s left)",
                self.title, self.total, self.unit
            ));
        }
    }

    /// Prints a line (a warning, an item's error) without tearing the bar.
    pub fn line(&self, text: &str) {
        self.bar.suspend(|| {
            // A closed standard error must not end the work.
            let _ = writeln!(std::io::stderr(), "{text}");
        });
    }

    /// Removes the bar; seconds since the start.
    pub fn finish(&self) -> f64 {
        self.bar.finish_and_clear();
        self.started.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_from_many_threads() {
        let progress = Progress::new("testing", "items", 1000, true);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..250).for_each(|_| progress.add(1)));
            }
        });
        assert_eq!(progress.done.load(Ordering::Relaxed), 1000);
        assert!(progress.finish() >= 0.0);
    }
}
