#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::*;
use num_bigint::BigInt;
use num_rational::BigRational;
use num_traits::{Signed, ToPrimitive, Zero};
use proptest::prelude::*;

const THRESHOLDS: [f64; 3] = [2.5, 7.5, 1.0];

fn rational(value: f64) -> BigRational {
    BigRational::from_float(value).unwrap()
}

/// MAE, RMSE, bias and standard deviation in exact arithmetic, rounded at the end.
fn exact(errors: &[f64]) -> [f64; 4] {
    let count = BigRational::from_integer(BigInt::from(errors.len()));
    let mut sum = BigRational::zero();
    let mut absolute = BigRational::zero();
    let mut square = BigRational::zero();
    for error in errors {
        let error = rational(*error);
        sum += &error;
        absolute += error.abs();
        square += &error * &error;
    }
    let (bias, mean_square) = (sum / &count, square / &count);
    let variance = &mean_square - &bias * &bias;
    [
        (absolute / count).to_f64().unwrap(),
        mean_square.to_f64().unwrap().sqrt(),
        bias.to_f64().unwrap(),
        variance.to_f64().unwrap().sqrt(),
    ]
}

fn assert_exact(sums: &ErrorSums, expected: [f64; 4], case: &str) {
    let found = [sums.mae(), sums.rmse(), sums.bias(), sums.std()];
    for ((found, expected), score) in found.iter().zip(expected).zip(["mae", "rmse", "bias", "std"])
    {
        let slack = if score == "bias" { 1e-30 * sums.mae() } else { 0.0 };
        let off = (found - expected).abs();
        assert!(off <= 1e-15 * expected.abs() + slack, "{case}: {score} {found:e}, {expected:e}");
    }
}

fn of(errors: &[f64]) -> ErrorSums {
    let mut sums = ErrorSums::new(THRESHOLDS.len());
    sums.add(errors, &THRESHOLDS);
    sums
}

/// The same errors, doubled so many times.
fn doubled(mut sums: ErrorSums, times: u32) -> ErrorSums {
    for _ in 0..times {
        sums.merge(&sums.clone());
    }
    sums
}

#[test]
fn hard_cases_agree_with_exact_arithmetic() {
    let wave = |scale: f64, offset: f64| -> Vec<f64> {
        (0..5000_i32).map(|i| offset + scale * f64::from((i * 7919) % 2003 - 1001)).collect()
    };
    let cases: [(&str, Vec<f64>); 17] = [
        ("one pixel", vec![-3.7]),
        ("two pixels", vec![0.1, 0.3]),
        ("neighbours", vec![4000.1, 4000.1_f64.next_up()]),
        ("many neighbours", [0.1, 0.1_f64.next_up(), 0.1].repeat(3000)),
        ("millimetres at 4,000 m", wave(1e-6, 4000.0)),
        ("tenths of a micrometre at 8,000 m", wave(1e-10, -8000.0)),
        ("millimetres", wave(1e-6, 0.0)),
        ("alternating", (0..9999).map(|i| if i % 2 == 0 { 1.1 } else { -1.1 }).collect()),
        ("cancelling but for 1e-9", [1e3 + 1e-9, -1e3].repeat(4000)),
        ("cancelling in threes", [1e20, 1.0, -1e20].repeat(3000)),
        ("f32 near overflow", [6.8e38, -6.8e38, 3.4e38, 0.0].repeat(1024)),
        ("f32 near overflow, once", [vec![0.5; 3000], vec![-6.8e38]].concat()),
        ("f32 subnormal", [1e-45_f32, -1.4e-43, 3e-39].map(f64::from).repeat(900)),
        ("zeros", vec![0.0; 100]),
        ("zeros of both signs", [0.0, -0.0].repeat(50)),
        ("all outliers", wave(1e3, 1e6)),
        ("growing", (0..300).map(|i| 1.5_f64.powi(i % 90)).collect()),
    ];
    for (case, errors) in cases {
        let expected = exact(&errors);
        let whole = of(&errors);
        assert_exact(&whole, expected, case);
        for piece in [1, 7, 1000] {
            let mut merged = ErrorSums::new(THRESHOLDS.len());
            for part in errors.chunks(piece) {
                merged.merge(&of(part));
            }
            assert_exact(&merged, expected, &format!("{case}, {piece} at a time"));
            assert_eq!(merged.below, whole.below);
            assert_eq!(merged.max_abs, whole.max_abs);
        }
        // The same over 10^9 pixels.
        let times = (30.0 - (errors.len() as f64).log2()) as u32 + 1;
        assert_exact(&doubled(whole, times), expected, &format!("{case}, doubled"));
    }
}

