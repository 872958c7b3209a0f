//! What `[detail]` adds to the blocks: greys, blocks of flats, railways, wires, fences, closed forest.
//!
//! Wires and fences are thinner than a lidar cell: pictures show them, the survey does not.

use super::city::{self, Look};
use super::plants::jitter;
use super::suburb::{FOUNDATION_M, Style};
use super::{Builder, Frame};
use crate::random::Draw;
use crate::scene::object::{Class, Colour, Cover, Epoch, Finish, Kind, Part, rgb};
use crate::scene::purpose;
use crate::scene::shape::Rect;
use crate::scene::solid::{Cylinder, Prism, Roof, Shape, flat};
use crate::scene::streets::BlockArea;

/// Distance of railway tracks, metres.
const TRACK_SPACING_M: f64 = 4.6;
/// Half the width of what is painted as a track, metres.
const TRACK_HALF_WIDTH_M: f64 = 1.35;
/// Distance of trees whose crowns touch, metres per metre of the highest tree.
const CANOPY_SPACING: f64 = 0.27;
/// A wire hangs in this many straight pieces between poles.
const WIRE_PIECES: i64 = 6;

/// Replaces a colour by a grey one in a share of the cases. Without the share nothing is drawn.
pub(super) fn greyed(draw: &mut Draw, colour: Colour, share: f64) -> Colour {
    if share > 0.0 && draw.chance(share) {
        let grey = draw.pick([
            rgb(48, 48, 52),
            rgb(66, 67, 70),
            rgb(84, 85, 88),
            rgb(104, 104, 106),
            rgb(122, 120, 118),
            rgb(142, 142, 142),
            rgb(106, 98, 90),
            rgb(88, 80, 74),
        ]);
        jitter(draw, grey, 0.12)
    } else {
        colour
    }
}

/// A car's paint: most are white, grey or black.
pub(super) fn grey_car(draw: &mut Draw, colour: Colour, share: f64) -> Colour {
    if share > 0.0 && draw.chance(share) {
        draw.pick([
            rgb(238, 239, 240),
            rgb(228, 229, 230),
            rgb(196, 199, 202),
            rgb(150, 153, 156),
            rgb(110, 113, 116),
            rgb(62, 64, 68),
            rgb(36, 38, 42),
            rgb(26, 27, 30),
        ])
    } else {
        colour
    }
}

impl Builder<'_> {
    /// `[detail] grey_share`.
    pub(super) fn grey_share(&self) -> f64 {
        self.spec.detail.map_or(0.0, |d| d.grey_share)
    }

    /// The size class of a garden or street tree that `[detail] larger_trees` makes of another.
    pub(super) fn enlarged(&self, draw: &mut Draw, scale: f64) -> f64 {
        match self.spec.detail {
            Some(d) => (scale * (1.0 + d.larger_trees * draw.unit())).min(1.0),
            None => scale,
        }
    }
}

/// A block of flats on a lot, in place of a house. Returns whether there was room.
pub(super) fn flats(b: &mut Builder<'_>, draw: &mut Draw, frame: &Frame, size: [f64; 2]) -> bool {
    let [width, depth] = size;
    let (half_w, half_d) = (width / 2.0 - draw.range(0.6, 2.0), (depth - 9.0) / 2.0);
    let half_d = half_d.min(draw.range(7.0, 15.0));
    if half_w < 3.5 || half_d < 4.0 {
        return false;
    }
    let rect = frame.rect(0.0, 4.0 + half_d, half_w, half_d);
    if !b.can_build(&rect) {
        return false;
    }
    let (low, high) = b.ground_under(&rect);
    let storeys = draw.pick([2.0, 3.0, 3.0, 3.0, 4.0]);
    let (bottom, eave) = (low - FOUNDATION_M, high + 0.4 + 2.9 * storeys);
    let grey = b.grey_share();
    let parts = if draw.chance(0.65) {
        let look = Look::draw(draw, grey);
        city::flat_building(draw, rect, bottom, eave, look)
    } else {
        let long = if rect.half_u >= rect.half_v { rect } else { rect.turned() };
        let slope = draw.range(0.2, 0.45);
        let ridge = (eave + slope * long.half_v).min(high + 14.5);
        let roof = if draw.chance(0.5) {
            Roof::Hip { ridge, slope }
        } else {
            Roof::Gable { ridge, slope }
        };
        let style = Style::draw(draw, grey);
        vec![style.part(long, bottom, roof, draw.bits() as u32)]
    };
    b.add(Kind::Building, parts);
    true
}

