//! The bare earth: an analytic function with its gradient, smooth everywhere.
//!
//! `z(p) = base + slope . p + sum of a_k sin(k_k . p + phase_k)`. With water, the land goes down to
//! a curved shoreline over a strip that is the wider the higher the land stands; the blend is the
//! quintic smoothstep, so that the second derivative is continuous too.

use super::spec::{SceneSpec, Side, WaterSpec};
use crate::random::Draw;
use std::f64::consts::TAU;

mod slope;

/// Least distance from the shore over which the land comes down to the water, metres.
const LEAST_STRIP_M: f64 = 34.0;
/// Width of that strip per metre by which the land stands above the water: slopes stay walkable.
const STRIP_PER_METRE: f64 = 6.0;
/// Slope at the water's edge.
const BEACH_SLOPE: f64 = 0.06;
/// Number of waves.
const WAVES: usize = 5;

/// One wave: amplitude (m), wave vector (rad/m), phase (rad).
#[derive(Clone, Copy, Debug, PartialEq)]
struct Wave {
    amplitude: f64,
    kx: f64,
    ky: f64,
    phase: f64,
}

impl Wave {
    /// Value and gradient.
    fn at(&self, x: f64, y: f64) -> [f64; 3] {
        let (sin, cos) = libm::sincos(self.kx * x + self.ky * y + self.phase);
        let d = self.amplitude * cos;
        [self.amplitude * sin, d * self.kx, d * self.ky]
    }

    fn steepest(&self) -> f64 {
        self.amplitude.abs() * libm::hypot(self.kx, self.ky)
    }
}

/// The shoreline: `inland(p) = n . p - offset - swing(along)`, metres; negative over water.
#[derive(Clone, Debug, PartialEq)]
struct Shore {
    inland: [f64; 2],
    offset: f64,
    level: f64,
    strip: f64,
    swing: Vec<Wave>,
}

/// Height and gradient of the ground at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Height (NAVD88), metres; that of the water over water.
    pub z: f64,
    /// Rise per metre to the east.
    pub dx: f64,
    /// Rise per metre to the north.
    pub dy: f64,
    /// Whether water covers it.
    pub water: bool,
}

/// The bare earth of a scene. Coordinates are metres in the local frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Terrain {
    base: f64,
    slope: [f64; 2],
    waves: Vec<Wave>,
    shore: Option<Shore>,
}

impl Terrain {
    /// The terrain that a scene asks for.
    #[must_use]
    pub fn new(spec: &SceneSpec) -> Self {
        let t = &spec.terrain;
        let mut draw = Draw::new(&[spec.seed, super::purpose::TERRAIN]);
        let azimuth = t.slope_azimuth_degrees.to_radians();
        let slope = t.slope_percent / 100.0;
        let mut waves: Vec<Wave> = (0..WAVES)
            .map(|i| {
                // Wave directions spread over the half circle, so that no scene is corrugated.
                let turn = (i as f64 + draw.range(0.1, 0.9)) / WAVES as f64;
                let angle = TAU / 2.0 * turn;
                let k = TAU / (t.wavelength_metres * draw.range(0.75, 1.6));
                Wave {
                    amplitude: draw.range(0.5, 1.0),
                    kx: k * libm::cos(angle),
                    ky: k * libm::sin(angle),
                    phase: draw.range(0.0, TAU),
                }
            })
            .collect();
        // Amplitudes sum to half the relief, which makes the relief a bound.
        let total: f64 = waves.iter().map(|w| w.amplitude).sum();
        for wave in &mut waves {
            wave.amplitude *= t.relief_metres / 2.0 / total;
        }
        // Level waves cost as much as high ones.
        waves.retain(|wave| wave.amplitude != 0.0);
        Self {
            base: t.base_height_metres,
            slope: [slope * libm::sin(azimuth), slope * libm::cos(azimuth)],
            waves,
            shore: spec.water.map(|w| Shore::new(&w, spec, &mut draw)),
        }
    }

    /// The land as it would be without water.
    fn land(&self, x: f64, y: f64) -> [f64; 3] {
        let mut sum =
            [self.base + self.slope[0] * x + self.slope[1] * y, self.slope[0], self.slope[1]];
        for wave in &self.waves {
            let w = wave.at(x, y);
            for i in 0..3 {
                sum[i] += w[i];
            }
        }
        sum
    }

    /// The ground at a point.
    #[must_use]
    pub fn at(&self, x: f64, y: f64) -> Ground {
        let [z, dx, dy] = self.land(x, y);
        let Some(shore) = &self.shore else { return Ground { z, dx, dy, water: false } };
        let [d, ddx, ddy] = shore.distance(x, y);
        if d < 0.0 {
            return Ground { z: shore.level, dx: 0.0, dy: 0.0, water: true };
        }
        if d >= shore.strip {
            return Ground { z, dx, dy, water: false };
        }
        let t = d / shore.strip;
        let blend = t * t * t * (t * (6.0 * t - 15.0) + 10.0);
        let rate = 30.0 * t * t * (t * (t - 2.0) + 1.0) / shore.strip;
        let beach = shore.level + BEACH_SLOPE * d;
        let along = BEACH_SLOPE * (1.0 - blend) + (z - beach) * rate;
        Ground {
            z: beach + (z - beach) * blend,
            dx: dx * blend + along * ddx,
            dy: dy * blend + along * ddy,
            water: false,
        }
    }

