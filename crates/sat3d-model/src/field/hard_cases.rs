//! The field's functions where their textbook forms fail (`docs/numerics-field.md`).
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::kernel::{
    LANES, exp_nonpositive, exp_nonpositive_f64, one_minus_exp, one_minus_exp_f64, sigmoid,
    softplus, sum_lanes,
};
use super::{DensityActivation, Field, FieldError, FieldInputs, Linear, PointHead, Representation};
use crate::exact::{exact, exp_minus, magnitudes, one_minus_exp as exact_one_minus_exp, relative};
use crate::tensor::Grid;
use pulp::Arch;

/// Relative error of a 32-bit result against one of 64 bits.
fn off(got: f32, want: f64) -> f64 {
    ((f64::from(got) - want) / want).abs()
}

/// 32-bit numbers over 60 orders of magnitude, from the least normal ones on.
fn sixty_orders() -> impl Iterator<Item = f32> {
    magnitudes(-37, 23, 200).map(|x| x as f32)
}

#[test]
fn opacity_keeps_its_digits_over_sixty_orders_of_magnitude() {
    let naive = |x: f32| 1.0 - libm::expf(-x);
    let (mut ours, mut theirs) = (0.0_f64, 0.0_f64);
    for x in sixty_orders() {
        let want = -libm::expm1(-f64::from(x));
        ours = ours.max(off(one_minus_exp(x), want));
        theirs = theirs.max(off(naive(x), want));
    }
    eprintln!("1 - exp(-x) in 32 bits: {ours:e}, naive {theirs}");
    assert!(ours < 2e-7, "{ours}");
    // Nothing is left of it below 3e-8, and three digits at 1e-4.
    for (x, least) in [(1e-37, 1.0), (2.9e-8, 1.0), (1e-6, 0.01), (1e-4, 1e-4)] {
        let error = off(naive(x), -libm::expm1(-f64::from(x)));
        assert!(error >= least, "{x:e}: {error}");
    }
}

#[test]
fn opacity_in_64_bits_keeps_its_digits_over_six_hundred_orders() {
    let naive = |x: f64| 1.0 - libm::exp(-x);
    let (mut ours, mut theirs) = (0.0_f64, 0.0_f64);
    for x in magnitudes(-300, 300, 8) {
        let want = exact_one_minus_exp(&exact(x));
        ours = ours.max(relative(one_minus_exp_f64(x), &want));
        theirs = theirs.max(relative(naive(x), &want));
    }
    for x in magnitudes(-3, 3, 500) {
        ours = ours.max(relative(one_minus_exp_f64(x), &exact_one_minus_exp(&exact(x))));
    }
    eprintln!("1 - exp(-x) in 64 bits: {ours:e}, naive {theirs}");
    assert!(ours < 1e-15, "{ours}");
    assert!(theirs == 1.0, "{theirs}");
}

#[test]
fn exponentials_are_reduced_without_loss_and_are_never_denormal() {
    // One constant for ln 2, as the textbook reduces: the product's rounding is the result's error.
    let naive = |x: f32| {
        let whole = (x * std::f32::consts::LOG2_E).round();
        let rest = x - whole * std::f32::consts::LN_2;
        libm::scalbnf(libm::expf(rest), whole as i32)
    };
    let (mut ours, mut theirs) = (0.0_f64, 0.0_f64);
    for k in 0..=870_000 {
        let x = -(k as f32) * 1e-4;
        let want = libm::exp(f64::from(x));
        ours = ours.max(off(exp_nonpositive(x), want));
        theirs = theirs.max(off(naive(x), want));
    }
    eprintln!("exp in 32 bits: {ours:e}, with one constant {theirs:e}");
    assert!(ours < 2e-7 && theirs > 1e-6, "{ours} {theirs}");
    // Beyond, the platform's falls to denormal numbers and to nought, where a logarithm is infinite.
    assert!(libm::expf(-90.0).is_subnormal() && libm::expf(-104.0) == 0.0);
    for x in sixty_orders() {
        let value = exp_nonpositive(-x);
        assert!(value.is_normal() && value >= 1.6e-38, "{x}: {value:e}");
        assert!(sigmoid(-x).is_normal() && softplus(-x).is_normal(), "{x}");
    }
    let mut worst = 0.0_f64;
    for k in 0..=7000 {
        let x = f64::from(k) * 0.1;
        worst = worst.max(relative(exp_nonpositive_f64(-x), &exp_minus(&exact(x))));
    }
    eprintln!("exp in 64 bits: {worst:e}");
    assert!(worst < 5e-16, "{worst}");
    assert!(libm::exp(-746.0) == 0.0 && exp_nonpositive_f64(-1e300).is_normal());
}

