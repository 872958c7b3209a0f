//! What `--explain` lists is what runs: complete, stable, and short.
//!
//! Every place in the code that carries a step out says so (`sat3d::plan::runs`); the program prints what was said
//! with `--log sat3d::plan=trace`. A run may say nothing that its plan does not have on, and must say all of that.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{run, sat3d, stderr, stdout, tiny_weights};
use sat3d::plan::Plan;
use serde_json::Value;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// More than this nobody reads.
const MOST_STEPS: usize = 26;

/// Two images of a small city, its lidar, a benchmark of it, and predictions made from that.
struct City {
    _folder: tempfile::TempDir,
    root: PathBuf,
}

/// A small scene; `more` is appended.
fn scene(folder: &Path, name: &str, more: &str) -> PathBuf {
    let path = folder.join(format!("{name}.toml"));
    let extent = "[extent]\nwidth_metres = 110.0\nheight_metres = 110.0\n";
    let images = "[images]\nmaximum = 1\nsize_pixels = 64\n";
    fs::write(&path, format!("name = \"{name}\"\nseed = 7\n{extent}{images}{more}")).unwrap();
    path
}

/// Everything that a scene can call for.
const ALL_EFFECTS: &str = "colours = \"palette\"\nsensor_noise_levels = 1.0\nyear = 2025\nseason = \"summer\"
[terrain]\nrelief_metres = 20.0\nwavelength_metres = 80.0\nslope_percent = 10.0
[sun]\nazimuth_degrees = 200.0\nelevation_degrees = 6.0
[view]\noff_nadir_degrees = 20.0\nazimuth_degrees = 110.0
[lidar]\nnoise_sigma_metres = 0.02\nmissing_pulse_share = 0.01\ncrown_penetration_share = 0.1\ngap_count = 1
gap_width_metres = 3.0\nsampling = \"area\"\nyear = 2021\nseason = \"winter\"
[change]\nbuilt_share_per_year = 0.05
[camera]\nhaze = 0.1
[picture]\npixel_metres = 2.0\n";

impl City {
    fn get() -> &'static Self {
        static CITY: OnceLock<City> = OnceLock::new();
        CITY.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().to_owned();
            let city = Self { _folder: folder, root };
            let text = "name = \"city\"\nseed = 7\n[extent]\nwidth_metres = 130.0\nheight_metres = 130.0\n[images]\nmaximum = 2\n";
            let path = city.path("city.toml");
            fs::write(&path, text).unwrap();
            run(city.sat3d(&["simulate", "city.toml", "--out", "city"]).arg("-q"), 0);
            run(&mut city.build("dsm", "--dtm city/lidar_dtm --max-nan 100"), 0);
            let made = ["eval", "baseline", "blurred", "--gt", "dsm", "--out"];
            run(city.sat3d(&made).arg("half"), 0);
            run(city.sat3d(&made).args(["same", "--size", "640"]), 0);
            city
        })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    fn sat3d(&self, arguments: &[&str]) -> Command {
        let mut command = sat3d();
        command.current_dir(&self.root).args(arguments);
        command
    }

    fn build(&self, out: &str, more: &str) -> Command {
        let mut command = self.sat3d(&["dsm-bench", "build", "-q", "--lidar", "city/lidar"]);
        command.args(["--vigor", "city/vigor/Seattle", "--out", out]).args(words(more));
        command
    }

    fn eval(&self, more: &str) -> Command {
        let mut command = self.sat3d(&["eval", "-q", "--gt", "dsm", "--threads", "1"]);
        command.args(words(more));
        command
    }

    /// The network on the image of the parity tests.
    fn infer(&self, out: &str, more: &str) -> Command {
        let image = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png");
        let input = self.path("image").join(image.file_name().unwrap());
        if !input.is_file() {
            fs::create_dir_all(self.path("image")).unwrap();
            fs::copy(image, input).unwrap();
        }
        let mut command = self.sat3d(&["infer", "-q", "image", "--out", out, "--threads", "2"]);
        command.args(["--engine", "burn", "--precision", "fp32", "--weights"]).arg(weights());
        command.args(words(more));
        command
    }

    fn tile(&self, picture: &str, out: &str, more: &str) -> Command {
        let mut command = self.sat3d(&["tile", "-q", picture, "--out", out, "--threads", "2"]);
        command.args(["--engine", "burn", "--precision", "fp32", "--weights"]).arg(weights());
        command.args(words(more));
        command
    }

    /// A picture with pixels of the network's size, and one with other pixels and some that are transparent.
    fn pictures(&self) {
        static MADE: OnceLock<()> = OnceLock::new();
        MADE.get_or_init(|| {
            let pixel = |x: u32, y: u32| [(x / 3) as u8, (y / 4) as u8, ((x + 2 * y) / 9) as u8];
            let plain = image::RgbImage::from_fn(256, 256, |x, y| image::Rgb(pixel(x, y)));
            plain.save(self.path("plain.png")).unwrap();
            let masked = image::RgbaImage::from_fn(300, 400, |x, y| {
                let [r, g, b] = pixel(x, y);
                image::Rgba([r, g, b, if x < 40 && y < 60 { 0 } else { 255 }])
            });
            masked.save(self.path("masked.png")).unwrap();
        });
    }
}

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("plans-weights"))
}

fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split_whitespace()
}

fn again(command: &Command, more: &[&str]) -> Command {
    let mut other = sat3d();
    other.args(command.get_args()).args(more);
    if let Some(folder) = command.get_current_dir() {
        other.current_dir(folder);
    }
    other
}

/// The plan of a call, as `--explain --json` prints it.
fn plan(command: &Command) -> Plan {
    let output = run(&mut again(command, &["--explain", "--json"]), 0);
    serde_json::from_str(&stdout(&output)).unwrap()
}

/// Steps that a call said it carried out.
fn carried_out(command: &Command) -> BTreeSet<String> {
    let output = run(again(command, &[]).env("SAT3D_LOG", "sat3d::plan=trace"), 0);
    let text = stderr(&output);
    text.lines()
        .filter_map(|line| line.split_once("[sat3d::plan] step "))
        .map(|(_, id)| id.trim().to_owned())
        .collect()
}

/// Runs a call and holds it to its plan. Returns the ids that are on.
#[track_caller]
fn complete(command: &Command) -> BTreeSet<String> {
    let plan = plan(command);
    assert!(plan.steps.len() <= MOST_STEPS, "{} steps of {command:?}", plan.steps.len());
    // A stated accuracy is a property of definitions and not done.
    let on: BTreeSet<String> = plan
        .steps
        .iter()
        .filter(|step| step.on && step.id != Plan::OPERATION)
        .map(|step| step.id.clone())
        .collect();
    let ran = carried_out(command);
    assert_eq!(ran, on, "left: what ran; right: what the plan has on; {command:?}");
    on
}

/// Every step of a command is on in one of some calls, so that none is listed in vain.
#[track_caller]
fn covered(commands: &[Command], never: &[&str]) {
    let mut on = BTreeSet::new();
    for command in commands {
        on.extend(complete(command));
    }
    for step in plan(&commands[0]).steps {
        let known = never.contains(&step.id.as_str()) || step.id == Plan::OPERATION;
        assert!(known || on.contains(&step.id), "no call has `{}` on", step.id);
    }
}

#[test]
fn a_benchmark_build_does_what_its_plan_has_on_and_nothing_else() {
    let city = City::get();
    let every = "--dtm city/lidar_dtm --source-tile --quantise 0.01 --geotiff --preview --stac --max-nan 100";
    covered(
        &[
            city.build("plain", "--max-nan 100"),
            city.build("every", every),
            city.build("coarse", "--tolerance 5 --coverage mosaic --max-nan 100"),
        ],
        &[],
    );
}

#[test]
fn an_evaluation_does_what_its_plan_has_on_and_nothing_else() {
    let city = City::get();
    let mask = r#"{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"kind":"all"},"geometry":
        {"type":"Polygon","coordinates":[[[-123,47],[-122,47],[-122,48],[-123,48],[-123,47]]]}}]}"#;
    fs::write(city.path("mask.geojson"), mask).unwrap();
    let every = "--pred half --pred same --protocol all --errors errors --csv images.csv --report report.html
        --against paper --mask mask.geojson --mask-class kind --metres-per-unit 64.48";
    // One prediction in units of the cube.
    let scaled = city.path("scaled");
    fs::create_dir_all(&scaled).unwrap();
    for item in fs::read_dir(city.path("half")).unwrap().map(Result::unwrap) {
        let metres = common::npz(&item.path(), "dsm");
        let units: Vec<f32> = metres.iter().map(|height| height / 1000.0).collect();
        let shape = [256, 256];
        let data = sat3d::raster::npz::NpyData::F32(&units);
        let array = sat3d::raster::npz::NpyArray { name: "arr_0", shape: &shape, data };
        let bytes = sat3d::raster::npz::encode(&[array], sat3d::raster::npz::Compression::Fast);
        fs::write(scaled.join(item.file_name()), bytes).unwrap();
    }
    covered(
        &[
            city.eval("--pred half"),
            city.eval(every),
            city.eval("--pred scaled --protocol vertical"),
            city.eval("--pred same --protocol plain --registration 0 --replicates 0"),
        ],
        &[],
    );
}

