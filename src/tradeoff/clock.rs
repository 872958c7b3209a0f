//! Measuring time: warm, in turns, in one process.
//!
//! Every way is run once before anything is timed: that fills caches and gives the result that is judged. Then come
//! rounds; each runs every way once, beginning with another one each time, so that what slows the machine
//! for a while slows all of them. Work that is short is repeated within a round.

use super::report::{Also, Quantity, Seconds, Setting, Skipped};
use super::{Switch, TradeoffError};
use crate::batch::Interrupt;
use crate::tradeoff::Stage;
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

    /// Runs all ways in turns and judges the first result of each.
    ///
    /// # Errors
    /// The first error of a way or of the judge; [`TradeoffError::Interrupted`].
    pub(super) fn measure<T>(
        &self,
        subject: Subject,
        mut ways: Vec<Way<'_, T>>,
        mut judge: impl FnMut(&T) -> Result<Judged, TradeoffError>,
    ) -> Result<Switch, TradeoffError> {
        let mut judged = Vec::with_capacity(ways.len());
        let mut repeats = Vec::with_capacity(ways.len());
        let mut round = 0.0;
        for way in &mut ways {
            let mut once = 0.0;
            let first = self.time(&mut once, &mut way.work)?;
            judged.push(judge(&first)?);
            drop(first);
            // What is slow when it is cold is not worth a second look before the rounds.
            if once < self.sample * 10.0 {
                self.time(&mut once, &mut way.work)?;
            }
            let repeat = (self.sample / once.max(1e-9)).ceil().clamp(1.0, 1000.0);
            repeats.push(repeat as usize);
            round += once * repeat;
        }
        let rounds = self.rounds.min(((self.budget / round) as usize).max(LEAST_ROUNDS));
        let mut times = vec![Vec::with_capacity(rounds); ways.len()];
        for first in 0..rounds {
            for k in 0..ways.len() {
                let at = (first + k) % ways.len();
                let started = Instant::now();
                for _ in 0..repeats[at] {
                    self.go_on()?;
                    std::hint::black_box((ways[at].work)()?);
                }
                let seconds = started.elapsed().as_secs_f64();
                times[at].push(seconds / (repeats[at] as f64 * subject.units));
            }
        }
        let settings = ways
            .into_iter()
            .zip(judged)
            .zip(times)
            .map(|((way, judged), times)| Setting {
                name: way.name,
                default: way.default,
                error: judged.error,
                bound: judged.bound,
                also: judged.also,
                seconds: Seconds::of(times),
                pareto: false,
            })
            .collect();
        Ok(Switch {
            stage: Stage::Build,
            switch: String::new(),
            cause: String::new(),
            truth: subject.truth.into(),
            error: subject.error,
            work: subject.work,
            settings,
            skipped: Vec::<Skipped>::new(),
        })
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
