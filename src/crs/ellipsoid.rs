//! Ellipsoids of revolution and the conformal latitude on them.

use crate::grid::LonLat;

/// An oblate ellipsoid of revolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipsoid {
    /// Equatorial radius, metres.
    pub a: f64,
    /// Flattening, `(a - b) / a`.
    pub f: f64,
}

impl Ellipsoid {
    /// WGS 84 (EPSG:7030).
    pub const WGS84: Self = Self { a: 6_378_137.0, f: 1.0 / 298.257_223_563 };
    /// GRS 1980 (EPSG:7019): NAD83 in all its realisations, ETRS89.
    pub const GRS80: Self = Self { a: 6_378_137.0, f: 1.0 / 298.257_222_101 };

    /// PROJ's name of the ellipsoid.
    pub(crate) fn proj_name(&self) -> &'static str {
        if *self == Self::WGS84 { "WGS84" } else { "GRS80" }
    }

    /// Polar radius, metres.
    #[must_use]
    pub fn b(&self) -> f64 {
        self.a * (1.0 - self.f)
    }

    /// First eccentricity squared.
    #[must_use]
    pub fn e2(&self) -> f64 {
        self.f * (2.0 - self.f)
    }

    /// First eccentricity.
    #[must_use]
    pub fn e(&self) -> f64 {
        self.e2().sqrt()
    }

    /// Third flattening, `(a - b) / (a + b)`.
    #[must_use]
    pub fn n(&self) -> f64 {
        self.f / (2.0 - self.f)
    }

    /// Radius of curvature in the meridian, metres, at a latitude in degrees.
    #[must_use]
    pub fn meridian_radius(&self, lat_deg: f64) -> f64 {
        let s = libm::sin(lat_deg.to_radians());
        let w2 = 1.0 - self.e2() * s * s;
        self.a * (1.0 - self.e2()) / (w2 * w2.sqrt())
    }

    /// Radius of the parallel of a latitude in degrees, metres.
    #[must_use]
    pub fn parallel_radius(&self, lat_deg: f64) -> f64 {
        let (s, c) = (libm::sin(lat_deg.to_radians()), libm::cos(lat_deg.to_radians()));
        self.a * c / (1.0 - self.e2() * s * s).sqrt()
    }

    /// Geocentric coordinates (x to longitude 0, y to 90 degrees east, z to the north pole) of a position at a
    /// height above the ellipsoid, metres.
    #[must_use]
    pub fn geocentric(&self, at: LonLat, height_m: f64) -> [f64; 3] {
        let (phi, lambda) = (at.lat_deg.to_radians(), at.lon_deg.to_radians());
        let (s, c) = (libm::sin(phi), libm::cos(phi));
        let normal = self.a / (1.0 - self.e2() * s * s).sqrt();
        let across = (normal + height_m) * c;
        [
            across * libm::cos(lambda),
            across * libm::sin(lambda),
            (normal * (1.0 - self.e2()) + height_m) * s,
        ]
    }

    /// Isometric latitude `asinh(tan phi) - e atanh(e sin phi)` of a latitude in degrees; infinite
    /// at the poles.
    #[must_use]
    pub fn isometric_latitude(&self, lat_deg: f64) -> f64 {
        if lat_deg.abs() == 90.0 {
            return f64::INFINITY.copysign(lat_deg);
        }
        let phi = lat_deg.to_radians();
        let e = self.e();
        libm::asinh(libm::tan(phi)) - e * libm::atanh(e * libm::sin(phi))
    }

    /// Isometric latitude of `lat_deg` minus that of `from_deg`, to full relative precision even
    /// where the two are close: every difference is taken between the latitudes themselves.
    #[must_use]
    pub fn isometric_difference(&self, lat_deg: f64, from_deg: f64) -> f64 {
        if lat_deg.abs() == 90.0 {
            return f64::INFINITY.copysign(lat_deg);
        }
        let (phi, from) = (lat_deg.to_radians(), from_deg.to_radians());
        let (s, s0) = (libm::sin(phi), libm::sin(from));
        let sine_difference = sine_difference(lat_deg, from_deg);
        // asinh(x) - asinh(y) and atanh(x) - atanh(y) by their addition theorems.
        let sphere = libm::asinh(sine_difference / (libm::cos(phi) * libm::cos(from)));
        let e = self.e();
        sphere - e * libm::atanh(e * sine_difference / (1.0 - self.e2() * s * s0))
    }

    /// Tangent of the conformal latitude from the tangent of the geographic one.
    #[must_use]
    pub fn conformal_tangent(&self, tan: f64) -> f64 {
        let sec = libm::hypot(1.0, tan);
        let e = self.e();
        let sigma = libm::sinh(e * libm::atanh(e * tan / sec));
        libm::hypot(1.0, sigma) * tan - sigma * sec
    }

    /// Tangent of the geographic latitude from the tangent of the conformal one: Newton's method on
    /// [`Self::conformal_tangent`] (Karney 2011, equations 19 to 21), quadratic from a start that is
    /// good to `e^2`, so that five steps are more than enough.
    #[must_use]
    pub fn geographic_tangent(&self, conformal: f64) -> f64 {
        const TOLERANCE: f64 = 1e-16;
        // Where 1 + t^2 is t^2, the two tangents are proportional.
        const LARGE: f64 = 1e9;
        let e2m = 1.0 - self.e2();
        let pole = libm::exp(self.e() * libm::atanh(self.e()));
        if conformal.abs() > LARGE {
            return conformal * pole;
        }
        let mut tan = if conformal.abs() > 70.0 { conformal * pole } else { conformal / e2m };
        for _ in 0..5 {
            let trial = self.conformal_tangent(tan);
            let slope = e2m * libm::hypot(1.0, tan) / (1.0 + e2m * tan * tan);
            let step = (conformal - trial) / (libm::hypot(1.0, trial) * slope);
            tan += step;
            if step.abs() <= TOLERANCE * tan.abs().max(1.0) {
                break;
            }
        }
        tan
    }
}

