//! The projections and the datum step where their formulas lose digits, each naive form beside ours;
//! `docs/numerics.md`.
//!
//! Distances are metres on the ground: at a pole or far outside of its zone a projection shrinks or
//! stretches without bound, and a difference on the map says nothing.

mod conic;
mod datum;
mod heights;
mod transverse_mercator;

use super::Ellipsoid;
use crate::grid::LonLat;
use crate::oracle::{Real, nearest, radians, real, squared};

/// An ellipsoid in 48 digits; its two parameters are the doubles that the program uses.
struct Exact {
    a: Real,
    e2: Real,
    e: Real,
}

impl Exact {
    fn of(ellipsoid: &Ellipsoid) -> Self {
        let f = real(ellipsoid.f);
        let e2 = &f * (real(2.0) - &f);
        Self { a: real(ellipsoid.a), e: e2.sqrt(), e2 }
    }

    /// `asinh(tan phi) - e atanh(e sin phi)` of radians.
    fn isometric(&self, phi: &Real) -> Real {
        phi.tan().asinh() - &self.e * (&self.e * phi.sin()).atanh()
    }

    /// Radius of curvature in the meridian, of radians.
    fn meridian_radius(&self, phi: &Real) -> Real {
        let w2 = real(1.0) - &self.e2 * squared(&phi.sin());
        &self.a * (real(1.0) - &self.e2) / (&w2 * w2.sqrt())
    }

    /// Radius of the parallel, of radians.
    fn parallel_radius(&self, phi: &Real) -> Real {
        &self.a * phi.cos() / (real(1.0) - &self.e2 * squared(&phi.sin())).sqrt()
    }

    /// Metres on the ground between a position in degrees and one in radians that is near it.
    fn apart(&self, found: LonLat, lambda: &Real, phi: &Real) -> f64 {
        let turns = (found.lon_deg - nearest(lambda).to_degrees()) / 360.0;
        let east = radians(found.lon_deg - 360.0 * turns.round()) - lambda;
        let north = radians(found.lat_deg) - phi;
        let (east, north) = (east * self.parallel_radius(phi), north * self.meridian_radius(phi));
        libm::hypot(nearest(&east), nearest(&north))
    }
}

/// A position in radians, exactly that of a position in degrees.
fn exactly(at: LonLat) -> (Real, Real) {
    (radians(at.lon_deg), radians(at.lat_deg))
}
