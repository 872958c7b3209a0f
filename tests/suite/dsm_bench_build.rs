//! `sat3d dsm-bench build` and `merge`, driven as a user would, on lidar tiles made by the test.
#![allow(clippy::unwrap_used, reason = "a test may fail")]
#![allow(
    clippy::disallowed_methods,
    reason = "an oracle of its own need not be the same on every machine"
)]

use crate::common;

use common::{assert_same, contents, npz, run, sat3d, stderr, stdout};
use sat3d::grid::GeoTransform;
use sat3d::raster::geotiff::{GeoTiffSpec, GeoTiffWriter};
use sat3d::units::US_SURVEY_FOOT_M;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// State Plane position (US survey feet, EPSG:2927) of the middle of the test area, and the same as
/// latitude and longitude (PAPER.md's check point).
const EAST: f64 = 1_193_067.570_541_287;
const NORTH: f64 = 828_235.976_053_613_7;
const LAT: f64 = 47.5903;
const LON: f64 = -122.3129;
const PIXEL: f64 = 1.5;

/// A smooth surface with walls, in US survey feet, at a State Plane position.
fn surface(x: f64, y: f64) -> f32 {
    let (u, v) = (x - EAST, y - NORTH);
    let wave = 20.0 * libm::sin(u / 90.0) * libm::cos(v / 70.0);
    let wall = if (u / 100.0).floor() as i64 % 3 == 0 && (v / 100.0).floor() as i64 % 2 == 0 {
        35.5
    } else {
        0.0
    };
    (250.0 + wave + wall) as f32
}

/// A tile of `width x height` cells whose north-west corner is `col, row` cells from the area's
/// corner (the area is 800 cells square, centred).
struct Tile {
    col: i32,
    row: i32,
    width: u32,
    height: u32,
}

const WHOLE: Tile = Tile { col: 0, row: 0, width: 800, height: 800 };

fn spec(tile: &Tile) -> GeoTiffSpec {
    let west = EAST - 400.0 * PIXEL + f64::from(tile.col) * PIXEL;
    let north = NORTH + 400.0 * PIXEL - f64::from(tile.row) * PIXEL;
    GeoTiffSpec {
        width: tile.width,
        height: tile.height,
        geotransform: GeoTransform::north_up(west, north, PIXEL, PIXEL),
        epsg: 2927,
        nodata: Some(-9999.0),
        ..GeoTiffSpec::default()
    }
}

fn write_tile(path: &Path, tile: &Tile, value: impl Fn(f64, f64) -> f32) {
    write_spec(path, &spec(tile), value);
}

fn write_spec(path: &Path, spec: &GeoTiffSpec, value: impl Fn(f64, f64) -> f32) {
    let mut rows = Vec::new();
    for r in 0..spec.height {
        for c in 0..spec.width {
            let x = spec.geotransform.0[0] + (f64::from(c) + 0.5) * PIXEL;
            let y = spec.geotransform.0[3] - (f64::from(r) + 0.5) * PIXEL;
            rows.push(value(x, y));
        }
    }
    let mut writer = GeoTiffWriter::create(path, spec).unwrap();
    writer.write_rows(&rows).unwrap();
    writer.finish().unwrap();
}

/// A list of `n x n` images on VIGOR's spacing around the middle.
fn write_list(path: &Path, n: i32) -> Vec<String> {
    let step_lon = 362.5 * 360.0 / (256.0 * f64::from(1 << 20));
    let step_lat = step_lon * LAT.to_radians().cos();
    let stems: Vec<String> = (0..n * n)
        .map(|k| {
            let (i, j) = (k % n - n / 2, k / n - n / 2);
            format!("satellite_{}_{}", LAT + f64::from(j) * step_lat, LON + f64::from(i) * step_lon)
        })
        .collect();
    fs::write(path, stems.join(".png\n")).unwrap();
    stems
}

struct Area {
    folder: tempfile::TempDir,
    stems: Vec<String>,
}

