//! Trees, shrubs and hedges: crowns of spheroids over empty space, on trunks.

use super::Builder;
use crate::random::Draw;
use crate::scene::object::{Class, Colour, Finish, Kind, Part, rgb};
use crate::scene::shape::Rect;
use crate::scene::solid::{Crown, Cylinder, Prism, Puff, Shape, flat};
use crate::scene::spec::Season;
use std::f64::consts::TAU;

impl Builder<'_> {
    /// Plants a tree of a size class: `scale` 1 is the highest of the scene.
    pub(super) fn plant_tree(&mut self, draw: &mut Draw, x: f64, y: f64, scale: f64) {
        if !self.is_land(x, y, 2.5) {
            return;
        }
        let conifer = draw.chance(self.spec.trees.conifer_share);
        let height = (self.spec.trees.height_metres * scale * draw.range(0.55, 1.0)).max(2.0);
        let ground = self.ground(x, y);
        let season = self.spec.images.season;
        let (kind, parts) = if conifer {
            (Kind::Conifer, conifer_parts(draw, [x, y, ground], height))
        } else {
            let lush = self.spec.detail.is_some();
            (Kind::Broadleaf, broadleaf_parts(draw, [x, y, ground], height, season, lush))
        };
        self.add(kind, parts);
    }

    /// Plants a shrub about a metre high.
    pub(super) fn plant_shrub(&mut self, draw: &mut Draw, x: f64, y: f64) {
        if !self.is_land(x, y, 2.5) {
            return;
        }
        let radius = draw.range(0.35, 0.95);
        let ground = self.ground(x, y);
        let puffs = (0..2 + draw.index(3))
            .map(|_| {
                let angle = draw.range(0.0, TAU);
                let off = radius * draw.range(0.0, 0.6);
                let r = radius * draw.range(0.5, 0.8);
                Puff {
                    center: [
                        x + off * libm::cos(angle),
                        y + off * libm::sin(angle),
                        ground + 0.55 * r,
                    ],
                    radius: r,
                    half_height: r * draw.range(0.8, 1.2),
                }
            })
            .collect();
        let base = pick_shrub(draw);
        let colour = jitter(draw, base, 0.25);
        let part = crown_part(x, y, puffs, colour, draw);
        self.add(Kind::Shrub, vec![part]);
    }

    /// A clipped hedge along a rectangle.
    pub(super) fn plant_hedge(&mut self, draw: &mut Draw, rect: Rect) {
        if !self.can_build(&rect) {
            return;
        }
        let (low, _) = self.ground_under(&rect);
        let top = self.ground(rect.x, rect.y) + draw.range(0.9, 2.0);
        let colour = jitter(draw, rgb(52, 84, 38), 0.2);
        let shape = Shape::Prism(Prism { rect, bottom: low - 0.3, roof: flat(top) });
        let finish = Finish::Foliage { colour, seed: draw.bits() as u32 };
        self.add(Kind::Shrub, vec![Part { class: Class::Tree, finish, shape }]);
    }
}

fn pick_shrub(draw: &mut Draw) -> Colour {
    draw.pick([
        rgb(58, 92, 40),
        rgb(78, 104, 48),
        rgb(46, 76, 44),
        rgb(98, 108, 56),
        rgb(108, 70, 62),
    ])
}

/// A colour made lighter or darker, and each channel a little different.
pub(super) fn jitter(draw: &mut Draw, colour: Colour, by: f64) -> Colour {
    let scale = 1.0 + by * draw.range(-1.0, 1.0);
    colour.map(|c| ((f64::from(c)) * scale * (1.0 + 0.25 * by * draw.range(-1.0, 1.0))) as f32)
}

fn broadleaf_colour(draw: &mut Draw, season: Season) -> Colour {
    let base = match season {
        Season::Spring => {
            draw.pick([rgb(104, 140, 58), rgb(88, 128, 52), rgb(128, 152, 74), rgb(168, 140, 148)])
        }
        Season::Summer => draw.pick([
            rgb(74, 106, 44),
            rgb(86, 116, 48),
            rgb(62, 92, 42),
            rgb(102, 122, 56),
            rgb(92, 104, 46),
            rgb(56, 84, 46),
        ]),
        Season::Autumn => draw.pick([
            rgb(168, 112, 40),
            rgb(146, 74, 36),
            rgb(122, 110, 46),
            rgb(184, 138, 52),
            rgb(92, 106, 48),
            rgb(128, 52, 38),
        ]),
        Season::Winter => draw.pick([rgb(112, 100, 88), rgb(98, 88, 78), rgb(124, 112, 98)]),
    };
    jitter(draw, base, 0.22)
}

fn crown_part(x: f64, y: f64, puffs: Vec<Puff>, colour: Colour, draw: &mut Draw) -> Part {
    let reach = |p: &Puff| libm::hypot(p.center[0] - x, p.center[1] - y) + p.radius;
    let crown = Crown {
        x,
        y,
        radius: puffs.iter().map(reach).fold(0.0, f64::max),
        bottom: puffs.iter().map(|p| p.center[2] - p.half_height).fold(f64::INFINITY, f64::min),
        top: puffs.iter().map(|p| p.center[2] + p.half_height).fold(f64::NEG_INFINITY, f64::max),
        puffs,
        porosity: 0.0,
        pattern: draw.bits() as u32,
    };
    let finish = Finish::Foliage { colour, seed: crown.pattern };
    Part { class: Class::Tree, finish, shape: Shape::Crown(crown) }
}

