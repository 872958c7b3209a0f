//! How solids look: roofs, walls with windows, cars, leaves. Pictures only.

use super::ground::{Paint, mix, scale};
use super::noise::{cell, fractal, value};
use super::object::{Colour, Covering, Finish, rgb};
use super::shape::Rect;
use super::solid::{Face, Shape};
use super::world::Solid;

/// Colour of a point on a face of a solid.
/// `leafy`: whether leaves show one by one (`[detail]`).
pub(super) fn paint(solid: &Solid, face: Face, at: [f64; 3], leafy: bool) -> Paint {
    let [x, y, z] = at;
    let frame = match &solid.shape {
        Shape::Prism(p) => Some((p.rect, p.rect.local(x, y))),
        _ => None,
    };
    match solid.finish {
        Finish::Roof { covering, colour, wall, storey, seed } => match (face, frame) {
            (Face::Wall(side), Some((rect, uv))) => {
                walls(&Wall { rect, uv, side, z, storey, seed }, wall)
            }
            (Face::Top(plane), Some((rect, uv))) => {
                let gabled =
                    matches!(&solid.shape, Shape::Prism(p) if p.gradient(plane) != (0.0, 0.0));
                roof(&RoofPoint { rect, uv, plane, gabled, at, seed }, covering, colour)
            }
            _ => Paint { colour, key: 0 },
        },
        Finish::Foliage { colour, seed } => foliage(solid, colour, seed, at, leafy),
        Finish::CarBody { colour } => car_body(frame, colour),
        Finish::CarCabin { colour } => car_cabin(frame, face, colour),
        Finish::Planks { colour, seed } => {
            let u = frame.map_or(x, |f| f.1.0);
            let plank = (u / 0.22).floor();
            let gap = u / 0.22 - plank < 0.14;
            let tone = 0.84 + 0.3 * cell(plank as i32, 0, seed);
            Paint { colour: scale(colour, if gap { 0.55 } else { tone }), key: 1 }
        }
        Finish::Machine { colour } => machine(frame, colour, at),
        Finish::Glass { colour } => {
            let (u, v) = frame.map_or((0.0, 0.0), |f| f.1);
            let bar = (u / 1.0).rem_euclid(1.0) < 0.07 || (v / 1.6).rem_euclid(1.0) < 0.05;
            let rim = frame.is_some_and(|(r, (u, v))| edge(&r, u, v) < 0.08);
            let tone = if bar || rim { 1.5 } else { 0.9 + 0.2 * value(x * 0.8, y * 0.8, 3) };
            Paint { colour: scale(colour, tone).map(|c| c.min(0.9)), key: 2 }
        }
        Finish::Corrugated { colour } => {
            let u = frame.map_or(x, |f| f.1.0);
            let tone = if (u / 0.3).rem_euclid(1.0) < 0.4 { 0.82 } else { 1.0 };
            let rust = fractal(x * 0.8, y * 0.8, 17, 3);
            Paint { colour: mix(scale(colour, tone), rgb(96, 70, 54), (rust - 0.6) * 3.0), key: 3 }
        }
        Finish::Plain { colour } => {
            let tone =
                0.9 + 0.16 * value(x * 2.0, y * 2.0, 29) + 0.06 * value(x * 9.0, y * 9.0, 31);
            Paint { colour: scale(colour, tone), key: 4 }
        }
    }
}

/// Distance from the nearest edge of a rectangle, metres.
fn edge(rect: &Rect, u: f64, v: f64) -> f64 {
    (rect.half_u - u.abs()).min(rect.half_v - v.abs())
}

struct RoofPoint {
    rect: Rect,
    uv: (f64, f64),
    plane: u8,
    gabled: bool,
    at: [f64; 3],
    seed: u32,
}