#[test]
fn softplus_neither_overflows_nor_loses_its_small_values() {
    let naive = |x: f32| libm::logf(1.0 + libm::expf(x));
    let want = |x: f32| {
        let x = f64::from(x);
        x.max(0.0) + libm::log1p(libm::exp(-x.abs()))
    };
    let mut ours = 0.0_f64;
    for x in sixty_orders().flat_map(|x| [x, -x]) {
        if x > -87.0 {
            ours = ours.max(off(softplus(x), want(x)));
        } else {
            // What is true is less than 1.7e-38, and so is what is said.
            assert!(softplus(x) > 0.0 && softplus(x) < 1.7e-38, "{x}");
        }
    }
    eprintln!("softplus: {ours:e}");
    assert!(ours < 2e-7, "{ours}");
    assert!(naive(89.0).is_infinite() && softplus(89.0) == 89.0);
    assert!(naive(-17.0) == 0.0 && off(softplus(-17.0), want(-17.0)) < 2e-7);
    assert!(off(naive(-10.0), want(-10.0)) > 1e-4);
    assert_eq!(softplus(f32::MAX), f32::MAX);
}

#[test]
fn sigmoid_is_right_on_both_sides() {
    let naive = |x: f32| libm::expf(x) / (1.0 + libm::expf(x));
    let mut ours = 0.0_f64;
    for x in sixty_orders().flat_map(|x| [x, -x]) {
        let want = 1.0 / (1.0 + libm::exp(-f64::from(x)));
        if x > -87.0 {
            ours = ours.max(off(sigmoid(x), want));
        } else {
            assert!(sigmoid(x) < 1.7e-38, "{x}");
        }
    }
    eprintln!("sigmoid: {ours:e}");
    assert!(ours < 2e-7, "{ours}");
    assert!(naive(89.0).is_nan() && sigmoid(89.0) == 1.0);
    // The complement by subtraction has no digits where its own argument's sign gives them all.
    let want = 1.0 / (1.0 + libm::exp(20.0));
    assert!(off(1.0 - sigmoid(20.0), want) == 1.0 && off(sigmoid(-20.0), want) < 2e-7);
}

#[test]
fn a_density_that_is_no_number_is_empty_space() {
    for activation in [DensityActivation::Mipnerf, DensityActivation::Relu] {
        assert!(activation.apply(f32::NAN) < 1.7e-38);
        assert!(activation.apply(f32::NEG_INFINITY) < 1.7e-38);
        assert_eq!(activation.apply(f32::INFINITY), f32::INFINITY);
    }
    // The textbook forms hand it on, to every sum of the ray.
    assert!(f32::ln(1.0 + f32::exp(f32::NAN)).is_nan());
}

/// A field of 21 hidden units: the map's values times `weight`, each unit's share of the density `density`.
fn field(arch: Arch, value: f32, weight: f32, density: f32) -> Result<Field, FieldError> {
    let linear = |inputs: usize, outputs: usize, weight: f32| Linear {
        inputs,
        outputs,
        weight: (0..inputs * outputs).map(|k| weight * (1.0 + 0.1 * (k % 7) as f32)).collect(),
        bias: vec![0.0; outputs],
    };
    let data = (0..4 * 64).map(|k| value * (1.0 + (k % 5) as f32)).collect();
    let inputs = FieldInputs {
        map: Grid::new(4, 8, 8, data),
        representation: Representation::Oneplane,
        activation: DensityActivation::Mipnerf,
        scale: 0.8,
    };
    let head = PointHead {
        net0: linear(4, 21, weight),
        density: linear(21, 1, density),
        feature: linear(21, 3, 1.0),
        style: linear(1, 3, 0.0),
        color: linear(6, 4, 1.0),
    };
    Ok(Field { arch, ..Field::new(&inputs, &head, None)? })
}

/// Every vector unit of this machine, and none at all.
pub(super) fn units() -> Vec<Arch> {
    let mut units = vec![Arch::Scalar, Arch::new()];
    #[cfg(target_arch = "x86_64")]
    units.extend(pulp::x86::V3::try_new().map(Arch::V3));
    units
}

