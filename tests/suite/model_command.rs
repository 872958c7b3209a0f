//! `sat3d model inspect` and `verify`, and where weights are looked for, with the built binary.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::model::weights::WEIGHTS_FILE;
use sat3d::model::weights::rule::{tiny_overrides, write_checkpoint};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

const CONFIG: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/crates/sat3d-model/fixtures/tiny/model/config.json");

/// `sat3d model` with nothing of the developer's own settings, and an empty cache.
fn model(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sat3d"));
    for variable in ["SAT3D_LOG", "SAT3D_WEIGHTS", "HF_HOME", "HUGGINGFACE_HUB_CACHE"] {
        command.env_remove(variable);
    }
    command.env("HF_HUB_CACHE", "/no/such/cache").env("NO_COLOR", "1").arg("model").args(arguments);
    command
}

/// Standard output of a call that must end with `code`, and its standard error.
fn ran(command: &mut Command, code: i32) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert_eq!(status.code(), Some(code), "{stdout}\n{stderr}");
    (stdout, stderr)
}

fn inspect(folder: &Path, code: i32) -> (String, String) {
    ran(&mut model(&["inspect", folder.to_str().unwrap()]), code)
}

fn config() -> String {
    fs::read_to_string(CONFIG).unwrap()
}

fn written(folder: &Path) {
    write_checkpoint(folder, &config(), tiny_overrides()).unwrap();
}

fn tiny() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path());
    folder
}

#[test]
fn a_checkpoint_is_described() {
    let folder = tiny();
    let (text, stderr) = inspect(folder.path(), 0);
    assert_eq!(stderr, "");
    for part in [
        "class             Sat3DGen\n",
        "found             named on the command line\n",
        "backbone          tiny: 3 layers of 64 channels, 2 heads, patches of 16 px, 4 registers\n",
        "padding           2 tokens on each side; the image covers 0.8 of the cube's sides\n",
        "representation    oneplane, 8 channels, 320 x 320\n",
        "density           mipnerf\n",
        "samples           48 coarse and 48 fine along a ray\n",
        "super-resolution  2 x, 16 channels, border reflect\n",
        "unet_model.dino_model       58       199,872         799,488  F32       e81426ad61d6c8ee\n",
        "sr_module                   11         8,320          33,280  F32       8adab1126479fc8f\n",
        "total                      317     1,168,563       4,674,252\n",
        "buffers           point_representer.oneplane_axes\n",
        "absent            none\n",
        "left over         unet_model.dino_model.embeddings.mask_token\n",
    ] {
        assert!(text.contains(part), "{part} in\n{text}");
    }
    let (text, _) = ran(&mut model(&["inspect", folder.path().to_str().unwrap(), "--json"]), 0);
    let json: Value = serde_json::from_str(&text).unwrap();
    let bytes = fs::read(folder.path().join(WEIGHTS_FILE)).unwrap();
    assert_eq!(json["inspection"]["bytes"], bytes.len());
    assert_eq!(json["config"]["super_resolution"], 2);
    assert_eq!(json["weights"]["origin"]["from"], "argument");
    // The file's hash is the one that any other program computes.
    use sha2::Digest as _;
    let hash: String = sha2::Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(json["inspection"]["sha256"], hash);
}

#[test]
fn everything_that_is_wrong_with_a_checkpoint_is_in_one_error() {
    let folder = tiny();
    let (path, weights) = (folder.path(), folder.path().join(WEIGHTS_FILE));
    let whole = fs::read(&weights).unwrap();
    for length in [0, 4, 1000, whole.len() / 2, whole.len() - 1] {
        fs::write(&weights, &whole[..length]).unwrap();
        let (stdout, stderr) = inspect(path, 2);
        assert_eq!(stdout, "");
        assert!(stderr.contains("not a whole safetensors file: cut off"), "{stderr}");
        assert!(stderr.contains(&format!("{length} bytes")), "{stderr}");
    }
    // Another class and two switches that are not served, beside the truncated file.
    let changed = config()
        .replace("\"Sat3DGen\"", "\"UNet2DModel\"")
        .replace("\"no_cls_token\": true", "\"no_cls_token\": false")
        .replace("\"density_clamp_mode\": \"mipnerf\"", "\"density_clamp_mode\": \"softplus\"");
    fs::write(path.join("config.json"), changed).unwrap();
    let (_, stderr) = inspect(path, 2);
    for part in
        ["4 problems:", "UNet2DModel", "no_cls_token", "density_clamp_mode", "4. ", "cut off"]
    {
        assert!(stderr.contains(part), "{part} in {stderr}");
    }
    // Another class alone.
    fs::write(&weights, &whole).unwrap();
    fs::write(path.join("config.json"), config().replace("\"Sat3DGen\"", "\"UNet2DModel\""))
        .unwrap();
    let (_, stderr) = inspect(path, 2);
    assert!(
        stderr.contains("`_class_name` is \"UNet2DModel\": not a Sat3DGen checkpoint"),
        "{stderr}"
    );
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    // A config of other sizes than the tensors.
    fs::write(path.join("config.json"), config().replace("\"dim\": 8", "\"dim\": 16")).unwrap();
    let (_, stderr) = inspect(path, 2);
    assert!(stderr.contains("mlp.net0.weight: expected [32, 32], found [32, 16]"), "{stderr}");
    assert!(stderr.contains("3 of another shape"), "{stderr}");
    // A deeper network than the file's: what is missing is listed by name.
    let deeper = config().replace("\"num_hidden_layers\": 3", "\"num_hidden_layers\": 4");
    fs::write(path.join("config.json"), deeper).unwrap();
    let (_, stderr) = inspect(path, 2);
    assert!(stderr.contains("missing: unet_model.dino_model.layer.3.norm1.weight"), "{stderr}");
    let shallower = config().replace("\"num_hidden_layers\": 3", "\"num_hidden_layers\": 2");
    fs::write(path.join("config.json"), shallower).unwrap();
    let (_, stderr) = inspect(path, 2);
    assert!(stderr.contains("extra: unet_model.dino_model.layer.2."), "{stderr}");
}

