//! Which images a run is for: one file, a folder, a VIGOR city folder, a list, a manifest.

use super::InferError;
use super::outputs::SCENE_END;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::schema::types::Type;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

/// File endings of pictures; the last three are GDAL's.
const PICTURES: &[&str] = if cfg!(feature = "gdal") {
    &["png", "jpg", "jpeg", "tif", "tiff", "vrt", "jp2", "webp"]
} else {
    &["png", "jpg", "jpeg", "tif", "tiff"]
};
/// Columns of a manifest that can name an image, the preferred first; `name` is a stem.
const COLUMNS: [&str; 5] = ["satellite", "image", "path", "name", "file"];

/// What an entry's file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A picture, for the network.
    Picture,
    /// A scene that an earlier run saved; the network is not needed.
    Scene,
}

/// One item of the batch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// What its outputs are called.
    pub stem: String,
    /// Its file, which need not exist.
    pub path: PathBuf,
    /// What that is.
    pub kind: Kind,
}

impl Entry {
    fn of(path: PathBuf) -> Self {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(stem) = name.strip_suffix(SCENE_END).or(name.strip_suffix(".safetensors")) {
            return Self { stem: stem.to_owned(), path, kind: Kind::Scene };
        }
        // A stem keeps the digits behind its last point: only known endings are taken off.
        let stem = match name.rsplit_once('.') {
            Some((stem, end)) if PICTURES.iter().any(|known| end.eq_ignore_ascii_case(known)) => {
                stem.to_owned()
            }
            _ => name,
        };
        Self { stem, path, kind: Kind::Picture }
    }
}

/// The images of an input, each once, sorted by stem.
///
/// # Errors
/// The input is missing, unreadable or empty; two files would give outputs of one name.
pub fn list(input: &Path, root: Option<&Path>) -> Result<Vec<Entry>, InferError> {
    let paths = if input.is_dir() {
        from_folder(input)?
    } else {
        let end = input.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let folder = root.unwrap_or_else(|| input.parent().unwrap_or(Path::new("")));
        match end.as_str() {
            end if PICTURES.contains(&end) || end == "safetensors" => {
                std::fs::metadata(input).map_err(InferError::io("read", input))?;
                vec![input.to_owned()]
            }
            "csv" => resolved(from_csv(input)?, folder),
            "parquet" => resolved(from_parquet(input)?, folder),
            "json" => resolved(from_json(input)?, folder),
            _ => resolved(from_text(input)?, folder),
        }
    };
    let mut entries: BTreeMap<String, Entry> = BTreeMap::new();
    for entry in paths.into_iter().map(Entry::of) {
        match entries.get(&entry.stem) {
            Some(known) if known.path != entry.path => {
                return Err(InferError::Input(format!(
                    "{} and {} would both give {}.npz; rename one, or give them to two runs",
                    known.path.display(),
                    entry.path.display(),
                    entry.stem
                )));
            }
            Some(_) => {}
            None => {
                entries.insert(entry.stem.clone(), entry);
            }
        }
    }
    if entries.is_empty() {
        return Err(InferError::Input(format!(
            "{}: no image in it (*.{}); give an image, a folder of images, a VIGOR city folder, or a list of names",
            input.display(),
            PICTURES.join(", *.")
        )));
    }
    Ok(entries.into_values().collect())
}

/// Whether a file of this name would be taken for a picture; folders' names may stand before it.
pub fn is_picture(name: &str) -> bool {
    !name.contains('/')
        && name
            .rsplit_once('.')
            .is_some_and(|(_, end)| PICTURES.iter().any(|known| end.eq_ignore_ascii_case(known)))
}

fn from_folder(folder: &Path) -> Result<Vec<PathBuf>, InferError> {
    let satellite = folder.join("satellite");
    let images = if satellite.is_dir() { &satellite } else { folder };
    let read = |folder: &Path| -> Result<Vec<PathBuf>, InferError> {
        std::fs::read_dir(folder)
            .and_then(|items| items.map(|item| item.map(|item| item.path())).collect())
            .map_err(InferError::io("read the folder", folder))
    };
    let all = read(images)?;
    let named = |path: &Path, wanted: &dyn Fn(&str) -> bool| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        !name.starts_with('.') && wanted(&name)
    };
    // Scenes lie among the pictures that were made with them: a folder that holds some is a folder of scenes.
    let scene = |name: &str| name.ends_with(SCENE_END);
    let scenes: Vec<PathBuf> = all.iter().filter(|p| named(p, &scene)).cloned().collect();
    if !scenes.is_empty() {
        return Ok(scenes);
    }
    let pictures: Vec<PathBuf> = all.iter().filter(|p| named(p, &is_picture)).cloned().collect();
    if pictures.is_empty()
        && let Some(city) = all.iter().filter(|path| path.join("satellite").is_dir()).min()
    {
        return Err(InferError::Input(format!(
            "{}: this is a VIGOR root; give one city, for example {}",
            folder.display(),
            city.display()
        )));
    }
    Ok(pictures)
}

/// A name in a list, with the city that a VIGOR manifest puts beside it.
struct Named {
    name: String,
    city: Option<String>,
}

