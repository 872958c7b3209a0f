//! `infer`: what is asked for beside an output changes no byte of it, the network's weights that no
//! output needs are not read, and heights keep the bounds of `rays`, `precision` and `storage`.

use super::Share;
use super::ledger::Ledger;
use crate::common::{npz, run, sat3d, stdout, tiny_weights};
use sat3d::footprint::{Footprint, VerticalScale};
use sat3d::model::field::closed_form::BoxCity;
use sat3d::model::field::{DensityActivation, Field};
use sat3d::model::network::{Precision, Wanted};
use sat3d::model::render::{
    DepthKind, Lattice, RenderOptions, SampleCounts, Sampling, density_grid,
};
use sat3d::model::scene::SceneParts;
use sat3d::model::{Checkpoint, Image8, Model, Scene};
use sat3d::plan::{Plan, Step};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The test of each step of the plan.
pub const LEDGER: Ledger = &[
    ("decode", &[what_is_asked_for_beside_it_changes_no_output]),
    ("ground-size", &[scales_change_no_height_of_the_cube]),
    ("resize", &[what_is_asked_for_beside_it_changes_no_output]),
    ("network", &[a_precision_errs_within_its_bound_and_the_tolerance]),
    ("precision", &[a_precision_errs_within_its_bound_and_the_tolerance]),
    ("fold", &[a_folded_field_is_the_field]),
    ("colour", BESIDE),
    ("sky", BESIDE),
    ("super-resolution", BESIDE),
    ("rays", &[rays_err_within_the_bound_of_their_rule]),
    ("depth", &[rays_err_within_the_bound_of_their_rule]),
    ("vertical-scale", &[scales_change_no_height_of_the_cube]),
    ("storage", &[a_stored_height_is_within_its_bound]),
    ("npz", BESIDE),
    (
        "geotiff",
        &[what_is_asked_for_beside_it_changes_no_output, a_stored_height_is_within_its_bound],
    ),
    ("scene", BESIDE),
    ("mesh", BESIDE),
    ("density", BESIDE),
    ("satellite-view", BESIDE),
    ("panorama", BESIDE),
    ("perspective", BESIDE),
    ("cameras", BESIDE),
    ("trajectory", BESIDE),
    ("animation", BESIDE),
    ("surface-probe", BESIDE),
    ("view-depth", BESIDE),
];

/// An output that is asked for, or a part of the network that only it needs: its bound is zero.
const BESIDE: &[fn()] =
    &[what_is_asked_for_beside_it_changes_no_output, weights_that_no_output_needs_are_not_read];

const STEM: &str = "satellite_47.6_-122.33";

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("bounds-infer-weights"))
}

fn picture() -> image::RgbImage {
    image::RgbImage::from_fn(256, 256, |x, y| {
        let block = (x / 23 + 3 * (y / 31)) % 7;
        image::Rgb([(x + 20 * block) as u8, (y / 2 + 31 * block) as u8, ((x + 2 * y) / 5) as u8])
    })
}

/// A folder with one image of a named place, a path and a camera.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        image::imageops::resize(&picture(), 640, 640, image::imageops::FilterType::Nearest)
            .save(place.path(&format!("{STEM}.png")))
            .unwrap();
        fs::write(place.path("path.csv"), "w,h,angle\n300,320,0\n360,316,-0.1\n").unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn infer(&self, weights: &Path, out: &str, extra: &str) -> Command {
        let mut command = sat3d();
        command.args(["-q", "infer"]).arg(self.path(&format!("{STEM}.png")));
        command.arg("--out").arg(self.path(out)).arg("--weights").arg(weights);
        // No ffmpeg: a film is a GIF, whose bytes are ours.
        command.current_dir(self.0.path()).args(extra.split_whitespace());
        command
    }

    fn plan(&self, extra: &str) -> Plan {
        let mut command = self.infer(weights(), "none", extra);
        let text = stdout(&run(command.args(["--explain", "--json"]), 0));
        serde_json::from_str(&text).unwrap()
    }
}