/// A house along the edges of a lot: a slab, an L or a U about a court.
pub(super) fn wings(draw: &mut Draw, lot: &Rect) -> Vec<Rect> {
    let deep = |half: f64, draw: &mut Draw| draw.range(6.0, 9.5).min(half);
    let (hu, hv) = (lot.half_u, lot.half_v);
    let (du, dv) = (deep(hu, draw), deep(hv, draw));
    let (su, sv) = (draw.pick([-1.0, 1.0]), draw.pick([-1.0, 1.0]));
    let along_u = lot.sub(0.0, sv * (hv - dv), hu, dv);
    let rest = hv - dv;
    let side = |s: f64| lot.sub(s * (hu - du), -sv * dv, du, rest);
    match draw.index(4) {
        0 => vec![*lot],
        1 => vec![along_u],
        2 if rest > 2.0 => vec![along_u, side(su)],
        _ if rest > 2.0 && hu > 2.0 * du => vec![along_u, side(su), side(-su)],
        _ => vec![*lot],
    }
}

/// Gabled windows that stand out of a roof, and a second gable as high as the first across it.
pub(super) fn roof_shapes(
    draw: &mut Draw,
    main: &Rect,
    roof: Roof,
    bottom: f64,
    style: Style,
    parts: &mut Vec<Part>,
) {
    let (Roof::Gable { ridge, slope } | Roof::Hip { ridge, slope }) = roof else { return };
    let seed = draw.bits() as u32;
    if draw.chance(0.22) && main.half_u > main.half_v * 0.8 {
        // A wing of the same height: an L or a T from above.
        let half = (main.half_v * draw.range(0.7, 1.0)).min(main.half_u * 0.7);
        let reach = main.half_v + draw.range(1.0, 3.2);
        let u = draw.pick([-1.0, 1.0]) * (main.half_u - half) * draw.range(0.0, 1.0);
        let side = draw.pick([-1.0, 1.0]);
        let wing = main.sub(u, side * reach / 2.0, half, reach / 2.0).turned();
        let top = ridge - slope * (main.half_v - half).max(0.0);
        let roof = Roof::Gable { ridge: top, slope };
        parts.push(style.part(wing, bottom, roof, seed));
    }
    if slope > 0.5 && draw.chance(0.3) {
        let count = 1 + draw.index(3);
        let side = draw.pick([-1.0, 1.0]);
        for k in 0..count {
            let u = main.half_u * 0.6 * ((k as f64 + 0.5) / count as f64 * 2.0 - 1.0);
            let (half, front) = (0.8, main.half_v * 0.75);
            // Its ridge meets the roof's plane where that is as high.
            let top = ridge - slope * main.half_v * 0.35;
            let back = main.half_v * 0.3;
            let rect =
                main.sub(u, side * (front + back) / 2.0, half, (front - back) / 2.0).turned();
            let roof = Roof::Gable { ridge: top, slope: 0.6 };
            parts.push(style.part(rect, top - 2.2, roof, seed ^ 5));
        }
    }
}

/// Fences along a lot's sides and back.
pub(super) fn fences(b: &mut Builder<'_>, draw: &mut Draw, frame: &Frame, size: [f64; 2]) {
    let share = b.spec.detail.map_or(0.0, |d| d.fence_share);
    if share <= 0.0 || !draw.chance(share) {
        return;
    }
    let [width, depth] = size;
    let front = draw.range(6.0, 12.0).min(depth - 2.0);
    let half = (depth - front) / 2.0;
    let height = draw.range(1.1, 1.9);
    let base = draw.pick([rgb(128, 112, 92), rgb(160, 150, 134), rgb(212, 208, 200)]);
    let colour = jitter(draw, base, 0.15);
    let sides = [
        frame.rect(-width / 2.0 + 0.08, front + half, 0.05, half).turned(),
        frame.rect(width / 2.0 - 0.08, front + half, 0.05, half).turned(),
        frame.rect(0.0, depth - 0.08, width / 2.0, 0.05),
    ];
    for rect in sides {
        if b.can_build(&rect) && draw.chance(0.8) {
            let (low, high) = b.ground_under(&rect);
            let shape = Shape::Prism(Prism { rect, bottom: low - 0.2, roof: flat(high + height) });
            let part = Part { class: Class::Structure, finish: Finish::Plain { colour }, shape };
            b.add_at(Kind::Structure, Some(Epoch::Image), vec![part]);
        }
    }
}

