//! The datum step at the poles, at the antimeridian and on the equator.

use super::{Exact, exactly};
use crate::crs::{Convention, DatumStep, Ellipsoid, Helmert};
use crate::grid::LonLat;
use crate::oracle::{Real, nearest, pi, real, squared};

/// As large as the steps from the datums before satellites (NAD27 to WGS 84): positions come out up to
/// 200 m above or below the ellipsoid.
const STEP: Helmert = Helmert {
    translation_m: [-8.0, 160.0, 176.0],
    rotation_arcsec: [0.1, -0.2, 0.3],
    scale_ppm: 1.5,
    convention: Convention::PositionVector,
};

/// Geocentric coordinates after the step, in 48 digits.
fn moved(ellipsoid: &Exact, at: LonLat) -> [Real; 3] {
    let (lambda, phi) = exactly(at);
    let normal = &ellipsoid.a / (real(1.0) - &ellipsoid.e2 * squared(&phi.sin())).sqrt();
    let (sin, cos) = lambda.sin_cos();
    let from = [
        &normal * phi.cos() * cos,
        &normal * phi.cos() * sin,
        &normal * (real(1.0) - &ellipsoid.e2) * phi.sin(),
    ];
    let [x, y, z] = STEP.rotation_arcsec.map(|seconds| real(seconds) * pi() / real(180.0 * 3600.0));
    let turned = [
        &from[0] - &z * &from[1] + &y * &from[2],
        &z * &from[0] + &from[1] - &x * &from[2],
        -(&y * &from[0]) + &x * &from[1] + &from[2],
    ];
    let scale = real(1.0) + real(STEP.scale_ppm) / real(1e6);
    let mut at = 0;
    turned.map(|value| {
        at += 1;
        real(STEP.translation_m[at - 1]) + &scale * value
    })
}

/// Longitude and latitude in radians: iterated until 48 digits stand.
fn geographic(ellipsoid: &Exact, [x, y, z]: &[Real; 3]) -> (Real, Real) {
    let p = x.hypot(y);
    let mut phi = z.atan2(&(&p * (real(1.0) - &ellipsoid.e2)));
    for _ in 0..40 {
        let sin = phi.sin();
        let normal = &ellipsoid.a / (real(1.0) - &ellipsoid.e2 * squared(&sin)).sqrt();
        phi = (z + &ellipsoid.e2 * normal * sin).atan2(&p);
    }
    (y.atan2(x), phi)
}

/// The latitude as if the point lay on the ellipsoid.
fn naive(ellipsoid: &Ellipsoid, [x, y, z]: [f64; 3]) -> LonLat {
    let lat = libm::atan(z / (libm::hypot(x, y) * (1.0 - ellipsoid.e2())));
    LonLat { lon_deg: libm::atan2(y, x).to_degrees(), lat_deg: lat.to_degrees() }
}

#[test]
fn a_datum_step_is_exact_at_poles_on_the_equator_and_at_the_antimeridian() {
    let wgs84 = Ellipsoid::WGS84;
    let exact = Exact::of(&wgs84);
    let step = DatumStep::new(wgs84, wgs84, STEP);
    let (mut farthest, mut ours) = (0.0_f64, 0.0_f64);
    for (lon_deg, lat_deg) in [
        (0.0, 90.0),
        (0.0, -90.0),
        (13.0, 89.999_999_9),
        (180.0, 0.0),
        (-180.0, 45.0),
        (179.999_999_999, -17.0),
        (0.0, 1e-9),
        (139.7, 35.7),
        (10.0, -45.0),
    ] {
        let at = LonLat { lon_deg, lat_deg };
        let cartesian = moved(&exact, at);
        let (lambda, phi) = geographic(&exact, &cartesian);
        let found = exact.apart(step.forward(at).expect("on the globe"), &lambda, &phi);
        assert!(found < 3e-9, "{at:?}: {found:e} m");
        ours = ours.max(found);
        let naive = naive(&wgs84, cartesian.each_ref().map(nearest));
        farthest = farthest.max(exact.apart(naive, &lambda, &phi));
    }
    println!("naive {farthest:.2} m, ours {ours:.1e} m");
    assert!(farthest > 0.6, "{farthest} m");
}