fn roof(p: &RoofPoint, covering: Covering, colour: Colour) -> Paint {
    let (u, v) = p.uv;
    let [x, y, _] = p.at;
    // `down` runs down the slope, `along` at right angles to it.
    let ends = p.gabled && p.plane >= 2;
    let (down, along) = if ends { (u.abs(), v) } else { (v.abs(), u) };
    let streak = fractal(along * 0.9, down * 0.22, p.seed, 3);
    let blotch = fractal(x / 3.2, y / 3.2, p.seed ^ 1, 3);
    let grain = value(x * 9.0, y * 9.0, p.seed ^ 2);
    let mut tone = 0.84 + 0.2 * blotch + 0.1 * streak + 0.07 * (grain - 0.5);
    let mut tint = colour;
    match covering {
        Covering::Shingle => {
            let course = (down / 0.3).floor();
            if down / 0.3 - course < 0.22 {
                tone *= 0.88;
            }
            let shift = f64::from(course as i32 & 1) * 0.5;
            tone *=
                0.93 + 0.14 * cell((along / 0.5 + shift).floor() as i32, course as i32, p.seed ^ 3);
        }
        Covering::Tile => {
            let row = (down / 0.38).floor();
            let wave = (along / 0.3).rem_euclid(1.0) as f32;
            tone *= 0.84 + 0.3 * (1.0 - (2.0 * wave - 1.0).abs());
            if down / 0.38 - row < 0.2 {
                tone *= 0.86;
            }
            tone *= 0.92 + 0.16 * cell((along / 0.3).floor() as i32, row as i32, p.seed ^ 3);
        }
        Covering::Metal => {
            let seam = (along / 0.5).rem_euclid(1.0);
            if seam < 0.14 {
                tone *= 0.8;
            } else if seam < 0.26 {
                tone *= 1.12;
            }
            let rust = fractal(along * 0.5, down * 0.12, p.seed ^ 4, 4);
            tint = mix(tint, rgb(132, 96, 70), (rust - 0.66) * 3.0);
        }
        Covering::Membrane => {
            let sheet = (v / 2.0 + 100.0).floor();
            if (v / 2.0 + 100.0) - sheet < 0.035 || (u / 9.0).rem_euclid(1.0) < 0.008 {
                tone *= 0.86;
            }
            tone *= 0.97 + 0.06 * cell(sheet as i32, 0, p.seed ^ 5);
            let puddle = fractal(x / 5.0, y / 5.0, p.seed ^ 6, 4);
            tone *= 1.0 - 0.5 * (puddle - 0.56).max(0.0) * 2.0;
        }
        Covering::Gravel => tone *= 0.86 + 0.3 * grain,
    }
    let (hu, hv) = (p.rect.half_u, p.rect.half_v);
    let mut key = 8 + u32::from(p.plane);
    if p.gabled {
        let border = edge(&p.rect, u, v);
        // Ridge caps, hips and gutters.
        let ridge = if ends { f64::INFINITY } else { v.abs() };
        let hip = if p.plane >= 2 || v.abs() > 0.2 {
            ((hv - v.abs()) - (hu - u.abs())).abs()
        } else {
            f64::INFINITY
        };
        if ridge < 0.13 {
            tone *= 1.18;
        } else if p.plane >= 2 && hip < 0.16 {
            tone *= 1.15;
        }
        if border < 0.12 {
            tone *= 0.72;
            key += 16;
        }
    }
    Paint { colour: scale(tint, tone), key }
}

struct Wall {
    rect: Rect,
    uv: (f64, f64),
    side: u8,
    z: f64,
    storey: f32,
    seed: u32,
}

fn walls(w: &Wall, colour: Colour) -> Paint {
    let (along, half) = if w.side < 2 { (w.uv.1, w.rect.half_v) } else { (w.uv.0, w.rect.half_u) };
    let grain = value(along * 3.0, w.z * 3.0, w.seed ^ 7);
    let plaster = scale(colour, 0.88 + 0.18 * grain);
    if w.storey <= 0.0 {
        let rib = (along / 0.6).rem_euclid(1.0) < 0.12;
        return Paint { colour: scale(plaster, if rib { 0.85 } else { 1.0 }), key: 30 };
    }
    let height = w.z / f64::from(w.storey);
    let floor = height.floor();
    let bays = (2.0 * half / 2.6).round().max(1.0);
    let bay = (along + half) / (2.0 * half) * bays;
    let (fx, fz) = (bay - bay.floor(), height - floor);
    let window = (0.2..0.8).contains(&fx) && (0.28..0.78).contains(&fz);
    if window {
        let lit = cell(bay.floor() as i32, floor as i32, w.seed ^ u32::from(w.side));
        return Paint { colour: scale(rgb(70, 84, 98), 0.5 + 0.9 * lit), key: 32 };
    }
    Paint { colour: if fz < 0.05 { scale(plaster, 0.82) } else { plaster }, key: 31 }
}

