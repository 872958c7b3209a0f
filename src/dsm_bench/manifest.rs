//! The files that describe a finished benchmark: `manifest.csv`, `manifest.parquet`,
//! `benchmark.json`, `run.json` and the STAC collection.
//!
//! All but `run.json` depend on the inputs and the plan alone: no times, hosts or thread counts.

use super::BenchError;
use super::build::RunSummary;
use super::record::Record;
use super::tiles::TileSet;
use crate::batch::{Header, Status, count_status, write_atomic};
use crate::lidar::CacheStatistics;
use crate::plan::Plan;
use crate::table::{Column, Table, TableError, wkb};
use serde_json::{Value, json};
use std::path::Path;

/// What only this run knows; goes into `run.json`.
pub struct RunFacts<'a> {
    /// Counts and times.
    pub summary: &'a RunSummary,
    /// Worker threads.
    pub threads: usize,
    /// Block cache.
    pub cache: CacheStatistics,
}

/// The machine-independent description of a build: plan, software, tiles and their operations.
pub fn benchmark_json(plan: &Plan, dsm: &TileSet, dtm: Option<&TileSet>) -> Value {
    json!({
        "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
        "plan_sha256": plan.hash(),
        "plan": plan,
        "seeds": {},
        "conventions": {
            "dsm": "float32, metres, NaN = no data, row 0 = north, pixel (i, j) covers [i, i+1) x [j, j+1)",
            "grid": "EPSG:3857 window centred on the latitude and longitude in the name",
            "heights": "in the vertical datum of the lidar tiles; no vertical transformation is applied",
        },
        "dsm_tiles": tiles_json(dsm),
        "dtm_tiles": dtm.map(tiles_json),
    })
}

fn tiles_json(set: &TileSet) -> Value {
    let tiles: Vec<Value> = set
        .tiles()
        .iter()
        .enumerate()
        .map(|(number, tile)| {
            let header = set.header(number);
            let crs = set.crs_of(number);
            json!({
                "number": number,
                "file": tile.file_name(),
                "bytes": header.size_bytes,
                "width": header.width,
                "height": header.height,
                "geotransform": header.geotransform,
                "sample_type": header.sample_type,
                "compression": header.compression,
                "nodata": header.nodata.filter(|v| v.is_finite()),
                "crs": crs.spec.epsg.map_or_else(|| crs.spec.name.clone(), |code| format!("EPSG:{code}")),
                "operation": crs.operation,
            })
        })
        .collect();
    let bad: Vec<Value> = set
        .bad
        .iter()
        .map(|bad| {
            let file = bad.path.file_name().unwrap_or_default().to_string_lossy();
            json!({"file": file, "reason": bad.reason})
        })
        .collect();
    json!({
        "vertical_unit": set.vertical_unit,
        "vertical_unit_from": set.vertical_evidence,
        "vertical_unit_assumed": set.vertical_assumed,
        "tiles": tiles,
        "unusable": bad,
    })
}

/// Writes everything that describes the benchmark. `facts` is absent after a merge.
///
/// # Errors
/// A file cannot be written.
pub fn write(
    out: &Path,
    header: &Header,
    mut records: Vec<Record>,
    facts: Option<&RunFacts<'_>>,
    stac: bool,
) -> Result<(), BenchError> {
    records.sort_by(|a, b| a.name.cmp(&b.name));
    let table = table(&records).map_err(table_error)?;
    table.write_csv(&out.join("manifest.csv")).map_err(table_error)?;
    table.write_parquet(&out.join("manifest.parquet")).map_err(table_error)?;
    let count = |status| count_status(&records, status);
    let mut benchmark = header.description.clone();
    benchmark["images"] = json!({
        "total": records.len(),
        "done": count(Status::Done),
        "skipped": count(Status::Skipped),
        "failed": count(Status::Failed),
    });
    write_json(&out.join("benchmark.json"), &benchmark)?;
    if let Some(facts) = facts {
        write_json(&out.join("run.json"), &run_json(facts))?;
    }
    if stac {
        crate::plan::runs("stac");
        super::stac::write(out, &benchmark, &records)?;
    }
    Ok(())
}

fn table_error(error: TableError) -> BenchError {
    BenchError::Input(error.to_string())
}

fn write_json(path: &Path, value: &Value) -> Result<(), BenchError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|error| BenchError::Io {
        action: "write",
        path: path.to_owned(),
        source: error.into(),
    })?;
    bytes.push(b'\n');
    write_atomic(path, &bytes).map_err(BenchError::io("write", path))
}

