//! Lambert conformal conic on the ellipsoid (EPSG methods 9801 and 9802).
//!
//! The textbook form subtracts two radii of some 6000 km from each other and two logarithms of
//! nearly equal numbers. Here every difference is taken first (after Karney's remarks on divided
//! differences in GeographicLib's documentation), so that rounding grows with the distance from the
//! false origin instead of from the apex, and parallels may be as close as wished, or equal.

use super::CrsError;
use super::ellipsoid::{Ellipsoid, on_globe, wrap_degrees};
use crate::grid::{LonLat, Projected};

/// Lambert conformal conic projection of one ellipsoid; coordinates in metres.
#[derive(Clone, Debug, PartialEq)]
pub struct LambertConic {
    ellipsoid: Ellipsoid,
    lat_0: f64,
    lon_0: f64,
    x_0: f64,
    y_0: f64,
    /// Isometric latitude of `lat_0`.
    psi_0: f64,
    /// Cone constant.
    n: f64,
    /// Radius of the parallel `lat_0` on the map, metres; has the sign of `n`.
    rho_0: f64,
}

impl LambertConic {
    /// Smallest mean of the standard parallels, degrees: below it the cone is a cylinder.
    const CYLINDER_DEG: f64 = 1e-8;

    /// Two standard parallels (EPSG:9802); degrees and metres. `lat_1 == lat_2` is the tangent cone.
    ///
    /// # Errors
    /// [`CrsError::Domain`] for a parallel at or beyond a pole, parallels that mirror each other at
    /// the equator, or a parameter that is not finite.
    pub fn two_parallels(
        ellipsoid: Ellipsoid,
        (lat_0, lon_0): (f64, f64),
        (lat_1, lat_2): (f64, f64),
        (x_0, y_0): (f64, f64),
    ) -> Result<Self, CrsError> {
        Self::new(ellipsoid, (lat_0, lon_0), (lat_1, lat_2), 1.0, (x_0, y_0))
    }

    /// One standard parallel, which is the latitude of origin too, and a scale (EPSG:9801); degrees
    /// and metres.
    ///
    /// # Errors
    /// As [`Self::two_parallels`].
    pub fn one_parallel(
        ellipsoid: Ellipsoid,
        (lat_0, lon_0): (f64, f64),
        k_0: f64,
        (x_0, y_0): (f64, f64),
    ) -> Result<Self, CrsError> {
        Self::new(ellipsoid, (lat_0, lon_0), (lat_0, lat_0), k_0, (x_0, y_0))
    }

    fn new(
        ellipsoid: Ellipsoid,
        (lat_0, lon_0): (f64, f64),
        (lat_1, lat_2): (f64, f64),
        k: f64,
        (x_0, y_0): (f64, f64),
    ) -> Result<Self, CrsError> {
        let on_globe = |lat: f64| lat.abs() < 90.0;
        let is_cone = (lat_1 + lat_2).abs() > 2.0 * Self::CYLINDER_DEG;
        let finite = lon_0.is_finite() && x_0.is_finite() && y_0.is_finite() && k.is_finite();
        if ![lat_0, lat_1, lat_2].into_iter().all(on_globe) || !is_cone || !finite || k <= 0.0 {
            return Err(domain(format!(
                "its own parameters: origin {lat_0}, {lon_0}, parallels {lat_1}, {lat_2}, scale {k}"
            )));
        }
        let n = cone_constant(&ellipsoid, lat_1, lat_2);
        let rho_1 = k * ellipsoid.parallel_radius(lat_1) / n;
        let rho_0 = rho_1 * libm::exp(-n * ellipsoid.isometric_difference(lat_0, lat_1));
        let psi_0 = ellipsoid.isometric_latitude(lat_0);
        Ok(Self { ellipsoid, lat_0, lon_0, x_0, y_0, psi_0, n, rho_0 })
    }

