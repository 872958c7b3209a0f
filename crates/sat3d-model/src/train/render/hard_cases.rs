//! The quadrature with gradients where 32-bit tensors lose what textbook forms take differences of
//! (`docs/numerics-field.md`).

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
fn weights_of_thin_media_keep_their_digits_and_their_gradients() {
    let device = Device::flex().autodiff();
    let (_, field, _) = both(REPRESENTATIONS[0], DensityActivation::Mipnerf, None);
    let radii: Vec<f32> = (0..SAMPLES).map(|k| k as f32 * STEP).collect();
    let (mut worst, mut steepest, mut theirs) = (0.0_f64, 0.0_f64, 0.0_f64);
    // Densities from 1e-30 to 1e30.
    let raws = (-68..=20).map(f64::from).chain([1e3, 1e10, 1e20, 1e30]);
    for raw in raws {
        let data = TensorData::new(vec![raw as f32; SAMPLES], [1, SAMPLES]);
        let leaf = Tensor::<2>::from_data(data, &device).require_grad();
        let weights = integrate(&field, leaf.clone(), &radii);
        let gradients = weights.clone().sum().backward();
        let slopes = values(leaf.grad(&gradients).expect("a gradient"));
        let (want, slope) = oracle(raw, &radii);
        for (got, want) in values(weights).iter().zip(&want) {
            let error = (got - want).abs();
            // A transmittance is the exponential of a sum of up to 87, in 32 bits.
            assert!(error <= 2e-4 * want + 1e-37, "{raw}: {got} {want}");
            if raw < 0.0 {
                worst = worst.max(error / want);
            }
        }
        let sum: f64 = slopes.iter().sum();
        assert!(slopes.iter().all(|slope| slope.is_finite()), "{raw}: {slopes:?}");
        if slope > 1e-30 && raw < 4.0 {
            steepest = steepest.max((sum / slope - 1.0).abs());
        }
        if raw < -17.0 {
            let tau = DensityActivation::Mipnerf.apply(raw as f32) * STEP;
            theirs = theirs.max((f64::from(1.0 - libm::expf(-tau)) / want[0] - 1.0).abs());
        }
    }
    eprintln!("weights of thin media {worst:e}, slopes {steepest:e}; 1 - exp: {theirs}");
    assert!(worst < 1e-5 && steepest < 1e-4, "{worst:e} {steepest:e}");
    assert!(theirs == 1.0, "{theirs}");
}
