//! From grid coordinates to metres: local east-north-up at the city's centre.
//!
//! A point goes from model pixels to pixels of the picture as it was given, through its georeference to
//! longitude and latitude, with its height above the ellipsoid to earth-centred coordinates, and from there to
//! east, north and up at the city's centre. The Earth's curvature is in it: 10 km from the centre the ground lies
//! 7.8 m below the plane that touches the ellipsoid there.
//!
//! A mesh has hundreds of millions of vertices, and each way goes through a projection and several
//! transcendental functions. So it is gone once for every node of a lattice, and a vertex takes the quadratic polynomial through
//! the nine nodes of its block: 64 pixels wide, or wider where the city has more than some 4000 x 4000 nodes'
//! worth of them. The error is measured against the exact way when a frame is made ([`LocalFrame::error_m`]):
//! below 1e-8 m for pixels of decimetres, since the third derivatives are of the order of 1 / (Earth's radius)^2.

use super::city::City;
use crate::crs::{CrsError, Ellipsoid};
use crate::footprint::{Footprint, FootprintError, Georeference};
use crate::grid::{LonLat, PixelPoint};
use rayon::prelude::*;
use std::sync::Arc;

/// Model pixels of a block, before it is widened or narrowed.
const BLOCK: f64 = 64.0;
/// Nodes that a lattice may have: 50 MB.
const MOST_NODES: u64 = 1 << 20;
/// Nodes that it may have where a coarser one is not exact enough.
const MOST_EXACT_NODES: u64 = 1 << 22;
/// Error up to which a lattice is taken, metres.
const TOLERANCE_M: f64 = 1e-6;

/// Local east-north-up at the centre of the city, on the WGS 84 ellipsoid; of a city without a place, metres
/// along the picture's axes.
///
/// Its origin stands at the city's lowest level: up is 0 there and the DSM's height above it (but for the
/// Earth's curvature), whatever the base height.
#[derive(Clone, Debug)]
pub struct LocalFrame {
    size: [f64; 2],
    gsd_m: [f64; 2],
    vertical_m: f64,
    base_height_m: f64,
    placed: Option<Placed>,
}

/// A frame that has a place on Earth.
#[derive(Clone, Debug)]
struct Placed {
    origin: LonLat,
    to_ecef: [f64; 16],
    lattice: Lattice,
    error_m: f64,
}

impl LocalFrame {
    /// Of a city whose lowest level stands `base_height_m` above the ellipsoid.
    ///
    /// # Errors
    /// [`FootprintError`] for a place that cannot be used.
    pub fn new(city: &City, base_height_m: f64) -> Result<Self, FootprintError> {
        let placed = match city.footprint.georeference()? {
            Some(georeference) => Some(Placed::new(city, &georeference, base_height_m)?),
            None => None,
        };
        Ok(Self {
            size: city.size.map(f64::from),
            gsd_m: city.gsd_m(),
            vertical_m: city.vertical_m,
            base_height_m,
            placed,
        })
    }

    /// East, north and up of a point in grid coordinates, metres.
    #[must_use]
    pub fn place(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let height = (z + 1.0) * self.vertical_m;
        let Some(placed) = &self.placed else {
            let east = (x - self.size[0] / 2.0) * self.gsd_m[0];
            let north = (self.size[1] / 2.0 - y) * self.gsd_m[1];
            return [east, north, height];
        };
        let [east, north, up, normal @ ..] = placed.lattice.at([x, y]);
        let foot = [east, north, up];
        std::array::from_fn(|axis| foot[axis] + height * normal[axis])
    }

    /// The point under the origin; `None` of a city without a place.
    #[must_use]
    pub fn origin(&self) -> Option<LonLat> {
        self.placed.as_ref().map(|placed| placed.origin)
    }

    /// Height of the origin above the ellipsoid, metres, as it was given.
    #[must_use]
    pub fn base_height_m(&self) -> f64 {
        self.base_height_m
    }