    /// Height of the ground, metres.
    #[must_use]
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.at(x, y).z
    }

    /// Distance inland from the shoreline, metres (negative over water, infinite without water).
    #[must_use]
    pub fn inland(&self, x: f64, y: f64) -> f64 {
        self.shore.as_ref().map_or(f64::INFINITY, |s| s.distance(x, y)[0])
    }

    /// Height of the water, metres.
    #[must_use]
    pub fn water_level(&self) -> Option<f64> {
        self.shore.as_ref().map(|s| s.level)
    }

    /// A bound on the slope within `reach` metres of the origin, rise per metre.
    #[must_use]
    pub fn steepest(&self, reach: f64) -> f64 {
        let waves: f64 = self.waves.iter().map(Wave::steepest).sum();
        let plane = libm::hypot(self.slope[0], self.slope[1]);
        let open = waves + plane;
        let Some(shore) = &self.shore else { return open };
        let bend: f64 = 1.0 + shore.swing.iter().map(Wave::steepest).sum::<f64>();
        let highest = self.base - shore.level
            + plane * reach
            + self.waves.iter().map(|w| w.amplitude).sum::<f64>();
        // The quintic smoothstep is steepest in the middle: 30 / 16 of its mean.
        open + bend * (BEACH_SLOPE + highest.max(0.0) * 1.875 / shore.strip)
    }

    /// The lowest that the land can be within `reach` metres of the origin, metres.
    #[must_use]
    pub fn lowest_land(&self, reach: f64) -> f64 {
        self.base
            - libm::hypot(self.slope[0], self.slope[1]) * reach
            - self.waves.iter().map(|w| w.amplitude).sum::<f64>()
    }
}

impl Shore {
    fn new(water: &WaterSpec, spec: &SceneSpec, draw: &mut Draw) -> Self {
        let extent = &spec.extent;
        let (inland, size) = match water.side {
            Side::South => ([0.0, 1.0], extent.height_metres),
            Side::North => ([0.0, -1.0], extent.height_metres),
            Side::West => ([1.0, 0.0], extent.width_metres),
            Side::East => ([-1.0, 0.0], extent.width_metres),
        };
        // Waves along the shore: their vector is at right angles to the inland direction.
        let swing = [170.0, 61.0, 23.0]
            .into_iter()
            .zip([0.62, 0.27, 0.11])
            .map(|(length, share)| {
                let k = TAU / (length * draw.range(0.8, 1.25));
                Wave {
                    amplitude: share * water.shoreline_swing_metres,
                    kx: k * inland[1],
                    ky: k * inland[0],
                    phase: draw.range(0.0, TAU),
                }
            })
            .collect();
        let drop = spec.terrain.base_height_metres - water.level_metres;
        Self {
            inland,
            offset: (water.share - 0.5) * size,
            level: water.level_metres,
            strip: LEAST_STRIP_M.max(STRIP_PER_METRE * drop),
            swing,
        }
    }

    /// Distance inland and its gradient.
    fn distance(&self, x: f64, y: f64) -> [f64; 3] {
        let mut d =
            [self.inland[0] * x + self.inland[1] * y - self.offset, self.inland[0], self.inland[1]];
        for wave in &self.swing {
            let w = wave.at(x, y);
            for i in 0..3 {
                d[i] -= w[i];
            }
        }
        d
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waterfront() -> Terrain {
        let mut spec = SceneSpec::default();
        spec.terrain.relief_metres = 20.0;
        spec.water = Some(WaterSpec::default());
        Terrain::new(&spec)
    }

    #[test]
    fn the_gradient_is_that_of_the_height() {
        let terrain = waterfront();
        let bound = terrain.steepest(250.0);
        let h = 1e-4;
        for i in 0..2000 {
            let mut draw = Draw::new(&[3, i]);
            let (x, y) = (draw.range(-150.0, 150.0), draw.range(-150.0, 150.0));
            let g = terrain.at(x, y);
            let dx = (terrain.height(x + h, y) - terrain.height(x - h, y)) / (2.0 * h);
            let dy = (terrain.height(x, y + h) - terrain.height(x, y - h)) / (2.0 * h);
            if terrain.inland(x, y).abs() > 0.01 {
                assert!((g.dx - dx).abs() < 1e-6 && (g.dy - dy).abs() < 1e-6, "{x} {y}");
            }
            assert!(libm::hypot(g.dx, g.dy) <= bound);
            assert_eq!(g.water, terrain.inland(x, y) < 0.0);
            assert!(g.z >= 5.0);
        }
    }

    #[test]
    fn a_plane_is_a_plane_in_closed_form() {
        let mut spec = SceneSpec::default();
        spec.terrain.relief_metres = 0.0;
        spec.terrain.slope_percent = 10.0;
        spec.terrain.slope_azimuth_degrees = 90.0;
        let terrain = Terrain::new(&spec);
        for (x, y) in [(0.0, 0.0), (30.0, -20.0), (-100.0, 55.0)] {
            assert!((terrain.height(x, y) - (40.0 + 0.1 * x)).abs() < 1e-12);
        }
        assert!((terrain.steepest(0.0) - 0.1).abs() < 1e-12);
        assert_eq!(terrain.inland(0.0, 0.0), f64::INFINITY);
    }

    #[test]
    fn the_shore_meets_the_water_without_a_step() {
        let terrain = waterfront();
        for y in [-80.0, 0.0, 63.0] {
            let mut x = -140.0;
            while terrain.inland(x, y) < 0.0 {
                x += 1e-3;
            }
            assert!((terrain.height(x, y) - 5.0).abs() < 1e-3, "{y}");
        }
    }
}
