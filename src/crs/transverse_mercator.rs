//! Transverse Mercator on the ellipsoid (EPSG method 9807) by Krueger's series in the third
//! flattening, order 8.
//!
//! Coefficients: Krueger 1912, extended by Karney, "Transverse Mercator with an accuracy of a few
//! nanometers" (2011), equations 35 and 36; a test computes them afresh by quadrature.

use super::CrsError;
use super::ellipsoid::{Ellipsoid, on_globe, wrap_degrees};
use crate::grid::{LonLat, Projected};
use std::f64::consts::PI;

/// Terms of the series.
const ORDER: usize = 8;

/// Row `j - 1` holds the coefficients of `n^j`, `n^(j+1)`, ... in `alpha_j`, as fractions.
const ALPHA: [&[(f64, f64)]; ORDER] = [
    &[
        (1.0, 2.0),
        (-2.0, 3.0),
        (5.0, 16.0),
        (41.0, 180.0),
        (-127.0, 288.0),
        (7_891.0, 37_800.0),
        (72_161.0, 387_072.0),
        (-18_975_107.0, 50_803_200.0),
    ],
    &[
        (13.0, 48.0),
        (-3.0, 5.0),
        (557.0, 1_440.0),
        (281.0, 630.0),
        (-1_983_433.0, 1_935_360.0),
        (13_769.0, 28_800.0),
        (148_003_883.0, 174_182_400.0),
    ],
    &[
        (61.0, 240.0),
        (-103.0, 140.0),
        (15_061.0, 26_880.0),
        (167_603.0, 181_440.0),
        (-67_102_379.0, 29_030_400.0),
        (79_682_431.0, 79_833_600.0),
    ],
    &[
        (49_561.0, 161_280.0),
        (-179.0, 168.0),
        (6_601_661.0, 7_257_600.0),
        (97_445.0, 49_896.0),
        (-40_176_129_013.0, 7_664_025_600.0),
    ],
    &[
        (34_729.0, 80_640.0),
        (-3_418_889.0, 1_995_840.0),
        (14_644_087.0, 9_123_840.0),
        (2_605_413_599.0, 622_702_080.0),
    ],
    &[
        (212_378_941.0, 319_334_400.0),
        (-30_705_481.0, 10_378_368.0),
        (175_214_326_799.0, 58_118_860_800.0),
    ],
    &[(1_522_256_789.0, 1_383_782_400.0), (-16_759_934_899.0, 3_113_510_400.0)],
    &[(1_424_729_850_961.0, 743_921_418_240.0)],
];

/// As [`ALPHA`], for the inverse series `beta_j`.
const BETA: [&[(f64, f64)]; ORDER] = [
    &[
        (1.0, 2.0),
        (-2.0, 3.0),
        (37.0, 96.0),
        (-1.0, 360.0),
        (-81.0, 512.0),
        (96_199.0, 604_800.0),
        (-5_406_467.0, 38_707_200.0),
        (7_944_359.0, 67_737_600.0),
    ],
    &[
        (1.0, 48.0),
        (1.0, 15.0),
        (-437.0, 1_440.0),
        (46.0, 105.0),
        (-1_118_711.0, 3_870_720.0),
        (51_841.0, 1_209_600.0),
        (24_749_483.0, 348_364_800.0),
    ],
    &[
        (17.0, 480.0),
        (-37.0, 840.0),
        (-209.0, 4_480.0),
        (5_569.0, 90_720.0),
        (9_261_899.0, 58_060_800.0),
        (-6_457_463.0, 17_740_800.0),
    ],
    &[
        (4_397.0, 161_280.0),
        (-11.0, 504.0),
        (-830_251.0, 7_257_600.0),
        (466_511.0, 2_494_800.0),
        (324_154_477.0, 7_664_025_600.0),
    ],
    &[
        (4_583.0, 161_280.0),
        (-108_847.0, 3_991_680.0),
        (-8_005_831.0, 63_866_880.0),
        (22_894_433.0, 124_540_416.0),
    ],
    &[
        (20_648_693.0, 638_668_800.0),
        (-16_363_163.0, 518_918_400.0),
        (-2_204_645_983.0, 12_915_302_400.0),
    ],
    &[(219_941_297.0, 5_535_129_600.0), (-497_323_811.0, 12_454_041_600.0)],
    &[(191_773_887_257.0, 3_719_607_091_200.0)],
];