fn step<'a>(plan: &'a Plan, id: &str) -> &'a Step {
    plan.step(id).unwrap_or_else(|| panic!("{id}"))
}

/// Files of a folder with their bytes, without what describes the run.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    fs::read_dir(folder)
        .unwrap()
        .map(|item| item.unwrap())
        .filter(|item| item.path().is_file())
        .map(|item| {
            (item.file_name().to_string_lossy().into_owned(), fs::read(item.path()).unwrap())
        })
        .filter(|(name, _)| name.starts_with(STEM))
        .collect()
}

const EVERYTHING: &str = "--geotiff --scene --mesh glb --grid-size 24 --density npy --satellite --panorama \
    --perspective --position px:240,400 --size 32x32 --with depth --trajectory path.csv --dsm-size 64";

#[test]
pub fn what_is_asked_for_beside_it_changes_no_output() {
    let place = Place::new();
    run(&mut place.infer(weights(), "all", EVERYTHING), 0);
    let all = files(&place.path("all"));
    for (out, extra) in [
        ("dsm", "--dsm-size 64"),
        ("tif", "--no-dsm --geotiff --dsm-size 64"),
        ("shape", "--no-dsm --mesh glb --density npy --grid-size 24"),
        ("above", "--no-dsm --satellite"),
    ] {
        run(&mut place.infer(weights(), out, extra), 0);
        let alone = files(&place.path(out));
        assert!(!alone.is_empty() && alone.len() < all.len());
        for (name, bytes) in alone {
            assert!(all[&name] == bytes, "{name} of `{extra}`");
        }
    }
}

/// The weights with those of some modules made NaN: whoever reads them spoils the output.
fn poisoned(name: &str, modules: &[&str]) -> PathBuf {
    let folder = tiny_weights(name);
    let file = folder.join("diffusion_pytorch_model.safetensors");
    let mut bytes = fs::read(&file).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let mut spoilt = 0;
    for (key, tensor) in header.as_object().unwrap() {
        if modules.iter().any(|module| key.starts_with(module)) {
            let ends = [0, 1].map(|i| tensor["data_offsets"][i].as_u64().unwrap() as usize);
            bytes[8 + length..][ends[0]..ends[1]].fill(0xFF);
            spoilt += ends[1] - ends[0];
        }
    }
    assert!(spoilt > 1000, "{spoilt} bytes of {modules:?}");
    fs::write(file, bytes).unwrap();
    folder
}

#[test]
pub fn weights_that_no_output_needs_are_not_read() {
    let place = Place::new();
    let street = ["sky_mapping", "sky_decoder", "sr_module"];
    let spoilt = poisoned("bounds-infer-poisoned", &street);
    let plan = place.plan("--dsm-size 64");
    assert!(["colour", "sky", "super-resolution"].iter().all(|id| !step(&plan, id).on));
    run(&mut place.infer(weights(), "sound", "--dsm-size 64"), 0);
    run(&mut place.infer(&spoilt, "spoilt", "--dsm-size 64"), 0);
    assert!(files(&place.path("sound")) == files(&place.path("spoilt")));
    // What needs them meets them.
    let panorama = "--no-dsm --panorama --position px:240,400";
    assert!(step(&place.plan(panorama), "sky").on);
    let output = place.infer(&spoilt, "view", panorama).output().unwrap();
    run(&mut place.infer(weights(), "sound-view", panorama), 0);
    assert!(
        !output.status.success() || files(&place.path("view")) != files(&place.path("sound-view"))
    );
}

/// 95 % quantile of the differences.
fn p95(a: &[f32], b: &[f32]) -> f64 {
    let mut apart: Vec<f64> =
        a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).filter(|d| !d.is_nan()).collect();
    apart.sort_unstable_by(f64::total_cmp);
    apart[apart.len() * 95 / 100]
}

