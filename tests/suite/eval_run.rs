//! `sat3d eval` as a user runs it: agreement with the reference implementation, the same bytes for
//! any division of the work, and inputs that are wrong in every way we could think of.

#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{run, sat3d, stderr, stdout};
use sat3d::raster::npz::{self, Compression, NpyArray, NpyData};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn golden_folders() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut folders = vec![root.join("fixtures/eval")];
    let all = std::env::var_os("SAT3D_TEST_GOLDENS")
        .map_or_else(|| root.join("../shared/goldens"), PathBuf::from);
    for name in ["eval", "eval_hard"] {
        let folder = all.join(name);
        if folder.is_dir() {
            folders.push(folder);
        } else {
            eprintln!(
                "SKIPPED goldens/{name}: not at {} (set SAT3D_TEST_GOLDENS)",
                folder.display()
            );
        }
    }
    folders
}

fn json(arguments: &[&str]) -> Value {
    let output = run(sat3d().arg("eval").args(arguments).args(["--json", "-q"]), 0);
    serde_json::from_str(&stdout(&output)).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The two numbers in brackets of a line of the reference's log.
fn logged(log: &str, before: &str) -> Option<Vec<f64>> {
    let rest = log.split(before).nth(1)?;
    let rest = rest.trim_start_matches([':', ' ', '(']);
    let numbers = rest.split([',', ' ', ')', '(']).filter(|part| !part.is_empty());
    Some(numbers.map_while(|part| part.parse().ok()).collect())
}

#[test]
fn the_paper_protocol_agrees_with_the_reference_implementation() {
    let spread = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/eval/offset_spread.json");
    let spread: Value = serde_json::from_slice(&std::fs::read(spread).unwrap()).unwrap();
    for folder in golden_folders() {
        let reference: Value =
            serde_json::from_slice(&std::fs::read(folder.join("reference.json")).unwrap()).unwrap();
        let (pred, gt) = (folder.join("pred"), folder.join("gt"));
        let found = json(&["--pred", text(&pred), "--gt", text(&gt)]);
        let mut compared = 0;
        for image in found["per_image"].as_array().unwrap() {
            let name = image["name"].as_str().unwrap();
            let expected = &reference[name];
            assert!(expected.is_object(), "{name}");
            let log: String =
                expected["log"].as_array().unwrap().iter().map(|l| l.as_str().unwrap()).collect();
            let number = |key: &str| image[key].as_f64().unwrap();
            let shift = (
                image["shift_px"]["x"].as_f64().unwrap(),
                image["shift_px"]["y"].as_f64().unwrap(),
            );
            let flags: Vec<&str> =
                image["flags"].as_array().unwrap().iter().map(|f| f.as_str().unwrap()).collect();
            if log.contains("with correlation -1.0000") {
                // A flat prediction: the reference reports the shift of rounding noise.
                assert!(flags.contains(&"no-texture"), "{name}: {flags:?}");
                assert_eq!((shift, number("rotation_deg")), ((0.0, 0.0), 0.0), "{name}");
                continue;
            }
            compared += 1;
            if let Some(yx) = logged(&log, "Found translation shift (y, x)") {
                assert!((shift.0 - yx[1]).abs() < 1e-9, "{name}: x {} {}", shift.0, yx[1]);
                assert!((shift.1 - yx[0]).abs() < 1e-9, "{name}: y {} {}", shift.1, yx[0]);
                let angle = logged(&log, "Found best rotation angle").unwrap()[0];
                assert!((number("rotation_deg") - angle).abs() < 1e-9, "{name}");
                assert!(flags.is_empty(), "{name}: {flags:?}");
            } else {
                assert!(flags.contains(&"shift-beyond-limit"), "{name}: {flags:?}");
                assert_eq!((shift, number("rotation_deg")), ((0.0, 0.0), 0.0), "{name}");
            }
            let ends: Vec<f64> =
                spread[name].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
            let offset = number("vertical_offset_m");
            // A hundred draws do not reach the ends of what the next may be; some end in single precision.
            let margin = 0.1 * (ends[1] - ends[0]) + 0.001;
            assert!(
                (ends[0] - margin..=ends[1] + margin).contains(&offset),
                "{name}: offset {offset}, the reference's are {ends:?}"
            );
            for (ours, theirs, within) in
                [("mae_m", "mae", 0.01), ("rmse_m", "rmse", 0.01), ("pixels", "valid", 0.0)]
            {
                let (ours, theirs_value) = (number(ours), expected[theirs].as_f64().unwrap());
                assert!(
                    (ours - theirs_value).abs() <= within,
                    "{name}: {theirs} {ours}, the reference has {theirs_value}"
                );
            }
            for (ours, theirs) in [("lt_2_5_m_pct", "lt_2_5"), ("lt_7_5_m_pct", "lt_7_5")] {
                let difference = number(ours) - expected[theirs].as_f64().unwrap();
                assert!(difference.abs() < 0.5, "{name}: {theirs} differs by {difference}");
            }
        }
        assert!(compared > 0, "{}", folder.display());
    }
}

/// A small city block: heights with edges and a slope, `size` pixels a side.
fn city(size: usize, seed: u64) -> Vec<f32> {
    let mut draw = sat3d::random::Draw::new(&[seed]);
    let mut heights: Vec<f32> = (0..size * size).map(|k| 30.0 + 0.02 * (k % size) as f32).collect();
    for _ in 0..25 {
        let (w, h) = (draw.index(size / 4) + 6, draw.index(size / 4) + 6);
        let (x0, y0) = (draw.index(size - w), draw.index(size - h));
        let top = draw.range(4.0, 25.0) as f32;
        for y in y0..y0 + h {
            for height in &mut heights[y * size + x0..y * size + x0 + w] {
                *height = 30.0 + top;
            }
        }
    }
    heights
}

fn write_npz(path: &Path, key: &str, size: usize, values: &[f32]) {
    let shape = [size, size];
    let array = NpyArray { name: key, shape: &shape, data: NpyData::F32(values) };
    std::fs::write(path, npz::encode(&[array], Compression::Fast)).unwrap();
}

fn name(k: usize) -> String {
    // Some 400 m apart: more than one image to a block of 500 m, and enough blocks.
    format!("satellite_47.{:04}_-122.{:04}", 6000 + 36 * (k / 6), 3300 + 54 * (k % 6))
}

/// Ground truths of `count` images and predictions with noise, some of them displaced.
fn benchmark(count: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for part in ["gt", "pred"] {
        std::fs::create_dir(folder.path().join(part)).unwrap();
    }
    for k in 0..count {
        let truth = city(96, k as u64);
        write_npz(&folder.path().join(format!("gt/{}_dsm.npz", name(k))), "dsm", 96, &truth);
        let noisy: Vec<f32> = truth
            .iter()
            .enumerate()
            .map(|(p, v)| {
                let noise = sat3d::random::normal(sat3d::random::key(&[k as u64, p as u64]));
                (v - 20.0 + noise as f32 * (1.0 + k as f32 * 0.1)) / 64.48
            })
            .collect();
        write_npz(&folder.path().join(format!("pred/{}.npz", name(k))), "arr_0", 96, &noisy);
    }
    folder
}

#[test]
fn threads_shards_and_memory_do_not_change_a_byte() {
    let folder = benchmark(40);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let base = ["eval", "--pred", text(&pred), "--gt", text(&gt), "--protocol", "all", "-q"];
    let json = |extra: &[&str]| stdout(&run(sat3d().args(base).args(extra).args(["--json"]), 0));
    let whole = json(&["--threads", "1"]);
    assert_eq!(whole, json(&["--threads", "5"]));
    assert_eq!(whole, json(&["--memory", "0"]), "errors computed again in the second pass");
    assert_ne!(whole, json(&["--seed", "2"]), "the seed decides the draws");
    for count in [2, 3] {
        let parts = folder.path().join(format!("parts{count}"));
        for index in 1..=count {
            let shard = format!("{index}/{count}");
            run(sat3d().args(base).args(["--shard", &shard, "--parts", text(&parts)]), 0);
        }
        let merged = run(sat3d().args(["eval", "merge", text(&parts), "--json", "-q"]), 0);
        assert_eq!(whole, stdout(&merged), "{count} parts");
    }
    let lonely = folder.path().join("parts3/eval-part-2-of-3.json");
    let output = run(sat3d().args(["eval", "merge", text(&lonely)]), 2);
    assert!(stderr(&output).contains("missing parts: 1/3, 3/3"), "{}", stderr(&output));
}

#[test]
fn every_number_of_an_image_is_that_of_its_error_raster() {
    let folder = benchmark(3);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let errors = folder.path().join("errors");
    let found = json(&[
        "--pred",
        text(&pred),
        "--gt",
        text(&gt),
        "--protocol",
        "vertical",
        "--errors",
        text(&errors),
    ]);
    let mut all: Vec<f64> = Vec::new();
    let mut mean_mae = 0.0;
    for image in found["per_image"].as_array().unwrap() {
        let stem = image["name"].as_str().unwrap();
        let read = |path: PathBuf, key: &str| common::npz(&path, key);
        let truth = read(gt.join(format!("{stem}_dsm.npz")), "dsm");
        let prediction = read(pred.join(format!("{stem}.npz")), "arr_0");
        let mut differences: Vec<f64> = prediction
            .iter()
            .zip(&truth)
            .map(|(p, t)| f64::from(*t) - f64::from(p * 64.48_f32))
            .collect();
        let errors_of = |offset: f64| differences.iter().map(move |d| offset - d);
        let sorted = {
            let mut sorted = differences.clone();
            sorted.sort_by(f64::total_cmp);
            sorted
        };
        let n = sorted.len();
        let offset = (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0;
        assert!((image["vertical_offset_m"].as_f64().unwrap() - offset).abs() < 1e-9);
        let mae = errors_of(offset).map(f64::abs).sum::<f64>() / n as f64;
        let rmse = (errors_of(offset).map(|e| e * e).sum::<f64>() / n as f64).sqrt();
        assert!((image["mae_m"].as_f64().unwrap() - mae).abs() < 1e-9);
        assert!((image["rmse_m"].as_f64().unwrap() - rmse).abs() < 1e-9);
        mean_mae += mae / 3.0;
        all.extend(errors_of(offset));
        differences.clear();
        assert!(errors.join(format!("{stem}_error.tif")).is_file());
    }
    let pooled = &found["pooled"];
    let mae = all.iter().map(|e| e.abs()).sum::<f64>() / all.len() as f64;
    assert!((pooled["mae_m"].as_f64().unwrap() - mae).abs() < 1e-9);
    assert!((found["per_image_mean"]["mae_m"].as_f64().unwrap() - mean_mae).abs() < 1e-9);
    let below = all.iter().filter(|e| e.abs() < 2.5).count() as f64 / all.len() as f64;
    assert!((pooled["lt_2_5_m_pct"].as_f64().unwrap() - 100.0 * below).abs() < 1e-9);
    all.sort_by(f64::total_cmp);
    let median = (all[all.len() / 2 - 1] + all[all.len() / 2]) / 2.0;
    assert!((pooled["median_m"].as_f64().unwrap() - median).abs() < 1e-6);
    let mut absolute: Vec<f64> = all.iter().map(|e| e.abs()).collect();
    absolute.sort_by(f64::total_cmp);
    let rank = 0.9 * (absolute.len() - 1) as f64;
    let low = absolute[rank as usize];
    let le90 = low + (absolute[rank as usize + 1] - low) * rank.fract();
    assert!((pooled["le90_m"].as_f64().unwrap() - le90).abs() < 1e-5);
}

#[test]
fn baselines_score_what_their_making_implies() {
    let folder = benchmark(4);
    let gt = folder.path().join("gt");
    let at = |kind: &str| folder.path().join("baselines").join(kind);
    let make = |kind: &str, extra: &[&str]| {
        let out = at(kind);
        let size = ["--size", "96", "--out", text(&out)];
        run(sat3d().args(["eval", "baseline", kind, "--gt", text(&gt)]).args(size).args(extra), 0);
    };
    make("flat", &[]);
    make("shifted", &["--east", "5", "--south", "-3"]);
    make("blurred", &["--sigma", "0"]);
    // Flat: errors are the truth's deviations from the offset, whatever the height that is predicted.
    let flat = at("flat");
    let scores = json(&[
        "--pred",
        text(&flat),
        "--gt",
        text(&gt),
        "--protocol",
        "vertical",
        "--offset",
        "mean",
    ]);
    for image in scores["per_image"].as_array().unwrap() {
        let file = gt.join(format!("{}_dsm.npz", image["name"].as_str().unwrap()));
        let truth: Vec<f64> = common::npz(&file, "dsm").into_iter().map(f64::from).collect();
        let mean = truth.iter().sum::<f64>() / truth.len() as f64;
        let variance = truth.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>();
        let rmse = (variance / truth.len() as f64).sqrt();
        assert!((image["rmse_m"].as_f64().unwrap() - rmse).abs() < 1e-5, "{rmse}");
    }
    // Under the paper's protocol nothing can be found in it, and that is said.
    let scores = json(&["--pred", text(&flat), "--gt", text(&gt)]);
    assert_eq!(scores["images"]["unaligned"], 4);
    // Shifted: the published alignment finds the shift, after which nothing is left to err.
    let shifted = at("shifted");
    let scores = json(&["--pred", text(&shifted), "--gt", text(&gt)]);
    for image in scores["per_image"].as_array().unwrap() {
        assert_eq!(image["shift_px"]["x"], 5.0);
        assert_eq!(image["shift_px"]["y"], -3.0);
        assert!(image["mae_m"].as_f64().unwrap() < 1e-4, "{image}");
    }
    // Not blurred at all: exactly the truth.
    let blurred = at("blurred");
    let scores = json(&["--pred", text(&blurred), "--gt", text(&gt), "--protocol", "plain"]);
    assert_eq!(scores["pooled"]["max_m"], 0.0);
    assert_eq!(scores["pooled"]["lt_2_5_m_pct"], 100.0);
}

#[test]
fn nothing_is_dropped_in_silence() {
    let folder = benchmark(6);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let file = |k: usize| pred.join(format!("{}.npz", name(k)));
    std::fs::remove_file(file(0)).unwrap();
    std::fs::write(file(1), b"PK\x03\x04 this is no archive").unwrap();
    write_npz(&file(2), "arr_0", 96, &[f32::NAN; 96 * 96]);
    write_npz(&file(3), "heights", 96, &[0.5; 96 * 96]);
    let shape = [48, 96];
    let wide = [0.25_f32; 48 * 96];
    let array = NpyArray { name: "arr_0", shape: &shape, data: NpyData::F32(&wide) };
    std::fs::write(file(4), npz::encode(&[array], Compression::Fast)).unwrap();
    let mut infinite = common::npz(&file(5), "arr_0");
    infinite[17] = f32::INFINITY;
    infinite[18] = f32::NEG_INFINITY;
    write_npz(&file(5), "arr_0", 96, &infinite);
    write_npz(&pred.join("satellite_1.0_2.0.npz"), "arr_0", 4, &[0.5; 16]);
    let arguments = ["eval", "--pred", text(&pred), "--gt", text(&gt), "-q"];
    let output = run(sat3d().args(arguments), 1);
    let table = stdout(&output);
    assert!(table.contains("evaluated 1 of 7"), "{table}");
    let output = run(sat3d().args(arguments).arg("--json"), 1);
    let found: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(found["images"]["found"], 7);
    assert_eq!(found["images"]["evaluated"], 1);
    assert_eq!(found["images"]["skipped"], 2);
    assert_eq!(found["images"]["failed"], 4);
    let reasons: Vec<&String> = found["reasons"].as_object().unwrap().keys().collect();
    for part in ["no prediction", "no ground truth", "no pixel has a height", "arr_0", "damaged"] {
        assert!(reasons.iter().any(|r| r.contains(part)), "{part}: {reasons:?}");
    }
    let (csv, parquet) =
        (folder.path().join("out/images.csv"), folder.path().join("images.parquet"));
    let report = folder.path().join("report.html");
    run(
        sat3d()
            .args(arguments)
            .args(["--csv", text(&csv), "--parquet", text(&parquet)])
            .args(["--report", text(&report)]),
        1,
    );
    let lines = std::fs::read_to_string(&csv).unwrap();
    assert_eq!(lines.lines().count(), 1 + 7, "a header and a row per image:\n{lines}");
    assert_eq!(lines.matches(",failed,").count(), 4, "{lines}");
    assert!(std::fs::read(&parquet).unwrap().starts_with(b"PAR1"));
    let page = std::fs::read_to_string(&report).unwrap();
    assert!(page.contains("1 of 7") && page.contains("data:image/png;base64,"));
    let row = |k: usize| {
        let rows = found["per_image"].as_array().unwrap();
        rows.iter().find(|row| row["name"] == name(k).as_str()).unwrap()
    };
    assert!(row(4)["reason"].as_str().unwrap().contains("96 x 48"), "{}", row(4));
    assert!(row(1)["reason"].as_str().unwrap().contains(&name(1)), "{}", row(1));
    assert_eq!(row(5)["status"], "done");
    assert!(row(5)["notes"][0].as_str().unwrap().contains("2 infinite"), "{}", row(5));
    assert_eq!(row(5)["pixels"], 96 * 96 - 2);
}

#[test]
fn wrong_usage_names_the_value_and_what_to_do() {
    let folder = benchmark(2);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let fails = |extra: &[&str], parts: &[&str]| {
        let output =
            run(sat3d().args(["eval", "--pred", text(&pred), "--gt", text(&gt)]).args(extra), 2);
        for part in parts {
            assert!(stderr(&output).contains(part), "{extra:?}: {}", stderr(&output));
        }
    };
    fails(&["--thresholds", "-1"], &["-1", "positive"]);
    fails(&["--block", "0"], &["--block 0", "positive"]);
    fails(&["--metres-per-unit", "NaN"], &["--metres-per-unit"]);
    fails(&["--mask", "missing.geojson"], &["missing.geojson"]);
    fails(&["--report", text(&gt)], &["is a folder"]);
    let file = gt.join(format!("{}_dsm.npz", name(0)));
    fails(&["--csv", text(&file.join("images.csv"))], &["cannot make the folder"]);
    fails(&["--shard", "3/2", "--parts", "p"], &["3/2"]);
    fails(&["--name", "a", "--name", "b"], &["--name"]);
    let empty = tempfile::tempdir().unwrap();
    let output = run(sat3d().args(["eval", "--pred", text(empty.path()), "--gt", text(&gt)]), 2);
    assert!(stderr(&output).contains("no file that could be scored"), "{}", stderr(&output));
    write_npz(&empty.path().join("other.npz"), "arr_0", 2, &[0.0; 4]);
    let output = run(sat3d().args(["eval", "--pred", text(empty.path()), "--gt", text(&gt)]), 2);
    assert!(stderr(&output).contains("no name in common"), "{}", stderr(&output));
    // A prediction in metres under the key of scene heights would be wrong by a factor of 64.
    let metres = city(96, 1);
    write_npz(&empty.path().join(format!("{}.npz", name(0))), "arr_0", 96, &metres);
    let output = run(
        sat3d().args(["eval", "--pred", text(empty.path()), "--gt", text(&gt), "--json", "-q"]),
        1,
    );
    assert!(stdout(&output).contains("metres belong into an array `dsm`"));
    let right = json(&["--pred", text(empty.path()), "--gt", text(&gt), "--metres-per-unit", "1"]);
    assert_eq!(right["images"]["evaluated"], 1);
}

#[test]
fn two_models_are_compared_on_the_images_that_both_have() {
    let folder = benchmark(30);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let worse = folder.path().join("worse");
    std::fs::create_dir(&worse).unwrap();
    for k in 0..25 {
        let file = format!("{}.npz", name(k));
        let heights = common::npz(&pred.join(&file), "arr_0");
        let rough: Vec<f32> = heights
            .iter()
            .enumerate()
            .map(|(p, v)| v + if p % 2 == 0 { 0.02 } else { -0.02 })
            .collect();
        write_npz(&worse.join(&file), "arr_0", 96, &rough);
    }
    let output = run(
        sat3d()
            .args(["eval", "--pred", text(&pred), "--pred", text(&worse), "--gt", text(&gt)])
            .args(["--json", "-q", "--protocol", "vertical", "--against", "paper"]),
        0,
    );
    let found: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(found["evaluations"].as_array().unwrap().len(), 2);
    let difference = &found["differences"][0];
    assert_eq!(difference["images"], 25);
    let scores = difference["scores"].as_array().unwrap();
    let mae = scores.iter().find(|s| s["score"] == "per_image_mean.mae_m").unwrap();
    assert!(mae["difference"].as_f64().unwrap() > 0.0, "{mae}");
    assert_eq!(mae["significant"], true, "{mae}");
    assert!(
        found["published"].as_array().unwrap().iter().any(|row| row["scores"]["mae_m"] == 3.47)
    );
}

#[test]
fn the_srtm_pair_is_found_where_it_was_put() {
    let Some(data) = common::test_data("eval, SRTM pair") else { return };
    let (pred, gt) =
        (data.join("rasters/srtm_shifted_4326.tif"), data.join("rasters/srtm_ref_4326.tif"));
    let found = json(&["--pred", text(&pred), "--gt", text(&gt), "--protocol", "coregister"]);
    let image = &found["per_image"][0];
    let shift = |axis: &str| image["shift_px"][axis].as_f64().unwrap();
    // The truth's cell (r + 5, c + 3) is the prediction's (r, c): the truth moves west and north.
    assert!((shift("x") + 3.0).abs() < 0.01, "{image}");
    assert!((shift("y") + 5.0).abs() < 0.01, "{image}");
    let after = &image["coregistration"]["after"];
    assert!((after["std_m"].as_f64().unwrap() - 5.36).abs() < 0.01, "{after}");
    assert!((after["nmad_m"].as_f64().unwrap() - 4.447).abs() < 0.005, "{after}");
    let before = &image["coregistration"]["before"];
    assert!(before["std_m"].as_f64() > after["std_m"].as_f64(), "{before}");
    assert!(image["shift_m"]["x"].as_f64().unwrap() < -200.0, "3 px of 3 arc seconds at 40 N");
    let plain = json(&["--pred", text(&pred), "--gt", text(&gt), "--protocol", "plain"]);
    assert_eq!(plain["pooled"]["pixels"], 997 * 995);
}

/// The grid of image `k` of [`benchmark`].
fn grid(k: usize) -> sat3d::grid::ImageGrid {
    let center = sat3d::vigor::SatelliteName::parse(&name(k)).unwrap().center();
    sat3d::grid::ImageGrid::new(center, 20, 96, 96).unwrap()
}

#[test]
fn rasters_score_as_the_arrays_that_they_hold() {
    use sat3d::raster::geotiff::{CogSpec, encode_cog};
    let folder = benchmark(3);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    let (pred_tif, gt_tif) = (folder.path().join("pred_tif"), folder.path().join("gt_tif"));
    std::fs::create_dir(&pred_tif).unwrap();
    std::fs::create_dir(&gt_tif).unwrap();
    for k in 0..3 {
        let spec = CogSpec {
            width: 96,
            height: 96,
            geotransform: grid(k).geotransform(),
            epsg: 3857,
            ..CogSpec::default()
        };
        let truth = common::npz(&gt.join(format!("{}_dsm.npz", name(k))), "dsm");
        std::fs::write(gt_tif.join(format!("{}_dsm.tif", name(k))), encode_cog(&truth, &spec))
            .unwrap();
        let heights = common::npz(&pred.join(format!("{}.npz", name(k))), "arr_0");
        let metres: Vec<f32> = heights.iter().map(|v| v * 64.48).collect();
        std::fs::write(pred_tif.join(format!("{}.tif", name(k))), encode_cog(&metres, &spec))
            .unwrap();
    }
    let arrays = json(&["--pred", text(&pred), "--gt", text(&gt), "--name", "x"]);
    let rasters =
        json(&["--pred", text(&pred_tif), "--gt", text(&gt_tif), "--size", "96", "--name", "x"]);
    assert_eq!(arrays["per_image"], rasters["per_image"]);
    assert_eq!(arrays["strata"], rasters["strata"]);
    // Rasters of other places have no pixel there, and that is said.
    for k in 0..3 {
        let file = |k: usize| pred_tif.join(format!("{}.tif", name(k)));
        if k > 0 {
            std::fs::copy(file(0), file(k)).unwrap();
        }
    }
    let arguments = ["eval", "--pred", text(&pred_tif), "--gt", text(&gt), "--json", "-q"];
    let found: Value = serde_json::from_str(&stdout(&run(sat3d().args(arguments), 1))).unwrap();
    assert_eq!(found["images"]["evaluated"], 1);
    assert_eq!(found["images"]["failed"], 2);
    assert!(found["reasons"].as_object().unwrap().contains_key("no pixel has a height"));
}

#[test]
fn a_mask_divides_the_pixels_where_it_lies() {
    let folder = benchmark(2);
    let (pred, gt) = (folder.path().join("pred"), folder.path().join("gt"));
    // The western quarter of the first image is a park; the second image has none.
    let corner = |x: f64, y: f64| {
        let at = grid(0).lonlat(sat3d::grid::PixelPoint { x, y });
        serde_json::json!([at.lon_deg, at.lat_deg])
    };
    let ring = [corner(0.0, 0.0), corner(0.0, 96.0), corner(24.0, 96.0), corner(24.0, 0.0)];
    let ring: Vec<&Value> = ring.iter().chain(ring.first()).collect();
    let mask = serde_json::json!({
        "type": "FeatureCollection",
        "features": [{
            "type": "Feature",
            "properties": {"kind": "park"},
            "geometry": {"type": "Polygon", "coordinates": [ring]}
        }]
    });
    let file = folder.path().join("mask.geojson");
    std::fs::write(&file, mask.to_string()).unwrap();
    let found = json(&[
        "--pred",
        text(&pred),
        "--gt",
        text(&gt),
        "--protocol",
        "plain",
        "--mask",
        text(&file),
        "--mask-class",
        "kind",
    ]);
    let groups = found["strata"].as_array().unwrap();
    let classes = groups.iter().find(|group| group["name"] == "class").unwrap();
    let park = classes["rows"].as_array().unwrap().iter().find(|r| r["label"] == "park").unwrap();
    assert_eq!(park["pixels"], 96 * 24, "{classes}");
    let output = run(
        sat3d()
            .args(["eval", "--pred", text(&pred), "--gt", text(&gt), "--mask", text(&file)])
            .args(["--mask-class", "use"]),
        2,
    );
    assert!(stderr(&output).contains("use"), "{}", stderr(&output));
}
