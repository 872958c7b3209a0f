//! Normal and Student's t distribution: levels for small numbers of blocks.

use std::f64::consts::{FRAC_2_PI, SQRT_2};

/// Probability that a standard normal variable is below `-z`, `z >= 0`.
pub(super) fn normal_tail(z: f64) -> f64 {
    0.5 * libm::erfc(z / SQRT_2)
}

/// Probability that Student's t of this many degrees of freedom is below `-t`, `t >= 0`.
///
/// Abramowitz and Stegun 26.7.3 and 26.7.4 up to 1,000 degrees of freedom, 26.7.8 beyond.
pub(super) fn student_tail(t: f64, degrees: u64) -> f64 {
    let freedom = degrees as f64;
    if degrees > 1000 {
        return normal_tail(t * (1.0 - 0.25 / freedom) / (1.0 + t * t / (2.0 * freedom)).sqrt());
    }
    let cosine_squared = freedom / (freedom + t * t);
    let sine = t / (freedom + t * t).sqrt();
    let odd = degrees % 2 == 1;
    let (mut term, mut sum) = (1.0, if degrees > 1 { 1.0 } else { 0.0 });
    for k in 1..(degrees / 2) {
        let k = k as f64;
        let (above, below) = if odd { (2.0 * k, 2.0 * k + 1.0) } else { (2.0 * k - 1.0, 2.0 * k) };
        term *= cosine_squared * above / below;
        sum += term;
    }
    let within = if odd {
        let angle = libm::atan2(t, freedom.sqrt());
        FRAC_2_PI * (angle + sine * cosine_squared.sqrt() * sum)
    } else {
        sine * sum
    };
    (0.5 * (1.0 - within)).max(0.0)
}

/// Where a falling tail reaches a probability, by bisection.
fn inverse(tail: impl Fn(f64) -> f64, probability: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1e6);
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if tail(middle) > probability {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// How far the percentile of a bootstrap over `units` must lie out so that its interval is as wide as
/// Student's t and the unbiased variance make it: the one-sided level that takes the place of
/// `level` (Hesterberg 2015, "What teachers should know about the bootstrap", 5.3, "expanded
/// percentile interval"). `units` is at least 2.
pub(super) fn expanded_level(level: f64, units: u64) -> f64 {
    let freedom = (units - 1) as f64;
    let t = inverse(|t| student_tail(t, units - 1), level);
    normal_tail(t * (units as f64 / freedom).sqrt())
}

/// The inverse of [`expanded_level`]: the level that a one-sided share of replicates stands for.
pub(super) fn unexpanded_level(level: f64, units: u64) -> f64 {
    let freedom = (units - 1) as f64;
    let z = inverse(normal_tail, level.min(0.5));
    student_tail(z * (freedom / units as f64).sqrt(), units - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tails_agree_with_scipy() {
        // scipy.stats.t.sf(t, n)
        for (t, degrees, expected) in [
            (12.706_204_736_174_705, 1, 0.025),
            (4.302_652_729_749_464, 2, 0.025),
            (3.182_446_305_283_708, 3, 0.025),
            (2.776_445_105_197_799, 4, 0.025),
            (2.085_963_447_265_837, 20, 0.025),
            (2.079_613_844_727_662, 21, 0.025),
            (1.962_341_461_133_45, 999, 0.025),
            (1.962_122_929_314_214, 1100, 0.025),
            (0.0, 7, 0.5),
            (4.589_864_596_755_033, 19, 0.0001),
        ] {
            let found = student_tail(t, degrees);
            assert!((found / expected - 1.0).abs() < 1e-5, "{t} {degrees}: {found}");
        }
        assert!((normal_tail(1.959_963_984_540_054) - 0.025).abs() < 1e-15);
    }

    #[test]
    fn levels_return_and_vanish_with_many_units() {
        for units in [2, 5, 30, 900, 12_000] {
            let level = expanded_level(0.025, units);
            assert!(level < 0.025);
            if level > 1e-12 {
                assert!((unexpanded_level(level, units) - 0.025).abs() < 1e-9);
            }
        }
        assert!((expanded_level(0.025, 12_000) - 0.025).abs() < 2e-5);
        assert!(expanded_level(0.025, 2) < 1e-12);
        assert!((unexpanded_level(0.5, 9) - 0.5).abs() < 1e-12);
    }
}