    /// Column-major 4 x 4 matrix from the local frame to earth-centred, earth-fixed coordinates (EPSG:4978);
    /// `None` of a city without a place.
    #[must_use]
    pub fn to_ecef(&self) -> Option<[f64; 16]> {
        self.placed.as_ref().map(|placed| placed.to_ecef)
    }

    /// How far [`LocalFrame::place`] lies from the exact position at most, metres, as measured between the nodes
    /// of up to 64 blocks; 0 of a city without a place.
    #[must_use]
    pub fn error_m(&self) -> f64 {
        self.placed.as_ref().map_or(0.0, |placed| placed.error_m)
    }
}

impl Placed {
    fn new(
        city: &City,
        georeference: &Georeference,
        base_height_m: f64,
    ) -> Result<Self, FootprintError> {
        let origin = georeference.center()?;
        let to_ecef = east_north_up(origin, base_height_m);
        let exact = Exact { city, georeference, to_ecef: &to_ecef, base_height_m };
        let size = city.size.map(f64::from);
        let mut block = BLOCK;
        while Lattice::nodes(size, block) > MOST_NODES {
            block *= 2.0;
        }
        loop {
            let lattice = Lattice::new(size, block, &exact)?;
            let error_m = lattice.error(&exact, 2.0 * city.vertical_m)?;
            // So written that NaN ends it too.
            let poor = error_m > TOLERANCE_M;
            if !poor || block <= 1.0 || Lattice::nodes(size, block / 2.0) > MOST_EXACT_NODES {
                return Ok(Self { origin, to_ecef, lattice, error_m });
            }
            block /= 2.0;
        }
    }
}

/// Column-major matrix from local east-north-up to earth-centred coordinates.
fn east_north_up(origin: LonLat, height_m: f64) -> [f64; 16] {
    let [east, north, up] = axes(origin);
    let at = Ellipsoid::WGS84.geocentric(origin, height_m);
    let mut matrix = [0.0; 16];
    for (column, values) in [east, north, up, at].into_iter().enumerate() {
        matrix[4 * column..][..3].copy_from_slice(&values);
    }
    matrix[15] = 1.0;
    matrix
}

/// Unit vectors to the east, to the north and away from the ellipsoid, in earth-centred coordinates.
fn axes(at: LonLat) -> [[f64; 3]; 3] {
    let (phi, lambda) = (at.lat_deg.to_radians(), at.lon_deg.to_radians());
    let (s, c) = (libm::sin(phi), libm::cos(phi));
    let (sl, cl) = (libm::sin(lambda), libm::cos(lambda));
    [[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]]
}

/// The exact way.
struct Exact<'a> {
    city: &'a City,
    georeference: &'a Georeference,
    to_ecef: &'a [f64; 16],
    base_height_m: f64,
}

impl Exact<'_> {
    /// Where the city's lowest level is at a point, east, north and up, and the unit vector away from the
    /// ellipsoid there.
    fn at(&self, [x, y]: [f64; 2]) -> Result<[f64; 6], CrsError> {
        let City { size, footprint: Footprint { size_px, .. }, .. } = self.city;
        // The picture's edge is the city's, to the last bit.
        let pixel = |value: f64, axis: usize| {
            let (given, model) = (f64::from(size_px[axis]), f64::from(size[axis]));
            if value == model { given } else { value * (given / model) }
        };
        let at =
            self.georeference.lonlat_of_pixel(PixelPoint { x: pixel(x, 0), y: pixel(y, 1) })?;
        let position = Ellipsoid::WGS84.geocentric(at, self.base_height_m);
        let [.., normal] = axes(at);
        let foot = [0, 1, 2].map(|axis| position[axis] - self.to_ecef[12 + axis]);
        let turned = |v: [f64; 3]| {
            [0, 1, 2].map(|axis| {
                let to = &self.to_ecef[4 * axis..][..3];
                to[0] * v[0] + to[1] * v[1] + to[2] * v[2]
            })
        };
        let ([e, n, u], [ne, nn, nu]) = (turned(foot), turned(normal));
        Ok([e, n, u, ne, nn, nu])
    }
}

