//! Histogram to style code, style code to sky map (MODEL_SPEC section 9.1).

use super::layers::Linear;
use super::loader::Loader;
use crate::config::{Config, HISTOGRAM};
use crate::error::ModelError;
use burn::module::Module;
use burn::tensor::{Tensor, activation};

/// Dense layers, each followed by a leaky ReLU, the last one too.
#[derive(Module, Debug)]
pub(crate) struct SkyMapping {
    /// Every second place is an activation, which has no parameters.
    mapping: Vec<Option<Linear>>,
}

impl SkyMapping {
    pub(crate) fn load(loader: &Loader<'_>, config: &Config) -> Result<Self, ModelError> {
        let place = loader.child("mapping");
        let mut mapping = Vec::with_capacity(2 * config.sky_mapping_layers);
        for layer in 0..config.sky_mapping_layers {
            let last = layer + 1 == config.sky_mapping_layers;
            let outputs = if last { config.style } else { HISTOGRAM };
            mapping.push(Some(Linear::load(&place.child(2 * layer), HISTOGRAM, outputs)?));
            mapping.push(None);
        }
        Ok(Self { mapping })
    }

    /// `1 x 270` to `1 x 512`.
    pub(crate) fn forward(&self, histogram: Tensor<2>) -> Tensor<2> {
        self.mapping.iter().fold(histogram, |code, layer| match layer {
            Some(linear) => linear.forward(code),
            None => activation::leaky_relu(code, 0.2),
        })
    }
}
