//! AdamW, and the moving average of weights, over the parameters of any module.
//!
//! Parameters are known by their path in the module, which is their key in a checkpoint: so the state
//! of an optimiser is a list of named tensors, and a restored one goes on bit for bit. `burn`'s own
//! optimisers know parameters by random numbers.

use super::error::TrainError;
use super::learner::NamedTensor;
use crate::error::{Mismatch, ModelError};
use crate::weights::TensorSource;
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Settings of [`AdamW`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamWSettings {
    /// Learning rate at scale 1.
    pub learning_rate: f64,
    /// Decay of the gradients' mean.
    pub beta1: f64,
    /// Decay of the gradients' mean square.
    pub beta2: f64,
    /// Added to the root of the mean square.
    pub epsilon: f64,
    /// Share of a weight taken away per step, times the learning rate (decoupled).
    pub weight_decay: f64,
}

impl Default for AdamWSettings {
    /// Those of the release (MODEL_SPEC section 11).
    fn default() -> Self {
        Self { learning_rate: 1e-4, beta1: 0.0, beta2: 0.9, epsilon: 1e-8, weight_decay: 0.01 }
    }
}

/// Gradient descent with adaptive moments and decoupled weight decay (Loshchilov and Hutter 2019,
/// algorithm 2), as PyTorch computes it.
#[derive(Debug)]
pub struct AdamW {
    settings: AdamWSettings,
    moments: BTreeMap<String, Moments>,
}

#[derive(Debug)]
struct Moments {
    steps: u64,
    shape: Vec<usize>,
    /// Flat, without gradients.
    mean: Tensor<1>,
    square: Tensor<1>,
}

impl AdamW {
    /// An optimiser that has seen nothing.
    #[must_use]
    pub fn new(settings: AdamWSettings) -> Self {
        Self { settings, moments: BTreeMap::new() }
    }

    /// One step for every parameter of the module that has a gradient; the others stay. `prefix` is the
    /// module's place in the checkpoint, `scale` the schedule's factor of the learning rate.
    #[must_use]
    pub fn step<M: Module>(
        &mut self,
        prefix: &str,
        module: M,
        gradients: &Gradients,
        scale: f64,
    ) -> M {
        let gradients = ParameterGradients::of(prefix, &module, gradients);
        self.apply(prefix, module, &gradients, scale)
    }

    /// The same with gradients that were taken out of their graphs.
    #[must_use]
    pub fn apply<M: Module>(
        &mut self,
        prefix: &str,
        module: M,
        gradients: &ParameterGradients,
        scale: f64,
    ) -> M {
        module.map(&mut Step { optimiser: self, path: path_of(prefix), gradients, scale })
    }

    /// The moments: `<path>.mean`, `<path>.square` and `<path>.steps` for each parameter.
    #[must_use]
    pub fn state(&self) -> Vec<NamedTensor> {
        let mut list = Vec::with_capacity(3 * self.moments.len());
        for (path, moments) in &self.moments {
            let tensor = |name: &str, shape: Vec<usize>, values| NamedTensor {
                name: format!("{path}.{name}"),
                shape,
                values,
            };
            list.push(tensor("mean", moments.shape.clone(), values(&moments.mean)));
            list.push(tensor("square", moments.shape.clone(), values(&moments.square)));
            // Two halves of 20 bits each are exact in f32.
            let halves = [moments.steps >> 20, moments.steps & 0xF_FFFF].map(|half| half as f32);
            list.push(tensor("steps", vec![2], halves.to_vec()));
        }
        list
    }

    /// Goes back to a state of [`AdamW::state`].
    ///
    /// # Errors
    /// [`TrainError::State`] where a moment of a parameter is missing or of another shape.
    pub fn restore(&mut self, state: &[NamedTensor], device: &Device) -> Result<(), TrainError> {
        let device = device.clone().without_autodiff();
        let by_name: BTreeMap<&str, &NamedTensor> =
            state.iter().map(|tensor| (tensor.name.as_str(), tensor)).collect();
        let mut restored = BTreeMap::new();
        for (name, mean) in &by_name {
            let Some(path) = name.strip_suffix(".mean") else { continue };
            let find = |what: &str| {
                let name = format!("{path}.{what}");
                by_name.get(name.as_str()).copied().ok_or_else(|| {
                    TrainError::State(format!("`{name}` is missing beside `{path}.mean`"))
                })
            };
            let (square, steps) = (find("square")?, find("steps")?);
            let [high, low] = steps.values[..] else {
                return Err(TrainError::State(format!("`{path}.steps` needs two values")));
            };
            if square.values.len() != mean.values.len() {
                return Err(TrainError::State(format!(
                    "`{path}.square` has {} values, `{path}.mean` {}",
                    square.values.len(),
                    mean.values.len()
                )));
            }
            let flat = |tensor: &NamedTensor| {
                let length = tensor.values.len();
                Tensor::from_data(TensorData::new(tensor.values.clone(), [length]), &device)
            };
            let moments = Moments {
                steps: ((high as u64) << 20) + low as u64,
                shape: mean.shape.clone(),
                mean: flat(mean),
                square: flat(square),
            };
            restored.insert(path.to_owned(), moments);
        }
        self.moments = restored;
        Ok(())
    }
}

struct Step<'a> {
    optimiser: &'a mut AdamW,
    path: Vec<String>,
    gradients: &'a ParameterGradients,
    scale: f64,
}

