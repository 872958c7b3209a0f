//! Elementary functions in single precision that the compiler can vectorise.
//!
//! They consist of IEEE additions, multiplications, fused multiply-adds, divisions, comparisons and
//! bit operations only, so a value is the same on every machine, whatever the width of its vector
//! unit (a machine without fused multiply-add computes it in software: slow, but equal).
//!
//! Accuracy, measured against `f64` in the tests: [`exp_nonpositive`] 2e-7 relative,
//! [`softplus`] 2e-7 relative for arguments above -87 (it stays at 1.6e-38 below), [`sigmoid`]
//! 2e-7 relative above -87, [`one_minus_exp`] 2e-7 relative.

/// Lanes of every accumulator: sums over hidden values run in 16 fixed lanes that are added in
/// one fixed order, so that the width of the machine's vectors does not change a sum.
pub(crate) const LANES: usize = 16;

/// Adding it rounds a number below 2^22 to an integer, which is left in the low bits.
const ROUND: f32 = 12_582_912.0;
const LN_2_HIGH: f32 = 0.693_359_4;
const LN_2_LOW: f32 = -2.121_944_4e-4;
/// The least argument whose exponential is a normal number, to the integer.
const LEAST: f32 = -87.0;

/// `exp(x)` for `x <= 0`; arguments under -87 count as -87.
#[inline(always)]
pub(crate) fn exp_nonpositive(x: f32) -> f32 {
    // A comparison rather than `f32::max`: one instruction, and no case for NaN.
    let x = if x > LEAST { x } else { LEAST };
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let exponent = shifted.to_bits() << 23;
    let whole = shifted - ROUND;
    let r = whole.mul_add(-LN_2_LOW, whole.mul_add(-LN_2_HIGH, x));
    // Fitted for least relative error on |r| <= ln(2)/2 (3e-9 before rounding).
    let p = 0.001_381_454_f32
        .mul_add(r, 0.008_368_745)
        .mul_add(r, 0.041_668_39)
        .mul_add(r, 0.166_665_2)
        .mul_add(r, 0.499_999_93)
        .mul_add(r, 1.0)
        .mul_add(r, 1.0);
    f32::from_bits(p.to_bits().wrapping_add(exponent))
}

/// `ln(1 + t) / t` for `0 <= t <= 1`, fitted for least relative error (3e-8 before rounding).
#[inline(always)]
fn log1p_over(t: f32) -> f32 {
    let u = t.mul_add(2.0, -1.0);
    2.044_020_6e-5_f32
        .mul_add(u, -6.698_798e-5)
        .mul_add(u, 1.810_387e-4)
        .mul_add(u, -6.321_327e-4)
        .mul_add(u, 2.289_616_2e-3)
        .mul_add(u, -8.463_931e-3)
        .mul_add(u, 0.033_152_27)
        .mul_add(u, -0.144_263_33)
        .mul_add(u, 0.810_930_2)
}

/// `ln(1 + exp(x))`.
#[inline(always)]
pub(crate) fn softplus(x: f32) -> f32 {
    let t = exp_nonpositive(-x.abs());
    let positive = if x > 0.0 { x } else { 0.0 };
    t.mul_add(log1p_over(t), positive)
}

/// `1 / (1 + exp(-x))`.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    let t = exp_nonpositive(-x.abs());
    (if x > 0.0 { 1.0 } else { t }) / (1.0 + t)
}

/// `1 - exp(-x)` for `x >= 0`, without cancellation for small `x`.
#[inline(always)]
pub(crate) fn one_minus_exp(x: f32) -> f32 {
    let large = 1.0 - exp_nonpositive(-x);
    // Taylor's series: the first term left out is below 2e-8 relative at 0.25.
    let small = 1.984_127e-4_f32
        .mul_add(-x, 1.388_888_9e-3)
        .mul_add(-x, 8.333_333e-3)
        .mul_add(-x, 0.041_666_668)
        .mul_add(-x, 0.166_666_67)
        .mul_add(-x, 0.5)
        .mul_add(-x, 1.0)
        * x;
    if x < 0.25 { small } else { large }
}

/// `exp(x)` in double precision for `-700 <= x <= 0` (3e-16 relative); smaller arguments give the
/// value at -700, 1e-304.
#[inline(always)]
pub(crate) fn exp_nonpositive_f64(x: f64) -> f64 {
    const ROUND: f64 = 6_755_399_441_055_744.0;
    const LN_2_HIGH: f64 = 6.931_471_803_691_238e-1;
    const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    let x = if x > -700.0 { x } else { -700.0 };
    let shifted = x.mul_add(std::f64::consts::LOG2_E, ROUND);
    let exponent = shifted.to_bits() << 52;
    let whole = shifted - ROUND;
    let r = whole.mul_add(-LN_2_LOW, whole.mul_add(-LN_2_HIGH, x));
    // Taylor's series to the thirteenth power: 4e-18 left out at ln(2)/2.
    let p = (1.0 / 6_227_020_800.0_f64)
        .mul_add(r, 1.0 / 479_001_600.0)
        .mul_add(r, 1.0 / 39_916_800.0)
        .mul_add(r, 1.0 / 3_628_800.0)
        .mul_add(r, 1.0 / 362_880.0)
        .mul_add(r, 1.0 / 40_320.0)
        .mul_add(r, 1.0 / 5_040.0)
        .mul_add(r, 1.0 / 720.0)
        .mul_add(r, 1.0 / 120.0)
        .mul_add(r, 1.0 / 24.0)
        .mul_add(r, 1.0 / 6.0)
        .mul_add(r, 0.5)
        .mul_add(r, 1.0)
        .mul_add(r, 1.0);
    f64::from_bits(p.to_bits().wrapping_add(exponent))
}

