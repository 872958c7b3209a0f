//! Meshes, volumes and views of `sat3d infer` as a user asks for them, with a small network of made-up weights.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{npz, run, sat3d, stderr, stdout, tiny_weights};
use serde_json::Value;
use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

const STEM: &str = "satellite_47.6_-122.33";

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("infer-outputs-weights"))
}

/// A folder with one image at a place, and the runs on it.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("crates/sat3d-model/fixtures/inputs")
            .join(format!("{STEM}.png"));
        fs::copy(fixture, folder.path().join(format!("{STEM}.png"))).unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, input: &str, out: &str, extra: &[&str]) -> Command {
        let mut command = sat3d();
        command.args(["-q", "infer"]).arg(self.path(input)).arg("--out").arg(self.path(out));
        command.args(extra);
        command
    }

    fn infer(&self, out: &str, extra: &[&str]) -> Command {
        let mut command = self.command(&format!("{STEM}.png"), out, extra);
        command.arg("--weights").arg(weights());
        command
    }

    fn bytes(&self, out: &str, end: &str) -> Vec<u8> {
        fs::read(self.path(out).join(format!("{STEM}{end}"))).unwrap()
    }

    fn picture(&self, out: &str, end: &str) -> image::RgbImage {
        image::load_from_memory(&self.bytes(out, end)).unwrap().into_rgb8()
    }
}

fn plan(place: &Place, extra: &[&str]) -> Value {
    let output = run(place.infer("none", extra).args(["--explain", "--json"]), 0);
    serde_json::from_str(&stdout(&output)).unwrap()
}

fn step<'a>(plan: &'a Value, id: &str) -> &'a Value {
    let steps = plan["steps"].as_array().unwrap();
    steps.iter().find(|step| step["id"] == id).unwrap_or_else(|| panic!("no step {id}"))
}

/// The JSON part of a binary glTF.
fn gltf(bytes: &[u8]) -> Value {
    assert_eq!(&bytes[..4], b"glTF");
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).unwrap()
}

/// The one row of a manifest.
fn row(out: &Path) -> HashMap<String, String> {
    common::row(out, STEM)
}

#[test]
fn meshes_are_metres_above_the_dsms_zero() {
    let place = Place::new();
    let small = ["--grid-size", "48", "--no-dsm"];
    run(place.infer("glb", &["--mesh", "glb"]).args(small), 0);
    let json = gltf(&place.bytes("glb", ".glb"));
    let position = json["accessors"]
        .as_array()
        .unwrap()
        .iter()
        .find(|accessor| accessor["type"] == "VEC3" && accessor.get("min").is_some())
        .unwrap();
    // y is up in glTF: from the bottom of the cube to the published 64.48 m; x and z within the crop.
    let corner = |end: &str| [0, 1, 2].map(|k| position[end][k].as_f64().unwrap());
    let (low, high) = (corner("min"), corner("max"));
    assert!(
        low[1] >= 0.0 && low[1] < 1.0 && high[1] > 20.0 && high[1] <= 64.48,
        "{low:?} {high:?}"
    );
    let half =
        640.0 * 156_543.033_928_04 * libm::cos(47.6_f64.to_radians()) / f64::from(1 << 20) / 2.0;
    for axis in [0, 2] {
        assert!(
            (low[axis] + half).abs() < 1.0 && (high[axis] - half).abs() < 1.0,
            "{low:?} {high:?}"
        );
    }
    let text = json.to_string();
    assert!(text.contains("-122.33") && text.contains("47.6"), "the georeference is in the extras");

    run(place.infer("iso", &["--mesh", "glb", "--vertical-scale", "isotropic"]).args(small), 0);
    let json = gltf(&place.bytes("iso", ".glb"));
    let position = &json["accessors"].as_array().unwrap().iter().find(|a| a.get("max").is_some());
    let taller = position.unwrap()["max"][1].as_f64().unwrap();
    let ratio = 2.0 * half / 0.8 / 64.48;
    assert!((taller / high[1] - ratio).abs() < 1e-4, "{taller} {}", high[1]);

    run(place.infer("obj", &["--mesh", "house.obj", "--mesh-color", "texture"]).args(small), 0);
    let folder = place.path("obj");
    for name in ["house.obj", "house.mtl", "house.png"] {
        assert!(folder.join(name).is_file(), "{name}");
    }
    run(
        place
            .infer("ply", &["--mesh", "ply", "--lattice", "reference", "--frame", "reference"])
            .args(small),
        0,
    );
    let ply = place.bytes("ply", ".ply");
    assert!(ply.starts_with(b"ply\nformat binary_little_endian 1.0\n"));
    let header = String::from_utf8_lossy(&ply[..600]).into_owned();
    assert!(header.contains("property uchar red"), "{header}");
}