/// Whether a longitude and a latitude are finite and the latitude is one.
pub(crate) fn on_globe(at: LonLat) -> bool {
    at.lon_deg.is_finite() && (-90.0..=90.0).contains(&at.lat_deg)
}

/// `sin(a) - sin(b)` of angles in degrees, to full relative precision.
pub(crate) fn sine_difference(a_deg: f64, b_deg: f64) -> f64 {
    let half_difference = (0.5 * (a_deg - b_deg)).to_radians();
    let mean = (0.5 * (a_deg + b_deg)).to_radians();
    2.0 * libm::cos(mean) * libm::sin(half_difference)
}

/// An angle in degrees brought to [-180, 180] by whole turns.
pub(crate) fn wrap_degrees(angle: f64) -> f64 {
    // Exact for angles that are in range already.
    if angle.abs() <= 180.0 { angle } else { angle - 360.0 * (angle / 360.0).round() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn radii_at_the_equator_and_the_pole() {
        let wgs84 = Ellipsoid::WGS84;
        assert!((wgs84.b() - 6_356_752.314_245_179).abs() < 1e-8);
        assert!((wgs84.meridian_radius(0.0) - wgs84.b() * wgs84.b() / wgs84.a).abs() < 1e-8);
        assert!((wgs84.meridian_radius(90.0) - wgs84.a * wgs84.a / wgs84.b()).abs() < 1e-8);
        assert!((wgs84.parallel_radius(0.0) - wgs84.a).abs() < 1e-9);
        assert!(wgs84.parallel_radius(90.0).abs() < 1e-9);
    }

    #[test]
    fn flattenings_and_eccentricities_are_those_of_the_two_radii() {
        let e = Ellipsoid { a: 5.0, f: 0.2 };
        assert!((e.b() - 4.0).abs() < 1e-15 && (e.n() - 1.0 / 9.0).abs() < 1e-15);
        assert!((e.e2() - 9.0 / 25.0).abs() < 1e-15 && (e.e() - 0.6).abs() < 1e-15);
    }

    #[test]
    fn radii_are_those_of_the_geocentric_ellipse() {
        let e = Ellipsoid { a: 5.0, f: 0.2 };
        for (lon_deg, lat_deg) in [(0.0, 0.0), (30.0, 50.0), (-100.0, -35.0), (170.0, 80.0)] {
            let at = |north: f64, height| {
                e.geocentric(LonLat { lon_deg, lat_deg: lat_deg + north }, height)
            };
            let [x, y, z] = at(0.0, 0.0);
            assert!((x * x / 25.0 + y * y / 25.0 + z * z / 16.0 - 1.0).abs() < 1e-14);
            assert!((libm::hypot(x, y) - e.parallel_radius(lat_deg)).abs() < 1e-14);
            assert!((libm::atan2(y, x).to_degrees() - lon_deg).abs() < 1e-13);
            // Height goes out along the normal, which is the gradient of the form above.
            let up: [f64; 3] = std::array::from_fn(|k| at(0.0, 2.0)[k] - [x, y, z][k]);
            let gradient = [x / 25.0, y / 25.0, z / 16.0];
            let length = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
            for (up, gradient) in up.into_iter().zip(gradient) {
                assert!((up - 2.0 * gradient / length).abs() < 1e-13, "{up}");
            }
            // And the meridian's radius is the speed along it.
            let (a, b) = (at(1e-4, 0.0), at(-1e-4, 0.0));
            let speed = (0..3).map(|k| (a[k] - b[k]) * (a[k] - b[k])).sum::<f64>().sqrt()
                / 2e-4_f64.to_radians();
            assert!((speed / e.meridian_radius(lat_deg) - 1.0).abs() < 1e-10, "{speed}");
        }
    }

    #[test]
    fn poles_are_infinitely_far_on_the_isometric_scale() {
        let grs80 = Ellipsoid::GRS80;
        assert_eq!(grs80.isometric_latitude(90.0), f64::INFINITY);
        assert_eq!(grs80.isometric_latitude(-90.0), f64::NEG_INFINITY);
        assert_eq!(grs80.isometric_difference(-90.0, 45.0), f64::NEG_INFINITY);
    }

    #[test]
    fn wrapping_keeps_what_is_in_range() {
        for (angle, wrapped) in
            [(180.0, 180.0), (-180.0, -180.0), (190.0, -170.0), (-541.0, 179.0), (0.0, 0.0)]
        {
            assert_eq!(wrap_degrees(angle), wrapped);
        }
    }

    #[test]
    fn places_off_the_globe_are_told() {
        let on = |lon_deg, lat_deg| on_globe(LonLat { lon_deg, lat_deg });
        assert!(on(0.0, 90.0) && on(1e3, -90.0));
        assert!(
            !on(f64::NAN, 0.0) && !on(f64::INFINITY, 0.0) && !on(0.0, 90.1) && !on(0.0, f64::NAN)
        );
    }

    #[test]
    fn conformal_tangent_is_that_of_the_isometric_latitude() {
        for lat in [-89.0, -30.0, 1e-9, 47.0, 70.0, 89.99] {
            let tan = Ellipsoid::GRS80.conformal_tangent(libm::tan(f64::to_radians(lat)));
            let expected = libm::sinh(Ellipsoid::GRS80.isometric_latitude(lat));
            assert!((tan / expected - 1.0).abs() < 1e-14, "{lat}: {tan} {expected}");
        }
        // Near the pole both tangents are proportional; the far branch goes on where the other ends.
        let back = |conformal| Ellipsoid::GRS80.geographic_tangent(conformal) / conformal;
        assert!((back(1.01e9) / back(0.99e9) - 1.0).abs() < 1e-15);
        assert!((back(-1.01e9) / back(0.99e9) - 1.0).abs() < 1e-15);
    }

    #[test]
    fn newtons_steps_converge_on_ellipsoids_much_flatter_than_the_earth() {
        // With the Earth's flattening the start is so good that almost any step would do.
        let flat = Ellipsoid { a: 1.0, f: 0.1 };
        for lat in -899..=899 {
            let tan = libm::tan((f64::from(lat) / 10.0).to_radians());
            let back = flat.geographic_tangent(flat.conformal_tangent(tan));
            assert!((back - tan).abs() <= 8.0 * f64::EPSILON * tan.abs().max(1.0), "{lat}: {back}");
        }
    }

    proptest! {
        #[test]
        fn conformal_and_geographic_tangent_are_inverse(lat in -89.999_999..89.999_999_f64) {
            let tan = libm::tan(lat.to_radians());
            let back = Ellipsoid::WGS84.geographic_tangent(Ellipsoid::WGS84.conformal_tangent(tan));
            prop_assert!((back - tan).abs() <= 8.0 * f64::EPSILON * tan.abs().max(1.0));
        }

        #[test]
        fn isometric_difference_is_the_difference(a in -89.0..89.0_f64, b in -89.0..89.0_f64) {
            let e = Ellipsoid::GRS80;
            let direct = e.isometric_latitude(a) - e.isometric_latitude(b);
            prop_assert!((e.isometric_difference(a, b) - direct).abs() < 1e-13);
        }

        #[test]
        fn isometric_difference_of_neighbours_is_its_derivative(
            lat in -80.0..80.0_f64, step in 1e-12..1e-7_f64,
        ) {
            // d psi / d phi = M / (N cos phi); the subtraction lat + step - lat is exact.
            let e = Ellipsoid::GRS80;
            let exact_step = ((lat + step) - lat).to_radians();
            let slope = e.meridian_radius(lat) / e.parallel_radius(lat);
            let got = e.isometric_difference(lat + step, lat);
            prop_assert!((got / (slope * exact_step) - 1.0).abs() < 3e-8, "{got}");
        }
    }
}
