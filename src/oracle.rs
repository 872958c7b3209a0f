//! Numbers of 48 digits: what hard cases are held against.
//!
//! Everything that a test computes here it computes by the textbook's formula, whose cancellations
//! cost digits that are there to be lost.

use dashu_float::FBig;
use dashu_float::round::mode::HalfEven;

/// A binary number of [`DIGITS`] digits; the result of an operation has as many.
pub type Real = FBig<HalfEven, 2>;

/// Binary digits.
pub const DIGITS: usize = 160;

/// A finite number, as it is.
pub fn real(value: f64) -> Real {
    Real::try_from(value).expect("a finite number").with_precision(DIGITS).value()
}

/// The nearest double.
pub fn nearest(value: &Real) -> f64 {
    value.to_f64().value()
}

/// How far a double is from the truth.
pub fn off(found: f64, truth: &Real) -> f64 {
    nearest(&(real(found) - truth)).abs()
}

/// The same, as a share of the truth.
pub fn relative(found: f64, truth: &Real) -> f64 {
    (nearest(&((real(found) - truth) / truth))).abs()
}

pub fn pi() -> Real {
    Real::pi(DIGITS)
}

pub fn radians(degrees: f64) -> Real {
    real(degrees) * pi() / real(180.0)
}

pub fn degrees(radians: &Real) -> Real {
    radians * real(180.0) / pi()
}

pub fn squared(value: &Real) -> Real {
    value * value
}
