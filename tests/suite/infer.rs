//! `sat3d infer` as a user runs it, with a small network of made-up weights.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{
    assert_same, has_tool, mercator_box, npz, row, run, sat3d, stderr, stdout, tiny_weights,
};
use sat3d::lidar::SingleRaster;
use sat3d::model::network::Wanted;
use sat3d::model::render::{RenderOptions, STABLE_RMS};
use sat3d::model::{Checkpoint, Image8, Model};
use sat3d::raster::OpenOptions;
use sat3d::raster::npz::{self, Compression, NpyArray, NpyData};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

const LAT: f64 = 47.6;
const LON: f64 = -122.33;

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("infer-weights"))
}

/// Pixels without any symmetry, another picture for each seed.
fn pixel(x: u32, y: u32, seed: u32) -> [u8; 3] {
    let block = (x / 23 + 3 * (y / 31) + seed) % 7;
    [(x / 3 + 20 * block) as u8, (y / 4 + 11 * seed) as u8, ((x + 2 * y) / 9 + 30 * block) as u8]
}

fn picture(width: u32, height: u32, seed: u32) -> image::RgbImage {
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb(pixel(x, y, seed)))
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

    /// A VIGOR city of `count` images.
    fn city(&self, count: u32) -> Vec<String> {
        fs::create_dir_all(self.path("Seattle/satellite")).unwrap();
        (0..count)
            .map(|k| {
                let stem = format!("satellite_{}_{LON}", LAT + f64::from(k) * 1e-3);
                let file = self.path("Seattle/satellite").join(format!("{stem}.png"));
                picture(640, 640, k).save(file).unwrap();
                stem
            })
            .collect()
    }

    fn infer(&self, input: &str, out: &str, extra: &[&str]) -> Command {
        let mut command = sat3d();
        command
            .env_remove("SAT3D_WEIGHTS")
            .args(["-q", "infer"])
            .arg(self.path(input))
            .arg("--out")
            .arg(self.path(out))
            .arg("--weights")
            .arg(weights())
            .args(extra);
        command
    }
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn heights_are_the_scenes_own_north_up_and_eval_scores_them_at_once() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    let output = run(&mut place.infer("Seattle", "out", &["--geotiff"]), 0);
    assert!(stdout(&output).contains("1 of 1 images done"), "{}", stdout(&output));
    assert!(stdout(&output).contains("sat3d eval --pred"), "{}", stdout(&output));
    let out = place.path("out");

    // The same numbers as the library gives for the picture.
    let image = picture(640, 640, 0);
    let image = Image8::new(640, 640, 3, image.into_raw()).unwrap();
    let checkpoint = Checkpoint::open(weights()).unwrap();
    // As fast as the program is on this machine.
    let execution = Wanted::default().choose(checkpoint.config()).unwrap();
    let model = Model::of_checkpoint(&checkpoint, &execution).unwrap();
    let scene = model.scene(&image, None, 32.24).unwrap();
    let dsm = scene.dsm(256, &RenderOptions::default());
    let file = out.join(format!("{stem}.npz"));
    let arrays = npz::read(&file).unwrap();
    let keys: Vec<_> =
        arrays.iter().map(|(key, array)| (key.as_str(), array.shape.clone())).collect();
    let square = vec![256, 256];
    let wanted = [
        ("arr_0", square.clone()),
        ("metres_per_unit", vec![]),
        ("opacity", square.clone()),
        ("depth_spread", square),
    ];
    assert_eq!(keys, wanted);
    let heights = npz(&file, "arr_0");
    assert_eq!(heights, dsm.height);
    assert_eq!(npz(&file, "opacity"), dsm.opacity);
    assert_eq!(arrays[1].1.to_f64(), [64.48]);
    for (metres, units) in npz(&file, "depth_spread").iter().zip(&dsm.depth_spread) {
        let exact = units * 32.24;
        assert!((metres - exact).abs() <= 1e-6 * exact || metres.is_nan(), "{metres} {units}");
    }
    let (low, high) = heights.iter().fold((1.0_f32, 0.0_f32), |(l, h), v| (l.min(*v), h.max(*v)));
    assert!(high - low > 0.05, "made-up weights still make a relief: {low} to {high}");

    // The GeoTIFF: metres, on the image's window with 256 pixels.
    let raster =
        SingleRaster::open(&out.join(format!("{stem}.tif")), &OpenOptions::default(), None)
            .unwrap();
    let header = raster.header();
    assert_eq!((header.width, header.height), (256, 256));
    let [west, south, east, north] = mercator_box(LAT, LON, 20, 640.0);
    let step = (east - west) / 256.0;
    let expected = [west, step, 0.0, north, 0.0, -(north - south) / 256.0];
    for (found, expected) in header.geotransform.0.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
    }
    let metres: Vec<f32> = heights.iter().map(|h| (f64::from(*h) * 64.48) as f32).collect();
    assert_eq!(raster.whole().unwrap(), metres);

    // Scored against themselves the heights err by nothing; turned over they do.
    let score = |truth: Vec<f32>, name: &str| {
        let folder = place.path(name);
        fs::create_dir_all(&folder).unwrap();
        let array = NpyArray { name: "dsm", shape: &[256, 256], data: NpyData::F32(&truth) };
        let bytes = npz::encode(&[array], Compression::Fast);
        fs::write(folder.join(format!("{stem}_dsm.npz")), bytes).unwrap();
        let mut command = sat3d();
        command.args(["eval", "--json", "-q", "--pred"]).arg(&out).arg("--gt").arg(folder);
        let found: Value = serde_json::from_str(&stdout(&run(&mut command, 0))).unwrap();
        assert_eq!(found["per_image"].as_array().unwrap().len(), 1, "{found}");
        found["per_image"][0]["mae_m"].as_f64().unwrap()
    };
    let same = score(metres.clone(), "gt");
    let south_up: Vec<f32> = metres.chunks(256).rev().flatten().copied().collect();
    let turned = score(south_up, "gt-south");
    assert!(same < 1e-3, "{same}");
    assert!(turned > 0.5, "{turned}");

    let row = row(&out, &stem);
    assert_eq!(row["status"], "done");
    assert_eq!(row["ground_from"], "place");
    assert_eq!((row["lat"].parse(), row["lon"].parse()), (Ok(LAT), Ok(LON)));
    assert!(!row["flags"].contains("ground"), "{}", row["flags"]);
    assert!((row["ground_width_m"].parse::<f64>().unwrap() - 64.44).abs() < 0.1);
    let predictions = json(&out.join("predictions.json"));
    assert_eq!(predictions["plan"]["command"], "infer");
    assert_eq!(predictions["images"]["done"], 1);
    assert_eq!(predictions["weights"]["class_name"], "Sat3DGen");
    assert_eq!(json(&out.join("run.json"))["summary"]["done"], 1);
}

