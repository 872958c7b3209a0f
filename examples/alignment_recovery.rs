//! How often alignment finds a known shift and a known rotation, on simulated cities or on given
//! ground truths. Prints the tables of `docs/eval-alignment.md`:
//!
//! ```text
//! cargo run --release --example alignment_recovery            # simulated cities
//! cargo run --release --example alignment_recovery -- FOLDER  # FOLDER/*_dsm.npz, key `dsm`
//! ```

use sat3d::eval::align::{AlignSettings, Aligner, AlignmentFlag, Shift};
use sat3d::eval::{OffsetMethod, Protocol, Surface};
use sat3d::random::{Draw, key, normal};
use sat3d::raster::npz;
use std::f64::consts::TAU;

/// Pixels along a side, as predictions have.
const SIDE: usize = 256;
/// Trials per row of a table.
const TRIALS: u64 = 100;

/// A flat-roofed building, turned by its cosine and sine.
struct Building {
    centre: (f64, f64),
    half: (f64, f64),
    turn: (f64, f64),
    height: f64,
}

/// Heights that can be sampled anywhere; coordinates in pixels of the truth.
enum Scene {
    City { buildings: Vec<Building>, waves: Vec<[f64; 4]> },
    Grid { side: usize, values: Vec<f32> },
}

impl Scene {
    /// Buildings of 3 to 40 m on ground that undulates by a few metres.
    fn city(seed: u64) -> Self {
        let mut draw = Draw::new(&[seed, 1]);
        let street = draw.range(-0.4, 0.4);
        let buildings = (0..70)
            .map(|_| {
                let angle = street + draw.range(-0.05, 0.05);
                Building {
                    centre: (draw.range(-40.0, 296.0), draw.range(-40.0, 296.0)),
                    half: (draw.range(5.0, 20.0), draw.range(5.0, 20.0)),
                    turn: (libm::cos(angle), libm::sin(angle)),
                    height: draw.range(3.0, 14.0) * if draw.chance(0.2) { 3.0 } else { 1.0 },
                }
            })
            .collect();
        let waves = (0..5)
            .map(|_| {
                let k = TAU / draw.range(80.0, 400.0);
                let angle = draw.range(0.0, TAU);
                [k * libm::cos(angle), k * libm::sin(angle), draw.range(0.0, TAU), 0.8]
            })
            .collect();
        Self::City { buildings, waves }
    }

    fn height(&self, x: f64, y: f64) -> f64 {
        match self {
            Self::City { buildings, waves } => {
                let ground: f64 =
                    waves.iter().map(|[kx, ky, p, a]| a * libm::sin(kx * x + ky * y + p)).sum();
                let roof = buildings
                    .iter()
                    .filter(|b| {
                        let (dx, dy) = (x - b.centre.0, y - b.centre.1);
                        (dx * b.turn.0 + dy * b.turn.1).abs() < b.half.0
                            && (dy * b.turn.0 - dx * b.turn.1).abs() < b.half.1
                    })
                    .map(|b| b.height)
                    .fold(0.0, f64::max);
                ground + roof
            }
            Self::Grid { side, values } => {
                let scale = *side as f64 / SIDE as f64;
                let last = (side - 1) as f64;
                let at = |v: f64| ((v + 0.5) * scale - 0.5).clamp(0.0, last);
                let (x, y) = (at(x), at(y));
                let (column, row) = (x as usize, y as usize);
                let (right, below) = ((column + 1).min(side - 1), (row + 1).min(side - 1));
                let (fx, fy) = (x - column as f64, y - row as f64);
                let value = |row: usize, column: usize| f64::from(values[row * side + column]);
                (value(row, column) * (1.0 - fx) + value(row, right) * fx) * (1.0 - fy)
                    + (value(below, column) * (1.0 - fx) + value(below, right) * fx) * fy
            }
        }
    }

