//! Arithmetic whose gradients stay finite.

use burn::tensor::{Bool, Tensor, activation};

/// `ln(1 + e^x)`, without overflow and with the right slope everywhere (one half at 0).
pub(super) fn softplus<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    -activation::log_sigmoid(-x)
}

/// The values where the mask holds, 0 elsewhere. No gradient flows from what is masked, be it NaN or
/// infinite.
pub(super) fn keep<const D: usize>(values: Tensor<D>, mask: &Tensor<D, Bool>) -> Tensor<D> {
    values.mask_fill(mask.clone().bool_not(), 0.0)
}

/// 1 where the mask holds and 0 elsewhere, in the number format of `like`.
pub(super) fn weights<const D: usize>(mask: &Tensor<D, Bool>, like: &Tensor<D>) -> Tensor<D> {
    keep(like.clone().detach().ones_like(), mask)
}

/// Mean of the values where the mask holds; 0 if it holds nowhere.
pub(super) fn mean_where<const D: usize>(values: Tensor<D>, mask: &Tensor<D, Bool>) -> Tensor<1> {
    let count = weights(mask, &values).sum().clamp_min(1.0);
    keep(values, mask).sum() / count
}

/// Square root whose slope at 0 is 0 instead of infinite.
pub(super) fn root<const D: usize>(squares: Tensor<D>) -> Tensor<D> {
    let zero = squares.clone().lower_equal_elem(0.0);
    squares.mask_fill(zero.clone(), 1.0).sqrt().mask_fill(zero, 0.0)
}