#[test]
fn numpy_and_gdal_read_the_outputs() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    run(&mut place.infer("Seattle", "out", &["--geotiff", "--depth", "normalised"]), 0);
    let python = std::env::var_os("SAT3D_PYTHON").unwrap_or_else(|| "python3".into());
    let script = "import sys, numpy\n\
        z = numpy.load(sys.argv[1])\n\
        a = z['arr_0']\n\
        assert a.dtype == numpy.float32 and a.shape == (256, 256)\n\
        assert z['opacity'].shape == a.shape and z['depth_spread'].dtype == numpy.float32\n\
        assert z['metres_per_unit'].shape == () and z['metres_per_unit'] == 64.48\n\
        print(numpy.isnan(a).sum(), (z['opacity'] < 0.05).sum())";
    if Command::new(&python).args(["-c", "import numpy"]).output().is_ok_and(|o| o.status.success())
    {
        let file = place.path("out").join(format!("{stem}.npz"));
        let output = run(Command::new(&python).args(["-c", script]).arg(file), 0);
        let text = stdout(&output);
        let counts: Vec<&str> = text.split_whitespace().collect();
        assert_eq!(counts[0], counts[1], "no surface, no height");
    } else {
        eprintln!("SKIPPED numpy: no python with numpy (set SAT3D_PYTHON)");
    }
    if has_tool("gdalinfo", "gdalinfo") {
        let file = place.path("out").join(format!("{stem}.tif"));
        let output = run(Command::new("gdalinfo").arg("-json").arg(file), 0);
        let found: Value = serde_json::from_str(&stdout(&output)).unwrap();
        assert_eq!(found["size"], serde_json::json!([256, 256]));
        let wkt = found["coordinateSystem"]["wkt"].as_str().unwrap();
        assert!(wkt.contains("3857") && !wkt.contains("VERT"), "{wkt}");
        assert_eq!(found["bands"][0]["noDataValue"], "NaN");
        assert_eq!(found["bands"][0]["unit"], "metre");
        assert_eq!(found["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"], "COG");
    }
}

