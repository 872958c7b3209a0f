//! Gradient penalty on real pictures (Gulrajani et al., 2017; MODEL_SPEC section 11):
//! `weight * mean over pictures of (|grad_x D(x)| - target)^2`.
//!
//! Its gradient in the discriminator's parameters is a second derivative, and burn has only first ones. But the
//! derivative of a length is the derivative along its own fixed direction: with `g = grad_x D` and
//! `v = g / |g|` held constant,
//!
//! `d/dparameters (|g| - 1)^2 = 2 (|g| - 1) d/dparameters <g, v>`,
//!
//! and `<grad_x D, v>` is the derivative of a score along `v`. Carried forward through the discriminator as an
//! ordinary tensor ([`Dual`](super::tangent::Dual)) it is exact, and the one backward pass gives what PyTorch's
//! double backward gives.
//!
//! Central differences of two more scores would need no second form of the discriminator, but are no
//! way out: the gradient of a score in the parameters jumps at the kinks of the rectifiers, and a jump between the
//! two places, divided by their distance, does not vanish with it. Against PyTorch, on a discriminator of the
//! release's layers, the error of the whole gradient was 1 to 66 times its size for steps of 0.1 to 1e-4 of
//! the picture's length; only below, where no kink lay between, it fell to 8e-4, and grew again by rounding.

use super::safe::root;
use burn::tensor::Tensor;

/// Constants of the penalty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Penalty {
    /// Weight of the term.
    pub weight: f64,
    /// The slope that a score is to have.
    pub target: f64,
}

impl Penalty {
    /// Weight 10, slope 1. The paper's discriminator loss is not said to have the term.
    #[must_use]
    pub const fn release() -> Self {
        Self { weight: 10.0, target: 1.0 }
    }
}

/// The penalty and what it was made of.
#[derive(Clone, Debug)]
pub struct PenaltyTerm {
    /// The term: its value is the penalty's, its gradient in the parameters too. It has none in the
    /// pictures.
    pub penalty: Tensor<1>,
    /// `|grad_x D|` of each picture, `[batch]`, constant.
    pub lengths: Tensor<1>,
}

/// Gradient penalty of a batch of pictures, `batch x channels x height x width`.
///
/// `scores` gives one score a picture, `[batch]`, each of its own picture alone (instance norm is fine, batch
/// norm is not). It is called once and differentiated, which consumes its graph: whatever it is made
/// of must hang on the parameters afresh at every call (a spectral norm is to be computed inside, in
/// one and the same state). `slopes` gives the derivative of each score along a direction, `[batch]`, from pictures
/// and directions of one shape, differentiable in the parameters: `scores` once more, with
/// [`Dual`](super::tangent::Dual) numbers.
///
/// A picture of slope 0 is counted in the value and has no gradient.
#[must_use]
pub fn gradient_penalty(
    pictures: &Tensor<4>,
    scores: impl FnOnce(Tensor<4>) -> Tensor<1>,
    slopes: impl FnOnce(Tensor<4>, Tensor<4>) -> Tensor<1>,
    options: &Penalty,
) -> PenaltyTerm {
    let [batch, ..] = pictures.dims();
    let leaf = pictures.clone().detach().require_grad();
    let gradients = scores(leaf.clone()).sum().backward();
    let gradient = match leaf.grad(&gradients) {
        Some(gradient) => gradient.autodiff(),
        // Scores that do not depend on the pictures.
        None => leaf.clone().detach().zeros_like(),
    };
    // In two steps, so that squares of tiny or huge slopes stay in range.
    let largest = gradient.clone().abs().flatten::<2>(1, 3).max_dim(1).reshape([batch, 1, 1, 1]);
    let none = largest.clone().equal_elem(0.0);
    let scaled = gradient / largest.clone().mask_fill(none, 1.0);
    let length = root((scaled.clone() * scaled.clone()).sum_dims(&[1, 2, 3]));
    let still = length.clone().equal_elem(0.0);
    let direction = scaled / length.clone().mask_fill(still, 1.0);
    let lengths = (length * largest).reshape([batch]);

    let along = slopes(leaf.detach(), direction);
    let excess = lengths.clone() - options.target;
    // The parentheses are nought in value: what is left of them is their gradient.
    let terms = excess.clone() * 2.0 * (along.clone() - along.detach()) + excess.clone() * excess;
    PenaltyTerm { penalty: terms.mean() * options.weight, lengths }
}

#[cfg(test)]
mod tests;
