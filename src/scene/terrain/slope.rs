//! Bounds on how steeply the ground rises in one direction: what decides whether hills can cast a shadow.
//!
//! [`Terrain::steepest`] adds what each part can do at its worst and is one sum. Here a square is divided, always where
//! the bound is largest, until the bound is close to a slope that was found (branch and bound). The bound of a cell is
//! interval arithmetic over what the ground is made of, so that it holds at every point of it.

use super::{BEACH_SLOPE, Shore, Terrain, Wave};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Cells looked at before the bound is taken as it is. Hills of 200 m in a square of 1 km take some hundreds.
const MOST_CELLS: usize = 20_000;
/// A bound is close enough to a slope that exists, rise per metre: as much as 0.3 degrees of the sun's height.
const CLOSE: f64 = 0.005;

/// All numbers from the first to the second.
type Range = [f64; 2];

fn around(middle: f64, half: f64) -> Range {
    [middle - half, middle + half]
}

fn plus(a: Range, b: Range) -> Range {
    [a[0] + b[0], a[1] + b[1]]
}

fn times(a: Range, b: Range) -> Range {
    let products = [a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]];
    products.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], |r, p| [r[0].min(p), r[1].max(p)])
}

/// A square of the ground and the largest slope that it can have.
struct Cell {
    centre: [f64; 2],
    half: f64,
    most: f64,
}

impl PartialEq for Cell {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Cell {}

impl PartialOrd for Cell {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Cell {
    fn cmp(&self, other: &Self) -> Ordering {
        self.most.total_cmp(&other.most)
    }
}

impl Wave {
    /// How fast its slope changes at most, per metre.
    fn sharpest(&self) -> f64 {
        self.amplitude.abs() * (self.kx * self.kx + self.ky * self.ky)
    }
}

fn sharpest(waves: &[Wave]) -> f64 {
    waves.iter().map(Wave::sharpest).sum()
}

impl Terrain {
    /// A bound on the slope in a direction (a unit vector, east and north) within a square around the origin of sides
    /// twice `half` metres, rise per metre; 0 where the ground nowhere rises that way. It is at most
    /// 0.005 too large, unless that takes more than 20 000 cells.
    #[must_use]
    pub fn steepest_towards(&self, direction: [f64; 2], half: f64) -> f64 {
        let slope = |[x, y]: [f64; 2]| {
            let ground = self.at(x, y);
            ground.dx * direction[0] + ground.dy * direction[1]
        };
        let cell = |centre, half| Cell { centre, half, most: self.rise(centre, half, direction) };
        let mut found = slope([0.0, 0.0]).max(0.0);
        let mut cells = BinaryHeap::from([cell([0.0, 0.0], half)]);
        for _ in 0..MOST_CELLS / 4 {
            let Some(top) = cells.pop() else { break };
            if top.most <= found + CLOSE {
                return top.most.max(found);
            }
            let half = top.half / 2.0;
            for (east, north) in [(-half, -half), (half, -half), (-half, half), (half, half)] {
                let centre = [top.centre[0] + east, top.centre[1] + north];
                found = found.max(slope(centre));
                cells.push(cell(centre, half));
            }
        }
        cells.peek().map_or(found, |top| top.most.max(found))
    }

