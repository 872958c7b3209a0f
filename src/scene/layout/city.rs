//! Dense and working blocks: downtown, shops with parking lots, industry.

use super::plants::jitter;
use super::suburb::FOUNDATION_M;
use super::{Builder, Frame, detail};
use crate::random::Draw;
use crate::scene::object::{Class, Colour, Cover, Covering, Finish, Kind, Part, rgb};
use crate::scene::purpose;
use crate::scene::shape::Rect;
use crate::scene::solid::{Cylinder, Prism, Roof, Shape, flat};
use crate::scene::streets::BlockArea;

/// Width of a parking place, metres.
pub(in crate::scene) const STALL_WIDTH_M: f64 = 2.6;
/// Length of a parking place, metres.
const STALL_LENGTH_M: f64 = 5.2;

fn roof_part(rect: Rect, bottom: f64, z: f64, look: Look, seed: u32) -> Part {
    Part {
        class: Class::Building,
        finish: Finish::Roof {
            covering: look.covering,
            colour: look.roof,
            wall: look.wall,
            storey: look.storey,
            seed,
        },
        shape: Shape::Prism(Prism { rect, bottom, roof: flat(z) }),
    }
}

#[derive(Clone, Copy)]
pub(super) struct Look {
    covering: Covering,
    roof: Colour,
    wall: Colour,
    storey: f32,
}

impl Look {
    /// Roof and wall; with a `grey` share (`[detail] grey_share`) the colours are plainer.
    pub(super) fn draw(draw: &mut Draw, grey: f64) -> Self {
        let covering = draw.pick([Covering::Membrane, Covering::Membrane, Covering::Gravel]);
        let roof = draw.pick([
            rgb(214, 212, 204),
            rgb(186, 184, 178),
            rgb(150, 148, 144),
            rgb(112, 112, 112),
            rgb(82, 82, 84),
            rgb(164, 152, 136),
            rgb(128, 122, 114),
        ]);
        let wall = draw.pick([
            rgb(150, 160, 168),
            rgb(176, 168, 154),
            rgb(142, 96, 78),
            rgb(110, 124, 138),
            rgb(196, 192, 184),
        ]);
        let (roof, wall) = (jitter(draw, roof, 0.12), jitter(draw, wall, 0.1));
        Self { covering, roof: detail::greyed(draw, roof, 0.6 * grey), wall, storey: 3.4 }
    }
}

/// A flat-roofed body with a parapet and what stands on its roof.
pub(super) fn flat_building(
    draw: &mut Draw,
    rect: Rect,
    bottom: f64,
    top: f64,
    look: Look,
) -> Vec<Part> {
    let seed = draw.bits() as u32;
    let mut parts = vec![roof_part(rect, bottom, top, look, seed)];
    let (hu, hv) = (rect.half_u, rect.half_v);
    let (width, height) = (0.2, draw.range(0.4, 1.1));
    let rim_colour = look.roof.map(|c| (c * 1.15 + 0.03).min(0.95));
    for side in [
        rect.sub(0.0, hv - width, hu, width),
        rect.sub(0.0, -(hv - width), hu, width),
        rect.sub(hu - width, 0.0, width, hv),
        rect.sub(-(hu - width), 0.0, width, hv),
    ] {
        let rim = Look { covering: Covering::Metal, roof: rim_colour, ..look };
        parts.push(roof_part(side, bottom, top + height, rim, seed));
    }
    roof_clutter(draw, &rect, top, &mut parts);
    parts
}

/// Machines, stair heads and skylights on a flat roof.
fn roof_clutter(draw: &mut Draw, rect: &Rect, top: f64, parts: &mut Vec<Part>) {
    let (hu, hv) = (rect.half_u, rect.half_v);
    let area = 4.0 * hu * hv;
    let mut put = |draw: &mut Draw, half_u: f64, half_v: f64, height: f64, finish: Finish| {
        let (ru, rv) = (hu - half_u - 1.2, hv - half_v - 1.2);
        if ru > 0.0 && rv > 0.0 {
            let place = rect.sub(draw.range(-ru, ru), draw.range(-rv, rv), half_u, half_v);
            let shape =
                Shape::Prism(Prism { rect: place, bottom: top - 0.5, roof: flat(top + height) });
            parts.push(Part { class: Class::Building, finish, shape });
        }
    };
    if area > 180.0 {
        let colour = jitter(draw, rgb(170, 166, 160), 0.2);
        let (a, b, h) = (draw.range(1.6, 3.6), draw.range(1.4, 2.6), draw.range(2.4, 3.4));
        put(draw, a, b, h, Finish::Plain { colour });
    }
    for _ in 0..draw.count((area / 110.0).min(14.0)) {
        let colour = jitter(draw, rgb(178, 180, 180), 0.25);
        let (a, b, h) = (draw.range(0.5, 1.6), draw.range(0.5, 1.1), draw.range(0.6, 1.8));
        put(draw, a, b, h, Finish::Machine { colour });
    }
    if draw.chance(0.5) {
        for _ in 0..draw.count((area / 160.0).min(10.0)) {
            put(draw, 1.2, 0.7, 0.3, Finish::Glass { colour: rgb(196, 208, 216) });
        }
    }
}

