//! A look at what passes between the layers, for parity tests.

use burn::tensor::Tensor;

/// A tensor between two layers.
#[derive(Clone, Debug, PartialEq)]
pub struct Stage {
    /// Where it is, named after the module that made it, as `layer.3` or `up.2.block.0`.
    pub name: String,
    /// Its shape, without the batch axis.
    pub shape: Vec<usize>,
    /// Its values, row-major.
    pub values: Vec<f32>,
}

/// Takes stages as they pass, or lets them pass unseen.
pub(crate) struct Probe<'a> {
    sink: Option<&'a mut dyn FnMut(Stage)>,
    prefix: String,
}

impl<'a> Probe<'a> {
    /// Sees nothing and costs nothing.
    pub(crate) fn none() -> Self {
        Self { sink: None, prefix: String::new() }
    }

    /// Hands every stage to `sink`.
    pub(crate) fn new(sink: &'a mut dyn FnMut(Stage)) -> Self {
        Self { sink: Some(sink), prefix: String::new() }
    }

    /// Runs `inner` with `name.` before the names of its stages.
    pub(crate) fn inside<T>(&mut self, name: &str, inner: impl FnOnce(&mut Self) -> T) -> T {
        if self.sink.is_none() {
            return inner(self);
        }
        let length = self.prefix.len();
        self.prefix.push_str(name);
        self.prefix.push('.');
        let result = inner(self);
        self.prefix.truncate(length);
        result
    }

    /// Shows one stage that `make` gives as shape and values.
    #[cfg(feature = "onednn")]
    pub(crate) fn see_values(&mut self, name: &str, make: impl FnOnce() -> (Vec<usize>, Vec<f32>)) {
        let Some(sink) = &mut self.sink else { return };
        let (shape, values) = make();
        sink(Stage { name: format!("{}{name}", self.prefix), shape, values });
    }

    /// Shows one stage; the first axis is dropped where it is a batch of one image.
    pub(crate) fn see<const D: usize>(&mut self, name: &str, tensor: &Tensor<D>) {
        let Some(sink) = &mut self.sink else { return };
        let mut shape = tensor.dims().to_vec();
        if D == 4 {
            shape.remove(0);
        }
        // A failed read shows as an empty stage, which no comparison passes.
        let values = tensor.clone().try_into_data().ok().and_then(|data| data.try_into_vec().ok());
        let name = format!("{}{name}", self.prefix);
        sink(Stage { name, shape, values: values.unwrap_or_default() });
    }
}