    /// What a grid sees whose truth has to be shifted, then turned, to lie on it; each pixel is the
    /// mean of four samples.
    fn seen(&self, shift: Shift, rotation_deg: f64) -> Surface {
        let angle = rotation_deg.to_radians();
        let (cosine, sine) = (libm::cos(angle), libm::sin(angle));
        let centre = (SIDE as f64 - 1.0) / 2.0;
        let mut values = Vec::with_capacity(SIDE * SIDE);
        for row in 0..SIDE {
            for column in 0..SIDE {
                let mut sum = 0.0;
                for (dy, dx) in [(-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)] {
                    let (y, x) = (row as f64 + dy - centre, column as f64 + dx - centre);
                    let source_y = cosine * y + sine * x + centre - shift.y;
                    let source_x = -sine * y + cosine * x + centre - shift.x;
                    sum += self.height(source_x, source_y);
                }
                values.push((sum / 4.0) as f32);
            }
        }
        Surface::new(SIDE, SIDE, values)
    }
}

/// Gaussian blur; edges are continued.
fn blur(surface: &Surface, sigma: f64) -> Surface {
    if sigma == 0.0 {
        return surface.clone();
    }
    let reach = (4.0 * sigma).ceil() as i64;
    let kernel: Vec<f64> = (-reach..=reach)
        .map(|i| libm::exp(-0.5 * (i as f64 / sigma) * (i as f64 / sigma)))
        .collect();
    let total: f64 = kernel.iter().sum();
    let pass = |values: &[f32], step: usize, other: usize| -> Vec<f32> {
        let mut out = vec![0.0; values.len()];
        for line in 0..SIDE {
            for at in 0..SIDE {
                let sum: f64 = kernel
                    .iter()
                    .zip(-reach..)
                    .map(|(k, i)| {
                        let from = (at as i64 + i).clamp(0, SIDE as i64 - 1) as usize;
                        k * f64::from(values[line * other + from * step])
                    })
                    .sum();
                out[line * other + at * step] = (sum / total) as f32;
            }
        }
        out
    };
    let across = pass(&surface.values, 1, SIDE);
    Surface::new(SIDE, SIDE, pass(&across, SIDE, 1))
}

fn noisy(mut surface: Surface, sigma: f64, seed: u64) -> Surface {
    for (i, value) in surface.values.iter_mut().enumerate() {
        *value += (sigma * normal(key(&[seed, 9, i as u64]))) as f32;
    }
    surface
}

/// What became of the trials of one row.
#[derive(Default)]
struct Row {
    shift: u32,
    at_zero: u32,
    rotation: u32,
    both: u32,
    left: u32,
    off_px: Vec<f64>,
    fine: u32,
    refused: u32,
}

impl Row {
    fn print(&mut self, blur_px: f64, noise_m: f64) {
        self.off_px.sort_unstable_by(f64::total_cmp);
        let per_cent = |n: u32| 100.0 * f64::from(n) / TRIALS as f64;
        println!(
            "| {blur_px} | {noise_m} | {:.0} | {:.0} | {:.0} | {:.0} | {:.0} | {:.1} | {:.0} | {:.0} |",
            per_cent(self.shift),
            per_cent(self.rotation),
            per_cent(self.both),
            per_cent(self.at_zero),
            per_cent(self.left),
            self.off_px.get(self.off_px.len() / 2).copied().unwrap_or(f64::NAN),
            per_cent(self.fine),
            per_cent(self.refused),
        );
    }
}

