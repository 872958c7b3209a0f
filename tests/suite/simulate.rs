//! `sat3d simulate` as a user drives it: the same bytes again, effects only where they are called for,
//! and errors that name the file, the key and the value.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{npz, python, run, run_python, sat3d, stderr, stdout};
use sat3d::footprint::Place;
use sat3d::grid::PixelPoint;
use sat3d::picture::{self, Window};
use sat3d::raster::OpenOptions;
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
        "[sun]\nazimuth_degrees = 150.0\nelevation_degrees = 40.0\n[lidar]\nnoise_sigma_metres = 0.02\n[picture]\npixel_metres = 0.2\n",
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
        "picture.tif",
        "picture_dsm.tif",
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

/// A scene with one satellite image and a picture around the same place, on the same pixels.
fn scene_with_picture(folder: &Path) -> PathBuf {
    let path = folder.join("whole.toml");
    let text = "seed = 7\n[extent]\nwidth_metres = 90.0\nheight_metres = 80.0\n\
        [sun]\nazimuth_degrees = 150.0\nelevation_degrees = 40.0\n\
        [images]\nsize_pixels = 320\ncentres_degrees = [[47.6097, -122.3331]]\n[picture]\n";
    fs::write(&path, text).unwrap();
    path
}

fn only_file(folder: &Path) -> PathBuf {
    let mut files = fs::read_dir(folder).unwrap().map(|item| item.unwrap().path());
    let first = files.next().unwrap();
    assert!(files.next().is_none());
    first
}

#[test]
fn the_picture_of_the_whole_extent_agrees_with_the_image_and_its_truth() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let path = scene_with_picture(folder.path());
    run(&mut simulate(&path, &out, &[]), 0);
    let mut whole = picture::open(&out.join("picture.tif")).unwrap();
    assert!(whole.warnings().is_empty(), "{:?}", whole.warnings());
    let mut image = picture::open(&only_file(&out.join("vigor/Seattle/satellite"))).unwrap();
    // Where the image lies in the picture, by what the two files say of themselves.
    let grid = |picture: &picture::Picture| match picture.place().unwrap() {
        Place::Raster { geotransform, crs } => {
            assert_eq!(crs.epsg, Some(3857));
            *geotransform
        }
        Place::WebMercator(grid) => grid.geotransform(),
    };
    let (outer, inner) = (grid(&whole), grid(&image));
    let corner = outer.to_pixel(inner.to_projected(PixelPoint { x: 0.0, y: 0.0 }));
    let [x, y] = [corner.x, corner.y].map(f64::round);
    assert!((corner.x - x).abs() < 1e-4 && (corner.y - y).abs() < 1e-4, "{corner:?}");
    let side = image.size()[0];
    let window = Window { x: x as u32, y: y as u32, width: side, height: side };
    let mut colours = vec![0; (side * side * 3) as usize];
    whole.read_window(window, &mut colours).unwrap();
    let expected = image.read().unwrap().data;
    let other = colours.iter().zip(&expected).filter(|(a, b)| a != b).count();
    // Edges at the image's border, which has no neighbours to tell them by, and some antialiasing.
    assert!(other * 200 < colours.len(), "{other} of {} bytes differ", colours.len());

    let truth = npz(&only_file(&out.join("truth")), "dsm");
    let mut reader =
        sat3d::raster::open(&out.join("picture_dsm.tif"), &OpenOptions::default()).unwrap();
    let header = reader.header().clone();
    assert_eq!([header.width, header.height], whole.size());
    assert_eq!(header.geotransform, outer);
    let (mut block, mut apart) = (Vec::new(), 0);
    let (across, down) = header.blocks();
    for (bx, by) in (0..down).flat_map(|by| (0..across).map(move |bx| (bx, by))) {
        reader.read_block(bx, by, &mut block).unwrap();
        let (left, top) = (bx * header.block_width, by * header.block_height);
        let width = header.block_width;
        for (i, height) in (0..).zip(&block) {
            let (column, row) = (left + i % width, top + i / width);
            let inside = |v: u32, from: u32| (from..from + side).contains(&v);
            if inside(column, window.x) && inside(row, window.y) {
                let index = (row - window.y) * side + column - window.x;
                apart += usize::from((height - truth[index as usize]).abs() > 1e-4);
            }
        }
    }
    assert!(apart * 1000 < truth.len(), "{apart} of {} heights differ", truth.len());
}

#[test]
fn rasterio_opens_the_picture_and_its_truth() {
    let test = "rasterio_opens_the_picture_and_its_truth";
    let Some(python) = python(test, "numpy, rasterio") else { return };
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let path = scene_with_picture(folder.path());
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, format!("{text}truth_spacing_pixels = 2.5\n")).unwrap();
    run(&mut simulate(&path, &out, &[]), 0);
    let script = "import sys, rasterio
