//! Polygons and their classes from GeoJSON (RFC 7946, and the `crs` member of the 2008 version).
//!
//! Read as plain JSON: what a mask needs is little, and messages can name the feature.

use super::mask::{MaskError, MaskOptions};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// A polygon's rings in the file's CRS.
pub(super) type Rings = Vec<Vec<[f64; 2]>>;

/// What a file holds.
#[derive(Debug)]
pub(super) struct Features {
    /// The CRS as the file states it, where it does and it is not WGS 84.
    pub crs: Option<String>,
    /// Feature number, class as text, polygons.
    pub features: Vec<(usize, Option<String>, Vec<Rings>)>,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Most values that a property may have before it is taken for an identifier.
const MAX_CLASSES: usize = 256;

/// Reads a file's text.
pub(super) fn read(path: &Path, text: &str, options: &MaskOptions) -> Result<Features, MaskError> {
    let fail = |reason: String| MaskError::GeoJson { path: path.to_owned(), reason };
    let text = text.trim_start_matches('\u{feff}');
    let root: Value =
        serde_json::from_str(text).map_err(|error| fail(format!("not JSON: {error}")))?;
    let kind = root.get("type").and_then(Value::as_str).unwrap_or("");
    let bare;
    let features: Vec<&Value> = match kind {
        "FeatureCollection" => match root.get("features").and_then(Value::as_array) {
            Some(features) => features.iter().collect(),
            None => return Err(fail("the FeatureCollection has no `features`".to_owned())),
        },
        "Feature" => vec![&root],
        "Polygon" | "MultiPolygon" | "GeometryCollection" => {
            bare = serde_json::json!({ "geometry": &root });
            vec![&bare]
        }
        other => {
            return Err(fail(format!(
                "its `type` is `{other}`; a mask is a FeatureCollection, a Feature, a Polygon or a MultiPolygon"
            )));
        }
    };
    let mut found = Features {
        crs: stated_crs(&root).map_err(fail)?,
        features: Vec::with_capacity(features.len()),
        warnings: Vec::new(),
    };
    let (mut without_class, mut without_geometry) = (0_usize, 0_usize);
    let mut names: BTreeMap<String, usize> = BTreeMap::new();
    for (number, feature) in features.iter().enumerate() {
        let bad =
            |reason: String| MaskError::Feature { path: path.to_owned(), feature: number, reason };
        let class = match &options.class_field {
            None => None,
            Some(field) => {
                let properties = feature.get("properties").and_then(Value::as_object);
                for name in properties.into_iter().flat_map(|p| p.keys()) {
                    *names.entry(name.clone()).or_default() += 1;
                }
                match class_of(properties.and_then(|p| p.get(field))) {
                    Ok(Some(class)) => Some(class),
                    Ok(None) => {
                        without_class += 1;
                        continue;
                    }
                    Err(value) => {
                        return Err(bad(format!(
                            "property `{field}` is {value}; a class is a text or a number"
                        )));
                    }
                }
            }
        };
        let mut polygons = Vec::new();
        match feature.get("geometry") {
            None | Some(Value::Null) => without_geometry += 1,
            Some(geometry) => collect(geometry, 0, &mut polygons).map_err(bad)?,
        }
        if !polygons.is_empty() {
            found.features.push((number, class, polygons));
        }
    }
    if let Some(field) = &options.class_field
        && !features.is_empty()
        && without_class == features.len()
    {
        let known: Vec<&str> = names.keys().take(12).map(String::as_str).collect();
        let known = if known.is_empty() { "none at all".to_owned() } else { known.join(", ") };
        return Err(fail(format!(
            "no feature has a property `{field}` with a text or number; the properties there are: {known}"
        )));
    }
    if found.features.is_empty() {
        return Err(fail(format!("it has no polygon ({} features)", features.len())));
    }
    let note = |count: usize, what: &str| {
        (count > 0).then(|| {
            format!("{}: {count} features have no {what} and are left out", path.display())
        })
    };
    found.warnings.extend(note(without_class, "class"));
    found.warnings.extend(note(without_geometry, "geometry"));
    Ok(found)
}

/// The `crs` member: its name, `None` for WGS 84 longitude and latitude.
fn stated_crs(root: &Value) -> Result<Option<String>, String> {
    let Some(member) = root.get("crs").filter(|v| !v.is_null()) else { return Ok(None) };
    let name = member.get("properties").and_then(|p| p.get("name")).and_then(Value::as_str);
    match name {
        Some(name) if name.to_ascii_uppercase().contains("CRS84") => Ok(None),
        Some(name) => Ok(Some(name.to_owned())),
        None => Err(format!(
            "its `crs` member is {}, which names no CRS; state one, for example EPSG:2927",
            short(member)
        )),
    }
}

/// A class as text; `None` where there is none, the value in words where it cannot be one.
fn class_of(value: Option<&Value>) -> Result<Option<String>, String> {
    match value {
        None | Some(Value::Null) => Ok(None),
        Some(Value::String(text)) => Ok(Some(text.clone())),
        Some(Value::Bool(value)) => Ok(Some(value.to_string())),
        // 2 and 2.0 are one class.
        Some(Value::Number(number)) => {
            Ok(Some(number.as_f64().map_or_else(|| number.to_string(), |value| value.to_string())))
        }
        Some(other) => Err(short(other)),
    }
}

/// Labels in order: numbers by size, then texts by alphabet.
pub(super) fn sorted_classes(
    path: &Path,
    field: &str,
    features: &Features,
) -> Result<Vec<String>, MaskError> {
    let mut classes: Vec<String> =
        features.features.iter().filter_map(|(_, class, _)| class.clone()).collect();
    classes.sort_by(|a, b| match (a.parse::<f64>(), b.parse::<f64>()) {
        (Ok(x), Ok(y)) => x.total_cmp(&y).then_with(|| a.cmp(b)),
        (Ok(_), Err(_)) => std::cmp::Ordering::Less,
        (Err(_), Ok(_)) => std::cmp::Ordering::Greater,
        (Err(_), Err(_)) => a.cmp(b),
    });
    classes.dedup();
    if classes.len() > MAX_CLASSES {
        return Err(MaskError::GeoJson {
            path: path.to_owned(),
            reason: format!(
                "property `{field}` has {} different values, more than {MAX_CLASSES}: is it an identifier? name a property that holds classes",
                classes.len()
            ),
        });
    }
    Ok(classes)
}

/// Gathers the polygons of a geometry.
fn collect(geometry: &Value, depth: u32, out: &mut Vec<Rings>) -> Result<(), String> {
    let coordinates = || {
        geometry
            .get("coordinates")
            .and_then(Value::as_array)
            .ok_or_else(|| "the geometry has no `coordinates`".to_owned())
    };
    match geometry.get("type").and_then(Value::as_str).unwrap_or("") {
        "Polygon" => out.extend(polygon(coordinates()?)?),
        "MultiPolygon" => {
            for part in coordinates()? {
                let rings = part.as_array().ok_or_else(|| {
                    format!("a part of the MultiPolygon is {}, not a list of rings", short(part))
                })?;
                out.extend(polygon(rings)?);
            }
        }
        "GeometryCollection" if depth < 8 => {
            let parts = geometry.get("geometries").and_then(Value::as_array);
            for part in parts.ok_or("the GeometryCollection has no `geometries`")? {
                collect(part, depth + 1, out)?;
            }
        }
        other => {
            return Err(format!(
                "the geometry is `{other}`; a mask holds Polygon and MultiPolygon only"
            ));
        }
    }
    Ok(())
}

/// The rings of a polygon; `None` for an empty one.
fn polygon(rings: &[Value]) -> Result<Option<Rings>, String> {
    let rings: Rings =
        rings.iter().enumerate().map(|(k, r)| ring(k, r)).collect::<Result<_, _>>()?;
    Ok((!rings.is_empty()).then_some(rings))
}

fn ring(number: usize, value: &Value) -> Result<Vec<[f64; 2]>, String> {
    let positions = value
        .as_array()
        .ok_or_else(|| format!("ring {number} is {}, not a list of positions", short(value)))?;
    let mut out = Vec::with_capacity(positions.len());
    for (k, position) in positions.iter().enumerate() {
        let number_at = |axis: usize| position.get(axis).and_then(Value::as_f64);
        let (Some(x), Some(y)) = (number_at(0), number_at(1)) else {
            return Err(format!(
                "position {k} of ring {number} is {}, not two numbers or more",
                short(position)
            ));
        };
        out.push([x, y]);
    }
    if out.len() < 4 {
        return Err(format!(
            "ring {number} has {} positions; a closed ring has 4 or more",
            out.len()
        ));
    }
    if out.first() != out.last() {
        return Err(format!(
            "ring {number} is not closed: it begins at {:?} and ends at {:?}; repeat the first position at its end",
            out[0],
            out[out.len() - 1]
        ));
    }
    Ok(out)
}

/// A value as JSON, shortened for a message.
fn short(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 60 {
        return text;
    }
    text.chars().take(57).chain("...".chars()).collect()
}