#[test]
fn a_density_volume_has_the_dsms_place_and_zero() {
    let place = Place::new();
    run(&mut place.infer("npy", &["--no-dsm", "--density", "npy", "--grid-size", "32"]), 0);
    let bytes = place.bytes("npy", "_density.npy");
    let header = String::from_utf8_lossy(&bytes[..128]).into_owned();
    assert!(header.contains("(32, 32, 40)") && header.contains("<f4"), "{header}");
    let coordinates = place.path("npy").join(format!("{STEM}_density_coordinates.npz"));
    let z = npz(&coordinates, "z");
    assert_eq!(z.len(), 40);
    let step = 64.48 / 40.0;
    assert!(
        (z[0] - step / 2.0).abs() < 1e-5 && (z[39] - (64.48 - step / 2.0)).abs() < 1e-5,
        "{z:?}"
    );
    let x = npz(&coordinates, "x");
    assert!(x[0] < -13_617_000.0 && x[31] > x[0], "Web Mercator eastings: {x:?}");

    run(&mut place.infer("zarr", &["--no-dsm", "--density", "zarr", "--grid-size", "32"]), 0);
    let volume = place.path("zarr").join(format!("{STEM}_density.zarr"));
    let group: Value =
        serde_json::from_slice(&fs::read(volume.join("zarr.json")).unwrap()).unwrap();
    assert_eq!(group["zarr_format"], 3);
    // A second run keeps it; without one of its files it is made again.
    let summary = |_: ()| {
        let output = run(
            place
                .infer("zarr", &["--no-dsm", "--density", "zarr", "--grid-size", "32"])
                .arg("--json"),
            0,
        );
        serde_json::from_str::<Value>(&stdout(&output)).unwrap()
    };
    assert_eq!(summary(())["kept"], 1);
    fs::remove_file(volume.join("density/zarr.json")).unwrap();
    assert_eq!(
        (summary(())["kept"].clone(), volume.join("density/zarr.json").is_file()),
        (0.into(), true)
    );
}

#[test]
fn views_are_pictures_in_a_named_light() {
    let place = Place::new();
    let views = [
        "--no-dsm",
        "--satellite",
        "--panorama",
        "--perspective",
        "--yaw",
        "35",
        "--pitch",
        "10",
        "--position",
        "px:240,400",
        "--with",
        "depth",
        "--scene",
    ];
    run(&mut place.infer("out", &views), 0);
    assert_eq!(place.picture("out", "_satellite.png").dimensions(), (256, 256));
    assert_eq!(place.picture("out", "_panorama.png").dimensions(), (512, 128));
    assert_eq!(place.picture("out", "_perspective.png").dimensions(), (256, 256));
    assert!(place.path("out").join(format!("{STEM}_perspective_depth.npz")).is_file());
    let predictions: Value =
        serde_json::from_slice(&fs::read(place.path("out/predictions.json")).unwrap()).unwrap();
    let light = &predictions["plan"]["parameters"]["illumination"];
    assert!(light["origin"].as_str().unwrap().contains("clear"), "{light}");
    let written = row(&place.path("out"));
    assert!(written["light"].contains("clear"), "{}", written["light"]);
    assert_eq!(written["file"], "", "no heights were asked for, and a view's depth is none");
    let mut files: Vec<&str> = written["files"].split(';').collect();
    files.sort_unstable();
    let ends = [
        ".scene.safetensors",
        "_panorama.png",
        "_panorama_depth.npz",
        "_panorama_depth.png",
        "_perspective.png",
        "_perspective_depth.npz",
        "_perspective_depth.png",
        "_satellite.png",
        "_satellite_depth.npz",
        "_satellite_depth.png",
    ];
    assert_eq!(files, ends.map(|end| format!("{STEM}{end}")));

    run(place.infer("white", &views).args(["--illumination", "white"]), 0);
    let same = |end: &str| place.bytes("out", end) == place.bytes("white", end);
    assert!(same("_satellite.png"), "no light from the sky falls on the view from above");
    assert!(!same("_panorama.png") && !same("_perspective.png"));
    assert_eq!(row(&place.path("white"))["light"], "bundled sky white");
    // A scene keeps the light that it was saved with, and says which that is.
    let white = format!("white/{STEM}.scene.safetensors");
    run(&mut place.command(&white, "kept", &["--no-dsm", "--panorama"]), 0);
    assert_eq!(row(&place.path("kept"))["light"], "bundled sky white");
    let clear = ["--no-dsm", "--panorama", "--illumination", "clear"];
    run(place.command(&white, "relit", &clear).arg("--weights").arg(weights()), 0);
    assert_eq!(row(&place.path("relit"))["light"], "bundled sky clear");

    // The stored scene has its sky: with the weights for the super-resolution it gives the same pictures,
    // without them those of the rays.
    let scene = format!("out/{STEM}.scene.safetensors");
    let street = ["--no-dsm", "--panorama", "--position", "px:240,400"];
    let mut again = place.command(&scene, "again", &street);
    run(again.arg("--weights").arg(weights()), 0);
    assert!(place.bytes("again", "_panorama.png") == place.bytes("out", "_panorama.png"));
    let output = run(&mut place.command(&scene, "rays", &street), 0);
    assert_eq!(place.picture("rays", "_panorama.png").dimensions(), (256, 64));
    assert!(stderr(&output).is_empty(), "-q is quiet: {}", stderr(&output));
}

