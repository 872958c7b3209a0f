//! Direct supervision by true heights, where there are any: simulated scenes. Neither the paper nor the release has
//! it; the small model does.
//!
//! Heights are metres, `batch x 1 x height x width`; a truth that is not finite is unknown and its pixel is
//! left out.

use super::safe::{keep, mean_where, weights};
use burn::tensor::{Bool, Int, Tensor, activation};

/// Constants of the height term.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Height {
    /// Where the smooth L1 of the logarithms turns from a parabola into a line, in units of `ln(1 m)`.
    pub beta: f64,
    /// Weight of the logarithmic part.
    pub log: f64,
    /// Weight of the mean absolute error in metres, once ramped in.
    pub l1: f64,
    /// Weight of the mean squared error in square metres, once ramped in.
    pub l2: f64,
}

impl Default for Height {
    /// The logarithmic part at weight 1 (`beta` 0.1, some 10 cm on the ground and 1 m on a roof of 10 m), 0.1
    /// a metre and 0.005 a square metre.
    fn default() -> Self {
        Self { beta: 0.1, log: 1.0, l1: 0.1, l2: 0.005 }
    }
}

/// The term and its parts, which are unweighted.
#[derive(Clone, Debug)]
pub struct HeightTerms {
    /// `log * LOG + ramp * (l1 * L1 + l2 * L2)`.
    pub total: Tensor<1>,
    /// Smooth L1 of [`symlog`].
    pub log: Tensor<1>,
    /// Mean absolute error, metres.
    pub l1: Tensor<1>,
    /// Mean squared error, square metres.
    pub l2: Tensor<1>,
}

/// A weight that grows from 0 to 1: 0 up to step `from`, 1 from step `to` on, a straight line between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ramp {
    /// Last step of weight 0.
    pub from: u64,
    /// First step of weight 1.
    pub to: u64,
}

impl Ramp {
    /// The weight at a step. A ramp that ends where it starts, or before, is a jump after `from`.
    #[must_use]
    pub fn at(&self, step: u64) -> f64 {
        if step <= self.from {
            0.0
        } else if step >= self.to {
            1.0
        } else {
            (step - self.from) as f64 / (self.to - self.from) as f64
        }
    }
}

/// Height term: means over the known pixels of the batch (0 without one).
///
/// `LOG = mean s(symlog(predicted) - symlog(truth))` with the [`smooth_l1`] `s`; `L1` and `L2` of the difference in metres.
/// `ramp` multiplies the two metric parts ([`Ramp::at`]).
#[must_use]
pub fn height(predicted: Tensor<4>, truth: Tensor<4>, options: &Height, ramp: f64) -> HeightTerms {
    let known = truth.clone().is_finite();
    let truth = keep(truth, &known);
    let predicted = keep(predicted, &known);
    let log = symlog(predicted.clone()) - symlog(truth.clone());
    let log = mean_where(smooth_l1(log, options.beta), &known);
    let difference = predicted - truth;
    let l1 = mean_where(difference.clone().abs(), &known);
    let l2 = mean_where(difference.clone() * difference, &known);
    let metric = l1.clone() * options.l1 + l2.clone() * options.l2;
    HeightTerms { total: log.clone() * options.log + metric * ramp, log, l1, l2 }
}

/// `sign(h) ln(1 + |h|)`: logarithmic far from the ground, slope 1 at it, for heights a little below 0 too.
#[must_use]
pub fn symlog<const D: usize>(height: Tensor<D>) -> Tensor<D> {
    // Of `sign` and `abs` the slope at 0 would be 0, and a prediction that starts flat would stay.
    let below = height.clone().lower_elem(0.0);
    let sign = height.clone().detach().ones_like().mask_fill(below, -1.0);
    (height * sign.clone()).log1p() * sign
}

/// Smooth L1: `d^2 / (2 beta)` where `|d| < beta`, `|d| - beta / 2` beyond.
#[must_use]
pub fn smooth_l1<const D: usize>(difference: Tensor<D>, beta: f64) -> Tensor<D> {
    let size = difference.abs();
    let near = size.clone().clamp_max(beta);
    near.clone() * (size - near * 0.5) / beta
}