#[test]
fn folders_without_a_checkpoint_say_what_is_wanted() {
    let folder = tempfile::tempdir().unwrap();
    let (_, stderr) = inspect(folder.path(), 2);
    for part in ["--weights", "no checkpoint here", "config.json", WEIGHTS_FILE] {
        assert!(stderr.contains(part), "{part} in {stderr}");
    }
    let (_, stderr) = inspect(&folder.path().join("nowhere"), 2);
    assert!(stderr.contains("there is no such folder"), "{stderr}");
    fs::write(folder.path().join("config.json"), config()).unwrap();
    let (_, stderr) = inspect(folder.path(), 2);
    assert!(stderr.contains(&format!("has no {WEIGHTS_FILE}")), "{stderr}");
}

#[test]
fn training_checkpoints_are_found_averaged_weights_first() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    written(&at("run/checkpoint-90000/vqmodel"));
    let (text, _) = inspect(&at("run"), 0);
    assert!(text.contains("checkpoint-90000/vqmodel\n"), "{text}");
    written(&at("run/checkpoint-90000/vqmodel_ema"));
    let (text, _) = inspect(&at("run/checkpoint-90000"), 0);
    assert!(text.contains("checkpoint-90000/vqmodel_ema\n"), "{text}");
    written(&at("run/checkpoint-80000/vqmodel_ema"));
    let (_, stderr) = inspect(&at("run"), 2);
    assert!(stderr.contains("2 checkpoints here; name one of:"), "{stderr}");
    assert!(stderr.contains("checkpoint-80000/vqmodel_ema\n"), "{stderr}");
}

#[test]
fn the_argument_the_variable_and_the_cache_are_asked_in_this_order() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let commit = "0123456789abcdef0123456789abcdef01234567";
    let repository = at("hub/models--qian43--Sat3DGen");
    fs::create_dir_all(repository.join("refs")).unwrap();
    fs::write(repository.join("refs/main"), commit).unwrap();
    for folder in [at("a"), at("b"), repository.join("snapshots").join(commit)] {
        written(&folder);
    }
    let origin = |arguments: &[&str], variable: Option<&Path>| {
        let mut command = model(&["inspect", "--json"]);
        command.args(arguments).env("HF_HUB_CACHE", at("hub"));
        command.envs(variable.map(|folder| ("SAT3D_WEIGHTS", folder)));
        let json: Value = serde_json::from_str(&ran(&mut command, 0).0).unwrap();
        json["weights"]["origin"].clone()
    };
    let (a, b) = (at("a"), at("b"));
    assert_eq!(origin(&[a.to_str().unwrap()], Some(&b))["from"], "argument");
    assert_eq!(origin(&[], Some(&b))["from"], "environment");
    let cache = origin(&[], None);
    assert_eq!(cache["from"], "cache");
    assert_eq!(cache["repository"], "qian43/Sat3DGen");
    assert_eq!(cache["revision"], commit);
    // A variable that names nothing is an error, although the cache has weights.
    let mut command = model(&["inspect"]);
    command.env("HF_HUB_CACHE", at("hub")).env("SAT3D_WEIGHTS", root.path().join("empty"));
    let (_, stderr) = ran(&mut command, 2);
    assert!(stderr.contains("SAT3D_WEIGHTS") && stderr.contains("no such folder"), "{stderr}");
    // Nothing anywhere: the model inside the program.
    let built_in = origin(&[], None);
    assert_eq!(built_in["from"], "cache", "the cache still counts first");
    let (text, _) = ran(&mut model(&["inspect"]), 0);
    for part in ["built-in:mini", "Sat3DMini", "sat3d model fetch"] {
        assert!(text.contains(part), "{part} in {text}");
    }
}

#[cfg(not(feature = "fetch"))]
#[test]
fn a_build_without_fetch_says_so() {
    let (_, stderr) = ran(&mut model(&["fetch", "--accept-license"]), 2);
    assert!(stderr.contains("built without `fetch`"), "{stderr}");
    assert!(stderr.contains("--features fetch") && stderr.contains("SAT3D_WEIGHTS"), "{stderr}");
}

#[test]
fn every_stage_equals_the_reference() {
    let (text, stderr) = ran(&mut model(&["verify"]), 0);
    assert_eq!(stderr, "");
    assert!(text.starts_with("set            stage"), "{text}");
    assert!(text.contains("\ntiny ") && text.contains("\ntiny_triplane "), "{text}");
    assert!(!text.contains("FAIL"), "{text}");
    let (json, _) = ran(&mut model(&["verify", "--json"]), 0);
    let json: Value = serde_json::from_str(&json).unwrap();
    let list = json["comparisons"].as_array().unwrap();
    assert_eq!(json["passed"], true);
    assert!(text.contains(&format!("all {} comparisons pass: fp32 by ", list.len())), "{text}");
    // Each comparison compared something.
    assert!(list.iter().all(|made| made["relative_l2"].is_number() && made["passes"] == true));
    let (_, stderr) = ran(&mut model(&["verify", "--goldens", "/no/such/folder"]), 2);
    assert!(stderr.contains("/no/such/folder"), "{stderr}");
    let (_, stderr) = ran(&mut model(&["verify", "--device", "abacus"]), 2);
    assert!(stderr.contains("abacus"), "{stderr}");
}