#[test]
fn threads_and_shards_do_not_change_a_byte() {
    let place = Place::new();
    place.city(4);
    let extra = ["--geotiff", "--scene", "--dsm-size", "48"];
    let with = |more: &[&'static str]| -> Vec<&str> {
        extra.iter().copied().chain(more.iter().copied()).collect()
    };
    run(&mut place.infer("Seattle", "one", &with(&["--threads", "1"])), 0);
    run(&mut place.infer("Seattle", "many", &with(&["--threads", "3"])), 0);
    assert_same(&place.path("one"), &place.path("many"));
    for shard in ["2/2", "1/2"] {
        run(&mut place.infer("Seattle", "sharded", &with(&["--shard", shard])), 0);
        assert!(!place.path("sharded/manifest.csv").exists());
    }
    run(sat3d().args(["infer", "merge", "--out"]).arg(place.path("sharded")), 0);
    assert_same(&place.path("one"), &place.path("sharded"));
    // Shards of other folders are copied; a missing one is named.
    run(&mut place.infer("Seattle", "p1", &with(&["--shard", "1/2"])), 0);
    let merge = |parts: &[&str], code: i32| {
        let mut command = sat3d();
        command.args(["infer", "merge", "--out"]).arg(place.path("joined"));
        command.args(parts.iter().map(|part| place.path(part)));
        run(&mut command, code)
    };
    assert!(stderr(&merge(&["p1"], 2)).contains("not finished: 2/2"));
    run(&mut place.infer("Seattle", "p2", &with(&["--shard", "2/2"])), 0);
    merge(&["p1", "p2"], 0);
    assert_same(&place.path("one"), &place.path("joined"));
}