#[test]
pub fn a_precision_errs_within_its_bound_and_the_tolerance() {
    let checkpoint = Checkpoint::open(weights()).unwrap();
    let config = checkpoint.config();
    let image = Image8::new(256, 256, 3, picture().into_raw()).unwrap();
    let mut known: BTreeMap<String, Vec<f32>> = BTreeMap::new();
    let mut heights = |wanted: &Wanted| {
        let execution = wanted.choose(config).unwrap();
        let made = || {
            let model = Model::of_checkpoint(&checkpoint, &execution).unwrap();
            let scene = model.scene(&image, None, 32.24).unwrap();
            scene.dsm(64, &RenderOptions::default()).height
        };
        let height = known.entry(execution.to_string()).or_insert_with(made).clone();
        (execution.precision, height)
    };
    let (_, exact) = heights(&Wanted { tolerance_m: 0.0, ..Wanted::default() });
    let mut share = Share::new("infer, precision");
    for tolerance_m in [1e-3, 4e-3, 5e-3, 0.05, 0.5, 2.0, 2.5, 10.0] {
        let wanted = Wanted { tolerance_m, ..Wanted::default() };
        let (precision, found) = heights(&wanted);
        let bound = precision.bound().p95_m;
        assert!(bound <= tolerance_m, "{precision} at {tolerance_m}");
        let error = p95(&exact, &found) * 64.48;
        if precision == Precision::Fp32 {
            assert_eq!(error, 0.0);
        }
        share.add(error, bound, || format!("{precision} at {tolerance_m} m"));
    }
    share.check();
    // Metres grow with the vertical scale, and with them the bound.
    let place = Place::new();
    for tolerance in ["0.001", "0.005", "0.006", "0.05", "2.6", "10"] {
        for scale in ["paper", "isotropic"] {
            let plan = place.plan(&format!("--tolerance {tolerance} --vertical-scale {scale}"));
            let bound = step(&plan, "precision").bound.vertical_m;
            assert!(bound <= tolerance.parse().unwrap(), "{bound} at {tolerance} {scale}");
        }
    }
}

#[test]
pub fn a_folded_field_is_the_field() {
    let boxes = BoxCity { texels: 64, ..BoxCity::example() };
    let (inputs, head) = boxes.inputs();
    let field = Field::new(&inputs, &head, None).unwrap();
    let lattice = Lattice::pixels(64, 0.8);
    let grid = density_grid(&field, lattice.clone());
    let mut worst: f64 = 0.0;
    let levels = lattice.z.len();
    for (k, found) in grid.values.iter().enumerate() {
        let (column, z) = (k / levels, lattice.z[k % levels]);
        // Level ground: no texel near is a roof's.
        if column / 64 > 3 && column % 64 > 3 || z.abs() > 0.95 {
            continue;
        }
        let depth = f64::from(boxes.steepness) * f64::from(boxes.ground - z);
        let soft = depth.max(0.0) + libm::log1p(libm::exp(-depth.abs()));
        let raw = (f64::from(boxes.gain) * soft + f64::from(boxes.bias)) as f32;
        let truth = f64::from(DensityActivation::Mipnerf.apply(raw));
        // Steps of 32 bits at the features' size, times the gain.
        let rounding = f64::from(boxes.gain * boxes.steepness * 4.0 * f32::EPSILON);
        worst = worst.max((f64::from(*found) - truth).abs() / (rounding + 1e-5 * truth));
    }
    println!("bound: infer, fold: worst share {worst:.3} of the rounding of 32 bits");
    assert!(worst > 0.0 && worst <= 1.0, "{worst}");
}

