//! Blocks of family houses: two rows of lots back to back, each with a house, a drive, a garden.

use super::plants::jitter;
use super::{Builder, Frame, detail};
use crate::random::Draw;
use crate::scene::object::{Class, Colour, Cover, Covering, Finish, Kind, Part, rgb};
use crate::scene::purpose;
use crate::scene::shape::Rect;
use crate::scene::solid::{Prism, Roof, Shape, flat};
use crate::scene::streets::BlockArea;

/// How far walls reach below the lowest ground at a corner, metres.
pub(super) const FOUNDATION_M: f64 = 0.5;

pub(super) fn fill(b: &mut Builder<'_>, block: &BlockArea) {
    let (ds, dt) = (block.s1 - block.s0, block.t1 - block.t0);
    // Lots front the streets along the longer side.
    let fronts_along_t = dt >= ds;
    let (length, depth) = if fronts_along_t { (dt, ds / 2.0) } else { (ds, dt / 2.0) };
    for row in 0..2_i64 {
        let sign = if row == 0 { 1.0 } else { -1.0 };
        let mut plan = b.draw(purpose::LOTS, &[block.index[0], block.index[1], row]);
        let lots = (length / plan.range(13.5, 18.5)).floor().max(1.0);
        let width = length / lots;
        for lot in 0..lots as i64 {
            let along = (lot as f64 + 0.5) * width;
            let (origin, t, n) = if fronts_along_t {
                let s = if row == 0 { block.s0 } else { block.s1 };
                ([s, block.t0 + along], [0.0, 1.0], [sign, 0.0])
            } else {
                let t = if row == 0 { block.t0 } else { block.t1 };
                ([block.s0 + along, t], [1.0, 0.0], [0.0, sign])
            };
            let direction = |v: [f64; 2]| b.streets.to_local(v[0], v[1]);
            let frame = Frame {
                origin: b.streets.to_local(origin[0], origin[1]),
                along: direction(t),
                into: direction(n),
            };
            let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], row, lot]);
            Lot { frame, width, depth }.fill(b, &mut draw);
        }
    }
}

struct Lot {
    frame: Frame,
    width: f64,
    depth: f64,
}

/// The colours of one house.
#[derive(Clone, Copy)]
pub(super) struct Style {
    covering: Covering,
    roof: Colour,
    wall: Colour,
}

impl Style {
    /// Roof and wall; with a `grey` share (`[detail] grey_share`) the colours are plainer.
    pub(super) fn draw(draw: &mut Draw, grey: f64) -> Self {
        let covering = match draw.index(10) {
            0 => Covering::Tile,
            1 => Covering::Metal,
            _ => Covering::Shingle,
        };
        let roof = match covering {
            Covering::Tile => draw.pick([rgb(158, 84, 62), rgb(142, 72, 56), rgb(172, 104, 74)]),
            Covering::Metal => {
                draw.pick([rgb(150, 42, 44), rgb(62, 92, 78), rgb(120, 134, 146), rgb(62, 86, 118)])
            }
            _ => draw.pick([
                rgb(104, 104, 106),
                rgb(86, 88, 94),
                rgb(122, 116, 108),
                rgb(98, 86, 78),
                rgb(128, 128, 128),
                rgb(112, 92, 82),
                rgb(92, 104, 116),
                rgb(146, 136, 122),
                rgb(94, 104, 92),
            ]),
        };
        let wall = draw.pick([
            rgb(226, 222, 212),
            rgb(196, 188, 170),
            rgb(164, 176, 186),
            rgb(150, 74, 60),
            rgb(136, 146, 122),
            rgb(206, 188, 146),
        ]);
        let (roof, wall) = (jitter(draw, roof, 0.15), jitter(draw, wall, 0.1));
        Self { covering, roof: detail::greyed(draw, roof, grey), wall }
    }

    pub(super) fn part(self, rect: Rect, bottom: f64, roof: Roof, seed: u32) -> Part {
        Part {
            class: Class::Building,
            finish: Finish::Roof {
                covering: self.covering,
                colour: self.roof,
                wall: self.wall,
                storey: 2.8,
                seed,
            },
            shape: Shape::Prism(Prism { rect, bottom, roof }),
        }
    }
}

impl Lot {
    fn fill(&self, b: &mut Builder<'_>, draw: &mut Draw) {
        let f = &self.frame;
        if !b.can_build(&f.rect(0.0, 12.0, 3.0, 9.0)) {
            return;
        }
        let side = if draw.chance(0.5) { 1.0 } else { -1.0 };
        let drive_w = side * (self.width / 2.0 - 2.0);
        let size = [self.width, self.depth];
        if let Some(d) = b.spec.detail
            && d.flats_share > 0.0
            && draw.chance(d.flats_share)
            && detail::flats(b, draw, f, size)
        {
            return;
        }
        detail::fences(b, draw, f, size);
        if draw.chance(b.spec.blocks.built_share) {
            self.house(b, draw, side, drive_w);
        }
        self.garden(b, draw, side);
    }

