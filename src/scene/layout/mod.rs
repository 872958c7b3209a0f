//! Where everything stands: blocks get a use, and each use fills its blocks with objects.
//!
//! Every object draws its numbers from a sequence named by the seed, a purpose and its place in the
//! plan (block, lot, slot), so that nothing depends on what was laid out before it.

mod city;
mod detail;
mod open;
mod plants;
mod suburb;
mod traffic;

pub(in crate::scene) use city::STALL_WIDTH_M;

use super::object::{Cover, Epoch, Kind, Object, Part, Patch};
use super::purpose;
use super::shape::{Bounds, Rect};
use super::spec::SceneSpec;
use super::streets::{BlockArea, Streets};
use super::terrain::Terrain;
use crate::random::{Draw, key};
use serde::Serialize;
use std::collections::BTreeMap;

/// What a block is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Use {
    /// Towers, midrise houses, plazas.
    Downtown,
    /// Large shops and their parking lots.
    Commercial,
    /// Sheds, tanks, containers.
    Industrial,
    /// Family houses.
    Suburb,
    /// Lawns, trees, courts.
    Park,
    /// Closed forest.
    Forest,
    /// Railway tracks.
    Railway,
}

impl Use {
    /// Cover of the ground where nothing else is painted.
    #[must_use]
    pub const fn cover(self) -> Cover {
        match self {
            Self::Downtown => Cover::Paving,
            Self::Commercial => Cover::Asphalt,
            Self::Industrial => Cover::Gravel,
            Self::Suburb => Cover::Lawn,
            Self::Park => Cover::Meadow,
            Self::Forest => Cover::Litter,
            Self::Railway => Cover::Gravel,
        }
    }
}

/// Distance from the shoreline within which nothing is built and streets end, metres.
pub const SHORE_STRIP_M: f64 = 9.0;

/// The plan of a scene.
#[derive(Clone, Debug)]
pub struct Layout {
    /// All objects, of both epochs.
    pub objects: Vec<Object>,
    /// Painted ground, in order of painting.
    pub patches: Vec<Patch>,
    /// Use of each block, by the numbers of the streets at its left and lower end.
    pub uses: BTreeMap<[i64; 2], Use>,
}

/// Lays out a scene. Objects lie in `area` (metres, local frame).
#[must_use]
pub fn lay_out(
    spec: &SceneSpec,
    terrain: &Terrain,
    streets: &Streets,
    area: Bounds,
    two_epochs_of_cars: bool,
) -> Layout {
    let blocks: Vec<BlockArea> = streets
        .blocks()
        .into_iter()
        .filter(|b| b.s1 - b.s0 > 12.0 && b.t1 - b.t0 > 12.0)
        .filter(|b| reaches(streets, b, &area))
        .collect();
    let uses = assign_uses(spec, streets, &blocks);
    let mut builder = Builder {
        spec,
        terrain,
        streets,
        area,
        car_epochs: if two_epochs_of_cars {
            vec![Some(Epoch::Lidar), Some(Epoch::Image)]
        } else {
            vec![None]
        },
        objects: Vec::new(),
        patches: Vec::new(),
    };
    for block in &blocks {
        match uses[&block.index] {
            Use::Downtown => city::downtown(&mut builder, block),
            Use::Commercial => city::commercial(&mut builder, block),
            Use::Industrial => city::industrial(&mut builder, block),
            Use::Suburb => suburb::fill(&mut builder, block),
            Use::Park => open::park(&mut builder, block),
            Use::Forest => open::forest(&mut builder, block),
            Use::Railway => detail::railway(&mut builder, block),
        }
    }
    traffic::along_streets(&mut builder, &uses);
    open::waterfront(&mut builder);
    Layout { objects: builder.objects, patches: builder.patches, uses }
}