fn main() {
    let scenes: Vec<Scene> = match std::env::args().nth(1) {
        Some(folder) => given(&folder),
        None => (0..TRIALS).map(Scene::city).collect(),
    };
    let noise_free = [0.0, 1.0, 2.0, 4.0, 8.0].map(|b| (b, 0.0));
    let cells: Vec<(f64, f64)> = noise_free
        .into_iter()
        .chain([(0.0, 0.5), (0.0, 2.0), (2.0, 0.5), (2.0, 2.0), (8.0, 0.5)])
        .collect();
    for (title, shifts, turns) in [
        ("Shift only, up to 15 px", true, false),
        ("Rotation only, up to 8 degrees", false, true),
        ("Shift and rotation", true, true),
    ] {
        println!("\n{title}\n");
        println!(
            "| blur px | noise m | shift % | rotation % | both % | shift at 0 % | left % | off px | coregister % | refused % |"
        );
        println!("|---|---|---|---|---|---|---|---|---|---|");
        let mut rows: Vec<Row> = cells.iter().map(|_| Row::default()).collect();
        let mut aligner = Aligner::new();
        for trial in 0..TRIALS {
            let scene = &scenes[trial as usize % scenes.len()];
            let mut draw = Draw::new(&[trial, 2, u64::from(shifts), u64::from(turns)]);
            let mut range = |on: bool, limit: f64| if on { draw.range(-limit, limit) } else { 0.0 };
            let shift = Shift { x: range(shifts, 15.0), y: range(shifts, 15.0) };
            let rotation = (range(turns, 8.0) * 2.0).round() / 2.0;
            let truth = scene.seen(Shift::default(), 0.0);
            let seen = scene.seen(shift, rotation);
            for (row, &(blur_px, noise_m)) in rows.iter_mut().zip(&cells) {
                let prediction = noisy(blur(&seen, blur_px), noise_m, trial);
                count(row, &mut aligner, (&prediction, &truth), shift, rotation);
            }
        }
        for (row, &(blur_px, noise_m)) in rows.iter_mut().zip(&cells) {
            row.print(blur_px, noise_m);
        }
    }
}

/// Aligns one pair by both protocols and counts what they found.
fn count(
    row: &mut Row,
    aligner: &mut Aligner,
    (prediction, truth): (&Surface, &Surface),
    shift: Shift,
    rotation: f64,
) {
    let settings = AlignSettings {
        protocol: Protocol::Paper,
        offset: OffsetMethod::Median,
        seed: 0,
        pixel_m: (0.25, 0.25),
        max_shift_px: 20.0,
        max_rotation_deg: 10.0,
    };
    let off = |found: Shift| libm::hypot(found.x - shift.x, found.y - shift.y);
    if let Ok(found) = aligner.align(prediction, truth, &settings) {
        if found.flags.contains(&AlignmentFlag::ShiftBeyondLimit) {
            row.left += 1;
        } else {
            let distance = off(found.shift_px);
            let (near, turned) = (distance <= 0.5, (found.rotation_deg - rotation).abs() <= 0.5);
            row.off_px.push(distance);
            row.shift += u32::from(near);
            row.rotation += u32::from(turned);
            row.both += u32::from(near && turned);
            row.at_zero += u32::from(libm::hypot(found.shift_px.x, found.shift_px.y) <= 0.5);
        }
    }
    let settings = AlignSettings { protocol: Protocol::Coregister, ..settings };
    if let Ok(found) = aligner.align(prediction, truth, &settings) {
        if found.flags.is_empty() {
            row.fine += u32::from(off(found.shift_px) <= 0.5);
        } else {
            row.refused += 1;
        }
    }
}

/// Square ground truths without holes from a folder of npz files, sorted by name.
fn given(folder: &str) -> Vec<Scene> {
    let mut paths: Vec<_> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.to_string_lossy().ends_with("_dsm.npz"))
        .collect();
    paths.sort();
    let scenes: Vec<Scene> = paths
        .iter()
        .filter_map(|path| npz::read_one(path, "dsm").ok())
        .filter(|array| array.shape.len() == 2 && array.shape[0] == array.shape[1])
        .map(|array| Scene::Grid { side: array.shape[0], values: array.to_f32() })
        .filter(|scene| match scene {
            Scene::Grid { values, .. } => values.iter().all(|v| v.is_finite()),
            Scene::City { .. } => true,
        })
        .collect();
    assert!(!scenes.is_empty(), "no ground truths without holes in {folder}");
    scenes
}
