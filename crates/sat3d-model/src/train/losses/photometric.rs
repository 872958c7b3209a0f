//! Colours (MODEL_SPEC sections 11 and 12). Pictures are `batch x 3 x height x width` in [-1, 1].

use burn::tensor::Tensor;

/// Mean absolute error over all values.
#[must_use]
pub fn l1<const D: usize>(predicted: Tensor<D>, truth: Tensor<D>) -> Tensor<1> {
    (predicted - truth).abs().mean()
}

/// Mean squared error over all values.
#[must_use]
pub fn l2<const D: usize>(predicted: Tensor<D>, truth: Tensor<D>) -> Tensor<1> {
    let difference = predicted - truth;
    (difference.clone() * difference).mean()
}