#[test]
fn an_evaluation_resizes_and_aligns_only_where_it_is_called_for() {
    let city = City::get();
    let on = |more: &str| {
        let plan = plan(&city.eval(more));
        move |id: &str| plan.step(id).unwrap().on
    };
    let (half, same) = (on("--pred half"), on("--pred same --protocol plain"));
    assert!(half("resize") && half("shift") && half("rotation") && half("vertical-offset"));
    assert!(!same("resize") && !same("shift") && !same("rotation") && !same("vertical-offset"));
    let coregister = on("--pred half --protocol coregister");
    assert!(coregister("coregistration") && !coregister("shift") && coregister("vertical-offset"));
}

#[test]
fn an_inference_does_what_its_plan_has_on_and_nothing_else() {
    let city = City::get();
    fs::write(city.path("path.csv"), "pixel_x,pixel_y\n300,300\n320,300\n").unwrap();
    covered(
        &[
            city.infer("heights", "--dsm-size 64"),
            city.infer(
                "outputs",
                "--dsm-size 32 --geotiff --scene --mesh ply --density npy --grid-size 32 --satellite --panorama
                 --perspective --size 64x64 --height 3 --position px:320,320 --with depth",
            ),
        ],
        &["cameras", "trajectory"],
    );
    // A scene needs no network.
    let mut again =
        city.sat3d(&["infer", "-q", "outputs/satellite_47.6_-122.33.scene.safetensors"]);
    again.args(["--out", "again", "--dsm-size", "32", "--threads", "2"]);
    let on = complete(&again);
    assert!(!on.contains("network") && on.contains("rays"), "{on:?}");
}

#[test]
fn a_tiling_does_what_its_plan_has_on_and_nothing_else() {
    let city = City::get();
    city.pictures();
    covered(
        &[
            city.tile("plain.png", "whole", "--gsd 0.25 --window-gsd 0.25 --dsm d.tif"),
            city.tile(
                "masked.png",
                "pieces",
                "--gsd 0.2 --window-gsd 0.25 --stride 64 --trim 16 --dsm d.tif --mesh m.ply --error 1 --density d.zarr
                 --tiles3d tiles --isovalue 26",
            ),
        ],
        // Needs a picture with a place.
        &["warp"],
    );
}

#[test]
fn a_simulation_does_what_its_plan_has_on_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = |name: &str, more: &str, extra: &[&str]| {
        let mut command = sat3d();
        command.args(["-q", "simulate"]).arg(scene(folder.path(), name, more));
        command.arg("--out").arg(folder.path().join(name)).args(extra);
        command
    };
    let sun = "[sun]\nazimuth_degrees = 180.0\nelevation_degrees = 60.0\n";
    covered(
        &[
            simulate("every", ALL_EFFECTS, &[]),
            simulate("plain", "", &[]),
            // Without a cause, forced where there is something to calculate with.
            simulate("forced", sun, &["--force", "curvature", "--force", "terrain-shadows"]),
            simulate(
                "nothing",
                "",
                &["--force", "shadows", "--force", "relief", "--force", "noise"],
            ),
            simulate("without", ALL_EFFECTS, &["--without", "datum", "--without", "shadows"]),
        ],
        &[],
    );
}

/// A text without what differs from folder to folder and machine to machine.
fn settled(text: &str, root: &Path) -> String {
    text.replace(&*root.to_string_lossy(), "<folder>")
}

/// Keys and types of a JSON value; of a list, those of its first item.
fn shape(value: &Value) -> Value {
    match value {
        Value::Null => "null".into(),
        Value::Bool(_) => "boolean".into(),
        Value::Number(_) => "number".into(),
        Value::String(_) => "string".into(),
        Value::Array(items) => items.first().map(shape).into_iter().collect(),
        Value::Object(map) => map
            .iter()
            .map(|(key, value)| (key.clone(), shape(value)))
            .collect::<serde_json::Map<_, _>>()
            .into(),
    }
}

#[track_caller]
fn stable(name: &str, command: &Command, root: &Path) {
    let text = stdout(&run(&mut again(command, &["--explain"]), 0));
    insta::assert_snapshot!(name, settled(&text, root));
}

#[test]
fn the_plan_of_a_benchmark_build_is_stable() {
    let city = City::get();
    stable("explain_dsm_bench_build", &city.build("x", ""), &city.root);
    let every = "--dtm city/lidar_dtm --source-tile --quantise 0.01 --geotiff --preview --stac --coverage mosaic
        --resampling cubic --tolerance 5";
    stable("explain_dsm_bench_build_every", &city.build("x", every), &city.root);
    stable("explain_dsm_bench_build_reference", &city.build("x", "--grid reference"), &city.root);
}