#[test]
fn every_vector_unit_keeps_denormals_and_gives_the_same_bytes() {
    let points: Vec<[f32; 3]> =
        (0..300).map(|k| [7, 11, 13].map(|step| (k * step % 101) as f32 / 46.0 - 1.1)).collect();
    // Texels, then weights, then products are denormal; everything is; and the largest that there is.
    let cases = [
        (1e-30, 1e-12, 1.0),
        (1.0, 1e-41, 1.0),
        (1.0, 1.0, 1e-42),
        (1e-41, 1e-41, 1e-41),
        (1e15, 1e15, 1.0),
    ];
    for (value, weight, density) in cases {
        let raw: Vec<Vec<f32>> = units()
            .into_iter()
            .map(|arch| field(arch, value, weight, density).unwrap().raw_densities(&points))
            .collect();
        for other in &raw[1..] {
            assert!(raw[0].iter().zip(other).all(|(a, b)| a.to_bits() == b.to_bits()));
        }
        if density < 1e-38 {
            // Units that flush denormals to nought, as compilers' fast mathematics has them, would lose all.
            assert!(raw[0].iter().all(|raw| raw.is_subnormal()), "{:e}", raw[0][0]);
        }
    }
    // Softplus of nothing is ln 2; 21 products of a denormal weight, each rounded to 1.4e-45 at worst.
    let [raw] = field(Arch::new(), 0.0, 0.0, 1e-42).unwrap().raw_densities(&[[0.0; 3]])[..] else {
        panic!("one point")
    };
    let weights = (0..21).map(|k| f64::from(1e-42_f32 * (1.0 + 0.1 * (k % 7) as f32)));
    let want = weights.sum::<f64>() * std::f64::consts::LN_2;
    assert!((f64::from(raw) - want).abs() < 21.0 * 1.4e-45, "{raw:e} {want:e}");
}

#[test]
fn a_sum_does_not_depend_on_the_width_of_the_vectors() {
    // As a compiler sums in lanes of a unit's own width, with the same additions in another order.
    fn naive<const WIDTH: usize>(values: &[f32]) -> f32 {
        let mut lanes = [0.0_f32; WIDTH];
        for chunk in values.chunks_exact(WIDTH) {
            for (lane, value) in lanes.iter_mut().zip(chunk) {
                *lane += value;
            }
        }
        lanes.iter().sum()
    }
    let values: Vec<f32> = (0..512)
        .map(|k| (if k % 2 == 0 { 1.0 } else { -1.0 }) * (1.0 + k as f32 * 0.37).powi(4))
        .collect();
    let sums = [naive::<1>(&values), naive::<4>(&values), naive::<8>(&values)];
    eprintln!("one list, summed in 1, 4 and 8 lanes: {sums:?}");
    assert!(sums[0] != sums[1] && sums[1] != sums[2]);
    // In 16 fixed lanes it is one number, here with the order written out.
    let mut lanes = [0.0_f32; LANES];
    for chunk in values.chunks_exact(LANES) {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += value;
        }
    }
    let pair = |k: usize| (lanes[k] + lanes[k + 8]) + (lanes[k + 4] + lanes[k + 12]);
    assert_eq!(sum_lanes(lanes), (pair(0) + pair(2)) + (pair(1) + pair(3)));
}

#[test]
fn products_beyond_32_bits_are_refused_and_make_no_hole() {
    // Each is finite, their products are not: as a tap of weight 0 an infinite texel is no number, and that is
    // empty space in the middle of what is solid.
    let texel = 1e25_f32 * 1e25;
    assert!((0.0 * texel).is_nan() && DensityActivation::Mipnerf.apply(0.0 * texel) < 1.7e-38);
    let refused = field(Arch::new(), 1e25, 1e25, 1.0).unwrap_err();
    assert!(
        matches!(refused, FieldError::NotFinite { tensor: "map times net0.weight", .. }),
        "{refused}"
    );
    // A thousandth of the largest number is well.
    let densities = field(Arch::new(), 1e17, 1e17, 1.0).unwrap().densities(&[[0.1, 0.2, 0.3]]);
    assert!(densities[0].is_finite() && densities[0] > 1e34, "{densities:?}");
}
