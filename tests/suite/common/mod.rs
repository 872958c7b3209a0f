//! What the end-to-end tests share: the built binary, the real data, the external tools.
#![allow(dead_code, reason = "each test file uses its own part")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::model::weights::rule::{tiny_overrides, write_checkpoint};
use std::collections::HashMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The folder of real rasters and lists: `SAT3D_TEST_DATA`, else `../shared/data`. Prints that the
/// test was skipped and returns `None` where it is absent.
pub fn test_data(test: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("SAT3D_TEST_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    if folder.join("rasters").is_dir() {
        Some(folder)
    } else {
        eprintln!("SKIPPED {test}: no test data at {} (set SAT3D_TEST_DATA)", folder.display());
        None
    }
}

/// Whether an external tool runs; prints that the test was skipped where it does not.
pub fn has_tool(test: &str, tool: &str) -> bool {
    let found = Command::new(tool).arg("--version").output().is_ok();
    if !found {
        eprintln!("SKIPPED {test}: {tool} is not installed");
    }
    found
}

/// A command that runs the built binary.
pub fn sat3d() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sat3d"));
    command.env_remove("SAT3D_LOG").env("NO_COLOR", "1");
    // No weights of whoever runs the tests.
    command.env_remove("SAT3D_WEIGHTS").env("HF_HUB_CACHE", "/nonexistent");
    command
}

/// Runs a command and returns its output; panics with both streams on another exit code.
pub fn run(command: &mut Command, code: i32) -> Output {
    let output = command.output().unwrap();
    assert_eq!(
        output.status.code(),
        Some(code),
        "{command:?}\n--- stdout\n{}\n--- stderr\n{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

/// Standard error of an output as text.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Standard output of an output as text.
pub fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The array of a key in an npz file.
pub fn npz(path: &Path, key: &str) -> Vec<f32> {
    let arrays = sat3d::raster::npz::read(path).unwrap();
    let (_, array) = arrays.into_iter().find(|(name, _)| name == key).unwrap();
    array.to_f64().into_iter().map(|v| v as f32).collect()
}

/// All files of a folder but run.json and the state folder, with their bytes.
pub fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|item| item.unwrap())
        .filter(|item| item.path().is_file() && item.file_name() != "run.json")
        .map(|item| {
            (item.file_name().to_string_lossy().into_owned(), std::fs::read(item.path()).unwrap())
        })
        .collect();
    files.sort();
    files
}

/// Two folders hold the same files with the same bytes, but for run.json.
#[track_caller]
pub fn assert_same(a: &Path, b: &Path) {
    let (a, b) = (contents(a), contents(b));
    let names =
        |files: &[(String, Vec<u8>)]| files.iter().map(|(n, _)| n.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    for ((name, x), (_, y)) in a.iter().zip(&b) {
        assert!(x == y, "{name} differs");
    }
}

/// One row of a manifest by the name of its image.
pub fn row(out: &Path, name: &str) -> HashMap<String, String> {
    let mut reader = csv::Reader::from_path(out.join("manifest.csv")).unwrap();
    let titles = reader.headers().unwrap().clone();
    let rows: Vec<csv::StringRecord> = reader.records().map(Result::unwrap).collect();
    let row = rows.iter().find(|row| &row[0] == name).unwrap();
    titles.iter().zip(row.iter()).map(|(k, v)| (k.to_owned(), v.to_owned())).collect()
}

/// A checkpoint of the small network of the parity tests, weights made by rule; `name` keeps test files
/// that run side by side apart.
pub fn tiny_weights(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let config = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("crates/sat3d-model/fixtures/tiny/model/config.json");
    write_checkpoint(&folder, &std::fs::read_to_string(config).unwrap(), tiny_overrides()).unwrap();
    folder
}

/// Says that a test was skipped.
pub fn skipped(test: &str, why: &str) {
    // The test harness hides what `eprintln!` says; this reaches the terminal.
    let _ = writeln!(std::io::stderr(), "SKIPPED {test}: {why}");
}

/// An interpreter that can import `modules`.
pub fn python(test: &str, modules: &str) -> Option<Command> {
    let interpreter = std::env::var_os("SAT3D_TEST_PYTHON").unwrap_or_else(|| "python3".into());
    let has = Command::new(&interpreter).args(["-c", &format!("import {modules}")]).output();
    if has.is_ok_and(|output| output.status.success()) {
        return Some(Command::new(interpreter));
    }
    skipped(test, &format!("no python with {modules} (set SAT3D_TEST_PYTHON)"));
    None
}

/// Runs a script; what it prints.
#[track_caller]
pub fn run_python(mut python: Command, script: &str, arguments: &[&Path]) -> String {
    let output = python.args(["-c", script]).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// EPSG:3857 corner coordinates of an image, computed here from the definition and not with the
/// library: west, south, east, north in metres.
pub fn mercator_box(lat_deg: f64, lon_deg: f64, zoom: i32, size: f64) -> [f64; 4] {
    let radius = 6_378_137.0_f64;
    let half = size / 2.0 * 2.0 * std::f64::consts::PI * radius / (256.0 * 2.0_f64.powi(zoom));
    let x = radius * lon_deg.to_radians();
    #[allow(clippy::disallowed_methods, reason = "an oracle of its own")]
    let y = radius * (std::f64::consts::FRAC_PI_4 + lat_deg.to_radians() / 2.0).tan().ln();
    [x - half, y - half, x + half, y + half]
}

/// Runs gdalwarp onto an image's grid, exact in coordinates, and returns band 1.
pub fn gdalwarp(
    source: &Path,
    lat_lon: (f64, f64),
    zoom: i32,
    size: usize,
    extra: &[&str],
) -> Vec<f32> {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("warped.bin");
    let te = mercator_box(lat_lon.0, lat_lon.1, zoom, size as f64).map(|v| format!("{v:.12}"));
    let ts = size.to_string();
    let mut command = Command::new("gdalwarp");
    command
        .args(["-q", "-overwrite", "-of", "ENVI", "-t_srs", "EPSG:3857", "-te"])
        .args(te)
        .args(["-ts", &ts, &ts, "-et", "0", "-ovr", "NONE", "-ot", "Float32", "-wt", "Float32"])
        .args(["-dstnodata", "nan"])
        .args(extra)
        .arg(source)
        .arg(&target);
    run(&mut command, 0);
    let bytes = std::fs::read(&target).unwrap();
    bytes
        .chunks_exact(4)
        .take(size * size)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect()
}
