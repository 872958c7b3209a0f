//! Cars, street trees and lamp posts along the streets.

use super::{Builder, SHORE_STRIP_M, Use, detail};
use crate::random::Draw;
use crate::scene::object::{Class, Colour, Finish, Kind, Part, rgb};
use crate::scene::purpose;
use crate::scene::shape::Rect;
use crate::scene::solid::{Cylinder, Prism, Roof, Shape, flat};
use crate::scene::streets::Street;
use std::collections::BTreeMap;

/// Length of a parking place along a kerb, metres.
const KERB_PLACE_M: f64 = 6.3;

impl Builder<'_> {
    /// Puts a car at a place, at each epoch with its own chance; it follows the slope of the ground.
    pub(super) fn park_car(&mut self, place: &Draw, at: [f64; 2], axis: [f64; 2], chance: f64) {
        for epoch in self.car_epochs.clone() {
            // The lidar's cars are the same whether or not others come later.
            let which = u64::from(epoch == Some(crate::scene::object::Epoch::Image));
            let mut draw = place.clone();
            let mut draw = Draw::new(&[draw.bits(), which]);
            if !draw.chance(chance) || !self.is_land(at[0], at[1], SHORE_STRIP_M) {
                continue;
            }
            let parts = self.car_parts(&mut draw, at, axis);
            self.add_at(Kind::Car, epoch, parts);
        }
    }

    fn car_parts(&self, draw: &mut Draw, at: [f64; 2], axis: [f64; 2]) -> Vec<Part> {
        let colour = car_colour(draw);
        let colour = detail::grey_car(draw, colour, self.grey_share());
        let van = draw.chance(0.12);
        let (length, width) = if van { (5.6, 2.0) } else { (draw.range(4.1, 4.9), 1.82) };
        let turn = draw.range(-0.025, 0.025);
        let flip = if draw.chance(0.5) { -1.0 } else { 1.0 };
        let axis = [flip * (axis[0] - turn * axis[1]), flip * (axis[1] + turn * axis[0])];
        let at = [at[0] + draw.range(-0.2, 0.2), at[1] + draw.range(-0.2, 0.2)];
        let rect = Rect::new(at, axis, length / 2.0, width / 2.0);
        let g = self.terrain.at(at[0], at[1]);
        let (du, dv) = (g.dx * axis[0] + g.dy * axis[1], g.dy * axis[0] - g.dx * axis[1]);
        let (low, _) = self.ground_under(&rect);
        let body = |rect: Rect, z: f64, finish: Finish| {
            let [cx, cy] = [rect.x - at[0], rect.y - at[1]];
            let z = g.z + z + g.dx * cx + g.dy * cy;
            let roof = Roof::Plane { z, du, dv };
            Part {
                class: Class::Car,
                finish,
                shape: Shape::Prism(Prism { rect, bottom: low - 0.2, roof }),
            }
        };
        let cabin = if van {
            rect.sub(-0.05 * length, 0.0, 0.4 * length, 0.46 * width)
        } else {
            rect.sub(-0.06 * length, 0.0, 0.29 * length, 0.44 * width)
        };
        let top = if van { 2.3 } else { draw.range(1.38, 1.75) };
        vec![
            body(rect, if van { 1.15 } else { 0.92 }, Finish::CarBody { colour }),
            body(cabin, top, Finish::CarCabin { colour }),
        ]
    }
}

fn car_colour(draw: &mut Draw) -> Colour {
    draw.pick([
        rgb(236, 237, 238),
        rgb(228, 229, 230),
        rgb(186, 190, 194),
        rgb(150, 154, 158),
        rgb(40, 42, 46),
        rgb(30, 32, 36),
        rgb(96, 100, 106),
        rgb(148, 32, 34),
        rgb(176, 44, 38),
        rgb(38, 62, 122),
        rgb(52, 84, 138),
        rgb(124, 132, 118),
        rgb(168, 152, 120),
        rgb(24, 46, 50),
    ])
}

