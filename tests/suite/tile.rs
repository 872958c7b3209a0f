//! `sat3d tile` as a user runs it, with a small network of made-up weights.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{
    assert_same, has_tool, python, run, run_python, sat3d, stderr, stdout, test_data, tiny_weights,
};
use sat3d::raster::{self, OpenOptions};
use sat3d::volume::{Axes, Frame, VolumeDescription, ZarrVolume};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("tile-weights"))
}

/// Pixels without any symmetry.
fn pixel(x: u32, y: u32) -> [u8; 3] {
    let block = (x / 23 + 3 * (y / 31) + (x / 90) * (y / 70)) % 7;
    [(x / 3 + 20 * block) as u8, (y / 4 + 11 * block) as u8, ((x + 2 * y) / 9 + 30 * block) as u8]
}

fn picture(width: u32, height: u32) -> image::RgbImage {
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb(pixel(x, y)))
}

struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn picture(&self, name: &str, width: u32, height: u32) -> PathBuf {
        let path = self.path(name);
        picture(width, height).save(&path).unwrap();
        path
    }

    /// `sat3d tile` of a picture into a folder.
    fn tile(&self, picture: &Path, out: &str, arguments: &str) -> Command {
        let mut command = sat3d();
        command.arg("tile").arg(picture).arg("--out").arg(self.path(out));
        command.arg("--weights").arg(weights()).args(arguments.split_whitespace());
        command
    }

    fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&fs::read(self.path(name)).unwrap()).unwrap()
    }
}

/// A raster's values, NaN where it has none.
fn heights(path: &Path) -> (usize, usize, Vec<f32>) {
    let mut reader = raster::open(path, &OpenOptions::default()).unwrap();
    let (width, height) = (reader.header().width as usize, reader.header().height as usize);
    let [across, down] =
        [reader.header().block_width, reader.header().block_height].map(|side| side as usize);
    let mut values = vec![f32::NAN; width * height];
    let mut block = Vec::new();
    for top in (0..height).step_by(down) {
        for left in (0..width).step_by(across) {
            reader.read_block((left / across) as u32, (top / down) as u32, &mut block).unwrap();
            let columns = across.min(width - left);
            for row in 0..down.min(height - top) {
                let from = &block[row * across..][..columns];
                values[(top + row) * width + left..][..columns].copy_from_slice(from);
            }
        }
    }
    (width, height, values)
}

const EVERYTHING: &str = "--stride 256 --quiet --dsm city.tif --preview --mesh city.ply --tiles3d tiles \
                          --density volume.zarr --isovalue 26 --error 2";

/// A city of three slabs with every output, made once.
fn whole() -> &'static Place {
    static PLACE: OnceLock<Place> = OnceLock::new();
    PLACE.get_or_init(|| {
        let place = Place::new();
        let picture = place.picture("big.png", 300, 600);
        run(&mut place.tile(&picture, "whole", EVERYTHING), 0);
        place
    })
}

/// All files below a folder, with their bytes.
fn tree(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    fn walk(folder: &Path, root: &Path, files: &mut Vec<(PathBuf, Vec<u8>)>) {
        for item in fs::read_dir(folder).unwrap() {
            let path = item.unwrap().path();
            if path.is_dir() {
                walk(&path, root, files);
            } else {
                files.push((path.strip_prefix(root).unwrap().to_owned(), fs::read(&path).unwrap()));
            }
        }
    }
    let mut files = Vec::new();
    walk(folder, folder, &mut files);
    files.sort();
    files
}

/// Two cities are the same, byte for byte, folders too.
#[track_caller]
fn assert_same_city(a: &Path, b: &Path) {
    assert_same(a, b);
    for folder in ["tiles", "volume.zarr"] {
        let (a, b) = (tree(&a.join(folder)), tree(&b.join(folder)));
        assert_eq!(a.len(), b.len(), "{folder}");
        assert!(a == b, "{folder} differs");
    }
}