folder = sys.argv[1]
with rasterio.open(folder + '/picture.tif') as p, rasterio.open(folder + '/picture_dsm.tif') as d:
    assert p.count == 3 and p.dtypes == ('uint8',) * 3 and p.crs.to_epsg() == 3857, p.profile
    assert p.profile['tiled'] and p.block_shapes[0] == (256, 256), p.profile
    assert p.tags(ns='IMAGE_STRUCTURE')['COMPRESSION'] == 'DEFLATE', p.profile
    assert [band.name for band in p.colorinterp] == ['red', 'green', 'blue'], p.colorinterp
    assert d.count == 1 and d.dtypes == ('float32',) and d.crs.to_epsg() == 3857 and d.units == ('metre',)
    assert (p.width, p.height) == (d.width * 2.5, d.height * 2.5)
    assert max(abs(a - b) for a, b in zip(p.bounds, d.bounds)) < 1e-6, (p.bounds, d.bounds)
    z = d.read(1)
    assert 20 < z.min() < z.max() < 120, (z.min(), z.max())
    sys.stdout.buffer.write(bytes(str(p.read().transpose(1, 2, 0).astype('uint64').sum()), 'ascii'))
";
    let sum: u64 = run_python(python, script, &[&out]).parse().unwrap();
    let data = picture::open(&out.join("picture.tif")).unwrap().read().unwrap().data;
    assert_eq!(sum, data.iter().map(|v| u64::from(*v)).sum::<u64>());
}

#[test]
fn the_scene_of_nine_square_kilometres_is_a_scene() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let spec = sat3d::scene::SceneSpec::read(&root.join("pipelines/scenes/city_3km.toml")).unwrap();
    assert!(spec.picture.is_some() && spec.extent.width_metres == 3000.0);
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

#[test]
fn random_scenes_are_those_of_their_seed_and_serve_as_vigor_and_as_truth() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let draw = |seed: &str, threads: &str, out: &Path| {
        let mut command = sat3d();
        command.args(["simulate", "--random", "3", "--seed", seed, "--size", "96", "--json"]);
        run(command.arg("--out").arg(out).env("RAYON_NUM_THREADS", threads), 0)
    };
    let made: serde_json::Value =
        serde_json::from_str(&stdout(&draw("7", "1", &at("one")))).unwrap();
    draw("7", "2", &at("two"));
    assert_same(&at("one"), &at("two"), "threads");
    draw("8", "2", &at("other"));
    assert_ne!(contents(&at("one")), contents(&at("other")));
    assert_eq!(made["scenes"], 3);

    // VIGOR's layout, read by the ingest.
    let mut ingest = sat3d();
    // Their pixels are fewer than VIGOR's 640, which labels count in.
    ingest
        .args(["vigor", "ingest", "--json", "--verify", "none"])
        .arg(at("one/vigor"))
        .arg("--out")
        .arg(at("index"));
    let summary: serde_json::Value = serde_json::from_str(&stdout(&run(&mut ingest, 0))).unwrap();
    assert!(made["panoramas"].as_u64().unwrap() > 0);
    assert_eq!(summary["pairs"], made["panoramas"]);

    // Exact heights, as `sat3d eval` reads truth.
    let predict = ["-q", "eval", "baseline", "flat", "--gt"];
    let mut baseline = sat3d();
    run(baseline.args(predict).arg(at("one/truth")).arg("--out").arg(at("flat")), 0);
    let mut eval = sat3d();
    eval.args(["eval", "--json", "--pred"]).arg(at("flat")).arg("--gt").arg(at("one/truth"));
    let report: serde_json::Value = serde_json::from_str(&stdout(&run(&mut eval, 0))).unwrap();
    assert!(report.to_string().contains("rmse"), "{report}");

    let mut explained = sat3d();
    explained.args(["simulate", "--random", "20", "--seed", "7", "--explain"]);
    let text = stdout(&run(&mut explained, 0));
    assert!(text.contains("slope") && text.contains("suburb"), "{text}");
}

#[test]
fn random_scenes_that_cannot_be_are_refused() {
    let refused = |arguments: &[&str]| {
        let mut command = sat3d();
        stderr(&run(command.arg("simulate").args(arguments), 2))
    };
    let text = refused(&["--random", "0", "--out", "/no/such/place"]);
    assert!(text.contains("--random") || text.contains("at least"), "{text}");
    let text = refused(&["scene.toml", "--random", "2"]);
    assert!(text.contains("--random"), "{text}");
    let text = refused(&["--random", "2", "--size", "1", "--out", "/no/such/place"]);
    assert!(text.contains("size") || text.contains('1'), "{text}");
}
