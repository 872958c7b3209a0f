//! The oracle of what is computed in 64-bit floats: the same function to 400 bits, correctly rounded
//! (`docs/numerics-field.md`).
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use dashu_float::FBig;

/// Bits of every number and result.
const BITS: usize = 400;

/// A float, exactly, with room for more digits.
pub(crate) fn exact(value: f64) -> FBig {
    FBig::try_from(value).unwrap().with_precision(BITS).value()
}

/// `exp(-x)` for `x >= 0`, 0 beyond a million: less than `10^-434294`.
pub(crate) fn exp_minus(x: &FBig) -> FBig {
    if *x > exact(1e6) { exact(0.0) } else { (-x.clone()).exp() }
}

/// `1 - exp(-x)` for `x >= 0`.
pub(crate) fn one_minus_exp(x: &FBig) -> FBig {
    if *x > exact(1e6) { exact(1.0) } else { -(-x.clone()).exp_m1() }
}

/// The nearest 64-bit float.
pub(crate) fn rounded(value: &FBig) -> f64 {
    value.to_f64().value()
}

/// Relative error of a float: 1 is 100 %.
pub(crate) fn relative(got: f64, want: &FBig) -> f64 {
    assert!(got.is_finite(), "{got}");
    rounded(&((exact(got) - want) / want)).abs()
}

/// Numbers from `10^from` to `10^to`, `steps` to a decade, ascending, without a common mantissa.
pub(crate) fn magnitudes(from: i32, to: i32, steps: i32) -> impl Iterator<Item = f64> {
    (from * steps..=to * steps).map(move |k| libm::pow(10.0, f64::from(k) / f64::from(steps)))
}
