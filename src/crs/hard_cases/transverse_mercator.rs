//! Transverse Mercator far from its meridian.

use super::{Exact, exactly};
use crate::crs::{Ellipsoid, TransverseMercator};
use crate::grid::{LonLat, Projected};
use crate::oracle::{Real, nearest, pi, real, squared};

/// A complex number of 48 digits.
#[derive(Clone)]
struct Complex {
    re: Real,
    im: Real,
}

impl Complex {
    fn plus(&self, other: &Self) -> Self {
        Self { re: &self.re + &other.re, im: &self.im + &other.im }
    }

    fn minus(&self, other: &Self) -> Self {
        Self { re: &self.re - &other.re, im: &self.im - &other.im }
    }

    fn times(&self, other: &Self) -> Self {
        Self {
            re: &self.re * &other.re - &self.im * &other.im,
            im: &self.re * &other.im + &self.im * &other.re,
        }
    }

    fn scaled(&self, by: &Real) -> Self {
        Self { re: &self.re * by, im: &self.im * by }
    }

    fn over(&self, other: &Self) -> Self {
        let size = squared(&other.re) + squared(&other.im);
        let conjugate = Self { re: other.re.clone(), im: -other.im.clone() };
        let product = self.times(&conjugate);
        Self { re: product.re / &size, im: product.im / &size }
    }

    fn ln(&self) -> Self {
        Self { re: self.re.hypot(&self.im).ln(), im: self.im.atan2(&self.re) }
    }

    /// By way of the logarithm; none of the radicands here is near the negative axis.
    fn to_the(&self, power: f64) -> Self {
        let logarithm = self.ln().scaled(&real(power));
        let size = logarithm.re.exp();
        let (sin, cos) = logarithm.im.sin_cos();
        Self { re: &size * cos, im: size * sin }
    }

    fn sin_cos(&self) -> (Self, Self) {
        let (sin, cos) = self.re.sin_cos();
        let (sinh, cosh) = self.im.sinh_cosh();
        let sine = Self { re: &sin * &cosh, im: &cos * &sinh };
        (sine, Self { re: cos * cosh, im: -(sin * sinh) })
    }

    fn atanh(&self) -> Self {
        let one = Self { re: real(1.0), im: real(0.0) };
        one.plus(self).over(&one.minus(self)).ln().scaled(&real(0.5))
    }
}

/// The projection by its definition, in 48 digits: the length of the meridian as an analytic
/// function, at the complex latitude whose isometric latitude is `psi + i lambda`. No series, no
/// elliptic functions.
struct Oracle {
    ellipsoid: Exact,
    /// Nodes and weights of Gauss and Legendre on [-1, 1].
    quadrature: Vec<(Real, Real)>,
}

impl Oracle {
    fn new(ellipsoid: &Ellipsoid) -> Self {
        Self { ellipsoid: Exact::of(ellipsoid), quadrature: gauss_legendre(28) }
    }

    /// Isometric latitude of a complex latitude.
    fn isometric(&self, sine: &Complex) -> Complex {
        let e = &self.ellipsoid.e;
        sine.atanh().minus(&sine.scaled(e).atanh().scaled(e))
    }

    /// Easting and northing in metres; latitude and longitude from the meridian in radians.
    fn forward(&self, lambda: &Real, phi: &Real) -> (Real, Real) {
        let e2 = &self.ellipsoid.e2;
        let one = Complex { re: real(1.0), im: real(0.0) };
        let psi = self.ellipsoid.isometric(phi);
        let (sin_lambda, cos_lambda) = lambda.sin_cos();
        let sinh_psi = psi.sinh();
        // On the sphere, in closed form; Newton's method goes on from there.
        let mut at = Complex {
            re: sinh_psi.atan2(&cos_lambda),
            im: (sin_lambda / sinh_psi.hypot(&cos_lambda)).asinh(),
        };
        for _ in 0..6 {
            let (sine, cosine) = at.sin_cos();
            let mut miss = self.isometric(&sine);
            miss.re = &miss.re - &psi;
            // Logarithms are known up to whole turns.
            miss.im = &miss.im - lambda;
            let turns = (nearest(&miss.im) / std::f64::consts::PI).round();
            miss.im = &miss.im - real(turns) * pi();
            let denominator = one.minus(&sine.times(&sine).scaled(e2)).times(&cosine);
            let slope = Complex { re: real(1.0) - e2, im: real(0.0) }.over(&denominator);
            at = at.minus(&miss.over(&slope));
        }
        // The integral of M over the straight way from the equator.
        let half = at.scaled(&real(0.5));
        let mut sum = Complex { re: real(0.0), im: real(0.0) };
        for (node, weight) in &self.quadrature {
            let (sine, _) = half.scaled(&(real(1.0) + node)).sin_cos();
            let w2 = one.minus(&sine.times(&sine).scaled(e2));
            sum = sum.plus(&w2.to_the(-1.5).scaled(weight));
        }
        let factor = &self.ellipsoid.a * (real(1.0) - e2);
        let arc = sum.times(&half).scaled(&factor);
        (arc.im, arc.re)
    }