impl ModuleMapper for Step<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let path = self.path.join(".");
        let Some(gradient) = self.gradients.0.get(&path) else { return param };
        let gradient = gradient.clone();
        let AdamWSettings { learning_rate, beta1, beta2, epsilon, weight_decay } =
            self.optimiser.settings;
        let rate = learning_rate * self.scale;
        let shape = param.val().dims();
        let length = shape.iter().product::<usize>();
        let moments = self.optimiser.moments.entry(path).or_insert_with(|| {
            let zeros = Tensor::zeros([length], &gradient.device());
            Moments { steps: 0, shape: shape.to_vec(), mean: zeros.clone(), square: zeros }
        });
        moments.steps += 1;
        moments.mean = moments.mean.clone() * beta1 + gradient.clone() * (1.0 - beta1);
        moments.square =
            moments.square.clone() * beta2 + gradient.clone() * gradient * (1.0 - beta2);
        let steps = moments.steps as f64;
        let (first, second) = (1.0 - libm::pow(beta1, steps), 1.0 - libm::pow(beta2, steps));
        let change = moments.mean.clone()
            / (moments.square.clone().sqrt() / second.sqrt() + epsilon)
            * (rate / first);
        param.map(|value| {
            let tracked = value.is_require_grad();
            let flat: Tensor<1> = value.without_autodiff().reshape([length]);
            let stepped = flat * (1.0 - rate * weight_decay) - change;
            let stepped = stepped.reshape(shape).autodiff();
            if tracked { stepped.require_grad() } else { stepped }
        })
    }
}

/// The moving average of a module's weights.
#[derive(Debug, Default)]
pub struct Average {
    updates: u64,
    values: BTreeMap<String, (Vec<usize>, Tensor<1>)>,
}

impl Average {
    /// Largest decay.
    const DECAY: f64 = 0.9999;

    /// Takes the module's weights in: the first time as they are, then with the decay
    /// `min((1 + n) / (10 + n), 0.9999)` after `n` updates. Call [`Average::advance`] after all modules.
    pub fn update<M: Module>(&mut self, prefix: &str, module: &M) {
        let updates = self.updates as f64;
        let decay = ((1.0 + updates) / (10.0 + updates)).min(Self::DECAY);
        module.visit(&mut Averaging { average: self, path: path_of(prefix), decay });
    }

    /// Counts one update.
    pub fn advance(&mut self) {
        self.updates += 1;
    }

    /// The averages by path.
    #[must_use]
    pub fn parameters(&self) -> Vec<NamedTensor> {
        let tensor = |(name, (shape, tensor)): (&String, &(Vec<usize>, Tensor<1>))| NamedTensor {
            name: name.clone(),
            shape: shape.clone(),
            values: values(tensor),
        };
        self.values.iter().map(tensor).collect()
    }

    /// Number of updates so far.
    #[must_use]
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Goes back to earlier averages.
    pub fn restore(&mut self, updates: u64, parameters: &[NamedTensor], device: &Device) {
        let device = device.clone().without_autodiff();
        self.updates = updates;
        self.values = parameters
            .iter()
            .map(|tensor| {
                let data = TensorData::new(tensor.values.clone(), [tensor.values.len()]);
                (tensor.name.clone(), (tensor.shape.clone(), Tensor::from_data(data, &device)))
            })
            .collect();
    }
}

struct Averaging<'a> {
    average: &'a mut Average,
    path: Vec<String>,
    decay: f64,
}

