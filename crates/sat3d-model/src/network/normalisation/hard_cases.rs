//! Statistics of maps whose mean is far larger than their deviation, and of maps without any
//! (`docs/numerics-field.md`).

use super::kernel::{Shape, moments};
use super::{After, normalise};
use crate::network::layers::standardise;
use crate::random::Draw;
use burn::tensor::{Device, Tensor, TensorData};

const SIDE: usize = 128;

/// Uniform noise of this deviation about a centre, rounded to 32 bits.
fn noise(seed: u64, count: usize, centre: f64, deviation: f64) -> Vec<f32> {
    let mut draw = Draw::new(&[seed]);
    let reach = deviation * 3.0_f64.sqrt();
    (0..count).map(|_| draw.range(centre - reach, centre + reach) as f32).collect()
}

/// Mean and variance in 64 bits, about the mean.
fn oracle(values: &[f32]) -> [f64; 2] {
    let count = values.len() as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / count;
    let square = |v: &f32| (f64::from(*v) - mean) * (f64::from(*v) - mean);
    [mean, values.iter().map(square).sum::<f64>() / count]
}

/// `E[x^2] - E[x]^2` in 32 bits, in as many sums side by side as ours.
fn naive(values: &[f32]) -> f32 {
    let count = values.len() as f32;
    let mean = |of: &dyn Fn(f32) -> f32| {
        let mut lanes = [0.0_f32; 16];
        for chunk in values.chunks(16) {
            lanes.iter_mut().zip(chunk).for_each(|(lane, value)| *lane += of(*value));
        }
        lanes.iter().sum::<f32>() / count
    };
    let plain = mean(&|v| v);
    mean(&|v| v * v) - plain * plain
}

#[test]
fn a_variance_does_not_drown_in_the_square_of_the_mean() {
    for centre in [0.0, 3.0, 1e2, 1e3, 1e4, -1e5, 1e6, 1e12] {
        let values = noise(1, 2 * SIDE * SIDE, centre, 1e-6 * f64::abs(centre).max(1e6));
        let shape = Shape { batch: 2, channels: 1, area: SIDE * SIDE };
        let found = moments(shape, &values);
        let [mean, variance] = oracle(&values);
        let errors = [
            (f64::from(found[0]) - mean).abs() / variance.sqrt(),
            (f64::from(found[1]) / variance - 1.0).abs(),
        ];
        let theirs = f64::from(naive(&values)) / variance;
        eprintln!("centre {centre:e}: mean and variance {errors:?}, naive {theirs:.3}");
        // A mean is held in 32 bits: of a centre a million deviations off, to 0.03 of a deviation.
        assert!(errors[0] < 6e-8 * centre.abs() / variance.sqrt() + 1e-6, "{centre}: {errors:?}");
        assert!(errors[1] < 1e-6, "{centre}: {errors:?}");
        if centre.abs() >= 1e4 {
            assert!((theirs - 1.0).abs() > 0.5, "{centre}: {theirs}");
        }
    }
}

#[test]
fn a_plateau_is_nought_after_its_norm_and_not_its_rounding() {
    let device = Device::flex();
    for height in [0.0_f32, 0.1, -7.3, 1234.567, 123_456.7, 1e7, 1e30] {
        let map = Tensor::<4>::full([2, 3, 21, 23], height, &device);
        let [gain, shift] = [1.0, 0.25].map(|v| Tensor::<1>::full([3], v, &device));
        let (output, _) = normalise(map, gain, shift, None, After::Nothing);
        let off = (output - 0.25).abs().max().into_scalar::<f32>();
        assert_eq!(off, 0.0, "{height}");
    }
    // The mean of 966 equal numbers, added up one by one, is another number: its rounding, divided by the root of
    // epsilon, is what the next layer would see.
    let height = 123_456.7_f32;
    let off = height - (0..966).fold(0.0, |sum, _| sum + height) / 966.0;
    let seen = f64::from(off) / (f64::from(off * off) + 1e-5).sqrt();
    eprintln!("a plateau's rounding: {off}, normalised {seen}");
    assert!(seen.abs() > 0.9, "{seen}");
}

#[test]
fn group_norms_of_operations_hold_the_same_to_the_rounding_of_their_mean() {
    let device = Device::flex();
    let (channels, groups) = (8, 4);
    for centre in [0.0, 10.0, 1e3, 1e4] {
        let values = noise(2, channels * SIDE * SIDE, centre, 1.0);
        let data = TensorData::new(values.clone(), [1, channels, SIDE, SIDE]);
        let (_, inverse) = standardise(Tensor::from_data(data, &device), groups, 1e-6);
        let inverse: Vec<f32> = inverse.into_data().iter::<f32>().collect();
        for (group, values) in values.chunks(channels / groups * SIDE * SIDE).enumerate() {
            let [_, variance] = oracle(values);
            let found = f64::from(inverse[group * channels / groups]);
            let error = (found * (variance + 1e-6).sqrt() - 1.0).abs();
            assert!(error < 2e-6, "{centre}: {error:e}");
            if centre >= 1e3 {
                let theirs = f64::from(naive(values)) / variance;
                assert!((theirs - 1.0).abs() > 0.01, "{centre}: {theirs}");
            }
        }
    }
}