#[test]
fn interrupted_and_killed_runs_continue_to_the_same_bytes() {
    let place = Place::new();
    place.city(5);
    let extra = ["--dsm-size", "32"];
    run(&mut place.infer("Seattle", "whole", &extra), 0);
    for signal in ["INT", "KILL"] {
        let out = format!("cut-{signal}");
        let mut child = place
            .infer("Seattle", &out, &extra)
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        // Wait for a first finished image, so that there is something to keep.
        for _ in 0..6000 {
            let begun = fs::read_dir(place.path(&out)).is_ok_and(|items| {
                items
                    .filter_map(Result::ok)
                    .any(|i| i.file_name().to_string_lossy().ends_with(".npz"))
            });
            if begun || child.try_wait().unwrap().is_some() {
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
        run(&mut place.infer("Seattle", &out, &extra), 0);
        assert_same(&place.path("whole"), &place.path(&out));
    }
    // A third run has nothing left to do.
    let output = run(&mut place.infer("Seattle", "whole", &[&extra[..], &["--json"]].concat()), 0);
    let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!((&summary["done"], &summary["kept"]), (&5.into(), &5.into()), "{summary}");
}

#[test]
fn changed_inputs_damaged_outputs_and_other_options_are_noticed() {
    let place = Place::new();
    let stems = place.city(2);
    let small = ["--dsm-size", "16"];
    run(&mut place.infer("Seattle", "out", &small), 0);
    let kept = |extra: &[&str]| {
        let extra = [&small[..], &["--json"], extra].concat();
        let output = run(&mut place.infer("Seattle", "out", &extra), 0);
        let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
        summary["kept"].as_u64().unwrap()
    };
    assert_eq!(kept(&[]), 2);
    // A byte changed: sizes do not tell, hashes do.
    let file = place.path("out").join(format!("{}.npz", stems[0]));
    let good = fs::read(&file).unwrap();
    let mut bad = good.clone();
    let middle = bad.len() / 2;
    bad[middle] ^= 1;
    fs::write(&file, bad).unwrap();
    assert_eq!(kept(&[]), 2);
    assert_eq!(kept(&["--verify", "hashes"]), 1);
    assert!(fs::read(&file).unwrap() == good);
    let origin = &json(&place.path("out/run.json"))["weights"];
    assert_eq!(origin["sha256"].as_str().unwrap().len(), 64, "{origin}");
    // A deleted output, then a new picture.
    fs::remove_file(&file).unwrap();
    assert_eq!(kept(&[]), 1);
    let image = place.path("Seattle/satellite").join(format!("{}.png", stems[1]));
    picture(640, 640, 9).save(image).unwrap();
    assert_eq!(kept(&[]), 1);
    // Another plan is refused, with what differs.
    let output = run(&mut place.infer("Seattle", "out", &["--dsm-size", "17"]), 2);
    let text = stderr(&output);
    assert!(text.contains("predictions made with another plan"), "{text}");
    assert!(text.contains("size: 16 there, 17 now"), "{text}");
    run(&mut place.infer("Seattle", "out", &["--dsm-size", "17", "--overwrite"]), 0);
    assert_eq!(npz(&file, "arr_0").len(), 17 * 17);
}

#[test]
fn a_bad_image_stops_nothing_and_every_kind_of_png_is_read() {
    let place = Place::new();
    let folder = place.path("images");
    fs::create_dir(&folder).unwrap();
    let (width, height) = (50, 40);
    let plain = picture(width, height, 3);
    plain.save(folder.join("plain.png")).unwrap();
    let deep = image::ImageBuffer::from_fn(width, height, |x, y| {
        image::Rgb(pixel(x, y, 3).map(|v| u16::from(v) * 257))
    });
    image::DynamicImage::ImageRgb16(deep).save(folder.join("deep.png")).unwrap();
    let alpha = image::RgbaImage::from_fn(width, height, |x, y| {
        let [r, g, b] = pixel(x, y, 3);
        image::Rgba([r, g, b, (x * 5) as u8])
    });
    alpha.save(folder.join("alpha.png")).unwrap();
    // A palette of 200 colours, and the same picture without it.
    let index = |x: u32, y: u32| ((x * 4 + y) % 200) as u8;
    let colour = |k: u8| [k, 255 - k, k / 2];
    let mut encoder =
        png::Encoder::new(fs::File::create(folder.join("palette.png")).unwrap(), width, height);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_palette((0..200).flat_map(colour).collect::<Vec<u8>>());
    let mut writer = encoder.write_header().unwrap();
    let indices: Vec<u8> = (0..height).flat_map(|y| (0..width).map(move |x| index(x, y))).collect();
    writer.write_image_data(&indices).unwrap();
    writer.finish().unwrap();
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb(colour(index(x, y))))
        .save(folder.join("unfolded.png"))
        .unwrap();
    image::RgbImage::from_pixel(1, 1, image::Rgb([90, 120, 40]))
        .save(folder.join("dot.png"))
        .unwrap();
    let whole = fs::read(folder.join("plain.png")).unwrap();
    fs::write(folder.join("cut.png"), &whole[..whole.len() / 2]).unwrap();
    fs::write(folder.join("text.png"), "not a picture").unwrap();
    fs::write(folder.join("notes.txt"), "left alone").unwrap();
    let name = "satellite_89.9_0.png";
    plain.save(folder.join(name)).unwrap();

    let output = run(&mut place.infer("images", "out", &["--dsm-size", "24", "--geotiff"]), 1);
    let text = stdout(&output);
    assert!(text.contains("7 of 9 images done"), "{text}");
    assert!(text.contains("state no size on the ground"), "{text}");
    let out = place.path("out");
    for (stem, why) in [("cut", "truncated"), ("text", "neither PNG nor JPEG nor TIFF")] {
        let row = row(&out, stem);
        assert_eq!(row["status"], "failed", "{stem}");
        assert!(row["reason"].contains(why), "{stem}: {}", row["reason"]);
        assert!(row["reason"].starts_with(stem), "no folders: {}", row["reason"]);
        assert!(!out.join(format!("{stem}.npz")).exists());
    }
    let off = row(&out, "satellite_89.9_0");
    assert!(off["flags"].contains("outside Web Mercator"), "{}", off["flags"]);
    assert_eq!((off["status"].as_str(), off["ground_from"].as_str()), ("done", "assumed"));
    let heights = |stem: &str| npz(&out.join(format!("{stem}.npz")), "arr_0");
    for stem in ["deep", "alpha"] {
        assert_eq!(heights(stem), heights("plain"), "{stem}");
    }
    assert_eq!(heights("palette"), heights("unfolded"));
    assert_ne!(heights("palette"), heights("plain"));
    assert!(heights("dot").iter().all(|v| v.is_finite()));
    let row = row(&out, "plain");
    assert_eq!(row["ground_from"], "assumed");
    assert_eq!(row["ground_width_m"].parse::<f64>().unwrap(), 64.48);
    assert!(row["flags"].contains("nothing says how large"), "{}", row["flags"]);
    let raster =
        SingleRaster::open(&out.join("plain.tif"), &OpenOptions::default(), None).map(|_| ());
    assert!(raster.is_err(), "a GeoTIFF without CRS has no place");
}

#[test]
fn the_ground_is_checked_against_that_of_the_training() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    let image = format!("Seattle/satellite/{stem}.png");
    let extra = ["--gsd", "0.2", "--dsm-size", "16", "--vertical-scale", "isotropic"];
    let mut command = place.infer(&image, "out", &extra);
    let output = run(&mut command, 0);
    assert!(stdout(&output).contains("another size on the ground"), "{}", stdout(&output));
    let row = row(&place.path("out"), &stem);
    assert_eq!(row["ground_from"], "option");
    assert_eq!(row["ground_width_m"].parse::<f64>().unwrap(), 128.0);
    assert!(row["flags"].contains("1.99 x 1.99 times"), "{}", row["flags"]);
    assert!(row["flags"].contains("--gsd says 0.2000"), "{}", row["flags"]);
    // 128 m over 1.6 cube units, twice.
    let units = npz(&place.path("out").join(format!("{stem}.npz")), "metres_per_unit");
    assert!((units[0] - 160.0).abs() < 1e-4, "{units:?}");
    // Not quiet, it is said before the work too.
    let mut loud = sat3d();
    loud.args(["infer", "--explain", "--gsd", "0.2,0.1", "--weights"]).arg(weights());
    let output = run(loud.arg(place.path(&image)), 0);
    assert!(stderr(&output).contains("1 of 1 images looked at"), "{}", stderr(&output));
}

