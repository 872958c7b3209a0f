//! Spectral norm of a discriminator's weights, as PyTorch's `spectral_norm` has it (Miyato et al., "Spectral
//! normalization for generative adversarial networks", 2018).

use crate::random;
use burn::tensor::{DType, Device, Tensor, TensorData};

/// Names the start vectors among the uses of the random numbers.
const PURPOSE: u64 = 0x7370_6563_7472_616C;

/// Smallest length that a vector is divided by.
const EPSILON: f64 = 1e-12;

/// Estimates of a weight's first singular vectors: the state that goes into a checkpoint beside it
/// (`weight_u`, `weight_v`, the weight itself being `weight_orig`).
#[derive(Clone, Debug)]
pub struct Spectral {
    /// Left vector, of length 1: as many values as the weight has outputs (its first axis).
    pub u: Tensor<1>,
    /// Right vector, of length 1: as many values as the other axes have together.
    pub v: Tensor<1>,
}

impl Spectral {
    /// A random start for a weight of this shape, of the seed alone.
    #[must_use]
    pub fn start<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Self {
        let mut draw = random::Draw::new(&[PURPOSE, seed]);
        let mut vector = |length: usize| {
            let values: Vec<f64> = (0..length).map(|_| random::normal(draw.bits())).collect();
            let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt().max(EPSILON);
            let values: Vec<f32> = values.iter().map(|v| (v / norm) as f32).collect();
            Tensor::from_data(TensorData::new(values, [length]), (device, DType::F32))
        };
        let [outputs, inputs] = sides(shape);
        Self { u: vector(outputs), v: vector(inputs) }
    }

    /// One power iteration: `v = W'u / |W'u|`, then `u = Wv / |Wv|`. A training step of a discriminator does it
    /// before each of its forward passes; evaluation, and the generator's steps, do not.
    #[must_use]
    pub fn iterate<const D: usize>(&self, weight: &Tensor<D>) -> Self {
        let matrix = matrix(weight.clone().detach());
        let v = unit(matrix.clone().transpose(), self.u.clone());
        let u = unit(matrix, v.clone());
        Self { u, v }
    }

    /// The weight divided by its estimated largest singular value `u'Wv`. The gradient flows through the
    /// weight, `u` and `v` are constants. A weight whose estimate is 0 stays as it is.
    #[must_use]
    pub fn normalise<const D: usize>(&self, weight: Tensor<D>) -> Tensor<D> {
        let product = column(matrix(weight.clone()), self.v.clone().detach());
        let sigma = (product * self.u.clone().detach()).sum();
        let zero = sigma.clone().equal_elem(0.0);
        weight / sigma.mask_fill(zero, 1.0).reshape([1; D])
    }
}

/// Outputs, and the product of the other axes.
fn sides<const D: usize>(shape: [usize; D]) -> [usize; 2] {
    let outputs = shape.first().copied().unwrap_or(1);
    [outputs, shape.iter().skip(1).product()]
}

fn matrix<const D: usize>(weight: Tensor<D>) -> Tensor<2> {
    let sides = sides(weight.dims());
    weight.reshape(sides)
}

fn column(matrix: Tensor<2>, vector: Tensor<1>) -> Tensor<1> {
    let [outputs, inputs] = matrix.dims();
    matrix.matmul(vector.reshape([inputs, 1])).reshape([outputs])
}

/// `matrix * vector` at length 1.
fn unit(matrix: Tensor<2>, vector: Tensor<1>) -> Tensor<1> {
    let product = column(matrix, vector.detach());
    let length = (product.clone() * product.clone()).sum().sqrt().clamp_min(EPSILON);
    product / length
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{
        TORCH, check_gradients, device, narrow, stored, uniform, values, wide,
    };

    fn close(ours: Tensor<1>, theirs: Tensor<1>, tolerance: f64) {
        for (ours, theirs) in values(ours).iter().zip(values(theirs)) {
            assert!((ours - theirs).abs() < tolerance, "{ours} {theirs}");
        }
    }

    #[test]
    fn an_iteration_is_that_of_the_reference() {
        for layer in 0..3 {
            let key = |part: &str| format!("penalty.{layer}.{part}");
            let weight = stored::<4>(TORCH, &key("weight"));
            let state = Spectral { u: stored(TORCH, &key("u")), v: stored(TORCH, &key("v")) };
            let next = state.iterate(&weight);
            close(next.u.clone(), stored(TORCH, &key("next_u")), 1e-6);
            close(next.v.clone(), stored(TORCH, &key("next_v")), 1e-6);
            let ours = next.normalise(weight);
            close(ours.flatten(0, 3), stored::<4>(TORCH, &key("normed")).flatten(0, 3), 1e-6);
        }
    }

    #[test]
    fn iterations_find_the_largest_singular_value() {
        // A diagonal of 3, 2, 1, turned by nothing: after many iterations it is divided by 3.
        let weight = narrow(&[0.0, 2.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0], [3, 3]);
        let mut state = Spectral::start([3, 3], 4, &device());
        for _ in 0..60 {
            state = state.iterate(&weight);
        }
        let largest = values(state.normalise(weight)).into_iter().fold(0.0, f64::max);
        assert!((largest - 1.0).abs() < 1e-6, "{largest}");
    }

    #[test]
    fn a_start_is_of_the_seed() {
        let start = |seed| values(Spectral::start([4, 2, 3, 3], seed, &device()).v);
        assert_eq!(start(1), start(1));
        assert_ne!(start(1), start(2));
        assert_eq!(start(1).len(), 18);
        assert!((start(1).iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_weight_of_zeros_stays_finite() {
        let weight = narrow(&[0.0; 6], [2, 3]).require_grad();
        let state = Spectral::start([2, 3], 4, &device()).iterate(&weight);
        assert!(values(state.u.clone()).iter().all(|v| v.is_finite()));
        let gradients = state.normalise(weight.clone()).sum().backward();
        let slope = values(weight.grad(&gradients).expect("a gradient"));
        assert!(slope.iter().all(|v| v.is_finite()), "{slope:?}");
    }

    #[test]
    fn gradients_agree_with_differences() {
        check_gradients("spectral", &[[3, 2, 2, 2]], [-1.0, 1.0], 1e-6, |input| {
            let state = Spectral {
                u: wide(uniform(5, 3, 0.2, 1.0), [3]),
                v: wide(uniform(6, 8, 0.2, 1.0), [8]),
            };
            let normed = state.normalise(input[0].clone());
            (normed.clone() * normed).sum()
        });
    }
}
