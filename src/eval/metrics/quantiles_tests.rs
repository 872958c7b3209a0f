#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::*;
use crate::random::{Draw, key as hash, normal};
use proptest::prelude::*;

/// The definition, by sorting.
fn sorted_quantile(values: &[f64], level: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = (sorted.len() - 1) as f64 * level;
    let (low, high) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    between(low, high, at.fract())
}

fn sorted_median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    (sorted[(sorted.len() - 1) / 2] + sorted[sorted.len() / 2]) / 2.0
}

fn naive(errors: &[f64]) -> Quantiles {
    let median = sorted_median(errors);
    let deviations: Vec<f64> = errors.iter().map(|e| (e - median).abs()).collect();
    let absolute: Vec<f64> = errors.iter().map(|e| e.abs()).collect();
    Quantiles {
        median,
        nmad: NMAD_FACTOR * sorted_median(&deviations),
        le68: sorted_quantile(&absolute, 0.68),
        le90: sorted_quantile(&absolute, 0.9),
        p95: sorted_quantile(&absolute, 0.95),
    }
}

fn pooled(parts: &[&[f64]]) -> Quantiles {
    let mut coarse = CoarseCounts::new();
    for part in parts {
        let mut counts = CoarseCounts::new();
        counts.add(part);
        coarse.merge(&counts);
    }
    let refinement = coarse.refinement();
    // Flat memory, whatever the errors: 64 bins of 65,536 cells.
    assert!(refinement.cells() <= 64 << 16, "{} cells", refinement.cells());
    let mut fine = FineCounts::new(&refinement);
    for part in parts {
        let mut counts = FineCounts::new(&refinement);
        counts.add(part);
        fine.merge(&counts);
    }
    Quantiles::pooled(&coarse, &fine)
}

fn check(errors: &[f64], case: &str) {
    let expected = naive(errors);
    let found = Quantiles::of(errors, &mut vec![f64::NAN; 3]);
    assert_eq!(found, expected, "{case}");

    // Order statistics of the rounded errors are exact to the bit.
    let rounded: Vec<f64> = errors.iter().map(|e| f64::from(rounded(*e))).collect();
    let of_rounded = naive(&rounded);
    let middle = errors.len() / 2;
    let found = pooled(&[&errors[..middle], &errors[middle..]]);
    assert_eq!(found.median, of_rounded.median, "{case}");
    assert_eq!(found.le68, of_rounded.le68, "{case}");
    assert_eq!(found.le90, of_rounded.le90, "{case}");
    assert_eq!(found.p95, of_rounded.p95, "{case}");
    let scale = found.median.abs() + of_rounded.nmad;
    let off = (found.nmad - of_rounded.nmad).abs();
    assert!(off <= 1e-7 * scale, "{case}: NMAD {} {}", found.nmad, of_rounded.nmad);

    // And near those of the errors as they are.
    if errors.iter().all(|e| e.abs() < 3e38 && (*e == 0.0 || e.abs() > 1e-30)) {
        for (found, expected) in [
            (found.median, expected.median),
            (found.le68, expected.le68),
            (found.le90, expected.le90),
            (found.p95, expected.p95),
        ] {
            assert!((found - expected).abs() <= 6e-8 * scale.max(expected.abs()), "{case}");
        }
        assert!((found.nmad - expected.nmad).abs() <= 2e-7 * scale.max(expected.nmad), "{case}");
    }
}

fn normals(count: u64, mean: f64, spread: f64) -> Vec<f64> {
    (0..count).map(|i| mean + spread * normal(hash(&[17, i]))).collect()
}

/// Numbers evenly spread over the logarithm: every coarse bin down to the smallest is occupied.
fn log_uniform(count: u64, sign: impl Fn(u64) -> f64) -> Vec<f64> {
    let mut draw = Draw::new(&[5]);
    (0..count).map(|i| sign(i) * libm::exp(draw.range(-100.0, 3.0))).collect()
}

