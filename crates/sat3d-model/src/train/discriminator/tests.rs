use super::*;
use crate::train::losses::testing::{TORCH, stored, values};

fn pictures(count: usize, height: usize, width: usize, seed: u64) -> Tensor<4> {
    let mut draw = Draw::new(&[seed]);
    let values: Vec<f32> =
        (0..count * 3 * height * width).map(|_| draw.range(-1.0, 1.0) as f32).collect();
    let data = TensorData::new(values, [count, 3, height, width]);
    Tensor::from_data(data, &Device::flex().autodiff())
}

fn small(seed: u64) -> Discriminator {
    Discriminator::new(16, 16, &[seed], &Device::flex().autodiff())
}

#[test]
fn layers_are_those_of_the_release() {
    assert_eq!(widths(256, 512), [64, 128, 256, 512, 512, 512]);
    assert_eq!(widths(128, 512), [64, 128, 256, 512, 512]);
    assert_eq!(widths(32, 64), [8, 16, 32]);
    assert_eq!(widths(1, 4).len(), 2);
}

#[test]
fn a_written_out_slope_is_that_of_autodiff() {
    let mut critic = small(1);
    for (height, width) in [(16, 16), (8, 32), (15, 18)] {
        let pass = critic.pass(true);
        let input = pictures(2, height, width, 5).require_grad();
        let (scores, slope) = pass.score_and_slope(input.clone());
        let wanted = input.grad(&scores.sum().backward()).expect("a gradient");
        let error: f32 = (slope.inner() - wanted.clone()).abs().max().into_scalar();
        let size: f32 = wanted.abs().max().into_scalar();
        assert!(error < 1e-5 * size.max(1e-3), "{height} x {width}: {error} of {size}");
    }
}

#[test]
fn gradients_of_the_penalty_agree_with_differences() {
    let mut critic = small(2);
    for _ in 0..20 {
        critic.pass(true);
    }
    let input = pictures(2, 16, 16, 6);
    let penalty = |critic: &mut Discriminator| {
        gradient_penalty(critic.pass(false).score_and_slope(input.clone()).1)
    };
    let gradients = penalty(&mut critic).backward();
    for layer in 0..critic.encoder.len() {
        let weight = critic.encoder[layer].weight.val();
        let shape = weight.dims();
        let gradient = weight.grad(&gradients).expect("a gradient").into_data();
        let gradient: Vec<f32> = gradient.iter::<f32>().collect();
        let values: Vec<f32> = weight.into_data().iter::<f32>().collect();
        let length = gradient.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt();
        let mut at = |step: f64| {
            let moved = values.iter().zip(&gradient);
            let moved: Vec<f32> = moved
                .map(|(value, g)| (f64::from(*value) + step * f64::from(*g) / length) as f32)
                .collect();
            let data = TensorData::new(moved, shape);
            critic.encoder[layer].weight = Param::from_data(data, &input.device());
            f64::from(penalty(&mut critic).into_scalar::<f32>())
        };
        let step = 1e-3;
        let difference = (at(step) - at(-step)) / (2.0 * step);
        at(0.0);
        assert!((difference / length - 1.0).abs() < 0.02, "{layer}: {length} {difference}");
    }
}

#[test]
fn weights_come_to_a_largest_singular_value_of_one() {
    let mut critic = small(3);
    let before = critic.buffers("d");
    critic.pass(false);
    assert_eq!(critic.buffers("d"), before, "a pass that does not train moves nothing");
    for _ in 0..200 {
        critic.pass(true);
    }
    let weight = critic.pass(false).layers[1].weight.clone().inner();
    let [rows, inputs, _, _] = weight.dims();
    let matrix: Tensor<2> = weight.reshape([rows, 9 * inputs]);
    // The largest singular value by an iteration of its own.
    let mut column = Tensor::<2>::ones([rows, 1], &matrix.device());
    let length = |column: &Tensor<2>| column.clone().powi_scalar(2).sum().sqrt();
    for _ in 0..500 {
        column = matrix.clone().matmul(matrix.clone().transpose().matmul(column));
        column = column.clone() / length(&column).reshape([1, 1]);
    }
    let length: f32 = length(&matrix.transpose().matmul(column)).into_scalar();
    assert!((length - 1.0).abs() < 1e-3, "{length}");
    let mut other = small(4);
    other.set_buffers(&critic.buffers("d"));
    assert_eq!(other.buffers("d"), critic.buffers("d"));
}

#[test]
fn a_flat_picture_has_a_finite_penalty() {
    let mut critic = small(5);
    let flat = pictures(2, 16, 16, 7) * 0.0;
    let (_, slope) = critic.pass(true).score_and_slope(flat);
    let penalty = gradient_penalty(slope);
    let gradients = penalty.clone().backward();
    let value: f32 = penalty.into_scalar();
    let gradient = critic.encoder[0].weight.val().grad(&gradients).expect("a gradient");
    let largest: f32 = gradient.abs().max().into_scalar();
    assert!(value.is_finite() && largest.is_finite(), "{value} {largest}");
}

/// The discriminator of the fixture, which PyTorch's `spectral_norm` and double backward ran on.
fn fixture() -> Discriminator {
    let key = |layer: usize, part: &str| format!("penalty.{layer}.{part}");
    let weight = |layer| Param::from_tensor(stored::<4>(TORCH, &key(layer, "weight")));
    let bias = |layer| Param::from_tensor(stored::<1>(TORCH, &key(layer, "bias")));
    let vector = |layer, part| stored::<1>(TORCH, &key(layer, part)).inner();
    let encoder = (0..3).map(|layer| NormedConv {
        weight: weight(layer),
        bias: bias(layer),
        spectral: Spectral { u: vector(layer, "u"), v: vector(layer, "v") },
    });
    Discriminator {
        encoder: encoder.collect(),
        shuffle: Plain { weight: weight(3), bias: bias(3) },
    }
}

#[test]
fn scores_penalty_and_its_gradients_are_those_of_pytorch() {
    let mut critic = fixture();
    let (scores, slope) = critic.pass(true).score_and_slope(stored(TORCH, "penalty.images"));
    for (ours, theirs) in values(scores).iter().zip(values(stored::<1>(TORCH, "penalty.scores"))) {
        assert!((ours - theirs).abs() < 1e-6, "{ours} {theirs}");
    }
    // The weight of the release.
    let penalty = gradient_penalty(slope) * 10.0;
    let [ours, theirs] =
        [penalty.clone(), stored::<1>(TORCH, "penalty.value")].map(|v| values(v)[0]);
    assert!((ours / theirs - 1.0).abs() < 1e-6, "{ours} {theirs}");
    let gradients = penalty.backward();
    let (mut error, mut size) = (0.0_f64, 0.0);
    let convolutions = critic.encoder.iter().map(|conv| &conv.weight);
    for (layer, weight) in convolutions.chain([&critic.shuffle.weight]).enumerate() {
        let theirs = values(stored::<4>(TORCH, &format!("penalty.{layer}.weight_gradient")));
        let ours = weight.val().grad(&gradients).map(values).expect("a gradient");
        for (ours, theirs) in ours.iter().zip(theirs) {
            error += (ours - theirs) * (ours - theirs);
            size += theirs * theirs;
        }
    }
    assert!((error / size).sqrt() < 1e-5, "{error} of {size}");
}
