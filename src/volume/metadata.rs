//! The `zarr.json` files of a volume: Zarr v3 with the names that xarray, CF and rioxarray look for.

use super::{Frame, VolumeDescription};
use crate::crs::CrsSpec;
use crate::raster::deflate::Compression;
use crate::units::LinearUnit;
use serde_json::{Map, Value, json};

/// The files of a volume: folder within it (empty for the whole) and content.
pub(super) fn documents(volume: &VolumeDescription) -> Vec<(&'static str, Value)> {
    let mut nodes = vec![
        ("density", density(volume)),
        ("x", axis(volume, 0)),
        ("y", axis(volume, 1)),
        ("z", axis(volume, 2)),
    ];
    if let Frame::Map(crs) = &volume.frame {
        nodes.push(("spatial_ref", spatial_ref(crs)));
    }
    // Everything once more in one place: readers need no further look.
    let all: Map<_, _> =
        nodes.iter().map(|(name, node)| ((*name).to_owned(), node.clone())).collect();
    let group = json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": attributes(volume),
        "consolidated_metadata": {
            "kind": "inline",
            "must_understand": false,
            "metadata": all,
        },
    });
    nodes.push(("", group));
    nodes
}

fn attributes(volume: &VolumeDescription) -> Value {
    let mut attributes = Map::new();
    attributes.insert("Conventions".into(), json!("CF-1.11"));
    attributes.insert("title".into(), json!("Volume density of a scene"));
    attributes.insert("metres_per_unit".into(), json!(volume.metres_per_unit));
    match &volume.frame {
        Frame::Local { origin: Some(origin) } => {
            attributes.insert("origin_longitude".into(), json!(origin.lon_deg));
            attributes.insert("origin_latitude".into(), json!(origin.lat_deg));
        }
        Frame::Local { origin: None } => {}
        Frame::Map(crs) => {
            if let Some(code) = crs.epsg {
                attributes.insert("proj:code".into(), json!(format!("EPSG:{code}")));
            }
        }
    }
    attributes.extend(volume.attributes.clone());
    Value::Object(attributes)
}

fn array(
    shape: &[usize],
    chunk: &[usize],
    data_type: &str,
    fill: Value,
    gzip: bool,
    attributes: Value,
) -> Map<String, Value> {
    let mut codecs = vec![json!({"name": "bytes", "configuration": {"endian": "little"}})];
    if gzip {
        codecs.push(json!({"name": "gzip", "configuration": {"level": 6}}));
    }
    let document = json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": codecs,
        "attributes": attributes,
        "storage_transformers": [],
    });
    match document {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

fn density(volume: &VolumeDescription) -> Value {
    let mut attributes = json!({
        "long_name": "volume density per unit of the scene's cube",
        "units": "1",
    });
    if matches!(volume.frame, Frame::Map(_)) {
        attributes["grid_mapping"] = json!("spatial_ref");
        // Beside the grid mapping, so that it is a coordinate without being asked for.
        attributes["coordinates"] = json!("spatial_ref");
    }
    let gzip = volume.compression != Compression::Stored;
    let shape = volume.axes.shape();
    let mut document = array(&shape, &volume.chunk, "float32", json!("NaN"), gzip, attributes);
    document.insert("dimension_names".into(), json!(["x", "y", "z"]));
    Value::Object(document)
}

fn axis(volume: &VolumeDescription, index: usize) -> Value {
    let count = volume.axes.shape()[index];
    let name = ["x", "y", "z"][index];
    let attributes = match (index, &volume.frame) {
        (2, _) => json!({
            "long_name": "height; its zero is arbitrary",
            "units": "m",
            "positive": "up",
            "axis": "Z",
        }),
        (_, Frame::Local { .. }) => json!({
            "long_name": (["metres east of the centre", "metres north of the centre"][index]),
            "units": "m",
            "axis": (["X", "Y"][index]),
        }),
        (_, Frame::Map(crs)) if crs.geographic => json!({
            "standard_name": (["longitude", "latitude"][index]),
            "units": (["degrees_east", "degrees_north"][index]),
            "axis": (["X", "Y"][index]),
        }),
        (_, Frame::Map(crs)) => json!({
            "standard_name": (["projection_x_coordinate", "projection_y_coordinate"][index]),
            "units": unit(crs.linear_unit),
            "axis": (["X", "Y"][index]),
        }),
    };
    let mut document = array(&[count], &[count], "float64", json!("NaN"), false, attributes);
    document.insert("dimension_names".into(), json!([name]));
    Value::Object(document)
}

/// UDUNITS' name.
fn unit(unit: Option<LinearUnit>) -> &'static str {
    match unit {
        Some(LinearUnit::Foot) => "foot",
        Some(LinearUnit::UsSurveyFoot) => "US_survey_foot",
        Some(LinearUnit::Metre) | None => "m",
    }
}

/// A variable without values, whose attributes are the CRS (CF's grid mapping, as rioxarray reads it).
fn spatial_ref(crs: &CrsSpec) -> Value {
    let mut attributes = json!({"long_name": crs.label()});
    let stated = crs.wkt.clone().or_else(|| crs.epsg.map(|code| format!("EPSG:{code}")));
    if let Some(stated) = stated {
        attributes["spatial_ref"] = json!(stated);
    }
    if let Some(wkt) = &crs.wkt {
        attributes["crs_wkt"] = json!(wkt);
    }
    let mut document = array(&[], &[], "int64", json!(0), false, attributes);
    document.insert("dimension_names".into(), json!([]));
    Value::Object(document)
}
