//! Lambert's conic at its poles, far outside of its zone, with parallels that almost coincide.

use super::{Exact, exactly};
use crate::crs::{Ellipsoid, LambertConic};
use crate::grid::{LonLat, Projected};
use crate::oracle::{Real, nearest, real};
use std::f64::consts::FRAC_PI_4;

/// A cone: latitude of origin and its two standard parallels, degrees; its meridian is 0.
type Cone = (f64, (f64, f64));

/// The projection by Snyder's equations 15-1 to 15-11 as they stand, in doubles.
struct Textbook {
    a: f64,
    e: f64,
    n: f64,
    big_f: f64,
    rho_0: f64,
}

impl Textbook {
    fn new(ellipsoid: &Ellipsoid, (lat_0, (lat_1, lat_2)): Cone) -> Self {
        let (a, e) = (ellipsoid.a, ellipsoid.e());
        let m = |lat: f64| ellipsoid.parallel_radius(lat) / a;
        let n = if lat_1 == lat_2 {
            libm::sin(lat_1.to_radians())
        } else {
            let logarithms = |of: &dyn Fn(f64) -> f64| libm::log(of(lat_1)) - libm::log(of(lat_2));
            logarithms(&m) / logarithms(&|lat| Self::t(e, lat))
        };
        let big_f = m(lat_1) / (n * libm::pow(Self::t(e, lat_1), n));
        let rho_0 = a * big_f * libm::pow(Self::t(e, lat_0), n);
        Self { a, e, n, big_f, rho_0 }
    }

    fn t(e: f64, lat: f64) -> f64 {
        let phi = lat.to_radians();
        let s = e * libm::sin(phi);
        libm::tan(FRAC_PI_4 - phi / 2.0) / libm::pow((1.0 - s) / (1.0 + s), e / 2.0)
    }

    fn forward(&self, at: LonLat) -> Projected {
        let rho = self.a * self.big_f * libm::pow(Self::t(self.e, at.lat_deg), self.n);
        let theta = self.n * at.lon_deg.to_radians();
        Projected { x: rho * libm::sin(theta), y: self.rho_0 - rho * libm::cos(theta) }
    }
}

/// The same in 48 digits.
struct Oracle {
    ellipsoid: Exact,
    n: Real,
    a_big_f: Real,
    rho_0: Real,
}

impl Oracle {
    fn new(ellipsoid: &Ellipsoid, (lat_0, (lat_1, lat_2)): Cone) -> Self {
        let exact = Exact::of(ellipsoid);
        let [phi_0, phi_1, phi_2] =
            [lat_0, lat_1, lat_2].map(|lat| exactly(LonLat { lon_deg: 0.0, lat_deg: lat }).1);
        let log_m = |phi: &Real| exact.parallel_radius(phi).ln();
        let psi = |phi: &Real| exact.isometric(phi);
        let n = if lat_1 == lat_2 {
            phi_1.sin()
        } else {
            (log_m(&phi_1) - log_m(&phi_2)) / (psi(&phi_2) - psi(&phi_1))
        };
        let a_big_f = exact.parallel_radius(&phi_1) / &n * (&n * psi(&phi_1)).exp();
        let rho_0 = &a_big_f * (-(&n * psi(&phi_0))).exp();
        Self { ellipsoid: exact, n, a_big_f, rho_0 }
    }

    fn radius(&self, phi: &Real) -> Real {
        &self.a_big_f * (-(&self.n * self.ellipsoid.isometric(phi))).exp()
    }

    /// Metres on the ground by which a map position is off.
    fn off(&self, at: LonLat, found: Projected) -> f64 {
        let (lambda, phi) = exactly(at);
        let rho = self.radius(&phi);
        let theta = &self.n * lambda;
        let x = &rho * theta.sin();
        let y = &self.rho_0 - &rho * theta.cos();
        let on_map = libm::hypot(nearest(&(real(found.x) - x)), nearest(&(real(found.y) - y)));
        let scale = nearest(&(&self.n * rho / self.ellipsoid.parallel_radius(&phi)));
        on_map / scale.abs()
    }

    /// Metres on the ground by which a position is off that stands for one on the map.
    fn off_inverse(&self, at: Projected, found: LonLat) -> f64 {
        let (x, south) = (real(at.x), &self.rho_0 - real(at.y));
        let sign = real(1.0_f64.copysign(nearest(&self.n)));
        let rho = &sign * x.hypot(&south);
        let lambda = (&sign * x).atan2(&(&sign * south)) / &self.n;
        let psi = -(rho / &self.a_big_f).ln() / &self.n;
        // Newton on the isometric latitude, from the position to be checked.
        let mut phi = exactly(found).1;
        for _ in 0..4 {
            let slope = self.ellipsoid.meridian_radius(&phi) / self.ellipsoid.parallel_radius(&phi);
            phi = &phi - (self.ellipsoid.isometric(&phi) - &psi) / slope;
        }
        self.ellipsoid.apart(found, &lambda, &phi)
    }
}

/// Largest errors over some positions, metres on the ground: the textbook's, ours there, ours back.
fn errors(cone: Cone, positions: &[(f64, f64)]) -> [f64; 3] {
    let ellipsoid = Ellipsoid::GRS80;
    let oracle = Oracle::new(&ellipsoid, cone);
    let textbook = Textbook::new(&ellipsoid, cone);
    let (lat_0, parallels) = cone;
    let ours = LambertConic::two_parallels(ellipsoid, (lat_0, 0.0), parallels, (0.0, 0.0))
        .expect("a cone");
    let mut worst = [0.0_f64; 3];
    for &(lon_deg, lat_deg) in positions {
        let at = LonLat { lon_deg, lat_deg };
        let there = ours.forward(at).expect("in the domain");
        let back = ours.inverse(there).expect("in the domain");
        let found = [
            oracle.off(at, textbook.forward(at)),
            oracle.off(at, there),
            oracle.off_inverse(there, back),
        ];
        for (worst, found) in worst.iter_mut().zip(found) {
            *worst = if found > *worst || found.is_nan() { found } else { *worst };
        }
    }
    let [naive, there, back] = worst;
    println!("{cone:?}: naive {naive:.1e} m, ours {there:.1e} m, back {back:.1e} m");
    worst
}