fn run_json(facts: &RunFacts<'_>) -> Value {
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_secs());
    json!({
        "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
        "finished_unix_s": now,
        "seconds": facts.summary.seconds,
        "threads": facts.threads,
        "machine": {
            "os": std::env::consts::OS,
            "architecture": std::env::consts::ARCH,
            "cores": std::thread::available_parallelism().map_or(1, usize::from),
        },
        "features": {
            "gdal": cfg!(feature = "gdal"),
            "proj": cfg!(feature = "proj"),
        },
        "block_cache": facts.cache,
        "summary": facts.summary,
    })
}

/// The manifest as a table: one row per image, geometry = the image's centre.
fn table(records: &[Record]) -> Result<Table, TableError> {
    let output = |r: &Record, end: &str| r.outputs.iter().find(|o| o.file.ends_with(end)).cloned();
    let npz = |r: &Record| output(r, "_dsm.npz");
    Table::new(vec![
        Column::text("name", "Stem of the satellite image", records.iter().map(|r| r.name.clone())),
        Column::text("status", "done, skipped or failed", records.iter().map(|r| r.status.name())),
        Column::text("reason", "Why skipped or failed", records.iter().map(|r| r.reason.clone())),
        Column::f64("lat", "Latitude of the centre, degrees", records.iter().map(|r| r.lat_deg)),
        Column::f64("lon", "Longitude of the centre, degrees", records.iter().map(|r| r.lon_deg)),
        Column::f64(
            "coverage_pct",
            "Pixels with data, per cent",
            records.iter().map(|r| r.nan_pct.map(|nan| 100.0 - nan)),
        ),
        Column::f64(
            "mosaic_coverage_pct",
            "Pixels with data that --coverage mosaic would give, per cent, where best-tile was not enough",
            records.iter().map(|r| r.mosaic_nan_pct.map(|nan| 100.0 - nan)),
        ),
        Column::i64(
            "candidates",
            "Tiles whose outline meets the image",
            records.iter().map(|r| Some(r.candidates as i64)),
        ),
        Column::text(
            "tiles",
            "Tiles that gave pixels, by ;",
            records.iter().map(|r| r.tiles.join(";")),
        ),
        Column::text(
            "transform",
            "Form of the transform: affine, separable, chebyshev or exact",
            records.iter().map(|r| r.transform.clone().unwrap_or_default()),
        ),
        Column::f64(
            "transform_bound_m",
            "Bound on the displacement of the transform, metres",
            records.iter().map(|r| r.transform_bound_m),
        ),
        Column::f64("min_m", "Lowest height, metres", records.iter().map(|r| r.min_m)),
        Column::f64("max_m", "Highest height, metres", records.iter().map(|r| r.max_m)),
        Column::f64("mean_m", "Mean height, metres", records.iter().map(|r| r.mean_m)),
        Column::f64(
            "steepest",
            "Steepest gradient between neighbouring lidar cells in the footprint, metres per metre",
            records.iter().map(|r| r.steepest),
        ),
        Column::f64(
            "height_bound_m",
            "Bound on the height error of all steps of the plan, metres; empty for nearest",
            records.iter().map(|r| r.height_bound_m),
        ),
        Column::i64(
            "uncertain_px",
            "Pixels whose validity could flip within the horizontal bound",
            records.iter().map(|r| r.uncertain_px.map(|n| n as i64)),
        ),
        Column::f64(
            "dtm_coverage_pct",
            "Pixels with bare-earth data, per cent",
            records.iter().map(|r| r.dtm_nan_pct.map(|nan| 100.0 - nan)),
        ),
        Column::text("flags", "Things to look at", records.iter().map(|r| r.flags.join("; "))),
        Column::text(
            "file",
            "The DSM, relative to the manifest",
            records.iter().map(|r| npz(r).map_or_else(String::new, |o| o.file)),
        ),
        Column::i64(
            "bytes",
            "Size of the DSM",
            records.iter().map(|r| npz(r).map(|o| o.bytes as i64)),
        ),
        Column::text(
            "sha256",
            "SHA-256 of the DSM",
            records.iter().map(|r| npz(r).map_or_else(String::new, |o| o.sha256)),
        ),
        Column::text(
            "geotiff_sha256",
            "SHA-256 of the GeoTIFF, where one was asked for",
            records.iter().map(|r| output(r, "_dsm.tif").map_or_else(String::new, |o| o.sha256)),
        ),
        Column::geometry(
            "geometry",
            "Centre of the image",
            records.iter().map(|r| Some(wkb::point(r.lon_deg?, r.lat_deg?))),
        ),
    ])
}
