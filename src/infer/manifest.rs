//! The files that describe a finished run: `manifest.csv`, `manifest.parquet`, `predictions.json`, `run.json`.
//!
//! All but `run.json` depend on the inputs and the plan alone: no times, hosts, folders or thread counts.

use super::options::InferOptions;
use super::outputs::SCENE_END;
use super::record::Record;
use super::run::RunSummary;
use super::{GROUND_TOLERANCE, InferError};
use crate::batch::{Header, OutputFile, Status, Verify, count_status, write_atomic};
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::network::Execution;
use crate::model::{Checkpoint, Config};
use crate::plan::Plan;
use crate::table::{Column, Table, TableError, wkb};
use crate::weights::{Identity, Origin, whole_hash};
use serde_json::{Value, json};
use std::path::Path;

/// The machine-independent description of a run: plan, weights, network, conventions.
pub fn description(plan: &Plan, identity: Option<&Identity>, config: Option<&Config>) -> Value {
    json!({
        "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
        "plan_sha256": plan.hash(),
        "plan": plan,
        "seeds": {},
        "weights": identity,
        "network": config.map(|config| json!({
            "class_name": config.class_name,
            "backbone": config.backbone,
            "representation": format!("{:?}", config.representation),
            "activation": format!("{:?}", config.activation),
            "image_side": config.image_side(),
            "scale": config.scale,
            "pad": config.pad,
        })),
        "conventions": {
            "arr_0": "float32, (2 - depth) / 2: 0 at the bottom of the scene, 1 at its top; row 0 = north, column 0 = west; NaN = no surface (normalised depth)",
            "metres_per_unit": "float64, metres per 1.0 of arr_0",
            "opacity": "float32, share of the ray that ends in the scene, 0 to 1",
            "depth_spread": "float32, metres: standard deviation of the height at which a ray ends; NaN = no surface",
            "heights": "above an arbitrary zero, in no vertical datum",
            "ground": format!("trained on crops {TRAINING_WIDTH_M} m wide; flagged beyond {} %", 100.0 * GROUND_TOLERANCE),
        },
    })
}

/// What only this run knows; goes into `run.json`.
pub struct RunFacts<'a> {
    pub summary: &'a RunSummary,
    pub options: &'a InferOptions,
    pub checkpoint: Option<&'a Checkpoint>,
    /// What led to the checkpoint.
    pub origin: Option<&'a Origin>,
    /// How the network was calculated, where there was one.
    pub execution: Option<Execution>,
}

/// Writes everything that describes the run. `facts` is absent after a merge.
///
/// # Errors
/// A file cannot be written.
pub fn write(
    out: &Path,
    header: &Header,
    mut records: Vec<Record>,
    facts: Option<&RunFacts<'_>>,
) -> Result<(), InferError> {
    records.sort_by(|a, b| a.name.cmp(&b.name));
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |error: TableError| InferError::Table { path, reason: error.to_string() }
    };
    let (csv, parquet) = (out.join("manifest.csv"), out.join("manifest.parquet"));
    let table = table(&records).map_err(failed(&csv))?;
    table.write_csv(&csv).map_err(failed(&csv))?;
    table.write_parquet(&parquet).map_err(failed(&parquet))?;
    let count = |status| count_status(&records, status);
    let mut predictions = header.description.clone();
    predictions["images"] = json!({
        "total": records.len(),
        "done": count(Status::Done),
        "skipped": count(Status::Skipped),
        "failed": count(Status::Failed),
    });
    write_json(&out.join("predictions.json"), &predictions)?;
    if let Some(facts) = facts {
        write_json(&out.join("run.json"), &run_json(facts))?;
    }
    Ok(())
}

fn write_json(path: &Path, value: &Value) -> Result<(), InferError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|error| InferError::Io {
        action: "write",
        path: path.to_owned(),
        source: error.into(),
    })?;
    bytes.push(b'\n');
    write_atomic(path, &bytes).map_err(InferError::io("write", path))
}