#[test]
fn the_plan_of_an_evaluation_is_stable() {
    let city = City::get();
    stable("explain_eval", &city.eval("--pred half"), &city.root);
    let every = "--pred half --pred same --protocol all --resize area --errors e --csv c.csv --report r.html --against paper";
    stable("explain_eval_every", &city.eval(every), &city.root);
    let plain = "--pred same --protocol plain --registration 0 --replicates 0";
    stable("explain_eval_plain", &city.eval(plain), &city.root);
}

#[test]
fn the_plan_of_an_inference_is_stable() {
    let city = City::get();
    stable("explain_infer", &city.infer("x", ""), &city.root);
    let every = "--geotiff --scene --mesh glb --density zarr --satellite --panorama --perspective --with depth
        --sampling stable --vertical-scale isotropic";
    stable("explain_infer_every", &city.infer("x", every), &city.root);
    stable("explain_infer_street", &city.infer("x", "--no-dsm --panorama --height 3"), &city.root);
}

#[test]
fn the_plan_of_a_tiling_is_stable() {
    let city = City::get();
    city.pictures();
    stable(
        "explain_tile",
        &city.tile("plain.png", "x", "--gsd 0.25 --window-gsd 0.25"),
        &city.root,
    );
    let every = "--gsd 0.2 --window-gsd 0.25 --stride 64 --trim 16 --blend hann --dsm d.tif --preview --mesh m.glb
        --error 0.5 --density d.zarr --tiles3d tiles --lattice pixels";
    stable("explain_tile_every", &city.tile("masked.png", "x", every), &city.root);
}

#[test]
fn the_plans_of_simulations_are_stable() {
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/scenes");
    for name in ["flat_noon", "hilly_waterfront", "towers_off_nadir"] {
        let mut command = sat3d();
        command.args(["simulate", "-q"]).arg(scenes.join(format!("{name}.toml")));
        stable(&format!("explain_simulate_{name}"), &command, &scenes);
    }
    let mut command = sat3d();
    command.args(["simulate", "-q"]).arg(scenes.join("towers_off_nadir.toml"));
    command.args(["--tolerance", "0.1", "--force", "terrain-shadows", "--without", "relief"]);
    stable("explain_simulate_overruled", &command, &scenes);
}

#[test]
fn the_plan_of_a_tradeoff_is_stable() {
    let mut command = sat3d();
    command.args(["tradeoff", "-q"]);
    stable("explain_tradeoff", &command, Path::new("/nowhere"));
    command.args(["--quick", "--stage", "eval,tile"]);
    stable("explain_tradeoff_quick", &command, Path::new("/nowhere"));
}

#[cfg(feature = "train")]
#[test]
fn the_plan_of_a_training_is_stable() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("train.toml");
    fs::write(&config, crate::train_support::SHORT).unwrap();
    let train = |changes: &[&str]| {
        let mut command = sat3d();
        command.args(["train", "-q"]).arg(&config).arg("--out").arg(folder.path().join("out"));
        command.args(changes.iter().flat_map(|change| ["--set", change]));
        command
    };
    stable("explain_train", &train(&[]), folder.path());
    let other = ["data.held_out=0", "objective.heights.slope=0", "run.minutes=5"];
    stable("explain_train_other", &train(&other), folder.path());
    let plan = plan(&train(&[]));
    assert!(plan.steps.len() <= MOST_STEPS, "{} steps", plan.steps.len());
}

#[test]
fn plans_as_json_have_one_shape_for_all_commands() {
    let city = City::get();
    city.pictures();
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/scenes");
    let mut simulate = city.sat3d(&["simulate", "-q"]);
    simulate.arg(scenes.join("flat_noon.toml"));
    let commands = [
        city.build("x", ""),
        city.eval("--pred half"),
        city.infer("x", ""),
        city.tile("plain.png", "x", "--gsd 0.25"),
        city.sat3d(&["tradeoff", "-q"]),
        simulate,
    ];
    let mut parameters = serde_json::Map::new();
    let mut common = BTreeSet::new();
    for command in commands {
        let output = run(&mut again(&command, &["--explain", "--json"]), 0);
        let plan: Value = serde_json::from_str(&stdout(&output)).unwrap();
        let mut form = shape(&plan);
        let own = form.as_object_mut().unwrap().insert("parameters".to_owned(), "object".into());
        let keys: Vec<String> = own.unwrap().as_object().unwrap().keys().cloned().collect();
        parameters.insert(plan["command"].as_str().unwrap().to_owned(), keys.into());
        common.insert(serde_json::to_string_pretty(&form).unwrap());
    }
    assert_eq!(common.len(), 1, "{common:?}");
    insta::assert_snapshot!("explain_json_shape", common.first().unwrap());
    insta::assert_snapshot!(
        "explain_json_parameters",
        serde_json::to_string_pretty(&parameters).unwrap()
    );
}
