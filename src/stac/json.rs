//! The documents as JSON, fields in the order of the specification's own examples.

use super::{Asset, COLLECTION_FILE, Collection, ITEMS_FOLDER, Item, TimeRange};
use serde_json::{Map, Value, json};

const VERSION: &str = "1.1.0";
/// Multihash prefix of a SHA-256: code 0x12, length 0x20.
const MULTIHASH_SHA256: &str = "1220";

/// Indented and with a final newline.
pub fn bytes(value: &Value) -> Vec<u8> {
    let mut text = format!("{value:#}").into_bytes();
    text.push(b'\n');
    text
}

pub fn collection(collection: &Collection, items: &[Item]) -> Value {
    let mut value = json!({
        "type": "Collection",
        "stac_version": VERSION,
        "id": collection.id,
        "title": collection.title,
        "description": collection.description,
        "license": collection.license,
        "extent": {
            "spatial": {"bbox": [extent(items)]},
            "temporal": {"interval": [interval(items)]},
        },
    });
    if !collection.keywords.is_empty() {
        value["keywords"] = json!(collection.keywords);
    }
    if !collection.providers.is_empty() {
        let providers = collection.providers.iter().map(|provider| {
            let mut value = json!({"name": provider.name, "roles": provider.roles});
            if let Some(url) = &provider.url {
                value["url"] = json!(url);
            }
            value
        });
        value["providers"] = providers.collect();
    }
    extend(&mut value, &collection.extra);
    let root = link("root", &format!("./{COLLECTION_FILE}"), "application/json", &collection.title);
    let links = items.iter().map(|item| {
        json!({
            "rel": "item",
            "href": format!("./{ITEMS_FOLDER}/{}.json", item.id),
            "type": "application/geo+json",
        })
    });
    value["links"] = std::iter::once(root).chain(links).collect();
    value
}

pub fn item(item: &Item, collection: &Collection) -> Value {
    let mut ring: Vec<[f64; 2]> = item.corners.iter().map(|c| [c.lon_deg, c.lat_deg]).collect();
    ring.push(ring[0]);
    let [start, end] = match &item.captured {
        Some(TimeRange { start, end }) => [start.as_str(), end],
        None => TimeRange::UNKNOWN,
    };
    let mut properties = json!({"datetime": null, "start_datetime": start, "end_datetime": end});
    if let Some(grid) = &item.grid {
        // The extension wants the order of the six coefficients of an affine matrix by rows.
        let [west, a, b, north, d, e] = grid.geotransform.0;
        properties["proj:code"] = json!(grid.code);
        properties["proj:shape"] = json!(grid.shape);
        properties["proj:transform"] = json!([a, b, west, d, e, north]);
    }
    extend(&mut properties, &item.properties);
    let assets: Map<String, Value> =
        item.assets.iter().map(|(key, value)| (key.clone(), asset(value))).collect();
    let up = format!("../{COLLECTION_FILE}");
    let links = ["root", "parent", "collection"]
        .map(|rel| link(rel, &up, "application/json", &collection.title));
    json!({
        "type": "Feature",
        "stac_version": VERSION,
        "id": item.id,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": bbox(item),
        "properties": properties,
        "links": links,
        "assets": assets,
        "collection": collection.id,
    })
}

fn asset(asset: &Asset) -> Value {
    let mut value = json!({
        "href": format!("../{}", asset.path),
        "title": asset.title,
        "type": asset.media_type,
        "roles": asset.roles,
    });
    if let Some(bytes) = asset.bytes {
        value["file:size"] = json!(bytes);
    }
    if let Some(digest) = &asset.sha256 {
        value["file:checksum"] =
            json!(format!("{MULTIHASH_SHA256}{}", digest.to_ascii_lowercase()));
    }
    extend(&mut value, &asset.extra);
    value
}

fn link(rel: &str, href: &str, media_type: &str, title: &str) -> Value {
    json!({"rel": rel, "href": href, "type": media_type, "title": title})
}

fn extend(value: &mut Value, extra: &Map<String, Value>) {
    for (key, field) in extra {
        value[key.as_str()] = field.clone();
    }
}

/// West, south, east, north, degrees.
fn bbox(item: &Item) -> [f64; 4] {
    let corners = item.corners.iter().map(|c| [c.lon_deg, c.lat_deg, c.lon_deg, c.lat_deg]);
    corners.reduce(union).unwrap_or_default()
}

/// The box around all items; the world if there are none, since STAC wants one.
fn extent(items: &[Item]) -> [f64; 4] {
    items.iter().map(bbox).reduce(union).unwrap_or([-180.0, -90.0, 180.0, 90.0])
}

fn union(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

/// First and last moment of all items; open (null) at both ends if that of any is not known. RFC
/// 3339 times in UTC with the same number of digits sort as text.
fn interval(items: &[Item]) -> [Option<&str>; 2] {
    let known: Option<Vec<&TimeRange>> = items.iter().map(|item| item.captured.as_ref()).collect();
    let known = known.unwrap_or_default();
    [known.iter().map(|t| t.start.as_str()).min(), known.iter().map(|t| t.end.as_str()).max()]
}