/// Transverse Mercator projection of one ellipsoid; coordinates in metres.
///
/// Domain: eastings up to [`TransverseMercator::MAX_ETA`] of the Earth's radius from the central
/// meridian, over the pole and down the other side too. Over all of it the series is exact to 1e-8 m
/// (measured against the exact projection: 7.5e-9 m, which is the rounding of a northing).
#[derive(Clone, Debug, PartialEq)]
pub struct TransverseMercator {
    ellipsoid: Ellipsoid,
    lon_0: f64,
    x_0: f64,
    y_0: f64,
    /// Rectifying radius times the scale on the central meridian, metres.
    radius: f64,
    /// Rectifying latitude of `lat_0`, radians.
    xi_0: f64,
    alpha: [f64; ORDER],
    beta: [f64; ORDER],
}

impl TransverseMercator {
    /// Largest easting in units of the rectifying radius (6367 km times the scale): 50 degrees of
    /// longitude on the equator. Beyond it the series loses its digits fast: 2e-8 m at 1.3, 3e-5 m
    /// at 1.7.
    pub const MAX_ETA: f64 = 1.0;

    /// Latitude and longitude of origin (degrees), scale on the central meridian, false easting and
    /// northing (metres).
    ///
    /// # Errors
    /// [`CrsError::Domain`] for an origin off the globe or a parameter that makes no sense.
    pub fn new(
        ellipsoid: Ellipsoid,
        (lat_0, lon_0): (f64, f64),
        k_0: f64,
        (x_0, y_0): (f64, f64),
    ) -> Result<Self, CrsError> {
        let origin = LonLat { lon_deg: lon_0, lat_deg: lat_0 };
        let finite = x_0.is_finite() && y_0.is_finite() && k_0.is_finite();
        if !on_globe(origin) || !finite || k_0 <= 0.0 {
            return Err(domain(format!(
                "its own parameters: origin {lat_0}, {lon_0}, scale {k_0}"
            )));
        }
        let n = ellipsoid.n();
        let n2 = n * n;
        let rectifying = ellipsoid.a / (1.0 + n)
            * (1.0
                + n2 * (1.0 / 4.0 + n2 * (1.0 / 64.0 + n2 * (1.0 / 256.0 + n2 * 25.0 / 16_384.0))));
        let mut projection = Self {
            ellipsoid,
            lon_0,
            x_0,
            y_0,
            radius: k_0 * rectifying,
            xi_0: 0.0,
            alpha: coefficients(&ALPHA, n),
            beta: coefficients(&BETA, n),
        };
        let conformal = ellipsoid.conformal_tangent(libm::tan(lat_0.to_radians()));
        projection.xi_0 = clenshaw(&projection.alpha, 1.0, libm::atan(conformal), 0.0).0;
        Ok(projection)
    }

    /// Longitude and latitude on this projection's own datum to metres.
    ///
    /// # Errors
    /// [`CrsError::Domain`] beyond [`Self::MAX_ETA`], beyond 90 degrees of latitude, and for NaN or
    /// infinity.
    pub fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        let LonLat { lon_deg, lat_deg } = at;
        if !on_globe(at) {
            return Err(domain(format!("longitude {lon_deg}, latitude {lat_deg}")));
        }
        let lambda = wrap_degrees(lon_deg - self.lon_0).to_radians();
        let tan = self.ellipsoid.conformal_tangent(libm::tan(lat_deg.to_radians()));
        let (sin_lambda, cos_lambda) = (libm::sin(lambda), libm::cos(lambda));
        let xi = libm::atan2(tan, cos_lambda);
        let eta = libm::asinh(sin_lambda / libm::hypot(tan, cos_lambda));
        if !in_reach(eta) {
            return Err(domain(format!(
                "longitude {lon_deg}, latitude {lat_deg}, too far from the central meridian {}",
                self.lon_0
            )));
        }
        let (xi, eta) = clenshaw(&self.alpha, 1.0, xi, eta);
        Ok(Projected {
            x: self.x_0 + self.radius * eta,
            y: self.y_0 + self.radius * (xi - self.xi_0),
        })
    }

    /// Metres to longitude and latitude on this projection's own datum.
    ///
    /// # Errors
    /// [`CrsError::Domain`] beyond [`Self::MAX_ETA`], past the far side of a pole, and for NaN or
    /// infinity.
    pub fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        let xi = (at.y - self.y_0) / self.radius + self.xi_0;
        let eta = (at.x - self.x_0) / self.radius;
        // The northing runs on past the poles, down the meridian opposite to the central one.
        if !(in_reach(eta) && (-PI..=PI).contains(&xi)) {
            return Err(domain(format!("x {}, y {} m: off the map", at.x, at.y)));
        }
        let (xi, eta) = clenshaw(&self.beta, -1.0, xi, eta);
        let (sinh_eta, cos_xi) = (libm::sinh(eta), libm::cos(xi));
        let tan = libm::sin(xi) / libm::hypot(sinh_eta, cos_xi);
        let lambda = libm::atan2(sinh_eta, cos_xi);
        let tan = self.ellipsoid.geographic_tangent(tan);
        Ok(LonLat {
            lon_deg: wrap_degrees(self.lon_0 + lambda.to_degrees()),
            lat_deg: libm::atan(tan).to_degrees().clamp(-90.0, 90.0),
        })
    }
}