#[test]
fn lists_and_manifests_name_images() {
    let place = Place::new();
    let stems = place.city(3);
    let names: Vec<String> = stems.iter().map(|stem| format!("{stem}.png")).collect();
    fs::write(
        place.path("names.txt"),
        format!(
            "# two of them\nSeattle/satellite/{} x 1 2\n\nSeattle/satellite/{}\n",
            names[0], names[2]
        ),
    )
    .unwrap();
    // As `vigor ingest` writes it: a row per pair.
    fs::write(
        place.path("manifest.csv"),
        format!(
            "city,panorama,satellite\nSeattle,a,{0}\nSeattle,b,{0}\nSeattle,c,gone.png\n",
            names[1]
        ),
    )
    .unwrap();
    fs::write(
        place.path("names.json"),
        format!("[\"{}\", {{\"satellite\": \"{}\"}}]", names[0], names[1]),
    )
    .unwrap();
    let table = sat3d::table::Table::new(vec![
        sat3d::table::Column::text("city", "City", ["Seattle", "Seattle"]),
        sat3d::table::Column::dictionary(
            "satellite",
            "File name",
            vec![names[2].clone()],
            [Some(0_u32), Some(0)],
        ),
    ])
    .unwrap();
    table.write_parquet(&place.path("manifest.parquet")).unwrap();
    let done = |list: &str, extra: &[&str], code: i32| {
        let out = format!("out-{list}");
        let extra = [&["--dsm-size", "8", "--json"], extra].concat();
        let output = run(&mut place.infer(list, &out, &extra), code);
        let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
        (summary["done"].as_u64().unwrap(), summary["failed"].as_u64().unwrap())
    };
    let seattle = place.path("Seattle");
    assert_eq!(done("names.txt", &[], 0), (2, 0));
    assert_eq!(done("manifest.csv", &[], 1), (1, 1));
    assert_eq!(done("names.json", &["--root", seattle.to_str().unwrap()], 0), (2, 0));
    assert_eq!(done("manifest.parquet", &[], 0), (1, 0));
}

