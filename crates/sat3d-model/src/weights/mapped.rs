//! A safetensors file in memory by mapping, read tensor by tensor.
#![expect(unsafe_code, reason = "mapping a file, and giving its pages back, are unsafe calls")]

use crate::error::{Mismatch, ModelError};
use half::{bf16, f16};
use memmap2::Mmap;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, Metadata, SafeTensorError, SafeTensors, TensorInfo};
use std::fs::File;
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A safetensors file in memory whose header has been checked against its length: mapped, or a part of
/// the program. Clones share it.
#[derive(Clone, Debug)]
pub struct MappedFile {
    path: PathBuf,
    bytes: Bytes,
    metadata: Metadata,
    /// In file order.
    keys: Vec<String>,
    /// Where the tensors' bytes begin.
    start: usize,
}

#[derive(Clone, Debug)]
enum Bytes {
    Mapped(Arc<Mmap>),
    BuiltIn(&'static [u8]),
}

impl Deref for Bytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::BuiltIn(bytes) => bytes,
        }
    }
}

impl MappedFile {
    /// Maps a file and reads its header. As with every mapped file, the program is stopped by the
    /// system if somebody truncates the file while it is in use.
    ///
    /// # Errors
    /// [`ModelError::Io`]; [`ModelError::Damaged`] where the file is cut off, or is not safetensors.
    pub fn open(path: &Path) -> Result<Self, ModelError> {
        let file = File::open(path).map_err(ModelError::io(path))?;
        // SAFETY: the map is only read. Another process changing the file would change values
        // under us, never types or lengths: every byte pattern is a valid u8.
        let map = unsafe { Mmap::map(&file) }.map_err(ModelError::io(path))?;
        Self::of(path, Bytes::Mapped(Arc::new(map)))
    }

    /// A file that is part of the program; `name` is for messages.
    ///
    /// # Errors
    /// [`ModelError::Damaged`].
    pub fn built_in(name: &str, bytes: &'static [u8]) -> Result<Self, ModelError> {
        Self::of(Path::new(name), Bytes::BuiltIn(bytes))
    }

    fn of(path: &Path, bytes: Bytes) -> Result<Self, ModelError> {
        let (header, metadata) = SafeTensors::read_metadata(&bytes).map_err(|error| {
            ModelError::Damaged { path: path.into(), why: explained(&error, &bytes) }
        })?;
        let start = header + LENGTH;
        let keys = metadata.offset_keys();
        Ok(Self { path: path.into(), bytes, metadata, keys, start })
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All of its bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The header: names, types, shapes and places of the tensors.
    #[must_use]
    pub fn header(&self) -> &[u8] {
        &self.bytes[..self.start]
    }

    /// Keys of the tensors, in file order.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.keys.iter().map(String::as_str)
    }

    /// Shape of a tensor.
    #[must_use]
    pub fn shape(&self, key: &str) -> Option<&[usize]> {
        self.metadata.info(key).map(|info| info.shape.as_slice())
    }

    /// Name of a tensor's element type, as `F32`.
    #[must_use]
    pub fn element(&self, key: &str) -> Option<String> {
        self.metadata.info(key).map(|info| info.dtype.to_string())
    }

    /// The element type of a tensor where it cannot be read as f32.
    pub(super) fn unreadable_type(&self, key: &str) -> Option<String> {
        let info = self.metadata.info(key)?;
        let readable = matches!(info.dtype, Dtype::F32 | Dtype::F16 | Dtype::BF16);
        (!readable).then(|| info.dtype.to_string())
    }

    /// A tensor's bytes in the file.
    #[must_use]
    pub fn raw(&self, key: &str) -> Option<&[u8]> {
        let info = self.metadata.info(key)?;
        Some(&self.bytes[self.start..][info.data_offsets.0..info.data_offsets.1])
    }