#[test]
fn ten_million_errors_one_after_another() {
    // Every chunk is the same multiset of errors in another order, so that the exact result is that of
    // one of them.
    let chunk: Vec<f64> = (0..10_000_i32).map(|i| 4000.0 + 1e-6 * f64::from(i - 3000)).collect();
    let expected = exact(&chunk);
    let mut sums = ErrorSums::new(3);
    for turn in 0..1000 {
        let mut turned = chunk.clone();
        turned.rotate_left(turn * 7 % 10_000);
        sums.add(&turned, &THRESHOLDS);
    }
    assert_eq!(sums.pixels(), 10_000_000);
    assert_exact(&sums, expected, "streamed");
}

#[test]
fn constant_surfaces_have_no_spread_at_all() {
    for constant in [0.1, -4000.1, 1e-3, 6.8e38, 1.4e-45, 1.0 / 3.0, 5e-324] {
        for pixels in [1, 2, 3, 65_536, 100_003] {
            let sums = doubled(of(&vec![constant; pixels]), 14);
            assert_eq!(sums.std(), 0.0, "{constant} {pixels}");
            assert_eq!(sums.bias(), constant);
            assert_eq!(sums.mae(), constant.abs());
            assert_eq!(sums.rmse(), constant.abs());
            assert_eq!(sums.max_abs(), constant.abs());
        }
    }
}

#[test]
fn squares_that_vanish_leave_the_rmse_between_mae_and_maximum() {
    let sums = of(&[5e-324, -1e-300, 1e-310]);
    assert!(sums.rmse() >= sums.mae() && sums.rmse() <= sums.max_abs() && sums.mae() > 0.0);
}

#[test]
fn an_error_at_a_threshold_does_not_count() {
    let mut errors = Vec::new();
    for threshold in [2.5_f64, 7.5, 1.0] {
        for sign in [1.0, -1.0] {
            errors
                .extend([threshold, threshold.next_down(), threshold.next_up()].map(|e| e * sign));
        }
    }
    let sums = of(&errors);
    assert_eq!(sums.below, [6 + 2, 2 * 6 + 2, 2]);
    assert_eq!(sums.below(0), 8);
    assert_eq!(sums.below_pct(2), 100.0 * 2.0 / 18.0);
}

#[test]
fn nothing_has_no_scores() {
    let mut sums = of(&[]);
    sums.merge(&ErrorSums::new(3));
    for score in [sums.mae(), sums.rmse(), sums.bias(), sums.std(), sums.max_abs()] {
        assert!(score.is_nan());
    }
    assert!(sums.below_pct(0).is_nan());
    // Nor does it change what it is merged with.
    let mut some = of(&[1.0, 2.0]);
    some.merge(&sums);
    assert_eq!(some, of(&[1.0, 2.0]));
    sums.merge(&some);
    assert_eq!(some, sums);
    assert!(mean(&[]).is_nan());
}

proptest! {
    #[test]
    fn sums_agree_with_exact_arithmetic_and_return_from_json(
        errors in proptest::collection::vec(
            prop_oneof![-100.0..100.0_f64, -1e-3..1e-3_f64, 3999.0..4001.0_f64, -7e38..7e38_f64],
            1..200,
        ),
        split in 0..200_usize,
    ) {
        let split = split.min(errors.len());
        let mut sums = of(&errors[..split]);
        sums.merge(&of(&errors[split..]));
        assert_exact(&sums, exact(&errors), "random");
        let text = serde_json::to_string(&sums).unwrap();
        let back: ErrorSums = serde_json::from_str(&text).unwrap();
        prop_assert_eq!(back, sums);
    }
}
