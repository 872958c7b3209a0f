//! Least squares on depths that say nothing, or that are told apart by their last digits
//! (`docs/numerics-field.md`).

use super::*;
use crate::train::losses::testing::{narrow, scalar, uniform, values, wide};

/// 1147 pixels: no power of two, so that a mean is rounded.
const SHAPE: [usize; 4] = [1, 1, 31, 37];
const COUNT: usize = 31 * 37;

fn forms() -> [Depth; 2] {
    [Depth::release(), Depth::paper()]
}

/// In 32 bits, and the same 32-bit inputs in 64.
fn both(depth: &[f32], label: &[f32], form: &Depth) -> [[f64; 3]; 2] {
    let of = |terms: DepthTerms| [terms.total, terms.level, terms.gradient].map(scalar);
    let widened = |v: &[f32]| wide(v.iter().map(|v| f64::from(*v)).collect(), SHAPE);
    [
        of(satellite_depth(narrow(depth, SHAPE), narrow(label, SHAPE), form)),
        of(satellite_depth(widened(depth), widened(label), form)),
    ]
}

/// Scale and shift by the normal equations as they stand in textbooks.
fn normal_equations(depth: &[f32], label: &[f32]) -> [f32; 2] {
    let n = depth.len() as f32;
    let sum = |of: &dyn Fn(f32, f32) -> f32| -> f32 {
        depth.iter().zip(label).map(|(d, l)| of(*d, *l)).sum()
    };
    let [d, l] = [sum(&|d, _| d), sum(&|_, l| l)];
    let [dd, dl] = [sum(&|d, _| d * d), sum(&|d, l| d * l)];
    let determinant = n * dd - d * d;
    [(n * dl - d * l) / determinant, (dd * l - d * dl) / determinant]
}

/// Mean absolute difference of the fit and the label.
fn level(depth: &[f32], label: &[f32], [scale, shift]: [f32; 2]) -> f64 {
    let off = depth.iter().zip(label).map(|(d, l)| f64::from((scale * d + shift - l).abs()));
    off.sum::<f64>() / depth.len() as f64
}

fn noise(seed: u64, low: f64, high: f64) -> Vec<f32> {
    uniform(seed, COUNT, low, high).into_iter().map(|v| v as f32).collect()
}

#[test]
fn a_fit_keeps_its_digits_under_any_offset() {
    let label = noise(1, 0.0, 1.0);
    for offset in [0.0_f32, 10.0, 1e3, 1e4, -1e5] {
        // Depths to the label's line, and a little beside it; rounded where they stand.
        let depth: Vec<f32> = (label.iter().zip(noise(2, -0.05, 0.05)))
            .map(|(label, aside)| offset + 2.0 - label + aside)
            .collect();
        let [ours, exact] = both(&depth, &label, &Depth::paper());
        let naive = level(&depth, &label, normal_equations(&depth, &label)) / exact[1];
        let error = (ours[1] / exact[1] - 1.0).abs();
        eprintln!("offset {offset:e}: ours {error:.1e}, normal equations {:.1e}", naive - 1.0);
        assert!(error < 3e-4, "{offset}: {ours:?} {exact:?}");
        assert!((ours[2] / exact[2] - 1.0).abs() < 3e-4, "{offset}: {ours:?} {exact:?}");
        if offset.abs() >= 1e3 {
            assert!(naive > 2.0 || naive.is_nan(), "{offset}: {naive}");
        }
    }
}

#[test]
fn a_constant_depth_is_fitted_by_the_mean_label_and_pushes_nowhere() {
    let label = noise(3, 0.0, 1.0);
    let mean = label.iter().map(|v| f64::from(*v)).sum::<f64>() / COUNT as f64;
    let away = label.iter().map(|v| (f64::from(*v) - mean).abs()).sum::<f64>() / COUNT as f64;
    for constant in [0.0_f32, 0.1, 1.7, 123.456, -1e6, 1e12] {
        let depth = vec![constant; COUNT];
        let [scale, _] = normal_equations(&depth, &label);
        // Nought by nought, or a determinant of rounding: a scale of any size.
        assert!(constant.abs() < 1.0 || scale.is_nan() || scale.abs() < 1e30, "{scale}");
        let [ours, _] = both(&depth, &label, &Depth::paper());
        assert!((ours[1] / away - 1.0).abs() < 1e-5, "{constant}: {ours:?} {away}");
        for form in forms() {
            let leaf = narrow(&depth, SHAPE).require_grad();
            let terms = satellite_depth(leaf.clone(), narrow(&label, SHAPE), &form);
            let slopes = values(leaf.grad(&terms.total.backward()).expect("a gradient"));
            assert!(slopes.iter().all(|slope| slope.is_finite()), "{form:?} {constant}");
        }
    }
    let naive = normal_equations(&[0.1; COUNT], &label);
    eprintln!("a constant of 0.1 by the normal equations: {naive:?}");
    assert!(naive[0].is_nan() || naive[0].abs() > 1.0, "{naive:?}");
}

#[test]
fn a_constant_label_asks_for_no_shape() {
    let depth = noise(4, 0.2, 1.9);
    for constant in [0.0_f32, 0.1, 1.0] {
        let label = vec![constant; COUNT];
        let [ours, _] = both(&depth, &label, &Depth::paper());
        assert!(ours.iter().all(|term| *term < 1e-6), "{constant}: {ours:?}");
        let [ours, exact] = both(&depth, &label, &Depth::release());
        for (ours, exact) in ours.iter().zip(exact) {
            assert!(
                (ours - exact).abs() <= 1e-5 * exact.abs() + 2e-5,
                "{constant}: {ours} {exact}"
            );
        }
    }
}

#[test]
fn units_from_a_micrometre_to_light_years_change_nothing() {
    let (depth, label) = (noise(5, 0.2, 1.9), noise(6, 0.0, 1.0));
    let [_, want] = both(&depth, &label, &Depth::paper());
    // From where the spread's addend of 1e-6 is not felt to the last units whose squares 32 bits do not hold.
    for unit in [1e-2_f32, 1.0, 1e6, 1e18, 1e25, 1e30] {
        let scaled: Vec<f32> = depth.iter().map(|v| v * unit).collect();
        let [ours, _] = both(&scaled, &label, &Depth::paper());
        for (ours, want) in ours.iter().zip(want) {
            assert!((ours / want - 1.0).abs() < 1e-4, "{unit:e}: {ours} {want}");
        }
        if unit > 1e19 {
            assert!(normal_equations(&scaled, &label)[0].is_nan());
        }
    }
}
