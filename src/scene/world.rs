//! The solids of one epoch behind a spatial index: what is on top over a point, what a ray meets.

use super::index::CellGrid;
use super::object::{Class, Finish, Object};
use super::shape::Bounds;
use super::solid::{Face, Ray, Shape};
use std::ops::ControlFlow;

/// A solid in the index.
#[derive(Clone, Debug)]
pub struct Solid {
    /// Number of the object it is a part of.
    pub object: u32,
    /// What it belongs to.
    pub class: Class,
    /// How it looks.
    pub finish: Finish,
    /// Its geometry.
    pub shape: Shape,
    highest: f64,
    /// Whether it casts a shadow that shows.
    casts: bool,
}

/// Light from a point source at infinity: a ray's change per metre of path, in the local frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SunRay {
    /// Towards the sun: east, north (grid metres), up, per metre of path.
    pub step: [f64; 3],
    /// How much a straight ray gains on the level surface, metres per squared metre of path:
    /// `cos(elevation)^2 / 2R`, or 0 on a flat Earth.
    pub curvature: f64,
}

/// A point of the scene as the satellite sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Index of the solid in [`World::solids`]; the ground when `None`.
    pub solid: Option<u32>,
    /// Face of the solid.
    pub face: Face,
    /// Where: x, y, z, metres in the local frame.
    pub at: [f64; 3],
}

/// Path over which a ray may touch the surface that it starts from, metres.
const CLEARANCE_M: f64 = 1e-3;

/// Whether a solid is so thin that the sun, half a degree wide, is seen on both sides of it from the ground.
fn is_wire(shape: &Shape) -> bool {
    match shape {
        Shape::Prism(p) => p.rect.half_u.min(p.rect.half_v) < 0.065 && p.highest() - p.bottom < 0.9,
        Shape::Cylinder(_) | Shape::Crown(_) => false,
    }
}

/// All solids of one epoch.
#[derive(Clone, Debug)]
pub struct World {
    /// Solids, the highest first.
    pub solids: Vec<Solid>,
    grid: CellGrid,
    /// Highest solid of each cell of the grid.
    tops: Vec<f64>,
    highest: f64,
}

impl World {
    /// Indexes the solids of objects over an area.
    #[must_use]
    pub fn new(objects: impl IntoIterator<Item = Object>, area: Bounds) -> Self {
        let mut solids: Vec<Solid> = objects
            .into_iter()
            .flat_map(|object| {
                object.parts.into_iter().map(move |part| Solid {
                    object: object.id,
                    class: part.class,
                    finish: part.finish,
                    highest: part.shape.highest(),
                    casts: !is_wire(&part.shape),
                    shape: part.shape,
                })
            })
            .collect();
        // A stable sort: among solids of one height the order of the objects decides.
        solids.sort_by(|a, b| b.highest.total_cmp(&a.highest));
        let boxes: Vec<Bounds> = solids.iter().map(|s| s.shape.bounds()).collect();
        let grid = CellGrid::new(area, &boxes);
        let tops = (0..grid.cells())
            .map(|cell| {
                grid.in_cell(cell)
                    .first()
                    .map_or(f64::NEG_INFINITY, |s| solids[*s as usize].highest)
            })
            .collect();
        let highest = solids.first().map_or(f64::NEG_INFINITY, |s| s.highest);
        Self { solids, grid, tops, highest }
    }

    /// Height of the highest solid, metres; negative infinity when there is none.
    #[must_use]
    pub const fn highest(&self) -> f64 {
        self.highest
    }

    /// The highest solid over a point, its height and face, among those that `keep` accepts.
    #[must_use]
    pub fn top(&self, x: f64, y: f64, keep: impl Fn(Class) -> bool) -> Option<(u32, f64, Face)> {
        let mut best: Option<(u32, f64, Face)> = None;
        for &index in self.grid.over(x, y) {
            let solid = &self.solids[index as usize];
            let high = best.map_or(f64::NEG_INFINITY, |b| b.1);
            // Sorted by height: nothing that follows can be higher.
            if solid.highest <= high {
                break;
            }
            if let Some((z, face)) = solid.shape.top(x, y)
                && z > high
                && keep(solid.class)
            {
                best = Some((index, z, face));
            }
        }
        best
    }

