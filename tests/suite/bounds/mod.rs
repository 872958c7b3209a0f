//! Every bound that a plan states is held, position and height apart; what a step left out would
//! have changed stays within its bound; and leaving it out saves work that can be counted.
//!
//! One file per plan. [`ledger`] fails when a plan has a step that no test here names.
//! `cargo test --test suite bounds:: -- --nocapture` prints the shares that `docs/bounds.md` gives.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

mod build;
mod build_heights;
mod build_positions;
mod infer;
mod ledger;
mod simulate;
mod tile;

use sat3d::random::Draw;

/// Numbers of a fixed seed: the same in every run.
fn draw(seed: u64) -> Draw {
    Draw::new(&[0xB0, seed])
}

/// Errors beside the bounds that were stated for them.
struct Share {
    what: String,
    count: usize,
    worst: f64,
    error: f64,
    bound: f64,
    at: String,
}

impl Share {
    fn new(what: &str) -> Self {
        let (what, at) = (what.to_owned(), String::new());
        Self { what, count: 0, worst: 0.0, error: 0.0, bound: 0.0, at }
    }

    /// An error and the bound of it; `at` says where.
    fn add(&mut self, error: f64, bound: f64, at: impl Fn() -> String) {
        self.count += 1;
        let share = if error == 0.0 { 0.0 } else { error / bound };
        // NaN counts as the worst.
        if share > self.worst || share.is_nan() {
            (self.worst, self.error, self.bound, self.at) = (share, error, bound, at());
        }
    }

    /// Prints the worst share, and fails where a bound did not hold.
    #[track_caller]
    fn check(&self) {
        let Self { what, count, worst, error, bound, at } = self;
        println!("bound: {what}: worst share {worst:.3} of {count} ({error:.3e} of {bound:.3e} m)");
        assert!(*count > 0, "{what}: nothing was measured");
        assert!(*worst <= 1.0, "{what}: {error:e} m where {bound:e} m is stated: {at}");
    }
}
