//! The engine with stand-ins for picture and network whose answers are known.

use super::city::{Along, City, Levels};
use super::column::ColumnIntegral;
use super::engine::{Engine, LineSink, Outcome, WindowModel, WindowSource};
use super::layout::{AxisWindows, Blend, WINDOW, WindowOptions};
use super::{TileError, explain};
use crate::batch::Interrupt;
use crate::footprint::Footprint;
use crate::model::field::Field;
use crate::model::field::closed_form::{BoxCity, Building};
use crate::model::render::{DensityGrid, Lattice, RenderOptions, density_grid};
use crate::model::scene::SceneParts;
use crate::model::{Image8, Scene};
use std::io;
use std::ops::Range;
use std::path::Path;

const LEVELS: usize = 3;

/// Densities that depend on the place on the ground alone, or also on the window.
struct Stub {
    /// Changes the density by this much times the window's number.
    differs: f32,
}

fn ground(x: i64, y: i64, level: usize) -> f32 {
    let wave = libm::sin(x as f64 * 0.11) * libm::cos(y as f64 * 0.07);
    (20.0 + 15.0 * wave + 7.0 * level as f64 + (x * 31 + y * 17).rem_euclid(13) as f64) as f32
}

impl WindowModel for Stub {
    fn densities(&self, _picture: &Image8, start: [i64; 2]) -> Result<DensityGrid, String> {
        let size = WINDOW as usize;
        let lattice = Lattice { z: levels().z, ..Lattice::pixels(size, 0.8) };
        let mut values = Vec::with_capacity(size * size * LEVELS);
        for x in 0..i64::from(WINDOW) {
            for y in 0..i64::from(WINDOW) {
                for level in 0..LEVELS {
                    let own = self.differs * ((start[0] * 7 + start[1]) % 11) as f32;
                    values.push(ground(start[0] + x, start[1] + y, level) + own);
                }
            }
        }
        Ok(DensityGrid { lattice, values })
    }
}

/// A picture of nothing, with holes.
struct Plain {
    size: [u32; 2],
    holes: Vec<[Range<u32>; 2]>,
}

impl Plain {
    fn holds(&self, x: i64, y: i64) -> bool {
        let [x, y] = [x, y].map(|at| at.max(0) as u32);
        !self.holes.iter().any(|[columns, rows]| columns.contains(&x) && rows.contains(&y))
    }
}

impl WindowSource for Plain {
    fn window(&self, x: i64, y: i64) -> io::Result<(Image8, Vec<bool>)> {
        let size = WINDOW as usize;
        let picture =
            Image8 { width: size, height: size, channels: 3, data: vec![0; size * size * 3] };
        let inside = |at: i64, count: u32| at.clamp(0, i64::from(count) - 1);
        let valid = (0..size * size).map(|at| {
            let (column, row) = (x + (at % size) as i64, y + (at / size) as i64);
            self.holds(inside(column, self.size[0]), inside(row, self.size[1]))
        });
        Ok((picture, valid.collect()))
    }

    fn valid(&self, [columns, rows]: [Range<u32>; 2]) -> io::Result<Option<Vec<bool>>> {
        if self.holes.is_empty() {
            return Ok(None);
        }
        let holds = |row: u32, column: u32| self.holds(column.into(), row.into());
        Ok(Some(
            rows.flat_map(|row| columns.clone().map(move |c| (row, c)))
                .map(|(r, c)| holds(r, c))
                .collect(),
        ))
    }
}

/// Keeps everything.
#[derive(Default)]
struct Kept {
    lines: Vec<(u32, Vec<f32>)>,
    windows: [usize; 2],
}

impl LineSink for Kept {
    fn line(&mut self, line: u32, densities: &[f32]) -> Result<(), TileError> {
        self.lines.push((line, densities.to_vec()));
        Ok(())
    }

    fn window(&mut self, _first_line: u32, run: bool) {
        self.windows[usize::from(!run)] += 1;
    }
}

fn levels() -> Levels {
    Levels { z: vec![-0.8, -0.1, 0.5], ends: [-1.0, 1.0] }
}

fn city(size: [u32; 2], along: Along) -> City {
    City {
        size,
        footprint: Footprint::of_gsd(size, [0.25, 0.25]),
        assumed: false,
        levels: levels(),
        vertical_m: 32.24,
        along,
    }
}

struct Case<'a> {
    size: [u32; 2],
    along: Along,
    windows: WindowOptions,
    holes: Vec<[Range<u32>; 2]>,
    differs: f32,
    spill: Option<&'a Path>,
}

