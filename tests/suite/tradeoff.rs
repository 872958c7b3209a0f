//! `sat3d tradeoff` as a user drives it. Nothing here looks at times: only at errors, which do not depend on the
//! machine, and at the files.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common::{run, sat3d, stderr, stdout};
use serde_json::Value;
use std::collections::HashMap;
use std::fs;
use std::path::Path;

/// A quick run of some stages; what it printed.
fn quick(stages: &str, out: &Path) -> Value {
    let mut command = sat3d();
    command.args(["-q", "tradeoff", "--quick", "--rounds", "3", "--json", "--stage", stages]);
    serde_json::from_str(&stdout(&run(command.arg("--out").arg(out), 0))).unwrap()
}

/// The settings of a switch by name.
fn settings<'a>(report: &'a Value, switch: &str) -> HashMap<&'a str, &'a Value> {
    let switches = report["switches"].as_array().unwrap();
    let found = switches.iter().find(|s| s["switch"] == switch).unwrap_or_else(|| {
        panic!("no {switch} in {report:#}");
    });
    let settings = found["settings"].as_array().unwrap();
    settings.iter().map(|s| (s["name"].as_str().unwrap(), s)).collect()
}

fn error(settings: &HashMap<&str, &Value>, name: &str) -> f64 {
    settings.get(name).and_then(|s| s["error"].as_f64()).unwrap_or_else(|| {
        panic!("no {name} in {settings:?}");
    })
}

#[test]
fn a_build_is_measured_against_its_truth_and_keeps_its_bounds() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("new/folder");
    let report = quick("build", &out);

    let transform = settings(&report, "transform");
    assert_eq!(error(&transform, "exact"), 0.0);
    let errors =
        ["chebyshev", "separable", "affine", "reference grid"].map(|n| error(&transform, n));
    assert!(errors.is_sorted(), "{errors:?}");
    assert!(errors[0] < 1e-8, "PAPER: within 5e-9 m");
    assert!((1e-5..2e-3).contains(&errors[2]), "PAPER: affine to 0.17 mm; {errors:?}");
    assert!((1.0..3.0).contains(&errors[3]), "PAPER: 2.1 m at worst; {errors:?}");

    let kernels = settings(&report, "resampling");
    assert!(error(&kernels, "bilinear") < error(&kernels, "nearest"));
    let coarse = settings(&report, "resampling-coarse");
    assert!(error(&coarse, "average") < error(&coarse, "nearest"));

    let coverage = settings(&report, "coverage");
    assert_eq!(error(&coverage, "mosaic"), 0.0);
    assert!(error(&coverage, "best-tile") > 1.0, "four tiles meet in the middle");

    for setting in settings(&report, "quantise").into_values().chain(transform.into_values()) {
        if let Some(bound) = setting["bound"].as_f64() {
            let error = setting["error"].as_f64().unwrap();
            assert!(error <= bound, "{error} beyond {bound}: {setting}");
        }
    }
    let sizes = settings(&report, "compression");
    assert!(error(&sizes, "small") < error(&sizes, "fast"));
    assert!(error(&sizes, "fast") < 0.9 * error(&sizes, "stored"));
    assert!(sizes.values().all(|s| s["also"][0]["value"] == 0.0), "lossless: {sizes:?}");

    let file: Value =
        serde_json::from_slice(&fs::read(out.join("tradeoff.json")).unwrap()).unwrap();
    assert_eq!(file, report);
    let lines = fs::read_to_string(out.join("tradeoff.csv")).unwrap();
    let count: usize = report["switches"]
        .as_array()
        .unwrap()
        .iter()
        .map(|s| s["settings"].as_array().unwrap().len())
        .sum();
    assert_eq!(lines.lines().count(), count + 1);
    let page = fs::read_to_string(out.join("tradeoff.html")).unwrap();
    assert_eq!(page.matches("<svg").count(), 6);
    assert!(!page.contains("http://") || page.matches("http://").count() == 6, "only namespaces");
}