impl Area {
    fn new(tiles: &[(&str, Tile)], n: i32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("tiles")).unwrap();
        for (name, tile) in tiles {
            write_tile(&folder.path().join("tiles").join(name), tile, surface);
        }
        let stems = write_list(&folder.path().join("names.txt"), n);
        Self { folder, stems }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn build(&self, out: &str, extra: &[&str]) -> Command {
        let mut command = sat3d();
        command
            .args(["-q", "dsm-bench", "build", "--lidar"])
            .arg(self.path("tiles"))
            .arg("--images")
            .arg(self.path("names.txt"))
            .arg("--out")
            .arg(self.path(out))
            .args(extra);
        command
    }
}

#[test]
fn heights_are_the_surface_in_metres_at_the_exact_pixel_positions() {
    let area = Area::new(&[("a.tif", WHOLE)], 1);
    let output = run(&mut area.build("dsm", &["--vertical-unit", "us-survey-foot"]), 0);
    assert!(stdout(&output).contains("1 of 1 images have a DSM"), "{}", stdout(&output));
    let dsm = npz(&area.path("dsm").join(format!("{}_dsm.npz", area.stems[0])), "dsm");
    let grid = sat3d::grid::ImageGrid::new(
        sat3d::grid::LonLat { lon_deg: LON, lat_deg: LAT },
        20,
        640,
        640,
    )
    .unwrap();
    let crs = sat3d::crs::CrsSpec::from_user_input("EPSG:2927").unwrap();
    let projection = sat3d::crs::resolve(&crs, &Default::default()).unwrap().projection;
    let mut compared = 0;
    for y in (5..640).step_by(31) {
        for x in (5..640).step_by(31) {
            let centre = sat3d::grid::PixelPoint { x: f64::from(x) + 0.5, y: f64::from(y) + 0.5 };
            let p = projection.forward(grid.lonlat(centre)).unwrap();
            // Away from the walls bilinear interpolation of the wave is good to its curvature.
            let near_wall = |v: f64| {
                let t = (v / 100.0).fract().abs() * 100.0;
                !(3.0..97.0).contains(&t)
            };
            if near_wall(p.x - EAST) || near_wall(p.y - NORTH) {
                continue;
            }
            let truth = f64::from(surface(p.x, p.y)) * US_SURVEY_FOOT_M;
            let height = f64::from(dsm[(y * 640 + x) as usize]);
            assert!((height - truth).abs() < 1e-3, "at {x}, {y}: {height} {truth}");
            compared += 1;
        }
    }
    assert!(compared > 200);
}

#[test]
pub fn tiles_cut_from_a_raster_give_the_bytes_of_the_raster() {
    let uncut = Area::new(&[("a.tif", WHOLE)], 3);
    let cut = Area::new(
        &[
            ("c.tif", Tile { col: 0, row: 0, width: 397, height: 411 }),
            ("b.tif", Tile { col: 397, row: 0, width: 403, height: 411 }),
            ("a.tif", Tile { col: 0, row: 411, width: 397, height: 389 }),
            ("d.tif", Tile { col: 397, row: 411, width: 403, height: 389 }),
        ],
        3,
    );
    for kernel in ["bilinear", "cubic", "average", "nearest"] {
        let extra = ["--coverage", "mosaic", "-r", kernel];
        run(&mut uncut.build(kernel, &extra), 0);
        run(&mut cut.build(kernel, &extra), 0);
        for stem in &uncut.stems {
            let name = format!("{stem}_dsm.npz");
            let (a, b) =
                (fs::read(uncut.path(kernel).join(&name)), fs::read(cut.path(kernel).join(&name)));
            assert!(a.unwrap() == b.unwrap(), "{kernel}: {name} differs");
        }
    }
    // Best-tile loses what lies across the borders, and says what mosaic would rescue.
    let output = run(&mut cut.build("best", &["--json"]), 0);
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(summary["skipped"].as_u64().unwrap() >= 3, "{summary}");
    assert_eq!(summary["rescued_by_mosaic"], summary["skipped"]);
}