/// Quadratic polynomials over blocks of pixels; neighbours share the three nodes of their side, so that the
/// whole is continuous.
#[derive(Clone, Debug)]
struct Lattice {
    blocks: [usize; 2],
    /// Blocks per pixel.
    density: [f64; 2],
    /// What [`Exact::at`] says, row by row.
    nodes: Arc<[[f64; 6]]>,
}

impl Lattice {
    /// Blocks over a city, none wider than `block` pixels.
    fn blocks(size: [f64; 2], block: f64) -> [usize; 2] {
        size.map(|side| (side / block).ceil().max(1.0) as usize)
    }

    fn nodes(size: [f64; 2], block: f64) -> u64 {
        Self::blocks(size, block).into_iter().map(|count| 2 * count as u64 + 1).product()
    }

    fn new(size: [f64; 2], block: f64, exact: &Exact<'_>) -> Result<Self, CrsError> {
        let blocks = Self::blocks(size, block);
        let at = |node: usize, axis: usize| size[axis] * (node as f64 / (2 * blocks[axis]) as f64);
        let rows: Vec<Vec<[f64; 6]>> = (0..=2 * blocks[1])
            .into_par_iter()
            .map(|row| (0..=2 * blocks[0]).map(|x| exact.at([at(x, 0), at(row, 1)])).collect())
            .collect::<Result<_, _>>()?;
        let density = [0, 1].map(|axis| blocks[axis] as f64 / size[axis]);
        Ok(Self { blocks, density, nodes: rows.concat().into() })
    }

    #[inline]
    fn at(&self, point: [f64; 2]) -> [f64; 6] {
        let [(column, across), (row, down)] = [0, 1].map(|axis| {
            let at = point[axis] * self.density[axis];
            let block = (at.max(0.0) as usize).min(self.blocks[axis] - 1);
            let u = at - block as f64;
            // Lagrange's polynomials of the nodes at 0, 1/2 and 1.
            (2 * block, [(1.0 - 2.0 * u) * (1.0 - u), 4.0 * u * (1.0 - u), u * (2.0 * u - 1.0)])
        });
        let stride = 2 * self.blocks[0] + 1;
        let mut sum = [0.0; 6];
        for (k, down) in down.into_iter().enumerate() {
            let nodes = &self.nodes[(row + k) * stride + column..][..3];
            for (component, sum) in sum.iter_mut().enumerate() {
                *sum += down
                    * (across[0] * nodes[0][component]
                        + across[1] * nodes[1][component]
                        + across[2] * nodes[2][component]);
            }
        }
        sum
    }

    /// Largest distance from the exact way, metres, at the ground and `height_m` above it, halfway between nodes
    /// of up to 8 x 8 blocks.
    fn error(&self, exact: &Exact<'_>, height_m: f64) -> Result<f64, CrsError> {
        let samples = |axis: usize| {
            let blocks = self.blocks[axis];
            let count = blocks.min(8);
            (0..count).flat_map(move |k| {
                let block = if count > 1 { k * (blocks - 1) / (count - 1) } else { 0 };
                [0.25, 0.75].map(|within| (block as f64 + within) / self.density[axis])
            })
        };
        let mut worst = 0.0_f64;
        for x in samples(0) {
            for y in samples(1) {
                let (found, truth) = (self.at([x, y]), exact.at([x, y])?);
                for height in [0.0, height_m] {
                    let off = |axis: usize| {
                        found[axis] - truth[axis] + height * (found[axis + 3] - truth[axis + 3])
                    };
                    let distance = [0, 1, 2].map(|axis| off(axis) * off(axis));
                    let distance = distance.iter().sum::<f64>().sqrt();
                    // `max` would drop a NaN.
                    worst = if distance.is_nan() { f64::NAN } else { worst.max(distance) };
                }
            }
        }
        Ok(worst)
    }
}

#[cfg(test)]
#[path = "frame_tests.rs"]
mod tests;