fn foliage(solid: &Solid, colour: Colour, seed: u32, at: [f64; 3], leafy: bool) -> Paint {
    let [x, y, z] = at;
    let clump = fractal(x * 1.25 + z * 0.4, y * 1.25 - z * 0.3, seed, 3);
    let leaf = value(x * 5.5 + z, y * 5.5, seed ^ 1);
    let spark = value(x * 11.0, y * 11.0 + z, seed ^ 2);
    // Light gets lost on the way down into a crown.
    let depth = match &solid.shape {
        Shape::Crown(c) => ((z - c.bottom) / (c.top - c.bottom).max(0.1)) as f32,
        _ => 1.0,
    };
    if leafy {
        let tone = (0.3 + 0.75 * clump + 0.62 * (leaf - 0.35) + 0.3 * (spark - 0.5)).max(0.12)
            * (0.36 + 0.68 * depth);
        let warm = mix(colour, [colour[0] * 1.3, colour[1] * 1.2, colour[2] * 0.75], leaf);
        return Paint { colour: scale(warm, tone), key: 0 };
    }
    let tone = (0.42 + 0.62 * clump + 0.32 * leaf + 0.2 * (spark - 0.5)) * (0.5 + 0.55 * depth);
    let warm = mix(colour, [colour[0] * 1.35, colour[1] * 1.2, colour[2] * 0.8], clump - 0.3);
    Paint { colour: scale(warm, tone), key: 0 }
}

fn car_body(frame: Option<(Rect, (f64, f64))>, colour: Colour) -> Paint {
    let Some((rect, (u, v))) = frame else { return Paint { colour, key: 0 } };
    let (nose, rim) = (u / rect.half_u, edge(&rect, u, v));
    let lamps = nose.abs() > 0.93 && v.abs() > 0.62 * rect.half_v;
    if lamps {
        let lamp = if nose > 0.0 { rgb(226, 226, 216) } else { rgb(150, 34, 30) };
        return Paint { colour: lamp, key: 1 };
    }
    let corner = (rect.half_u - u.abs()) + (rect.half_v - v.abs()) < 0.3;
    let tone = if corner || rim < 0.06 { 0.55 } else { 1.0 };
    Paint { colour: scale(colour, tone), key: 2 + u32::from(corner) }
}

fn car_cabin(frame: Option<(Rect, (f64, f64))>, face: Face, colour: Colour) -> Paint {
    let Some((rect, (u, v))) = frame else { return Paint { colour, key: 0 } };
    let glass = Paint { colour: rgb(38, 44, 52), key: 5 };
    if matches!(face, Face::Wall(_)) {
        return glass;
    }
    let (nose, side) = (u / rect.half_u, v.abs() / rect.half_v);
    if !(-0.66..=0.52).contains(&nose) {
        return if side > 0.93 { Paint { colour, key: 6 } } else { glass };
    }
    if side > 0.86 {
        return glass;
    }
    Paint { colour: scale(colour, 1.06).map(|c| c.min(0.95)), key: 6 }
}

fn machine(frame: Option<(Rect, (f64, f64))>, colour: Colour, at: [f64; 3]) -> Paint {
    let Some((rect, (u, v))) = frame else { return Paint { colour, key: 0 } };
    let small = rect.half_u.min(rect.half_v);
    let fans = (rect.half_u / small).round().max(1.0);
    let pitch = 2.0 * rect.half_u / fans;
    let fu = (u + rect.half_u).rem_euclid(pitch) - pitch / 2.0;
    let r = libm::hypot(fu, v) / small;
    if r < 0.68 {
        let blade = libm::atan2(v, fu) * 3.0;
        let tone = if libm::sin(blade) > 0.2 { 0.75 } else { 1.1 };
        return Paint { colour: scale(rgb(62, 64, 66), tone), key: 7 };
    }
    let grain = value(at[0] * 4.0, at[1] * 4.0, 41);
    Paint { colour: scale(colour, 0.92 + 0.14 * grain), key: 8 }
}
