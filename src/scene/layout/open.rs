//! Parks, forest, and the waterfront with its docks.

use super::plants::jitter;
use super::{Builder, detail};
use crate::random::Draw;
use crate::scene::object::{Class, Cover, Finish, Kind, Part, rgb};
use crate::scene::purpose;
use crate::scene::shape::Rect;
use crate::scene::solid::{Prism, Roof, Shape, flat};
use crate::scene::spec::Side;
use crate::scene::streets::BlockArea;

pub(super) fn park(b: &mut Builder<'_>, block: &BlockArea) {
    let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 40]);
    let all = b.street_rect([block.s0, block.s1], [block.t0, block.t1]);
    let mut free: Vec<Rect> = Vec::new();
    if draw.chance(0.75) {
        let (half_u, half_v, cover) = if draw.chance(0.6) || all.half_u.min(all.half_v) < 26.0 {
            (18.0, 9.0, Cover::TennisCourt)
        } else {
            (32.0, 22.0, Cover::Pitch)
        };
        let long = if all.half_u >= all.half_v { all } else { all.turned() };
        let (ru, rv) = (long.half_u - half_u - 2.0, long.half_v - half_v - 2.0);
        if ru > 0.0 && rv > 0.0 {
            let court = long.sub(draw.range(-ru, ru), draw.range(-rv, rv), half_u, half_v);
            b.paint(court, cover);
            free.push(court.sub(0.0, 0.0, half_u + 2.0, half_v + 2.0));
        }
    }
    // Two paths that cross.
    let (pu, pv) = (draw.range(-0.4, 0.4) * all.half_u, draw.range(-0.4, 0.4) * all.half_v);
    for path in [all.sub(0.0, pv, all.half_u, 1.1), all.sub(pu, 0.0, 1.1, all.half_v)] {
        if free.iter().all(|f| !overlaps(f, &path)) {
            b.paint(path, draw.pick([Cover::Concrete, Cover::Gravel, Cover::Asphalt]));
            free.push(path.sub(0.0, 0.0, path.half_u + 0.8, path.half_v + 0.8));
        }
    }
    scatter(b, &mut draw, &all, b.spec.trees.park_per_hectare, &free);
}

/// Whether two rectangles with the same axes (up to quarter turns) overlap.
fn overlaps(a: &Rect, b: &Rect) -> bool {
    let (u, v) = a.local(b.x, b.y);
    let parallel = (a.cos * b.cos + a.sin * b.sin).abs() > 0.5;
    let (bu, bv) = if parallel { (b.half_u, b.half_v) } else { (b.half_v, b.half_u) };
    u.abs() < a.half_u + bu && v.abs() < a.half_v + bv
}

pub(super) fn forest(b: &mut Builder<'_>, block: &BlockArea) {
    let mut draw = b.draw(purpose::LOTS, &[block.index[0], block.index[1], 50]);
    let all = b.street_rect([block.s0, block.s1], [block.t0, block.t1]);
    match b.spec.detail.filter(|d| d.closed_canopy > 0.0) {
        Some(d) => detail::canopy(b, &mut draw, &all, d.closed_canopy),
        None => scatter(b, &mut draw, &all, b.spec.trees.forest_per_hectare, &[]),
    }
}

/// Plants trees on a jittered lattice, in clumps, with undergrowth.
fn scatter(b: &mut Builder<'_>, draw: &mut Draw, area: &Rect, per_hectare: f64, free: &[Rect]) {
    if per_hectare <= 0.0 {
        return;
    }
    let step = (10_000.0 / per_hectare).sqrt();
    let clump = draw.bits() as u32;
    let (nu, nv) =
        ((2.0 * area.half_u / step).ceil() as i64, (2.0 * area.half_v / step).ceil() as i64);
    for i in 0..nu {
        for j in 0..nv {
            let u = -area.half_u + (i as f64 + draw.range(0.0, 1.0)) * step;
            let v = -area.half_v + (j as f64 + draw.range(0.0, 1.0)) * step;
            let [x, y] =
                area.at(u.clamp(-area.half_u, area.half_u), v.clamp(-area.half_v, area.half_v));
            if free.iter().any(|f| f.contains(x, y)) {
                continue;
            }
            let dense = f64::from(crate::scene::noise::value(x / 24.0, y / 24.0, clump));
            if draw.chance(0.35 + dense) {
                let scale = draw.range(0.35, 1.0);
                b.plant_tree(draw, x, y, scale);
            } else if draw.chance(0.5) {
                b.plant_shrub(draw, x, y);
            }
        }
    }
}

