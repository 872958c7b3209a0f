//! What was found.

use super::{Machine, Stage};
use crate::plan::Plan;
use serde::Serialize;

/// What one axis of a chart shows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Quantity {
    /// In words, for example `RMS height error`.
    pub name: String,
    /// Its unit.
    pub unit: String,
}

impl Quantity {
    pub(super) fn new(name: &str, unit: &str) -> Self {
        Self { name: name.into(), unit: unit.into() }
    }
}

/// A further number of a setting.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Also {
    /// What it is.
    #[serde(flatten)]
    pub quantity: Quantity,
    /// The number.
    pub value: f64,
}

/// Seconds of one unit of work.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Seconds {
    /// The middle one of all rounds.
    pub median: f64,
    /// A quarter of the rounds took less.
    pub lower_quartile: f64,
    /// A quarter of the rounds took longer.
    pub upper_quartile: f64,
    /// Rounds.
    pub rounds: usize,
}

impl Seconds {
    /// Of the rounds' times, in any order.
    ///
    /// # Panics
    /// Without any.
    #[must_use]
    pub fn of(mut rounds: Vec<f64>) -> Self {
        rounds.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let place = share * (rounds.len() - 1) as f64;
            let (low, part) = (place as usize, place.fract());
            rounds[low] + part * (rounds[(low + 1).min(rounds.len() - 1)] - rounds[low])
        };
        Self {
            median: at(0.5),
            lower_quartile: at(0.25),
            upper_quartile: at(0.75),
            rounds: rounds.len(),
        }
    }
}

/// One position of a switch.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setting {
    /// Its name.
    pub name: String,
    /// Whether it is what the program does unless told otherwise.
    pub default: bool,
    /// Error against the truth, in the unit of [`Switch::error`].
    pub error: f64,
    /// What the plan states as the bound of that error, where it states one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound: Option<f64>,
    /// Further numbers.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub also: Vec<Also>,
    /// How long it takes.
    pub seconds: Seconds,
    /// Whether no other setting is both as fast and as exact, and one of them better.
    pub pareto: bool,
}

/// What was not measured: a position of a switch that this machine, build or model does not have.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    /// Its name.
    pub name: String,
    /// Why it was not measured.
    pub reason: String,
}

/// A switch with all its positions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Switch {
    /// The stage.
    pub stage: Stage,
    /// Its name.
    pub switch: String,
    /// What in a scene makes it matter.
    pub cause: String,
    /// What the error is measured against.
    pub truth: String,
    /// What the error is.
    pub error: Quantity,
    /// What the time is for.
    pub work: String,
    /// Positions, in their own order.
    pub settings: Vec<Setting>,
    /// Positions that were not measured.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub skipped: Vec<Skipped>,
}

impl Switch {
    /// Says of each setting whether it is on the Pareto front of median time and error.
    pub fn mark_pareto(&mut self) {
        let points: Vec<[f64; 2]> =
            self.settings.iter().map(|s| [s.seconds.median, s.error]).collect();
        for (setting, &[time, error]) in self.settings.iter_mut().zip(&points) {
            setting.pareto =
                !points.iter().any(|&[t, e]| t <= time && e <= error && (t < time || e < error));
        }
    }

    /// The setting that is used unless told otherwise.
    #[must_use]
    pub fn default_setting(&self) -> Option<&Setting> {
        self.settings.iter().find(|setting| setting.default)
    }

    /// A setting that is at least as exact as the default, and faster beyond the spread of both: the upper
    /// quartile of the one is under the lower quartile of the other.
    #[must_use]
    pub fn beats_default(&self) -> Option<&Setting> {
        let default = self.default_setting()?;
        self.settings
            .iter()
            .filter(|s| s.error <= default.error)
            .filter(|s| s.seconds.upper_quartile < default.seconds.lower_quartile)
            .min_by(|a, b| a.seconds.median.total_cmp(&b.seconds.median))
    }
}

/// Everything that a run found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Program and version.
    pub software: String,
    /// Where it was measured.
    pub machine: Machine,
    /// Hash of the plan.
    pub plan_sha256: String,
    /// Which switches were measured, and why not others.
    pub plan: Plan,
    /// The switches.
    pub switches: Vec<Switch>,
    /// Switches of the plan that could not be measured, as `stage/switch`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<Skipped>,
    /// Whether the run was interrupted: the plan has more switches on than were measured.
    pub interrupted: bool,
    /// Seconds of the whole run.
    pub seconds: f64,
}
