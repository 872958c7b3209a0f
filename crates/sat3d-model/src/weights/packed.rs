//! Weights in an engine's own packing, kept on disk: packing the large network for Winograd's convolutions takes
//! seconds, reading the result a fraction of one.
//!
//! One folder belongs to one weights file, by path, size, time and header, and one file in it to one tensor packed for
//! one use. A file that is cut off, damaged or of another use is as good as none: the tensor is packed again.

use super::MappedFile;
use crate::error::ModelError;
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::UNIX_EPOCH;

/// First bytes of a file.
const MAGIC: &[u8; 16] = b"sat3d packed 1\n\0";
/// Bytes that are read and written at once.
const CHUNK: usize = 1 << 20;

/// Packed weights of one file.
#[derive(Debug)]
pub struct PackedWeights {
    folder: PathBuf,
    /// Files that were read and that were written.
    counts: [AtomicU64; 2],
    failure: Mutex<Option<String>>,
}

impl PackedWeights {
    /// Those of a weights file, in a folder of their own below `cache`, which is made when something is kept.
    ///
    /// # Errors
    /// [`ModelError::Io`] where the weights' time cannot be read.
    pub fn of(weights: &MappedFile, cache: &Path) -> Result<Self, ModelError> {
        let path = fs::canonicalize(weights.path()).map_err(ModelError::io(weights.path()))?;
        let metadata = fs::metadata(&path).map_err(ModelError::io(&path))?;
        let time = metadata.modified().map_err(ModelError::io(&path))?;
        let time = time.duration_since(UNIX_EPOCH).unwrap_or_default();
        let mut hash = Sha256::new();
        hash.update(path.as_os_str().as_encoded_bytes());
        hash.update(metadata.len().to_le_bytes());
        hash.update(time.as_nanos().to_le_bytes());
        hash.update(weights.header());
        Ok(Self::in_folder(cache.join(name_of(&hash.finalize()))))
    }

    pub(crate) fn in_folder(folder: PathBuf) -> Self {
        Self { folder, counts: Default::default(), failure: Mutex::default() }
    }

    /// Fills `into` with what was kept of a tensor for a use; whether there was such a file, whole and of this length.
    pub fn recall(&self, key: &str, layout: &[u8], into: &mut [f32]) -> bool {
        let found = read(&self.file(key, layout), into).unwrap_or(false);
        self.counts[0].fetch_add(u64::from(found), Ordering::Relaxed);
        found
    }

    /// Keeps a tensor packed for a use. That it cannot be kept stops nothing; [`PackedWeights::failure`] has the
    /// reason.
    pub fn keep(&self, key: &str, layout: &[u8], values: &[f32]) {
        let path = self.file(key, layout);
        match write(&path, values) {
            Ok(()) => {
                self.counts[1].fetch_add(1, Ordering::Relaxed);
            }
            Err(error) => {
                let mut failure =
                    self.failure.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                failure.get_or_insert_with(|| format!("{}: {error}", path.display()));
            }
        }
    }

    /// Tensors that were found and that were written.
    #[must_use]
    pub fn counts(&self) -> [u64; 2] {
        [0, 1].map(|k| self.counts[k].load(Ordering::Relaxed))
    }

    /// Why something could not be kept.
    #[must_use]
    pub fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }

    fn file(&self, key: &str, layout: &[u8]) -> PathBuf {
        let mut hash = Sha256::new();
        hash.update(key.as_bytes());
        hash.update([0]);
        hash.update(layout);
        self.folder.join(format!("{}.packed", name_of(&hash.finalize())))
    }
}

