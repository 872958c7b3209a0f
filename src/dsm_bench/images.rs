//! Which images a benchmark is for: a VIGOR city folder, a folder of images, or a list of names.

use super::BenchError;
use crate::vigor::{NameError, SatelliteName};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Where the image names come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ImageSource {
    /// A VIGOR city folder (with `satellite/`, or with `satellite_list.txt` alone) or a folder of
    /// `satellite_<lat>_<lon>.png`.
    Folder(PathBuf),
    /// A text file: per line a name, or a line whose first field is one (VIGOR label and split
    /// files); the image files need not exist.
    List(PathBuf),
}

/// One image of the batch.
#[derive(Clone, Debug)]
pub struct ImageEntry {
    /// Stem, or the whole text where it is no valid name.
    pub stem: String,
    /// The parsed name, or why it is none.
    pub name: Result<SatelliteName, NameError>,
    /// The image file, if there is one; its pixel size is checked.
    pub file: Option<PathBuf>,
}

impl ImageSource {
    /// The images, each once, in natural order of the source; unparsable names are kept, to be
    /// reported per item.
    ///
    /// # Errors
    /// The source is missing, unreadable, or holds no image name at all.
    pub fn list(&self) -> Result<Vec<ImageEntry>, BenchError> {
        let entries = match self {
            Self::List(path) => from_list(path)?,
            Self::Folder(folder) => from_folder(folder)?,
        };
        if entries.is_empty() {
            let place = match self {
                Self::List(path) | Self::Folder(path) => path.display(),
            };
            return Err(BenchError::Input(format!(
                "{place}: no satellite_<lat>_<lon>.png found; give a VIGOR city folder, a folder of such images, or --images with a list of names"
            )));
        }
        let mut seen = HashSet::new();
        Ok(entries.into_iter().filter(|entry| seen.insert(entry.stem.clone())).collect())
    }
}

fn entry(text: &str, file: Option<PathBuf>) -> ImageEntry {
    let name = SatelliteName::parse(text);
    let stem = name.as_ref().map_or_else(|_| text.to_owned(), |name| name.stem().to_owned());
    ImageEntry { stem, name, file }
}

fn from_list(path: &Path) -> Result<Vec<ImageEntry>, BenchError> {
    let bytes = std::fs::read(path).map_err(BenchError::io("read", path))?;
    let text = String::from_utf8_lossy(&bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    Ok(text
        .lines()
        .filter_map(|line| {
            // A label line begins with the panorama; its images carry the name we look for.
            let mut fields = line.split_whitespace();
            let first = fields.next()?;
            let file_name =
                |field: &str| field.rsplit(['/', '\\']).next().unwrap_or(field).to_owned();
            let name = std::iter::once(first)
                .chain(fields)
                .map(file_name)
                .find(|field| field.starts_with("satellite_"))
                .unwrap_or_else(|| file_name(first));
            (!name.starts_with('#')).then(|| entry(&name, None))
        })
        .collect())
}

fn from_folder(folder: &Path) -> Result<Vec<ImageEntry>, BenchError> {
    let satellite = folder.join("satellite");
    let images = if satellite.is_dir() { &satellite } else { folder };
    let mut names = Vec::new();
    for item in std::fs::read_dir(images).map_err(BenchError::io("read the folder", images))? {
        let item = item.map_err(BenchError::io("read the folder", images))?;
        let name = item.file_name().to_string_lossy().into_owned();
        let lower = name.to_ascii_lowercase();
        if [".png", ".jpg", ".jpeg"].iter().any(|end| lower.ends_with(end)) {
            names.push(name);
        }
    }
    if names.is_empty() {
        for list in ["satellite_list.txt", "splits/satellite_list.txt"] {
            let list = folder.join(list);
            if list.is_file() {
                return from_list(&list);
            }
        }
        let cities: Vec<String> = std::fs::read_dir(folder)
            .map_err(BenchError::io("read the folder", folder))?
            .filter_map(|item| item.ok())
            .filter(|item| item.path().join("satellite").is_dir())
            .map(|item| item.file_name().to_string_lossy().into_owned())
            .collect();
        if !cities.is_empty() {
            return Err(BenchError::Input(format!(
                "{}: this is a VIGOR root; give one city, for example --vigor {}",
                folder.display(),
                folder.join(&cities[0]).display()
            )));
        }
    }
    names.sort_unstable();
    Ok(names.into_iter().map(|name| entry(&name, Some(images.join(&name)))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn lists_take_names_from_every_kind_of_line() {
        let folder = tempfile::tempdir().expect("folder");
        let list = folder.path().join("list.txt");
        fs::write(
            &list,
            "\u{feff}satellite_47.1_-122.1.png\r\n\n# a comment\nSeattle/satellite/satellite_47.2_-122.2.png Seattle/panorama/p.jpg m 1 2\npano,1,2,.jpg satellite_47.3_-122.3.png 1 2\nsatellite_47.1_-122.1.png\nrubbish",
        )
        .expect("writes");
        let stems: Vec<_> = ImageSource::List(list)
            .list()
            .expect("lists")
            .into_iter()
            .map(|e| (e.stem, e.name.is_ok()))
            .collect();
        let expected = [
            ("satellite_47.1_-122.1", true),
            ("satellite_47.2_-122.2", true),
            ("satellite_47.3_-122.3", true),
            ("rubbish", false),
        ];
        assert_eq!(stems, expected.map(|(s, ok)| (s.to_owned(), ok)));
    }

    #[test]
    fn folders_are_cities_images_or_lists() {
        let folder = tempfile::tempdir().expect("folder");
        let root = folder.path();
        assert!(matches!(
            ImageSource::Folder(root.to_owned()).list(),
            Err(BenchError::Input(text)) if text.contains("no satellite_")
        ));
        let city = root.join("Seattle");
        fs::create_dir_all(city.join("satellite")).expect("makes");
        fs::write(city.join("satellite/satellite_1_2.png"), b"x").expect("writes");
        fs::write(city.join("satellite/notes.txt"), b"x").expect("writes");
        let listed = ImageSource::Folder(city.clone()).list().expect("lists");
        assert_eq!(listed.len(), 1);
        assert!(listed[0].file.is_some());
        assert!(matches!(
            ImageSource::Folder(root.to_owned()).list(),
            Err(BenchError::Input(text)) if text.contains("VIGOR root")
        ));
        assert_eq!(ImageSource::Folder(city.join("satellite")).list().expect("lists").len(), 1);
        assert!(ImageSource::Folder(root.join("missing")).list().is_err());
    }
}
