//! How a training shows itself: a bar on a terminal, a line now and then elsewhere.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::fmt::Write as _;
use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// Time between two plain lines when standard error is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(30);
/// Share of the newest step in the loss and the speed that are shown.
const NEWEST: f64 = 0.05;

/// The display of one session.
#[derive(Debug)]
pub struct Live {
    bar: ProgressBar,
    /// When the last plain line was written; `None` when a bar is drawn or progress is off.
    plain: Option<Instant>,
    quiet: bool,
    steps: u64,
    /// Step at which this session began, and when.
    first: u64,
    started: Instant,
    images: u64,
    loss: Option<f64>,
}

impl Live {
    /// Begins at a step.
    #[must_use]
    pub fn new(step: u64, steps: u64, quiet: bool) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = match quiet || !terminal {
            true => ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::hidden()),
            false => ProgressBar::new(steps),
        };
        if let Ok(style) = ProgressStyle::with_template("training [{bar:28}] {pos}/{len}  {msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_position(step);
        let started = Instant::now();
        let plain = (!quiet && !terminal).then_some(started);
        Self { bar, plain, quiet, steps, first: step, started, images: 0, loss: None }
    }

    /// After a step.
    pub fn step(&mut self, step: u64, images: usize, loss: Option<f32>) {
        self.images += images as u64;
        if let Some(loss) = loss.map(f64::from).filter(|loss| loss.is_finite()) {
            self.loss = Some(self.loss.map_or(loss, |old| old + NEWEST * (loss - old)));
        }
        self.bar.set_position(step);
        self.bar.set_message(self.words(step));
        if self.plain.is_some_and(|last| last.elapsed() >= PLAIN_INTERVAL) {
            self.plain = Some(Instant::now());
            self.line(&format!("training: {step}/{} steps, {}", self.steps, self.words(step)));
        }
    }

    fn words(&self, step: u64) -> String {
        let mut text = String::new();
        if let Some(loss) = self.loss {
            let _ = write!(text, "loss {loss:.4}  ");
        }
        let seconds = self.seconds();
        let left = (self.steps - step.min(self.steps)) as f64 * seconds
            / (step - self.first).max(1) as f64;
        let _ = write!(text, "{:.1} images/s  {} left", self.images_per_second(), duration(left));
        text
    }

    /// Prints a line without tearing the bar; nothing when only errors are wanted.
    pub fn line(&self, text: &str) {
        if self.quiet {
            return;
        }
        self.bar.suspend(|| {
            // A closed standard error must not end the training.
            let _ = writeln!(std::io::stderr(), "{text}");
        });
    }

    /// Seconds of this session.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Examples a second in this session.
    #[must_use]
    pub fn images_per_second(&self) -> f64 {
        self.images as f64 / self.seconds().max(1e-9)
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// Seconds for people: `45 s`, `12 min`, `3 h 05 min`.
#[must_use]
pub fn duration(seconds: f64) -> String {
    // The cast saturates.
    let whole = (seconds + 0.5) as u64;
    match whole {
        0..120 => format!("{whole} s"),
        120..7200 => format!("{} min", (whole + 30) / 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_for_people() {
        let all = [0.2, 45.0, 119.0, 600.0, 7200.0, 11_100.0].map(duration);
        assert_eq!(all, ["0 s", "45 s", "119 s", "10 min", "2 h 00 min", "3 h 05 min"]);
        assert!(duration(f64::INFINITY).contains(" h "));
        assert_eq!(duration(f64::NAN), "0 s");
    }
}
