//! Weights, or the mean of several networks' weights, written with 32-bit or 16-bit floats.

use super::{Checkpoint, MappedFile};
use crate::error::ModelError;
use half::f16;
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, View};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Numbers of a weights' file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// 32-bit floats.
    Single,
    /// 16-bit floats (IEEE 754 binary16), rounded to the nearest, ties to even.
    Half,
}

/// What rounding did to the values of a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Rounding {
    /// Tensors.
    pub tensors: usize,
    /// Values in them.
    pub values: u64,
    /// Largest change of a value by its size, of values of at least [`LEAST_NORMAL`]; 2^-11 at most.
    pub largest_relative: f64,
    /// The tensor in which it happened; none where nothing changed.
    pub largest_in: Option<String>,
    /// Values under [`LEAST_NORMAL`] and not 0, of which 16-bit floats keep fewer digits.
    pub small: u64,
    /// Those of them that became 0.
    pub vanished: u64,
    /// Largest change of them; 2^-25 at most.
    pub largest_of_small: f64,
}

/// The least 16-bit float with all its digits, 2^-14.
pub const LEAST_NORMAL: f32 = 1.0 / 16384.0;

/// Why weights could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RoundingError {
    /// A tensor cannot be read.
    #[error(transparent)]
    Read(#[from] ModelError),
    /// Networks of two kinds have no mean.
    #[error(
        "{}: its config.json says another network than that of {}; the mean of weights needs networks of one kind",
        other.display(), first.display()
    )]
    Differs {
        /// The first checkpoint's folder.
        first: PathBuf,
        /// The folder of the one that does not fit to it.
        other: PathBuf,
    },
    /// A value beyond 65504, the largest 16-bit float, or none at all.
    #[error(
        "{}: value {index} of `{tensor}` is {value}, which {}", path.display(),
        if value.is_finite() { "a 16-bit float cannot hold; write 32-bit floats" } else { "is no weight" }
    )]
    Value {
        /// The file.
        path: PathBuf,
        /// Key of the tensor.
        tensor: String,
        /// Place of the value in it, row-major.
        index: usize,
        /// The value.
        value: f32,
    },
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Writes the tensors of a checkpoint to a safetensors file, all in one precision, sorted by their keys: its
/// bytes depend on keys, shapes and values alone. One tensor at a time is in memory.
///
/// With `others`, each value is the mean of theirs and the checkpoint's, in 64 bits, rounded once: trainings that went
/// on from the same weights make errors that differ, and the mean of their weights has fewer of them (Wortsman et al.,
/// Model soups, ICML 2022).
///
/// # Errors
/// [`RoundingError::Differs`] where a network is of another kind than the first; [`RoundingError::Value`] where a value
/// does not fit, before anything is written; [`RoundingError::Read`]; [`RoundingError::Write`].
pub fn write_rounded(
    checkpoint: &Checkpoint,
    others: &[Checkpoint],
    precision: Precision,
    path: &Path,
) -> Result<Rounding, RoundingError> {
    if let Some(other) = others.iter().find(|other| other.config() != checkpoint.config()) {
        let (first, other) = (checkpoint.folder().into(), other.folder().into());
        return Err(RoundingError::Differs { first, other });
    }
    let first = checkpoint.file();
    let files: Vec<&MappedFile> =
        std::iter::once(first).chain(others.iter().map(Checkpoint::file)).collect();
    let mut keys: Vec<&str> = first.keys().collect();
    keys.sort_unstable();
    let mut rounding = Rounding::default();
    let mut tensors = Vec::with_capacity(keys.len());
    for key in keys {
        let shape = first.shape(key).unwrap_or_default();
        let tensor = Tensor { files: &files, key, shape, precision };
        tensor.check(&mut rounding)?;
        tensors.push((key, tensor));
    }
    // What diffusers asks for.
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    safetensors::serialize_to_file(tensors, Some(metadata), path).map_err(|error| {
        let source = match error {
            SafeTensorError::IoError(error) => error,
            other => std::io::Error::other(other.to_string()),
        };
        RoundingError::Write { path: path.into(), source }
    })?;
    Ok(rounding)
}

/// The mean of a tensor over files, made and converted while it is written.
struct Tensor<'a> {
    files: &'a [&'a MappedFile],
    key: &'a str,
    shape: &'a [usize],
    precision: Precision,
}

impl Tensor<'_> {
    /// The values, as 32-bit floats; those of a single file to the bit.
    fn values(&self) -> Result<Vec<f32>, ModelError> {
        if let [file] = self.files {
            return file.read(self.key, self.shape);
        }
        let mut sum = vec![0.0_f64; self.shape.iter().product()];
        for file in self.files {
            for (sum, value) in sum.iter_mut().zip(file.read(self.key, self.shape)?) {
                *sum += f64::from(value);
            }
        }
        let count = self.files.len() as f64;
        Ok(sum.into_iter().map(|sum| (sum / count) as f32).collect())
    }

    /// Looks at every value, and adds to `rounding` what becomes of it.
    fn check(&self, rounding: &mut Rounding) -> Result<(), RoundingError> {
        let values = self.values()?;
        rounding.tensors += 1;
        rounding.values += values.len() as u64;
        for (index, value) in values.into_iter().enumerate() {
            let written = match self.precision {
                Precision::Single => value,
                Precision::Half => f16::from_f32(value).to_f32(),
            };
            if !written.is_finite() {
                return Err(self.refused(index, value));
            }
            let change = (f64::from(written) - f64::from(value)).abs();
            if value.abs() >= LEAST_NORMAL {
                let relative = change / f64::from(value).abs();
                if relative > rounding.largest_relative {
                    rounding.largest_relative = relative;
                    rounding.largest_in = Some(self.key.to_owned());
                }
            } else if value != 0.0 {
                rounding.small += 1;
                rounding.vanished += u64::from(written == 0.0);
                rounding.largest_of_small = rounding.largest_of_small.max(change);
            }
        }
        Ok(())
    }

    /// What is said of a mean that cannot be written: of the values that it is made of, the first that is no number,
    /// else the largest, and the file that holds it.
    fn refused(&self, index: usize, mean: f32) -> RoundingError {
        let of = |file: &&MappedFile| file.read(self.key, self.shape).ok()?.get(index).copied();
        let all = self.files.iter().filter_map(|file| Some((file.path(), of(file)?)));
        let size = |value: f32| if value.is_finite() { value.abs() } else { f32::INFINITY };
        let worst = all.reduce(|a, b| if size(b.1) > size(a.1) { b } else { a });
        let (path, value) = worst.unwrap_or((self.files[0].path(), mean));
        RoundingError::Value { path: path.into(), tensor: self.key.into(), index, value }
    }
}

impl View for Tensor<'_> {
    fn dtype(&self) -> Dtype {
        match self.precision {
            Precision::Single => Dtype::F32,
            Precision::Half => Dtype::F16,
        }
    }

    fn shape(&self) -> &[usize] {
        self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        // It was read before; a tensor without its bytes makes a file that is not whole, which whoever opens it
        // refuses.
        let values = self.values().unwrap_or_default().into_iter();
        Cow::Owned(match self.precision {
            Precision::Single => values.flat_map(f32::to_le_bytes).collect(),
            Precision::Half => values.flat_map(|v| f16::from_f32(v).to_le_bytes()).collect(),
        })
    }

    fn data_len(&self) -> usize {
        let bytes = match self.precision {
            Precision::Single => 4,
            Precision::Half => 2,
        };
        bytes * self.shape.iter().product::<usize>()
    }
}