/// Whether any of a block may lie in the area.
fn reaches(streets: &Streets, b: &BlockArea, area: &Bounds) -> bool {
    let corners = [(b.s0, b.t0), (b.s1, b.t0), (b.s0, b.t1), (b.s1, b.t1)]
        .map(|(s, t)| streets.to_local(s, t));
    let low = corners.iter().fold([f64::INFINITY; 2], |m, c| [m[0].min(c[0]), m[1].min(c[1])]);
    let high = corners.iter().fold([f64::NEG_INFINITY; 2], |m, c| [m[0].max(c[0]), m[1].max(c[1])]);
    low[0] < area.east && high[0] > area.west && low[1] < area.north && high[1] > area.south
}

/// Gives each block a use so that the numbers of blocks follow the weights as closely as they
/// can, and the dense uses lie together around a random middle.
fn assign_uses(
    spec: &SceneSpec,
    streets: &Streets,
    blocks: &[BlockArea],
) -> BTreeMap<[i64; 2], Use> {
    let b = &spec.blocks;
    let weights = [
        (Use::Downtown, b.downtown),
        (Use::Commercial, b.commercial),
        (Use::Industrial, b.industrial),
        (Use::Suburb, b.suburb),
        (Use::Park, b.park),
        (Use::Forest, b.forest),
        (Use::Railway, spec.detail.map_or(0.0, |d| d.railway)),
    ];
    let total: f64 = weights.iter().map(|w| w.1).sum();
    let reach = spec.extent.width_metres.max(spec.extent.height_metres);
    let mut draw = Draw::new(&[spec.seed, purpose::USES]);
    let middle = [draw.range(-0.35, 0.35) * reach, draw.range(-0.35, 0.35) * reach];
    let mut ranked: Vec<(f64, [i64; 2])> = blocks
        .iter()
        .map(|block| {
            let [x, y] = streets.to_local((block.s0 + block.s1) / 2.0, (block.t0 + block.t1) / 2.0);
            let [i, j] = block.index.map(i64::cast_unsigned);
            let jitter = Draw::new(&[spec.seed, purpose::USES, i, j]).range(0.0, 0.55);
            (libm::hypot(x - middle[0], y - middle[1]) / reach + jitter, block.index)
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let count = ranked.len() as f64;
    ranked
        .iter()
        .enumerate()
        .map(|(rank, (_, index))| {
            let share = (rank as f64 + 0.5) / count * total;
            let mut sum = 0.0;
            let chosen = weights.iter().find(|(_, weight)| {
                sum += weight;
                share < sum
            });
            (*index, chosen.map_or(Use::Suburb, |c| c.0))
        })
        .collect()
}

/// What the uses build with.
struct Builder<'a> {
    spec: &'a SceneSpec,
    terrain: &'a Terrain,
    streets: &'a Streets,
    area: Bounds,
    car_epochs: Vec<Option<Epoch>>,
    objects: Vec<Object>,
    patches: Vec<Patch>,
}

impl Builder<'_> {
    /// The private random sequence of something named by a purpose and numbers.
    fn draw(&self, purpose: u64, parts: &[i64]) -> Draw {
        let place = key(&parts.iter().map(|p| p.cast_unsigned()).collect::<Vec<_>>());
        Draw::new(&[self.spec.seed, purpose, place])
    }

    fn add(&mut self, kind: Kind, parts: Vec<Part>) {
        self.add_at(kind, None, parts);
    }

    fn add_at(&mut self, kind: Kind, only: Option<Epoch>, parts: Vec<Part>) {
        if !parts.is_empty() {
            let id = self.objects.len() as u32;
            self.objects.push(Object { id, kind, only, parts });
        }
    }

    /// Paints a rectangle, if any of it is on land.
    fn paint(&mut self, rect: Rect, cover: Cover) {
        let seed = self.patches.len() as u32;
        self.patches.push(Patch { rect, cover, seed });
    }

    fn ground(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y)
    }

    /// Lowest and highest ground under a rectangle's corners and centre, metres.
    fn ground_under(&self, rect: &Rect) -> (f64, f64) {
        let centre = self.ground(rect.x, rect.y);
        rect.corners().iter().fold((centre, centre), |(low, high), c| {
            let z = self.ground(c[0], c[1]);
            (low.min(z), high.max(z))
        })
    }

    /// Whether a point lies in the area and at least `strip` metres from the shore.
    fn is_land(&self, x: f64, y: f64, strip: f64) -> bool {
        self.area.contains(x, y) && self.terrain.inland(x, y) >= strip
    }

    /// Whether a rectangle can be built on: all of it inside the area and away from the shore.
    fn can_build(&self, rect: &Rect) -> bool {
        rect.corners().iter().all(|c| self.is_land(c[0], c[1], SHORE_STRIP_M + 3.0))
    }

    /// The rectangle of a block part given in street coordinates; u runs along family 0.
    fn street_rect(&self, s: [f64; 2], t: [f64; 2]) -> Rect {
        let center = self.streets.to_local((s[0] + s[1]) / 2.0, (t[0] + t[1]) / 2.0);
        Rect::new(center, self.streets.axis, (t[1] - t[0]) / 2.0, (s[1] - s[0]) / 2.0)
    }
}