/// Whether an easting is within [`TransverseMercator::MAX_ETA`]; NaN is not.
fn in_reach(eta: f64) -> bool {
    (-TransverseMercator::MAX_ETA..=TransverseMercator::MAX_ETA).contains(&eta)
}

/// Values of the series' coefficients at a third flattening.
fn coefficients(table: &[&[(f64, f64)]; ORDER], n: f64) -> [f64; ORDER] {
    let mut out = [0.0; ORDER];
    let mut power = 1.0;
    for (value, row) in out.iter_mut().zip(table) {
        power *= n;
        let polynomial = row.iter().rev().fold(0.0, |sum, (p, q)| sum * n + p / q);
        *value = power * polynomial;
    }
    out
}

/// `zeta + sign * sum of c_j sin(2 j zeta)` for the complex `zeta = xi + i eta`, by Clenshaw's
/// recurrence.
fn clenshaw(c: &[f64; ORDER], sign: f64, xi: f64, eta: f64) -> (f64, f64) {
    let (s, co) = (libm::sin(2.0 * xi), libm::cos(2.0 * xi));
    let (sh, ch) = (libm::sinh(2.0 * eta), libm::cosh(2.0 * eta));
    // 2 cos(2 zeta).
    let (ar, ai) = (2.0 * co * ch, -2.0 * s * sh);
    let (mut b1, mut b2) = ((0.0, 0.0), (0.0, 0.0));
    for c in c.iter().rev() {
        let b0 = (ar * b1.0 - ai * b1.1 - b2.0 + c, ar * b1.1 + ai * b1.0 - b2.1);
        (b2, b1) = (b1, b0);
    }
    // sin(2 zeta) * b1.
    let (sr, si) = (s * ch, co * sh);
    (xi + sign * (sr * b1.0 - si * b1.1), eta + sign * (sr * b1.1 + si * b1.0))
}