#[test]
fn a_path_is_filmed() {
    let place = Place::new();
    fs::write(
        place.path("path.csv"),
        "w,h,angle\n300,320,0\n320,320,0\n340,318,-0.1\n360,316,-0.1\n",
    )
    .unwrap();
    let path = place.path("path.csv");
    let film = [
        "--no-dsm",
        "--follow",
        "--every",
        "2",
        "--size",
        "32x32",
        "--trajectory",
        path.to_str().unwrap(),
    ];
    run(&mut place.infer("out", &film), 0);
    let folder = place.path("out").join(format!("{STEM}_trajectory"));
    for name in ["0001.png", "0002.png"] {
        assert_eq!(image::open(folder.join(name)).unwrap().into_rgb8().dimensions(), (32, 32));
    }
    assert!(!folder.join("0003.png").exists());
    let gif = place.bytes("out", "_trajectory.gif");
    assert!(gif.starts_with(b"GIF89a"));
    let row = fs::read_to_string(place.path("out/manifest.csv")).unwrap();
    assert!(row.contains("done"), "{row}");
    let output = run(place.infer("out", &film).arg("--json"), 0);
    let summary: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(summary["kept"], 1, "frames in their folder count as what was written");
    // Made anew with fewer frames, with the leftover of a killed run beside them.
    fs::write(folder.join(".0001.png.abcdef.part"), "half").unwrap();
    fs::write(folder.join("notes.txt"), "somebody's own").unwrap();
    let fewer = film.map(|word| if word == "2" { "4" } else { word });
    run(&mut place.infer("out", &fewer), 2);
    run(place.infer("out", &fewer).arg("--overwrite"), 0);
    let mut left: Vec<_> =
        fs::read_dir(&folder).unwrap().map(|item| item.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["0001.png", "notes.txt"], "the second frame and the leftover are gone");
}

#[test]
fn only_what_outputs_need_is_planned() {
    let place = Place::new();
    let on = |plan: &Value, id: &str| step(plan, id)["on"].as_bool().unwrap();
    let heights = plan(&place, &[]);
    for id in ["colour", "sky", "super-resolution", "mesh", "density"] {
        assert!(!on(&heights, id), "{id}");
    }
    let street = plan(&place, &["--panorama"]);
    for id in ["colour", "sky", "super-resolution"] {
        assert!(on(&street, id), "{id}");
    }
    assert!(step(&street, "sky")["form"].as_str().unwrap().contains("clear"));
    let above = plan(&place, &["--satellite"]);
    assert!(on(&above, "colour") && !on(&above, "sky") && !on(&above, "super-resolution"));
    let mesh = plan(&place, &["--mesh", "glb", "--mesh-color", "texture"]);
    assert!(on(&mesh, "mesh") && !on(&mesh, "colour"), "a texture needs no colours of the field");
    assert!(!place.path("none").exists(), "a plan writes nothing");
}

#[test]
fn mistakes_are_said_before_any_work() {
    let place = Place::new();
    fs::copy(place.path(&format!("{STEM}.png")), place.path("other.png")).unwrap();
    let folder = |extra: &[&str]| {
        let mut command = place.command(".", "out", extra);
        command.arg("--weights").arg(weights());
        command
    };
    for (extra, says) in [
        (&["--mesh", "a.glb"][..], "the name of one mesh, and there are 2 images"),
        (&["--mesh", "x/a.glb"], "without folders"),
        (&["--yaw", "3"], "--perspective"),
        (&["--panorama", "--illumination", "dusk"], "overcast"),
        (&["--grid-size", "64"], "--mesh and --density"),
        (&["--panorama", "--sky-mask", "m.png"], "--illumination"),
    ] {
        let output = run(&mut folder(extra), 2);
        assert!(stderr(&output).contains(says), "{extra:?}: {}", stderr(&output));
    }
    // Nothing is written over an input, nor where the next run would take it for one.
    fs::rename(place.path("other.png"), place.path(&format!("{STEM}_satellite.png"))).unwrap();
    for extra in [&["--satellite"][..], &["--panorama"], &["--geotiff"]] {
        let mut command = place.command(".", ".", extra);
        let output = run(command.arg("--weights").arg(weights()), 2);
        assert!(stderr(&output).contains("another --out"), "{}", stderr(&output));
    }
    // A place outside the image fails that image alone, with the place.
    let output = run(&mut folder(&["--no-dsm", "--perspective", "--position", "px:900,10"]), 1);
    assert!(stderr(&output).contains("900"), "{}", stderr(&output));
    // Without weights it is the model of the program, which a folder of another model's work does not take.
    let output = run(&mut place.command(&format!("{STEM}.png"), "out", &[]), 2);
    let text = stderr(&output);
    assert!(text.contains("another plan") && text.contains("Sat3DMini"), "{text}");
}