pub(super) fn downtown(b: &mut Builder<'_>, block: &BlockArea) {
    let mut plan = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 10]);
    let (ds, dt) = (block.s1 - block.s0, block.t1 - block.t0);
    let (ns, nt) = (
        (ds / plan.range(24.0, 36.0)).round().max(1.0),
        (dt / plan.range(26.0, 40.0)).round().max(1.0),
    );
    for i in 0..ns as i64 {
        for j in 0..nt as i64 {
            let cut = |low: f64, size: f64, k: i64, n: f64| {
                [low + size * k as f64 / n, low + size * (k + 1) as f64 / n]
            };
            let lot = b.street_rect(cut(block.s0, ds, i, ns), cut(block.t0, dt, j, nt));
            let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 11, i, j]);
            if !b.can_build(&lot.sub(0.0, 0.0, lot.half_u * 0.8, lot.half_v * 0.8)) {
                continue;
            }
            if !draw.chance(b.spec.blocks.built_share) || draw.chance(0.12) {
                if draw.chance(0.5) {
                    parking_lot(b, &mut draw, &lot);
                } else {
                    plaza(b, &mut draw, &lot);
                }
                continue;
            }
            tower(b, &mut draw, &lot);
        }
    }
}

/// A podium with a setback tower, or a midrise house; the highest are rare.
fn tower(b: &mut Builder<'_>, draw: &mut Draw, lot: &Rect) {
    let gap = draw.range(0.2, 2.2);
    let podium = lot.sub(0.0, 0.0, lot.half_u - gap, lot.half_v - gap);
    if !b.can_build(&podium) {
        return;
    }
    let (low, high) = b.ground_under(&podium);
    let bottom = low - FOUNDATION_M;
    let mut share = draw.unit();
    if b.spec.detail.is_some() {
        // High houses stand on large lots.
        let area = 4.0 * podium.half_u * podium.half_v;
        share *= (area / 900.0).clamp(0.3, 1.0).sqrt();
    }
    let height = (b.spec.blocks.tower_height_metres * (0.16 + 0.84 * share * share)).max(6.0);
    let look = Look::draw(draw, b.grey_share());
    let mut parts = Vec::new();
    if b.spec.detail.is_some() && draw.chance(0.4) {
        let height = high + height.min(30.0);
        for wing in detail::wings(draw, &podium) {
            parts.extend(flat_building(draw, wing, bottom, height, look));
        }
    } else if height > 16.0 {
        let base = draw.range(5.0, 11.0);
        parts.extend(flat_building(draw, podium, bottom, high + base, look));
        let shrink = draw.range(0.55, 0.85);
        let (hu, hv) = (podium.half_u * shrink, podium.half_v * shrink);
        let shift = podium.half_u * (1.0 - shrink) * draw.range(-0.7, 0.7);
        let shaft = podium.sub(shift, 0.0, hu, hv);
        let upper = Look::draw(draw, b.grey_share());
        let top = high + height;
        if height > 30.0 && draw.chance(0.5) {
            let waist = high + height * draw.range(0.6, 0.85);
            parts.extend(flat_building(draw, shaft, bottom, waist, upper));
            let crown = shaft.sub(0.0, 0.0, hu * 0.7, hv * 0.7);
            parts.extend(flat_building(draw, crown, bottom, top, upper));
        } else {
            parts.extend(flat_building(draw, shaft, bottom, top, upper));
        }
    } else {
        parts.extend(flat_building(draw, podium, bottom, high + height, look));
    }
    b.add(Kind::Building, parts);
}

fn plaza(b: &mut Builder<'_>, draw: &mut Draw, lot: &Rect) {
    b.paint(*lot, draw.pick([Cover::Paving, Cover::Concrete]));
    let lawn = lot.sub(draw.range(-2.0, 2.0), 0.0, lot.half_u * 0.55, lot.half_v * 0.5);
    b.paint(lawn, Cover::Lawn);
    let n = (lot.half_u / 3.5).floor() as i64;
    for k in -n..=n {
        for side in [-0.78, 0.78] {
            if draw.chance(0.75) {
                let [x, y] = lot.at(k as f64 * 3.3, side * lot.half_v);
                b.plant_tree(draw, x, y, 0.38);
            }
        }
    }
}

