//! What is in a checkpoint: modules, parameters, hashes; and all that is wrong with one.

use super::expected::own_buffer;
use super::{Checkpoint, MappedFile, Need, WEIGHTS_FILE, compare, expected, locate};
use crate::config::{Config, RELEASED};
use crate::error::ModelError;
use serde::Serialize;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::{self, Write as _};
use std::path::{Path, PathBuf};

/// Prefixes of the modules, in the order in which an image passes them.
const MODULES: [&str; 7] = [
    "unet.",
    "unet_model.dino_model.",
    "unet_model.decoder.",
    "mlp.",
    "sky_mapping.",
    "sky_decoder.",
    "sr_module.",
];

/// One module of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ModuleSummary {
    /// Prefix of its keys, without the last dot.
    pub name: String,
    /// Number of tensors that are parameters.
    pub tensors: usize,
    /// Number of parameters.
    pub parameters: u64,
    /// Bytes of their values in the file.
    pub bytes: u64,
    /// Element types found, as `F32`.
    pub elements: Vec<String>,
    /// SHA-256 over its tensors in order of their keys: key, a zero byte, dimensions as little-endian
    /// u64, then the bytes as stored. Says which module two checkpoints share, whatever the file's
    /// layout.
    pub sha256: String,
}

/// A checkpoint, described.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Inspection {
    /// The folder with the `config.json`.
    pub folder: PathBuf,
    /// Class named in the config.
    pub class_name: String,
    /// Size of the weights' file.
    pub bytes: u64,
    /// SHA-256 of the weights' file, as `sha256sum` prints it.
    pub sha256: String,
    /// Parameters of all modules.
    pub parameters: u64,
    /// The modules.
    pub modules: Vec<ModuleSummary>,
    /// Buffers, which are constants and not counted.
    pub buffers: Vec<String>,
    /// Parameters that the config's network has and the file may lack, and does.
    pub absent: Vec<String>,
    /// Tensors that are there and that no output depends on: parameters of a part that the config
    /// leaves out, the encoder's mask token, the buffer of another representation.
    pub left_over: Vec<String>,
}

/// Describes a checkpoint; reads the whole file twice.
#[must_use]
pub fn inspect(checkpoint: &Checkpoint) -> Inspection {
    inspect_with(checkpoint, &|_| ())
}

/// As [`inspect`]; `each` is told of every number of bytes that were hashed, from two threads. They
/// add up to at most twice the size of the file.
#[must_use]
pub fn inspect_with(checkpoint: &Checkpoint, each: &(dyn Fn(u64) + Sync)) -> Inspection {
    let file = checkpoint.file();
    let (sha256, modules) =
        rayon::join(|| file_hash(file, each), || module_summaries(checkpoint, each));
    let specs = expected(checkpoint.config());
    let of_need = |need| -> BTreeSet<&str> {
        specs.iter().filter(|spec| spec.need == need).map(|spec| spec.key.as_str()).collect()
    };
    let (buffers, optional) = (of_need(Need::Buffer), of_need(Need::Optional));
    let present: BTreeSet<&str> = file.keys().collect();

    Inspection {
        folder: checkpoint.folder().into(),
        class_name: checkpoint.config().class_name.clone(),
        bytes: file.bytes().len() as u64,
        sha256,
        parameters: modules.iter().map(|module| module.parameters).sum(),
        modules,
        buffers: buffers.intersection(&present).map(ToString::to_string).collect(),
        absent: optional.difference(&present).map(ToString::to_string).collect(),
        left_over: optional
            .iter()
            .chain(buffers.iter().filter(|key| **key != own_buffer(checkpoint.config())))
            .filter(|key| present.contains(*key))
            .map(ToString::to_string)
            .collect(),
    }
}

/// Bytes that are hashed, then given back, at a time.
const CHUNK: usize = 1 << 24;

fn file_hash(file: &MappedFile, each: &(dyn Fn(u64) + Sync)) -> String {
    let mut hash = Sha256::new();
    for chunk in file.bytes().chunks(CHUNK) {
        hash.update(chunk);
        file.release(chunk);
        each(chunk.len() as u64);
    }
    hex(&hash.finalize())
}

