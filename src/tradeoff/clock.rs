//! Measuring time: warm, in turns, in one process.
//!
//! Every way is run once before anything is timed: that fills caches and gives the result that is judged. Then come
//! rounds; each runs every way once, beginning with another one each time, so that what slows the machine
//! for a while slows all of them. Work that is short is repeated within a round.

use super::TradeoffError;
use super::report::{Also, Quantity, Seconds, Setting, Skipped};
use crate::batch::Interrupt;
use std::time::Instant;

/// Fewest rounds of anything.
const LEAST_ROUNDS: usize = 3;

/// One way of doing a piece of work.
pub(super) struct Way<'a, T> {
    name: String,
    default: bool,
    work: Box<dyn FnMut() -> Result<T, TradeoffError> + 'a>,
}

impl<'a, T> Way<'a, T> {
    pub(super) fn new(
        name: impl Into<String>,
        default: bool,
        work: impl FnMut() -> Result<T, TradeoffError> + 'a,
    ) -> Self {
        Self { name: name.into(), default, work: Box::new(work) }
    }
}

/// How far a result is from the truth.
#[derive(Default)]
pub(super) struct Judged {
    pub error: f64,
    pub bound: Option<f64>,
    pub also: Vec<Also>,
}

impl Judged {
    pub(super) fn new(error: f64) -> Self {
        Self { error, ..Self::default() }
    }

    pub(super) fn bounded(mut self, bound: f64) -> Self {
        self.bound = Some(bound);
        self
    }

    pub(super) fn also(mut self, name: &str, unit: &str, value: f64) -> Self {
        self.also.push(Also { quantity: Quantity::new(name, unit), value });
        self
    }
}

/// What a study says of itself.
pub(super) struct Subject {
    pub truth: &'static str,
    pub error: Quantity,
    pub work: String,
    /// Units of that work in one call of a [`Way`].
    pub units: f64,
}

/// What measuring a switch gave.
pub(super) struct Findings {
    pub truth: &'static str,
    pub error: Quantity,
    pub work: String,
    pub settings: Vec<Setting>,
    /// Positions that this machine or build does not have.
    pub skipped: Vec<Skipped>,
}

/// A way while it is measured.
struct Runner<'a, T> {
    way: Way<'a, T>,
    judged: Judged,
    /// Calls of one measurement.
    repeats: usize,
    /// Seconds of a unit of work, one a round.
    times: Vec<f64>,
}

impl<T> Runner<'_, T> {
    fn setting(self) -> Setting {
        Setting {
            name: self.way.name,
            default: self.way.default,
            error: self.judged.error,
            bound: self.judged.bound,
            also: self.judged.also,
            seconds: Seconds::of(self.times),
            pareto: false,
        }
    }
}

/// Rounds and times of a run.
pub(super) struct Clock<'a> {
    rounds: usize,
    /// Seconds that the rounds of one switch may take together.
    budget: f64,
    /// Least seconds of one measurement.
    sample: f64,
    stop: &'a Interrupt,
}

impl<'a> Clock<'a> {
    pub(super) fn new(rounds: usize, quick: bool, stop: &'a Interrupt) -> Self {
        let (budget, sample) = if quick { (1.2, 5e-3) } else { (30.0, 30e-3) };
        Self { rounds, budget, sample, stop }
    }

    /// Runs all ways in turns and judges the first result of each. A way that refuses the input and is not the
    /// default is listed as skipped, with its reason.
    ///
    /// # Errors
    /// The first error of a way or of the judge; [`TradeoffError::Interrupted`].
    pub(super) fn measure<T>(
        &self,
        subject: Subject,
        ways: Vec<Way<'_, T>>,
        mut judge: impl FnMut(&T) -> Result<Judged, TradeoffError>,
    ) -> Result<Findings, TradeoffError> {
        let mut skipped = Vec::new();
        let mut runners = Vec::with_capacity(ways.len());
        let mut round = 0.0;
        for mut way in ways {
            let mut once = 0.0;
            let first = match self.time(&mut once, &mut way.work) {
                Err(error) if error.is_refusal() && !way.default => {
                    skipped.push(Skipped { name: way.name, reason: error.to_string() });
                    continue;
                }
                first => first?,
            };
            let judged = judge(&first)?;
            drop(first);
            // What is slow when it is cold is not worth a second look before the rounds.
            if once < self.sample * 10.0 {
                self.time(&mut once, &mut way.work)?;
            }
            let repeats = (self.sample / once.max(1e-9)).ceil().clamp(1.0, 1000.0);
            round += once * repeats;
            runners.push(Runner { way, judged, repeats: repeats as usize, times: Vec::new() });
        }
        let rounds = self.rounds.min(((self.budget / round) as usize).max(LEAST_ROUNDS));
        for first in 0..rounds {
            for k in 0..runners.len() {
                let at = (first + k) % runners.len();
                let runner = &mut runners[at];
                let started = Instant::now();
                for _ in 0..runner.repeats {
                    self.go_on()?;
                    std::hint::black_box((runner.way.work)()?);
                }
                let seconds = started.elapsed().as_secs_f64();
                runner.times.push(seconds / (runner.repeats as f64 * subject.units));
            }
        }
        let settings = runners.into_iter().map(Runner::setting).collect();
        let Subject { truth, error, work, .. } = subject;
        Ok(Findings { truth, error, work, settings, skipped })
    }

    fn time<T>(
        &self,
        seconds: &mut f64,
        work: &mut dyn FnMut() -> Result<T, TradeoffError>,
    ) -> Result<T, TradeoffError> {
        self.go_on()?;
        let started = Instant::now();
        let result = work()?;
        *seconds = started.elapsed().as_secs_f64();
        Ok(result)
    }

    fn go_on(&self) -> Result<(), TradeoffError> {
        if self.stop.requested() { Err(TradeoffError::Interrupted) } else { Ok(()) }
    }
}