/// `1 - exp(-x)` in double precision for `x >= 0` (1e-15 relative).
#[inline(always)]
pub(crate) fn one_minus_exp_f64(x: f64) -> f64 {
    let large = 1.0 - exp_nonpositive_f64(-x);
    let small = (-1.0 / 479_001_600.0_f64)
        .mul_add(x, 1.0 / 39_916_800.0)
        .mul_add(x, -1.0 / 3_628_800.0)
        .mul_add(x, 1.0 / 362_880.0)
        .mul_add(x, -1.0 / 40_320.0)
        .mul_add(x, 1.0 / 5_040.0)
        .mul_add(x, -1.0 / 720.0)
        .mul_add(x, 1.0 / 120.0)
        .mul_add(x, -1.0 / 24.0)
        .mul_add(x, 1.0 / 6.0)
        .mul_add(x, -0.5)
        .mul_add(x, 1.0)
        * x;
    if x < 0.35 { small } else { large }
}

/// The sum of 16 lanes in one fixed order.
#[inline(always)]
pub(crate) fn sum_lanes(lanes: [f32; LANES]) -> f32 {
    // Three arrays rather than a loop over halves: that loop would be run through memory.
    let (mut eight, mut four, mut two) = ([0.0; 8], [0.0; 4], [0.0; 2]);
    for lane in 0..8 {
        eight[lane] = lanes[lane] + lanes[lane + 8];
    }
    for lane in 0..4 {
        four[lane] = eight[lane] + eight[lane + 4];
    }
    for lane in 0..2 {
        two[lane] = four[lane] + four[lane + 2];
    }
    two[0] + two[1]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest relative error of `got` against `want` over the given arguments.
    fn worst(
        arguments: impl Iterator<Item = f32>,
        got: fn(f32) -> f32,
        want: fn(f64) -> f64,
    ) -> f64 {
        arguments
            .map(|x| {
                let want = want(f64::from(x));
                ((f64::from(got(x)) - want) / want).abs()
            })
            .fold(0.0, f64::max)
    }

    fn spread(from: f32, to: f32) -> impl Iterator<Item = f32> {
        const COUNT: usize = 400_000;
        (0..=COUNT).map(move |k| from + (to - from) * (k as f32 / COUNT as f32))
    }

    fn tiny() -> impl Iterator<Item = f32> {
        (0..4000).map(|k| f32::from_bits(0x0080_0000 + k * 0x0003_7f11)).filter(|x| *x < 1.0)
    }

    #[test]
    fn single_precision_agrees_with_double() {
        let softplus64 = |x: f64| x.max(0.0) + libm::log1p(libm::exp(-x.abs()));
        let errors = [
            worst(spread(-87.0, 0.0), exp_nonpositive, libm::exp),
            worst(spread(-87.0, 100.0), softplus, softplus64),
            worst(spread(-2.0, 2.0), softplus, softplus64),
            worst(spread(-87.0, 100.0), sigmoid, |x| 1.0 / (1.0 + libm::exp(-x))),
            worst(spread(1e-6, 90.0), one_minus_exp, |x| -libm::expm1(-x)),
            worst(tiny(), one_minus_exp, |x| -libm::expm1(-x)),
        ];
        eprintln!("relative errors: {errors:?}");
        assert!(errors.iter().all(|error| *error < 2e-7), "{errors:?}");
    }

    #[test]
    fn double_precision_agrees_with_libm() {
        let mut worst = [0.0_f64; 2];
        for k in 0..1_000_000 {
            let x = f64::from(k) * 7e-4;
            let exp = libm::exp(-x);
            worst[0] = worst[0].max(((exp_nonpositive_f64(-x) - exp) / exp).abs());
            let x = libm::pow(10.0, f64::from(k) * 34e-6 - 31.0);
            let one = -libm::expm1(-x);
            worst[1] = worst[1].max(((one_minus_exp_f64(x) - one) / one).abs());
        }
        eprintln!("relative errors: {worst:?}");
        assert!(worst[0] < 5e-16 && worst[1] < 1e-15, "{worst:?}");
    }

    #[test]
    fn extremes_stay_finite() {
        for x in [0.0, -0.0, 1e-38, -1e30, f32::MIN, -87.5, -1e4] {
            assert!(exp_nonpositive(-f32::abs(x)).is_finite() && softplus(x).is_finite(), "{x}");
            assert!((0.0..=1.0).contains(&sigmoid(x)), "{x}");
        }
        assert_eq!(softplus(1e30), 1e30);
        assert_eq!(softplus(30.0), 30.0);
        assert_eq!(
            (one_minus_exp(0.0), one_minus_exp(1e30), one_minus_exp(f32::MAX)),
            (0.0, 1.0, 1.0)
        );
        assert_eq!((one_minus_exp_f64(0.0), one_minus_exp_f64(1e300)), (0.0, 1.0));
        assert_eq!((exp_nonpositive(0.0), exp_nonpositive_f64(0.0)), (1.0, 1.0));
        assert_eq!(sum_lanes([1.0; LANES]), 16.0);
    }
}