/// Positions in a zone around 46 degrees.
const ZONE: [(f64, f64); 4] = [(-2.0, 46.0), (0.0, 45.5), (1.7, 47.3), (3.0, 44.0)];
/// Washington's southern zone.
const WASHINGTON: Cone = (45.333_333_333_333_3, (45.833_333_333_333_3, 47.333_333_333_333_3));

#[test]
fn parallels_may_coincide_but_for_rounding() {
    // The textbook divides two differences that are rounding and nothing else.
    for (apart, naive_m) in [(1e-13, 100.0), (1e-10, 1e-2), (1e-7, 1e-4), (1e-5, 1e-6), (1.5, 0.0)]
    {
        let [naive, there, back] = errors((45.0, (46.0, 46.0 + apart)), &ZONE);
        assert!(naive > naive_m, "{apart:e}: {naive:e} m");
        assert!(there < 1e-9 && back < 2e-9, "{apart:e}: {there:e} m, {back:e} m back");
    }
    let [_, there, back] = errors((45.0, (46.0, 46.0)), &ZONE);
    assert!(there < 1e-9 && back < 2e-9, "equal: {there:e} m, {back:e} m back");
}

#[test]
fn cones_may_be_almost_cylinders_and_almost_planes() {
    for (parallels, naive_m) in
        [((1e-6, 2e-6), 1e-3), ((1e-3, 2e-3), 1e-6), ((0.5, 1.5), 1e-8), ((80.0, 85.0), 0.0)]
    {
        let [naive, there, back] = errors((0.3, parallels), &ZONE);
        assert!(naive > naive_m, "{parallels:?}: {naive:e} m");
        assert!(there < 1e-8 && back < 1e-8, "{parallels:?}: {there:e} m, {back:e} m back");
    }
    // Parallels a tenth of a degree from the pole: an angle in radians has no more digits there.
    let [_, there, back] = errors((0.3, (89.9, 89.99)), &ZONE);
    assert!(there < 5e-6 && back < 5e-6, "{there:e} m, {back:e} m back");
    // An apex at infinity: 0 / 0 in the textbook, a position here.
    let textbook = Textbook::new(&Ellipsoid::GRS80, (0.3, (2e-8, 3e-8)));
    assert!(textbook.forward(LonLat { lon_deg: 1.0, lat_deg: 1.0 }).y.is_nan());
    let ours = LambertConic::two_parallels(Ellipsoid::GRS80, (0.3, 0.0), (2e-8, 3e-8), (0.0, 0.0));
    let found = ours.expect("a cone").forward(LonLat { lon_deg: 1.0, lat_deg: 1.0 });
    let oracle = Oracle::new(&Ellipsoid::GRS80, (0.3, (2e-8, 3e-8)));
    let off = oracle.off(LonLat { lon_deg: 1.0, lat_deg: 1.0 }, found.expect("in the domain"));
    println!("parallels 2e-8 and 3e-8: {off:.1e} m");
    assert!(off < 1e-7, "{off:e} m");
}

#[test]
fn the_apex_is_a_point_and_the_other_pole_is_nowhere() {
    for colatitude in [1.0, 1e-3, 1e-6, 1e-9, 1e-12] {
        let lat = 90.0 - colatitude;
        let [_, there, back] = errors(WASHINGTON, &[(0.0, lat), (100.0, lat), (-179.0, lat)]);
        assert!(there < 2e-9 && back < 2e-9, "{colatitude:e}: {there:e} m, {back:e} m back");
    }
    let ours = LambertConic::two_parallels(
        Ellipsoid::GRS80,
        (WASHINGTON.0, 0.0),
        WASHINGTON.1,
        (0.0, 0.0),
    )
    .expect("a cone");
    let pole = |lon_deg, lat_deg| ours.forward(LonLat { lon_deg, lat_deg });
    let apex = pole(0.0, 90.0).expect("the apex");
    assert_eq!(apex.x, 0.0);
    assert_eq!(pole(77.0, 90.0).map(|p| p.y), Ok(apex.y));
    assert_eq!(ours.inverse(apex).map(|p| p.lat_deg), Ok(90.0));
    // The textbook has a place for a pole that is infinitely far away: tan(pi / 2) is 1.6e16 in
    // doubles.
    let nowhere = Textbook::new(&Ellipsoid::GRS80, WASHINGTON)
        .forward(LonLat { lon_deg: 10.0, lat_deg: -90.0 });
    assert!(nowhere.x.is_finite() && nowhere.y.is_finite());
    assert!(pole(10.0, -90.0).is_err());
}

#[test]
fn far_outside_of_its_zone_the_cone_is_as_exact_on_the_ground() {
    for lat in [60.0, 0.0, -30.0, -60.0, -89.0, -89.999_999, -89.999_999_999] {
        let lons = [0.0, 100.0, -179.0, 179.999_999_999];
        let [naive, there, back] = errors(WASHINGTON, &lons.map(|lon| (lon, lat)));
        assert!(there < 1e-8 && back < 1e-8, "{lat}: {there:e} m, {back:e} m back");
        // It loses a digit, and no more: what fails it is the parallels.
        assert!(naive < 1e-6, "{lat}: {naive:e} m");
    }
}
