//! A value and its derivative along one direction, through the layers of a discriminator.
//!
//! burn differentiates once, and the gradient penalty needs the derivative of a derivative. Carrying the directional
//! derivative forward as an ordinary tensor makes it differentiable by the one backward pass there
//! is: the result is exact, where finite differences are not (see [`penalty`](super::penalty)).

use burn::tensor::{Tensor, activation};

/// A tensor and its derivative along the direction that the input was given.
#[derive(Clone, Debug)]
pub struct Dual<const D: usize> {
    /// The value.
    pub value: Tensor<D>,
    /// Its derivative, of the same shape.
    pub slope: Tensor<D>,
}

impl<const D: usize> Dual<D> {
    /// An input and the direction in which it moves.
    #[must_use]
    pub const fn new(value: Tensor<D>, direction: Tensor<D>) -> Self {
        Self { value, slope: direction }
    }

    /// A linear layer with what it adds: `layer` is applied to value and slope, `bias` (which must broadcast)
    /// to the value alone. Convolutions, dense layers, means and shuffles are of this kind.
    #[must_use]
    pub fn affine<const E: usize>(
        self,
        layer: impl Fn(Tensor<D>) -> Tensor<E>,
        bias: Option<Tensor<E>>,
    ) -> Dual<E> {
        let value = layer(self.value);
        let value = match bias {
            Some(bias) => value + bias,
            None => value,
        };
        Dual { value, slope: layer(self.slope) }
    }

    /// Leaky rectifier with this slope below 0 (at 0, as in the backward pass, the slope above).
    #[must_use]
    pub fn leaky_relu(self, negative_slope: f64) -> Self {
        let below = self.value.clone().lower_elem(0.0);
        let slope = self.slope.clone().mask_where(below, self.slope * negative_slope);
        Self { value: activation::leaky_relu(self.value, negative_slope), slope }
    }
}

impl Dual<4> {
    /// Instance norm without learned parameters: each channel of each image to mean 0 and variance 1,
    /// `(x - m) / sqrt(variance + epsilon)`, the variance that of the whole population. PyTorch's epsilon is
    /// 1e-5.
    #[must_use]
    pub fn instance_norm(self, epsilon: f64) -> Self {
        let mean = |v: Tensor<4>| v.mean_dims(&[2, 3]);
        let value = self.value.clone() - mean(self.value);
        let slope = self.slope.clone() - mean(self.slope);
        let inverse = (mean(value.clone() * value.clone()) + epsilon).sqrt().recip();
        let value = value * inverse.clone();
        // With z = x / s: dz = (dx - z mean(z dx)) / s.
        let along = mean(value.clone() * slope.clone());
        let slope = (slope - value.clone() * along) * inverse;
        Self { value, slope }
    }
}

/// Instance norm of plain values, as [`Dual::instance_norm`].
#[must_use]
pub fn instance_norm(values: Tensor<4>, epsilon: f64) -> Tensor<4> {
    let mean = |v: Tensor<4>| v.mean_dims(&[2, 3]);
    let centred = values.clone() - mean(values);
    let inverse = (mean(centred.clone() * centred.clone()) + epsilon).sqrt().recip();
    centred * inverse
}
