//! Reads parameters into modules along the modules' own names.

use crate::error::ModelError;
use crate::weights::TensorSource;
use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use std::fmt::Display;

/// A place in the tree of modules, from which values are read.
pub(crate) struct Place<'a> {
    source: &'a dyn TensorSource,
    path: String,
}

impl<'a> Place<'a> {
    /// The root of a checkpoint.
    pub(crate) fn new(source: &'a dyn TensorSource) -> Self {
        Self { source, path: String::new() }
    }

    /// The module `name` below this one.
    pub(crate) fn child(&self, name: impl Display) -> Self {
        Self { source: self.source, path: self.key(name) }
    }

    /// Values of one parameter of this module.
    pub(crate) fn read<const D: usize>(
        &self,
        name: &str,
        shape: [usize; D],
    ) -> Result<Vec<f32>, ModelError> {
        self.source.read(&self.key(name), &shape)
    }

    /// The key of a parameter of this module.
    pub(crate) fn key(&self, name: impl Display) -> String {
        if self.path.is_empty() { name.to_string() } else { format!("{}.{name}", self.path) }
    }
}

#[cfg(feature = "onednn")]
impl<'a> Place<'a> {
    /// Values where they lie in memory; see [`TensorSource::mapped`].
    pub(crate) fn mapped<const D: usize>(
        &self,
        name: &str,
        shape: [usize; D],
    ) -> Option<&'a [f32]> {
        self.source.mapped(&self.key(name), &shape)
    }

    /// See [`TensorSource::packed`].
    pub(crate) fn packed(&self) -> Option<&'a crate::weights::PackedWeights> {
        self.source.packed()
    }

    /// See [`TensorSource::release`].
    pub(crate) fn release(&self, name: &str) {
        self.source.release(&self.key(name));
    }
}

/// The same, for parameters of `burn`.
pub(crate) struct Loader<'a> {
    place: Place<'a>,
    device: &'a Device,
}

impl<'a> Loader<'a> {
    /// The root of a checkpoint.
    pub(crate) fn new(source: &'a dyn TensorSource, device: &'a Device) -> Self {
        Self { place: Place::new(source), device }
    }

    /// The module `name` below this one.
    pub(crate) fn child(&self, name: impl Display) -> Self {
        Self { place: self.place.child(name), device: self.device }
    }

    /// Where this is, as keys begin.
    pub(crate) fn path(&self) -> &str {
        &self.place.path
    }

    /// One parameter of this module. The values go to the device before the next are read.
    pub(crate) fn parameter<const D: usize>(
        &self,
        name: &str,
        shape: [usize; D],
    ) -> Result<Param<Tensor<D>>, ModelError> {
        let values = self.place.read(name, shape)?;
        Ok(Param::from_data(TensorData::new(values, shape), self.device))
    }
}