/// Where the files of a list are: under the folder, or in a VIGOR layout under it. A file that is
/// nowhere keeps the first place, so that it fails by that name.
fn resolved(names: Vec<Named>, folder: &Path) -> Vec<PathBuf> {
    let place = |Named { name, city }: Named| {
        let mut places = vec![folder.join(&name)];
        if let Some(city) = city {
            places.push(folder.join(&city).join("satellite").join(&name));
        }
        places.push(folder.join("satellite").join(&name));
        let exact = places.iter().find(|path| path.is_file()).cloned();
        // A manifest can name stems.
        let ended = || {
            let mut ends = places.iter().flat_map(|path| {
                PICTURES.iter().map(move |end| {
                    let mut path = path.clone().into_os_string();
                    path.push(format!(".{end}"));
                    PathBuf::from(path)
                })
            });
            ends.find(|path| path.is_file())
        };
        exact.or_else(ended).unwrap_or_else(|| places.swap_remove(0))
    };
    names.into_iter().map(place).collect()
}

/// One name a line, or VIGOR's label and split lines, whose first field `satellite_...` is taken.
fn from_text(path: &Path) -> Result<Vec<Named>, InferError> {
    let bytes = std::fs::read(path).map_err(InferError::io("read", path))?;
    if bytes.contains(&0) {
        return Err(InferError::Input(format!(
            "{}: neither an image (*.{}) nor a text file with names of images",
            path.display(),
            PICTURES.join(", *.")
        )));
    }
    let text = String::from_utf8_lossy(&bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let name = |line: &str| {
        let satellite = line.split_whitespace().find(|field| {
            field.rsplit(['/', '\\']).next().is_some_and(|name| name.starts_with("satellite_"))
        });
        Named { name: satellite.unwrap_or(line).to_owned(), city: None }
    };
    let lines = text.lines().map(str::trim);
    Ok(lines.filter(|line| !line.is_empty() && !line.starts_with('#')).map(name).collect())
}

fn no_column(path: &Path, found: &str) -> InferError {
    InferError::Table {
        path: path.to_owned(),
        reason: format!(
            "no column names images; one of {} is needed, and there are {found}",
            COLUMNS.join(", ")
        ),
    }
}

fn from_csv(path: &Path) -> Result<Vec<Named>, InferError> {
    let wrong =
        |error: csv::Error| InferError::Table { path: path.to_owned(), reason: error.to_string() };
    let mut reader = csv::Reader::from_path(path).map_err(wrong)?;
    let titles = reader.headers().map_err(wrong)?.clone();
    let column = |name: &str| {
        titles.iter().position(|title| title.trim_start_matches('\u{feff}').trim() == name)
    };
    let Some(image) = COLUMNS.iter().find_map(|name| column(name)) else {
        return Err(no_column(path, &titles.iter().collect::<Vec<_>>().join(", ")));
    };
    let city = column("city");
    let mut names = Vec::new();
    for row in reader.records() {
        let row = row.map_err(wrong)?;
        let field = |at: usize| row.get(at).filter(|text| !text.is_empty()).map(str::to_owned);
        if let Some(name) = field(image) {
            names.push(Named { name, city: city.and_then(field) });
        }
    }
    Ok(unique(names))
}

/// VIGOR's manifest has a row per pair: each image many times.
fn unique(names: Vec<Named>) -> Vec<Named> {
    let mut seen = std::collections::HashSet::new();
    names.into_iter().filter(|n| seen.insert((n.name.clone(), n.city.clone()))).collect()
}

fn from_parquet(path: &Path) -> Result<Vec<Named>, InferError> {
    let wrong = |error: parquet::errors::ParquetError| InferError::Table {
        path: path.to_owned(),
        reason: error.to_string(),
    };
    let file = File::open(path).map_err(InferError::io("read", path))?;
    let reader = SerializedFileReader::new(file).map_err(wrong)?;
    let schema = reader.metadata().file_metadata().schema().clone();
    let field = |name: &str| schema.get_fields().iter().find(|f| f.name() == name).cloned();
    let Some(image) = COLUMNS.iter().find_map(|name| field(name)) else {
        let names: Vec<&str> = schema.get_fields().iter().map(|f| f.name()).collect();
        return Err(no_column(path, &names.join(", ")));
    };
    let title = image.name().to_owned();
    let mut wanted = vec![image];
    wanted.extend(field("city"));
    let projection =
        Type::group_type_builder(schema.name()).with_fields(wanted).build().map_err(wrong)?;
    let mut names = Vec::new();
    for row in reader.get_row_iter(Some(projection)).map_err(wrong)? {
        let row = row.map_err(wrong)?;
        let text = |title: &str| {
            let found = row.get_column_iter().find(|(name, _)| *name == title)?;
            match found.1 {
                parquet::record::Field::Str(text) => Some(text.clone()),
                _ => None,
            }
        };
        if let Some(name) = text(&title) {
            names.push(Named { name, city: text("city") });
        }
    }
    Ok(unique(names))
}

/// An array of names, or of objects with a column's key.
fn from_json(path: &Path) -> Result<Vec<Named>, InferError> {
    let bytes = std::fs::read(path).map_err(InferError::io("read", path))?;
    let wrong = |reason: String| InferError::Table { path: path.to_owned(), reason };
    let value: Value =
        serde_json::from_slice(&bytes).map_err(|error| wrong(format!("not JSON: {error}")))?;
    let Value::Array(rows) = value else {
        return Err(wrong("an array of names is needed, or of objects that name an image".into()));
    };
    let name = |row: &Value| match row {
        Value::String(name) => Some(Named { name: name.clone(), city: None }),
        row => {
            let name = COLUMNS.iter().find_map(|key| row[key].as_str())?;
            Some(Named { name: name.to_owned(), city: row["city"].as_str().map(str::to_owned) })
        }
    };
    let names: Option<Vec<Named>> = rows.iter().map(name).collect();
    names.map(unique).ok_or_else(|| {
        wrong(format!("an entry names no image; it needs one of {}", COLUMNS.join(", ")))
    })
}
