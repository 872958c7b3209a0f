//! Colours (MODEL_SPEC sections 11 and 12). Pictures are `batch x 3 x height x width` in [-1, 1].

use super::perceptual::Perceptual;
use burn::tensor::{Tensor, TensorData};

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

/// What a view's colours are held to: `l1 * L1 + l2 * L2 + perceptual * P`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Photometric {
    /// Weight of the mean absolute error.
    pub l1: f64,
    /// Weight of the mean squared error.
    pub l2: f64,
    /// Weight of the perceptual distance.
    pub perceptual: f64,
}

impl Photometric {
    /// The release's satellite view: L1 + 0.1 LPIPS.
    #[must_use]
    pub const fn release_satellite() -> Self {
        Self { l1: 1.0, l2: 0.0, perceptual: 0.1 }
    }

    /// The release's panorama and perspective views, after super-resolution: LPIPS alone.
    #[must_use]
    pub const fn release_street() -> Self {
        Self { l1: 0.0, l2: 0.0, perceptual: 1.0 }
    }

    /// The release's raw view against the half-size picture of its own super-resolution ([`half_size`] of the
    /// prediction, not detached): 0.1 (0.618 L1 + 0.382 LPIPS). It is added to the view's
    /// [`release_street`](Self::release_street) term.
    #[must_use]
    pub const fn release_raw() -> Self {
        Self { l1: 0.1 * 0.618, l2: 0.0, perceptual: 0.1 * 0.382 }
    }

    /// Every view of the paper: L2 + LPIPS.
    #[must_use]
    pub const fn paper() -> Self {
        Self { l1: 0.0, l2: 1.0, perceptual: 1.0 }
    }
}

/// Photometric term of a view. Parts of weight 0 are not computed.
#[must_use]
pub fn photometric(
    predicted: Tensor<4>,
    truth: Tensor<4>,
    perceptual: &Perceptual,
    options: &Photometric,
) -> Tensor<1> {
    type Part<'a> = (f64, &'a dyn Fn(Tensor<4>, Tensor<4>) -> Tensor<1>);
    let distance = |a, b| perceptual.distance(a, b).mean();
    let parts: [Part<'_>; 3] =
        [(options.l1, &l1), (options.l2, &l2), (options.perceptual, &distance)];
    let mut total = None;
    for (weight, part) in parts.into_iter().filter(|(weight, _)| *weight != 0.0) {
        let term = part(predicted.clone(), truth.clone()) * weight;
        total = Some(match total {
            Some(sum) => sum + term,
            None => term,
        });
    }
    total.unwrap_or_else(|| predicted.sum() * 0.0)
}

/// A picture at half its size by a triangle filter of width four, weights renormalised at the border: PyTorch's
/// `interpolate(scale_factor=0.5, mode="bilinear", antialias=True)`. An odd last row or column is left out of
/// the count and still seen by the filter.
#[must_use]
pub fn half_size(picture: Tensor<4>) -> Tensor<4> {
    let [.., height, width] = picture.dims();
    let filter = |length: usize| {
        let half = length / 2;
        let mut weights = vec![0.0_f64; half * length];
        for (out, row) in weights.chunks_mut(length).enumerate() {
            let mut total = 0.0;
            for (tap, weight) in (0_usize..).zip([0.25, 0.75, 0.75, 0.25]) {
                if let Some(cell) = (2 * out + tap).checked_sub(1).and_then(|at| row.get_mut(at)) {
                    *cell = weight;
                    total += weight;
                }
            }
            row.iter_mut().for_each(|weight| *weight /= total);
        }
        let options = (&picture.device(), picture.dtype());
        Tensor::<4>::from_data(TensorData::new(weights, [1, 1, half, length]), options)
    };
    let [rows, columns] = [filter(height), filter(width)];
    rows.matmul(picture).matmul(columns.swap_dims(2, 3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::perceptual::Substitute;
    use crate::train::losses::testing::{TORCH, check_gradients, scalar, stored, values, wide};

    #[test]
    fn means_are_over_all_values() {
        let [a, b] = [[1.0, -2.0, 0.5], [1.5, 1.0, 0.5]].map(|v| wide(v.to_vec(), [3]));
        assert!((scalar(l1(a.clone(), b.clone())) - 3.5 / 3.0).abs() < 1e-12);
        assert!((scalar(l2(a, b)) - 9.25 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn half_size_is_that_of_the_reference() {
        let ours = values(half_size(stored(TORCH, "half.picture")));
        let theirs = values(stored::<4>(TORCH, "half.half"));
        assert_eq!(ours.len(), theirs.len());
        for (ours, theirs) in ours.iter().zip(theirs) {
            assert!((ours - theirs).abs() < 2e-7, "{ours} {theirs}");
        }
    }

    #[test]
    fn forms_are_sums_of_their_parts() {
        let of =
            |seed| wide(crate::train::losses::testing::uniform(seed, 96, -1.0, 1.0), [1, 3, 4, 8]);
        let substitute = Perceptual::Substitute(Substitute::default());
        let p = scalar(substitute.distance(of(1), of(2)));
        let [a, b] = [l1(of(1), of(2)), l2(of(1), of(2))].map(scalar);
        for (options, want) in [
            (Photometric::release_satellite(), a + 0.1 * p),
            (Photometric::release_street(), p),
            (Photometric::release_raw(), 0.1 * (0.618 * a + 0.382 * p)),
            (Photometric::paper(), b + p),
            (Photometric { l1: 0.0, l2: 0.0, perceptual: 0.0 }, 0.0),
        ] {
            let ours = scalar(photometric(of(1), of(2), &substitute, &options));
            assert!((ours - want).abs() < 1e-12, "{options:?}: {ours} {want}");
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        let shapes = [[2, 3, 8, 10]; 2];
        check_gradients("l1", &shapes, [-1.0, 1.0], 1e-6, |v| l1(v[0].clone(), v[1].clone()));
        check_gradients("l2", &shapes, [-1.0, 1.0], 1e-6, |v| l2(v[0].clone(), v[1].clone()));
        check_gradients("half size", &shapes[..1], [-1.0, 1.0], 1e-6, |v| {
            let half = half_size(v[0].clone());
            (half.clone() * half).sum()
        });
    }
}
