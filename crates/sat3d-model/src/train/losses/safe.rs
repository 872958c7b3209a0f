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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{scalar, values, wide};

    #[test]
    fn the_root_of_nought_has_no_slope() {
        let squares = wide(vec![0.0, 4.0, -1e-30], [3]).require_grad();
        let roots = root(squares.clone());
        assert_eq!(values(roots.clone()), [0.0, 2.0, 0.0]);
        let slopes = values(squares.grad(&roots.sum().backward()).expect("a gradient"));
        assert_eq!(slopes, [0.0, 0.25, 0.0]);
    }

    #[test]
    fn a_mean_of_nothing_is_nought() {
        let values = || wide(vec![f64::NAN, 2.0, 4.0], [3]);
        let mean = |known: [f64; 3]| {
            scalar(mean_where(values(), &wide(known.to_vec(), [3]).greater_elem(0.5)))
        };
        assert_eq!([mean([0.0; 3]), mean([0.0, 1.0, 0.0]), mean([0.0, 1.0, 1.0])], [0.0, 2.0, 3.0]);
    }
}