    /// Longitude and latitude on this projection's own datum to metres. The pole at the apex is a
    /// point; the map is cut along the meridian opposite to `lon_0`.
    ///
    /// # Errors
    /// [`CrsError::Domain`] at the other pole, beyond 90 degrees, and for NaN or infinity.
    pub fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        let LonLat { lon_deg, lat_deg } = at;
        if !on_globe(at) {
            return Err(domain(format!("longitude {lon_deg}, latitude {lat_deg}")));
        }
        // rho / rho_0 - 1.
        let excess =
            libm::expm1(-self.n * self.ellipsoid.isometric_difference(lat_deg, self.lat_0));
        let rho = self.rho_0 * (1.0 + excess);
        let theta = self.n * wrap_degrees(lon_deg - self.lon_0).to_radians();
        let half_sine = libm::sin(0.5 * theta);
        let x = rho * libm::sin(theta);
        // rho_0 - rho cos(theta), without the cancellation.
        let y = 2.0 * rho * half_sine * half_sine - self.rho_0 * excess;
        if x.is_finite() && y.is_finite() {
            Ok(Projected { x: self.x_0 + x, y: self.y_0 + y })
        } else {
            Err(domain(format!("longitude {lon_deg}, latitude {lat_deg} (the pole off the cone)")))
        }
    }

    /// Metres to longitude and latitude on this projection's own datum.
    ///
    /// # Errors
    /// [`CrsError::Domain`] in the gap that the unrolled cone leaves, and for NaN or infinity.
    pub fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        let u = (at.x - self.x_0) / self.rho_0;
        let v = (at.y - self.y_0) / self.rho_0;
        let theta = libm::atan2(u, 1.0 - v);
        let lambda = (theta / self.n).to_degrees();
        // A hair of tolerance for positions on the cut itself.
        if !(u.is_finite() && v.is_finite() && lambda.abs() <= 180.0 + 1e-9) {
            return Err(domain(format!("x {}, y {} m: no place on Earth lies there", at.x, at.y)));
        }
        // (rho / rho_0)^2 - 1, again without the cancellation near the origin.
        let excess = u * u + v * (v - 2.0);
        let log_ratio = if excess > -0.5 {
            0.5 * libm::log1p(excess)
        } else {
            libm::log(libm::hypot(u, 1.0 - v))
        };
        let psi = self.psi_0 - log_ratio / self.n;
        let tan = self.ellipsoid.geographic_tangent(libm::sinh(psi));
        Ok(LonLat {
            lon_deg: wrap_degrees(self.lon_0 + lambda.clamp(-180.0, 180.0)),
            lat_deg: libm::atan(tan).to_degrees(),
        })
    }
}

/// `(ln m1 - ln m2) / (psi2 - psi1)`, with `m` the radius of the parallel over `a`; its limit
/// `sin(lat)` where the parallels coincide.
fn cone_constant(ellipsoid: &Ellipsoid, lat_1: f64, lat_2: f64) -> f64 {
    if lat_1 == lat_2 {
        return libm::sin(lat_1.to_radians());
    }
    // The parallel nearer to the equator first: the ratio below is then positive, and its logarithm
    // keeps its digits.
    let (lat_1, lat_2) = if lat_1.abs() > lat_2.abs() { (lat_2, lat_1) } else { (lat_1, lat_2) };
    let (phi_1, phi_2) = (lat_1.to_radians(), lat_2.to_radians());
    // m = cos(beta), tan(beta) = (1 - f) tan(phi): ln m1 - ln m2 is half the logarithm of
    // (1 + tan^2 beta_2) / (1 + tan^2 beta_1).
    let flat = 1.0 - ellipsoid.f;
    let t_1 = flat * libm::tan(phi_1);
    let tangent_difference =
        flat * libm::sin((lat_2 - lat_1).to_radians()) / (libm::cos(phi_1) * libm::cos(phi_2));
    let tangent_sum =
        flat * libm::sin((lat_2 + lat_1).to_radians()) / (libm::cos(phi_1) * libm::cos(phi_2));
    let ratio = tangent_difference * tangent_sum / (1.0 + t_1 * t_1);
    0.5 * libm::log1p(ratio) / ellipsoid.isometric_difference(lat_2, lat_1)
}

