//! The benchmark as a STAC collection: one item per finished DSM.

use super::BenchError;
use super::record::Record;
use crate::batch::{OutputFile, Status};
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use crate::stac::{Asset, Collection, Item, ProjectedGrid, StacError};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Writes `collection.json` and `items/` into `out`, from `benchmark.json` and the records. The
/// same benchmark gives the same bytes.
///
/// # Errors
/// A file cannot be written, or `benchmark` does not say the images' zoom and size.
pub fn write(out: &Path, benchmark: &Value, records: &[Record]) -> Result<(), BenchError> {
    let parameters = &benchmark["plan"]["parameters"];
    let images = Images::of(parameters)?;
    let mut items = Vec::new();
    for record in records.iter().filter(|record| record.status == Status::Done) {
        items.push(images.item(record)?);
    }
    crate::stac::write(out, &collection(benchmark), &items).map_err(|error| match error {
        StacError::Io { action, path, source } => BenchError::Io { action, path, source },
        other => BenchError::Input(other.to_string()),
    })
}

/// What all images of a benchmark share.
struct Images {
    zoom: u8,
    size: u32,
    /// Whether the DSMs lie on the images' own grid and not on the reference implementation's.
    exact: bool,
}

impl Images {
    fn of(parameters: &Value) -> Result<Self, BenchError> {
        let number = |name: &str| {
            parameters[name].as_u64().and_then(|value| u32::try_from(value).ok()).ok_or_else(|| {
                BenchError::Input(format!(
                    "the plan's \"{name}\" is {}, not a size in pixels or a zoom; \
                     the journal is damaged: build into an empty folder",
                    parameters[name]
                ))
            })
        };
        let zoom = number("zoom")?;
        Ok(Self {
            zoom: u8::try_from(zoom).unwrap_or(u8::MAX),
            size: number("size")?,
            exact: parameters["grid"] == "web-mercator",
        })
    }

    fn item(&self, record: &Record) -> Result<Item, BenchError> {
        let named = |reason: String| BenchError::Input(format!("{}: {reason}", record.name));
        let (Some(lat_deg), Some(lon_deg)) = (record.lat_deg, record.lon_deg) else {
            return Err(named(
                "its record has no position; build it again with --overwrite".into(),
            ));
        };
        let grid = ImageGrid::new(LonLat { lon_deg, lat_deg }, self.zoom, self.size, self.size)
            .map_err(|error| named(error.to_string()))?;
        let (end, size) = (f64::from(self.size), self.size);
        let corners = [(0.0, end), (end, end), (end, 0.0), (0.0, 0.0)];
        let geotransform = grid.geotransform();
        Ok(Item {
            id: record.name.clone(),
            corners: corners.map(|(x, y)| grid.lonlat(PixelPoint { x, y })),
            captured: None,
            grid: self.exact.then(|| ProjectedGrid {
                code: "EPSG:3857".into(),
                shape: [size, size],
                geotransform,
            }),
            properties: properties(record, &grid),
            assets: record.outputs.iter().filter_map(|file| asset(file, record)).collect(),
        })
    }
}

fn properties(record: &Record, grid: &ImageGrid) -> Map<String, Value> {
    let mut properties = Map::new();
    let mut put = |name: &str, value: Value| {
        if !value.is_null() {
            properties.insert(name.into(), value);
        }
    };
    put("gsd", json!(grid.ground_sample_distance()));
    put("sat3d:coverage_pct", json!(record.nan_pct.map(|nan| 100.0 - nan)));
    put("sat3d:dtm_coverage_pct", json!(record.dtm_nan_pct.map(|nan| 100.0 - nan)));
    put("sat3d:tiles", json!(record.tiles));
    put("sat3d:transform_bound_m", json!(record.transform_bound_m));
    put("sat3d:height_bound_m", json!(record.height_bound_m));
    if !record.flags.is_empty() {
        put("sat3d:flags", json!(record.flags));
    }
    properties
}

/// Key and description of an output; `None` for files that are not for users.
fn asset(file: &OutputFile, record: &Record) -> Option<(String, Asset)> {
    let (key, title, media_type, roles): (_, _, _, &[&str]) = match Path::new(&file.file)
        .extension()?
        .to_str()?
    {
        "npz" => ("dsm", "Heights, metres (numpy archive, key dsm)", "application/zip", &["data"]),
        "tif" => (
            "dsm_geotiff",
            "Heights, metres (Cloud Optimized GeoTIFF)",
            "image/tiff; application=geotiff; profile=cloud-optimized",
            &["data"],
        ),
        "png" => ("preview", "Hillshaded picture", "image/png", &["thumbnail", "overview"]),
        _ => return None,
    };
    let mut extra = Map::new();
    if roles.contains(&"data") {
        extra.insert("data_type".into(), "float32".into());
        extra.insert("nodata".into(), "nan".into());
        extra.insert("unit".into(), "m".into());
        let statistics: Map<String, Value> = [
            ("minimum", record.min_m),
            ("maximum", record.max_m),
            ("mean", record.mean_m),
            ("valid_percent", record.nan_pct.map(|nan| 100.0 - nan)),
        ]
        .into_iter()
        .filter_map(|(name, value)| Some((name.to_owned(), json!(value?))))
        .collect();
        if !statistics.is_empty() {
            extra.insert("statistics".into(), statistics.into());
        }
    }
    let asset = Asset {
        path: file.file.clone(),
        title: title.into(),
        media_type: media_type.into(),
        roles: roles.iter().map(|&role| role.to_owned()).collect(),
        bytes: Some(file.bytes),
        sha256: Some(file.sha256.clone()),
        extra,
    };
    Some((key.to_owned(), asset))
}

fn collection(benchmark: &Value) -> Collection {
    let mut extra = Map::new();
    extra.insert("sat3d:software".into(), benchmark["software"].clone());
    extra.insert("sat3d:plan_sha256".into(), benchmark["plan_sha256"].clone());
    // The plan's hash names the build: parts of one benchmark have it in common.
    let plan = benchmark["plan_sha256"].as_str().unwrap_or_default();
    Collection {
        id: format!("sat3d-dsm-benchmark-{}", plan.get(..12).unwrap_or(plan)),
        title: "DSM benchmark for satellite images".into(),
        description: "Ground-truth digital surface models out of lidar, one per satellite image, on the image's \
                      pixel grid: float32 metres in the vertical datum of the lidar tiles, NaN = no data, \
                      row 0 = north.\n\nThe time of the lidar survey is not known to the program: the times of \
                      the items enclose all possible ones. The licence is that of the lidar tiles, whose names \
                      are in `sat3d:tiles`."
            .into(),
        license: "other".into(),
        keywords: ["DSM", "lidar", "elevation", "benchmark", "VIGOR"].map(str::to_owned).to_vec(),
        providers: Vec::new(),
        extra,
    }
}
