//! What in a folder can be shown.

use super::ViewerError;
use serde::Serialize;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// How many folders below the given one are looked into.
const LEVELS: usize = 4;
/// More items than this are not listed; the rest is warned about.
const MOST_ITEMS: usize = 1000;
/// The first bytes of binary glTF.
const GLB: &[u8; 4] = b"glTF";

/// What an item is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ItemKind {
    /// A 3D Tiles tileset (its tileset.json).
    Tileset,
    /// A mesh in one binary glTF file.
    Mesh,
}

/// Something that can be shown.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Item {
    /// What it is.
    pub kind: ItemKind,
    /// How people call it: the tileset's folder or the mesh's file, relative to what was asked for.
    pub name: String,
    /// Its file, relative to the root, with `/` between folders.
    pub path: String,
    /// Size of that file, bytes (a tileset's tiles not counted).
    pub bytes: u64,
}

/// What is shown out of a folder, and what may be read of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contents {
    /// The folder, without links or `..` in its path.
    root: PathBuf,
    /// The only file that may be read, relative to the root, where one mesh was asked for.
    only: Option<String>,
    /// Tilesets first, each kind by name; never empty.
    items: Vec<Item>,
    /// What was left out of the list, and why.
    warnings: Vec<String>,
}

impl Contents {
    /// Looks for tilesets and meshes at `path`: a folder with a tileset.json (or that file), a .glb file, or a
    /// folder in which such are found, up to four folders deep. Tiles of a tileset are no items of their own.
    ///
    /// # Errors
    /// There is nothing at the path or nothing that can be shown; what was asked for by its own name is broken.
    pub fn find(path: &Path) -> Result<Self, ViewerError> {
        let read = |source| ViewerError::Read { path: path.to_owned(), source };
        let real = match fs::canonicalize(path) {
            Ok(real) => real,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Err(ViewerError::Missing { path: path.to_owned() });
            }
            Err(source) => return Err(read(source)),
        };
        if real.is_dir() {
            return Self::of_folder(path, real);
        }
        let name = real.file_name().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
        let root = real.parent().unwrap_or(&real).to_owned();
        if name == "tileset.json" {
            let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty());
            return Self::of_folder(folder.unwrap_or(Path::new(".")), root);
        }
        if !is_glb(&name) {
            return Err(ViewerError::NotShown { path: path.to_owned() });
        }
        check_glb(&real)?;
        let bytes = fs::metadata(&real).map_err(read)?.len();
        let item = Item { kind: ItemKind::Mesh, name: name.clone(), path: name.clone(), bytes };
        Ok(Self { root, only: Some(name), items: vec![item], warnings: Vec::new() })
    }

    fn of_folder(asked: &Path, root: PathBuf) -> Result<Self, ViewerError> {
        let tileset = root.join("tileset.json");
        if tileset.is_file() {
            check_tileset(&tileset)?;
        }
        let mut contents = Self { root, only: None, items: Vec::new(), warnings: Vec::new() };
        let mut broken = None;
        contents
            .look(&contents.root.clone(), "", 0, &mut broken)
            .map_err(|source| ViewerError::Read { path: asked.to_owned(), source })?;
        contents.items.sort_by(|a, b| {
            (a.kind != ItemKind::Tileset, &a.path).cmp(&(b.kind != ItemKind::Tileset, &b.path))
        });
        if contents.items.is_empty() {
            return Err(
                broken.unwrap_or(ViewerError::Empty { path: asked.to_owned(), levels: LEVELS })
            );
        }
        if contents.items.len() > MOST_ITEMS {
            let more = contents.items.len() - MOST_ITEMS;
            contents.items.truncate(MOST_ITEMS);
            contents.warnings.push(format!(
                "{more} more tilesets and meshes are not listed; give one of the folders inside"
            ));
        }
        Ok(contents)
    }

    /// Adds the items of one folder and those below it. Folders that cannot be read and broken items become
    /// warnings (the first broken item also goes to `broken`), but for the folder that was asked for.
    fn look(
        &mut self,
        folder: &Path,
        relative: &str,
        level: usize,
        broken: &mut Option<ViewerError>,
    ) -> io::Result<()> {
        let tileset = folder.join("tileset.json");
        if tileset.is_file() {
            let name = if relative.is_empty() { "tileset" } else { relative.trim_end_matches('/') };
            let path = format!("{relative}tileset.json");
            self.add(ItemKind::Tileset, name.to_owned(), path, &tileset, broken);
            return Ok(());
        }
        let mut entries = fs::read_dir(folder)?.collect::<io::Result<Vec<_>>>()?;
        entries.sort_by_key(fs::DirEntry::file_name);
        for entry in entries {
            let Ok(name) = entry.file_name().into_string() else {
                self.warnings.push(format!("{}: a name that is not UTF-8", entry.path().display()));
                continue;
            };
            if name.starts_with('.') {
                continue;
            }
            let path = entry.path();
            // Links to folders are not followed here: they may go round in circles.
            if entry.file_type()?.is_dir() {
                if level < LEVELS {
                    let below = format!("{relative}{name}/");
                    if let Err(error) = self.look(&path, &below, level + 1, broken) {
                        self.warnings.push(format!("cannot read {}: {error}", path.display()));
                    }
                }
            } else if is_glb(&name) && path.is_file() {
                let relative = format!("{relative}{name}");
                self.add(ItemKind::Mesh, relative.clone(), relative, &path, broken);
            }
        }
        Ok(())
    }

    fn add(
        &mut self,
        kind: ItemKind,
        name: String,
        path: String,
        file: &Path,
        broken: &mut Option<ViewerError>,
    ) {
        let checked = match kind {
            ItemKind::Tileset => check_tileset(file),
            ItemKind::Mesh => check_glb(file),
        };
        match checked {
            Ok(bytes) => self.items.push(Item { kind, name, path, bytes }),
            Err(error) => {
                self.warnings.push(format!("left out: {error}"));
                broken.get_or_insert(error);
            }
        }
    }

    /// The folder that is served, without links or `..` in its path.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What can be shown: tilesets first, each kind by name; never empty.
    #[must_use]
    pub fn items(&self) -> &[Item] {
        &self.items
    }

    /// What was left out of the list, and why.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Whether a file (relative, with `/` between folders) may be read.
    pub(super) fn allows(&self, relative: &str) -> bool {
        self.only.as_ref().is_none_or(|only| only == relative)
    }
}