/// Trees so close that their crowns touch.
pub(super) fn canopy(b: &mut Builder<'_>, draw: &mut Draw, area: &Rect, share: f64) {
    let step = (b.spec.trees.height_metres * CANOPY_SPACING).clamp(3.4, 6.5);
    let (patches, sizes) = (draw.bits() as u32, draw.bits() as u32);
    let count = |half: f64| (2.0 * half / step).ceil() as i64;
    for i in 0..count(area.half_u) {
        for j in 0..count(area.half_v) {
            let u = -area.half_u + (i as f64 + draw.range(0.1, 0.9)) * step;
            let v = -area.half_v + (j as f64 + draw.range(0.1, 0.9)) * step;
            let [x, y] = area.at(u, v);
            let keep = draw.chance(0.96);
            let scale = draw.range(0.5, 0.85)
                + 0.3 * f64::from(crate::scene::noise::value(x / 18.0, y / 18.0, sizes));
            let dense = f64::from(crate::scene::noise::value(x / 26.0, y / 26.0, patches));
            if keep && dense < 0.25 + 0.75 * share {
                b.plant_tree(draw, x, y, scale.min(1.0));
            } else if draw.chance(0.5) {
                b.plant_shrub(draw, x, y);
            }
        }
    }
}

/// A yard of parallel railway tracks, with trains, masts and a road across.
pub(super) fn railway(b: &mut Builder<'_>, block: &BlockArea) {
    let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 70]);
    let all = b.street_rect([block.s0, block.s1], [block.t0, block.t1]);
    let long = if all.half_u >= all.half_v { all } else { all.turned() };
    let tracks = (2.0 * long.half_v / TRACK_SPACING_M).floor() as i64;
    let (width, busy) = (TRACK_SPACING_M, draw.range(0.05, 0.5));
    let road = draw.range(-0.7, 0.7) * long.half_u;
    let electric = draw.chance(0.5);
    for track in 0..tracks {
        if draw.chance(0.1) {
            continue;
        }
        let v = -long.half_v + (track as f64 + 0.5) * width;
        b.paint(long.sub(0.0, v, long.half_u, TRACK_HALF_WIDTH_M), Cover::Track);
        let mut u = -long.half_u + draw.range(0.0, 30.0);
        while draw.chance(busy) && u + 30.0 < long.half_u {
            u = train(b, &mut draw, &long, [u, v]);
        }
        if electric && track % 3 == 0 {
            masts(b, &mut draw, &long, v + width / 2.0);
        }
    }
    if draw.chance(0.5) {
        b.paint(long.sub(road, 0.0, draw.range(2.0, 4.0), long.half_v), Cover::Asphalt);
    }
}

/// A train from a place along a track; returns where the next may begin.
fn train(b: &mut Builder<'_>, draw: &mut Draw, yard: &Rect, at: [f64; 2]) -> f64 {
    let length = draw.range(15.0, 25.0);
    let base = draw.pick([
        rgb(120, 122, 124),
        rgb(70, 72, 76),
        rgb(186, 188, 190),
        rgb(122, 82, 60),
        rgb(52, 72, 104),
    ]);
    let (colour, height) = (jitter(draw, base, 0.2), draw.range(3.4, 4.6));
    let tank = draw.chance(0.2);
    let mut u = at[0];
    for _ in 0..1 + draw.index(7) {
        if u + length > yard.half_u {
            break;
        }
        let rect = yard.sub(u + length / 2.0, at[1], length / 2.0, 1.45);
        if b.can_build(&rect) {
            let (low, high) = b.ground_under(&rect);
            let roof = if tank {
                Roof::Gable { ridge: high + height, slope: 0.5 }
            } else {
                flat(high + height)
            };
            let finish =
                if tank { Finish::Plain { colour } } else { Finish::Corrugated { colour } };
            let shape = Shape::Prism(Prism { rect, bottom: low - 0.2, roof });
            b.add(Kind::Structure, vec![Part { class: Class::Structure, finish, shape }]);
        }
        u += length + 0.9;
    }
    u + draw.range(5.0, 60.0)
}