impl ModuleVisitor for Averaging<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val().without_autodiff();
        let shape = value.dims();
        let flat: Tensor<1> = value.reshape([shape.iter().product::<usize>()]);
        let decay = self.decay;
        self.average
            .values
            .entry(self.path.join("."))
            .and_modify(|(_, average)| {
                *average = average.clone() * decay + flat.clone() * (1.0 - decay);
            })
            .or_insert_with(|| (shape.to_vec(), flat));
    }
}

/// A module's parameters by their paths below `prefix`.
#[must_use]
pub fn named_parameters<M: Module>(prefix: &str, module: &M) -> Vec<NamedTensor> {
    struct Reader {
        path: Vec<String>,
        found: Vec<NamedTensor>,
    }
    impl ModuleVisitor for Reader {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let value = param.val().without_autodiff();
            let shape = value.dims().to_vec();
            self.found.push(NamedTensor {
                name: self.path.join("."),
                values: values(&value),
                shape,
            });
        }
    }
    let mut reader = Reader { path: path_of(prefix), found: Vec::new() };
    module.visit(&mut reader);
    reader.found
}

/// Gradients of a module's parameters by their paths, flat and without their graph.
#[derive(Clone, Debug, Default)]
pub struct ParameterGradients(BTreeMap<String, Tensor<1>>);

impl ParameterGradients {
    /// Those of the parameters that have one; `prefix` is the module's place in the checkpoint.
    #[must_use]
    pub fn of<M: Module>(prefix: &str, module: &M, gradients: &Gradients) -> Self {
        struct Reader<'a> {
            path: Vec<String>,
            gradients: &'a Gradients,
            found: BTreeMap<String, Tensor<1>>,
        }
        impl ModuleVisitor for Reader<'_> {
            fn enter_module(&mut self, name: &str, _container: &str) {
                self.path.push(name.into());
            }
            fn exit_module(&mut self, _name: &str, _container: &str) {
                self.path.pop();
            }
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                if let Some(gradient) = param.val().grad(self.gradients) {
                    let length = gradient.dims().iter().product::<usize>();
                    let flat = gradient.without_autodiff().reshape([length]);
                    self.found.insert(self.path.join("."), flat);
                }
            }
        }
        let mut reader = Reader { path: path_of(prefix), gradients, found: BTreeMap::new() };
        module.visit(&mut reader);
        Self(reader.found)
    }

    /// The sum with another part's. The order of parts decides the last bits.
    #[must_use]
    pub fn plus(mut self, other: Self) -> Self {
        for (path, gradient) in other.0 {
            let sum = match self.0.remove(&path) {
                Some(mine) => mine + gradient,
                None => gradient,
            };
            self.0.insert(path, sum);
        }
        self
    }

    /// How many parameters have one.
    #[must_use]
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// Whether every one is finite.
    #[must_use]
    pub fn finite(&self) -> bool {
        // One number says it for a tensor: infinity and NaN survive a sum of absolute values.
        self.0.values().all(|gradient| {
            values(&gradient.clone().abs().sum()).iter().all(|value| value.is_finite())
        })
    }
}

/// Whether every gradient of the module's parameters is finite.
#[must_use]
pub fn finite<M: Module>(module: &M, gradients: &Gradients) -> bool {
    ParameterGradients::of("", module, gradients).finite()
}

/// Named tensors as a source of weights, to load modules from.
#[derive(Debug)]
pub struct Named(BTreeMap<String, NamedTensor>);

impl Named {
    /// A source of these tensors.
    #[must_use]
    pub fn new(tensors: impl IntoIterator<Item = NamedTensor>) -> Self {
        Self(tensors.into_iter().map(|tensor| (tensor.name.clone(), tensor)).collect())
    }
}

impl TensorSource for Named {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        match self.0.get(key) {
            Some(tensor) if tensor.shape == shape => Ok(tensor.values.clone()),
            found => {
                let mut mismatch = Mismatch::default();
                match found {
                    Some(other) => {
                        let shapes = (key.into(), shape.to_vec(), other.shape.clone());
                        mismatch.misshaped.push(shapes);
                    }
                    None => mismatch.missing.push(key.into()),
                }
                let path = PathBuf::from("(weights in memory)");
                Err(ModelError::Tensors { path, mismatch: Box::new(mismatch) })
            }
        }
    }
}

pub(crate) fn path_of(prefix: &str) -> Vec<String> {
    if prefix.is_empty() { Vec::new() } else { vec![prefix.to_owned()] }
}

/// Values of a tensor, brought to memory.
pub(crate) fn values<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    let data = tensor.clone().into_data();
    data.try_into_vec().unwrap_or_default()
}