fn run_json(facts: &RunFacts<'_>) -> Value {
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_secs());
    let hashed = facts.options.verify == Verify::Hashes;
    json!({
        "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
        "finished_unix_s": now,
        "seconds": facts.summary.seconds,
        "threads": facts.options.threads,
        "network": facts.execution.map(|execution| execution.to_string()),
        "input": facts.options.input,
        "weights": facts.checkpoint.map(|checkpoint| json!({
            "folder": checkpoint.folder(),
            "origin": facts.origin,
            "sha256": hashed.then(|| whole_hash(checkpoint)),
        })),
        "machine": {
            "os": std::env::consts::OS,
            "architecture": std::env::consts::ARCH,
            "cores": std::thread::available_parallelism().map_or(1, usize::from),
        },
        "features": {
            "cuda": cfg!(feature = "cuda"),
            "wgpu": cfg!(feature = "wgpu"),
        },
        "summary": facts.summary,
    })
}

/// The manifest as a table: one row per image, geometry = the image's centre.
fn table(records: &[Record]) -> Result<Table, TableError> {
    let output = |r: &Record, end: &str| {
        let name = format!("{}{end}", r.name);
        r.outputs.iter().find(|output| output.file == name).cloned()
    };
    let npz = |r: &Record| output(r, ".npz");
    let hash = |output: Option<OutputFile>| output.map_or_else(String::new, |o| o.sha256);
    let files = |r: &Record| -> String {
        r.outputs.iter().map(|output| output.file.as_str()).collect::<Vec<_>>().join(";")
    };
    let number = |name, about, of: &dyn Fn(&Record) -> Option<f64>| {
        Column::f64(name, about, records.iter().map(of))
    };
    let count = |name, about, of: &dyn Fn(&Record) -> Option<i64>| {
        Column::i64(name, about, records.iter().map(of))
    };
    let text = |name, about, of: &dyn Fn(&Record) -> String| {
        Column::text(name, about, records.iter().map(of))
    };
    Table::new(vec![
        text("name", "Stem of the image", &|r| r.name.clone()),
        text("status", "done, skipped or failed", &|r| r.status.name().to_owned()),
        text("reason", "Why skipped or failed", &|r| r.reason.clone()),
        text("image", "File name of the image", &|r| r.image.clone()),
        number("lat", "Latitude of the centre, degrees", &|r| r.lat_deg),
        number("lon", "Longitude of the centre, degrees", &|r| r.lon_deg),
        count("width_px", "Columns of the image", &|r| r.size_px.map(|s| s[0].into())),
        count("height_px", "Rows of the image", &|r| r.size_px.map(|s| s[1].into())),
        number("ground_width_m", "Width on the ground, metres", &|r| r.ground_m.map(|m| m[0])),
        number("ground_height_m", "Height on the ground, metres", &|r| r.ground_m.map(|m| m[1])),
        text(
            "ground_from",
            "What says so: place (name, georeference or scene file), option (--gsd), assumed (nothing does)",
            &|r| r.ground_from.map_or("", |from| from.name()).to_owned(),
        ),
        number("metres_per_unit", "Metres per 1.0 of arr_0", &|r| r.metres_per_unit),
        number("min_m", "Lowest height, metres", &|r| r.min_m),
        number("max_m", "Highest height, metres", &|r| r.max_m),
        number("mean_m", "Mean height, metres", &|r| r.mean_m),
        number("opacity", "Mean opacity, 0 to 1", &|r| r.opacity),
        count("no_surface_px", "Pixels whose ray met no surface (opacity under 0.05)", &|r| {
            r.no_surface_px.map(|n| n as i64)
        }),
        text("light", "Light of the street views", &|r| r.light.clone().unwrap_or_default()),
        text("flags", "Things to look at", &|r| r.flags.join("; ")),
        text("file", "The heights, relative to the manifest", &|r| {
            npz(r).map_or_else(String::new, |o| o.file)
        }),
        count("bytes", "Size of that file", &|r| npz(r).map(|o| o.bytes as i64)),
        text("sha256", "SHA-256 of that file", &|r| hash(npz(r))),
        text("geotiff_sha256", "SHA-256 of the GeoTIFF, where one was asked for", &|r| {
            hash(output(r, ".tif"))
        }),
        text("scene_sha256", "SHA-256 of the scene, where one was asked for", &|r| {
            hash(output(r, SCENE_END))
        }),
        text("files", "All files of the image, by ;", &files),
        Column::geometry(
            "geometry",
            "Centre of the image",
            records.iter().map(|r| Some(wkb::point(r.lon_deg?, r.lat_deg?))),
        ),
    ])
}