    /// The largest slope that a square of the ground can have in a direction.
    fn rise(&self, centre: [f64; 2], half: f64, [east, north]: [f64; 2]) -> f64 {
        // Nothing of the square is farther from its middle.
        let far = half * std::f64::consts::SQRT_2;
        let [z, dx, dy] = self.land(centre[0], centre[1]);
        let bend = sharpest(&self.waves) * far;
        let land = around(dx * east + dy * north, bend);
        let Some(shore) = &self.shore else { return land[1] };
        let height = around(z, (libm::hypot(dx, dy) + bend) * far);
        shore.rise(centre, far, [east, north], land, height)
    }
}

impl Shore {
    /// [`Terrain::rise`] where there is water: of the land's slope and height and what the shore makes of them.
    fn rise(&self, [x, y]: [f64; 2], far: f64, u: [f64; 2], land: Range, height: Range) -> f64 {
        let [d, ddx, ddy] = self.distance(x, y);
        let bend = sharpest(&self.swing) * far;
        let inland = around(ddx * u[0] + ddy * u[1], bend);
        let d = around(d, (libm::hypot(ddx, ddy) + bend) * far);
        if d[1] < 0.0 {
            return 0.0;
        }
        let d = d.map(|d| d.clamp(0.0, self.strip));
        let t = d.map(|d| d / self.strip);
        let blend = t.map(|t| t * t * t * (t * (6.0 * t - 15.0) + 10.0));
        let rate_at = |t: f64| 30.0 * t * t * (t * (t - 2.0) + 1.0) / self.strip;
        // The blend is steepest in the middle of the strip, and less so the farther from it.
        let [near, end] = t.map(rate_at);
        let top = if t[0] <= 0.5 && t[1] >= 0.5 { rate_at(0.5) } else { near.max(end) };
        let rate = [near.min(end), top];
        let beach = d.map(|d| self.level + BEACH_SLOPE * d);
        let over = [height[0] - beach[1], height[1] - beach[0]];
        let less = [BEACH_SLOPE * (1.0 - blend[1]), BEACH_SLOPE * (1.0 - blend[0])];
        let along = plus(less, times(over, rate));
        let rise = plus(times(land, blend), times(along, inland))[1];
        // Water, which is level, may be part of the square.
        rise.max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;
    use crate::scene::spec::{SceneSpec, Side, WaterSpec};

    fn towards(azimuth_degrees: f64) -> [f64; 2] {
        let (sin, cos) = libm::sincos(azimuth_degrees.to_radians());
        [sin, cos]
    }

    /// Hills with and without water on each side, high and low.
    fn terrains() -> Vec<Terrain> {
        let sides =
            [None, Some(Side::South), Some(Side::North), Some(Side::West), Some(Side::East)];
        let relief = [0.0, 4.0, 25.0];
        let cases = sides.into_iter().flat_map(|side| relief.map(|relief| (side, relief)));
        (0..)
            .zip(cases)
            .map(|(seed, (side, relief))| {
                let mut spec = SceneSpec { seed, ..SceneSpec::default() };
                spec.terrain.relief_metres = relief;
                spec.terrain.slope_percent = 3.0;
                spec.water = side.map(|side| WaterSpec { side, ..WaterSpec::default() });
                Terrain::new(&spec)
            })
            .collect()
    }

    #[test]
    fn no_point_is_steeper_than_the_bound_and_the_bound_is_close_to_one() {
        for (i, terrain) in terrains().iter().enumerate() {
            let half = 150.0;
            let u = towards(37.0 * i as f64);
            let bound = terrain.steepest_towards(u, half);
            let mut most = 0.0_f64;
            for row in 0..=600 {
                for column in 0..=600 {
                    let [x, y] = [column, row].map(|k| f64::from(k) * 0.5 - half);
                    let ground = terrain.at(x, y);
                    most = most.max(ground.dx * u[0] + ground.dy * u[1]);
                }
            }
            assert!(most <= bound, "{i}: {most} over {bound}");
            assert!(bound <= most + 1.2 * CLOSE, "{i}: {bound} far from {most}");
            assert!(bound <= terrain.steepest(half * std::f64::consts::SQRT_2), "{i}: {bound}");
        }
    }

    #[test]
    fn every_square_s_bound_holds_in_it() {
        for (i, terrain) in terrains().iter().enumerate() {
            let mut draw = Draw::new(&[11, i as u64]);
            for _ in 0..400 {
                let centre = [draw.range(-200.0, 200.0), draw.range(-200.0, 200.0)];
                let half = libm::exp(draw.range(-3.0, 4.0));
                let u = towards(draw.range(0.0, 360.0));
                let bound = terrain.rise(centre, half, u);
                for _ in 0..20 {
                    let [x, y] = centre.map(|c| c + half * draw.range(-1.0, 1.0));
                    let ground = terrain.at(x, y);
                    let slope = ground.dx * u[0] + ground.dy * u[1];
                    assert!(slope <= bound + 1e-12, "{i} at {x} {y}: {slope} over {bound}");
                }
            }
        }
    }

    #[test]
    fn a_plane_rises_one_way_only() {
        let mut spec = SceneSpec::default();
        spec.terrain.relief_metres = 0.0;
        spec.terrain.slope_percent = 10.0;
        spec.terrain.slope_azimuth_degrees = 90.0;
        let terrain = Terrain::new(&spec);
        for (azimuth, slope) in [(90.0, 0.1), (270.0, 0.0), (0.0, 0.0), (30.0, 0.05)] {
            let bound = terrain.steepest_towards(towards(azimuth), 500.0);
            assert!((bound - slope).abs() < 1e-12, "{azimuth}: {bound}");
        }
    }
}