    /// Whether a solid stands between a point and the sun.
    #[must_use]
    pub fn shadowed(&self, from: [f64; 3], sun: &SunRay) -> bool {
        let [dx, dy, dz] = sun.step;
        let end = (self.highest - from[2]) / dz;
        if end <= 0.0 {
            return false;
        }
        self.grid
            .along([from[0], from[1]], [dx, dy], end, |cell, enter, exit| {
                // The parabola of a ray over a curved Earth is its tangent in the middle of the
                // cell, to within a few micrometres.
                let middle = 0.5 * (enter + exit);
                let ray = Ray {
                    from: [from[0], from[1], from[2] - sun.curvature * middle * middle],
                    step: [dx, dy, dz + 2.0 * sun.curvature * middle],
                };
                if self.tops[cell] > from[2] + enter * dz
                    && self
                        .grid
                        .in_cell(cell)
                        .iter()
                        .map(|s| &self.solids[*s as usize])
                        .any(|s| s.casts && s.shape.blocks(&ray, CLEARANCE_M))
                {
                    return ControlFlow::Break(());
                }
                ControlFlow::Continue(())
            })
            .is_some()
    }

    /// The first solid that a ray meets from outside between two parameters, and where: parameter and
    /// what is seen there. The ray may run in any direction.
    #[must_use]
    pub fn hit(&self, ray: &Ray, after: f64, until: f64) -> Option<(f64, Seen)> {
        let [dx, dy, dz] = ray.step;
        let mut best: Option<(f64, u32, Face)> = None;
        let height = |t: f64| ray.from[2] + t * dz;
        let _: Option<()> =
            self.grid.along([ray.from[0], ray.from[1]], [dx, dy], until, |cell, enter, exit| {
                // Sorted by height: where the ray is above one, it is above those that follow.
                let low = height(enter).min(height(exit)) - CLEARANCE_M;
                for &index in self.grid.in_cell(cell) {
                    let solid = &self.solids[index as usize];
                    if solid.highest < low {
                        break;
                    }
                    if let Some((t, face)) = solid.shape.enter(ray, after)
                        && t <= until
                        && best.is_none_or(|b| t < b.0)
                    {
                        best = Some((t, index, face));
                    }
                }
                // What begins beyond this cell may still be behind something in the next.
                if best.is_some_and(|b| b.0 <= exit) {
                    return ControlFlow::Break(());
                }
                ControlFlow::Continue(())
            });
        best.map(|(t, index, face)| (t, Seen { solid: Some(index), face, at: ray.at(t) }))
    }