/// Root of the mean squared error of a rule on a city, cube units: beside ten times as many samples,
/// which stand for the integral.
fn rms(boxes: &BoxCity, sampling: Sampling) -> f64 {
    let (inputs, head) = boxes.inputs();
    let parts = SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 };
    let scene = Scene::new(parts).unwrap();
    let heights = |sampling, samples| {
        let depth = DepthKind::Normalised;
        let options = RenderOptions { sampling, samples, depth, ..RenderOptions::default() };
        scene.dsm(16, &options).height
    };
    let truth = heights(Sampling::Stable, SampleCounts::new(512, 512).unwrap());
    let found = heights(sampling, SampleCounts::default());
    let squares: Vec<f64> = (found.iter().zip(&truth))
        .map(|(a, b)| (2.0 * (f64::from(*a) - f64::from(*b))).powi(2))
        .collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
pub fn rays_err_within_the_bound_of_their_rule() {
    let place = Place::new();
    let cities = [(400.0, 40.0, -4.0), (400.0, 1.0, -9.0), (400.0, 5.0, -6.0), (150.0, 8.0, -6.0)]
        .map(|(steepness, gain, bias)| BoxCity { steepness, gain, bias, ..BoxCity::example() });
    for (rule, flags) in
        [(Sampling::Reference, "--sampling reference"), (Sampling::Stable, "--sampling stable")]
    {
        let mut share = Share::new(&format!("infer, rays, {rule:?}").to_lowercase());
        let errors = cities.each_ref().map(|boxes| rms(boxes, rule));
        for (scale, metres) in [("paper", 32.24), ("isotropic", 40.3)] {
            // The number of samples of the released network, for which the bound is stated.
            let plan = place.plan(&format!("{flags} --vertical-scale {scale}"));
            let bound = step(&plan, "rays").bound.vertical_m;
            for (k, error) in errors.iter().enumerate() {
                share.add(error * metres, bound, || format!("city {k}, {scale}"));
            }
        }
        share.check();
    }
}

#[test]
pub fn scales_change_no_height_of_the_cube() {
    let place = Place::new();
    run(&mut place.infer(weights(), "paper", "--dsm-size 32"), 0);
    run(&mut place.infer(weights(), "iso", "--dsm-size 32 --vertical-scale isotropic"), 0);
    run(&mut place.infer(weights(), "gsd", "--dsm-size 32 --gsd 0.1"), 0);
    let read = |out: &str| npz(&place.path(out).join(format!("{STEM}.npz")), "arr_0");
    assert!(read("paper") == read("iso") && read("paper") == read("gsd"));
    let unit = |scale| Footprint::of_training([640; 2]).vertical_metres_per_unit(scale, 0.8);
    assert_eq!((unit(VerticalScale::Paper), unit(VerticalScale::Isotropic)), (32.24, 40.3));
}

#[test]
pub fn a_stored_height_is_within_its_bound() {
    let place = Place::new();
    run(&mut place.infer(weights(), "out", "--dsm-size 64 --geotiff"), 0);
    let bound = step(&place.plan("--dsm-size 64 --geotiff"), "storage").bound.vertical_m;
    let units = npz(&place.path(&format!("out/{STEM}.npz")), "arr_0");
    let raster = sat3d::lidar::SingleRaster::open(
        &place.path(&format!("out/{STEM}.tif")),
        &sat3d::raster::OpenOptions::default(),
        None,
    )
    .unwrap();
    let mut share = Share::new("infer, storage");
    for (unit, metres) in units.iter().zip(raster.whole().unwrap()) {
        assert!((0.0..=1.0).contains(unit), "{unit}");
        // Half a step of the stored unit (none is above 1), and what the metres add to it.
        let half_step = f64::from(unit - unit.next_down()) / 2.0 * 64.48;
        let error = half_step + (f64::from(metres) - f64::from(*unit) * 64.48).abs();
        share.add(error, bound, || format!("{unit}"));
    }
    share.check();
}

/// Plans with and without a path, over outputs and rules.
pub fn plans() -> Vec<Plan> {
    let place = Place::new();
    ["", EVERYTHING, "--sampling stable --vertical-scale isotropic", "--no-dsm --panorama"]
        .iter()
        .map(|extra| place.plan(extra))
        .collect()
}