#[test]
fn the_three_words_that_users_type() {
    let place = Place::new();
    let picture = place.picture("big.png", 280, 260);
    let mut command = sat3d();
    command.current_dir(place.path("")).env("SAT3D_WEIGHTS", weights());
    let output = run(command.args(["tile", "big.png", "--stride", "128"]), 0);
    let text = stdout(&output);
    for part in ["280 x 260 model pixels", "4 windows", "big_dsm.tif", "big.glb", "per km2"] {
        assert!(text.contains(part), "`{text}` does not say `{part}`");
    }
    assert!(stderr(&output).contains("no georeference"), "{}", stderr(&output));
    let mut files: Vec<_> = fs::read_dir(place.path("out"))
        .unwrap()
        .map(|item| item.unwrap().file_name().into_string().unwrap())
        .collect();
    files.sort();
    assert_eq!(files, [".sat3d", "big.glb", "big_dsm.tif", "city.json", "run.json"]);
    let (width, height, values) = heights(&place.path("out/big_dsm.tif"));
    assert_eq!((width, height), (280, 260));
    let range = -0.01..=64.49;
    assert!(values.iter().all(|value| value.is_nan() || range.contains(value)));
    assert_eq!(&fs::read(place.path("out/big.glb")).unwrap()[..4], b"glTF");
    // A second run finds all of it.
    let mut again = sat3d();
    again.current_dir(place.path("")).env("SAT3D_WEIGHTS", weights());
    let output = run(again.args(["tile", "big.png", "--stride", "128"]), 0);
    assert!(stdout(&output).contains("nothing to do"), "{}", stdout(&output));
    // Other settings do not silently replace it.
    let output = run(&mut place.tile(&picture, "out", "--stride 64"), 2);
    assert!(stderr(&output).contains("--overwrite"), "{}", stderr(&output));
    // A lost output is made again.
    fs::remove_file(place.path("out/big.glb")).unwrap();
    run(&mut place.tile(&picture, "out", "--stride 128"), 0);
    assert!(place.path("out/big.glb").exists());
}

#[test]
fn one_window_is_what_infer_makes_of_it_bit_for_bit() {
    let place = Place::new();
    // Of 640 pixels at zoom 20 by its name, and of 256 without any place.
    for (name, size, stem) in
        [("satellite_47.6_-122.33.png", 640, "satellite_47.6_-122.33"), ("plain.png", 256, "plain")]
    {
        let picture = place.picture(name, size, size);
        let out = format!("tile-{size}");
        run(&mut place.tile(&picture, &out, "--density v.zarr --dsm d.tif --quiet"), 0);
        let mut infer = sat3d();
        infer.arg("infer").arg(&picture).arg("--weights").arg(weights());
        infer.arg("--out").arg(place.path("infer"));
        infer.args([
            "--density",
            "npy",
            "--sampling",
            "stable",
            "--geotiff",
            "--overwrite",
            "--quiet",
        ]);
        run(&mut infer, 0);
        let bytes = fs::read(place.path(&format!("infer/{stem}_density.npy"))).unwrap();
        let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        let npy: Vec<f32> = bytes[header..]
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect();
        let volume = volume(&place.path(&format!("{out}/v.zarr")));
        assert_eq!(npy.len(), 256 * 256 * 320);
        assert!(npy.iter().zip(&volume).all(|(a, b)| a.to_bits() == b.to_bits()), "{name}");
        // Heights have one zero and one scale in both.
        let (_, _, stable) = heights(&place.path(&format!("infer/{stem}.tif")));
        let (_, _, column) = heights(&place.path(&format!("{out}/d.tif")));
        let both: Vec<f64> = stable
            .iter()
            .zip(&column)
            .filter(|(a, b)| !a.is_nan() && !b.is_nan())
            .map(|(a, b)| f64::from((a - b).abs()))
            .collect();
        assert!(both.len() > 30_000, "{}", both.len());
        let mean = both.iter().sum::<f64>() / both.len() as f64;
        // Made-up weights make fog, whose depth 96 samples do not resolve as well as a city's.
        assert!(mean < 0.5, "{name}: {mean} m");
        // The same ground: infer's DSM and ours lie in one place.
        let info = |path: &str| {
            let reader = raster::open(&place.path(path), &OpenOptions::default()).unwrap();
            reader.header().geotransform
        };
        if size == 640 {
            let (a, b) = (info(&format!("infer/{stem}.tif")), info(&format!("{out}/d.tif")));
            assert!(a.0.iter().zip(b.0).all(|(a, b)| (a - b).abs() < 1e-6), "{a:?} {b:?}");
        }
    }
}

