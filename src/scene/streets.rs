//! The street grid: two families of parallel streets, and where a point lies with respect to them.
//!
//! Street coordinates `(s, t)`: t along the grid's azimuth, s to its right. Streets of family 0 run
//! along t (at fixed s), those of family 1 along s.

use super::spec::StreetSpec;
use crate::random::Draw;
use serde::Serialize;

/// Half the width of an arterial road's carriageway, metres (four lanes).
const ARTERIAL_HALF_WIDTH_M: f64 = 6.6;
/// Half the width of a local street's carriageway, metres (two lanes, parking on both sides).
const LOCAL_HALF_WIDTH_M: f64 = 4.6;
/// Width of kerb, verge and pavement together on each side of a carriageway, metres.
pub const SIDE_WIDTH_M: f64 = 4.0;
/// Width of the kerb, metres.
pub const KERB_M: f64 = 0.18;
/// Where the verge ends and the pavement begins, metres from the carriageway.
pub const VERGE_END_M: f64 = 2.1;
/// Radius of the carriageway's rounded corners at crossings, metres.
const CORNER_RADIUS_M: f64 = 3.5;

/// One street.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Street {
    /// Coordinate of its centre line: s of family 0, t of family 1, metres.
    pub at: f64,
    /// Half the width of its carriageway, metres.
    pub half_width: f64,
    /// Whether it has four lanes.
    pub arterial: bool,
    /// Number counted from the middle of the scene; negative to the left and below.
    pub number: i64,
}

/// A block: the land between four streets without their pavements, in street coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BlockArea {
    /// Number of the street at its left, and at its lower end.
    pub index: [i64; 2],
    /// Lowest s, metres.
    pub s0: f64,
    /// Highest s, metres.
    pub s1: f64,
    /// Lowest t, metres.
    pub t0: f64,
    /// Highest t, metres.
    pub t1: f64,
}

/// Where a point lies in the street grid.
#[derive(Clone, Copy, Debug)]
pub struct StreetPoint {
    /// Street coordinates, metres.
    pub st: [f64; 2],
    /// Distance from the nearest carriageway, metres; negative on it.
    pub kerb: f64,
    /// Nearest street of each family.
    pub nearest: [Street; 2],
    /// Position of the block: how many streets of each family are below the point.
    pub cell: [usize; 2],
}

impl StreetPoint {
    /// Signed distance from the centre line of the nearest street of a family, metres.
    #[must_use]
    pub fn across(&self, family: usize) -> f64 {
        self.st[family] - self.nearest[family].at
    }

    /// Coordinate along the streets of a family, metres.
    #[must_use]
    pub fn along(&self, family: usize) -> f64 {
        self.st[1 - family]
    }

    /// Whether the point is on the carriageway of the family's nearest street.
    #[must_use]
    pub fn on(&self, family: usize) -> bool {
        self.across(family).abs() < self.nearest[family].half_width
    }
}

/// The street grid of a scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Streets {
    /// Direction of family 0 in the local frame, unit vector (east, north).
    pub axis: [f64; 2],
    /// The streets of both families, in order of their coordinate.
    pub families: [Vec<Street>; 2],
}

impl Streets {
    /// Lays streets within `reach` metres of the origin and a little beyond.
    #[must_use]
    pub fn new(spec: &StreetSpec, seed: u64, reach: f64) -> Self {
        let azimuth = spec.azimuth_degrees.to_radians();
        let family = |which: u64, spacing: f64| {
            let mut streets = Vec::new();
            let start =
                Draw::new(&[seed, super::purpose::STREETS, which]).range(-0.5, 0.5) * spacing;
            for direction in [1_i64, -1] {
                let mut at = start;
                let mut number = 0_i64;
                while at.abs() <= reach + 1.5 * spacing {
                    if direction > 0 || number < 0 {
                        streets.push(street(spec, which, at, number));
                    }
                    let gap = if direction > 0 { number } else { number - 1 };
                    let mut draw =
                        Draw::new(&[seed, super::purpose::STREETS, which, 1, gap.cast_unsigned()]);
                    let vary = 1.0 + spec.irregularity * draw.range(-1.0, 1.0);
                    at += direction as f64 * spacing * vary;
                    number += direction;
                }
            }
            streets.sort_by(|a, b| a.at.total_cmp(&b.at));
            streets
        };
        Self {
            axis: [libm::sin(azimuth), libm::cos(azimuth)],
            families: [family(0, spec.block_width_metres), family(1, spec.block_length_metres)],
        }
    }

    /// Street coordinates of a point of the local frame.
    #[must_use]
    pub fn to_street(&self, x: f64, y: f64) -> [f64; 2] {
        let [ax, ay] = self.axis;
        [x * ay - y * ax, x * ax + y * ay]
    }

    /// The point of the local frame at street coordinates.
    #[must_use]
    pub fn to_local(&self, s: f64, t: f64) -> [f64; 2] {
        let [ax, ay] = self.axis;
        [s * ay + t * ax, t * ay - s * ax]
    }

