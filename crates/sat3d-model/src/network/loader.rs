//! Reads parameters into modules along the modules' own names.

use crate::error::ModelError;
use crate::weights::TensorSource;
use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use std::fmt::Display;

/// A place in the tree of modules, from which parameters are read.
pub(crate) struct Loader<'a> {
    source: &'a dyn TensorSource,
    device: &'a Device,
    path: String,
}

impl<'a> Loader<'a> {
    /// The root of a checkpoint.
    pub(crate) fn new(source: &'a dyn TensorSource, device: &'a Device) -> Self {
        Self { source, device, path: String::new() }
    }

    /// The module `name` below this one.
    pub(crate) fn child(&self, name: impl Display) -> Self {
        let path = self.key(name);
        Self { source: self.source, device: self.device, path }
    }

    /// Where this is, as keys begin.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// One parameter of this module. The values go to the device before the next are read.
    pub(crate) fn parameter<const D: usize>(
        &self,
        name: &str,
        shape: [usize; D],
    ) -> Result<Param<Tensor<D>>, ModelError> {
        let values = self.source.read(&self.key(name), &shape)?;
        Ok(Param::from_data(TensorData::new(values, shape), self.device))
    }

    fn key(&self, name: impl Display) -> String {
        if self.path.is_empty() { name.to_string() } else { format!("{}.{name}", self.path) }
    }
}
