//! A folder of rasters as a self-contained STAC 1.1.0 collection: `collection.json` beside the data
//! and `items/<id>.json`, joined by relative links, so that the folder can be moved or served as it is.
//!
//! Fields of the projection (2.0.0) and file (2.1.0) extensions are written under their names and
//! **not declared** in `stac_extensions`: a declared extension makes every validator fetch its schema
//! from the network, while the core schemas ship with the validators. A reader that insists on the
//! declaration adds it on reading (`item.ext.add("proj")` in pystac).
//!
//! STAC wants a time of every item. Where none is known, `datetime` is null, as the specification
//! says for data without a single time, and the range that it then requires is [`TimeRange::UNKNOWN`].

mod json;

use crate::batch::{sync_folder, write_atomic};
use crate::grid::{GeoTransform, LonLat};
use rayon::prelude::*;
use serde_json::{Map, Value};
use std::collections::HashSet;
use std::io;
use std::path::{Path, PathBuf};

/// Name of the collection's file in its folder.
pub const COLLECTION_FILE: &str = "collection.json";
/// Name of the folder of items beside it.
pub const ITEMS_FOLDER: &str = "items";

/// What all items have in common. Extents are those of the items and not stated here.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Collection {
    /// Identifier.
    pub id: String,
    /// One line for people.
    pub title: String,
    /// What the data is; CommonMark.
    pub description: String,
    /// SPDX identifier, or `other`.
    pub license: String,
    /// Words to find it by.
    pub keywords: Vec<String>,
    /// Who made, processed or serves the data.
    pub providers: Vec<Provider>,
    /// Further fields of the collection; names should have a prefix (`sat3d:`).
    pub extra: Map<String, Value>,
}

/// Someone who had a part in the data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Provider {
    /// Name.
    pub name: String,
    /// `licensor`, `producer`, `processor` or `host`.
    pub roles: Vec<String>,
    /// Home page.
    pub url: Option<String>,
}

/// One place: its files and what is known of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Item {
    /// Identifier, which is also the stem of the item's file.
    pub id: String,
    /// Corners of the footprint, counter-clockwise from the south-west, WGS 84.
    pub corners: [LonLat; 4],
    /// When the data was taken, if known.
    pub captured: Option<TimeRange>,
    /// The grid of the raster, if all assets share one.
    pub grid: Option<ProjectedGrid>,
    /// Further properties; names outside of STAC's common metadata should have a prefix.
    pub properties: Map<String, Value>,
    /// The files by key (`dsm`, `preview`), in order.
    pub assets: Vec<(String, Asset)>,
}

/// First and last moment, RFC 3339 in UTC (`2021-03-01T00:00:00Z`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TimeRange {
    /// First moment.
    pub start: String,
    /// Last moment.
    pub end: String,
}

impl TimeRange {
    /// The range of items whose time is not known, start and end: wide enough to hold any lidar
    /// survey, so that it is true; within what readers with 64-bit nanoseconds can hold (until 2262);
    /// and no file's date, which would differ between copies.
    pub const UNKNOWN: [&str; 2] = ["1970-01-01T00:00:00Z", "2099-12-31T23:59:59Z"];
}

/// A raster's grid for the projection extension.
#[derive(Clone, Debug, PartialEq)]
pub struct ProjectedGrid {
    /// Authority and code, for example `EPSG:3857`.
    pub code: String,
    /// Rows and columns.
    pub shape: [u32; 2],
    /// Pixel corners in units of the CRS.
    pub geotransform: GeoTransform,
}

/// One file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Asset {
    /// Path relative to the collection's folder, `/` between parts.
    pub path: String,
    /// One line for people.
    pub title: String,
    /// Media type.
    pub media_type: String,
    /// What the file is for: `data`, `thumbnail`, `metadata`.
    pub roles: Vec<String>,
    /// Size in bytes.
    pub bytes: Option<u64>,
    /// SHA-256, hexadecimal.
    pub sha256: Option<String>,
    /// Further fields, for example `data_type` and `unit`.
    pub extra: Map<String, Value>,
}

/// Why a collection cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum StacError {
    /// The operating system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// An identifier that cannot be a file's name.
    #[error(
        "STAC item \"{id}\": an identifier must be a plain file name without / or \\ at its start or inside"
    )]
    Identifier {
        /// The identifier.
        id: String,
    },
    /// Two items of one name.
    #[error("two STAC items are called \"{id}\"; identifiers must differ")]
    Duplicate {
        /// The identifier.
        id: String,
    },
    /// A number or digest that JSON or the specification has no room for.
    #[error("STAC item \"{id}\": {reason}")]
    Value {
        /// The item.
        id: String,
        /// What is wrong.
        reason: String,
    },
}