    /// What a distant satellite sees in the direction of a point of the ground: `lean` is the
    /// horizontal way towards the satellite per metre of height.
    #[must_use]
    pub fn seen(&self, ground: [f64; 3], lean: [f64; 2]) -> Seen {
        let mut best: Option<(u32, f64, Face)> = None;
        let ray = Ray { from: ground, step: [lean[0], lean[1], 1.0] };
        let end = self.highest - ground[2];
        if end > 0.0 {
            let _: Option<()> = self.grid.along([ground[0], ground[1]], lean, end, |cell, _, _| {
                for &index in self.grid.in_cell(cell) {
                    let solid = &self.solids[index as usize];
                    let high = best.map_or(0.0, |b| b.1);
                    if solid.highest - ground[2] <= high {
                        break;
                    }
                    if let Some(span) = solid.shape.clip(&ray)
                        && span.exit > high
                    {
                        best = Some((index, span.exit, span.exit_face));
                    }
                }
                ControlFlow::Continue(())
            });
        }
        let Some((index, t, face)) = best else {
            return Seen { solid: None, face: Face::Top(0), at: ground };
        };
        let [x, y, z] = ray.at(t);
        let solid = &self.solids[index as usize];
        // On a top face the height function is the authority: a satellite at nadir then sees
        // exactly the surface, bit for bit.
        let z = match (face, solid.shape.top(x, y)) {
            (Face::Top(_), Some((top, f))) if f == face && (top - z).abs() < 1e-6 => top,
            _ => z,
        };
        Seen { solid: Some(index), face, at: [x, y, z] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;
    use crate::scene::object::{Kind, Part, rgb};
    use crate::scene::shape::Rect;
    use crate::scene::solid::{Crown, Cylinder, Prism, Puff, flat};

    fn block(id: u32, x: f64, y: f64, half: f64, bottom: f64, top: f64) -> Object {
        let rect = Rect::new([x, y], [1.0, 0.0], half, half);
        let part = Part {
            class: Class::Building,
            finish: Finish::Plain { colour: rgb(1, 2, 3) },
            shape: Shape::Prism(Prism { rect, bottom, roof: flat(top) }),
        };
        Object { id, kind: Kind::Building, only: None, parts: vec![part] }
    }

    fn area() -> Bounds {
        Bounds::around(0.0, 0.0, 100.0)
    }

    fn random_world(seed: u64) -> World {
        let mut draw = Draw::new(&[seed]);
        let objects: Vec<Object> = (0..120)
            .map(|id| {
                let (x, y) = (draw.range(-95.0, 95.0), draw.range(-95.0, 95.0));
                let bottom = draw.pick([0.0, 4.0]);
                block(id, x, y, draw.range(0.5, 6.0), bottom, bottom + draw.range(1.0, 30.0))
            })
            .collect();
        World::new(objects, area())
    }

    #[test]
    fn the_index_finds_what_a_search_over_all_solids_finds() {
        let world = random_world(4);
        let (mut hits, mut dark) = (0, 0);
        for i in 0..4000 {
            let mut draw = Draw::new(&[9, i]);
            let (x, y) = (draw.range(-99.0, 99.0), draw.range(-99.0, 99.0));
            let all = world.solids.iter().filter_map(|s| s.shape.top(x, y)).map(|t| t.0);
            let expected = all.fold(f64::NEG_INFINITY, f64::max);
            let found = world.top(x, y, |_| true).map_or(f64::NEG_INFINITY, |t| t.1);
            assert_eq!(found, expected);
            hits += usize::from(found > 0.0);

            let z = found.max(0.0);
            let (e, a) = (draw.range(0.05, 1.5), draw.range(0.0, 6.3));
            let step = [libm::cos(e) * libm::sin(a), libm::cos(e) * libm::cos(a), libm::sin(e)];
            let sun = SunRay { step, curvature: 0.0 };
            let ray = Ray { from: [x, y, z], step };
            let expected = world.solids.iter().any(|s| s.shape.blocks(&ray, CLEARANCE_M));
            assert_eq!(world.shadowed([x, y, z], &sun), expected);
            dark += usize::from(expected);

            let lean = [draw.range(-0.6, 0.6), draw.range(-0.6, 0.6)];
            let ray = Ray { from: [x, y, 0.0], step: [lean[0], lean[1], 1.0] };
            let exits = world.solids.iter().filter_map(|s| s.shape.clip(&ray)).map(|s| s.exit);
            let expected = exits.fold(0.0, f64::max);
            let seen = world.seen([x, y, 0.0], lean);
            assert!((seen.at[2] - expected).abs() < 1e-9);
        }
        assert!(hits > 300 && dark > 300, "{hits} {dark}");
    }

    /// A world of prisms, cylinders and crowns.
    fn mixed_world(seed: u64) -> World {
        let mut draw = Draw::new(&[seed, 1]);
        let objects = (0..150).map(|id| {
            let (x, y) = (draw.range(-95.0, 95.0), draw.range(-95.0, 95.0));
            if id % 3 == 0 {
                return block(id, x, y, draw.range(0.5, 6.0), -1.0, draw.range(1.0, 20.0));
            }
            let shape = if id % 3 == 1 {
                let (bottom, radius) = (draw.range(-1.0, 4.0), draw.range(0.1, 3.0));
                Shape::Cylinder(Cylinder { x, y, radius, bottom, top: bottom + 6.0 })
            } else {
                let puffs: Vec<Puff> = (0..6)
                    .map(|_| Puff {
                        center: [
                            x + draw.range(-2.0, 2.0),
                            y + draw.range(-2.0, 2.0),
                            draw.range(2.0, 8.0),
                        ],
                        radius: draw.range(0.5, 1.5),
                        half_height: draw.range(0.5, 1.5),
                    })
                    .collect();
                let (radius, bottom, top) = (4.5, 0.0, 9.5);
                Shape::Crown(Crown { x, y, radius, bottom, top, puffs, porosity: 0.0, pattern: 1 })
            };
            let finish = Finish::Plain { colour: rgb(1, 2, 3) };
            let parts = vec![Part { class: Class::Tree, finish, shape }];
            Object { id, kind: Kind::Building, only: None, parts }
        });
        World::new(objects.collect::<Vec<_>>(), area())
    }

    #[test]
    fn a_ray_hits_first_what_a_search_over_all_solids_finds_first() {
        let world = mixed_world(5);
        let mut hits = 0;
        for i in 0..6000 {
            let mut draw = Draw::new(&[21, i]);
            let from = [0, 1, 2]
                .map(|k| if k < 2 { draw.range(-105.0, 105.0) } else { draw.range(-2.0, 25.0) });
            let (e, a) = (draw.range(-1.6, 1.6), draw.range(0.0, 6.3));
            let step = draw.pick([
                [libm::cos(e) * libm::sin(a), libm::cos(e) * libm::cos(a), libm::sin(e)],
                [libm::sin(a), libm::cos(a), 0.0],
                [1.0, 0.0, 0.0],
            ]);
            let ray = Ray { from, step };
            let until = draw.range(1.0, 250.0);
            let after = draw.pick([0.0, 1e-3, 5.0]);
            let expected = world
                .solids
                .iter()
                .filter_map(|s| s.shape.enter(&ray, after))
                .map(|h| h.0)
                .filter(|t| *t <= until)
                .fold(f64::INFINITY, f64::min);
            let found = world.hit(&ray, after, until);
            let inside = expected.is_infinite() || {
                // What lies outside the indexed area is not found.
                let [x, y, _] = ray.at(expected);
                area().contains(x, y)
            };
            if inside {
                assert_eq!(found.map_or(f64::INFINITY, |h| h.0), expected, "{ray:?}");
            }
            let Some((t, seen)) = found else { continue };
            hits += 1;
            // The point lies on the solid's surface, and the face looks towards the start.
            let solid = &world.solids[seen.solid.expect("a solid") as usize];
            let n = solid.shape.normal(seen.face, seen.at);
            assert!((0..3).map(|k| n[k] * step[k]).sum::<f64>() <= 1e-9, "{seen:?}");
            let just_before = ray.at(t - 1e-6);
            let over = solid.shape.top(just_before[0], just_before[1]);
            if let (Face::Top(_), Some((z, _)), Shape::Prism(_)) = (seen.face, over, &solid.shape) {
                assert!(just_before[2] >= z - 1e-9);
            }
        }
        assert!(hits > 800, "{hits}");
    }

    #[test]
    fn from_above_a_ray_hits_the_top_and_along_the_lean_what_the_satellite_sees() {
        let world = random_world(9);
        let (mut tops, mut leaning) = (0, 0);
        for i in 0..4000 {
            let mut draw = Draw::new(&[22, i]);
            let (x, y) = (draw.range(-95.0, 95.0), draw.range(-95.0, 95.0));
            let down = Ray { from: [x, y, 500.0], step: [0.0, 0.0, -1.0] };
            let hit = world.hit(&down, 0.0, 600.0).map(|h| h.1);
            let top = world.top(x, y, |_| true);
            assert_eq!(hit.map(|s| s.solid), top.map(|t| Some(t.0)));
            if let (Some(seen), Some((_, z, face))) = (hit, top) {
                tops += 1;
                assert!((seen.at[2] - z).abs() < 1e-9 && seen.face == face);
            }
            let lean = [draw.range(-0.5, 0.5), draw.range(-0.5, 0.5)];
            let ground = [x, y, 0.0];
            let seen = world.seen(ground, lean);
            let towards = Ray {
                from: [x + 60.0 * lean[0], y + 60.0 * lean[1], 60.0],
                step: [-lean[0], -lean[1], -1.0],
            };
            if !area().contains(towards.from[0], towards.from[1]) {
                continue;
            }
            match world.hit(&towards, 0.0, 60.0 - 1e-9) {
                Some((_, hit)) => {
                    leaning += 1;
                    assert_eq!(hit.solid, seen.solid, "{ground:?} {lean:?}");
                    assert!((0..3).all(|k| (hit.at[k] - seen.at[k]).abs() < 1e-6));
                }
                None => assert_eq!(seen.solid, None),
            }
        }
        assert!(tops > 300 && leaning > 500, "{tops} {leaning}");
    }

    #[test]
    fn from_the_nadir_the_satellite_sees_the_surface_bit_for_bit() {
        let world = random_world(8);
        for i in 0..4000 {
            let mut draw = Draw::new(&[10, i]);
            let (x, y) = (draw.range(-99.0, 99.0), draw.range(-99.0, 99.0));
            let ground = draw.range(-1.0, 0.0);
            let seen = world.seen([x, y, ground], [0.0, 0.0]);
            match world.top(x, y, |_| true) {
                Some((solid, z, face)) => {
                    assert_eq!(seen, Seen { solid: Some(solid), face, at: [x, y, z] });
                }
                None => assert_eq!(seen.solid, None),
            }
        }
    }

    #[test]
    fn a_wall_casts_its_height_over_the_tangent_of_the_suns_elevation() {
        let world = World::new([block(0, 0.0, 0.0, 5.0, -1.0, 12.0)], area());
        for degrees in [15.0_f64, 35.0, 60.0, 85.0] {
            let (sin, cos) = libm::sincos(degrees.to_radians());
            // The sun in the south: shadows fall north of the northern wall, at y = 5.
            let sun = SunRay { step: [0.0, -cos, sin], curvature: 0.0 };
            let length = 12.0 * cos / sin;
            let dark = |y: f64| world.shadowed([0.0, y, 0.0], &sun);
            assert!(dark(5.0 + length - 1e-6) && !dark(5.0 + length + 1e-6), "{degrees}");
            assert!(!world.shadowed([0.0, -5.1, 0.0], &sun));
            assert!(!world.shadowed([1.0, 1.0, 12.0], &sun), "a roof does not shade itself");
        }
        let zenith = SunRay { step: [0.0, 0.0, 1.0], curvature: 0.0 };
        assert!(!world.shadowed([0.0, 5.01, 0.0], &zenith));
    }

    #[test]
    fn the_curved_earth_shortens_a_long_shadow_by_what_the_parabola_says() {
        let radius = 6.37e6;
        let long = Bounds { west: -50.0, south: -20.0, east: 50.0, north: 9000.0 };
        let world = World::new([block(0, 0.0, 0.0, 5.0, -1.0, 60.0)], long);
        let (sin, cos) = libm::sincos(0.6_f64.to_radians());
        let edge = |curvature: f64| {
            let sun = SunRay { step: [0.0, -cos, sin], curvature };
            let (mut low, mut high) = (5.1, 8900.0);
            while high - low > 1e-7 {
                let middle = 0.5 * (low + high);
                if world.shadowed([0.0, middle, 0.0], &sun) { low = middle } else { high = middle }
            }
            low - 5.0
        };
        let flat = edge(0.0);
        assert!((flat - 60.0 * cos / sin).abs() < 1e-5);
        // 60 = s tan(e) + s^2 / 2R.
        let tan = sin / cos;
        let s = radius * (-tan + (tan * tan + 2.0 * 60.0 / radius).sqrt());
        let curved = edge(cos * cos / (2.0 * radius));
        assert!((curved - s).abs() < 2e-3, "{curved} {s}");
        assert!(flat - curved > 100.0);
    }
}
