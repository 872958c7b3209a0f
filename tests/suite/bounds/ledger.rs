//! The table of bound tests: a step that a plan can have and no test names fails here.

use super::{build, infer, simulate, tile};
use sat3d::plan::Plan;
use std::collections::BTreeSet;

/// The steps of one command's plan, each with the tests that hold its bound. They are functions, so
/// that a test that is gone is a compiler's error.
pub type Ledger = &'static [(&'static str, &'static [fn()])];

#[track_caller]
fn complete(command: &str, ledger: Ledger, plans: &[Plan]) {
    assert!(plans.iter().all(|plan| plan.command == command));
    let steps: BTreeSet<&str> =
        plans.iter().flat_map(|plan| &plan.steps).map(|step| step.id.as_str()).collect();
    let tested: BTreeSet<&str> = ledger.iter().map(|(id, _)| *id).collect();
    let without: Vec<_> = steps.difference(&tested).collect();
    assert!(without.is_empty(), "{command}: no test holds the bound of {without:?}");
    let gone: Vec<_> = tested.difference(&steps).collect();
    assert!(gone.is_empty(), "{command}: no plan has the steps {gone:?}");
    assert!(ledger.iter().all(|(_, tests)| !tests.is_empty()));
    assert_eq!(ledger.len(), tested.len(), "{command}: a step is listed twice");
    println!("bound: {command}: {} steps, each with a test", tested.len());
}

/// Bounds are lengths, and a step that does nothing errs by nothing or says by what.
#[track_caller]
fn sensible(plans: &[Plan]) {
    for plan in plans {
        for step in &plan.steps {
            let lengths = [step.bound.horizontal_m, step.bound.vertical_m];
            assert!(lengths.iter().all(|m| m.is_finite() && *m >= 0.0), "{step:?}");
            assert!(!step.cause.is_empty() && !step.cost.is_empty() && !step.form.is_empty());
        }
        let sum: f64 = plan.steps.iter().map(|step| step.bound.vertical_m).sum();
        assert_eq!(plan.vertical_m(), sum);
    }
}

#[test]
fn every_step_of_every_plan_has_its_test() {
    let plans = [
        ("dsm-bench build", build::LEDGER, build::plans()),
        ("simulate", simulate::LEDGER, simulate::plans()),
        ("infer", infer::LEDGER, infer::plans()),
        ("tile", tile::LEDGER, tile::plans()),
    ];
    for (command, ledger, plans) in plans {
        complete(command, ledger, &plans);
        sensible(&plans);
    }
}