/// Masts beside a track, with an arm over it.
fn masts(b: &mut Builder<'_>, draw: &mut Draw, yard: &Rect, v: f64) {
    let start = draw.range(0.0, 30.0);
    let count = ((2.0 * yard.half_u - start) / 32.0).floor().max(0.0) as i64;
    for k in 0..count {
        let u = -yard.half_u + start + k as f64 * 32.0;
        let [x, y] = yard.at(u, v);
        if !b.is_land(x, y, super::SHORE_STRIP_M) {
            continue;
        }
        let ground = b.ground(x, y);
        let arm = Prism {
            rect: yard.sub(u, v - TRACK_SPACING_M / 2.0, 0.08, TRACK_SPACING_M / 2.0),
            bottom: ground + 6.6,
            roof: flat(ground + 6.8),
        };
        let pole = Cylinder { x, y, radius: 0.14, bottom: ground - 0.5, top: ground + 7.6 };
        let finish = Finish::Plain { colour: rgb(96, 96, 96) };
        let part = |shape| Part { class: Class::Structure, finish, shape };
        b.add(Kind::Structure, vec![part(Shape::Cylinder(pole)), part(Shape::Prism(arm))]);
    }
}

/// A wooden pole with a crossarm whose ends point along `across`.
pub(super) fn pole(b: &mut Builder<'_>, at: [f64; 2], across: [f64; 2], height: f64) {
    let [x, y] = at;
    let ground = b.ground(x, y);
    let top = ground + height;
    let arm =
        Prism { rect: Rect::new(at, across, 1.2, 0.07), bottom: top - 0.75, roof: flat(top - 0.6) };
    let pole = Cylinder { x, y, radius: 0.16, bottom: ground - 0.5, top };
    let finish = Finish::Plain { colour: rgb(112, 96, 80) };
    let part = |shape| Part { class: Class::Structure, finish, shape };
    b.add(Kind::Structure, vec![part(Shape::Cylinder(pole)), part(Shape::Prism(arm))]);
}

/// Wires between the crossarms of two poles (foot of each, height over its ground): they sag.
pub(super) fn wires(b: &mut Builder<'_>, from: [f64; 2], to: [f64; 2], height: f64) {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let length = libm::hypot(dx, dy);
    if length < 1.0 {
        return;
    }
    let axis = [dx / length, dy / length];
    let (z0, z1) = (b.ground(from[0], from[1]), b.ground(to[0], to[1]));
    let sag = 0.012 * length;
    let mut parts = Vec::new();
    for (side, drop, half_width) in
        [(-1.1, 0.55, 0.03), (0.0, 0.1, 0.03), (1.1, 0.55, 0.03), (0.15, 3.2, 0.06)]
    {
        let z = |t: f64| z0 + (z1 - z0) * t + height - drop - 4.0 * sag * t * (1.0 - t);
        for k in 0..WIRE_PIECES {
            let [t0, t1] = [k, k + 1].map(|k| k as f64 / WIRE_PIECES as f64);
            let (t, piece) = (0.5 * (t0 + t1), length / WIRE_PIECES as f64);
            let middle = [from[0] + dx * t - axis[1] * side, from[1] + dy * t + axis[0] * side];
            let top = 0.5 * (z(t0) + z(t1));
            let rect = Rect::new(middle, axis, piece / 2.0, half_width);
            let roof = Roof::Plane { z: top, du: (z(t1) - z(t0)) / piece, dv: 0.0 };
            // Bodies end in a level underside: what a wire of one piece falls is part of it.
            let bottom = z(t0).min(z(t1)) - 2.0 * half_width;
            let finish = Finish::Plain { colour: rgb(150, 150, 148) };
            let shape = Shape::Prism(Prism { rect, bottom, roof });
            parts.push(Part { class: Class::Structure, finish, shape });
        }
    }
    b.add_at(Kind::Structure, Some(Epoch::Image), parts);
}