#[test]
fn threads_shards_and_interruptions_do_not_change_a_byte() {
    let area = Area::new(
        &[("a.tif", WHOLE), ("b.tif", Tile { col: 100, row: 50, width: 700, height: 700 })],
        4,
    );
    let extra = [
        "--dtm",
        area.path("tiles").to_str().unwrap(),
        "--source-tile",
        "--geotiff",
        "--preview",
        "--stac",
    ]
    .map(str::to_owned);
    let extra: Vec<&str> = extra.iter().map(String::as_str).collect();
    let with = |more: &[&'static str]| -> Vec<&str> {
        extra.iter().copied().chain(more.iter().copied()).collect()
    };
    run(&mut area.build("one", &with(&["--threads", "1"])), 0);
    run(&mut area.build("many", &with(&["--threads", "7", "--memory", "1"])), 0);
    assert_same(&area.path("one"), &area.path("many"));
    for shard in ["2/3", "1/3", "3/3"] {
        run(&mut area.build("sharded", &with(&["--shard", shard])), 0);
    }
    run(sat3d().args(["dsm-bench", "merge", "--stac", "--out"]).arg(area.path("sharded")), 0);
    assert_same(&area.path("one"), &area.path("sharded"));
    // Shards of other folders are copied.
    run(&mut area.build("p1", &with(&["--shard", "1/2"])), 0);
    let missing = run(
        sat3d().args(["dsm-bench", "merge", "--out"]).arg(area.path("joined")).arg(area.path("p1")),
        2,
    );
    assert!(stderr(&missing).contains("not finished: 2/2"), "{}", stderr(&missing));
    run(&mut area.build("p2", &with(&["--shard", "2/2"])), 0);
    run(
        sat3d()
            .args(["dsm-bench", "merge", "--stac", "--out"])
            .arg(area.path("joined"))
            .arg(area.path("p1"))
            .arg(area.path("p2")),
        0,
    );
    assert_same(&area.path("one"), &area.path("joined"));
}

#[test]
fn a_second_run_continues_and_redoes_only_what_changed() {
    let area = Area::new(&[("a.tif", WHOLE)], 3);
    let json = |command: &mut Command| -> serde_json::Value {
        serde_json::from_slice(&run(command, 0).stdout).unwrap()
    };
    let first = json(&mut area.build("dsm", &["--json"]));
    assert_eq!((first["done"].as_u64(), first["kept"].as_u64()), (Some(9), Some(0)));
    let before = contents(&area.path("dsm"));
    let second = json(&mut area.build("dsm", &["--json"]));
    assert_eq!(second["kept"].as_u64(), Some(9));
    // A file of the right size but another content is found by hashes only; a missing one always.
    let victim = area.path("dsm").join(format!("{}_dsm.npz", area.stems[0]));
    let mut bytes = fs::read(&victim).unwrap();
    bytes[1000] ^= 1;
    fs::write(&victim, &bytes).unwrap();
    fs::remove_file(area.path("dsm").join(format!("{}_dsm.npz", area.stems[1]))).unwrap();
    assert_eq!(json(&mut area.build("dsm", &["--json"]))["kept"].as_u64(), Some(8));
    assert_eq!(
        json(&mut area.build("dsm", &["--json", "--verify", "hashes"]))["kept"].as_u64(),
        Some(8)
    );
    assert!(contents(&area.path("dsm")) == before);
    // A changed tile redoes its images.
    write_tile(&area.path("tiles").join("a.tif"), &WHOLE, |x, y| surface(x, y) + 1.0);
    assert_eq!(json(&mut area.build("dsm", &["--json"]))["kept"].as_u64(), Some(0));
    // Other options are refused, and named.
    let refused = run(&mut area.build("dsm", &["-r", "cubic"]), 2);
    assert!(
        stderr(&refused).contains("resampling: \"bilinear\" there, \"cubic\" now"),
        "{}",
        stderr(&refused)
    );
    assert_eq!(
        json(&mut area.build("dsm", &["-r", "cubic", "--overwrite", "--json"]))["kept"].as_u64(),
        Some(0)
    );
}