#[test]
fn without_any_weights_the_model_inside_the_program_serves() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    let mut bare = sat3d();
    bare.args(["infer", "--dsm-size", "32", "--panorama", "--out"]).arg(place.path("out"));
    let text = stderr(&run(bare.arg(place.path("Seattle")), 0));
    for part in ["built-in model `mini`", "sat3d model fetch", "indicative"] {
        assert!(text.contains(part), "`{text}` does not say `{part}`");
    }
    assert!(place.path("out").join(format!("{stem}.npz")).is_file());
    // Asked for by name, it is the same one.
    let mut named = sat3d();
    named.args(["infer", "--dsm-size", "32", "--weights", "built-in:mini", "--out"]);
    run(named.arg(place.path("named")).arg(place.path("Seattle")), 0);
    let bytes = |out: &str| fs::read(place.path(out).join(format!("{stem}.npz"))).unwrap();
    assert!(bytes("out") == bytes("named"));
    let run_json = fs::read_to_string(place.path("named/run.json")).unwrap();
    assert!(run_json.contains("built-in:mini"), "{run_json}");
}

#[test]
fn a_saved_scene_renders_the_same_without_the_network() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    run(&mut place.infer("Seattle", "out", &["--scene", "--dsm-size", "40"]), 0);
    let again = |out: &str, extra: &[&str]| {
        let mut command = sat3d();
        command.env_remove("SAT3D_WEIGHTS").args(["-q", "infer", "--out"]).arg(place.path(out));
        command.arg(place.path("out").join(format!("{stem}.scene.safetensors"))).args(extra);
        command.args(["--dsm-size", "40"]);
        run(&mut command, 0);
        fs::read(place.path(out).join(format!("{stem}.npz"))).unwrap()
    };
    let first = fs::read(place.path("out").join(format!("{stem}.npz"))).unwrap();
    assert!(again("again", &[]) == first);
    assert!(again("stable", &["--sampling", "stable"]) != first);
    run(&mut place.infer("Seattle", "few", &["--scene", "--no-dsm", "--samples", "16,16"]), 0);
    let mut command = sat3d();
    command.args(["-q", "infer", "--dsm-size", "8", "--out"]).arg(place.path("more"));
    run(command.arg(place.path("few").join(format!("{stem}.scene.safetensors"))), 0);
    let flags = row(&place.path("more"), &stem)["flags"].clone();
    assert!(flags.contains("--samples 16,16"), "{flags}");
    let row = row(&place.path("again"), &stem);
    assert_eq!((row["ground_from"].as_str(), row["width_px"].as_str()), ("place", "640"));
    // A folder of scenes is an input too, with another scale.
    let mut command = sat3d();
    command.args([
        "-q",
        "infer",
        "--no-dsm",
        "--geotiff",
        "--vertical-scale",
        "isotropic",
        "--out",
    ]);
    fs::create_dir(place.path("scenes")).unwrap();
    let name = format!("{stem}.scene.safetensors");
    fs::copy(place.path("out").join(&name), place.path("scenes").join(&name)).unwrap();
    run(command.arg(place.path("tif")).arg(place.path("scenes")), 0);
    assert!(place.path("tif").join(format!("{stem}.tif")).exists());
    assert!(!place.path("tif").join(format!("{stem}.npz")).exists());
}

