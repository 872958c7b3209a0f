//! Where things lie: VIGOR's folders, or what people keep of them.
//!
//! A root holds `<City>/{satellite,panorama}`, `splits/<City>/`, `splits__corrected/<City>/` and
//! Sat3DGen's split files. A city folder holds its images, its label files, or both; its labels may
//! also lie beside it in the root's `splits*` folders.

use super::city::canonical_name;
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Why a folder cannot be read as VIGOR.
#[derive(Debug, thiserror::Error)]
pub enum LayoutError {
    /// There is nothing of that name.
    #[error("{} does not exist; give VIGOR's root folder or a city folder", path.display())]
    Missing {
        /// The path given.
        path: PathBuf,
    },
    /// A file, not a folder.
    #[error(
        "{} is a file; give the folder that holds it, or VIGOR's root or a city folder and name the file with --labels",
        path.display()
    )]
    NotAFolder {
        /// The path given.
        path: PathBuf,
    },
    /// A folder cannot be listed.
    #[error("cannot list the folder {}: {source}", path.display())]
    Unreadable {
        /// The folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// Neither images nor label files.
    #[error(
        "{} holds nothing of VIGOR: no city folders, no satellite/ or panorama/ folder, no splits/, no .txt label files",
        path.display()
    )]
    Nothing {
        /// The path given.
        path: PathBuf,
    },
    /// `--city` names none of the cities found.
    #[error("{} has no city `{city}`; it has {found}", path.display())]
    NoSuchCity {
        /// The path given.
        path: PathBuf,
        /// The city asked for.
        city: String,
        /// Those found, separated by commas.
        found: String,
    },
}

/// A city's image folders.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CityFolder {
    /// `satellite/`, if it exists, or the folder itself if images lie in it.
    pub satellite: Option<PathBuf>,
    /// `panorama/`, if it exists.
    pub panorama: Option<PathBuf>,
}

/// A text file to read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TextFile {
    /// Where it is.
    pub path: PathBuf,
    /// Its path from the root, with `/`: how reports name it.
    pub name: String,
    /// The city of lines that name none; the files of a root have none.
    pub city: Option<String>,
}

/// What a folder holds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Layout {
    /// The folder that split files' paths start from.
    pub root: PathBuf,
    /// Cities with their image folders, by name.
    pub cities: BTreeMap<String, CityFolder>,
    /// Text files, sorted by name.
    pub files: Vec<TextFile>,
    /// The one city that `--city` asks for.
    pub only: Option<String>,
}

impl Layout {
    /// Looks at a root or a city folder. `city` names a city folder's city, or picks one of a
    /// root's; `labels` are more text files to read.
    ///
    /// # Errors
    /// [`LayoutError`] when the folder is missing, unreadable or holds nothing of VIGOR.
    pub fn find(path: &Path, city: Option<&str>, labels: &[PathBuf]) -> Result<Self, LayoutError> {
        let metadata = fs::metadata(path).map_err(|source| match source.kind() {
            io::ErrorKind::NotFound => LayoutError::Missing { path: path.to_owned() },
            _ => LayoutError::Unreadable { path: path.to_owned(), source },
        })?;
        if !metadata.is_dir() {
            return Err(LayoutError::NotAFolder { path: path.to_owned() });
        }
        let city = city.map(canonical_name);
        let folder = Folder::list(path)?;
        let mut layout = if folder.has_images() {
            Self::of_city(path, &folder, city)?
        } else {
            let mut root = Self::of_root(path, &folder)?;
            if root.cities.is_empty() {
                Self::of_city(path, &folder, city)?
            } else {
                if let Some(city) = city {
                    root.keep_only(path, city)?;
                }
                root
            }
        };
        let own_city =
            (layout.cities.len() == 1).then(|| layout.cities.keys().next().cloned()).flatten();
        for label in labels {
            let name = label.to_string_lossy().replace('\\', "/");
            layout.files.push(TextFile { path: label.clone(), name, city: own_city.clone() });
        }
        if layout.files.is_empty() && layout.cities.values().all(CityFolder::is_empty) {
            return Err(LayoutError::Nothing { path: path.to_owned() });
        }
        layout.files.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(layout)
    }

