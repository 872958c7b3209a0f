//! The average of overlapping windows against its slow exact version, and the released lattice, stride and trim against
//! the reference implementation's own slicing (fixtures/tile/README.md).
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::tiny_weights;
use sat3d::batch::Interrupt;
use sat3d::footprint::Footprint;
use sat3d::model::render::{DensityGrid, Lattice};
use sat3d::model::{Device, Image8, Model};
use sat3d::raster::npz::{self, NpyOwned};
use sat3d::tile::city::{Along, City, Levels};
use sat3d::tile::layout::{AxisWindows, Blend, WINDOW, WindowOptions};
use sat3d::tile::{
    Engine, LineSink, NetworkWindows, Outcome, TileError, TileLattice, WindowModel, WindowSource,
};
use std::collections::HashMap;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/tile").join(name)
}

fn arrays(name: &str) -> HashMap<String, NpyOwned> {
    npz::read(&fixture(name)).unwrap().into_iter().collect()
}

fn indices(array: &NpyOwned) -> Vec<usize> {
    array.to_f64().into_iter().map(|index| index as usize).collect()
}

/// A picture in memory.
struct Picture {
    width: usize,
    pixels: Vec<u8>,
}

impl WindowSource for Picture {
    fn window(&self, x: i64, y: i64) -> io::Result<(Image8, Vec<bool>)> {
        let side = WINDOW as usize;
        let data = (0..side)
            .flat_map(|row| {
                let first = ((y as usize + row) * self.width + x as usize) * 3;
                &self.pixels[first..first + side * 3]
            })
            .copied()
            .collect();
        Ok((Image8 { width: side, height: side, channels: 3, data }, vec![true; side * side]))
    }

    fn valid(&self, _: [Range<u32>; 2]) -> io::Result<Option<Vec<bool>>> {
        Ok(None)
    }
}

/// The density of `blend_oracle.py`.
struct Stub;

impl WindowModel for Stub {
    fn densities(&self, _: &Image8, [left, top]: [i64; 2]) -> Result<DensityGrid, String> {
        let axis = |start: i64| (start..start + i64::from(WINDOW)).map(|at| at as f32).collect();
        let lattice = Lattice { x: axis(left), y: axis(top), z: vec![-0.5, 0.0, 0.5] };
        let mut values = Vec::new();
        for x in left..left + i64::from(WINDOW) {
            for y in top..top + i64::from(WINDOW) {
                let value =
                    |level: i64| (31 * left + 17 * top + 7 * x + 13 * y + 101 * level) % 1009;
                values.extend((0..3).map(|level| value(level) as f32 / 64.0));
            }
        }
        Ok(DensityGrid { lattice, values })
    }
}

/// Keeps every line.
#[derive(Default)]
struct All(Vec<Vec<f32>>);

impl LineSink for All {
    fn line(&mut self, line: u32, densities: &[f32]) -> Result<(), TileError> {
        assert_eq!(line as usize, self.0.len());
        self.0.push(densities.to_vec());
        Ok(())
    }

    fn window(&mut self, _: u32, run: bool) {
        assert!(run);
    }
}

fn city(size: [u32; 2], levels: Levels, along: Along) -> City {
    let footprint = Footprint::of_gsd(size, [0.28; 2]);
    City { size, footprint, assumed: false, levels, vertical_m: 32.24, along }
}

/// All lines of a city whose slabs follow each other along `city.along`.
fn run(
    city: &City,
    options: &WindowOptions,
    source: &Picture,
    model: &dyn WindowModel,
    sink: &mut dyn LineSink,
) {
    let windows = city.size.map(|length| AxisWindows::new(length, options).unwrap());
    let (stop, progress) = (Interrupt::default(), || ());
    let engine = Engine {
        city,
        windows: &windows,
        source,
        model,
        spill: None,
        stop: &stop,
        progress: &progress,
    };
    let [lines, _] = city.lines_across();
    assert_eq!(engine.run(0..lines, sink).unwrap(), Outcome::Complete);
}

#[test]
fn averages_are_those_of_the_oracle() {
    let expected = arrays("blend.npz");
    let (rows, columns) = (indices(&expected["rows"]), indices(&expected["columns"]));
    let size = [420, 300];
    let picture = Picture { width: 420, pixels: vec![0; 420 * 300 * 3] };
    let levels = Levels { z: vec![-0.5, 0.0, 0.5], ends: [-0.75, 0.75] };
    let mut cases = 0;
    for along in [Along::X, Along::Y] {
        for blend in [Blend::Mean, Blend::Hann, Blend::Gaussian] {
            for (stride, trim) in [(128, 0), (128, 32), (64, 0), (64, 32), (96, 0), (96, 32)] {
                let mut lines = All::default();
                let city = city(size, levels.clone(), along);
                run(&city, &WindowOptions { stride, trim, blend }, &picture, &Stub, &mut lines);
                let name = format!("{}_stride{stride}_trim{trim}", blend.name());
                let value = |row: usize, column: usize, level: usize| match along {
                    Along::X => lines.0[column][row * 3 + level],
                    Along::Y => lines.0[row][column * 3 + level],
                };
                let sampled = expected[&name].to_f64();
                let mut oracle = sampled.iter();
                for row in &rows {
                    for column in &columns {
                        for level in 0..3 {
                            let (found, right) =
                                (value(*row, *column, level), oracle.next().unwrap());
                            // Weights and sums in single precision: a few units of 16's last place.
                            assert!(
                                (f64::from(found) - right).abs() < 1e-5,
                                "{name} {along:?}: {found} and {right} at row {row}, column {column}, level {level}"
                            );
                        }
                    }
                }
                assert!(oracle.next().is_none());
                for (level, right) in expected[&format!("{name}_sums")].to_f64().iter().enumerate()
                {
                    let pixels = (0..300).flat_map(|row| (0..420).map(move |column| (row, column)));
                    let sum: f64 =
                        pixels.map(|(row, column)| f64::from(value(row, column, level))).sum();
                    assert!(
                        (sum / right - 1.0).abs() < 1e-6,
                        "{name} {along:?}: {sum} and {right}"
                    );
                }
                cases += 1;
            }
        }
    }
    assert_eq!(cases * 2, expected.len() * 2 - 4);
}

