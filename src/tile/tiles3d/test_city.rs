//! A city to test with: blocks of houses between streets, with the colours of their roofs.

use crate::footprint::Footprint;
use crate::tile::city::{Along, City, Levels};
use crate::tile::slabs::{FOLDER, Kind, Slabs, file_name};
use crate::tile::surface::sink::SlabMesher;
use crate::tile::surface::store;
use std::path::Path;

/// Metres of height per cube unit.
pub const VERTICAL_M: f64 = 32.24;

/// A city on a picture of the same size.
pub fn city(size: [u32; 2], footprint: Footprint, along: Along, levels: u32) -> City {
    let step = 2.0 / f64::from(levels);
    City {
        size,
        footprint,
        assumed: false,
        levels: Levels {
            z: (0..levels).map(|k| (-1.0 + step * (f64::from(k) + 0.5)) as f32).collect(),
            ends: [-1.0, 1.0],
        },
        vertical_m: VERTICAL_M,
        along,
    }
}

/// A draw from 0 to 1 that hangs on a place.
fn draw(x: u32, y: u32, purpose: u32) -> f64 {
    let mut state = u64::from(x) << 32 ^ u64::from(y) << 8 ^ u64::from(purpose);
    state = (state ^ 0x9e37_79b9_7f4a_7c15).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    state = (state ^ state >> 29).wrapping_mul(0x94d0_49bb_1331_11eb);
    (state >> 40) as f64 / f64::from(1 << 24)
}

/// Height in metres above the lowest level, and colour.
pub fn houses([x, y]: [u32; 2]) -> (f64, [u8; 3]) {
    const LOT: u32 = 56;
    let ground = 8.0 + 3.0 * libm::sin(f64::from(x) / 170.0) * libm::cos(f64::from(y) / 130.0);
    let ([lot_x, lot_y], [u, v]) = ([x / LOT, y / LOT], [x % LOT, y % LOT]);
    let noise = draw(x, y, 9) * 18.0 - 9.0;
    let shade = |colour: [f64; 3]| colour.map(|value| (value + noise).clamp(0.0, 255.0) as u8);
    if u < 12 || v < 12 {
        // A street with a line along its middle.
        let line = (u == 6 && v >= 12 && y % 12 < 6) || (v == 6 && u >= 12 && x % 12 < 6);
        return (ground, shade(if line { [220.0; 3] } else { [92.0, 92.0, 96.0] }));
    }
    if draw(lot_x, lot_y, 1) < 0.15 {
        // A park with round trees.
        let [du, dv] = [u, v].map(|w| f64::from(w % 11) - 5.0);
        let crown = (22.0 - du * du - dv * dv).max(0.0).sqrt() * 1.2;
        let high = if crown > 0.0 { 3.0 + crown } else { 0.0 };
        let colour = if crown > 0.0 { [38.0, 84.0, 36.0] } else { [104.0, 142.0, 72.0] };
        return (ground + high, shade(colour));
    }
    let inset = 14 + (draw(lot_x, lot_y, 2) * 6.0) as u32;
    if u < inset || v < inset || u >= LOT - 3 || v >= LOT - 3 {
        return (ground, shade([124.0, 148.0, 92.0]));
    }
    let floors = 2.0 + (draw(lot_x, lot_y, 3) * draw(lot_x, lot_y, 4) * 11.0).floor();
    let warm = draw(lot_x, lot_y, 5);
    let roof = [120.0 + 90.0 * warm, 100.0 + 40.0 * (1.0 - warm), 86.0];
    let base = 8.0 + 3.0 * libm::sin(f64::from(lot_x)) * libm::cos(f64::from(lot_y));
    if floors < 4.0 {
        // A ridge.
        let middle = f64::from(inset + LOT - 3) / 2.0;
        let side = (f64::from(v) - middle).abs();
        let slope = if f64::from(v) < middle { 18.0 } else { -18.0 };
        let high = base.max(ground) + 3.2 * floors + (5.0 - 0.28 * side).max(0.0);
        return (high, shade(roof.map(|value| value + slope)));
    }
    (base.max(ground) + 3.2 * floors, shade([170.0, 168.0, 160.0 + 30.0 * warm]))
}

/// Writes what a finished run leaves: heights, colours and surface of each slab. A height of NaN is no surface.
pub fn write_slabs(out: &Path, city: &City, scene: impl Fn([u32; 2]) -> (f64, [u8; 3])) {
    std::fs::create_dir_all(out.join(FOLDER)).expect("a folder");
    let slabs = Slabs { city, out };
    let [_, across] = city.lines_across();
    let line_of = |line: u32| -> Vec<f32> {
        let column = |other: u32| {
            let at = match city.along {
                Along::X => [line, other],
                Along::Y => [other, line],
            };
            let (height, _) = scene(at);
            let top = height / city.vertical_m - 1.0;
            // 5 at the surface, and as steep as the levels lie apart.
            let steep = 5.0 * city.levels.z.len() as f64 / 2.0;
            city.levels.z.iter().map(move |z| {
                let density = 5.0 + steep * (top - f64::from(*z));
                density.clamp(0.0, 10.0) as f32
            })
        };
        (0..across).flat_map(column).collect()
    };
    for slab in 0..city.slabs() {
        let mut mesher = SlabMesher::new(city, slab, 5.0).expect("a mesher");
        let lines = city.lines(slab);
        if lines.start > 0 {
            mesher.prime(&line_of(lines.start - 1)).expect("a line");
        }
        for line in lines {
            mesher.push(line, &line_of(line)).expect("a line");
        }
        let tiles = mesher.finish().expect("tiles");
        let [columns, rows] = city.rectangle(slab);
        let pixels: Vec<_> =
            rows.flat_map(|y| columns.clone().map(move |x| [x, y])).map(&scene).collect();
        let heights: Vec<u8> =
            pixels.iter().flat_map(|(height, _)| (*height as f32).to_le_bytes()).collect();
        let colours: Vec<u8> = pixels.iter().flat_map(|(_, colour)| *colour).collect();
        for (kind, bytes) in [
            (Kind::Heights, heights),
            (Kind::Colours, colours),
            (Kind::Surface, store::encode(slab, &tiles)),
        ] {
            std::fs::write(slabs.path(slab, kind), bytes).expect("writes");
        }
        assert!(out.join(file_name(slab, Kind::Surface)).is_file());
    }
}