/// Everything that lines the streets.
pub(super) fn along_streets(b: &mut Builder<'_>, uses: &BTreeMap<[i64; 2], Use>) {
    let streets = b.streets;
    for family in 0..2 {
        for street in &streets.families[family] {
            for cross in streets.families[1 - family].windows(2) {
                let from = cross[0].at + cross[0].half_width;
                let to = cross[1].at - cross[1].half_width;
                let segment = Segment { family, street: *street, from, to, low: cross[0] };
                segment.fill(b, uses);
            }
        }
    }
}

/// The part of a street between two crossings.
struct Segment {
    family: usize,
    street: Street,
    from: f64,
    to: f64,
    low: Street,
}

impl Segment {
    /// The point `across` metres from the centre line, at a coordinate along the street.
    fn at(&self, b: &Builder<'_>, across: f64, along: f64) -> [f64; 2] {
        let c = self.street.at + across;
        if self.family == 0 { b.streets.to_local(c, along) } else { b.streets.to_local(along, c) }
    }

    fn axis(&self, b: &Builder<'_>) -> [f64; 2] {
        let [ax, ay] = b.streets.axis;
        if self.family == 0 { [ax, ay] } else { [ay, -ax] }
    }

    fn draw(&self, b: &Builder<'_>, what: i64, side: i64, slot: i64) -> Draw {
        let id = [self.family as i64, self.street.number, self.low.number, what, side, slot];
        b.draw(purpose::TRAFFIC, &id)
    }

    /// What the block on a side of the segment is used for.
    fn beside(&self, uses: &BTreeMap<[i64; 2], Use>, side: f64) -> Option<Use> {
        let own = self.street.number - i64::from(side < 0.0);
        let index = if self.family == 0 { [own, self.low.number] } else { [self.low.number, own] };
        uses.get(&index).copied()
    }

    fn fill(&self, b: &mut Builder<'_>, uses: &BTreeMap<[i64; 2], Use>) {
        let axis = self.axis(b);
        let half = self.street.half_width;
        let cars = b.spec.cars;
        for side in [-1.0, 1.0] {
            let tag = side as i64;
            // Along the kerb: local streets only, and not where the crosswalks are.
            if !self.street.arterial {
                let (start, end) = (self.from + 8.0, self.to - 8.0);
                let places = ((end - start) / KERB_PLACE_M).floor().max(0.0) as i64;
                for slot in 0..places {
                    let along = start + (slot as f64 + 0.5) * KERB_PLACE_M;
                    let at = self.at(b, side * (half - 1.15), along);
                    b.park_car(&self.draw(b, 0, tag, slot), at, axis, 0.8 * cars.parked_share);
                }
            }
            let lanes: &[f64] = if self.street.arterial { &[1.7, 4.9] } else { &[1.4] };
            for (lane, offset) in lanes.iter().enumerate() {
                let slots = ((self.to - self.from) / 12.5).floor().max(0.0) as i64;
                for slot in 0..slots {
                    let chance = cars.driving_per_100_metres / 8.0;
                    let along = self.from + (slot as f64 + 0.5) * 12.5;
                    let at = self.at(b, side * offset, along);
                    b.park_car(&self.draw(b, 1 + lane as i64, tag, slot), at, axis, chance);
                }
            }
            self.trees(b, side, self.beside(uses, side));
            self.lamps(b, side);
        }
        self.wires(b);
    }