fn is_glb(name: &str) -> bool {
    Path::new(name).extension().is_some_and(|extension| extension.eq_ignore_ascii_case("glb"))
}

/// Size of a file that looks like a tileset, bytes.
fn check_tileset(file: &Path) -> Result<u64, ViewerError> {
    let broken = |problem| ViewerError::Broken { path: file.to_owned(), problem };
    let bytes =
        fs::read(file).map_err(|source| ViewerError::Read { path: file.to_owned(), source })?;
    let value: serde_json::Value = serde_json::from_slice(&bytes)
        .map_err(|error| broken(format!("no JSON, so no tileset: {error}; write it again")))?;
    for key in ["asset", "root"] {
        if !value.get(key).is_some_and(serde_json::Value::is_object) {
            return Err(broken(format!("JSON without `{key}`, so no 3D Tiles tileset")));
        }
    }
    Ok(bytes.len() as u64)
}

/// Size of a file that begins like binary glTF 2 and is as long as it says, bytes.
fn check_glb(file: &Path) -> Result<u64, ViewerError> {
    let read = |source| ViewerError::Read { path: file.to_owned(), source };
    let broken = |problem| Err(ViewerError::Broken { path: file.to_owned(), problem });
    let mut open = File::open(file).map_err(read)?;
    let bytes = open.metadata().map_err(read)?.len();
    let mut head = [0; 12];
    match open.read_exact(&mut head) {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
            return broken(format!("{bytes} bytes, too short for binary glTF; write it again"));
        }
        outcome => outcome.map_err(read)?,
    }
    let number =
        |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    if &head[..4] != GLB || number(4) != 2 {
        return broken("does not begin like binary glTF 2, whatever its name says".to_owned());
    }
    if u64::from(number(8)) > bytes {
        return broken(format!("cut off: {bytes} of {} bytes; write it again", number(8)));
    }
    Ok(bytes)
}