impl Case<'_> {
    fn plain(size: [u32; 2], stride: u32, trim: u32, blend: Blend) -> Self {
        let windows = WindowOptions { stride, trim, blend };
        Self { size, along: Along::Y, windows, holes: Vec::new(), differs: 0.0, spill: None }
    }

    /// Lines of a range.
    fn lines(&self, range: Option<Range<u32>>) -> Kept {
        let city = city(self.size, self.along);
        let windows = self.size.map(|size| AxisWindows::new(size, &self.windows).expect("windows"));
        let source = Plain { size: self.size, holes: self.holes.clone() };
        let engine = Engine {
            city: &city,
            windows: &windows,
            source: &source,
            model: &Stub { differs: self.differs },
            spill: self.spill,
            stop: &Interrupt::default(),
            progress: &|| {},
        };
        let range = range.unwrap_or(0..city.lines_across()[0]);
        let mut kept = Kept::default();
        let outcome = engine.run(range.clone(), &mut kept).expect("runs");
        assert_eq!(outcome, Outcome::Complete);
        assert!(kept.lines.iter().map(|(line, _)| *line).eq(range.clone()));
        assert_eq!(kept.windows.iter().sum::<usize>(), engine.count(&range));
        kept
    }

    /// Density at a pixel of the whole.
    fn at(&self, kept: &Kept, x: u32, y: u32, level: usize) -> f32 {
        let (line, across) = if self.along == Along::X { (x, y) } else { (y, x) };
        kept.lines[line as usize].1[across as usize * LEVELS + level]
    }
}

