//! Which weights were used, told apart without reading 1.5 GB.

use crate::model::Checkpoint;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Bytes of each tensor that go into the sampled hash.
const SAMPLE: usize = 4096;

/// What tells a checkpoint from others; part of the plan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// Class named in the config.
    pub class_name: String,
    /// Size of the weights' file.
    pub bytes: u64,
    /// SHA-256 over the config, the header of the weights' file, and the first 4096 bytes of every
    /// tensor in the order of their keys. Training moves every tensor, so that two stages of one
    /// training differ.
    pub sampled_sha256: String,
}

impl Identity {
    /// Of an open checkpoint; reads a few megabytes.
    #[must_use]
    pub fn of(checkpoint: &Checkpoint) -> Self {
        let config = checkpoint.config_text().as_bytes();
        let file = checkpoint.file();
        let bytes = file.bytes();
        // Eight bytes of length, then the header itself.
        let length = bytes.first_chunk::<8>().map_or(0, |length| u64::from_le_bytes(*length));
        let header = usize::try_from(length).unwrap_or(usize::MAX).saturating_add(8);
        let mut hash = Sha256::new();
        hash.update((config.len() as u64).to_le_bytes());
        hash.update(config);
        hash.update(&bytes[..header.min(bytes.len())]);
        let mut keys: Vec<&str> = file.keys().collect();
        keys.sort_unstable();
        for raw in keys.into_iter().filter_map(|key| file.raw(key)) {
            hash.update(&raw[..raw.len().min(SAMPLE)]);
        }
        Self {
            class_name: checkpoint.config().class_name.clone(),
            bytes: bytes.len() as u64,
            sampled_sha256: crate::plan::hex(&hash.finalize()),
        }
    }
}

/// SHA-256 of the whole weights' file, as `sha256sum` prints it.
#[must_use]
pub fn whole_hash(checkpoint: &Checkpoint) -> String {
    crate::plan::hex(&Sha256::digest(checkpoint.file().bytes()))
}
