//! The list of comparisons, and the limits that they are held to.

use super::golden::File;
use super::{Comparison, ParityError, Set};
use crate::network;

/// Errors of the NumPy implementation: set, file, tensor, relative L2, largest.
const ORACLE: &str = include_str!("../../fixtures/oracle.tsv");

/// How many times the oracle's largest error ours may be.
pub(super) const TIMES: f64 = 20.0;

/// The oracle's errors of one tensor: relative L2, and the largest single one.
pub(super) fn oracle(set: Set, file: &str, key: &str) -> Option<(f64, f64)> {
    // What all sets have in common was compared once.
    let set = if file == "common" { Set::Tiny } else { set };
    ORACLE.lines().find_map(|line| {
        let mut fields = line.split('\t');
        let found = [set.name(), file, key].into_iter().all(|name| fields.next() == Some(name));
        let mut number = || fields.next()?.parse().ok();
        found.then(|| Some((number()?, number()?))).flatten()
    })
}

/// Comparisons as they are made.
pub(super) struct Ledger<'a> {
    set: Set,
    each: &'a mut dyn FnMut(&Comparison),
    all: Vec<Comparison>,
}

/// What a stage's values are held to.
#[derive(Clone, Copy)]
pub(super) struct Stage {
    /// Its name in the list.
    pub name: &'static str,
    /// Relative L2 error.
    pub tolerance: f64,
    /// How many times the oracle's largest error ours may be.
    pub times: f64,
}

impl Stage {
    pub const fn new(name: &'static str, tolerance: f64) -> Self {
        Self { name, tolerance, times: TIMES }
    }
}

impl<'a> Ledger<'a> {
    pub fn new(set: Set, each: &'a mut dyn FnMut(&Comparison)) -> Self {
        Self { set, each, all: Vec::new() }
    }

    pub fn into_all(self) -> Vec<Comparison> {
        self.all
    }

    /// Holds our values of a whole tensor against the reference's, with the oracle's limit.
    pub fn compare(
        &mut self,
        stage: Stage,
        file: &File,
        key: &str,
        ours: &[f32],
    ) -> Result<(), ParityError> {
        let ours: Vec<f64> = ours.iter().map(|value| f64::from(*value)).collect();
        self.compare_f64(stage, file, key, &ours)
    }

    /// The same in double precision.
    pub fn compare_f64(
        &mut self,
        stage: Stage,
        file: &File,
        key: &str,
        ours: &[f64],
    ) -> Result<(), ParityError> {
        let allowed = oracle(self.set, file.name, key).map(|(_, largest)| stage.times * largest);
        self.compare_within(stage, file, key, ours, allowed.unwrap_or(f64::NAN))
    }

    /// A stage inside the network, shape included.
    pub fn compare_stage(
        &mut self,
        stage: Stage,
        file: &File,
        seen: &network::Stage,
    ) -> Result<(), ParityError> {
        let expected = file.expected(&seen.name)?.shape;
        let found: Vec<usize> = seen.shape.iter().copied().filter(|side| *side != 1).collect();
        if expected != found {
            return Err(ParityError::Shape {
                what: format!("{} {} {}", self.set, file.name, seen.name),
                expected: format!("{expected:?}"),
                found: format!("{found:?}"),
            });
        }
        self.compare(stage, file, &seen.name, &seen.values)
    }

    /// The same with a limit of the largest error that is not the oracle's.
    pub fn compare_within(
        &mut self,
        stage: Stage,
        file: &File,
        key: &str,
        ours: &[f64],
        largest_allowed: f64,
    ) -> Result<(), ParityError> {
        let expected = file.expected(key)?;
        let count: usize = expected.shape.iter().product();
        if count != ours.len() {
            return Err(ParityError::Shape {
                what: format!("{} {} {key}", self.set, file.name),
                expected: format!("{:?}, {count} values", expected.shape),
                found: format!("{} values", ours.len()),
            });
        }
        let name = format!("{} {key}", file.name);
        self.add(stage, &name, &expected.picked(ours), &expected.values, largest_allowed);
        Ok(())
    }

    /// Adds the comparison of two lists of one length.
    pub fn add(
        &mut self,
        stage: Stage,
        name: &str,
        ours: &[f64],
        reference: &[f64],
        largest_allowed: f64,
    ) {
        let (relative_l2, largest) = errors(ours, reference);
        let comparison = Comparison {
            stage: stage.name,
            what: format!("{} {name}", self.set),
            relative_l2,
            tolerance: stage.tolerance,
            largest,
            largest_allowed,
        };
        (self.each)(&comparison);
        self.all.push(comparison);
    }
}

/// Relative L2 error and largest single error; both NaN where any value is not finite or the lengths differ.
fn errors(ours: &[f64], reference: &[f64]) -> (f64, f64) {
    if ours.len() != reference.len() {
        return (f64::NAN, f64::NAN);
    }
    let (mut error, mut norm, mut largest) = (0.0, 0.0, 0.0_f64);
    for (ours, reference) in ours.iter().zip(reference) {
        let difference = (ours - reference).abs();
        // `max` would swallow a NaN, and infinities of one sign would cancel.
        if !difference.is_finite() {
            return (f64::NAN, f64::NAN);
        }
        error += difference * difference;
        norm += reference * reference;
        largest = largest.max(difference);
    }
    ((error / norm.max(1e-60)).sqrt(), largest)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;

    #[test]
    fn errors_are_relative_and_a_nan_fails() {
        assert_eq!(errors(&[3.0, 4.5], &[3.0, 4.0]), (0.1, 0.5));
        for bad in [f64::NAN, f64::INFINITY] {
            let (relative, largest) = errors(&[1.0, bad], &[1.0, bad]);
            assert!(relative.is_nan() && largest.is_nan());
        }
        assert!(errors(&[1.0], &[1.0, 2.0]).0.is_nan());
        let of = |relative_l2, largest| Comparison {
            stage: "x",
            what: "x".into(),
            relative_l2,
            tolerance: 1e-4,
            largest,
            largest_allowed: 1.0,
        };
        assert!(of(1e-4, 1.0).passes());
        assert!(!of(2e-4, 0.0).passes() && !of(0.0, 2.0).passes());
        assert!(!of(f64::NAN, 0.0).passes() && !of(0.0, f64::NAN).passes());
        assert!(!Comparison { largest_allowed: f64::NAN, ..of(0.0, 0.0) }.passes());
    }

    #[test]
    fn the_oracle_is_found_by_name() {
        let (relative, largest) = oracle(Set::Tiny, "04_ortho", "depth64").unwrap();
        assert!(relative > 1e-6 && relative < 1e-4 && largest > 1e-6 && largest < 1e-3);
        assert_eq!(oracle(Set::Full, "common", "x"), oracle(Set::Tiny, "common", "x"));
        assert_eq!(oracle(Set::Tiny, "04_ortho", "nothing"), None);
        assert!(ORACLE.lines().skip(1).all(|line| line.split('\t').count() == 5));
    }
}