fn module_summaries(checkpoint: &Checkpoint, each: &(dyn Fn(u64) + Sync)) -> Vec<ModuleSummary> {
    let file = checkpoint.file();
    // Buffers have no module: none of their keys begins as one.
    let present: BTreeSet<&str> = file.keys().collect();
    let mut modules = Vec::new();
    for prefix in MODULES {
        let mut hash = Sha256::new();
        let (mut parameters, mut bytes) = (0, 0);
        let mut elements = BTreeSet::new();
        let mut tensors = 0;
        for key in present.iter().filter(|key| key.starts_with(prefix)) {
            let (Some(shape), Some(raw)) = (file.shape(key), file.raw(key)) else { continue };
            tensors += 1;
            parameters += shape.iter().map(|&side| side as u64).product::<u64>();
            elements.insert(file.element(key).unwrap_or_default());
            hash.update(key.as_bytes());
            hash.update([0]);
            for &side in shape {
                hash.update((side as u64).to_le_bytes());
            }
            bytes += raw.len() as u64;
            for chunk in raw.chunks(CHUNK) {
                hash.update(chunk);
                file.release(chunk);
                each(chunk.len() as u64);
            }
        }
        if tensors > 0 {
            modules.push(ModuleSummary {
                name: prefix.trim_end_matches('.').into(),
                tensors,
                parameters,
                bytes,
                elements: elements.into_iter().collect(),
                sha256: hex(&hash.finalize()),
            });
        }
    }
    modules
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// All that keeps a folder from being a checkpoint that is served. Never empty.
#[derive(Debug)]
pub struct Problems {
    /// The folder that was examined.
    pub folder: PathBuf,
    /// One error each, in the order in which they were met.
    pub problems: Vec<ModelError>,
}

impl fmt::Display for Problems {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let [only] = self.problems.as_slice() {
            return write!(formatter, "{only}");
        }
        write!(formatter, "{}: {} problems:", self.folder.display(), self.problems.len())?;
        for (index, problem) in self.problems.iter().enumerate() {
            // An error of several lines stays under its number.
            let text = problem.to_string().replace('\n', "\n     ");
            write!(formatter, "\n  {}. {text}", index + 1)?;
        }
        Ok(())
    }
}

impl std::error::Error for Problems {}

/// Opens a checkpoint as [`Checkpoint::open`] does, and where that fails goes on to find everything
/// else that is wrong: every switch that is not served, not only the first, and the weights' file
/// besides. Tensors are held against the config only where the config describes a network that is
/// served: against another one, nearly all of them would be wrong.
///
/// # Errors
/// [`Problems`], with all of them.
pub fn examine(folder: &Path) -> Result<Checkpoint, Problems> {
    let fail = |problems| Err(Problems { folder: folder.into(), problems });
    let place = match locate(folder) {
        Ok(place) => place,
        Err(error) => return fail(vec![error]),
    };
    let (config, mut problems) = examine_config(&place);
    let whole_network = problems.iter().all(|error| matches!(error, ModelError::ClassName { .. }));
    let file = MappedFile::open(&place.join(WEIGHTS_FILE)).map_err(|error| problems.push(error));
    if let (Ok(file), Some(config), true) = (&file, &config, whole_network) {
        let mismatch = compare(&expected(config), file);
        if !mismatch.is_empty() {
            let path = file.path().into();
            problems.push(ModelError::Tensors { path, mismatch: Box::new(mismatch) });
        }
    }
    match (config, file, problems.is_empty()) {
        (Some(config), Ok(file), true) => {
            let path = place.join("config.json");
            match std::fs::read_to_string(&path) {
                Ok(config_text) => {
                    Ok(Checkpoint { folder: place, config_text, config, file, packed: None })
                }
                Err(source) => fail(vec![ModelError::Io { path, source }]),
            }
        }
        _ => fail(problems),
    }
}

/// The config and all its errors. Each value that is refused is replaced by the released one, or by
/// its default, and the reading begins again; so one error does not hide the next.
fn examine_config(place: &Path) -> (Option<Config>, Vec<ModelError>) {
    let first = match Config::from_folder(place) {
        Ok(config) => return (Some(config), Vec::new()),
        Err(error) => error,
    };
    let path = place.join("config.json");
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    // Not JSON, or not to be read: there is no more to find.
    let Ok(mut root) = serde_json::from_str::<Value>(&text) else { return (None, vec![first]) };
    let mut problems = Vec::new();
    let released: Value = serde_json::from_str(RELEASED).unwrap_or(Value::Null);
    let origin = path.display().to_string();
    let mut seen = BTreeSet::new();
    loop {
        let text = root.to_string();
        let error = match Config::from_json(&text) {
            Ok(config) => return (Some(config), problems),
            Err(error) => error,
        };
        let (error, key) = match error {
            ModelError::ClassName { found, .. } => {
                (ModelError::ClassName { origin: origin.clone(), found }, "_class_name".to_owned())
            }
            ModelError::Unsupported { ref key, .. } | ModelError::InvalidConfig { ref key, .. } => {
                let key = key.clone();
                (error, key)
            }
            ModelError::ConfigSyntax { message, .. } => {
                problems.push(ModelError::ConfigSyntax { origin, message });
                return (None, problems);
            }
            other => {
                problems.push(other);
                return (None, problems);
            }
        };
        problems.push(error);
        // A value that stays wrong after it was replaced contradicts another one.
        if !seen.insert(key.clone()) || !replace(&mut root, &released, &key) {
            return (None, problems);
        }
    }
}

/// Sets the value at a path of keys (`opt.network.sr_factor`) to that of `source`, or takes it out
/// where `source` has none. Whether there was an object to change.
fn replace(root: &mut Value, source: &Value, path: &str) -> bool {
    let keys: Vec<&str> = path.split('.').collect();
    let Some((last, parents)) = keys.split_last() else { return false };
    let mut target = root;
    let mut from = Some(source);
    for key in parents {
        let Some(next) = target.get_mut(key) else { return false };
        target = next;
        from = from.and_then(|value| value.get(key));
    }
    let Some(object) = target.as_object_mut() else { return false };
    match from.and_then(|value| value.get(last)) {
        Some(value) => {
            object.insert((*last).to_owned(), value.clone());
        }
        None => {
            object.remove(*last);
        }
    }
    true
}