    /// A folder of one city, with labels of its own or in the root's `splits*` folders.
    fn of_city(path: &Path, folder: &Folder, city: Option<String>) -> Result<Self, LayoutError> {
        let real = fs::canonicalize(path)
            .map_err(|source| LayoutError::Unreadable { path: path.to_owned(), source })?;
        let folder_name =
            real.file_name().map_or_else(|| "city".into(), |n| n.to_string_lossy().into_owned());
        let city = city.unwrap_or_else(|| canonical_name(&folder_name));
        let mut layout = Self { root: path.to_owned(), ..Self::default() };
        layout.add_texts(path, folder, "", Some(&city));
        // In VIGOR's own layout a city's labels lie beside its folder.
        if folder.has_images()
            && let Some(root) = real.parent()
        {
            // Paths in split files start from the root.
            layout.root = root.to_owned();
            for splits in Folder::list(root)?.folders.iter().filter(|n| is_splits(n)) {
                let beside = root.join(splits).join(&folder_name);
                if beside.is_dir() {
                    let prefix = format!("../{splits}/{folder_name}/");
                    layout.add_texts(&beside, &Folder::list(&beside)?, &prefix, Some(&city));
                }
            }
        }
        layout.cities.insert(city, folder.images(path));
        Ok(layout)
    }

    /// A root: city folders, `splits*` folders, split files.
    fn of_root(path: &Path, folder: &Folder) -> Result<Self, LayoutError> {
        let mut layout = Self { root: path.to_owned(), ..Self::default() };
        for name in &folder.folders {
            let below = path.join(name);
            let listed = Folder::list(&below)?;
            if is_splits(name) {
                for city_name in &listed.folders {
                    let labels = below.join(city_name);
                    let city = canonical_name(city_name);
                    let prefix = format!("{name}/{city_name}/");
                    layout.add_texts(&labels, &Folder::list(&labels)?, &prefix, Some(&city));
                    layout.cities.entry(city).or_default();
                }
            } else if listed.has_images() || listed.has_labels() {
                let city = canonical_name(name);
                layout.add_texts(&below, &listed, &format!("{name}/"), Some(&city));
                layout.cities.insert(city, listed.images(&below));
            }
        }
        if !layout.cities.is_empty() {
            layout.add_texts(path, folder, "", None);
        }
        Ok(layout)
    }

    fn keep_only(&mut self, path: &Path, city: String) -> Result<(), LayoutError> {
        if !self.cities.contains_key(&city) {
            let found = self.cities.keys().cloned().collect::<Vec<_>>().join(", ");
            return Err(LayoutError::NoSuchCity { path: path.to_owned(), city, found });
        }
        self.cities.retain(|name, _| *name == city);
        self.files.retain(|file| file.city.as_ref().is_none_or(|c| *c == city));
        self.only = Some(city);
        Ok(())
    }

    fn add_texts(&mut self, path: &Path, folder: &Folder, prefix: &str, city: Option<&str>) {
        self.files.extend(folder.texts.iter().map(|name| TextFile {
            path: path.join(name),
            name: format!("{prefix}{name}"),
            city: city.map(str::to_owned),
        }));
    }
}

impl CityFolder {
    /// Whether there are no images.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.satellite.is_none() && self.panorama.is_none()
    }
}

fn is_splits(name: &str) -> bool {
    name == "splits" || name.starts_with("splits_")
}

/// Names in a folder, sorted; those that are not UTF-8 belong to nothing of VIGOR.
#[derive(Default)]
struct Folder {
    folders: Vec<String>,
    texts: Vec<String>,
    /// Whether satellite images lie in the folder itself.
    satellites: bool,
}