    /// House, drive, path, garage; the drive runs along the lot's edge on `side`.
    fn house(&self, b: &mut Builder<'_>, draw: &mut Draw, side: f64, drive_w: f64) {
        let f = &self.frame;
        let style = Style::draw(draw, b.grey_share());
        let seed = draw.bits() as u32;
        let half_w = (draw.range(4.2, 5.6)).min(self.width / 2.0 - 2.9);
        let half_d = draw.range(4.2, 6.8).min(self.depth / 2.0 - 6.0).max(3.0);
        let front = draw.range(4.5, 7.5);
        let (cw, cd) = (-side * 1.3, front + half_d);
        let lengthwise = half_d > half_w;
        let main = {
            let r = f.rect(cw, cd, half_w, half_d);
            if lengthwise { r.turned() } else { r }
        };
        if !b.can_build(&main) {
            return;
        }
        let (low, high) = b.ground_under(&main);
        let eave = high + draw.pick([2.8, 3.2, 5.4, 5.8, 6.2]);
        let slope = draw.range(0.32, 0.85);
        let rise = slope * main.half_v;
        let hipped = draw.chance(b.spec.blocks.hipped_share);
        let roof = if hipped {
            Roof::Hip { ridge: eave + rise, slope }
        } else {
            Roof::Gable { ridge: eave + rise, slope }
        };
        let bottom = low - FOUNDATION_M;
        let mut parts = vec![style.part(main, bottom, roof, seed)];
        // A wing across the main ridge, towards the street.
        if draw.chance(0.5) && main.half_u > 3.4 {
            let wing_half = (main.half_v * draw.range(0.5, 0.75)).min(main.half_u - 0.6);
            let reach = draw.range(1.2, 2.6).min(front - 2.0);
            let w = cw + draw.range(-0.9, 0.9) * (half_w - wing_half).max(0.0);
            let r = f.rect(w, cd - half_d - reach / 2.0 + 1.5, wing_half, reach / 2.0 + 1.5);
            let wing = if lengthwise { r } else { r.turned() };
            let wing_slope = slope.min(0.95 * rise / wing.half_v.max(0.1));
            let ridge = eave - 0.3 + wing_slope * wing.half_v;
            parts.push(style.part(wing, bottom, Roof::Gable { ridge, slope: wing_slope }, seed));
        }
        // A low roof at the back: porch or kitchen.
        if draw.chance(0.45) {
            let r = f.rect(cw + draw.range(-1.5, 1.5), cd + half_d + 1.3, half_w * 0.55, 1.4);
            let roof = Roof::Plane { z: high + 2.7, du: 0.0, dv: 0.0 };
            parts.push(style.part(r, bottom, roof, seed));
        }
        if draw.chance(0.55) {
            let v = if draw.chance(0.5) { 0.0 } else { draw.range(-0.5, 0.5) * main.half_v };
            let u = draw.range(-0.5, 0.5) * main.half_u;
            let rect = main.sub(u, v, 0.45, 0.4);
            let top = eave + rise + draw.range(0.4, 1.1);
            parts.push(Part {
                class: Class::Building,
                finish: Finish::Plain { colour: rgb(134, 84, 70) },
                shape: Shape::Prism(Prism { rect, bottom, roof: flat(top) }),
            });
        }
        if b.spec.detail.is_some() {
            detail::roof_shapes(draw, &main, roof, bottom, style, &mut parts);
        }
        self.roof_lights(draw, &main, roof, &mut parts);
        b.add(Kind::Building, parts);

        // Drive and path.
        let cover = draw.pick([Cover::Concrete, Cover::Concrete, Cover::Asphalt, Cover::Gravel]);
        let garage = draw.chance(0.55);
        let drive_end = if garage { self.depth - 9.5 } else { front + half_d * 1.2 };
        let start = -super::super::streets::SIDE_WIDTH_M;
        let drive = f.rect(drive_w, (start + drive_end) / 2.0, 1.45, (drive_end - start) / 2.0);
        b.paint(drive, cover);
        let path_w = cw + draw.range(-0.5, 0.5) * half_w;
        b.paint(f.rect(path_w, front / 2.0 - 0.9, 0.6, front / 2.0 + 0.9), Cover::Concrete);
        if garage {
            self.garage(b, draw, drive_w, style);
        }
        for slot in 0..2 {
            let d = 3.0 + 6.0 * f64::from(slot);
            if d + 2.5 < drive_end {
                let place = Draw::new(&[draw.bits(), 77]);
                let chance = 0.9 * b.spec.cars.parked_share;
                b.park_car(&place, f.at(drive_w, d), f.into, chance);
            }
        }
    }

