//! The error budget: every step that could be done in more than one way states a bound on its
//! error, its cost and its cause, side by side; a [`Plan`] is resolved from them before work starts.
//!
//! A plan is a plain value: `--explain` prints it, its hash goes into the manifest, and the run
//! executes what it says and nothing else. To hold it to that, each place in the code that carries
//! a step out says so by [`runs`]; `--log sat3d::plan=trace` prints what was said, and tests compare
//! it with the steps that are on.

pub(crate) mod network;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::sync::{Mutex, PoisonError};

/// Bounds on the error that a step makes, position and height apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bound {
    /// Displacement on the ground, metres.
    pub horizontal_m: f64,
    /// Error of height that is not a consequence of the displacement, metres. The height error
    /// that a displacement causes is `horizontal_m` times the steepest gradient of the source in
    /// the footprint, found per image.
    pub vertical_m: f64,
}

impl Bound {
    /// No error beyond the rounding of the stored `f32`.
    pub const EXACT: Self = Self { horizontal_m: 0.0, vertical_m: 0.0 };

    /// A bound on position alone.
    #[must_use]
    pub const fn horizontal(metres: f64) -> Self {
        Self { horizontal_m: metres, vertical_m: 0.0 }
    }

    /// A bound on height alone.
    #[must_use]
    pub const fn vertical(metres: f64) -> Self {
        Self { horizontal_m: 0.0, vertical_m: metres }
    }
}

/// One step of a plan: what is done (or left out), how wrong it can be, what it costs, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// Stable identifier, for example `datum`.
    pub id: String,
    /// Whether the step runs.
    pub on: bool,
    /// The form in which it runs, or would run: `chebyshev 3 x 3`, `bilinear`.
    pub form: String,
    /// Bound of the error made by doing the step in this form, or by leaving it out.
    pub bound: Bound,
    /// What the step costs, in words with units: `13 projections per image`.
    pub cost: String,
    /// What in the input makes the step matter.
    pub cause: String,
    /// Why it is on, off, or in this form.
    pub reason: String,
}

impl Step {
    /// A step that makes no error in position or height of its own.
    pub(crate) fn exact(
        id: &str,
        on: bool,
        form: impl Into<String>,
        [cost, cause, reason]: [&str; 3],
    ) -> Self {
        Self {
            id: id.into(),
            on,
            form: form.into(),
            bound: Bound::EXACT,
            cost: cost.into(),
            cause: cause.into(),
            reason: reason.into(),
        }
    }
}

/// Says that the step `id` of the plan is carried out here: once in the life of the program, however
/// often it is. Costs a comparison where nobody listens.
#[inline]
pub fn runs(id: &str) {
    if tracing::enabled!(target: "sat3d::plan", tracing::Level::TRACE) {
        say_once(id);
    }
}

#[cold]
fn say_once(id: &str) {
    static SAID: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    if SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(id.to_owned()) {
        tracing::trace!(target: "sat3d::plan", "step {id}");
    }
}

/// A resolved plan: parameters that decide the bytes of the output, and the steps that run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// The subcommand, for example `dsm-bench build`.
    pub command: String,
    /// Horizontal budget asked for, metres; 0 for a command without one.
    pub tolerance_m: f64,
    /// All parameters that the output's bytes depend on.
    pub parameters: serde_json::Map<String, serde_json::Value>,
    /// The steps, in order of execution.
    pub steps: Vec<Step>,
}

impl Plan {
    /// SHA-256 of the plan's canonical JSON, hexadecimal: equal plans give equal bytes.
    #[must_use]
    pub fn hash(&self) -> String {
        let json = serde_json::to_vec(self).unwrap_or_default();
        hex(&Sha256::digest(&json))
    }

    /// Sum of the horizontal bounds of all steps under this program's control, metres: that of
    /// the step with id [`Self::OPERATION`] is a property of the CRS definitions and kept apart.
    #[must_use]
    pub fn horizontal_m(&self) -> f64 {
        self.steps.iter().filter(|s| s.id != Self::OPERATION).map(|s| s.bound.horizontal_m).sum()
    }