#[cfg(unix)]
#[test]
fn interrupted_and_killed_runs_leave_a_state_that_continues() {
    let area = Area::new(&[("a.tif", WHOLE)], 7);
    run(&mut area.build("whole", &[]), 0);
    for signal in ["INT", "KILL"] {
        let out = format!("cut-{signal}");
        let mut child = area
            .build(&out, &["--threads", "1"])
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let folder = area.path(&out);
        // Wait for a first finished image, so that there is something to keep.
        for _ in 0..2000 {
            let begun = fs::read_dir(&folder).is_ok_and(|items| {
                items
                    .filter_map(Result::ok)
                    .any(|i| i.file_name().to_string_lossy().ends_with("_dsm.npz"))
            });
            if begun {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(2));
        }
        Command::new("kill")
            .args([&format!("-{signal}"), &child.id().to_string()])
            .status()
            .unwrap();
        let status = child.wait().unwrap();
        // A fast machine may have finished before the signal came.
        if signal == "INT" {
            assert!(matches!(status.code(), Some(130 | 0)), "{status}");
        }
        run(&mut area.build(&out, &[]), 0);
        assert_same(&area.path("whole"), &folder);
    }
}

#[test]
fn no_data_in_every_form_becomes_nan_and_never_bleeds() {
    // The north half of the tile is without data, marked in different ways.
    let marks: [(f32, &[&str]); 4] =
        [(-9999.0, &[]), (f32::NAN, &[]), (-3.402_823_5e38, &[]), (-77.0, &["--nodata", "-77"])];
    for (mark, extra) in marks {
        let area = Area::new(&[], 1);
        write_tile(&area.path("tiles").join("a.tif"), &WHOLE, |x, y| {
            if y > NORTH { mark } else { surface(x, y) }
        });
        for kernel in ["bilinear", "cubic", "average", "nearest"] {
            let mut all = vec!["--max-nan", "60", "-r", kernel];
            all.extend(extra);
            run(&mut area.build(kernel, &all), 0);
            let dsm = npz(&area.path(kernel).join(format!("{}_dsm.npz", area.stems[0])), "dsm");
            let valid: Vec<f32> = dsm.iter().copied().filter(|v| !v.is_nan()).collect();
            let share = valid.len() as f64 / dsm.len() as f64;
            assert!((share - 0.5).abs() < 0.02, "{mark} {kernel}: {share}");
            let low = valid.iter().copied().fold(f32::INFINITY, f32::min);
            assert!(low > 65.0, "{mark} {kernel}: lowest {low}");
        }
    }
    // Undeclared, the mark is taken for no data with a warning.
    let area = Area::new(&[], 1);
    let undeclared = GeoTiffSpec { nodata: None, ..spec(&WHOLE) };
    write_spec(&area.path("tiles").join("a.tif"), &undeclared, |x, y| {
        if y > NORTH { -9999.0 } else { surface(x, y) }
    });
    let mut command = area.build("undeclared", &["--max-nan", "60"]);
    let warned = stderr(&run(command.env("SAT3D_LOG", "warn"), 0));
    assert!(warned.contains("-9999") && warned.contains("--nodata"), "{warned}");
    // `--nodata none` takes the mark for a height.
    let area = Area::new(&[], 1);
    write_tile(&area.path("tiles").join("a.tif"), &WHOLE, |x, y| {
        if y > NORTH { -9999.0 } else { surface(x, y) }
    });
    run(&mut area.build("none", &["--nodata", "none"]), 0);
    let dsm = npz(&area.path("none").join(format!("{}_dsm.npz", area.stems[0])), "dsm");
    assert!(dsm.iter().all(|v| !v.is_nan()) && dsm.iter().any(|v| *v < -3000.0));
}