#[cfg(feature = "onednn")]
#[test]
fn the_network_is_calculated_as_asked_or_as_well_as_the_machine_can() {
    use sat3d::model::network::{Engine, Execution, Precision};
    let place = Place::new();
    let form = |extra: &[&str], set: &[(&str, &str)]| {
        let mut arguments = vec!["--explain", "--json"];
        arguments.extend(extra);
        let mut command = place.infer("out", &arguments);
        let plan: Value =
            serde_json::from_str(&stdout(&run(command.envs(set.iter().copied()), 0))).unwrap();
        let steps = plan["steps"].as_array().unwrap().clone();
        let step = steps.into_iter().find(|step| step["id"] == "precision").unwrap();
        let network = plan["parameters"]["network"].clone();
        assert_eq!(step["form"], network);
        (network.as_str().unwrap().to_owned(), step["bound"]["vertical_m"].as_f64().unwrap())
    };
    let burn = ("fp32 by burn on cpu".to_owned(), 0.0);
    assert_eq!(form(&["--engine", "burn"], &[]), burn);
    // A machine without the library calculates all the same, unless it is asked for what only the library can.
    let without = [("SAT3D_ONEDNN", "/none/libdnnl.so.2")];
    assert_eq!(form(&[], &without), burn);
    assert_eq!(form(&["--precision", "fp32"], &without), burn);
    let refused = |extra: &[&str], set: &[(&str, &str)], parts: &[&str]| {
        let mut command = place.infer("out", extra);
        let output = run(command.envs(set.iter().copied()), 2);
        let error = stderr(&output);
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        assert!(!place.path("out").exists());
    };
    refused(&["--engine", "onednn"], &without, &["/none/libdnnl.so.2", "apt-get install"]);
    refused(&["--precision", "bf16"], &without, &["bf16 by onednn on cpu", "/none/libdnnl.so.2"]);
    refused(&["--engine", "burn", "--precision", "bf16"], &[], &["oneDNN serves the others"]);
    refused(&["--precision", "fp64"], &[], &["fp64", "fp32, fp32-winograd, bf16"]);
    refused(&["--engine", "mkl"], &[], &["mkl", "burn, onednn"]);
    refused(&["--tolerance", "-1"], &[], &["--tolerance", "0 or more"]);

    let there = Execution { engine: Engine::OneDnn, ..Execution::default() };
    if let Some(why) = there.refusal() {
        println!("SKIPPED: {why}");
        return;
    }
    assert_eq!(form(&["--tolerance", "0"], &[]), ("fp32 by onednn on cpu".to_owned(), 0.0));
    // A processor with less.
    let less = [("DNNL_MAX_CPU_ISA", "AVX2")];
    assert_eq!(form(&[], &less).0, "fp32 by onednn on cpu");
    refused(&["--precision", "fp32-winograd"], &less, &["DNNL_MAX_CPU_ISA", "Avx512"]);
    // All of them see the same heights, each within its bound.
    let heights = |out: &str, extra: &[&str], set: &[(&str, &str)]| {
        let mut command = place.infer(out, extra);
        run(command.envs(set.iter().copied()), 0);
        npz(&place.path(out).join(format!("{STEM}.npz")), "arr_0")
    };
    let wanted = heights("burn", &["--engine", "burn"], &[]);
    let p95 = |found: &[f32]| {
        let mut apart: Vec<f32> =
            found.iter().zip(&wanted).map(|(a, b)| (a - b).abs() * 64.48).collect();
        apart.sort_unstable_by(f32::total_cmp);
        apart[apart.len() * 95 / 100]
    };
    assert!(p95(&heights("avx2", &[], &less)) < 0.005);
    assert!(p95(&heights("exact", &["--precision", "fp32"], &[])) < 0.005);
    for precision in [Precision::Fp32Winograd, Precision::Bf16] {
        let execution = Execution { precision, ..there };
        if let Some(why) = execution.refusal() {
            println!("SKIPPED: {why}");
            continue;
        }
        let name = precision.name();
        let off = p95(&heights(name, &["--precision", name], &[]));
        assert!(f64::from(off) <= precision.bound().p95_m, "{name}: {off}");
    }
}