    /// Sum of the vertical bounds of all steps, metres.
    #[must_use]
    pub fn vertical_m(&self) -> f64 {
        self.steps.iter().map(|s| s.bound.vertical_m).sum()
    }

    /// Id of the step whose bound is the stated accuracy of a coordinate operation.
    pub const OPERATION: &'static str = "operation-accuracy";

    /// The step with an id.
    #[must_use]
    pub fn step(&self, id: &str) -> Option<&Step> {
        self.steps.iter().find(|s| s.id == id)
    }

    /// Whether the step with an id runs; one that the plan does not name does not. The place that asks
    /// is the one that carries it out: a step that runs is reported by [`runs`].
    #[must_use]
    pub fn runs(&self, id: &str) -> bool {
        let on = self.steps.iter().any(|step| step.id == id && step.on);
        if on {
            runs(id);
        }
        on
    }

    /// The table that `--explain` prints; the dominating terms are marked with `*`.
    #[must_use]
    pub fn explain(&self) -> String {
        let mut out = String::new();
        let tolerance = match self.tolerance_m {
            0.0 => String::new(),
            tolerance => format!("  (tolerance {} m)", metres(tolerance)),
        };
        let _ = writeln!(out, "plan for `sat3d {}`{tolerance}", self.command);
        let width = |f: fn(&Step) -> usize, title: &str| {
            self.steps.iter().map(f).max().unwrap_or(0).max(title.len())
        };
        let id = width(|s| s.id.chars().count(), "step");
        let form = width(|s| s.form.chars().count(), "form");
        let _ = writeln!(
            out,
            "  {:id$}  {:3}  {:form$}  {:>13}  {:>12}",
            "step", "run", "form", "horizontal m", "vertical m"
        );
        let top = |f: fn(&Step) -> f64| self.steps.iter().map(f).fold(0.0, f64::max);
        let (top_h, top_v) = (top(|s| s.bound.horizontal_m), top(|s| s.bound.vertical_m));
        for step in &self.steps {
            let mark = |value: f64, top: f64| {
                format!("{}{}", metres(value), if value > 0.0 && value == top { "*" } else { " " })
            };
            let _ = writeln!(
                out,
                "  {:id$}  {:3}  {:form$}  {:>13}  {:>12}",
                step.id,
                if step.on { "on" } else { "off" },
                step.form,
                mark(step.bound.horizontal_m, top_h),
                mark(step.bound.vertical_m, top_v),
            );
            let _ = writeln!(
                out,
                "  {:id$}       {} [cause: {}; cost: {}]",
                "", step.reason, step.cause, step.cost
            );
        }
        let _ = writeln!(
            out,
            "  sum of bounds under the program's control: {} m horizontal, {} m vertical;  * = dominating term",
            metres(self.horizontal_m()),
            metres(self.vertical_m()),
        );
        out
    }
}

/// A length for a table: 0 as `0`, small values in scientific notation.
fn metres(value: f64) -> String {
    match value {
        0.0 => "0".to_owned(),
        v if (1e-3..1e4).contains(&v) => format!("{v:.3}"),
        v => format!("{v:.1e}"),
    }
}

/// Lower-case hexadecimal of a digest.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan() -> Plan {
        let step = |id: &str, h: f64| Step {
            bound: Bound::horizontal(h),
            ..Step::exact(id, true, "exact", ["none", "always", "default"])
        };
        Plan {
            command: "test".into(),
            tolerance_m: 1e-6,
            parameters: serde_json::Map::new(),
            steps: vec![step("transform", 5e-9), step(Plan::OPERATION, 1.0)],
        }
    }

    #[test]
    fn the_stated_accuracy_is_marked_but_not_summed() {
        let plan = plan();
        assert_eq!(plan.horizontal_m(), 5e-9);
        let text = plan.explain();
        assert!(text.contains("1.000*") && text.contains("5.0e-9 "), "{text}");
    }

    #[test]
    fn the_hash_changes_with_any_parameter() {
        let (a, mut b) = (plan(), plan());
        assert_eq!(a.hash(), b.hash());
        b.parameters.insert("zoom".into(), 20.into());
        assert_ne!(a.hash(), b.hash());
    }
}
