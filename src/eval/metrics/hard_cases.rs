//! Means and variances of ten million heights, and of small errors under a large offset, each naive
//! form beside ours; `docs/numerics.md`. (More cases, without the naive form, are in `sums_tests.rs`.)

use super::*;
use crate::random::{key, normal};
use num_bigint::BigInt;
use num_rational::BigRational;
use num_traits::ToPrimitive;

/// Binary digits behind the point with which every height below is a whole number.
const DIGITS: u32 = 40;

/// A height as a whole number of `2^-40` m; exact, since the height is a multiple of that.
fn whole(height: f64) -> i128 {
    let scaled = height * (1_u64 << DIGITS) as f64;
    assert_eq!(scaled.fract(), 0.0, "{height}");
    scaled as i128
}

/// Mean and variance of whole numbers of `2^-40` m, in exact arithmetic, rounded at the end.
fn exact(numbers: impl Iterator<Item = i128> + Clone) -> (f64, f64) {
    let count = BigInt::from(numbers.clone().count());
    // Sums of squares about the first keep to 128 bits.
    let first = numbers.clone().next().unwrap_or(0);
    let (mut sum, mut squares) = (0_i128, BigInt::from(0));
    let mut part = 0_i128;
    for (k, number) in numbers.enumerate() {
        let number = number - first;
        sum += number;
        part += number * number;
        if k % 4096 == 0 {
            squares += part;
            part = 0;
        }
    }
    squares += part;
    let unit = BigRational::from_integer(BigInt::from(1_u64 << DIGITS));
    let mean = BigRational::new(BigInt::from(sum), count.clone());
    let square = BigRational::new(squares, count);
    let variance = (square - &mean * &mean) / (&unit * &unit);
    let mean = (mean + BigRational::from_integer(BigInt::from(first))) / unit;
    (mean.to_f64().unwrap_or(f64::NAN), variance.to_f64().unwrap_or(f64::NAN))
}

#[test]
fn ten_million_heights_have_the_mean_and_the_spread_of_exact_arithmetic() {
    // N(120, 5) m, as a raster holds them.
    let heights: Vec<f32> =
        (0..10_000_000_u64).map(|k| (120.0 + 5.0 * normal(key(&[7, k]))) as f32).collect();
    let (mean, variance) = exact(heights.iter().map(|h| whole(f64::from(*h))));
    assert!((mean - 120.0).abs() < 0.01 && (variance.sqrt() - 5.0).abs() < 0.01);

    // In f32: once the sum has passed 2^30, its steps are as large as a height.
    let count = heights.len() as f32;
    let naive_mean = heights.iter().sum::<f32>() / count;
    let squares = heights.iter().map(|h| h * h).sum::<f32>() / count;
    let naive_variance = squares - naive_mean * naive_mean;
    println!("naive {naive_mean} {naive_variance}, exact {mean} {variance}");
    assert!((f64::from(naive_mean) - mean).abs() > 5.0, "{naive_mean}");
    assert!((f64::from(naive_variance) - variance).abs() > 100.0, "{naive_variance}");

    let mut sums = ErrorSums::new(2);
    for part in heights.chunks(1 << 16) {
        let part: Vec<f64> = part.iter().map(|h| f64::from(*h)).collect();
        sums.add(&part, &PUBLISHED_THRESHOLDS_M);
    }
    assert!((sums.bias() / mean - 1.0).abs() < 3e-16, "{} {mean}", sums.bias());
    assert!((sums.std() / variance.sqrt() - 1.0).abs() < 1e-15, "{}", sums.std());
}

#[test]
fn a_small_spread_under_a_large_offset_keeps_its_digits() {
    // Spreads of a millimetre and of a micrometre under 4,000 m: a wrong datum, a wrong unit.
    for (step, naive_off) in [(-20, 1e-4), (-30, 1.0)] {
        let step = libm::exp2(f64::from(step));
        let errors: Vec<f64> =
            (0..100_003).map(|i| 4000.0 + step * f64::from((i * 7919) % 2003 - 1001)).collect();
        let (mean, variance) = exact(errors.iter().map(|e| whole(*e)));
        let count = errors.len() as f64;
        let plain = errors.iter().sum::<f64>() / count;
        let naive = errors.iter().map(|e| e * e).sum::<f64>() / count - plain * plain;
        println!("{step:e}: naive {naive:e}, exact {variance:e}");
        let naive = (naive / variance - 1.0).abs();
        assert!(naive > naive_off, "mean of squares less square of mean: {naive:e}");
        let mut sums = ErrorSums::new(2);
        sums.add(&errors, &PUBLISHED_THRESHOLDS_M);
        assert!((sums.std() / variance.sqrt() - 1.0).abs() < 1e-15, "{:e}", sums.std());
        assert!((sums.bias() / mean - 1.0).abs() < 3e-16, "{}", sums.bias());
    }
}