#[test]
fn explain_shows_each_step_and_writes_nothing() {
    let place = Place::new();
    place.city(1);
    let output = run(&mut place.infer("Seattle", "out", &["--explain"]), 0);
    let text = stdout(&output);
    for line in ["network", "precision", "fold", "rays", "vertical-scale", "npz"] {
        assert!(
            text.lines().any(|l| l.trim_start().starts_with(line) && l.contains("  on ")),
            "{line}\n{text}"
        );
    }
    for line in ["colour", "sky", "super-resolution", "geotiff", "scene"] {
        assert!(
            text.lines().any(|l| l.trim_start().starts_with(line) && l.contains("  off ")),
            "{line}\n{text}"
        );
    }
    assert!(text.contains("0.019*"), "{text}");
    assert!(text.contains("1 image of this run"), "{text}");
    assert!(!place.path("out").exists());
    let output = run(
        &mut place.infer("Seattle", "out", &["--explain", "--json", "--sampling", "stable"]),
        0,
    );
    let plan: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(plan["command"], "infer");
    assert_eq!(plan["parameters"]["render"]["sampling"], "stable");
    let steps = plan["steps"].as_array().unwrap();
    let step = |id: &str| steps.iter().find(|step| step["id"] == id).unwrap();
    assert_eq!(step("rays")["bound"]["vertical_m"], STABLE_RMS * 32.24);
    assert_eq!(step("sky")["on"], false);
    assert!(step("depth")["form"].as_str().unwrap().starts_with("normalised"));
}

#[test]
fn what_cannot_work_is_said_before_any_work() {
    let place = Place::new();
    let stem = place.city(1).remove(0);
    let says = |command: &mut Command, text: &str| {
        let output = run(command, 2);
        assert!(stderr(&output).contains(text), "{text}\n{}", stderr(&output));
    };
    says(&mut place.infer("missing", "out", &[]), "missing");
    says(&mut place.infer("missing.png", "out", &[]), "missing.png");
    fs::create_dir(place.path("empty")).unwrap();
    says(&mut place.infer("empty", "out", &[]), "no image in it");
    says(&mut place.infer("", "out", &[]), "VIGOR root");
    says(&mut place.infer("Seattle", "out", &["--no-dsm"]), "leaves nothing to make");
    says(&mut place.infer("Seattle", "out", &["--samples", "4,48"]), "8 to 512");
    says(&mut place.infer("Seattle", "out", &["--gsd", "-1"]), "not metres per pixel");
    says(&mut place.infer("Seattle", "out", &["--device", "abacus"]), "cpu, cuda");
    says(&mut place.infer("Seattle", "out", &["--device", "cuda"]), "--features cuda");
    let mut wrong = sat3d();
    wrong.args(["infer", "--weights"]).arg(place.path("Seattle")).arg(place.path("Seattle"));
    says(&mut wrong, "no config.json");
    // Two pictures of one name.
    fs::create_dir(place.path("twice")).unwrap();
    picture(8, 8, 0).save(place.path("twice/a.png")).unwrap();
    picture(8, 8, 0).save(place.path("twice/a.jpg")).unwrap();
    says(&mut place.infer("twice", "out", &[]), "would both give a.npz");
    // A folder of another subcommand's results.
    let out = place.path("bench/.sat3d");
    fs::create_dir_all(&out).unwrap();
    let header =
        r#"{"header":{"plan_hash":"x","benchmark":{"plan":{"command":"dsm-bench build"}}}}"#;
    fs::write(out.join("journal.1-of-1.jsonl"), format!("{header}\n")).unwrap();
    says(
        &mut place.infer("Seattle", "bench", &["--overwrite"]),
        "results of `sat3d dsm-bench build`",
    );
    assert!(!place.path("out").exists(), "nothing was begun");
    // A truncated checkpoint.
    let broken = place.path("broken");
    fs::create_dir(&broken).unwrap();
    for name in ["config.json", "diffusion_pytorch_model.safetensors"] {
        let bytes = fs::read(weights().join(name)).unwrap();
        let length = if name == "config.json" { bytes.len() } else { bytes.len() / 2 };
        fs::write(broken.join(name), &bytes[..length]).unwrap();
    }
    let mut cut = sat3d();
    cut.args(["infer", "--weights"]).arg(&broken).arg(place.path("Seattle"));
    says(&mut cut, "not a whole safetensors file");
    drop(stem);
}