fn domain(what: String) -> CrsError {
    CrsError::Domain { projection: "transverse Mercator".to_owned(), what }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::scale::ground_distance_m;

    /// The `j`-th sine coefficient of a function on [0, pi/2] that is odd about both ends' doubles,
    /// by the midpoint rule, which converges geometrically here.
    fn sine_coefficient(f: impl Fn(f64) -> f64, j: usize) -> f64 {
        const N: usize = 64;
        let term = |k: usize| {
            let at = (k as f64 + 0.5) / N as f64 * PI / 2.0;
            f(at) * libm::sin(2.0 * j as f64 * at)
        };
        (0..N).map(term).sum::<f64>() * 2.0 / N as f64
    }

    /// Rectifying latitude, by Simpson's rule over the meridian.
    fn rectifying(ellipsoid: &Ellipsoid, lat: f64) -> f64 {
        let arc = |to: f64| {
            const N: usize = 512;
            let step = to / N as f64;
            let weight = |k: usize| match k {
                0 | N => 1.0,
                k if k % 2 == 1 => 4.0,
                _ => 2.0,
            };
            let radius = |k: usize| ellipsoid.meridian_radius((k as f64 * step).to_degrees());
            (0..=N).map(|k| weight(k) * radius(k)).sum::<f64>() * step / 3.0
        };
        arc(lat) / arc(PI / 2.0) * (PI / 2.0)
    }

    #[test]
    fn forward_coefficients_are_those_of_the_rectifying_in_the_conformal_latitude() {
        let ellipsoid = Ellipsoid::GRS80;
        let alpha = coefficients(&ALPHA, ellipsoid.n());
        for (i, expected) in alpha.iter().enumerate() {
            let excess = |conformal: f64| {
                let tan = ellipsoid.geographic_tangent(libm::tan(conformal));
                rectifying(&ellipsoid, libm::atan(tan)) - conformal
            };
            let found = sine_coefficient(excess, i + 1);
            assert!((found - expected).abs() < 2e-15, "alpha {}: {found:e} {expected:e}", i + 1);
        }
    }

    #[test]
    fn inverse_coefficients_undo_the_forward_ones() {
        // On the meridian both series are real; an ellipsoid 10 times flatter shows a wrong term.
        for (f, bound) in [(1.0 / 298.257_222_101, 5e-16), (1.0 / 30.0, 1e-13)] {
            let n = Ellipsoid { a: 1.0, f }.n();
            let (alpha, beta) = (coefficients(&ALPHA, n), coefficients(&BETA, n));
            for k in 0..=90 {
                let chi = f64::from(k).to_radians();
                let (xi, _) = clenshaw(&alpha, 1.0, chi, 0.0);
                let (back, _) = clenshaw(&beta, -1.0, xi, 0.0);
                assert!((back - chi).abs() < bound, "{k}: {:e}", back - chi);
            }
        }
    }

    #[test]
    fn every_term_of_both_series_counts_on_an_ellipsoid_thirty_times_flatter() {
        let ellipsoid = Ellipsoid { a: 1.0, f: 0.1 };
        let n = ellipsoid.n();
        let forward = |conformal: f64| {
            let tan = ellipsoid.geographic_tangent(libm::tan(conformal));
            rectifying(&ellipsoid, libm::atan(tan)) - conformal
        };
        // The conformal latitude of a rectifying one, by iteration; each step gains a factor of 2 n.
        let inverse = |xi: f64| (0..14).fold(xi, |conformal, _| xi - forward(conformal)) - xi;
        for (table, excess, sign) in
            [(&ALPHA, &forward as &dyn Fn(f64) -> f64, 1.0), (&BETA, &inverse, -1.0)]
        {
            for (i, coefficient) in coefficients(table, n).iter().enumerate() {
                // Half of the last term, n^8, is more than all that are left out.
                let (p, q) = table[i][table[i].len() - 1];
                let bound = 0.5 * (p / q).abs() * libm::pow(n, 8.0);
                let found = sign * sine_coefficient(excess, i + 1);
                assert!(
                    (found - coefficient).abs() < bound,
                    "{i}: {found:e} {coefficient:e} {bound:e}"
                );
            }
        }
    }

    #[test]
    fn clenshaw_is_the_sum() {
        let c = coefficients(&ALPHA, 0.01);
        let (xi, eta) = (0.7, 0.9);
        let (mut x, mut y) = (xi, eta);
        for (j, c) in c.iter().enumerate() {
            let m = 2.0 * (j + 1) as f64;
            x += c * libm::sin(m * xi) * libm::cosh(m * eta);
            y += c * libm::cos(m * xi) * libm::sinh(m * eta);
        }
        let found = clenshaw(&c, 1.0, xi, eta);
        assert!((found.0 - x).abs() < 1e-14 && (found.1 - y).abs() < 1e-14);
    }

    /// EPSG's Guidance Note 7-2 (2024), section 3.2.3.1: the British National Grid.
    #[test]
    fn the_worked_example_of_epsg_is_met() {
        let airy = Ellipsoid { a: 6_377_563.396, f: 1.0 / 299.324_96 };
        let (k_0, false_origin) = (0.999_601_271_7, (400_000.0, -100_000.0));
        let grid = TransverseMercator::new(airy, (49.0, -2.0), k_0, false_origin).expect("valid");
        let found = grid.forward(LonLat { lon_deg: 0.5, lat_deg: 50.5 }).expect("valid");
        assert!(
            (found.x - 577_274.99).abs() < 0.01 && (found.y - 69_740.50).abs() < 0.01,
            "{found:?}"
        );
    }

    #[test]
    fn northings_on_the_central_meridian_are_its_length() {
        let ellipsoid = Ellipsoid { a: 1.0, f: 1.0 / 30.0 };
        let grid =
            TransverseMercator::new(ellipsoid, (-20.0, 10.0), 0.5, (3.0, 4.0)).expect("valid");
        // Simpson's rule over 400 parts of the arc from -20 to 55 degrees.
        let step = 75.0 / 400.0;
        let sum: f64 = (0..=400)
            .map(|k| {
                let weight = if k % 400 == 0 { 1.0 } else { f64::from(2 + 2 * (k % 2)) };
                weight * ellipsoid.meridian_radius(-20.0 + f64::from(k) * step)
            })
            .sum();
        let found = grid.forward(LonLat { lon_deg: 10.0, lat_deg: 55.0 }).expect("valid");
        let length = 0.5 * sum * step.to_radians() / 3.0;
        assert!((found.x - 3.0).abs() < 1e-15, "{found:?}");
        assert!((found.y - 4.0 - length).abs() < 1e-11, "{} {length}", found.y - 4.0);
    }

    #[test]
    fn inverse_undoes_forward_over_the_pole_and_as_far_as_the_series_reaches() {
        let grid = TransverseMercator::new(Ellipsoid::GRS80, (40.0, 177.0), 0.9996, (5e5, -1e6))
            .expect("valid");
        for lat_deg in [-89.0, -60.0, -1.0, 0.5, 47.6, 80.0, 89.9] {
            for lon_deg in [-178.0, 177.0, 177.1, 140.0, 90.0, -3.0, 20.0] {
                let at = LonLat { lon_deg, lat_deg };
                // A quarter of the way round, and near the equator.
                let too_far = lon_deg == 90.0 && lat_deg.abs() < 40.0;
                let on_map = grid.forward(at);
                assert_eq!(on_map.is_err(), too_far, "{at:?}");
                if let Ok(on_map) = on_map {
                    let miss = ground_distance_m(at, grid.inverse(on_map).expect("valid"));
                    assert!(miss < 1e-8, "{at:?}: {miss:e}");
                }
            }
        }
    }

    #[test]
    fn what_lies_off_the_map_is_refused_on_all_sides() {
        let grid =
            TransverseMercator::new(Ellipsoid::GRS80, (0.0, 0.0), 1.0, (0.0, 0.0)).expect("valid");
        let forward = |lon_deg, lat_deg| grid.forward(LonLat { lon_deg, lat_deg }).is_ok();
        assert!(
            forward(49.0, 0.0)
                && forward(-49.0, 0.0)
                && !forward(51.0, 0.0)
                && !forward(-51.0, 0.0)
        );
        assert!(!forward(0.0, 90.1) && !forward(f64::NAN, 0.0));
        let inverse = |x, y| grid.inverse(Projected { x, y }).is_ok();
        let (reach, round) = (grid.radius, grid.radius * PI);
        assert!(inverse(reach * 0.999, 0.0) && inverse(-reach * 0.999, 0.0));
        assert!(!inverse(reach * 1.001, 0.0) && !inverse(-reach * 1.001, 0.0));
        assert!(inverse(0.0, round * 0.999) && inverse(0.0, -round * 0.999));
        assert!(
            !inverse(0.0, round * 1.001)
                && !inverse(0.0, -round * 1.001)
                && !inverse(f64::NAN, 0.0)
        );
    }

    #[test]
    fn senseless_parameters_are_refused() {
        let new = |lat, lon, k, x| {
            TransverseMercator::new(Ellipsoid::WGS84, (lat, lon), k, (x, 0.0)).is_ok()
        };
        assert!(new(90.0, 0.0, 1.0, 0.0));
        assert!(!new(91.0, 0.0, 1.0, 0.0) && !new(f64::NAN, 0.0, 1.0, 0.0));
        assert!(!new(0.0, f64::INFINITY, 1.0, 0.0) && !new(0.0, 0.0, 0.0, 0.0));
        assert!(!new(0.0, 0.0, f64::NAN, 0.0) && !new(0.0, 0.0, 1.0, f64::NAN));
    }
}
