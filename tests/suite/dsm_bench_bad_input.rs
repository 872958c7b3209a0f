//! Bad input to `sat3d dsm-bench build`: a clear error or a recorded skip, and nothing lost.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{run, sat3d, stderr, stdout};
use sat3d::grid::GeoTransform;
use sat3d::raster::geotiff::{GeoTiffSpec, GeoTiffWriter};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const CENTRE: (f64, f64) = (1_193_067.570_541, 828_235.976_054);
const NAME: &str = "satellite_47.5903_-122.3129";

fn spec() -> GeoTiffSpec {
    GeoTiffSpec {
        width: 300,
        height: 300,
        geotransform: GeoTransform::north_up(CENTRE.0 - 225.0, CENTRE.1 + 225.0, 1.5, 1.5),
        epsg: 2927,
        nodata: Some(-9999.0),
        ..GeoTiffSpec::default()
    }
}

fn write(path: &Path, spec: &GeoTiffSpec) {
    let rows: Vec<f32> = (0..spec.width * spec.height)
        .map(|k| 200.0 + (k.wrapping_mul(2_654_435_761) >> 20) as f32 / 64.0)
        .collect();
    let mut writer = GeoTiffWriter::create(path, spec).unwrap();
    writer.write_rows(&rows).unwrap();
    writer.finish().unwrap();
}

struct Case {
    folder: tempfile::TempDir,
}

impl Case {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("tiles")).unwrap();
        fs::write(folder.path().join("names.txt"), NAME).unwrap();
        Self { folder }
    }

    fn with_good_tile() -> Self {
        let case = Self::new();
        write(&case.path("tiles/good.tif"), &spec());
        case
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn build(&self, extra: &[&str]) -> Command {
        let mut command = sat3d();
        command
            .args(["dsm-bench", "build", "--lidar"])
            .arg(self.path("tiles"))
            .arg("--images")
            .arg(self.path("names.txt"))
            .arg("--out")
            .arg(self.path("dsm"))
            .args(extra);
        command
    }

    /// Runs to exit code 2 and wants every text in the error.
    fn refuses(&self, extra: &[&str], texts: &[&str]) {
        let error = stderr(&run(&mut self.build(extra), 2));
        for text in texts {
            assert!(error.contains(text), "`{text}` not in:\n{error}");
        }
        assert!(!error.contains("panicked") && !error.contains("bug in sat3d"), "{error}");
    }
}

#[test]
fn an_empty_folder_and_a_missing_one() {
    let case = Case::new();
    case.refuses(&[], &["tiles", ".tif"]);
    fs::remove_dir(case.path("tiles")).unwrap();
    case.refuses(&[], &["tiles"]);
}

#[test]
fn a_text_file_named_tif_does_not_stop_the_others() {
    let case = Case::with_good_tile();
    fs::write(case.path("tiles/bad.tif"), "this is no raster\n").unwrap();
    let output = run(&mut case.build(&[]), 1);
    assert!(stderr(&output).contains("bad.tif"), "{}", stderr(&output));
    assert!(stdout(&output).contains("1 of 1 images have a DSM"), "{}", stdout(&output));
    let benchmark = fs::read_to_string(case.path("dsm/benchmark.json")).unwrap();
    assert!(benchmark.contains("bad.tif"));
    fs::remove_file(case.path("tiles/good.tif")).unwrap();
    fs::remove_dir_all(case.path("dsm")).unwrap();
    case.refuses(&[], &["none of the 1 lidar tiles can be used", "bad.tif"]);
}

#[test]
fn a_truncated_tile_fails_its_images_by_name() {
    let case = Case::with_good_tile();
    let good = case.path("tiles/good.tif");
    let bytes = fs::read(&good).unwrap();
    fs::write(&good, &bytes[..bytes.len() / 2]).unwrap();
    let output = case.build(&[]).output().unwrap();
    // Either the header is past the cut (the tile is unusable: 2), or its blocks are (1).
    assert!(matches!(output.status.code(), Some(1 | 2)), "{output:?}");
    assert!(stderr(&output).contains("good.tif"), "{}", stderr(&output));
    assert!(!stderr(&output).contains("bug in sat3d"), "{}", stderr(&output));
}

#[test]
fn tiles_without_or_with_unknown_or_geographic_crs() {
    let case = Case::new();
    write(&case.path("tiles/a.tif"), &GeoTiffSpec { epsg: 0, ..spec() });
    case.refuses(&[], &["a.tif", "--crs"]);
    // Said on the command line, the tile is good.
    run(&mut case.build(&["--crs", "EPSG:2927"]), 0);
    case.refuses(&["--crs", "EPSG:999999", "--overwrite"], &["999999"]);
    let case = Case::new();
    let degrees = GeoTransform::north_up(-122.32, 47.6, 1e-5, 1e-5);
    write(&case.path("tiles/d.tif"), &GeoTiffSpec { epsg: 4326, geotransform: degrees, ..spec() });
    case.refuses(&[], &["d.tif", "degrees"]);
}

#[test]
fn a_rotated_tile() {
    let case = Case::new();
    let c = spec().geotransform.0;
    let rotated = GeoTransform([c[0], 1.49, 0.1, c[3], 0.1, -1.49]);
    write(&case.path("tiles/r.tif"), &GeoTiffSpec { geotransform: rotated, ..spec() });
    case.refuses(&[], &["r.tif", "rotated"]);
}