fn domain(what: String) -> CrsError {
    CrsError::Domain { projection: "Lambert conformal conic".to_owned(), what }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::scale::ground_distance_m;

    fn cone(lat_0: f64, lat_1: f64, lat_2: f64) -> Result<LambertConic, CrsError> {
        LambertConic::two_parallels(Ellipsoid::GRS80, (lat_0, 0.0), (lat_1, lat_2), (0.0, 0.0))
    }

    #[test]
    fn cone_constant_is_continuous_where_the_parallels_meet() {
        let grs80 = Ellipsoid::GRS80;
        for lat in [-60.0, 20.0, 47.0, 85.0] {
            let tangent = cone_constant(&grs80, lat, lat);
            for apart in [1e-13, 1e-9, 1e-6] {
                let secant = cone_constant(&grs80, lat, lat + apart);
                // The mean of the parallels moves by half of what parts them.
                assert!((secant - tangent).abs() < apart.to_radians() + 1e-15, "{lat} {apart}");
                assert_eq!(secant, cone_constant(&grs80, lat + apart, lat));
            }
        }
    }

    #[test]
    fn one_parallel_with_a_scale_is_two_parallels_of_the_same_cone() {
        // A secant cone is a tangent one at the parallel of least scale, shrunk.
        let secant = cone(46.0, 45.0, 47.0).expect("valid");
        let middle = libm::asin(secant.n).to_degrees();
        let least = secant.n
            * secant.rho_0
            * libm::exp(-secant.n * Ellipsoid::GRS80.isometric_difference(middle, 46.0))
            / Ellipsoid::GRS80.parallel_radius(middle);
        let shift = secant.forward(LonLat { lon_deg: 0.0, lat_deg: middle }).expect("valid").y;
        let tangent =
            LambertConic::one_parallel(Ellipsoid::GRS80, (middle, 0.0), least, (0.0, shift))
                .expect("valid");
        for (lon_deg, lat_deg) in [(3.0, 44.0), (-20.0, 60.0), (0.0, 46.0)] {
            let at = LonLat { lon_deg, lat_deg };
            let (a, b) = (secant.forward(at).expect("valid"), tangent.forward(at).expect("valid"));
            assert!((a.x - b.x).abs() < 1e-8 && (a.y - b.y).abs() < 1e-8, "{a:?} {b:?}");
        }
    }

    /// EPSG's Guidance Note 7-2 (2024), sections 3.1.1.1 and 3.1.1.2.
    #[test]
    fn worked_examples_of_epsg_are_met() {
        let degrees = |d: f64, m: f64, s: f64| d + m / 60.0 + s / 3600.0;
        // Texas South Central, in US survey feet.
        let clarke = Ellipsoid { a: 20_925_832.16, f: 1.0 / 294.978_70 };
        let parallels = (degrees(28.0, 23.0, 0.0), degrees(30.0, 17.0, 0.0));
        let origin = (degrees(27.0, 50.0, 0.0), -99.0);
        let texas = LambertConic::two_parallels(clarke, origin, parallels, (2_000_000.0, 0.0))
            .expect("valid");
        let found = texas.forward(LonLat { lon_deg: -96.0, lat_deg: 28.5 }).expect("valid");
        assert!(
            (found.x - 2_963_503.91).abs() < 0.01 && (found.y - 254_759.80).abs() < 0.01,
            "{found:?}"
        );
        // Jamaica National Grid.
        let clarke = Ellipsoid { a: 6_378_206.4, f: 1.0 / 294.978_70 };
        let jamaica =
            LambertConic::one_parallel(clarke, (18.0, -77.0), 1.0, (250_000.0, 150_000.0))
                .expect("valid");
        let at =
            LonLat { lon_deg: -degrees(76.0, 56.0, 37.26), lat_deg: degrees(17.0, 55.0, 55.80) };
        let found = jamaica.forward(at).expect("valid");
        assert!(
            (found.x - 255_966.58).abs() < 0.01 && (found.y - 142_493.51).abs() < 0.01,
            "{found:?}"
        );
    }

    #[test]
    fn inverse_undoes_forward_from_the_apex_to_the_cut() {
        for (lat_0, lat_1, lat_2) in [(46.0, 45.0, 47.0), (-30.0, -25.0, -60.0), (5.0, 3.0, 3.0)] {
            let mut cone = cone(lat_0, lat_1, lat_2).expect("valid");
            (cone.lon_0, cone.x_0, cone.y_0) = (170.0, 5e5, -2e5);
            for lat in [-70.0, -20.0, 0.0, 30.0, 46.0, 46.1, 75.0] {
                for lon_deg in [-179.0, -10.1, 0.0, 77.0, 169.9, 170.0] {
                    let at = LonLat { lon_deg, lat_deg: lat * f64::signum(lat_0) };
                    let on_map = cone.forward(at).expect("valid");
                    let back = cone.inverse(on_map).expect("valid");
                    let miss = ground_distance_m(at, back);
                    // What rounding the map's own coordinates makes.
                    let bound = 1e-15 * (on_map.x.abs() + on_map.y.abs()) + 2e-9;
                    assert!(miss < bound, "{lat_0} {at:?}: {miss:e} {bound:e}");
                }
            }
        }
    }

    #[test]
    fn apex_cut_and_gap_are_where_the_cone_has_them() {
        let cone = cone(46.0, 45.0, 47.0).expect("valid");
        let at = |lon_deg, lat_deg| cone.forward(LonLat { lon_deg, lat_deg });
        let apex = at(123.0, 90.0).expect("the apex");
        assert!(apex.x.abs() < 1e-8 && (apex.y - cone.rho_0).abs() < 1e-8, "{apex:?}");
        assert!(at(0.0, -90.0).is_err() && at(0.0, 90.1).is_err() && at(f64::NAN, 0.0).is_err());
        let back = |x, y| cone.inverse(Projected { x, y });
        let east = at(179.9, 30.0).expect("on the map");
        assert!((back(east.x, east.y).expect("on the map").lon_deg - 179.9).abs() < 1e-9);
        // Straight behind the apex lies the gap.
        assert!(back(0.0, cone.rho_0 * 1.1).is_err() && back(1e6, cone.rho_0 * 1.5).is_err());
        assert!(back(f64::NAN, 0.0).is_err() && back(0.0, f64::INFINITY).is_err());
    }

    #[test]
    fn cylinders_planes_and_nonsense_are_refused() {
        for (lat_0, lat_1, lat_2) in [
            (0.0, 30.0, -30.0),
            (0.0, 0.0, 0.0),
            (45.0, 90.0, 90.0),
            (45.0, 45.0, 90.0),
            (45.0, f64::NAN, 45.0),
            (91.0, 45.0, 46.0),
            (90.0, 45.0, 46.0),
        ] {
            assert!(matches!(cone(lat_0, lat_1, lat_2), Err(CrsError::Domain { .. })));
        }
        let scaled =
            |k| LambertConic::one_parallel(Ellipsoid::WGS84, (45.0, 0.0), k, (0.0, 0.0)).is_ok();
        assert!(scaled(0.999) && !scaled(0.0) && !scaled(-1.0) && !scaled(f64::INFINITY));
    }
}