/// The first 128 bits, as hexadecimal digits.
fn name_of(hash: &[u8]) -> String {
    hash[..16].iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A sum over values that changes with each of them and with their order.
struct Sum([u64; 8]);

impl Sum {
    const fn new() -> Self {
        Self([0xcbf2_9ce4_8422_2325; 8])
    }

    /// Of a multiple of eight values, or the last ones.
    fn add(&mut self, values: &[f32]) {
        for values in values.chunks(8) {
            for (lane, value) in self.0.iter_mut().zip(values) {
                *lane = (*lane ^ u64::from(value.to_bits())).wrapping_mul(0x0100_0000_01b3);
            }
        }
    }

    fn value(&self) -> u64 {
        let fold =
            |sum: u64, lane: &u64| (sum ^ lane).wrapping_mul(0x0100_0000_01b3).rotate_left(29);
        self.0.iter().fold(0xcbf2_9ce4_8422_2325, fold)
    }
}

fn read(path: &Path, into: &mut [f32]) -> io::Result<bool> {
    let mut file = File::open(path)?;
    let mut head = [0; 32];
    file.read_exact(&mut head)?;
    let number = |from: usize| {
        let bytes = head[from..].first_chunk().copied().unwrap_or_default();
        u64::from_le_bytes(bytes)
    };
    let length = head.len() as u64 + size_of_val(into) as u64;
    if head[..16] != *MAGIC || number(16) != into.len() as u64 || file.metadata()?.len() != length {
        return Ok(false);
    }
    let mut sum = Sum::new();
    let mut bytes = vec![0; CHUNK];
    for values in into.chunks_mut(CHUNK / 4) {
        let bytes = &mut bytes[..size_of_val(values)];
        file.read_exact(bytes)?;
        for (value, bytes) in values.iter_mut().zip(bytes.as_chunks().0) {
            *value = f32::from_le_bytes(*bytes);
        }
        sum.add(values);
    }
    Ok(sum.value() == number(24))
}

/// Under another name first, so that a reader never sees half of it.
fn write(path: &Path, values: &[f32]) -> io::Result<()> {
    let part = path.with_extension(format!("{}.part", std::process::id()));
    let whole = || {
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        let mut sum = Sum::new();
        values.chunks(CHUNK / 4).for_each(|values| sum.add(values));
        let mut file = File::create(&part)?;
        file.write_all(MAGIC)?;
        file.write_all(&(values.len() as u64).to_le_bytes())?;
        file.write_all(&sum.value().to_le_bytes())?;
        let mut bytes = Vec::with_capacity(CHUNK);
        for values in values.chunks(CHUNK / 4) {
            bytes.clear();
            bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            file.write_all(&bytes)?;
        }
        fs::rename(&part, path)
    };
    whole().inspect_err(|_| {
        // What is left of it is of no use; that it cannot be removed changes nothing.
        let _ = fs::remove_file(&part);
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packed(folder: &Path) -> PackedWeights {
        PackedWeights::in_folder(folder.to_owned())
    }

    fn values(count: usize) -> Vec<f32> {
        (0..count).map(|k| (k as f32 - 7.5) * 0.37).collect()
    }

    #[test]
    fn what_is_kept_is_recalled_bit_for_bit_for_its_use_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let packed = packed(folder.path());
        let mut odd = values(300_001);
        (odd[0], odd[1]) = (f32::NAN, -0.0);
        packed.keep("a.weight", b"layout", &odd);
        let mut found = vec![1.0; odd.len()];
        assert!(packed.recall("a.weight", b"layout", &mut found));
        assert!(found.iter().zip(&odd).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert!(!packed.recall("b.weight", b"layout", &mut found));
        assert!(!packed.recall("a.weight", b"another", &mut found));
        assert!(!packed.recall("a.weight", b"layout", &mut found[1..]));
        assert_eq!(packed.counts(), [1, 1]);
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1, "no part is left");
    }

    #[test]
    fn a_damaged_file_is_none() {
        let folder = tempfile::tempdir().expect("a folder");
        let packed = packed(folder.path());
        let kept = values(5000);
        packed.keep("a", b"", &kept);
        let file = packed.file("a", b"");
        let whole = fs::read(&file).expect("the file");
        let recalled = |bytes: &[u8]| {
            fs::write(&file, bytes).expect("writes");
            packed.recall("a", b"", &mut vec![0.0; kept.len()])
        };
        assert!(recalled(&whole));
        for cut in [0, 3, 31, 32, 1000, whole.len() - 1] {
            assert!(!recalled(&whole[..cut]), "{cut} bytes");
        }
        assert!(!recalled(&[&whole[..], &[0]].concat()), "one byte too many");
        for at in [0, 15, 16, 24, 31, 32, 40, 5000, whole.len() - 1] {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            assert!(!recalled(&damaged), "byte {at}");
        }
        // Values in another order.
        let mut damaged = whole.clone();
        damaged[32..40].rotate_left(4);
        assert!(!recalled(&damaged));
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_said_and_stops_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("none");
        fs::write(&file, "a file where a folder has to be").expect("writes");
        let packed = packed(&file);
        packed.keep("a", b"", &values(3));
        assert!(packed.failure().expect("a reason").contains("none"));
        assert!(!packed.recall("a", b"", &mut [0.0; 3]));
        assert_eq!(packed.counts(), [0, 0]);
    }
}