impl StacError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

/// Writes `collection.json` and `items/<id>.json` into `folder`, which must exist.
///
/// Items appear whole (a file beside the target, then a rename) but are not flushed one by one: of
/// 20,000 that would cost minutes, and all of them can be made again from what they describe. The
/// folder of items is synced once, and the collection is written after that, atomically and
/// flushed. Item files that the folder's earlier collection linked to and that are no longer in it
/// are removed; nothing else is.
///
/// # Errors
/// [`StacError`]; items that were written before the error stay, and the earlier collection too.
pub fn write(folder: &Path, collection: &Collection, items: &[Item]) -> Result<(), StacError> {
    let mut ids = HashSet::with_capacity(items.len());
    for item in items {
        check(item)?;
        if !ids.insert(item.id.as_str()) {
            return Err(StacError::Duplicate { id: item.id.clone() });
        }
    }
    let items_folder = folder.join(ITEMS_FOLDER);
    std::fs::create_dir_all(&items_folder).map_err(StacError::io("create", &items_folder))?;
    items.par_iter().try_for_each(|item| {
        let path = items_folder.join(format!("{}.json", item.id));
        replace(&path, &json::bytes(&json::item(item, collection)))
            .map_err(StacError::io("write", &path))
    })?;
    let target = folder.join(COLLECTION_FILE);
    let earlier = linked_items(&target);
    sync_folder(&items_folder).map_err(StacError::io("sync", &items_folder))?;
    write_atomic(&target, &json::bytes(&json::collection(collection, items)))
        .map_err(StacError::io("write", &target))?;
    for id in earlier.iter().filter(|id| !ids.contains(id.as_str())) {
        let path = items_folder.join(format!("{id}.json"));
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(StacError::io("remove", &path)(error));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Refuses what would give a damaged file or one outside of the folder.
fn check(item: &Item) -> Result<(), StacError> {
    let Item { id, corners, grid, assets, .. } = item;
    if !is_file_name(id) {
        return Err(StacError::Identifier { id: id.clone() });
    }
    let value = |reason: String| StacError::Value { id: id.clone(), reason };
    if let Some(corner) =
        corners.iter().find(|c| !(c.lon_deg.abs() <= 180.0 && c.lat_deg.abs() <= 90.0))
    {
        return Err(value(format!(
            "no place on Earth: {}, {} degrees",
            corner.lon_deg, corner.lat_deg
        )));
    }
    if grid.as_ref().is_some_and(|grid| grid.geotransform.0.iter().any(|v| !v.is_finite())) {
        return Err(value("its geotransform is not finite".into()));
    }
    for (key, asset) in assets {
        if let Some(digest) = &asset.sha256
            && (digest.len() != 64 || !digest.bytes().all(|b| b.is_ascii_hexdigit()))
        {
            return Err(value(format!("asset {key}: \"{digest}\" is no SHA-256")));
        }
    }
    Ok(())
}

fn is_file_name(id: &str) -> bool {
    !id.is_empty() && !id.starts_with('.') && !id.contains(['/', '\\', '\0'])
}

/// Identifiers that a collection written here links to; none if there is no such file.
fn linked_items(collection: &Path) -> Vec<String> {
    let parsed = std::fs::read(collection)
        .ok()
        .and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok());
    let links = parsed.as_ref().and_then(|value| value["links"].as_array());
    let ids = links.into_iter().flatten().filter(|link| link["rel"] == "item").filter_map(|link| {
        let name = link["href"]
            .as_str()?
            .strip_prefix("./")?
            .strip_prefix(ITEMS_FOLDER)?
            .strip_prefix('/')?;
        name.strip_suffix(".json").filter(|id| is_file_name(id)).map(str::to_owned)
    });
    ids.collect()
}

/// Puts a file in place whole, without flushing it to disk.
fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("json.part");
    let written = std::fs::write(&part, bytes).and_then(|()| std::fs::rename(&part, path));
    if written.is_err() {
        // The error that matters is the first one.
        let _ = std::fs::remove_file(&part);
    }
    written
}

#[cfg(test)]
mod tests;