    /// Where a point lies.
    #[must_use]
    pub fn locate(&self, x: f64, y: f64) -> StreetPoint {
        let st = self.to_street(x, y);
        let (s, cell0) = nearest(&self.families[0], st[0]);
        let (t, cell1) = nearest(&self.families[1], st[1]);
        let a = (st[0] - s.at).abs() - s.half_width;
        let b = (st[1] - t.at).abs() - t.half_width;
        let r = CORNER_RADIUS_M;
        let kerb = if a < r && b < r {
            // At a crossing: paved outside the circle that touches both carriageways.
            r - libm::hypot(r - a, r - b)
        } else {
            a.min(b)
        };
        StreetPoint { st, kerb, nearest: [s, t], cell: [cell0, cell1] }
    }

    /// All blocks between the streets.
    #[must_use]
    pub fn blocks(&self) -> Vec<BlockArea> {
        let mut blocks = Vec::new();
        for t in self.families[1].windows(2) {
            for s in self.families[0].windows(2) {
                let side = |street: &Street| street.half_width + SIDE_WIDTH_M;
                blocks.push(BlockArea {
                    index: [s[0].number, t[0].number],
                    s0: s[0].at + side(&s[0]),
                    s1: s[1].at - side(&s[1]),
                    t0: t[0].at + side(&t[0]),
                    t1: t[1].at - side(&t[1]),
                });
            }
        }
        blocks
    }
}

fn street(spec: &StreetSpec, family: u64, at: f64, number: i64) -> Street {
    let every = i64::from(spec.arterial_every);
    let arterial = every > 0 && (number + family as i64).rem_euclid(every) == 0;
    let half_width = if arterial { ARTERIAL_HALF_WIDTH_M } else { LOCAL_HALF_WIDTH_M };
    Street { at, half_width, arterial, number }
}

/// The nearest street of a sorted, non-empty family, and how many streets lie below.
fn nearest(streets: &[Street], at: f64) -> (Street, usize) {
    let above = streets.partition_point(|s| s.at <= at);
    let best = match (above.checked_sub(1).and_then(|i| streets.get(i)), streets.get(above)) {
        (Some(low), Some(high)) => {
            // The nearer kerb, so that a wide road is not cut off at the middle of the block.
            let (l, h) = (at - low.at - low.half_width, high.at - at - high.half_width);
            if l <= h { low } else { high }
        }
        (Some(only), None) | (None, Some(only)) => only,
        (None, None) => &Street { at: f64::INFINITY, half_width: 0.0, arterial: false, number: 0 },
    };
    (*best, above)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn streets() -> Streets {
        Streets::new(&StreetSpec::default(), 5, 150.0)
    }

    #[test]
    fn coordinates_turn_with_the_azimuth_and_back() {
        let streets = streets();
        let [x, y] = streets.to_local(12.0, -7.0);
        let [s, t] = streets.to_street(x, y);
        assert!((s - 12.0).abs() < 1e-12 && (t + 7.0).abs() < 1e-12);
        // Azimuth 4 degrees: t points nearly north, s nearly east.
        let [x, y] = streets.to_local(0.0, 1.0);
        assert!((libm::atan2(x, y).to_degrees() - 4.0).abs() < 1e-12);
        assert!(streets.to_local(1.0, 0.0)[0] > 0.99);
    }

    #[test]
    fn the_kerb_distance_is_continuous_and_blocks_lie_off_the_streets() {
        let streets = streets();
        let h = 0.01;
        for i in 0..30_000 {
            let mut draw = Draw::new(&[2, i]);
            let (x, y) = (draw.range(-150.0, 150.0), draw.range(-150.0, 150.0));
            let here = streets.locate(x, y).kerb;
            for (dx, dy) in [(h, 0.0), (0.0, h)] {
                // A distance changes by no more than the step.
                let there = streets.locate(x + dx, y + dy).kerb;
                assert!((there - here).abs() <= 1.5 * h, "{x} {y} {here} {there}");
            }
        }
        let blocks = streets.blocks();
        assert!(blocks.len() >= 6);
        for b in &blocks {
            assert!(b.s0 < b.s1 && b.t0 < b.t1);
            let [x, y] = streets.to_local(b.s0, b.t0);
            assert!(streets.locate(x, y).kerb >= SIDE_WIDTH_M - 1e-9);
        }
    }

    #[test]
    fn every_third_street_is_an_arterial_road() {
        let streets = streets();
        for family in &streets.families {
            assert!(family.len() >= 4);
            let numbers: Vec<i64> = family.iter().map(|s| s.number).collect();
            assert!(numbers.windows(2).all(|w| w[1] == w[0] + 1), "{numbers:?}");
        }
        assert!(streets.families[0].iter().all(|s| s.arterial == (s.number.rem_euclid(3) == 0)));
    }
}
