//! Where a model's weights are: `--weights`, `SAT3D_WEIGHTS`, the cache of the Hugging Face hub, and last
//! the small model inside the program.
//!
//! The first of these that there is counts. If it holds no checkpoint, that is an error: weights that
//! somebody named are never silently replaced by others.

pub mod cache;
pub mod export;
#[cfg(feature = "fetch")]
pub mod fetch;
mod identity;

pub use identity::{Identity, whole_hash};

use cache::Cache;
use sat3d_model::weights::{BuiltIn, MINI, WEIGHTS_FILE, locate};
use sat3d_model::{Checkpoint, ModelError};
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Repository of the released weights on the Hugging Face hub.
pub const REPOSITORY: &str = "qian43/Sat3DGen";
/// Branch of [`REPOSITORY`] that is looked for in the cache.
pub const REVISION: &str = "main";
/// Environment variable that names a checkpoint folder.
pub const VARIABLE: &str = "SAT3D_WEIGHTS";
/// Levels of folders below a given one in which a checkpoint is looked for.
const LEVELS: usize = 2;

/// A checkpoint folder, and who named it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Weights {
    /// The folder that holds `config.json` and the weights' file, or `built-in:<name>`.
    pub folder: PathBuf,
    /// How it was found.
    pub origin: Origin,
}

/// How weights were found; part of a manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "from", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Origin {
    /// `--weights`.
    Argument,
    /// `SAT3D_WEIGHTS`.
    Environment,
    /// The cache of the Hugging Face hub.
    Cache {
        /// Name on the hub, as `qian43/Sat3DGen`.
        repository: String,
        /// The commit, 40 hexadecimal digits.
        revision: String,
    },
    /// Inside the program: nothing else was given, or it was asked for.
    BuiltIn {
        /// Its name.
        name: String,
    },
}

impl Weights {
    /// Opens them.
    ///
    /// # Errors
    /// Those of [`Checkpoint::open`].
    pub fn open(&self) -> Result<Checkpoint, ModelError> {
        Checkpoint::at(&self.folder)
    }

    /// The same, of which networks keep their packed weights below a folder, if there is one.
    ///
    /// # Errors
    /// Those of [`Checkpoint::open`] and [`Checkpoint::keep_packed`].
    pub fn open_keeping(&self, packed: Option<&Path>) -> Result<Checkpoint, ModelError> {
        let checkpoint = self.open()?;
        match packed {
            Some(folder) => checkpoint.keep_packed(folder),
            None => Ok(checkpoint),
        }
    }

    /// What a user should know about them.
    #[must_use]
    pub fn note(&self) -> Option<String> {
        let Origin::BuiltIn { name } = &self.origin else { return None };
        Some(format!(
            "the small built-in model `{name}` is used: it learnt from simulated cities, and its heights \
             on real images are indicative; `sat3d model fetch` gets the released one"
        ))
    }

    fn built_in(model: &BuiltIn) -> Self {
        let origin = Origin::BuiltIn { name: model.name.into() };
        Self { folder: model.place().into(), origin }
    }
}

/// Why no weights were found. Each says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WeightsError {
    /// Nothing was given and the cache has nothing.
    #[error(
        "no weights: {looked}. Three ways to have some: `sat3d model fetch` downloads \
         {REPOSITORY}; --weights DIR names a checkpoint folder; so does the environment variable \
         {VARIABLE}"
    )]
    None {
        /// Where the cache was looked for.
        looked: String,
    },
    /// A place that was given holds no checkpoint.
    #[error(
        "{by} {}: no checkpoint here: {why}; wanted is a folder with config.json and \
         {WEIGHTS_FILE}, or one that holds such a folder",
        place.display()
    )]
    NotHere {
        /// `--weights` or `SAT3D_WEIGHTS`.
        by: &'static str,
        /// As given.
        place: PathBuf,
        /// What was looked for.
        why: String,
    },
    /// A place that was given holds several checkpoints.
    #[error("{by} {}: {} checkpoints here; name one of:{}", place.display(), found.len(), listed(found))]
    Several {
        /// `--weights`, `SAT3D_WEIGHTS`, or the cache.
        by: &'static str,
        /// As given.
        place: PathBuf,
        /// All of them.
        found: Vec<PathBuf>,
    },
    /// The cache has the repository, and no whole checkpoint in it.
    #[error(
        "{}: the cache has {repository} at {revision}, and no checkpoint in it: {why}; \
         `sat3d model fetch` completes it",
        snapshot.display()
    )]
    Incomplete {
        /// Name on the hub.
        repository: String,
        /// The commit.
        revision: String,
        /// The folder of that commit in the cache.
        snapshot: PathBuf,
        /// What is missing.
        why: String,
    },
    /// A file of the cache cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
}

fn listed(folders: &[PathBuf]) -> String {
    folders.iter().map(|folder| format!("\n  {}", folder.display())).collect()
}

/// Finds weights: those of `argument` (`--weights`), else of `SAT3D_WEIGHTS`, else the snapshot of
/// [`REPOSITORY`] in the cache of the Hugging Face hub, else the small model inside the program
/// ([`MINI`]). An empty variable counts as not set.
///
/// A place is a checkpoint folder, a training checkpoint (see [`locate`]), a folder with exactly one
/// of those up to two levels below it, a file of a checkpoint folder, or a repository's folder in a
/// cache; `built-in:mini` is the model inside the program. Only names are looked at; [`Weights::open`]
/// reads the files.
///
/// # Errors
/// [`WeightsError::NotHere`] and [`WeightsError::Several`] for a place that was given;
/// [`WeightsError::Incomplete`] for a cache without the files.
pub fn find(argument: Option<&Path>) -> Result<Weights, WeightsError> {
    or_built_in(find_given(argument))
}

