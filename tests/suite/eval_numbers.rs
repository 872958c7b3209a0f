//! Sums, quantiles and histograms of errors against numpy and scipy on random and hard inputs.
//!
//! Set `SAT3D_TEST_PYTHON` to an interpreter that has numpy and scipy; without one the test says that
//! it was skipped.

#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::eval::metrics::{
    CoarseCounts, ErrorSums, FineCounts, Histogram, Quantiles, threshold_list,
};
use sat3d::eval::summary::ErrorHistogram;
use sat3d::random::{Draw, normal};
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

/// Reads raw `f64` files, prints one JSON list per file.
const SCRIPT: &str = r#"
import json, sys
import numpy as np
from scipy import stats
for path in sys.argv[1:]:
    e = np.fromfile(path, dtype="<f8")
    a = np.abs(e)
    numbers = {
        "mae": a.mean(dtype=np.longdouble),
        "rmse": np.sqrt((e.astype(np.longdouble) ** 2).mean()),
        "bias": e.mean(dtype=np.longdouble),
        "std": e.astype(np.longdouble).std(),
        "max": a.max(),
        "lt_2_5": 100 * np.mean(a < 2.5),
        "lt_7_5": 100 * np.mean(a < 7.5),
        "lt_1": 100 * np.mean(a < 1.0),
        "median": np.median(e),
        "nmad": 1.4826 * stats.median_abs_deviation(e),
        "le68": np.percentile(a, 68),
        "le90": np.percentile(a, 90),
        "p95": np.percentile(a, 95),
    }
    edges = -10.0 + 0.5 * np.arange(41)
    # The last bin of numpy holds its upper edge too: one more bin takes it.
    counts = np.histogram(e, bins=np.append(edges, np.nextafter(edges[-1], np.inf)))[0][:40]
    print(json.dumps({k: float(v) for k, v in numbers.items()} | {"histogram": counts.tolist()}))
"#;

fn python() -> Option<String> {
    let python = std::env::var("SAT3D_TEST_PYTHON").unwrap_or_else(|_| "python3".into());
    let status = Command::new(&python)
        .args(["-c", "import numpy, scipy.stats"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    status.is_ok_and(|status| status.success()).then_some(python)
}

/// Errors of many kinds and sizes.
fn inputs() -> Vec<Vec<f64>> {
    let mut inputs = vec![
        vec![2.5],
        vec![-2.5, 7.5],
        vec![0.0; 17],
        vec![-0.1; 1001],
        [1.0, -1.0].repeat(500),
        (0..3000).map(|i| f64::from(i % 41 - 20) * 0.5).collect(),
        vec![6.8e38, -6.8e38, 1.0, 2.0, 3.0],
        (0..500).map(|i| f64::from(f32::from_bits(i * 91))).collect(),
    ];
    let mut draw = Draw::new(&[42]);
    for turn in 0..60 {
        let count = 1 + draw.index(3000);
        let scale = libm::exp(draw.range(-9.0, 5.0));
        let offset = if turn % 3 == 0 { draw.range(-4000.0, 4000.0) } else { 0.0 };
        let errors = (0..count).map(|_| {
            let deviate = normal(draw.bits());
            match turn % 5 {
                0 => offset + scale * deviate,
                1 => offset + (scale * deviate).round(),
                2 => offset + scale * deviate * deviate * deviate,
                3 => f64::from((offset + scale * deviate) as f32),
                _ => offset + scale * draw.unit(),
            }
        });
        inputs.push(errors.collect());
    }
    inputs
}

fn write(errors: &[f64], path: &Path) {
    let bytes: Vec<u8> = errors.iter().flat_map(|error| error.to_le_bytes()).collect();
    std::fs::write(path, bytes).unwrap();
}

fn close(found: f64, expected: &serde_json::Value, relative: f64, slack: f64, what: &str) {
    let expected = expected.as_f64().unwrap();
    let off = (found - expected).abs();
    assert!(off <= relative * expected.abs() + slack, "{what}: {found:e}, numpy {expected:e}");
}

#[test]
fn numbers_agree_with_numpy_and_scipy() {
    let Some(python) = python() else {
        let why = "no python with numpy and scipy (set SAT3D_TEST_PYTHON)";
        let _ = writeln!(std::io::stderr(), "SKIPPED numbers_agree_with_numpy_and_scipy: {why}");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let inputs = inputs();
    let mut command = Command::new(python);
    command.args(["-c", SCRIPT]);
    for (place, errors) in inputs.iter().enumerate() {
        let path = folder.path().join(format!("{place}.f64"));
        write(errors, &path);
        command.arg(path);
    }
    let output = command.stderr(Stdio::inherit()).output().unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), inputs.len());

    let thresholds = threshold_list(&[1.0]);
    for (place, (errors, line)) in inputs.iter().zip(lines).enumerate() {
        let expected: serde_json::Value = serde_json::from_str(line).unwrap();
        let (first, second) = errors.split_at(errors.len() / 3);

        let mut sums = ErrorSums::new(3);
        sums.add(first, &thresholds);
        let mut more = ErrorSums::new(3);
        more.add(second, &thresholds);
        sums.merge(&more);
        // What numpy's own deviations lose to the rounding of the mean.
        let lost = 1e-19 * sums.mae();
        for (name, found) in [
            ("mae", sums.mae()),
            ("rmse", sums.rmse()),
            ("bias", sums.bias()),
            ("std", sums.std()),
            ("max", sums.max_abs()),
            ("lt_2_5", sums.below_pct(0)),
            ("lt_7_5", sums.below_pct(1)),
            ("lt_1", sums.below_pct(2)),
        ] {
            close(found, &expected[name], 1e-15, lost, &format!("input {place}, {name}"));
        }

        let exact = Quantiles::of(errors, &mut Vec::new());
        let mut coarse = CoarseCounts::new();
        coarse.add(first);
        coarse.add(second);
        let mut fine = FineCounts::new(&coarse.refinement());
        fine.add(second);
        fine.add(first);
        let pooled = Quantiles::pooled(&coarse, &fine);
        let in_f32 = errors.iter().all(|error| error.abs() < 3e38);
        // The rounding to `f32`: of the numbers themselves, or (NMAD) of the largest involved.
        let scale = if in_f32 { exact.median.abs() + exact.nmad } else { f64::INFINITY };
        for (name, exact, pooled, slack) in [
            ("median", exact.median, pooled.median, 6e-8 * scale + 1e-45),
            ("nmad", exact.nmad, pooled.nmad, 2e-7 * scale + 1e-44),
            ("le68", exact.le68, pooled.le68, 1e-45),
            ("le90", exact.le90, pooled.le90, 1e-45),
            ("p95", exact.p95, pooled.p95, 1e-45),
        ] {
            let what = format!("input {place}, {name}");
            close(exact, &expected[name], 0.0, 0.0, &what);
            if in_f32 {
                close(pooled, &expected[name], 6e-8, slack, &format!("{what}, pooled"));
            }
        }

        let mut histogram = Histogram::new(-10.0, 0.5, 40);
        histogram.add(errors);
        let histogram = ErrorHistogram::from(histogram);
        let counts: Vec<u64> = serde_json::from_value(expected["histogram"].clone()).unwrap();
        assert_eq!(histogram.counts, counts, "input {place}");
        let all = histogram.counts.iter().sum::<u64>() + histogram.below + histogram.above;
        assert_eq!(all, errors.len() as u64);
    }
}