    /// Poles along one side of a local street, and the wires between them (`[detail] wires_share`).
    fn wires(&self, b: &mut Builder<'_>) {
        let share = b.spec.detail.map_or(0.0, |d| d.wires_share);
        // A street has them from end to end, or not at all.
        let mut row =
            b.draw(purpose::TRAFFIC, &[self.family as i64, self.street.number, 0, 7, 0, 0]);
        if share <= 0.0 || self.street.arterial || !row.chance(share) {
            return;
        }
        let side = if row.chance(0.5) { 1.0 } else { -1.0 };
        let (height, reach) = (row.range(8.5, 12.5), self.street.half_width + 0.7);
        let count = ((self.to - self.from) / row.range(28.0, 42.0)).round().max(1.0) as i64;
        let along = |k: i64| self.from + (k as f64 + 0.5) * (self.to - self.from) / count as f64;
        let [ax, ay] = self.axis(b);
        let mut feet: Vec<[f64; 2]> =
            (0..count).map(|k| self.at(b, side * reach, along(k))).collect();
        for foot in &feet {
            if b.is_land(foot[0], foot[1], SHORE_STRIP_M) {
                detail::pole(b, *foot, [-ay, ax], height);
            }
        }
        // On over the crossing, half of the way to the next pole.
        let half = (self.to - self.from) / count as f64 / 2.0;
        let over = self.low.half_width + half;
        feet.insert(0, self.at(b, side * reach, along(0) - half - over));
        feet.push(self.at(b, side * reach, along(count - 1) + half + over));
        for pair in feet.windows(2) {
            if pair.iter().all(|p| b.is_land(p[0], p[1], SHORE_STRIP_M)) {
                detail::wires(b, pair[0], pair[1], height);
            }
        }
    }

    fn trees(&self, b: &mut Builder<'_>, side: f64, beside: Option<Use>) {
        let spacing = b.spec.trees.street_spacing_metres;
        if spacing <= 0.0 {
            return;
        }
        let (start, end) = (self.from + 7.0, self.to - 7.0);
        let count = ((end - start) / spacing).floor().max(0.0) as i64;
        // A street is planted as a whole: all trees of a side are of about one size.
        let mut row = self.draw(b, 5, side as i64, -1);
        let (planted, size) = (row.chance(0.8), row.range(0.28, 0.6));
        for slot in 0..count {
            let mut draw = self.draw(b, 5, side as i64, slot);
            let along = start + (slot as f64 + draw.range(0.3, 0.7)) * spacing;
            let keep = if beside == Some(Use::Industrial) { 0.3 } else { 0.8 };
            if planted && draw.chance(keep) {
                let [x, y] = self.at(b, side * (self.street.half_width + 1.15), along);
                let size = b.enlarged(&mut draw, size);
                b.plant_tree(&mut draw, x, y, size);
            }
        }
    }

    fn lamps(&self, b: &mut Builder<'_>, side: f64) {
        let mut row = self.draw(b, 6, 0, 0);
        let lit_side = if row.chance(0.5) { 1.0 } else { -1.0 };
        if !self.street.arterial && side != lit_side {
            return;
        }
        let count = ((self.to - self.from) / 36.0).round().max(1.0);
        for i in 0..count as i64 {
            let along = self.from + (i as f64 + 0.5) * (self.to - self.from) / count;
            let reach = self.street.half_width + 0.55;
            let [x, y] = self.at(b, side * reach, along);
            if !b.is_land(x, y, SHORE_STRIP_M) {
                continue;
            }
            let ground = b.ground(x, y);
            let colour = rgb(128, 130, 130);
            let pole = Cylinder { x, y, radius: 0.11, bottom: ground - 0.5, top: ground + 8.4 };
            let arm = Prism {
                rect: Rect::new(
                    self.at(b, side * (reach - 0.9), along),
                    {
                        let [ax, ay] = self.axis(b);
                        [-ay, ax]
                    },
                    0.95,
                    0.11,
                ),
                bottom: ground + 8.2,
                roof: flat(ground + 8.4),
            };
            let part =
                |shape| Part { class: Class::Structure, finish: Finish::Plain { colour }, shape };
            b.add(Kind::Structure, vec![part(Shape::Cylinder(pole)), part(Shape::Prism(arm))]);
        }
    }
}