    /// A tensor's values where they lie in the file, if they are f32 of this shape and lie as this processor reads
    /// them.
    pub(super) fn mapped(&self, key: &str, shape: &[usize]) -> Option<&[f32]> {
        let info = self.metadata.info(key)?;
        if info.shape != shape || info.dtype != Dtype::F32 || cfg!(target_endian = "big") {
            return None;
        }
        // SAFETY: any bits are a float; `align_to` sees to their alignment.
        let (before, values, after) = unsafe { self.raw(key)?.align_to::<f32>() };
        (before.is_empty() && after.is_empty()).then_some(values)
    }

    /// Converts one tensor to f32 and gives its pages back to the system.
    ///
    /// # Errors
    /// [`ModelError::Tensors`] where it is missing or of another shape or type.
    pub fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        let mut mismatch = Mismatch::default();
        match self.metadata.info(key) {
            None => mismatch.missing.push(key.into()),
            Some(info) if info.shape != shape => {
                mismatch.misshaped.push((key.into(), shape.to_vec(), info.shape.clone()));
            }
            Some(info) => match self.convert(info) {
                Some(values) => return Ok(values),
                None => mismatch.mistyped.push((key.into(), info.dtype.to_string())),
            },
        }
        let path = self.path.clone();
        Err(ModelError::Tensors { path, mismatch: Box::new(mismatch) })
    }

    fn convert(&self, info: &TensorInfo) -> Option<Vec<f32>> {
        let (begin, end) = info.data_offsets;
        let bytes = &self.bytes[self.start + begin..self.start + end];
        let values = match info.dtype {
            Dtype::F32 => widen(bytes, f32::from_le_bytes),
            Dtype::F16 => widen(bytes, |half| f16::from_le_bytes(half).to_f32()),
            Dtype::BF16 => widen(bytes, |half| bf16::from_le_bytes(half).to_f32()),
            _ => return None,
        };
        self.release(bytes);
        Some(values)
    }

    /// Lets the system drop the pages of a part of [`MappedFile::bytes`]; they come back from the
    /// file when they are read again. Only a hint, and only where the system has one.
    pub(super) fn release(&self, part: &[u8]) {
        #[cfg(unix)]
        if let Bytes::Mapped(map) = &self.bytes {
            let offset = part.as_ptr().addr().wrapping_sub(map.as_ptr().addr());
            if offset <= map.len() && part.len() <= map.len() - offset {
                let advice = memmap2::UncheckedAdvice::DontNeed;
                // SAFETY: the map is file-backed and never written, so dropped pages are read
                // again with the same content.
                let _ = unsafe { map.unchecked_advise_range(advice, offset, part.len()) };
            }
        }
        #[cfg(not(unix))]
        let _ = part;
    }
}

/// Converts in parallel: each value stands alone.
fn widen<const N: usize>(bytes: &[u8], convert: impl Fn([u8; N]) -> f32 + Sync) -> Vec<f32> {
    let (items, _) = bytes.as_chunks::<N>();
    items.par_iter().with_min_len(1 << 16).map(|&item| convert(item)).collect()
}

/// Bytes before the header that hold its length.
const LENGTH: usize = 8;

/// What is wrong with a file, in words: the library names its cases for programmers.
fn explained(error: &SafeTensorError, bytes: &[u8]) -> String {
    let found = bytes.len();
    let Some(length) = bytes.first_chunk::<LENGTH>().map(|bytes| u64::from_le_bytes(*bytes)) else {
        return format!("cut off: {found} bytes, too few for the length of its header");
    };
    match error {
        SafeTensorError::InvalidHeaderLength => {
            format!("cut off: {found} bytes, its header alone says {length}")
        }
        SafeTensorError::MetadataIncompleteBuffer => format!(
            "cut off or too long: {found} bytes, other than the sizes of its tensors add up to"
        ),
        SafeTensorError::HeaderTooLarge => {
            format!("{found} bytes, the first of which make no header's length ({length})")
        }
        other => format!("{other} ({found} bytes)"),
    }
}