/// Docks at right angles to the shore, with boats beside them.
pub(super) fn waterfront(b: &mut Builder<'_>) {
    let Some(water) = b.spec.water else { return };
    let (along_y, sign) = match water.side {
        Side::West => (true, -1.0),
        Side::East => (true, 1.0),
        Side::South => (false, -1.0),
        Side::North => (false, 1.0),
    };
    let out = if along_y { [sign, 0.0] } else { [0.0, sign] };
    let (low, high) =
        if along_y { (b.area.south, b.area.north) } else { (b.area.west, b.area.east) };
    let docks = ((high - low) / 100.0 * water.docks_per_100_metres).round();
    let pitch = (high - low) / docks.max(1.0);
    for k in 0..docks as i64 {
        let mut draw = b.draw(purpose::LOTS, &[60, k]);
        let along = low + (k as f64 + draw.range(0.25, 0.75)) * pitch;
        let point = |outward: f64| {
            if along_y { [outward * sign, along] } else { [along, outward * sign] }
        };
        // Walk out from the middle of the scene to the shore.
        let mut at = 0.0;
        let end = libm::hypot(b.area.east, b.area.north);
        while at < end && b.terrain.inland(point(at)[0], point(at)[1]) > -1.0 {
            at += 0.25;
        }
        if at >= end {
            continue;
        }
        dock(b, &mut draw, point(at), out, water.level_metres);
    }
}

fn dock(b: &mut Builder<'_>, draw: &mut Draw, shore: [f64; 2], out: [f64; 2], level: f64) {
    let length = draw.range(16.0, 34.0);
    let half_width = draw.range(1.1, 1.9);
    let middle = [0, 1].map(|i| shore[i] + out[i] * (length / 2.0 - 4.0));
    let deck = Rect::new(middle, out, length / 2.0, half_width);
    let wood = jitter(draw, rgb(150, 136, 116), 0.15);
    let top = level + 1.1;
    let plank = |rect: Rect, seed: u32| Part {
        class: Class::Structure,
        finish: Finish::Planks { colour: wood, seed },
        shape: Shape::Prism(Prism { rect, bottom: level + 0.6, roof: flat(top) }),
    };
    let mut parts = vec![plank(deck, draw.bits() as u32)];
    let mut berths = Vec::new();
    let fingers = ((length - 9.0) / 6.5).floor().max(0.0) as i64;
    for k in 0..fingers {
        let u = deck.half_u - 1.0 - k as f64 * 6.5;
        for side in [-1.0, 1.0] {
            let reach = 4.0;
            parts.push(plank(
                deck.sub(u, side * (half_width + reach), 0.45, reach),
                draw.bits() as u32,
            ));
            berths.push(deck.sub(u - 3.2, side * (half_width + reach + 0.4), 1.35, 3.7).turned());
        }
    }
    b.add(Kind::Structure, parts);
    for berth in berths {
        if draw.chance(0.6) {
            boat(b, draw, berth, level);
        }
    }
}

fn boat(b: &mut Builder<'_>, draw: &mut Draw, rect: Rect, level: f64) {
    let corners_afloat = rect.corners().iter().all(|c| b.terrain.inland(c[0], c[1]) < -0.5);
    if !corners_afloat {
        return;
    }
    let hull = jitter(
        draw,
        draw.clone().pick([rgb(236, 236, 232), rgb(226, 228, 230), rgb(52, 70, 104)]),
        0.06,
    );
    let part = |rect: Rect, roof: Roof, finish: Finish| Part {
        class: Class::Structure,
        finish,
        shape: Shape::Prism(Prism { rect, bottom: level - 0.5, roof }),
    };
    let cabin = rect.sub(-0.1 * rect.half_u, 0.0, rect.half_u * 0.4, rect.half_v * 0.62);
    let bow = rect.sub(rect.half_u * 0.86, 0.0, rect.half_u * 0.24, rect.half_v * 0.55);
    b.add(
        Kind::Structure,
        vec![
            part(
                rect.sub(-0.08 * rect.half_u, 0.0, rect.half_u * 0.8, rect.half_v * 0.85),
                flat(level + 0.9),
                Finish::Plain { colour: hull },
            ),
            part(bow, flat(level + 1.0), Finish::Plain { colour: hull }),
            part(cabin, flat(level + 2.1), Finish::CarCabin { colour: rgb(240, 240, 238) }),
        ],
    );
}