/// A parking lot: rows of places, two rows back to back between aisles.
fn parking_lot(b: &mut Builder<'_>, draw: &mut Draw, lot: &Rect) {
    b.paint(*lot, Cover::Asphalt);
    // Rows run along the longer side.
    let lot = if lot.half_u >= lot.half_v { *lot } else { lot.turned() };
    let pitch = 2.0 * STALL_LENGTH_M + 6.4;
    let rows = ((2.0 * lot.half_v - 1.0) / pitch).floor().max(0.0) as i64;
    let places = ((2.0 * lot.half_u - 6.0) / STALL_WIDTH_M).floor() as i64;
    if rows == 0 || places < 2 {
        return;
    }
    let spare = 2.0 * lot.half_v - rows as f64 * pitch;
    let half_u = places as f64 * STALL_WIDTH_M / 2.0;
    let busy = draw.range(0.5, 1.5) * b.spec.cars.parked_share;
    for row in 0..rows {
        let middle = -lot.half_v + spare / 2.0 + (row as f64 + 0.5) * pitch;
        for side in [-1.0, 1.0] {
            let v = middle + side * STALL_LENGTH_M / 2.0;
            b.paint(lot.sub(0.0, v, half_u, STALL_LENGTH_M / 2.0), Cover::Stalls);
            for place in 0..places {
                let u = -half_u + (place as f64 + 0.5) * STALL_WIDTH_M;
                let car = Draw::new(&[draw.bits(), 78]);
                b.park_car(&car, lot.at(u, v), [-lot.sin, lot.cos], busy);
            }
        }
        // Planted islands at both ends.
        for end in [-1.0, 1.0] {
            let island = lot.sub(end * (half_u + 1.0), middle, 0.85, STALL_LENGTH_M * 0.9);
            b.paint(island, Cover::Mulch);
            if draw.chance(0.8) {
                b.plant_tree(draw, island.x, island.y, 0.35);
            }
        }
    }
}

/// The two parts of a block: what is at its back, and the yard in front of it.
fn split(b: &Builder<'_>, block: &BlockArea, draw: &mut Draw, share: f64) -> (Rect, Rect) {
    let (s0, s1, t0, t1) = (block.s0, block.s1, block.t0, block.t1);
    let flip = draw.chance(0.5);
    if t1 - t0 >= s1 - s0 {
        let cut = if flip { t0 + share * (t1 - t0) } else { t1 - share * (t1 - t0) };
        let (low, high) = (b.street_rect([s0, s1], [t0, cut]), b.street_rect([s0, s1], [cut, t1]));
        if flip { (low, high) } else { (high, low) }
    } else {
        let cut = if flip { s0 + share * (s1 - s0) } else { s1 - share * (s1 - s0) };
        let (low, high) = (b.street_rect([s0, cut], [t0, t1]), b.street_rect([cut, s1], [t0, t1]));
        if flip { (low, high) } else { (high, low) }
    }
}

pub(super) fn commercial(b: &mut Builder<'_>, block: &BlockArea) {
    let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 20]);
    let share = draw.range(0.42, 0.56);
    let (back, yard) = split(b, block, &mut draw, share);
    parking_lot(b, &mut draw, &yard.sub(0.0, 0.0, yard.half_u - 1.5, yard.half_v - 1.5));
    let units = 1 + draw.index(3);
    let long = if back.half_u >= back.half_v { back } else { back.turned() };
    for unit in 0..units {
        let width = 2.0 * long.half_u / units as f64;
        let u = -long.half_u + (unit as f64 + 0.5) * width;
        let gap = draw.range(0.8, 3.0);
        let half_v = long.half_v - draw.range(1.0, 4.0);
        let rect = long.sub(u, 0.0, width / 2.0 - gap, half_v);
        if rect.half_u < 4.0 || rect.half_v < 4.0 || !b.can_build(&rect) {
            continue;
        }
        let (low, high) = b.ground_under(&rect);
        let look = Look { storey: 0.0, ..Look::draw(&mut draw, b.grey_share()) };
        let top = high + draw.range(5.5, 10.0);
        let parts = flat_building(&mut draw, rect, low - FOUNDATION_M, top, look);
        b.add(Kind::Building, parts);
    }
    for _ in 0..8 {
        let (u, v) = (draw.range(-1.0, 1.0) * yard.half_u, draw.pick([-0.97, 0.97]) * yard.half_v);
        let [x, y] = yard.at(u, v);
        b.plant_shrub(&mut draw, x, y);
    }
}