#[test]
fn an_evaluation_is_measured_against_what_was_put_into_its_pairs() {
    let place = tempfile::tempdir().unwrap();
    let report = quick("eval", place.path());
    let protocol = settings(&report, "protocol");
    let shift = |name: &str| protocol[name]["also"][0]["value"].as_f64().unwrap();
    // One of the three pairs shows little but level ground.
    assert!(shift("coregister") < 0.5, "a shift of (3.4, -2.2) px is found: {protocol:?}");
    assert!(shift("coregister") < shift("paper") && shift("paper") < shift("plain"));
    let all = libm::hypot(3.4, 2.2);
    assert!((shift("plain") - all).abs() < 1e-9, "what was put in");
    // Interpolation across walls leaves more than the noise.
    assert!(error(&protocol, "coregister") < 0.5 * error(&protocol, "vertical"));
    assert!(error(&protocol, "vertical") < error(&protocol, "plain"));
    let offset = settings(&report, "offset");
    assert!(error(&offset, "ransac") < error(&offset, "mean"));
    assert!((error(&offset, "mean") - 0.15 * 8.0).abs() < 0.1, "the gross errors' mean");
    let resize = settings(&report, "resize");
    assert!(error(&resize, "area") < error(&resize, "reference"));
    let bootstrap = settings(&report, "bootstrap");
    assert!(error(&bootstrap, "2000") < error(&bootstrap, "100"));
    for (switch, default) in [
        ("protocol", "paper"),
        ("offset", "ransac"),
        ("resize", "reference"),
        ("bootstrap", "2000"),
    ] {
        assert_eq!(settings(&report, switch)[default]["default"], true, "{switch}");
    }
}

#[test]
fn rays_converge_to_the_slow_march() {
    let place = tempfile::tempdir().unwrap();
    let report = quick("infer", place.path());
    let samples = settings(&report, "samples");
    for name in ["reference", "stable"] {
        let at = |n: usize| error(&samples, &format!("{name} {n} + {n}"));
        assert!(at(128) < at(32) && at(32) < at(8), "{samples:?}");
    }
    assert!(error(&samples, "stable 128 + 128") < 0.01, "metres");
    assert_eq!(samples["reference 48 + 48"]["default"], true);
    let stop = settings(&report, "early-stop");
    assert!((error(&stop, "below 1e-6") - error(&stop, "never")).abs() < 1e-4);
    let size = settings(&report, "dsm-size");
    assert!(error(&size, "256 px") < error(&size, "64 px"));
    let plan = report["plan"]["steps"].as_array().unwrap();
    let precision = plan.iter().find(|step| step["id"] == "infer/precision").unwrap();
    assert_eq!(precision["on"], false, "there is no time for it");
}

#[test]
fn explaining_measures_and_writes_nothing() {
    let place = tempfile::tempdir().unwrap();
    let mut command = sat3d();
    command.args(["tradeoff", "--explain", "--quick", "--stage", "tile"]).current_dir(&place);
    let text = stdout(&run(&mut command, 0));
    assert!(text.contains("tile/stride") && text.contains("--quick has no time"), "{text}");
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0);
}

#[test]
fn bad_usage_is_named_before_any_work() {
    let place = tempfile::tempdir().unwrap();
    let mut command = sat3d();
    let output = run(command.args(["tradeoff", "--stage", "build,cook"]), 2);
    assert!(stderr(&output).contains("no stage; there are build, eval, infer, tile"));
    let file = place.path().join("file");
    fs::write(&file, "").unwrap();
    let mut command = sat3d();
    let output = run(command.args(["tradeoff", "--quick", "--out"]).arg(file.join("below")), 2);
    assert!(stderr(&output).contains("cannot make the folder"), "{}", stderr(&output));
    let mut command = sat3d();
    let output = run(
        command
            .args(["tradeoff", "--quick", "--stage", "tile", "--weights", "nowhere", "--out"])
            .arg(place.path()),
        2,
    );
    assert!(stderr(&output).contains("nowhere"), "{}", stderr(&output));
}