#[test]
fn what_hangs_on_the_place_alone_has_no_seams() {
    for size in [[520, 300], [300, 260], [100, 700], [256, 256], [1, 400], [37, 5]] {
        for (stride, trim) in [(256, 0), (128, 0), (100, 0), (64, 32), (150, 50)] {
            for blend in [Blend::Mean, Blend::Hann, Blend::Gaussian] {
                let along = if size[0] > size[1] { Along::X } else { Along::Y };
                let case = Case { along, ..Case::plain(size, stride, trim, blend) };
                let kept = case.lines(None);
                for x in 0..size[0] {
                    for y in 0..size[1] {
                        for level in 0..LEVELS {
                            let found = case.at(&kept, x, y, level);
                            let wanted = ground(x.into(), y.into(), level);
                            assert!(
                                (found - wanted).abs() <= 1e-6 * wanted,
                                "{size:?} {stride} {trim} {blend:?} at {x}, {y}: {found}, not {wanted}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn one_window_is_kept_bit_for_bit() {
    let case = Case::plain([256, 256], 128, 0, Blend::Mean);
    let kept = case.lines(None);
    for at in [[0, 0], [255, 0], [17, 200], [255, 255]] {
        assert_eq!(case.at(&kept, at[0], at[1], 1), ground(at[0].into(), at[1].into(), 1));
    }
}

#[test]
fn a_part_has_the_same_bits_as_the_whole() {
    for along in [Along::X, Along::Y] {
        for (stride, trim, blend) in
            [(128, 0, Blend::Mean), (64, 32, Blend::Gaussian), (100, 10, Blend::Hann)]
        {
            let case =
                Case { along, differs: 0.37, ..Case::plain([700, 610], stride, trim, blend) };
            let whole = case.lines(None);
            for range in [255..512_u32, 511..600, 0..256, 300..301] {
                let part = case.lines(Some(range.clone()));
                for (line, densities) in &part.lines {
                    assert_eq!(
                        densities, &whole.lines[*line as usize].1,
                        "{along:?} {range:?} {line}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_direction_does_not_matter() {
    let [x, y] = [Along::X, Along::Y].map(|along| {
        let case = Case { along, differs: 0.5, ..Case::plain([420, 380], 96, 20, Blend::Hann) };
        let kept = case.lines(None);
        (0..420)
            .flat_map(|x| (0..380).map(move |y| (x, y)))
            .map(|(x, y)| case.at(&kept, x, y, 2))
            .collect::<Vec<_>>()
    });
    assert!(x.iter().zip(&y).all(|(a, b)| (a - b).abs() <= 2e-6 * a));
}

#[test]
fn sums_in_a_file_are_those_in_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let memory = Case { differs: 0.3, ..Case::plain([300, 530], 100, 0, Blend::Gaussian) };
    let file = Case { spill: Some(folder.path()), holes: Vec::new(), ..memory };
    let found = file.lines(None).lines;
    let memory = Case { spill: None, ..file };
    assert_eq!(memory.lines(None).lines, found);
    assert_eq!(std::fs::read_dir(folder.path()).expect("reads").count(), 0);
}

#[test]
fn windows_that_differ_are_averaged() {
    // Two windows of 256 in 384 pixels: the middle 128 columns are covered by both.
    let case = Case { differs: 1.0, ..Case::plain([384, 256], 128, 0, Blend::Mean) };
    let kept = case.lines(None);
    let own = |start: i64| ((start * 7) % 11) as f32;
    for (x, over) in [(10, vec![0]), (200, vec![0, 128]), (300, vec![128])] {
        let added: f32 = over.iter().map(|start| own(*start)).sum::<f32>() / over.len() as f32;
        let wanted = ground(x.into(), 40, 0) + added;
        assert!((case.at(&kept, x, 40, 0) - wanted).abs() < 1e-5, "{x}");
    }
}

#[test]
fn no_data_is_left_out_and_not_guessed() {
    for along in [Along::X, Along::Y] {
        // The east half is empty: windows from 512 on hold nothing.
        let holes = vec![[450..1000, 0..400], [100..110, 50..60]];
        let case =
            Case { along, differs: 0.9, holes, ..Case::plain([1000, 400], 256, 0, Blend::Mean) };
        let kept = case.lines(None);
        assert!(kept.windows[1] > 0, "some windows hold nothing");
        for (x, y, holds) in [
            (0, 0, true),
            (449, 399, true),
            (450, 0, false),
            (999, 399, false),
            (105, 55, false),
            (99, 55, true),
        ] {
            assert_eq!(!case.at(&kept, x, y, 0).is_nan(), holds, "{along:?} {x} {y}");
        }
    }
}

#[test]
fn windows_left_out_do_not_dim_their_neighbours() {
    // One valid column west of an empty window that would have counted for it.
    let holes = vec![[257..600, 0..256]];
    let case = Case { holes, ..Case::plain([600, 256], 200, 0, Blend::Gaussian) };
    let kept = case.lines(None);
    assert_eq!(kept.windows, [2, 1]);
    for x in [0, 199, 230, 256] {
        let wanted = ground(x.into(), 9, 2);
        assert!((case.at(&kept, x, 9, 2) - wanted).abs() < 1e-5 * wanted, "{x}");
    }
}

/// A city of boxes, with what infer's stable rule and the column integral make of it.
fn heights(boxes: &BoxCity) -> (Vec<f32>, Vec<f32>) {
    let (inputs, head) = boxes.inputs();
    let field = Field::new(&inputs, &head, None).expect("a field");
    let lattice = Lattice::pixels(256, 0.8);
    let city = City {
        levels: Levels { z: lattice.z.clone(), ends: [-1.0, 1.0] },
        ..city([256, 256], Along::X)
    };
    let grid = density_grid(&field, lattice);
    let columns = ColumnIntegral::new(&city).heights(&grid.values);
    let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 });
    let dsm = scene.expect("a scene").dsm(256, &RenderOptions::stable());
    let columns = (0..256 * 256).map(|at| columns[at % 256 * 256 + at / 256]).collect();
    (dsm.height.iter().map(|height| height * 64.48).collect(), columns)
}

#[test]
fn the_column_integral_is_infers_stable_rule() {
    let tall = |roof| Building { x: [-0.5, 0.1], y: [-0.4, 0.3], roof };
    for boxes in [
        BoxCity::example(),
        BoxCity { buildings: vec![tall(0.77)], steepness: 150.0, ..BoxCity::example() },
        BoxCity { buildings: vec![tall(-0.7)], gain: 8.0, bias: -2.0, ..BoxCity::example() },
    ] {
        let (stable, columns) = heights(&boxes);
        let (mut sum, mut worst) = (0.0_f64, 0.0_f64);
        for (a, b) in stable.iter().zip(&columns) {
            assert_eq!(a.is_nan(), b.is_nan());
            let off = f64::from((a - b).abs());
            sum += off;
            worst = worst.max(off);
        }
        let mean = sum / stable.len() as f64;
        eprintln!("mean difference {mean:.5} m, worst {worst:.4} m");
        assert!(mean < explain::COLUMN_MEAN * 32.24, "{mean}");
        assert!(mean < 0.1 && worst < 0.2, "{mean} {worst}");
    }
}

#[test]
fn empty_and_full_columns() {
    let integral = ColumnIntegral::new(&city([1, 1], Along::Y));
    let columns =
        [[0.0; 3], [f32::NAN; 3], [1e30; 3], [0.0, 0.0, 1e-3], [1e-30, 0.0, 0.0]].concat();
    let heights = integral.heights(&columns);
    assert!(
        heights[0].is_nan() && heights[1].is_nan() && heights[3].is_nan() && heights[4].is_nan()
    );
    // All light ends at the very top.
    assert!((heights[2] - 64.48).abs() < 1e-4, "{}", heights[2]);
    // One level of density s between -0.45 and 0.2: the expected end has a closed form.
    let (s, from, to) = (4.0_f64, -0.45_f64, 0.2_f64);
    let tau = s * (to - from);
    let ends = -libm::expm1(-tau);
    let away = 1.0 / s - (to - from) * (1.0 - ends) / ends;
    let wanted = (to - away + 1.0) * 32.24;
    let found = integral.heights(&[0.0, s as f32, 0.0]);
    assert!((f64::from(found[0]) - wanted).abs() < 1e-4, "{} {wanted}", found[0]);
}