fn trunk(at: [f64; 3], height: f64, top: f64) -> Part {
    Part {
        class: Class::Tree,
        finish: Finish::Plain { colour: rgb(84, 70, 56) },
        shape: Shape::Cylinder(Cylinder {
            x: at[0],
            y: at[1],
            radius: 0.08 + 0.012 * height,
            bottom: at[2] - 0.5,
            top,
        }),
    }
}

/// A round, lumpy crown on a trunk.
fn broadleaf_parts(
    draw: &mut Draw,
    at: [f64; 3],
    height: f64,
    season: Season,
    lush: bool,
) -> Vec<Part> {
    let [x, y, ground] = at;
    let radius = height * draw.range(0.26, 0.42);
    let depth = height * draw.range(0.5, 0.68);
    let count = if lush { 14 + (radius * 4.0) as usize } else { 9 + (radius * 2.6) as usize };
    let (least, most) = if lush { (0.16, 0.36) } else { (0.24, 0.4) };
    let mut puffs: Vec<Puff> = (0..count.min(if lush { 36 } else { 30 }))
        .map(|i| {
            // Golden-angle turns spread the lumps; the first sits in the middle.
            let angle = i as f64 * 2.399_963 + draw.range(-0.5, 0.5);
            let share = if i == 0 { 0.0 } else { ((i as f64) / count as f64).sqrt() };
            let off = radius * 0.74 * share * draw.range(0.85, 1.12);
            let size = radius * draw.range(least, most) * if i == 0 { 1.35 } else { 1.0 };
            let drop = depth * (0.3 + 0.42 * share * share) + depth * draw.range(-0.07, 0.07);
            Puff {
                center: [
                    x + off * libm::cos(angle),
                    y + off * libm::sin(angle),
                    ground + height - drop,
                ],
                radius: size,
                half_height: size * draw.range(0.75, 1.1),
            }
        })
        .collect();
    if lush {
        // The dense inside, under the lumps.
        puffs.push(Puff {
            center: [x, y, ground + height - 0.55 * depth],
            radius: 0.72 * radius,
            half_height: 0.36 * depth,
        });
    }
    let top = puffs.iter().map(|p| p.center[2] + p.half_height).fold(f64::NEG_INFINITY, f64::max);
    for puff in &mut puffs {
        puff.center[2] += ground + height - top;
    }
    // Trees turn one by one.
    let season =
        if lush && season == Season::Autumn && draw.chance(0.55) { Season::Summer } else { season };
    let mut colour = broadleaf_colour(draw, season);
    if lush && season == Season::Spring && draw.chance(0.7) {
        // Few trees blossom.
        colour = broadleaf_colour(draw, Season::Summer);
    }
    vec![crown_part(x, y, puffs, colour, draw), trunk(at, height, ground + height - 0.55 * depth)]
}

/// A spire with tiers of branches that point outwards.
fn conifer_parts(draw: &mut Draw, at: [f64; 3], height: f64) -> Vec<Part> {
    let [x, y, ground] = at;
    let radius = height * draw.range(0.15, 0.23);
    let core = Puff {
        center: [x, y, ground + 0.575 * height],
        radius: 0.42 * radius,
        half_height: 0.425 * height,
    };
    let mut puffs = vec![core];
    for (tier, count) in [(0.0, 8), (1.0, 7), (2.0, 6), (3.0, 5), (4.0, 3)] {
        let reach = radius * (1.0 - tier / 5.4);
        let start = draw.range(0.0, TAU);
        for i in 0..count {
            let angle = start + TAU * f64::from(i) / f64::from(count) + draw.range(-0.22, 0.22);
            let off = reach * draw.range(0.52, 0.7);
            let size = reach * draw.range(0.26, 0.36);
            puffs.push(Puff {
                center: [
                    x + off * libm::cos(angle),
                    y + off * libm::sin(angle),
                    ground + height * (0.2 + 0.145 * tier + draw.range(-0.02, 0.02)),
                ],
                radius: size,
                half_height: height * 0.075,
            });
        }
    }
    let base = draw.pick([rgb(44, 72, 44), rgb(52, 80, 48), rgb(38, 64, 46), rgb(60, 84, 58)]);
    let colour = jitter(draw, base, 0.2);
    vec![crown_part(x, y, puffs, colour, draw), trunk(at, height, ground + 0.5 * height)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_is_as_high_as_asked_and_its_crown_hangs_over_a_void() {
        for i in 0..50 {
            let mut draw = Draw::new(&[i]);
            for parts in [
                broadleaf_parts(&mut draw, [1.0, 2.0, 30.0], 12.0, Season::Summer, i % 2 == 0),
                conifer_parts(&mut draw, [1.0, 2.0, 30.0], 12.0),
            ] {
                let Shape::Crown(crown) = &parts[0].shape else { panic!("a crown comes first") };
                assert!((crown.top - 42.0).abs() < 1e-9);
                assert!(crown.bottom > 30.5, "{}", crown.bottom);
                assert!(crown.radius < 7.0);
                assert!(parts[1].shape.highest() < 42.0);
            }
        }
    }
}