/// A lot's own axes: `w` along its street, `d` into the lot; the origin is the middle of its front.
#[derive(Clone, Copy, Debug)]
struct Frame {
    origin: [f64; 2],
    along: [f64; 2],
    into: [f64; 2],
}

impl Frame {
    fn at(&self, w: f64, d: f64) -> [f64; 2] {
        [0, 1].map(|i| self.origin[i] + w * self.along[i] + d * self.into[i])
    }

    /// A rectangle with sides along the lot's axes; u runs along the street.
    fn rect(&self, w: f64, d: f64, half_w: f64, half_d: f64) -> Rect {
        Rect::new(self.at(w, d), self.along, half_w, half_d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(spec: &SceneSpec) -> Layout {
        let area = Bounds { west: -180.0, south: -180.0, east: 180.0, north: 180.0 };
        let streets = Streets::new(&spec.streets, spec.seed, 260.0);
        lay_out(spec, &Terrain::new(spec), &streets, area, false)
    }

    #[test]
    fn uses_follow_the_weights() {
        let mut spec = SceneSpec::default();
        spec.blocks.downtown = 0.0;
        spec.blocks.forest = 0.0;
        let plan = layout(&spec);
        let count = |u: Use| plan.uses.values().filter(|v| **v == u).count();
        assert_eq!(count(Use::Downtown) + count(Use::Forest), 0);
        assert!(count(Use::Suburb) > count(Use::Commercial));
        assert!(count(Use::Commercial) >= 1);
    }

    #[test]
    fn the_same_seed_gives_the_same_plan_and_another_seed_another() {
        let spec = SceneSpec::default();
        let (a, b) = (layout(&spec), layout(&spec));
        assert_eq!(a.objects, b.objects);
        assert_eq!(a.patches, b.patches);
        let other = layout(&SceneSpec { seed: 2, ..spec });
        assert_ne!(a.objects, other.objects);
        assert!(a.objects.len() > 300, "{}", a.objects.len());
    }

    #[test]
    fn buildings_stand_off_the_streets_and_on_land() {
        let mut spec = SceneSpec {
            water: Some(super::super::spec::WaterSpec::default()),
            ..SceneSpec::default()
        };
        spec.terrain.base_height_metres = 20.0;
        let plan = layout(&spec);
        let terrain = Terrain::new(&spec);
        let streets = Streets::new(&spec.streets, spec.seed, 260.0);
        let mut seen = 0;
        for object in plan.objects.iter().filter(|o| o.kind == Kind::Building) {
            for part in &object.parts {
                let b = part.shape.bounds();
                let (x, y) = ((b.west + b.east) / 2.0, (b.south + b.north) / 2.0);
                assert!(streets.locate(x, y).kerb > 2.0, "{object:?}");
                assert!(terrain.inland(x, y) > SHORE_STRIP_M);
                seen += 1;
            }
        }
        assert!(seen > 30, "{seen}");
    }
}
