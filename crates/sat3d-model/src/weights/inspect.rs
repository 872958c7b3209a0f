//! What is in a checkpoint: modules, parameters, hashes.

use super::{Checkpoint, Need, expected};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::PathBuf;

/// Prefixes of the modules, in the order in which an image passes them.
const MODULES: [&str; 6] = [
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
}

/// Describes a checkpoint; reads the whole file twice.
#[must_use]
pub fn inspect(checkpoint: &Checkpoint) -> Inspection {
    let file = checkpoint.file();
    let specs = expected(checkpoint.config());
    let of_need = |need| -> BTreeSet<&str> {
        specs.iter().filter(|spec| spec.need == need).map(|spec| spec.key.as_str()).collect()
    };
    let (buffers, optional) = (of_need(Need::Buffer), of_need(Need::Optional));
    let present: BTreeSet<&str> = file.keys().collect();

    let mut modules = Vec::new();
    for prefix in MODULES {
        let mut hash = Sha256::new();
        let mut parameters = 0;
        let mut elements = BTreeSet::new();
        let mut tensors = 0;
        for key in present.iter().filter(|key| key.starts_with(prefix) && !buffers.contains(*key)) {
            let (Some(shape), Some(raw)) = (file.shape(key), file.raw(key)) else { continue };
            tensors += 1;
            parameters += shape.iter().map(|&side| side as u64).product::<u64>();
            elements.insert(file.element(key).unwrap_or_default());
            hash.update(key.as_bytes());
            hash.update([0]);
            for &side in shape {
                hash.update((side as u64).to_le_bytes());
            }
            hash.update(raw);
            file.release(raw);
        }
        if tensors > 0 {
            modules.push(ModuleSummary {
                name: prefix.trim_end_matches('.').into(),
                tensors,
                parameters,
                elements: elements.into_iter().collect(),
                sha256: hex(&hash.finalize()),
            });
        }
    }
    let mut hash = Sha256::new();
    for chunk in file.bytes().chunks(1 << 24) {
        hash.update(chunk);
        file.release(chunk);
    }
    Inspection {
        folder: checkpoint.folder().into(),
        class_name: checkpoint.config().class_name.clone(),
        bytes: file.bytes().len() as u64,
        sha256: hex(&hash.finalize()),
        parameters: modules.iter().map(|module| module.parameters).sum(),
        modules,
        buffers: buffers.intersection(&present).map(ToString::to_string).collect(),
        absent: optional.difference(&present).map(ToString::to_string).collect(),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