#[test]
fn every_transform_form_keeps_its_bound_and_tolerance_decides() {
    let area = Area::new(&[("a.tif", WHOLE)], 1);
    let stem = area.stems[0].clone();
    let heights = |out: &str, extra: &[&str]| {
        run(&mut area.build(out, extra), 0);
        npz(&area.path(out).join(format!("{stem}_dsm.npz")), "dsm")
    };
    let manifest = |out: &str, column: &str| {
        let text = fs::read_to_string(area.path(out).join("manifest.csv")).unwrap();
        let mut reader = csv::Reader::from_reader(text.as_bytes());
        let at = reader.headers().unwrap().iter().position(|h| h == column).unwrap();
        reader.records().next().unwrap().unwrap()[at].to_owned()
    };
    let exact = heights("exact", &["--transform", "exact"]);
    let steepest: f64 = manifest("exact", "steepest").parse().unwrap();
    assert!(steepest > 5.0, "walls of 35 ft within 1.5 ft: {steepest}");
    for form in ["chebyshev", "separable", "affine"] {
        let other = heights(form, &["--transform", form]);
        let bound: f64 = manifest(form, "transform_bound_m").parse().unwrap();
        let worst =
            exact.iter().zip(&other).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
        // Heights may differ by the bound times the gradient, and by the rounding of f32.
        assert!(worst <= bound * steepest + 1e-5, "{form}: {worst} > {bound} x {steepest}");
    }
    for (tolerance, form) in [("1e-6", "chebyshev"), ("0.001", "affine"), ("1e-9", "exact")] {
        heights(tolerance, &["--tolerance", tolerance]);
        assert_eq!(manifest(tolerance, "transform"), form, "tolerance {tolerance}");
    }
    let explain = stdout(&run(&mut area.build("x", &["--explain"]), 0));
    for step in [
        "operation-accuracy",
        "datum",
        "lattice",
        "transform",
        "vertical-unit",
        "quantise",
        "kernel",
    ] {
        assert!(explain.contains(step), "{step} in\n{explain}");
    }
    assert!(explain.contains("1.000*"), "the stated accuracy dominates:\n{explain}");
    assert!(!area.path("x").exists(), "--explain writes nothing");
}

#[test]
fn quantised_heights_are_within_half_a_step_and_smaller() {
    let area = Area::new(&[("a.tif", WHOLE)], 1);
    let name = format!("{}_dsm.npz", area.stems[0]);
    run(&mut area.build("full", &[]), 0);
    run(&mut area.build("cm", &["--quantise", "0.01"]), 0);
    let (full, cm) =
        (npz(&area.path("full").join(&name), "dsm"), npz(&area.path("cm").join(&name), "dsm"));
    let worst = full.iter().zip(&cm).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
    assert!(worst <= 0.005 + 1e-5 && worst > 0.004, "{worst}");
    let size = |out: &str| fs::metadata(area.path(out).join(&name)).unwrap().len();
    assert!(size("cm") < size("full"));
}

/// The same bytes from the build with GDAL and PROJ, from the pure one, and on every machine: the
/// hash was printed by this test, and both builds run it.
#[test]
fn both_builds_give_these_bytes() {
    let area = Area::new(&[("a.tif", WHOLE)], 1);
    run(&mut area.build("dsm", &["--geotiff", "--preview", "--quantise", "0.001"]), 0);
    let hash = |end: &str| {
        use sha2::{Digest, Sha256};
        let file = area.path("dsm").join(format!("{}_dsm.{end}", area.stems[0]));
        sat3d::plan::hex(&Sha256::digest(fs::read(file).unwrap()))[..16].to_owned()
    };
    assert_eq!(
        [hash("npz"), hash("tif"), hash("png")],
        ["2f611d0eb76aff14", "65695a6d42f666f8", "63999954588491d4"]
    );
}
