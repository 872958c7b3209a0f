//! The quadrature with gradients from haze to solid (`docs/numerics-field.md`).

use super::*;
use crate::field::DensityActivation;
use crate::train::field::tests::{REPRESENTATIONS, both};
use burn::tensor::Device;

const SAMPLES: usize = 96;
const STEP: f32 = 0.02;

fn values(tensor: Tensor<2>) -> Vec<f64> {
    tensor.into_data().iter::<f32>().map(f64::from).collect()
}

/// The released rule's weights and their sum's slope in every raw density, in 64 bits, for a ray of one raw density.
fn oracle(raw: f64, radii: &[f32]) -> (Vec<f64>, f64) {
    let x = raw - 1.0;
    let sigma = x.max(0.0) + libm::log1p(libm::exp(-x.abs()));
    let slope = 1.0 / (1.0 + libm::exp(-x));
    let (mut passed, mut length) = (1.0, 0.0);
    let weights = radii.windows(2).map(|ends| {
        let tau = sigma * f64::from(ends[1] - ends[0]);
        let weight = passed * -libm::expm1(-tau);
        passed *= libm::exp(-tau) + EPSILON;
        length += f64::from(ends[1] - ends[0]);
        weight
    });
    let weights = weights.collect();
    // All raw densities together; with transmittances that the epsilon does not reach.
    (weights, slope * length * libm::exp(-sigma * length))
}

#[test]
fn gradients_of_thin_media_are_right_where_their_values_are_rounded_away() {
    let device = Device::flex().autodiff();
    let (_, field, _) = both(REPRESENTATIONS[0], DensityActivation::Mipnerf, None);
    let radii: Vec<f32> = (0..SAMPLES).map(|k| k as f32 * STEP).collect();
    let weights_of = |raw: f32| {
        let data = TensorData::new(vec![raw; SAMPLES], [1, SAMPLES]);
        let leaf = Tensor::<2>::from_data(data, &device).require_grad();
        (leaf.clone(), integrate(&field, leaf, &radii))
    };
    let (mut worst, mut steepest) = (0.0_f64, 0.0_f64);
    // Densities from 1e-30 to 1e30.
    let raws = (-68..=20).map(f64::from).chain([1e3, 1e10, 1e20, 1e30]);
    for raw in raws {
        let (leaf, weights) = weights_of(raw as f32);
        let gradients = weights.clone().sum().backward();
        let slopes = values(leaf.grad(&gradients).expect("a gradient"));
        let (want, slope) = oracle(raw, &radii);
        for (got, want) in values(weights).iter().zip(&want) {
            worst = worst.max((got - want).abs());
        }
        assert!(slopes.iter().all(|slope| slope.is_finite()), "{raw}: {slopes:?}");
        if slope > 1e-30 && raw < 4.0 {
            steepest = steepest.max((slopes.iter().sum::<f64>() / slope - 1.0).abs());
        }
    }
    eprintln!("weights {worst:e} of the light, slopes {steepest:e}");
    // A weight is a difference of 32-bit numbers next to 1; its slope is none.
    assert!(worst < 1e-7 && steepest < 1e-4, "{worst:e} {steepest:e}");
    // By differences of those values there would be no slope at all.
    let sum = |raw: f32| values(weights_of(raw).1).iter().sum::<f64>();
    assert_eq!((sum(-16.9) - sum(-17.1)) / 0.2, 0.0);
    assert!(oracle(-17.0, &radii).1 > 1e-8);
}