    /// Metres on the map by which a map position is off; the scale of the map is 1 to 1.6 there.
    fn off(&self, at: LonLat, found: Projected) -> f64 {
        let (lambda, phi) = exactly(at);
        let (x, y) = self.forward(&lambda, &phi);
        libm::hypot(nearest(&(real(found.x) - x)), nearest(&(real(found.y) - y)))
    }
}

fn gauss_legendre(count: usize) -> Vec<(Real, Real)> {
    let n = count as f64;
    (0..count)
        .map(|k| {
            let start = libm::cos(std::f64::consts::PI * (k as f64 + 0.75) / (n + 0.5));
            let mut x = real(start);
            let mut slope = real(1.0);
            for _ in 0..6 {
                let (mut before, mut value) = (real(1.0), x.clone());
                for j in 2..=count {
                    let j = j as f64;
                    let next =
                        (real(2.0 * j - 1.0) * &x * &value - real(j - 1.0) * &before) / real(j);
                    before = std::mem::replace(&mut value, next);
                }
                slope = real(n) * (&x * &value - before) / (squared(&x) - real(1.0));
                x = &x - value / &slope;
            }
            let weight = real(2.0) / ((real(1.0) - squared(&x)) * squared(&slope));
            (x, weight)
        })
        .collect()
}

/// Snyder's equations 8-9, 8-10 and 3-21, which most programs used for decades: powers of the
/// distance from the meridian.
fn powers(ellipsoid: &Ellipsoid, at: LonLat) -> Projected {
    let e2 = ellipsoid.e2();
    let phi = at.lat_deg.to_radians();
    let (sin, cos) = (libm::sin(phi), libm::cos(phi));
    let second = e2 / (1.0 - e2);
    let normal = ellipsoid.a / (1.0 - e2 * sin * sin).sqrt();
    let tan = sin / cos;
    let (t, c) = (tan * tan, second * cos * cos);
    let a = cos * at.lon_deg.to_radians();
    let (e4, e6) = (e2 * e2, e2 * e2 * e2);
    let m = ellipsoid.a
        * ((1.0 - e2 / 4.0 - 3.0 * e4 / 64.0 - 5.0 * e6 / 256.0) * phi
            - (3.0 * e2 / 8.0 + 3.0 * e4 / 32.0 + 45.0 * e6 / 1024.0) * libm::sin(2.0 * phi)
            + (15.0 * e4 / 256.0 + 45.0 * e6 / 1024.0) * libm::sin(4.0 * phi)
            - (35.0 * e6 / 3072.0) * libm::sin(6.0 * phi));
    let a2 = a * a;
    let x = normal
        * a
        * (1.0
            + a2 / 6.0 * (1.0 - t + c)
            + a2 * a2 / 120.0 * (5.0 - 18.0 * t + t * t + 72.0 * c - 58.0 * second));
    let y = m + normal
        * tan
        * (a2 / 2.0
            + a2 * a2 / 24.0 * (5.0 - t + 9.0 * c + 4.0 * c * c)
            + a2 * a2 * a2 / 720.0 * (61.0 - 58.0 * t + t * t + 600.0 * c - 330.0 * second));
    Projected { x, y }
}

#[test]
fn far_from_its_meridian_the_series_is_exact_to_its_limit_and_refuses_beyond() {
    let ellipsoid = Ellipsoid::WGS84;
    let oracle = Oracle::new(&ellipsoid);
    let ours = TransverseMercator::new(ellipsoid, (0.0, 0.0), 1.0, (0.0, 0.0)).expect("valid");
    // Degrees, and what powers of the distance from the meridian miss by at least, metres.
    for (lon_deg, lat_deg, naive_m) in [
        (1e-9, 1e-9, 0.0),
        (3.0, 47.6, 1e-4),
        (6.0, 47.6, 1e-3),
        (15.0, 60.0, 0.1),
        (-33.0, -71.0, 50.0),
        (30.0, 45.0, 200.0),
        (45.0, 10.0, 1e4),
        (49.4, 0.0, 3e4),
        (60.0, 45.0, 3e4),
        // Over the pole, and down the other side.
        (10.0, 89.999_999, 0.0),
        (85.0, 60.0, 1e5),
        (120.0, 80.0, 1e5),
        (179.0, 70.0, 1e7),
    ] {
        let at = LonLat { lon_deg, lat_deg };
        let naive = oracle.off(at, powers(&ellipsoid, at));
        assert!(naive >= naive_m, "{at:?}: {naive:e} m");
        let there = ours.forward(at).expect("in the domain");
        let off = oracle.off(at, there);
        assert!(off < 1e-8, "{at:?}: {off:e} m");
        let (lambda, phi) = exactly(at);
        let back =
            oracle.ellipsoid.apart(ours.inverse(there).expect("in the domain"), &lambda, &phi);
        println!("{at:?}: naive {naive:.1e} m, ours {off:.1e} m, back {back:.1e} m");
        assert!(back < 2e-8, "{at:?}: {back:e} m there and back");
    }
    for lon_deg in [50.0, 60.0, 75.0, 90.0] {
        assert!(ours.forward(LonLat { lon_deg, lat_deg: 0.0 }).is_err(), "{lon_deg}");
    }
}
