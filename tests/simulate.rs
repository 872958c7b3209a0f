//! `sat3d simulate` as a user drives it: the same bytes again, effects only where they are called for,
//! and errors that name the file, the key and the value.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

mod common;

use common::{npz, run, sat3d, stderr, stdout};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A small scene with two images; `more` is appended.
fn scene(folder: &Path, name: &str, more: &str) -> PathBuf {
    let path = folder.join(format!("{name}.toml"));
    let text = format!(
        "name = \"{name}\"\nseed = 7\n[extent]\nwidth_metres = 120.0\nheight_metres = 110.0\n[images]\nmaximum = 2\n{more}"
    );
    fs::write(&path, text).unwrap();
    path
}

fn simulate(scene: &Path, out: &Path, extra: &[&str]) -> Command {
    let mut command = sat3d();
    command.args(["-q", "simulate"]).arg(scene).arg("--out").arg(out).args(extra);
    command
}

/// Every file below a folder but `scene.json` (it holds the plan), with its bytes.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for item in fs::read_dir(&next).unwrap().map(|item| item.unwrap().path()) {
            if item.is_dir() {
                folders.push(item);
            } else if !item.ends_with("scene.json") {
                files.push((
                    item.strip_prefix(folder).unwrap().to_owned(),
                    fs::read(&item).unwrap(),
                ));
            }
        }
    }
    files.sort();
    files
}

fn assert_same(a: &Path, b: &Path, what: &str) {
    let (a, b) = (contents(a), contents(b));
    assert!(!a.is_empty());
    assert_eq!(a.len(), b.len(), "{what}");
    for ((name, x), (_, y)) in a.iter().zip(&b) {
        assert!(x == y, "{what}: {} differs", name.display());
    }
}

#[test]
fn the_same_scene_gives_the_same_bytes_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(
        folder.path(),
        "city",
        "[sun]\nazimuth_degrees = 150.0\nelevation_degrees = 40.0\n[lidar]\nnoise_sigma_metres = 0.02\n",
    );
    let (one, four) = (folder.path().join("one"), folder.path().join("four"));
    run(simulate(&path, &one, &[]).env("RAYON_NUM_THREADS", "1"), 0);
    run(simulate(&path, &four, &[]).env("RAYON_NUM_THREADS", "4"), 0);
    assert_same(&one, &four, "threads");
    let names: Vec<String> = contents(&one).iter().map(|(p, _)| p.display().to_string()).collect();
    for part in [
        "lidar/king_county_west_2021_dsm_87.tif",
        "lidar_dtm/king_county_west_2021_dtm_87.tif",
        "vigor/Seattle/satellite/satellite_",
        "truth/satellite_",
        "satellite_list.txt",
    ] {
        assert!(names.iter().any(|name| name.contains(part)), "{part} not in {names:?}");
    }
}

#[test]
fn an_effect_without_its_cause_is_the_effect_switched_off_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    // Neither sun, nor an oblique view, nor noise, nor change: every such effect has no cause.
    let path = scene(folder.path(), "plain", "");
    let plain = folder.path().join("plain");
    run(&mut simulate(&path, &plain, &[]), 0);
    for effect in [
        "shadows",
        "relief",
        "noise",
        "gaps",
        "missing-pulses",
        "season",
        "change",
        "sensor-noise",
        "curvature",
    ] {
        let off = folder.path().join(effect);
        run(&mut simulate(&path, &off, &["--without", effect]), 0);
        assert_same(&plain, &off, effect);
    }
    let plan = stdout(&run(&mut simulate(&path, &plain, &["--explain"]), 0));
    for effect in ["shadows", "relief", "noise", "change"] {
        let line =
            plan.lines().find(|line| line.trim_start().starts_with(&format!("{effect} "))).unwrap();
        assert!(line.contains(" off "), "{line}");
    }
}

#[test]
fn an_effect_under_the_tolerance_changes_less_than_its_bound_when_forced() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(
        folder.path(),
        "noisy",
        "[lidar]\nnoise_sigma_metres = 0.01\n[tiles]\ncolumns = 1\nrows = 1\n",
    );
    let (skipped, forced) = (folder.path().join("skipped"), folder.path().join("forced"));
    run(&mut simulate(&path, &skipped, &["--tolerance", "0.05"]), 0);
    run(&mut simulate(&path, &forced, &["--tolerance", "0.05", "--force", "noise"]), 0);
    let dsm = |out: &Path, name: &str| {
        let mut build = sat3d();
        build
            .args(["-q", "dsm-bench", "build", "-r", "nearest", "--max-nan", "50", "--lidar"])
            .arg(out.join("lidar"));
        build
            .arg("--vigor")
            .arg(out.join("vigor/Seattle"))
            .arg("--out")
            .arg(folder.path().join(name));
        run(&mut build, 0);
        let first =
            fs::read_dir(out.join("truth")).unwrap().map(|i| i.unwrap().file_name()).min().unwrap();
        npz(&folder.path().join(name).join(first), "dsm")
    };
    let (a, b) = (dsm(&skipped, "a"), dsm(&forced, "b"));
    let worst =
        a.iter().zip(&b).map(|(a, b)| (a - b).abs()).filter(|d| !d.is_nan()).fold(0.0, f32::max);
    assert!(worst > 0.02, "the noise is there: {worst}");
    assert!(worst <= 0.04 + 1e-5, "cut at 4 sigma: {worst}");
}

#[test]
fn wrong_scenes_are_refused_with_file_key_and_value() {
    let folder = tempfile::tempdir().unwrap();
    for (name, more, texts) in [
        ("unknown", "[sun]\nazimut = 3.0\n", &["unknown.toml", "azimut"][..]),
        (
            "low",
            "[sun]\nazimuth_degrees = 10.0\nelevation_degrees = -5.0\n",
            &["low.toml", "elevation", "-5"][..],
        ),
        (
            "far",
            "[place]\nlatitude_degrees = 10.0\nlongitude_degrees = -122.3\n",
            &["far.toml", "latitude", "10"][..],
        ),
    ] {
        let path = scene(folder.path(), name, more);
        let error = stderr(&run(&mut simulate(&path, &folder.path().join("out"), &[]), 2));
        for text in texts {
            assert!(error.contains(text), "`{text}` not in {error}");
        }
    }
    let error = stderr(&run(
        &mut simulate(&folder.path().join("none.toml"), &folder.path().join("out"), &[]),
        2,
    ));
    assert!(error.contains("none.toml"), "{error}");
    assert!(!folder.path().join("out").exists());
}