/// Cross-entropy of classes: `sum w_y (-ln softmax(logits)_y) / sum w_y` over the pixels whose class `y` is known,
/// `w` the weights of the classes. 0 without a known pixel or with a sum of weights of 0.
///
/// `logits` is `batch x classes x height x width`; `classes` is `batch x 1 x height x width`, below 0 (or past the last
/// class) where unknown. There is one weight a class; a class without one weighs 1.
#[must_use]
pub fn class_entropy(
    logits: Tensor<4>,
    classes: Tensor<4, Int>,
    class_weights: &[f64],
) -> Tensor<1> {
    let count = logits.dims()[1];
    let known = classes.clone().greater_equal_elem(0);
    let known: Tensor<4, Bool> = known.bool_and(classes.clone().lower_elem(count as i64));
    let index = classes.mask_fill(known.clone().bool_not(), 0);
    let entropy = -activation::log_softmax(logits, 1).gather(1, index.clone());
    let mut weight = weights(&known, &entropy.clone().detach());
    for (class, value) in (0_i64..).zip(class_weights) {
        let here = index.clone().equal_elem(class).bool_and(known.clone());
        weight = weight.mask_fill(here, *value);
    }
    let total = weight.clone().sum();
    let none = total.clone().equal_elem(0.0);
    (keep(entropy, &known) * weight).sum() / total.mask_fill(none, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{
        TORCH, check_gradients, check_gradients_at, narrow, scalar, stored, uniform, values, wide,
    };

    #[test]
    fn the_textbook_functions_are_those_of_the_reference() {
        let entropy = class_entropy(
            stored(TORCH, "entropy.logits"),
            stored::<3>(TORCH, "entropy.classes").int().unsqueeze_dim(1),
            &values(stored::<1>(TORCH, "entropy.weight")),
        );
        let [first, second] =
            ["first", "second"].map(|k| stored::<1>(TORCH, &format!("smooth.{k}")));
        let smooth = smooth_l1(first - second, 0.7).mean();
        for (ours, key) in [(entropy, "entropy.value"), (smooth, "smooth.value")] {
            let [ours, theirs] = [ours, stored(TORCH, key)].map(scalar);
            assert!((ours / theirs - 1.0).abs() < 1e-6, "{key}: {ours} {theirs}");
        }
    }

    #[test]
    fn symlog_is_odd_and_has_slope_one_on_the_ground() {
        let heights = wide(vec![-3.0, -1e-9, 0.0, 2.0, 150.0], [5]).require_grad();
        let logs = symlog(heights.clone());
        for (log, h) in values(logs.clone()).iter().zip([-3.0_f64, -1e-9, 0.0, 2.0, 150.0]) {
            assert!((log - h.signum() * libm::log1p(h.abs())).abs() < 1e-15, "{h}: {log}");
        }
        let slopes = values(heights.grad(&logs.sum().backward()).expect("a gradient"));
        assert!((slopes[2] - 1.0).abs() < 1e-15 && (slopes[3] - 1.0 / 3.0).abs() < 1e-15);
    }

    #[test]
    fn unknown_heights_count_for_nothing() {
        let term = |predicted: [f32; 4]| {
            let truth = narrow(&[f32::NAN, 2.0, f32::INFINITY, 5.0], [1, 1, 2, 2]);
            let terms = height(narrow(&predicted, [1, 1, 2, 2]), truth, &Height::default(), 0.5);
            [terms.total, terms.log, terms.l1, terms.l2].map(scalar)
        };
        let [total, log, l1, l2] = term([7.0, 3.0, 7.0, 5.0]);
        assert!((l1 - 0.5).abs() < 1e-7 && (l2 - 0.5).abs() < 1e-7, "{l1} {l2}");
        assert!((total - log - 0.5 * (0.05 + 0.0025)).abs() < 1e-7);
        assert_eq!(term([f32::NAN, 3.0, -1e30, 5.0]), [total, log, l1, l2]);
    }

    #[test]
    fn a_ramp_is_a_line_between_two_steps() {
        let ramp = Ramp { from: 100, to: 300 };
        let at = [0, 100, 150, 299, 300, u64::MAX].map(|step| ramp.at(step));
        assert_eq!(at, [0.0, 0.0, 0.25, 0.995, 1.0, 1.0]);
        assert_eq!([0, 1].map(|step| Ramp { from: 0, to: 0 }.at(step)), [0.0, 1.0]);
    }

    #[test]
    fn gradients_agree_with_differences() {
        let shape = [2, 1, 4, 5];
        let mut truth = uniform(9, 40, -1.0, 20.0);
        truth[3] = f64::NAN;
        check_gradients("height", &[shape], [-1.0, 20.0], 1e-6, |input| {
            let truth = wide(truth.clone(), shape);
            height(input[0].clone(), truth, &Height::default(), 0.7).total
        });
        // Flat ground, where a prediction starts.
        check_gradients_at("flat", &[shape], &[vec![0.0; 40]], 1e-6, |input| {
            let truth = wide(truth.clone(), shape);
            height(input[0].clone(), truth, &Height::default(), 0.7).total
        });
        let classes = |from: i32| {
            let classes = (0..24).map(|i| (i * 7 + i / 5) % (4 - from) + from);
            narrow::<4>(&classes.map(|v| v as f32).collect::<Vec<_>>(), [2, 1, 3, 4]).int()
        };
        check_gradients("entropy", &[[2, 4, 3, 4]], [-3.0, 3.0], 1e-6, |input| {
            class_entropy(input[0].clone(), classes(-1), &[0.3, 1.0, 2.0])
        });
    }
}
