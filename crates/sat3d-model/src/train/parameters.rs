//! Weights by their names: into modules, and in the lists that a run's state consists of.

use super::TrainError;
use super::learner::NamedTensor;
use super::optimiser::path_of;
use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Tensor, TensorData};
use std::collections::BTreeMap;

/// A list of named tensors from which each is taken once.
pub(crate) struct Stored<'a> {
    tensors: BTreeMap<&'a str, &'a NamedTensor>,
}

impl<'a> Stored<'a> {
    /// All of a list.
    ///
    /// # Errors
    /// [`TrainError::State`] where a name comes twice.
    pub(crate) fn new(tensors: &'a [NamedTensor]) -> Result<Self, TrainError> {
        let mut found = BTreeMap::new();
        for tensor in tensors {
            if found.insert(tensor.name.as_str(), tensor).is_some() {
                return Err(TrainError::State(format!("`{}` is there twice", tensor.name)));
            }
            if tensor.values.len() != tensor.shape.iter().product::<usize>() {
                let (shape, count) = (&tensor.shape, tensor.values.len());
                let why = format!("`{}` of shape {shape:?} has {count} values", tensor.name);
                return Err(TrainError::State(why));
            }
        }
        Ok(Self { tensors: found })
    }

    /// Takes one out.
    ///
    /// # Errors
    /// [`TrainError::State`] where it is missing.
    pub(crate) fn take(&mut self, name: &str) -> Result<&'a NamedTensor, TrainError> {
        self.take_if_there(name).ok_or_else(|| TrainError::State(format!("`{name}` is missing")))
    }

    /// Takes one out if it is there.
    pub(crate) fn take_if_there(&mut self, name: &str) -> Option<&'a NamedTensor> {
        self.tensors.remove(name)
    }

    /// Takes out all whose names begin so; the beginning is cut off.
    pub(crate) fn take_below(&mut self, prefix: &str) -> Vec<NamedTensor> {
        let found: Vec<&'a NamedTensor> = self
            .tensors
            .iter()
            .filter(|(name, _)| name.starts_with(prefix))
            .map(|(_, tensor)| *tensor)
            .collect();
        found
            .into_iter()
            .map(|tensor| {
                self.tensors.remove(tensor.name.as_str());
                NamedTensor { name: tensor.name[prefix.len()..].into(), ..tensor.clone() }
            })
            .collect()
    }

    /// That nothing is left over.
    ///
    /// # Errors
    /// [`TrainError::State`] with what is.
    pub(crate) fn done(self) -> Result<(), TrainError> {
        match self.tensors.keys().next() {
            None => Ok(()),
            Some(name) => {
                let count = self.tensors.len();
                Err(TrainError::State(format!("{count} tensors left over, the first `{name}`")))
            }
        }
    }
}

/// A list with a beginning before all names.
pub(crate) fn below(prefix: &str, tensors: Vec<NamedTensor>) -> impl Iterator<Item = NamedTensor> {
    tensors
        .into_iter()
        .map(move |tensor| NamedTensor { name: format!("{prefix}{}", tensor.name), ..tensor })
}

/// The module with the values that are stored under its parameters' names, which are taken out.
///
/// # Errors
/// [`TrainError::State`] where one is missing or of another shape.
pub(crate) fn with_parameters<M: Module>(
    prefix: &str,
    module: M,
    stored: &mut Stored<'_>,
) -> Result<M, TrainError> {
    let mut mapper = Putting { path: path_of(prefix), stored, error: None };
    let module = module.map(&mut mapper);
    match mapper.error {
        None => Ok(module),
        Some(error) => Err(error),
    }
}

struct Putting<'a, 'b> {
    path: Vec<String>,
    stored: &'a mut Stored<'b>,
    error: Option<TrainError>,
}

impl ModuleMapper for Putting<'_, '_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if self.error.is_some() {
            return param;
        }
        let name = self.path.join(".");
        let wanted = param.val().dims();
        let found = self.stored.take(&name).and_then(|tensor| {
            if tensor.shape == wanted {
                return Ok(tensor.values.clone());
            }
            let shape = &tensor.shape;
            Err(TrainError::State(format!("`{name}` is {shape:?}, the model's {wanted:?}")))
        });
        match found {
            Ok(values) => {
                let device = param.val().device();
                param.map(|value| {
                    let new = Tensor::from_data(TensorData::new(values, wanted), &device);
                    if value.is_require_grad() { new.require_grad() } else { new }
                })
            }
            Err(error) => {
                self.error = Some(error);
                param
            }
        }
    }
}
