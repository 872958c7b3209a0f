//! The tree's own files: `tileset.json`, and further ones for parts of a large city.

use super::Tiles3dOptions;
use super::tree::Built;
use crate::tile::city::City;
use crate::tile::frame::LocalFrame;
use serde_json::{Value, json};

/// Two corners: the least and the largest east, north and up, metres.
pub(super) type Bounds = [[f64; 3]; 2];

/// A tile that shows the file `uri`.
pub(super) fn tile(bounds: Bounds, error_m: f64, uri: &str, children: Vec<Value>) -> Value {
    let mut tile = json!({
        "boundingVolume": { "box": volume(bounds) },
        "geometricError": error_m,
        "refine": "REPLACE",
        "content": { "uri": uri },
    });
    if !children.is_empty() {
        tile["children"] = children.into();
    }
    tile
}

/// A part of the tree in a file of its own.
pub(super) fn part(root: Value) -> Value {
    json!({ "asset": { "version": "1.1" }, "geometricError": root["geometricError"], "root": root })
}

/// The file that a viewer opens.
pub(super) fn document(
    city: &City,
    frame: &LocalFrame,
    options: &Tiles3dOptions,
    step_m: f64,
    root: &Built,
) -> Value {
    let mut extras = json!({
        "generator": "sat3d",
        "axes": "metres, x east, y north, z up",
        "vertical_metres_per_unit": city.vertical_m,
        "vertical_datum": "none: heights are predictions above the city's lowest level",
        "finest_error_m": options.error_m,
        "position_step_m": step_m,
        "ground_sample_distance_m": city.gsd_m(),
        "ground_sample_distance_assumed": city.assumed,
    });
    let mut top = root.tile.clone();
    if let Some(origin) = frame.origin() {
        extras["origin_longitude_deg"] = json!(origin.lon_deg);
        extras["origin_latitude_deg"] = json!(origin.lat_deg);
        extras["origin_crs"] = json!("EPSG:4326");
        extras["base_height_ellipsoidal_m"] = json!(frame.base_height_m());
    } else {
        extras["place"] = json!("none: the picture has no georeference");
    }
    if let Some(matrix) = frame.to_ecef() {
        top["transform"] = json!(matrix);
    }
    // As long as nothing is drawn, the whole city is missing.
    let [low, high] = root.bounds;
    let sides: f64 = (0..3).map(|k| (high[k] - low[k]) * (high[k] - low[k])).sum();
    let error_m = sides.sqrt().max(root.error_m);
    json!({
        "asset": { "version": "1.1", "extras": extras },
        "geometricError": error_m,
        "root": top,
    })
}

/// A document as a file: one line, since a city's tiles are many.
pub(super) fn text(document: &Value) -> Vec<u8> {
    let mut bytes = document.to_string().into_bytes();
    bytes.push(b'\n');
    bytes
}

/// Centre and half axes. All are exact: sums of multiples of a power of two.
fn volume([low, high]: Bounds) -> [f64; 12] {
    // A flat piece still needs a volume; a millimetre hides nothing.
    const LEAST: f64 = 1.0 / 1024.0;
    let middle = [0, 1, 2].map(|k| (low[k] + high[k]) / 2.0);
    let half = [0, 1, 2].map(|k| ((high[k] - low[k]) / 2.0).max(LEAST));
    let mut volume = [0.0; 12];
    volume[..3].copy_from_slice(&middle);
    for (axis, half) in half.into_iter().enumerate() {
        volume[3 + 4 * axis] = half;
    }
    volume
}