pub(super) fn industrial(b: &mut Builder<'_>, block: &BlockArea) {
    let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 30]);
    let share = draw.range(0.5, 0.65);
    let (sheds, yard) = split(b, block, &mut draw, share);
    b.paint(yard.sub(0.0, 0.0, yard.half_u * 0.95, yard.half_v * 0.9), Cover::Concrete);
    let long = if sheds.half_u >= sheds.half_v { sheds } else { sheds.turned() };
    let bays = (2.0 * long.half_u / draw.range(18.0, 27.0)).round().max(1.0);
    for bay in 0..bays as i64 {
        let width = 2.0 * long.half_u / bays;
        let u = -long.half_u + (bay as f64 + 0.5) * width;
        let rect = long.sub(u, 0.0, width / 2.0 - 0.8, long.half_v - draw.range(1.0, 5.0)).turned();
        if !b.can_build(&rect) || !draw.chance(b.spec.blocks.built_share) {
            continue;
        }
        let (low, high) = b.ground_under(&rect);
        if b.spec.detail.is_some() && draw.chance(0.45) {
            // A flat roof; wide halls are high.
            let wide = (rect.half_u.min(rect.half_v) / 14.0).min(1.0);
            let top = high + draw.range(4.5, 7.5) + 3.5 * wide;
            let look = Look { storey: 0.0, ..Look::draw(&mut draw, b.grey_share()) };
            let parts = flat_building(&mut draw, rect, low - FOUNDATION_M, top, look);
            b.add(Kind::Building, parts);
            continue;
        }
        let colour = draw.pick([
            rgb(176, 182, 186),
            rgb(148, 156, 160),
            rgb(206, 206, 200),
            rgb(124, 82, 64),
            rgb(92, 116, 136),
            rgb(136, 142, 128),
        ]);
        let slope = draw.range(0.08, 0.2);
        let finish = Finish::Roof {
            covering: Covering::Metal,
            colour: {
                let colour = jitter(&mut draw, colour, 0.15);
                detail::greyed(&mut draw, colour, 0.5 * b.grey_share())
            },
            wall: jitter(&mut draw, rgb(168, 172, 172), 0.15),
            storey: 0.0,
            seed: draw.bits() as u32,
        };
        let roof = Roof::Gable { ridge: high + draw.range(6.0, 9.5) + slope * rect.half_v, slope };
        let shape = Shape::Prism(Prism { rect, bottom: low - FOUNDATION_M, roof });
        b.add(Kind::Building, vec![Part { class: Class::Building, finish, shape }]);
    }
    storage_yard(b, &mut draw, &yard);
}

/// Containers in stacks, tanks, parked vehicles.
fn storage_yard(b: &mut Builder<'_>, draw: &mut Draw, yard: &Rect) {
    let frame = Frame {
        origin: yard.at(0.0, -yard.half_v),
        along: [yard.cos, yard.sin],
        into: [-yard.sin, yard.cos],
    };
    let lanes = (2.0 * yard.half_v / 7.5).floor() as i64;
    for lane in 0..lanes {
        let d = (lane as f64 + 0.6) * 7.5;
        let slots = (2.0 * (yard.half_u - 4.0) / 12.8).floor() as i64;
        for slot in 0..slots {
            let w = -yard.half_u + 4.0 + (slot as f64 + 0.5) * 12.8;
            let at = frame.at(w, d);
            if draw.chance(0.35) {
                let rect = Rect::new(at, frame.along, 6.05, 1.22);
                if b.can_build(&rect) {
                    let (low, high) = b.ground_under(&rect);
                    let colour = draw.pick([
                        rgb(146, 56, 44),
                        rgb(44, 82, 128),
                        rgb(176, 110, 50),
                        rgb(62, 104, 82),
                        rgb(180, 180, 176),
                        rgb(104, 66, 52),
                    ]);
                    let top = high + 2.6 * (1.0 + draw.index(3) as f64);
                    let finish = Finish::Corrugated { colour: jitter(draw, colour, 0.2) };
                    let shape = Shape::Prism(Prism { rect, bottom: low - 0.2, roof: flat(top) });
                    b.add(Kind::Structure, vec![Part { class: Class::Structure, finish, shape }]);
                }
            } else {
                let place = Draw::new(&[draw.bits(), 79]);
                b.park_car(&place, at, frame.into, 0.3 * b.spec.cars.parked_share);
            }
        }
    }
    for _ in 0..draw.index(4) {
        let radius = draw.range(2.5, 6.0);
        let [x, y] = yard.at(
            draw.range(-0.8, 0.8) * (yard.half_u - radius),
            draw.pick([-1.0, 1.0]) * (yard.half_v - radius).max(0.0),
        );
        if b.can_build(&Rect::new([x, y], [1.0, 0.0], radius, radius)) {
            let ground = b.ground(x, y);
            let top = ground + draw.range(5.0, 11.0);
            let tank = Cylinder { x, y, radius, bottom: ground - 2.0, top };
            let finish = Finish::Plain { colour: jitter(draw, rgb(218, 218, 212), 0.1) };
            let shape = Shape::Cylinder(tank);
            b.add(Kind::Structure, vec![Part { class: Class::Structure, finish, shape }]);
        }
    }
}
