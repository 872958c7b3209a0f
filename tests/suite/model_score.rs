//! `sat3d model score`, `export` and `compare`, with the built binary and the model inside it.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{run, sat3d, stderr, stdout};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;

fn model(arguments: &[&str], folder: &Path) -> Command {
    let mut command = sat3d();
    for variable in ["SAT3D_WEIGHTS", "HF_HOME", "HUGGINGFACE_HUB_CACHE"] {
        command.env_remove(variable);
    }
    command.env("HF_HUB_CACHE", "/no/such/cache").current_dir(folder);
    command.arg("model").args(arguments);
    command
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn weights_in_half_of_the_bytes_score_as_the_whole_ones_and_are_compared() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let exported = ["export", "--weights", "built-in:mini", "--out", "copy"];
    run(&mut model(&exported, folder.path()), 0);
    let wide = fs::metadata(at("copy/diffusion_pytorch_model.safetensors")).unwrap().len();
    run(&mut model(&["export", "--weights", "copy", "--out", "half", "--half"], folder.path()), 0);
    let half = fs::read(at("half/diffusion_pytorch_model.safetensors")).unwrap();
    assert!((half.len() as f64) < 0.52 * wide as f64, "{} of {wide}", half.len());
    // The model inside the program is in half precision itself: nothing was rounded on the way.
    assert_eq!(half, sat3d::model::weights::MINI.weights);
    // The mean of a model and itself is itself.
    let mean = ["export", "--weights", "copy", "--weights", "half", "--out", "mean", "--half"];
    let text = stdout(&run(&mut model(&mean, folder.path()), 0));
    assert!(text.contains("mean of 2 checkpoints"), "{text}");
    assert_eq!(half, fs::read(at("mean/diffusion_pytorch_model.safetensors")).unwrap());

    let score = |weights: &str, out: &str| {
        let few = ["--seeds", "1,2", "--scenes", "1", "--out", out];
        stdout(&run(model(&["score", "--weights", weights], folder.path()).args(few), 0))
    };
    let text = score("copy", "scores/copy.json");
    for part in ["flat", "buildings", "mesh", "floaters"] {
        assert!(text.contains(part), "{part} in\n{text}");
    }
    score("half", "scores/half.json");
    let (copy, same) = (json(&at("scores/copy.json")), json(&at("scores/half.json")));
    assert_eq!(copy["report"]["all"]["images"], 2);
    assert_eq!(copy["report"]["all"]["scores"], same["report"]["all"]["scores"]);
    // A report of the same weights is left alone, one of others is not.
    let keep = ["score", "--weights", "half", "--seeds", "1,2", "--scenes", "1", "--keep"];
    let before = fs::metadata(at("scores/half.json")).unwrap().modified().unwrap();
    run(model(&keep, folder.path()).args(["--out", "scores/half.json"]), 0);
    assert_eq!(fs::metadata(at("scores/half.json")).unwrap().modified().unwrap(), before);

    let compare = ["compare", "scores/copy.json", "scores/half.json", "--out", "table.md"];
    let table = stdout(&run(&mut model(&compare, folder.path()), 0));
    assert_eq!(fs::read_to_string(at("table.md")).unwrap().trim(), table.trim());
    assert!(table.contains("| copy") && table.contains("| half"), "{table}");
}

#[test]
fn what_cannot_be_scored_exported_or_compared_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |arguments: &[&str]| stderr(&run(&mut model(arguments, folder.path()), 2));
    let text = refused(&["score", "--weights", "no/such/folder"]);
    assert!(text.contains("no/such/folder"), "{text}");
    let text = refused(&["score", "--weights", "built-in:mini", "--scenes", "0"]);
    assert!(text.contains("--scenes") || text.contains("scenes"), "{text}");
    let text = refused(&["compare", "no.json", "neither.json"]);
    assert!(text.contains("no.json"), "{text}");
    fs::write(folder.path().join("bad.json"), "{}").unwrap();
    let text = refused(&["compare", "bad.json"]);
    assert!(text.contains("bad.json"), "{text}");
    fs::create_dir(folder.path().join("mine")).unwrap();
    fs::write(folder.path().join("mine/README.md"), "notes").unwrap();
    let text = refused(&["export", "--weights", "built-in:mini", "--out", "mine"]);
    assert!(text.contains("mine"), "{text}");
    assert_eq!(fs::read(folder.path().join("mine/README.md")).unwrap(), b"notes");
    let tiny = common::tiny_weights("no-mean");
    let tiny = tiny.to_str().unwrap();
    let mean = ["export", "--weights", "built-in:mini", "--weights", tiny, "--out", "mean"];
    let text = refused(&mean);
    assert!(text.contains("built-in:mini") && text.contains(tiny), "{text}");
    assert!(!folder.path().join("mean").exists());
}

#[test]
fn the_gates_of_the_small_model_are_printed_with_what_they_ask_for() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["score", "--weights", "built-in:mini", "--scenes", "1", "--seeds", "1"];
    let text = stdout(&run(&mut model(&arguments, folder.path()), 0));
    assert!(text.matches("pass").count() + text.matches("FAIL").count() >= 5, "{text}");
}