    /// Skylights and solar panels a hand above a roof plane.
    fn roof_lights(&self, draw: &mut Draw, main: &Rect, roof: Roof, parts: &mut Vec<Part>) {
        let (Roof::Gable { ridge, slope } | Roof::Hip { ridge, slope }) = roof else { return };
        let mut panel = |u: f64, v: f64, half_u: f64, half_v: f64, finish: Finish| {
            let rect = main.sub(u, v, half_u, half_v);
            let dv = -slope * v.signum();
            let z = ridge - slope * v.abs() + 0.12;
            let shape =
                Shape::Prism(Prism { rect, bottom: z - 2.0, roof: Roof::Plane { z, du: 0.0, dv } });
            parts.push(Part { class: Class::Building, finish, shape });
        };
        let sign = if draw.chance(0.5) { 1.0 } else { -1.0 };
        let room = main.half_u - main.half_v;
        if draw.chance(0.16) && main.half_v > 3.5 {
            let half_u = (room.max(0.0) + main.half_v * 0.3).min(2.8);
            let glass = Finish::Glass { colour: rgb(34, 44, 74) };
            panel(0.0, sign * main.half_v * 0.5, half_u, main.half_v * 0.28, glass);
        } else if draw.chance(0.3) {
            let glass = Finish::Glass { colour: rgb(172, 190, 204) };
            panel(room.max(0.0) * 0.5, sign * main.half_v * 0.45, 0.45, 0.6, glass);
        }
    }

    fn garage(&self, b: &mut Builder<'_>, draw: &mut Draw, w: f64, style: Style) {
        let rect = self.frame.rect(w * 0.96, self.depth - 5.6, 2.1, 3.0).turned();
        if !b.can_build(&rect) {
            return;
        }
        let (low, high) = b.ground_under(&rect);
        let slope = draw.range(0.25, 0.5);
        let roof = Roof::Gable { ridge: high + 2.5 + slope * rect.half_v, slope };
        let part = style.part(rect, low - FOUNDATION_M, roof, draw.bits() as u32);
        b.add(Kind::Building, vec![part]);
    }

    /// Everything green, and what stands in the back garden.
    fn garden(&self, b: &mut Builder<'_>, draw: &mut Draw, side: f64) {
        let f = &self.frame;
        let half = self.width / 2.0;
        let back = self.depth;
        if draw.chance(0.2) {
            b.paint(f.rect(0.0, 1.9, half - 0.3, 1.9), draw.pick([Cover::Mulch, Cover::Gravel]));
        }
        if draw.chance(0.4) {
            let w = draw.range(-0.3, 0.3) * half;
            b.paint(
                f.rect(w, back - 8.5, 2.4, 1.9),
                draw.pick([Cover::Concrete, Cover::Paving, Cover::Soil]),
            );
        }
        if draw.chance(0.05) {
            let rect = f.rect(-side * 0.3 * half, back - 5.0, 3.6, 1.9);
            b.paint(rect.sub(0.0, 0.0, 4.4, 2.7), Cover::Paving);
            b.paint(rect, Cover::Pool);
        }
        if draw.chance(0.35) {
            let rect = f.rect(-side * (half - 2.3), back - 2.6, 1.4, 1.1);
            if b.can_build(&rect) {
                let (low, high) = b.ground_under(&rect);
                let style = Style::draw(draw, b.grey_share());
                let roof = Roof::Gable { ridge: high + 2.5, slope: 0.45 };
                let part = style.part(rect, low - 0.3, roof, draw.bits() as u32);
                b.add(Kind::Building, vec![part]);
            }
        }
        if draw.chance(0.3) {
            b.plant_hedge(draw, f.rect(-side * (half - 0.35), back * 0.6, 0.32, back * 0.34));
        }
        if draw.chance(0.15) {
            b.plant_hedge(draw, f.rect(0.0, 0.35, half * 0.45, 0.3));
        }
        for _ in 0..draw.count(b.spec.trees.per_garden) {
            let w = draw.range(-0.9, 0.9) * half;
            let d = if draw.chance(0.7) {
                draw.range(back - 8.0, back - 0.8)
            } else {
                draw.range(0.8, 3.6)
            };
            let [x, y] = f.at(w, d);
            let scale = draw.range(0.2, 0.75);
            let scale = b.enlarged(draw, scale);
            b.plant_tree(draw, x, y, scale);
        }
        let more = if b.spec.detail.is_some() { draw.index(14) } else { 0 };
        for _ in 0..more {
            // Beds along the house, the fences and the street.
            let w = draw.range(-0.97, 0.97) * half;
            let d = draw.pick([0.04, 0.13, 0.2, 0.6, 0.75, 0.9, 0.97]) * back;
            let [x, y] = f.at(w, d + draw.range(-0.6, 0.6));
            if draw.chance(0.3) {
                b.plant_tree(draw, x, y, 0.16);
            } else {
                b.plant_shrub(draw, x, y);
            }
        }
        for _ in 0..3 + draw.index(7) {
            let w = draw.pick([-1.0, 1.0]) * half * draw.range(0.55, 0.97);
            let [x, y] = f.at(w, draw.range(0.6, back - 0.6));
            b.plant_shrub(draw, x, y);
        }
    }
}