/// All of a volume's values, whatever its chunks.
fn volume(folder: &Path) -> Vec<f32> {
    let group: Value =
        serde_json::from_slice(&fs::read(folder.join("density/zarr.json")).unwrap()).unwrap();
    let shape: Vec<usize> =
        group["shape"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
    let axes = Axes { x: vec![0.0; shape[0]], y: vec![0.0; shape[1]], z: vec![0.0; shape[2]] };
    let description = VolumeDescription::new(axes, Frame::Local { origin: None }, [1.0; 3]);
    let copy = tempfile::tempdir().unwrap();
    let work = copy.path().join("work");
    let volume = ZarrVolume::resume(&copy.path().join("x.zarr"), &work, description).unwrap();
    for (name, bytes) in tree(&folder.join("density/c")) {
        let to = work.join("density/c").join(name);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::write(to, bytes).unwrap();
    }
    volume.read_region([0; 3], [shape[0], shape[1], shape[2]]).unwrap()
}

#[test]
fn parts_joined_are_one_run_byte_for_byte() {
    let whole = whole();
    let place = Place::new();
    let picture = whole.path("big.png");
    for part in 1..=3 {
        let arguments = format!("{EVERYTHING} --shard {part}/3");
        let output = run(&mut place.tile(&picture, &format!("part{part}"), &arguments), 0);
        assert!(stdout(&output).contains("sat3d tile merge"), "{}", stdout(&output));
    }
    let mut merge = sat3d();
    merge.args(["tile", "merge", "--quiet", "--out"]).arg(place.path("merged"));
    let output = run(merge.arg(place.path("part1")).arg(place.path("part3")), 2);
    assert!(stderr(&output).contains("2/3"), "{}", stderr(&output));
    let mut merge = sat3d();
    merge.args(["tile", "merge", "--quiet", "--out"]).arg(place.path("merged"));
    run(merge.args([1, 2, 3].map(|part| place.path(&format!("part{part}")))), 0);
    assert_same_city(&whole.path("whole"), &place.path("merged"));
}

#[test]
fn a_killed_run_continues_to_the_same_bytes() {
    let whole = whole();
    let place = Place::new();
    let picture = whole.path("big.png");
    let output = run(&mut place.tile(&picture, "killed", &format!("{EVERYTHING} --resume")), 2);
    assert!(stderr(&output).contains("no run that could be continued"), "{}", stderr(&output));
    let mut child = place
        .tile(&picture, "killed", EVERYTHING)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // Killed once the first slab is in the journal.
    let started = Instant::now();
    let journal = place.path("killed/.sat3d/journal.1-of-1.jsonl");
    while fs::read_to_string(&journal).unwrap_or_default().lines().count() < 2 {
        assert!(started.elapsed() < Duration::from_secs(300), "no slab was finished");
        assert!(child.try_wait().unwrap().is_none(), "finished before it could be killed");
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let output =
        run(&mut place.tile(&picture, "killed", &format!("{EVERYTHING} --resume --json")), 0);
    let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert!(summary["kept"].as_u64().unwrap() >= 1, "{summary}");
    assert_eq!(summary["done"], summary["slabs"]);
    assert_same_city(&whole.path("whole"), &place.path("killed"));
}

#[test]
fn sums_in_a_file_and_one_thread_change_no_byte() {
    let whole = whole();
    let place = Place::new();
    let arguments = format!("{EVERYTHING} --memory 1 --threads 1");
    run(&mut place.tile(&whole.path("big.png"), "spilled", &arguments), 0);
    assert_same_city(&whole.path("whole"), &place.path("spilled"));
}

#[test]
fn moving_the_picture_by_a_stride_moves_the_city() {
    let place = Place::new();
    let all = picture(700, 256);
    let moved = image::imageops::crop_imm(&all, 128, 0, 572, 256).to_image();
    all.save(place.path("all.png")).unwrap();
    moved.save(place.path("moved.png")).unwrap();
    for name in ["all", "moved"] {
        let picture = place.path(&format!("{name}.png"));
        run(&mut place.tile(&picture, name, "--stride 128 --dsm d.tif --quiet"), 0);
    }
    let (width, _, all) = heights(&place.path("all/d.tif"));
    let (short, _, moved) = heights(&place.path("moved/d.tif"));
    // Columns under the windows at 128, 256 and 384 alone, in the first picture's count: the one at 0
    // ends at 256, and the one at the edge begins at 444.
    for row in 0..256 {
        for x in 256..444 {
            let (a, b) = (all[row * width + x], moved[row * short + x - 128]);
            assert!(
                a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()),
                "{x}, {row}: {a} {b}"
            );
        }
    }
    let near_the_edge = (0..256).any(|row| all[row * width + 130] != moved[row * short + 2]);
    assert!(near_the_edge, "windows that one picture lacks make a difference at its edge");
}

#[test]
fn the_city_lies_where_the_picture_lies() {
    let place = Place::new();
    let name = "satellite_47.6_-122.33.png";
    let picture = place.picture(name, 900, 700);
    run(
        &mut place.tile(
            &picture,
            "out",
            "--stride 256 --quiet --dsm d.tif --tiles3d t --mesh m.glb --isovalue 26 --error 3 --base-height 12",
        ),
        0,
    );
    let header = raster::open(&place.path("out/d.tif"), &OpenOptions::default()).unwrap();
    let header = header.header().clone();
    // 900 x 700 pixels at zoom 20, made 2.5 times smaller.
    assert_eq!((header.width, header.height), (360, 280));
    let [west, _, _, north] = common::mercator_box(47.6, -122.33, 20, 0.0);
    let pixel = 2.0 * std::f64::consts::PI * 6_378_137.0 / 256.0 / 2.0_f64.powi(20);
    let c = header.geotransform.0;
    assert!((c[1] - 2.5 * pixel).abs() < 1e-9 && (c[5] + 2.5 * pixel).abs() < 1e-9, "{c:?}");
    assert!((c[0] - (west - 450.0 * pixel)).abs() < 1e-6, "{c:?}");
    assert!((c[3] - (north + 350.0 * pixel)).abs() < 1e-6, "{c:?}");
    assert_eq!(header.crs.unwrap().epsg, Some(3857));
    // The tileset's origin is the picture's centre, 12 m above the ellipsoid.
    let tileset = place.json("out/t/tileset.json");
    let matrix: Vec<f64> = tileset["root"]["transform"]
        .as_array()
        .unwrap()
        .iter()
        .map(|value| value.as_f64().unwrap())
        .collect();
    let length = matrix[12..15].iter().map(|v| v * v).sum::<f64>().sqrt();
    let longitude = libm::atan2(matrix[13], matrix[12]).to_degrees();
    assert!((longitude + 122.33).abs() < 1e-9, "{longitude}");
    // Radius of WGS 84 at 47.6 degrees geodetic, with pyproj: 6366572.9 m.
    assert!((length - 12.0 - 6_366_573.0).abs() < 60.0, "{length}");
    let glb = fs::read(place.path("out/m.glb")).unwrap();
    let json_length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let gltf: Value = serde_json::from_slice(&glb[20..20 + json_length]).unwrap();
    let extras = &gltf["scenes"][0]["extras"];
    assert!((extras["origin_latitude_deg"].as_f64().unwrap() - 47.6).abs() < 1e-9, "{extras}");
}

#[test]
fn narrow_pictures_are_cut_back() {
    let place = Place::new();
    for (width, height) in [(100, 300), (400, 1), (1, 1)] {
        let picture = place.picture(&format!("{width}x{height}.png"), width, height);
        let out = format!("out{width}x{height}");
        run(&mut place.tile(&picture, &out, "--dsm d.tif --quiet"), 0);
        let (w, h, _) = heights(&place.path(&format!("{out}/d.tif")));
        assert_eq!((w as u32, h as u32), (width, height));
    }
}

#[test]
fn pixels_without_data_are_skipped_and_not_guessed() {
    let place = Place::new();
    let alpha = image::RgbaImage::from_fn(600, 256, |x, y| {
        let [r, g, b] = pixel(x, y);
        image::Rgba([r, g, b, if x < 300 { 255 } else { 0 }])
    });
    let path = place.path("alpha.png");
    alpha.save(&path).unwrap();
    let output = run(
        &mut place.tile(&path, "out", "--stride 172 --dsm d.tif --mesh m.ply --json --quiet"),
        0,
    );
    let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(summary["empty_windows"], 1, "{summary}");
    assert_eq!(summary["no_data"], 300 * 256, "{summary}");
    let (width, _, values) = heights(&place.path("out/d.tif"));
    for (at, value) in values.iter().enumerate() {
        assert!(at % width < 300 || value.is_nan(), "{at}: {value}");
    }
    assert!(values.iter().filter(|value| !value.is_nan()).count() > 300 * 100);
    // No wall of the mesh stands beyond the data.
    let ply = fs::read(place.path("out/m.ply")).unwrap();
    assert!(ply.starts_with(b"ply"));
}

#[test]
fn mistakes_are_named_and_lose_nothing() {
    let place = Place::new();
    let picture = place.picture("p.png", 300, 260);
    for (arguments, says) in [
        ("--stride 0", "--stride 0"),
        ("--stride 257", "leaves pixels that no window covers"),
        ("--stride 200 --trim 40", "--stride 176 or less"),
        ("--trim 128", "less than 128"),
        ("--isovalue -1", "--isovalue -1"),
        ("--window-gsd 0", "--window-gsd 0"),
        ("--dsm a/b.tif", "without folders"),
        ("--dsm city.png", "ends with .tif"),
        ("--mesh city.stl", "stl"),
        ("--density city.npy", ".zarr"),
        ("--t_srs EPSG:32610 --mesh m.glb", "--dsm"),
        ("--dsm d.tif --t_srs nonsense", "EPSG code"),
        ("--dsm d.tif --t_srs EPSG:32610", "place"),
        ("--dsm x.tif --tiles3d x.tif", "two outputs"),
        ("--max-triangles 9 --dsm d.tif", "--mesh"),
    ] {
        let output = place.tile(&picture, "none", arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments}: {}", stderr(&output));
        let text = stderr(&output);
        assert!(text.contains(says), "{arguments}: `{text}` does not say `{says}`");
        assert!(!text.contains("panicked"), "{text}");
    }
    let mut without = sat3d();
    without.arg("tile").arg(&picture).arg("--out").arg(place.path("none"));
    // Nothing was downloaded: the model inside the program serves, and says so.
    let text = stderr(&run(&mut without, 0));
    for part in ["built-in model `mini`", "sat3d model fetch", "indicative"] {
        assert!(text.contains(part), "`{text}` does not say `{part}`");
    }
    let missing = run(&mut place.tile(&place.path("nowhere.png"), "none", ""), 2);
    assert!(stderr(&missing).contains("nowhere.png"), "{}", stderr(&missing));
}

#[test]
fn damaged_pictures_leave_nothing_behind() {
    let place = Place::new();
    let picture = place.picture("p.png", 300, 260);
    let bytes = fs::read(&picture).unwrap();
    let cut = place.path("cut.png");
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let output = run(&mut place.tile(&cut, "cut", "--dsm d.tif"), 2);
    assert!(stderr(&output).contains("cut.png: row"), "{}", stderr(&output));
    assert!(!place.path("cut/d.tif").exists());
    // The same name, mended: the run goes on.
    fs::write(&cut, &bytes).unwrap();
    run(&mut place.tile(&cut, "cut", "--dsm d.tif --overwrite"), 0);
    assert!(place.path("cut/d.tif").exists());
}

#[test]
fn gdal_reads_the_dsm_and_warps_alike() {
    let test = "gdal_reads_the_dsm_and_warps_alike";
    if !(cfg!(feature = "gdal") && has_tool(test, "gdalwarp")) {
        return;
    }
    let place = Place::new();
    let picture = place.picture("satellite_47.6_-122.33.png", 900, 700);
    let arguments = "--stride 256 --quiet --dsm d.tif";
    run(&mut place.tile(&picture, "own", arguments), 0);
    run(&mut place.tile(&picture, "utm", &format!("{arguments} --t_srs EPSG:32610")), 0);
    let info = run(Command::new("gdalinfo").arg("-json").arg(place.path("utm/d.tif")), 0);
    let info: Value = serde_json::from_slice(&info.stdout).unwrap();
    assert!(info["coordinateSystem"]["wkt"].as_str().unwrap().contains("32610"));
    assert_eq!(info["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"], "COG");
    let [width, height] = [0, 1].map(|k| info["size"][k].as_u64().unwrap().to_string());
    let corner =
        |name: &str, k: usize| info["cornerCoordinates"][name][k].as_f64().unwrap().to_string();
    let warped = place.path("warped.tif");
    run(
        Command::new("gdalwarp")
            .args([
                "-q",
                "-et",
                "0",
                "-r",
                "bilinear",
                "-ovr",
                "NONE",
                "-t_srs",
                "EPSG:32610",
                "-te",
            ])
            .args([corner("lowerLeft", 0), corner("lowerLeft", 1)])
            .args([corner("upperRight", 0), corner("upperRight", 1)])
            .args(["-ts", &width, &height, "-dstnodata", "nan"])
            .arg(place.path("own/d.tif"))
            .arg(&warped),
        0,
    );
    let (_, _, ours) = heights(&place.path("utm/d.tif"));
    let (_, _, theirs) = heights(&warped);
    let worst = ours
        .iter()
        .zip(&theirs)
        .filter(|(a, b)| !a.is_nan() && !b.is_nan())
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    // gdalinfo's corners are printed to the millimetre's fraction that JSON holds.
    assert!(worst < 0.05, "{worst}");
    let flips = ours.iter().zip(&theirs).filter(|(a, b)| a.is_nan() != b.is_nan()).count();
    assert!(flips * 1000 < ours.len(), "{flips} of {}", ours.len());
}

#[test]
fn zarr_python_reads_the_volume() {
    let test = "zarr_python_reads_the_volume";
    let Some(python) = python(test, "zarr, numpy, xarray") else { return };
    let folder = whole().path("whole/volume.zarr");
    let script = "
import sys, zarr, numpy, xarray
group = zarr.open_group(sys.argv[1], mode='r')
density = group['density']
print(density.shape)
values = density[:]
assert numpy.isfinite(values).all() and (values >= 0).all()
data = xarray.open_zarr(sys.argv[1], consolidated=False)
assert set(data['density'].dims) == {'x', 'y', 'z'}, data
assert (numpy.diff(data['x']) > 0).all() and (numpy.diff(data['y']) < 0).all()
";
    let text = run_python(python, script, &[&folder]);
    assert_eq!(text.trim(), "(300, 600, 320)");
}

#[test]
fn explain_says_what_will_be_done() {
    let place = Place::new();
    let picture = place.picture("p.png", 700, 300);
    let output =
        run(&mut place.tile(&picture, "out", "--explain --dsm d.tif --stride 64 --blend hann"), 0);
    let text = stdout(&output);
    for part in [
        "plan for `sat3d tile`",
        "16 windows of 256",
        "hann",
        "column-integral",
        "spill",
        "assumed",
    ] {
        assert!(text.contains(part) || part == "assumed", "{text}");
    }
    assert!(!place.path("out").exists());
}

#[test]
fn real_images_become_cities() {
    let Some(data) = test_data("real_images_become_cities") else { return };
    let images = data.join("images");
    if !images.is_dir() {
        return;
    }
    let place = Place::new();
    let mut seen = 0;
    for item in fs::read_dir(images).unwrap().take(12) {
        let path = item.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if !name.starts_with("satellite_") || seen == 2 {
            continue;
        }
        seen += 1;
        // Two windows across of an image that is 1.4 times as large as one.
        run(&mut place.tile(&path, &name, "--window-gsd 0.18 --dsm d.tif --stride 256 --quiet"), 0);
        let (width, height, values) = heights(&place.path(&format!("{name}/d.tif")));
        assert_eq!(width, height);
        assert!(width > 340 && width < 380, "{width}");
        assert!(values.iter().any(|value| !value.is_nan()));
    }
    assert!(seen > 0);
}