#[test]
fn tiles_that_disagree_about_the_vertical_unit() {
    let case = Case::with_good_tile();
    let metre = GeoTiffSpec { unit: Some(sat3d::units::LinearUnit::Metre), ..spec() };
    write(&case.path("tiles/metre.tif"), &metre);
    case.refuses(&[], &["disagree", "good.tif", "metre.tif", "--vertical-unit"]);
    run(&mut case.build(&["--vertical-unit", "us-survey-foot"]), 0);
}

#[test]
fn names_that_do_not_parse_latitudes_beyond_the_map_and_the_antimeridian() {
    let case = Case::with_good_tile();
    let names = [
        NAME,
        "satellite_47.5.png",
        "satellite_x_-122.png",
        "satellite_85.06_-122.png",
        "satellite_95_-122.png",
        "satellite_10_180.png",
        "satellite_10_-179.9999999.png",
        "satellite_0_0.png",
    ];
    fs::write(case.path("names.txt"), names.join("\r\n")).unwrap();
    let output = run(&mut case.build(&[]), 1);
    let text = stdout(&output);
    assert!(text.contains("1 of 8 images have a DSM"), "{text}");
    let manifest = fs::read_to_string(case.path("dsm/manifest.csv")).unwrap();
    for (name, word) in [
        ("satellite_47.5", "not named"),
        ("satellite_x_-122", "latitude"),
        ("satellite_85.06_-122", "outside Web Mercator"),
        ("satellite_95_-122", "latitude"),
        ("satellite_10_180", "antimeridian"),
        ("satellite_10_-179.9999999", "antimeridian"),
        ("satellite_0_0", "no lidar tile"),
    ] {
        let row = manifest.lines().find(|line| line.starts_with(name)).unwrap_or_default();
        assert!(row.contains(word), "{name}: {row}");
    }
}

#[test]
fn impossible_options_name_themselves() {
    let case = Case::with_good_tile();
    case.refuses(&["--max-nan", "101"], &["--max-nan", "101"]);
    case.refuses(&["--tolerance", "0"], &["--tolerance"]);
    case.refuses(&["--quantise", "0"], &["--quantise"]);
    case.refuses(&["--shard", "3/2"], &["3/2"]);
    case.refuses(&["--nodata", "abc"], &["abc"]);
    case.refuses(&["--size", "0"], &["--size"]);
    case.refuses(&["--grid", "reference", "--geotiff"], &["--grid reference"]);
    assert!(!case.path("dsm").exists());
}

#[test]
fn an_image_of_another_size_fails_with_both_sizes() {
    let case = Case::with_good_tile();
    fs::create_dir(case.path("city")).unwrap();
    let image = image::RgbImage::new(512, 512);
    image.save(case.path("city").join(format!("{NAME}.png"))).unwrap();
    let mut command = sat3d();
    command.args(["dsm-bench", "build", "--lidar"]).arg(case.path("tiles"));
    command.arg("--vigor").arg(case.path("city")).arg("--out").arg(case.path("dsm"));
    let output = run(&mut command, 1);
    assert!(stderr(&output).contains("512 x 512"), "{}", stderr(&output));
}

#[test]
fn an_unwritable_output_and_a_folder_in_use() {
    let case = Case::with_good_tile();
    fs::write(case.path("file"), "").unwrap();
    let mut command = sat3d();
    command.args(["dsm-bench", "build", "--lidar"]).arg(case.path("tiles"));
    command.arg("--images").arg(case.path("names.txt")).arg("--out").arg(case.path("file/dsm"));
    let error = stderr(&run(&mut command, 2));
    assert!(error.contains("file/dsm"), "{error}");
    // Someone else works in the folder.
    fs::create_dir_all(case.path("dsm/.sat3d")).unwrap();
    let lock = fs::File::create(case.path("dsm/.sat3d/lock")).unwrap();
    lock.lock().unwrap();
    case.refuses(&[], &["another sat3d run"]);
    drop(lock);
    run(&mut case.build(&[]), 0);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_stops_the_run_and_loses_nothing() {
    let case = Case::with_good_tile();
    let names: Vec<String> =
        (0..12).map(|k| format!("satellite_47.5903_{}", -122.3129 + f64::from(k) * 1e-5)).collect();
    fs::write(case.path("names.txt"), names.join("\n")).unwrap();
    let disk = case.path("dsm");
    fs::create_dir(&disk).unwrap();
    let mounted = Command::new("mount")
        .args(["-t", "tmpfs", "-o", "size=6m", "tmpfs"])
        .arg(&disk)
        .status()
        .is_ok_and(|status| status.success());
    if !mounted {
        eprintln!("SKIPPED a_full_disk_stops_the_run_and_loses_nothing: cannot mount a tmpfs");
        return;
    }
    let full = case.build(&["--max-nan", "100"]).output().unwrap();
    let first =
        fs::read_dir(&disk).unwrap().filter_map(Result::ok).filter(|i| i.path().is_file()).count();
    let remounted =
        Command::new("mount").args(["-o", "remount,size=64m"]).arg(&disk).status().unwrap();
    let again = case.build(&["--max-nan", "100"]).output().unwrap();
    let whole = fs::read_to_string(disk.join("manifest.csv")).unwrap_or_default();
    let unmounted = Command::new("umount").arg(&disk).status().unwrap();
    assert!(matches!(full.status.code(), Some(1 | 2)), "{full:?}");
    let error = stderr(&full);
    assert!(error.contains("space"), "{error}");
    assert!(first >= 1, "the first images fit");
    assert!(remounted.success() && unmounted.success());
    assert_eq!(again.status.code(), Some(0), "{}", stderr(&again));
    assert!(stdout(&again).contains("12 of 12 images have a DSM"), "{}", stdout(&again));
    assert_eq!(whole.lines().count(), 13);
}
