//! What is counted on the way: examples, skips, and the sums of the log's next line.

use super::data::Batch;
use crate::model::train::Term;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Most items of one reason that are named.
const NAMED: usize = 20;

/// Items that were no good for one reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// How often one was drawn.
    pub draws: u64,
    /// The first of them, with what is wrong.
    pub items: Vec<String>,
}

/// The mean of one term over the steps of a log line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Sum {
    name: String,
    sum: f64,
    steps: u64,
}

/// What was counted since the first step, whatever was interrupted in between.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Examples that were learnt from.
    pub images: u64,
    /// Examples without a depth label among them.
    pub without_depth: u64,
    /// Batches that were skipped for values that are not finite.
    pub skipped_batches: u64,
    /// How many of them stand at the end, without one that was learnt from after them.
    pub skipped_in_a_row: u64,
    /// Items that were no good, by the kind of reason.
    pub skipped_items: BTreeMap<String, Skipped>,
    /// Sums of the terms since the last line of the log.
    sums: Vec<Sum>,
}

impl Progress {
    /// Counts the items that a batch left out; the kinds of reasons that are new.
    pub(super) fn items(&mut self, batch: &Batch) -> Vec<String> {
        let mut new = Vec::new();
        for skip in &batch.skips {
            let skipped = self.skipped_items.entry(skip.reason.kind()).or_default();
            let text = format!("{}: {}", skip.item, skip.reason);
            if skipped.draws == 0 {
                new.push(text.clone());
            }
            skipped.draws += 1;
            if skipped.items.len() < NAMED && !skipped.items.contains(&text) {
                skipped.items.push(text);
            }
        }
        new
    }

    /// Counts a batch that was learnt from.
    pub(super) fn stepped(&mut self, batch: &Batch, terms: &[Term]) {
        self.images += batch.examples.len() as u64;
        let without = batch.examples.iter().filter(|example| example.depth.is_none()).count();
        self.without_depth += without as u64;
        self.skipped_in_a_row = 0;
        for term in terms {
            let value = f64::from(term.value);
            match self.sums.iter_mut().find(|sum| sum.name == term.name) {
                Some(sum) => {
                    sum.sum += value;
                    sum.steps += 1;
                }
                None => self.sums.push(Sum { name: term.name.to_owned(), sum: value, steps: 1 }),
            }
        }
    }

    /// Counts a batch that was not finite.
    pub(super) fn skipped(&mut self) {
        self.skipped_batches += 1;
        self.skipped_in_a_row += 1;
    }

    /// The means of the terms since the last call, in the order in which they first came.
    pub(super) fn means(&mut self) -> Vec<(String, f64)> {
        std::mem::take(&mut self.sums)
            .into_iter()
            .map(|sum| (sum.name, sum.sum / sum.steps as f64))
            .collect()
    }

    /// Draws whose item was no good.
    #[must_use]
    pub fn skipped_draws(&self) -> u64 {
        self.skipped_items.values().map(|skipped| skipped.draws).sum()
    }
}
