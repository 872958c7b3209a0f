use super::*;
use crate::train::losses::testing::{
    check_gradients_at, golden, narrow, scalar, uniform, values, wide,
};

const SHAPE: [usize; 4] = [2, 1, 11, 14];

fn forms() -> [Depth; 2] {
    [Depth::release(), Depth::paper()]
}

/// A depth and a label at random, a few labels unknown.
fn pair() -> [Vec<f64>; 2] {
    let count = SHAPE.iter().product();
    let depth = uniform(1, count, 0.2, 1.9);
    let mut label = uniform(2, count, 0.0, 1.0);
    for index in (0..count).step_by(17) {
        label[index] = f64::NAN;
    }
    [depth, label]
}

fn terms(depth: &[f64], label: &[f64], form: &Depth) -> [f64; 3] {
    let terms = satellite_depth(wide(depth.to_vec(), SHAPE), wide(label.to_vec(), SHAPE), form);
    [terms.total, terms.level, terms.gradient].map(scalar)
}

#[test]
fn the_reference_gives_the_same_numbers() {
    let terms = satellite_depth(golden("depth_pred"), golden("depth_gt"), &Depth::release());
    for (ours, key) in
        [(terms.total, "depth_total"), (terms.level, "depth_ssi"), (terms.gradient, "depth_reg")]
    {
        let [ours, theirs] = [ours, golden::<1>(key)].map(scalar);
        assert!((ours / theirs - 1.0).abs() < 3e-6, "{key}: {ours} {theirs}");
    }
}

#[test]
fn a_scale_and_a_shift_change_nothing() {
    let [depth, label] = pair();
    let Depth::Aligned(release) = Depth::release() else { unreachable!() };
    // The sizes of what is added to denominators bound the invariance.
    let free = Depth::Aligned(Aligned { spread_epsilon: 0.0, ..release });
    let inverse = |v: f64| 1.0 / (v + 1.0 + 1e-6);
    for (scale, shift) in [(0.01, 0.3), (7.0, 0.0), (1.0, 40.0)] {
        let moved = |v: &f64| (v + 1.0) * scale + shift - 1.0;
        let affine: Vec<f64> = depth.iter().map(moved).collect();
        let [a, b] = [&depth, &affine].map(|v| terms(v, &label, &free)[1]);
        assert!((a / b - 1.0).abs() < 1e-9, "level: {a} {b}");
        let [a, b] = [&depth, &affine].map(|v| terms(v, &label, &Depth::paper()));
        for (a, b) in a.iter().zip(b) {
            assert!((a / b - 1.0).abs() < 1e-9, "paper: {a} {b}");
        }
        let affine: Vec<f64> =
            depth.iter().map(|v| 1.0 / (inverse(*v) * scale + shift) - 1.0 - 1e-6).collect();
        let [a, b] = [&depth, &affine].map(|v| terms(v, &label, &Depth::release())[2]);
        // The determinant's addend of 1e-6 against n^2 times a variance of scale^2.
        assert!((a / b - 1.0).abs() < 1e-5, "gradient: {a} {b}");
    }
    let upside_down: Vec<f64> = depth.iter().map(|v| 2.0 - v).collect();
    let [a, b] = [&depth, &upside_down].map(|v| terms(v, &label, &free)[1]);
    assert!((a / b - 1.0).abs() > 1e-3, "the release's form knows which way is up: {a} {b}");
}

#[test]
fn a_perfect_depth_costs_nothing() {
    let [_, label] = pair();
    let depth: Vec<f64> = label.iter().map(|v| 1.0 / (5.0 * v + 1.0) - 1.0).collect();
    let depth: Vec<f64> = depth.iter().map(|v| if v.is_nan() { 0.7 } else { *v }).collect();
    for value in terms(&depth, &label, &Depth::release()) {
        assert!(value < 1e-4, "{value}");
    }
    let depth: Vec<f64> = label.iter().map(|v| if v.is_nan() { 0.7 } else { 2.0 - v }).collect();
    for value in terms(&depth, &label, &Depth::paper()) {
        assert!(value < 1e-9, "{value}");
    }
}

#[test]
fn what_lies_under_an_unknown_label_has_no_effect() {
    let [depth, label] = pair();
    for form in forms() {
        let mut other = depth.clone();
        for (value, label) in other.iter_mut().zip(&label) {
            if label.is_nan() {
                *value = -1e6;
            }
        }
        assert_eq!(terms(&depth, &label, &form), terms(&other, &label, &form));
    }
}

#[test]
fn depths_behind_the_camera_have_no_pole() {
    let [mut depth, label] = pair();
    let gradient = |depth: &[f64]| terms(depth, &label, &Depth::release())[2];
    depth[20] = -1.0;
    let nearest = gradient(&depth);
    for behind in [-1.000_001, -1.5, -1e6] {
        depth[20] = behind;
        assert_eq!(gradient(&depth), nearest, "{behind}");
    }
}

#[test]
fn the_unit_of_the_depth_does_not_overflow() {
    let [depth, label] = pair();
    let [depth, label] = [depth, label].map(|v| v.iter().map(|v| *v as f32).collect::<Vec<_>>());
    let slopes = |unit: f32| {
        let scaled: Vec<f32> = depth.iter().map(|v| v * unit).collect();
        let leaf = narrow(&scaled, SHAPE).require_grad();
        let terms = satellite_depth(leaf.clone(), narrow(&label, SHAPE), &Depth::paper());
        let slopes = values(leaf.grad(&terms.total.backward()).expect("a gradient"));
        (scalar(terms.total), slopes.iter().fold(0.0_f64, |m, v| m.max(v.abs())))
    };
    let [(a, steep), (b, flat)] = [slopes(1.0), slopes(1e25)];
    assert!((a / b - 1.0).abs() < 1e-5, "{a} {b}");
    assert!((steep / flat / 1e25 - 1.0).abs() < 1e-3, "{steep} {flat}");
}

#[test]
fn the_median_is_the_lower_of_the_known() {
    let known = wide(vec![1.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [2, 1, 1, 4]).greater_elem(0.5);
    let data = wide(vec![4.0, -9.0, 1.0, 3.0, 5.0, 1.0, 1.0, 1.0], [2, 4]);
    let pixels = Pixels::new(&known, &data.clone().reshape([2, 1, 1, 4]));
    assert_eq!(values(pixels.lower_median(data.clone())), [3.0, 5.0]);
    let known = known.bool_not();
    let pixels = Pixels::new(&known, &data.clone().reshape([2, 1, 1, 4]));
    assert_eq!(values(pixels.lower_median(data)), [-9.0, 1.0]);
}

#[test]
fn gradients_agree_with_differences() {
    let [depth, label] = pair();
    for form in forms() {
        for which in 0..3 {
            check_gradients_at("depth", &[SHAPE], std::slice::from_ref(&depth), 2e-6, |input| {
                let label = wide(label.clone(), SHAPE);
                let terms = satellite_depth(input[0].clone(), label, &form);
                [terms.total, terms.level, terms.gradient][which].clone()
            });
        }
    }
}
