//! Lists of tensors as safetensors files.

use crate::model::ModelError;
use crate::model::train::NamedTensor;
use crate::model::weights::MappedFile;
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, View};
use std::borrow::Cow;
use std::collections::HashMap;
use std::io;
use std::path::Path;

/// A tensor as the library writes it.
struct Floats<'a>(&'a NamedTensor);

impl View for Floats<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.0.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(self.0.values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    fn data_len(&self) -> usize {
        4 * self.0.values.len()
    }
}

/// Writes tensors as a safetensors file of 32-bit floats, in the order of their names; one at a time is in memory
/// twice.
///
/// # Errors
/// Any error of writing; a tensor whose shape is not that of its values, or a name that comes twice.
pub fn write_tensors(path: &Path, tensors: &[NamedTensor]) -> io::Result<()> {
    let mut names: Vec<&str> = tensors.iter().map(|tensor| tensor.name.as_str()).collect();
    names.sort_unstable();
    let wrong = |text: String| io::Error::new(io::ErrorKind::InvalidData, text);
    if let Some(twice) = names.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(wrong(format!("the tensor `{}` comes twice", twice[0])));
    }
    let count = |tensor: &NamedTensor| tensor.shape.iter().product::<usize>();
    if let Some(odd) = tensors.iter().find(|tensor| count(tensor) != tensor.values.len()) {
        let NamedTensor { name, shape, values } = odd;
        return Err(wrong(format!("the tensor `{name}` of {shape:?} has {} values", values.len())));
    }
    // What diffusers asks for.
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    let list = tensors.iter().map(|tensor| (tensor.name.as_str(), Floats(tensor)));
    safetensors::serialize_to_file(list, Some(metadata), path).map_err(|error| match error {
        SafeTensorError::IoError(error) => error,
        other => io::Error::other(other.to_string()),
    })
}

/// Reads all tensors of a safetensors file, in the order of the file.
///
/// # Errors
/// [`ModelError`] where the file is damaged or holds other types than floats.
pub fn read_tensors(path: &Path) -> Result<Vec<NamedTensor>, ModelError> {
    let file = MappedFile::open(path)?;
    file.keys()
        .map(|name| {
            let shape = file.shape(name).unwrap_or_default().to_vec();
            let values = file.read(name, &shape)?;
            Ok(NamedTensor { name: name.to_owned(), shape, values })
        })
        .collect()
}