/// As [`find`], without the model inside the program unless it is asked for.
///
/// # Errors
/// As [`find`]; [`WeightsError::None`] where nothing is given and the cache has nothing.
pub fn find_given(argument: Option<&Path>) -> Result<Weights, WeightsError> {
    find_in(argument, &|name| std::env::var_os(name))
}

fn or_built_in(found: Result<Weights, WeightsError>) -> Result<Weights, WeightsError> {
    match found {
        Err(WeightsError::None { .. }) => Ok(Weights::built_in(&MINI)),
        found => found,
    }
}

/// As [`find_given`], with the environment given.
fn find_in(
    argument: Option<&Path>,
    environment: &dyn Fn(&str) -> Option<OsString>,
) -> Result<Weights, WeightsError> {
    let variable = environment(VARIABLE).filter(|value| !value.is_empty()).map(PathBuf::from);
    let given = match (argument, &variable) {
        (Some(place), _) => Some(("--weights", place, Origin::Argument)),
        (None, Some(place)) => Some((VARIABLE, place.as_path(), Origin::Environment)),
        (None, None) => None,
    };
    if let Some((by, place, origin)) = given {
        if let Some(model) = BuiltIn::at(place) {
            return Ok(Weights::built_in(model));
        }
        return match below(place) {
            Ok(folder) => Ok(Weights { folder, origin }),
            Err(Below::Nothing(why)) => Err(WeightsError::NotHere { by, place: place.into(), why }),
            Err(Below::Several(found)) => {
                Err(WeightsError::Several { by, place: place.into(), found })
            }
        };
    }
    let Some(cache) = Cache::from_variables(environment) else {
        let looked = "no home folder is known, so there is no cache of the Hugging Face hub";
        return Err(WeightsError::None { looked: looked.into() });
    };
    in_cache(&cache)
}

/// The checkpoint of [`REPOSITORY`] in a cache.
///
/// # Errors
/// As [`find`] for the cache.
pub fn in_cache(cache: &Cache) -> Result<Weights, WeightsError> {
    let repository = cache.repository(REPOSITORY);
    let commit = repository
        .commit(REVISION)
        .map_err(|source| WeightsError::Io { path: repository.reference(REVISION), source })?;
    let Some(revision) = commit else {
        let looked = format!(
            "none in the cache ({} does not exist)",
            repository.reference(REVISION).display()
        );
        return Err(WeightsError::None { looked });
    };
    let snapshot = repository.snapshot(&revision);
    match below(&snapshot) {
        Ok(folder) => Ok(Weights {
            folder,
            origin: Origin::Cache { repository: REPOSITORY.into(), revision },
        }),
        Err(Below::Nothing(why)) => {
            Err(WeightsError::Incomplete { repository: REPOSITORY.into(), revision, snapshot, why })
        }
        Err(Below::Several(found)) => {
            Err(WeightsError::Several { by: "the cache,", place: snapshot, found })
        }
    }
}

/// Why a place names no checkpoint.
enum Below {
    Nothing(String),
    Several(Vec<PathBuf>),
}

/// The checkpoint that a place stands for.
fn below(place: &Path) -> Result<PathBuf, Below> {
    let is_part = |name: &std::ffi::OsStr| name == WEIGHTS_FILE || name == "config.json";
    let file = place.is_file() && place.file_name().is_some_and(is_part);
    let place = match place.parent() {
        Some(parent) if file && parent.as_os_str().is_empty() => Path::new("."),
        Some(parent) if file => parent,
        _ => place,
    };
    let why = match locate(place) {
        Ok(folder) => return Ok(folder),
        Err(ModelError::NoCheckpoint { why, .. }) => why,
        Err(other) => other.to_string(),
    };
    if !place.is_dir() {
        let why = if place.exists() { "not a folder" } else { "there is no such folder" };
        return Err(Below::Nothing(why.into()));
    }
    if let Some(snapshot) = cache::only_snapshot(place) {
        return below(&snapshot);
    }
    let mut found = Vec::new();
    search(place, LEVELS, &mut found);
    match found.len() {
        0 => Err(Below::Nothing(format!("{why}, nor in folders up to {LEVELS} levels below"))),
        1 => Ok(found.remove(0)),
        _ => Err(Below::Several(found)),
    }
}

/// Collects the checkpoints in the folders of `folder`, in order of their names.
fn search(folder: &Path, levels: usize, found: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    let hidden = |path: &PathBuf| {
        path.file_name().is_none_or(|name| name.as_encoded_bytes().starts_with(b"."))
    };
    let mut folders: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.is_dir() && !hidden(path))
        .collect();
    folders.sort_unstable();
    for folder in folders {
        match locate(&folder) {
            Ok(checkpoint) => found.push(checkpoint),
            Err(_) if levels > 1 => search(&folder, levels - 1, found),
            Err(_) => {}
        }
    }
}

#[cfg(test)]
mod tests;
