use super::*;
use crate::train::losses::spectral::Spectral;
use crate::train::losses::tangent::{Dual, instance_norm};
use crate::train::losses::testing::{TORCH, narrow, scalar, stored, uniform, values, wide};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{FloatDType, activation, module};

const EPSILON: f64 = 1e-5;

/// The fixture's discriminator, after its one power iteration.
struct Fixture {
    weights: Vec<Tensor<4>>,
    biases: Vec<Tensor<1>>,
    states: Vec<Spectral>,
}

impl Fixture {
    fn new(dtype: FloatDType) -> Self {
        let key = |layer: usize, part: &str| format!("penalty.{layer}.{part}");
        let vector = |layer, part| stored::<1>(TORCH, &key(layer, part)).cast(dtype);
        let weight = |layer| stored::<4>(TORCH, &key(layer, "weight")).cast(dtype).require_grad();
        let weights: Vec<_> = (0..4).map(weight).collect();
        let states = (0..3).map(|layer| {
            Spectral { u: vector(layer, "u"), v: vector(layer, "v") }.iterate(&weights[layer])
        });
        let biases = (0..4).map(|layer| vector(layer, "bias").require_grad());
        Self { states: states.collect(), biases: biases.collect(), weights }
    }

    fn normed(&self, layer: usize) -> Tensor<4> {
        let weight = self.weights[layer].clone();
        match self.states.get(layer) {
            Some(state) => state.normalise(weight),
            None => weight,
        }
    }

    fn convolve(&self, layer: usize, features: Tensor<4>, bias: bool) -> Tensor<4> {
        let options = if layer < 3 {
            ConvOptions::new([2, 2], [1, 1], [1, 1], 1)
        } else {
            ConvOptions::new([1, 1], [0, 0], [1, 1], 1)
        };
        let bias = bias.then(|| self.biases[layer].clone());
        module::conv2d(features, self.normed(layer), bias, options)
    }

    fn scores(&self, pictures: Tensor<4>) -> Tensor<1> {
        let mut features = pictures;
        for layer in 0..3 {
            features = self.convolve(layer, features, true);
            if layer > 0 {
                features = instance_norm(features, EPSILON);
            }
            features = activation::leaky_relu(features, 0.2);
        }
        mean(self.convolve(3, features, true))
    }

    fn slopes(&self, pictures: Tensor<4>, directions: Tensor<4>) -> Tensor<1> {
        let mut features = Dual::new(pictures, directions);
        for layer in 0..3 {
            let bias = self.biases[layer].clone();
            let bias = bias.clone().reshape([1, bias.dims()[0], 1, 1]);
            features = features.affine(|v| self.convolve(layer, v, false), Some(bias));
            if layer > 0 {
                features = features.instance_norm(EPSILON);
            }
            features = features.leaky_relu(0.2);
        }
        features.affine(|v| mean(self.convolve(3, v, false)), None).slope
    }

    /// Relative error of the parameters' gradients, as one vector, against PyTorch's.
    fn error(&self, penalty: &Tensor<1>) -> f64 {
        let gradients = penalty.backward();
        let (mut error, mut size) = (0.0, 0.0);
        for layer in 0..4 {
            let key = format!("penalty.{layer}.weight_gradient");
            let theirs = values(stored::<4>(TORCH, &key));
            let ours = self.weights[layer].grad(&gradients).map(values).expect("a gradient");
            for (ours, theirs) in ours.iter().zip(theirs) {
                error += (ours - theirs) * (ours - theirs);
                size += theirs * theirs;
            }
        }
        let theirs = values(stored::<1>(TORCH, "penalty.0.bias_gradient"));
        let ours = self.biases[0].grad(&gradients).map(values);
        for (index, theirs) in theirs.iter().enumerate() {
            let ours = ours.as_ref().map_or(0.0, |ours| ours[index]);
            error += (ours - theirs) * (ours - theirs);
            size += theirs * theirs;
        }
        (error / size).sqrt()
    }
}

fn mean(map: Tensor<4>) -> Tensor<1> {
    let [batch, ..] = map.dims();
    map.mean_dims(&[1, 2, 3]).reshape([batch])
}

fn pictures(dtype: FloatDType) -> Tensor<4> {
    stored::<4>(TORCH, "penalty.images").cast(dtype)
}

#[test]
fn slopes_carried_forward_give_the_double_backward() {
    for (dtype, tolerance) in [(FloatDType::F64, 2e-7), (FloatDType::F32, 1e-5)] {
        let fixture = Fixture::new(dtype);
        let scores = fixture.scores(pictures(dtype));
        for (ours, theirs) in
            values(scores).iter().zip(values(stored::<1>(TORCH, "penalty.scores")))
        {
            assert!((ours - theirs).abs() < 1e-6, "{ours} {theirs}");
        }
        let term = gradient_penalty(
            &pictures(dtype),
            |x| fixture.scores(x),
            |x, v| fixture.slopes(x, v),
            &Penalty::release(),
        );
        let theirs = scalar(stored(TORCH, "penalty.value"));
        assert!((scalar(term.penalty.clone()) / theirs - 1.0).abs() < 1e-6);
        let error = fixture.error(&term.penalty);
        assert!(error < tolerance, "{dtype:?}: {error}");
    }
}

#[test]
fn slopes_agree_with_differences_of_scores() {
    let fixture = Fixture::new(FloatDType::F64);
    let v = || wide::<4>(uniform(3, 2 * 3 * 32 * 32, -0.02, 0.02), [2, 3, 32, 32]);
    let exact = values(fixture.slopes(pictures(FloatDType::F64), v()));
    let at = |step: f64| values(fixture.scores(pictures(FloatDType::F64) + v() * step));
    let (step, mut seen) = (1e-7, 0);
    for ((exact, above), below) in exact.iter().zip(at(step)).zip(at(-step)) {
        let near = (above - below) / (2.0 * step);
        assert!((exact - near).abs() < 1e-6 * exact.abs().max(1e-3), "{exact} {near}");
        seen += 1;
    }
    assert_eq!(seen, 2);
}

#[test]
fn flat_and_steep_scores_have_finite_gradients() {
    let pictures = narrow(&[0.0; 12], [1, 3, 2, 2]);
    let weight = narrow(&[0.0; 12], [1, 3, 2, 2]).require_grad();
    let sum = |v: Tensor<4>| v.sum_dims(&[1, 2, 3]).reshape([1]);
    for steepness in [0.0_f32, 1e18, 1e-30] {
        let at = |x: Tensor<4>| sum((weight.clone() + steepness) * x);
        let term = gradient_penalty(&pictures, at, |_, v| at(v), &Penalty::release());
        let gradients = term.penalty.backward();
        let slope = values(weight.grad(&gradients).expect("a gradient"));
        assert!(slope.iter().all(|v| v.is_finite()), "{steepness}: {slope:?}");
        let want = f64::from(steepness) * 12.0_f64.sqrt();
        assert!((scalar(term.lengths) - want).abs() <= 1e-6 * want, "{steepness}");
    }
    // Scores that do not look at the pictures.
    let constant = |_| weight.clone().sum();
    let still = |_, v: Tensor<4>| sum(v) * weight.clone().sum();
    let term = gradient_penalty(&pictures, constant, still, &Penalty::release());
    assert!((scalar(term.penalty) - 10.0).abs() < 1e-6);
}