impl Folder {
    fn list(path: &Path) -> Result<Self, LayoutError> {
        let failed = |source| LayoutError::Unreadable { path: path.to_owned(), source };
        let mut listed = Self::default();
        for entry in fs::read_dir(path).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            if name.starts_with("satellite_") && !name.ends_with(".txt") {
                // A folder of 20,000 images need not ask about each.
                listed.satellites = true;
                continue;
            }
            // Through links, as a user sees it. What vanished or is a dangling link is not there.
            let Ok(kind) = fs::metadata(entry.path()).map(|m| m.file_type()) else { continue };
            if kind.is_dir() {
                listed.folders.push(name);
            } else if name.to_ascii_lowercase().ends_with(".txt") && !name.starts_with('.') {
                listed.texts.push(name);
            }
        }
        listed.folders.sort();
        listed.texts.sort();
        Ok(listed)
    }

    fn has_images(&self) -> bool {
        self.satellites || self.folders.iter().any(|n| n == "satellite" || n == "panorama")
    }

    fn has_labels(&self) -> bool {
        ["satellite_list", "same_area_balanced", "pano_label"]
            .iter()
            .any(|start| self.texts.iter().any(|name| name.starts_with(start)))
    }

    fn images(&self, path: &Path) -> CityFolder {
        let find = |name: &str| self.folders.iter().any(|n| n == name).then(|| path.join(name));
        let own = || self.satellites.then(|| path.to_owned());
        CityFolder { satellite: find("satellite").or_else(own), panorama: find("panorama") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Makes folders and empty files below a temporary folder.
    fn tree(paths: &[&str]) -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a folder");
        for path in paths {
            let full = root.path().join(path);
            if path.ends_with('/') {
                fs::create_dir_all(full).expect("a folder");
            } else {
                fs::create_dir_all(full.parent().expect("a parent")).expect("a folder");
                fs::write(full, "").expect("a file");
            }
        }
        root
    }

    fn names(layout: &Layout) -> Vec<(&str, Option<&str>)> {
        layout.files.iter().map(|f| (f.name.as_str(), f.city.as_deref())).collect()
    }

    const VIGOR: [&str; 9] = [
        "NewYork/satellite/",
        "NewYork/panorama/",
        "Seattle/satellite/",
        "Seattle/panorama/",
        "Seattle_DSM/x.npz",
        "splits/Seattle/satellite_list.txt",
        "splits__corrected/Chicago/same_area_balanced_train__corrected.txt",
        "splits__corrected/Seattle/same_area_balanced_train__corrected.txt",
        "test_remove_building.txt",
    ];

    #[test]
    fn a_root_has_cities_with_images_labels_or_both() {
        let root = tree(&VIGOR);
        let layout = Layout::find(root.path(), None, &[]).expect("a root");
        assert_eq!(layout.cities.keys().collect::<Vec<_>>(), ["Chicago", "NewYork", "Seattle"]);
        assert!(layout.cities["Chicago"].is_empty());
        assert_eq!(
            names(&layout),
            [
                ("splits/Seattle/satellite_list.txt", Some("Seattle")),
                (
                    "splits__corrected/Chicago/same_area_balanced_train__corrected.txt",
                    Some("Chicago")
                ),
                (
                    "splits__corrected/Seattle/same_area_balanced_train__corrected.txt",
                    Some("Seattle")
                ),
                ("test_remove_building.txt", None),
            ]
        );
        let one = Layout::find(root.path(), Some("seattle"), &[]).expect("a root");
        assert_eq!(one.cities.keys().collect::<Vec<_>>(), ["Seattle"]);
        assert_eq!(one.files.len(), 3);
        assert!(matches!(
            Layout::find(root.path(), Some("Delft"), &[]),
            Err(LayoutError::NoSuchCity { found, .. }) if found == "Chicago, NewYork, Seattle"
        ));
    }

    #[test]
    fn a_city_folder_finds_its_labels_beside_it() {
        let root = tree(&VIGOR);
        let layout = Layout::find(&root.path().join("Seattle"), None, &[]).expect("a city");
        assert_eq!(layout.cities.keys().collect::<Vec<_>>(), ["Seattle"]);
        assert_eq!(
            names(&layout).iter().map(|n| n.0).collect::<Vec<_>>(),
            [
                "../splits/Seattle/satellite_list.txt",
                "../splits__corrected/Seattle/same_area_balanced_train__corrected.txt",
            ]
        );
    }

    #[test]
    fn folders_of_label_files_alone() {
        let root = tree(&["seattle/satellite_list.txt", "seattle/notes.md"]);
        let bare = Layout::find(&root.path().join("seattle"), None, &[]).expect("a city");
        assert_eq!(names(&bare), [("satellite_list.txt", Some("Seattle"))]);
        let above = Layout::find(root.path(), None, &[]).expect("a root of one city");
        assert_eq!(names(&above), [("seattle/satellite_list.txt", Some("Seattle"))]);
        let named = Layout::find(&root.path().join("seattle"), Some("Delft"), &[]).expect("a city");
        assert_eq!(named.cities.keys().collect::<Vec<_>>(), ["Delft"]);
    }

    #[test]
    fn images_may_lie_in_the_city_folder_itself() {
        let root = tree(&["Delft/satellite_52.0_4.36.png"]);
        let delft = root.path().join("Delft");
        let layout = Layout::find(&delft, None, &[]).expect("a city");
        assert_eq!(layout.cities["Delft"].satellite, Some(delft));
    }

    #[test]
    fn folders_that_hold_nothing_say_so() {
        let root = tree(&["a/b/", "file.md"]);
        let find = |path: &Path| Layout::find(path, None, &[]);
        assert!(matches!(find(root.path()), Err(LayoutError::Nothing { .. })));
        assert!(matches!(find(&root.path().join("none")), Err(LayoutError::Missing { .. })));
        assert!(matches!(find(&root.path().join("file.md")), Err(LayoutError::NotAFolder { .. })));
    }
}