#[test]
fn adversarial_errors_are_refined_where_it_matters() {
    let both = |i: u64| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    let cases: Vec<(&str, Vec<f64>)> = vec![
        ("one", vec![3.3]),
        ("two", vec![-10.0, 10.0]),
        ("two alike", vec![0.1, 0.1]),
        ("constant", vec![-4000.1; 999]),
        ("zeros", vec![0.0; 10]),
        ("zeros of both signs", [0.0, -0.0].repeat(9)),
        ("two values, even", [-10.0, 10.0].repeat(50)),
        ("two values, odd", [vec![-10.0; 51], vec![10.0; 50]].concat()),
        ("two values, same sign", [0.0, 10.0].repeat(50)),
        ("a few values", [1.0, 2.0, 3.0, 4.0, 5.0, -1.0].repeat(40)),
        ("one bin", (0..3000).map(|i| 1.0 + f64::from(i) * 1e-6).collect()),
        ("neighbours", (0..99).map(|i| f64::from(f32::from_bits(0x4000_0000 + i))).collect()),
        ("normal", normals(20_001, 0.0, 2.0)),
        ("far from zero", normals(20_000, 4000.0, 1e-3)),
        ("far below zero", normals(20_000, -4000.0, 0.2)),
        ("one sign", normals(5000, 3.0, 1.0)),
        ("bimodal", [normals(3000, -20.0, 0.5), normals(3000, 20.0, 0.5)].concat()),
        ("bimodal, one at zero", [normals(3000, 0.0, 1e-4), normals(3000, 20.0, 1e-4)].concat()),
        ("half at zero", [vec![0.0; 3000], normals(3000, 10.0, 1.0)].concat()),
        ("half tiny", [log_uniform(6000, both), vec![10.0; 6001]].concat()),
        ("half tiny, even", [log_uniform(6000, both), vec![10.0; 6000]].concat()),
        ("tiny around zero, spread around 7", {
            [log_uniform(9000, both), normals(9001, 7.0, 0.01)].concat()
        }),
        ("log-uniform", log_uniform(20_000, both)),
        ("log-uniform, positive", log_uniform(20_001, |_| 1.0)),
        ("log-uniform, negative", log_uniform(20_000, |_| -1.0)),
        ("subnormal", (0..500).map(|i| f64::from(f32::from_bits(i * 37))).collect()),
        ("subnormal, both", (0..500).map(|i| both(i) * 1e-45 * i as f64).collect()),
        ("below f32", (0..50).map(|i| both(i) * 1e-300 * i as f64).collect()),
        ("beyond f32", (0..60).map(|i| both(i) * (1e37 + 1.1e37 * i as f64)).collect()),
        ("around powers of two", {
            (1..4000).map(|i| 1.0 + f64::from(i - 2000) * 2f64.powi(-23)).collect()
        }),
        ("uniform on 0..6", (0..60_001).map(|i| f64::from(i) * 1e-4).collect()),
        ("exponential", (0..40_000).map(|i| -libm::log((f64::from(i) + 0.5) / 4e4)).collect()),
        ("millimetres", (0..9000).map(|i| f64::from(i % 300) * 0.001).collect()),
    ];
    for (case, errors) in cases {
        check(&errors, case);
        let opposite: Vec<f64> = errors.iter().map(|e| -e).collect();
        check(&opposite, &format!("{case}, opposite"));
    }
}

#[test]
fn nothing_has_no_quantiles() {
    let empty = pooled(&[&[], &[]]);
    assert!(empty.median.is_nan() && empty.nmad.is_nan() && empty.p95.is_nan());
    let empty = Quantiles::of(&[], &mut Vec::new());
    assert!(empty.le68.is_nan() && empty.le90.is_nan());
}

#[test]
fn counts_do_not_depend_on_the_order_of_parts() {
    let (a, b) = (normals(1000, 0.0, 1.0), normals(777, 1.0, 4.0));
    assert_eq!(pooled(&[&a, &b]), pooled(&[&b, &a]));
}

#[test]
#[should_panic(expected = "same errors")]
fn a_second_pass_over_other_errors_is_noticed() {
    let mut coarse = CoarseCounts::new();
    coarse.add(&[1.0, 2.0, 3.0]);
    let mut fine = FineCounts::new(&coarse.refinement());
    fine.add(&[1.0, 2.0]);
    let _ = Quantiles::pooled(&coarse, &fine);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn random_errors(
        errors in proptest::collection::vec(
            prop_oneof![
                -30.0..30.0_f64,
                (-20..20_i32).prop_map(f64::from),
                (-1e-3..1e-3_f64),
                (0..64_i32, any::<bool>()).prop_map(|(e, s)| {
                    let value = 2f64.powi(10 - e);
                    if s { -value } else { value }
                }),
                Just(0.0),
            ],
            1..120,
        ),
        offset in prop_oneof![Just(0.0), -5000.0..5000.0_f64],
    ) {
        let errors: Vec<f64> = errors.iter().map(|e| e + offset).collect();
        check(&errors, "random");
    }
}