/// What `reference.npz` and `reference.json` hold, gathered from rows as they come.
#[derive(Default)]
struct Volume {
    rows: Vec<Vec<f32>>,
    inside: u64,
    cut: [u64; 3],
}

const LEVELS: usize = 288;
const ISOVALUE: f32 = 4.5;

impl LineSink for Volume {
    fn line(&mut self, _: u32, row: &[f32]) -> Result<(), TileError> {
        let inside = |density: f32| density >= ISOVALUE;
        let apart = |a: &[f32], b: &[f32]| {
            a.iter().zip(b).filter(|(a, b)| inside(**a) != inside(**b)).count() as u64
        };
        self.inside += row.iter().filter(|density| inside(**density)).count() as u64;
        if let Some(before) = self.rows.last() {
            self.cut[0] += apart(before, row);
        }
        self.cut[1] += apart(row, &row[LEVELS..]);
        self.cut[2] +=
            row.chunks_exact(LEVELS).map(|column| apart(column, &column[1..])).sum::<u64>();
        self.rows.push(row.to_vec());
        Ok(())
    }

    fn window(&mut self, _: u32, run: bool) {
        assert!(run);
    }
}

#[test]
fn stride_64_and_trim_32_on_the_released_lattice_are_the_references_slicing() {
    let input = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png");
    let picture = image::open(input).unwrap().to_rgb8();
    let picture = image::imageops::crop_imm(&picture, 0, 0, 400, 400).to_image();
    let picture = Picture { width: 400, pixels: picture.into_raw() };
    let model = Model::load(&tiny_weights("tile_oracles"), &Device::Cpu.into()).unwrap();
    let lattice = TileLattice::Reference;
    let levels = lattice.levels(model.config.scale).unwrap();
    assert_eq!(levels.z.len(), LEVELS);
    // Slabs from north to south, so that lines are the reference's rows.
    let city = city([400, 400], levels, Along::Y);
    let options = WindowOptions { stride: 64, trim: 32, blend: Blend::Mean };
    let mut volume = Volume::default();
    run(&city, &options, &picture, &NetworkWindows { model: &model, lattice }, &mut volume);

    let expected = arrays("reference.npz");
    let mut largest = 0.0_f64;
    let mut compare = |what: &str, found: f32, right: f32| {
        // Two implementations of the network in single precision; densities reach 34.
        let off = f64::from(found - right).abs() / f64::from(right.abs().max(1.0));
        assert!(off < 2e-4, "{what}: {found} and {right}");
        largest = largest.max(off);
    };
    let [rows, columns, levels] =
        ["rows", "columns", "levels"].map(|name| indices(&expected[name]));
    let density = expected["density"].to_f32();
    let mut right = density.iter();
    for row in &rows {
        for column in &columns {
            for level in &levels {
                compare(
                    "density",
                    volume.rows[*row][column * LEVELS + level],
                    *right.next().unwrap(),
                );
            }
        }
    }
    for (at, (along_row, along_column)) in (expected["row_200_level_40"].to_f32().iter())
        .zip(expected["column_200_level_40"].to_f32())
        .enumerate()
    {
        compare("row 200", volume.rows[200][at * LEVELS + 40], *along_row);
        compare("column 200", volume.rows[at][200 * LEVELS + 40], along_column);
    }
    for (at, right) in expected["column_sums_stride4"].to_f32().into_iter().enumerate() {
        let (row, column) = (at / 100 * 4, at % 100 * 4);
        let column = &volume.rows[row][column * LEVELS..][..LEVELS];
        let sum: f64 = column.iter().map(|density| f64::from(*density)).sum();
        compare("sum of a column", sum as f32, right);
    }
    println!("largest relative difference {largest:.1e}");

    let numbers = std::fs::read_to_string(fixture("reference.json")).unwrap();
    let numbers: serde_json::Value = serde_json::from_str(&numbers).unwrap();
    // A density next to the isovalue may fall on the other side: 2225 points of the reference lie within 2e-4 of it.
    let near = |found: u64, right: &serde_json::Value| {
        let right = right.as_u64().unwrap();
        println!("{found} and {right}");
        assert!(found.abs_diff(right) <= right / 10_000, "{found} and {right}");
    };
    near(volume.inside, &numbers["points_inside"]);
    for (axis, found) in volume.cut.into_iter().enumerate() {
        near(found, &numbers["cut_edges_along_row_column_level"][axis]);
    }
}
