//! What a person sees of an evaluation: the table on a terminal, JSON, CSV and Parquet, HTML.
//!
//! Everything here is a function of the [`EvaluationSet`] alone, without dates or machine names:
//! the same evaluation gives the same bytes.

mod data;
mod html;
mod number;
mod picture;
mod score;
mod terminal;

pub use data::{json, per_image_table};
pub use html::{Panel, html};
pub use terminal::terminal;

use super::summary::{Evaluation, EvaluationSet};
use std::collections::BTreeSet;

/// What tells the evaluations of a set apart: the model, the protocol, or both.
fn labels(set: &EvaluationSet) -> Vec<String> {
    let models: BTreeSet<&str> = set.evaluations.iter().map(|e| e.model.as_str()).collect();
    let protocols: BTreeSet<&str> = set.evaluations.iter().map(|e| e.protocol.name()).collect();
    let label = |e: &Evaluation| match (models.len() > 1, protocols.len() > 1) {
        (true, true) => format!("{}, {}", e.model, e.protocol.name()),
        (false, true) => e.protocol.name().to_owned(),
        _ => e.model.clone(),
    };
    set.evaluations.iter().map(label).collect()
}

#[cfg(test)]
use crate as library;
#[cfg(test)]
#[path = "../../../tests/suite/eval_support/sample.rs"]
mod sample;
