//! The network on oneDNN's convolutions and products of matrices.
//!
//! Maps stay in the order in which convolutions read them from the first layer to the last. Norm, swish, border, doubling and
//! conversion are one pass between two convolutions; the second convolution of a residual block adds to the first's input
//! where that lies. What the library does not serve here (the dense layers of the sky, super-resolution) goes through
//! [`BurnNetwork`].

mod attention;
mod decoder;
mod encoder;
#[cfg(test)]
mod hard_cases;
mod layers;
mod map;
mod passes;
#[cfg(test)]
mod tests;

use super::burned::{Observer, check, check_length, probe};
use super::loader::Place;
use super::precision::Precision;
use super::{BurnNetwork, Device, Network, StagedNetwork};
use crate::config::{Border, Config, PATCHES, SKY_SEED};
use crate::error::ModelError;
use crate::field::kernel::sigmoid;
use crate::tensor::Grid;
use crate::weights::TensorSource;
use decoder::Decoder;
use encoder::Encoder;
use layers::Numerics;
use map::Context;
use sat3d_onednn::{Algorithm, Element, Instructions, Library, Order};
use std::sync::{Arc, Mutex, PoisonError};

/// The network on this processor, with its library. One image at a time; each module is compiled and packed when it is
/// first needed.
pub struct OneDnnNetwork {
    config: Config,
    source: Arc<dyn TensorSource>,
    numerics: Numerics,
    library: &'static Library,
    /// For what is not served here.
    rest: BurnNetwork,
    state: Mutex<State>,
}

struct State {
    context: Context,
    encoder: Option<Encoder>,
    decoder: Option<Decoder>,
    sky: Option<Decoder>,
}

impl std::fmt::Debug for OneDnnNetwork {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut out = formatter.debug_struct("OneDnnNetwork");
        out.field("numerics", &self.numerics).finish_non_exhaustive()
    }
}

/// Why a precision is not served on this machine, or nothing.
pub(super) fn refusal(precision: Precision) -> Option<String> {
    let library = match Library::get() {
        Ok(library) => library,
        Err(error) => return Some(error.to_string()),
    };
    let least = match precision {
        Precision::Fp32 => Instructions::Other,
        Precision::Fp32Winograd => Instructions::Avx512,
        Precision::Bf16 => Instructions::Avx512Bf16,
    };
    let found = library.instructions();
    (found < least).then(|| {
        format!("this processor (or DNNL_MAX_CPU_ISA) offers {found:?}; it needs {least:?}")
    })
}

/// Whether 16-bit floats are multiplied faster than 32-bit ones here.
pub(super) fn has_tiles() -> bool {
    Library::get().is_ok_and(|library| library.instructions() == Instructions::Amx)
}

impl OneDnnNetwork {
    /// A network whose weights are still at their source.
    ///
    /// # Errors
    /// [`ModelError::Device`] where the machine has not the library, or the processor not the precision.
    pub fn new(
        config: Config,
        source: Box<dyn TensorSource>,
        precision: Precision,
    ) -> Result<Self, ModelError> {
        let refused = |why| ModelError::Device { name: format!("onednn, {precision}"), why };
        if let Some(why) = refusal(precision) {
            return Err(refused(why));
        }
        let library = Library::get().map_err(|error| refused(error.to_string()))?;
        let source: Arc<dyn TensorSource> = source.into();
        let rest = BurnNetwork::new(config.clone(), Box::new(Arc::clone(&source)), Device::Cpu)?;
        let direct = Algorithm::Direct;
        let (element, order, algorithm) = match precision {
            Precision::Fp32 => (Element::F32, Order::Pixels, direct),
            Precision::Fp32Winograd => (Element::F32, Order::Blocks, Algorithm::Winograd),
            Precision::Bf16 => (Element::Bf16, Order::Pixels, direct),
        };
        let numerics = Numerics { element, order, algorithm };
        let context = Context::new(library)?;
        let state = Mutex::new(State { context, encoder: None, decoder: None, sky: None });
        Ok(Self { config, source, numerics, library, rest, state })
    }

    /// Runs one stage; stages take turns. What an interrupted one left behind is not used again.
    fn with<T>(
        &self,
        run: impl FnOnce(&mut State) -> Result<T, ModelError>,
    ) -> Result<T, ModelError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.library.set_threads(rayon::current_num_threads());
        run(&mut state)
    }

    fn root(&self) -> Place<'_> {
        Place::new(self.source.as_ref())
    }
}

impl StagedNetwork for OneDnnNetwork {
    fn config(&self) -> &Config {
        &self.config
    }

    fn tokens(&self, image: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError> {
        let side = self.config.image_side();
        check("image", image, [3, side, side])?;
        self.with(|State { context, encoder, .. }| {
            let encoder = match encoder {
                Some(encoder) => encoder,
                None => {
                    let place = self.root().child("unet_model").child("dino_model");
                    let element = self.numerics.element;
                    let config = &self.config.backbone;
                    encoder.insert(Encoder::load(self.library, &place, config, element)?)
                }
            };
            encoder.forward(context, image, &self.root(), &mut probe(observer))
        })
    }

    fn decode(&self, tokens: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError> {
        check("tokens", tokens, [self.config.backbone.hidden, PATCHES, PATCHES])?;
        let pad = self.config.pad_tokens();
        self.with(|State { context, decoder, .. }| {
            let decoder = match decoder {
                Some(decoder) => decoder,
                None => {
                    let place = self.root().child("unet_model").child("decoder");
                    let size = (PATCHES + 2 * pad, Border::Zeros);
                    let config = &self.config.decoder;
                    let made = Decoder::load(self.library, &place, config, size, self.numerics)?;
                    decoder.insert(made)
                }
            };
            decoder.forward(context, tokens, pad, &mut probe(observer))
        })
    }

    fn sky_observed(&self, style: &[f32], observer: Observer<'_>) -> Result<Grid, ModelError> {
        let channels = self.config.style;
        check_length("style code", style, channels)?;
        let seed: Vec<f32> = style.iter().flat_map(|&value| [value; SKY_SEED * SKY_SEED]).collect();
        let seed = Grid::new(channels, SKY_SEED, SKY_SEED, seed);
        let map = self.with(|State { context, sky, .. }| {
            let sky = match sky {
                Some(sky) => sky,
                None => {
                    let place = self.root().child("sky_decoder");
                    let size = (SKY_SEED, Border::Circular);
                    // Its colours are seen as they are.
                    let numerics = Numerics { element: Element::F32, ..self.numerics };
                    let config = &self.config.sky;
                    sky.insert(Decoder::load(self.library, &place, config, size, numerics)?)
                }
            };
            sky.forward(context, &seed, 0, &mut probe(observer))
        })?;
        let width = self.config.sky_width();
        let mut data = vec![0.0; map.channels * map.height * width];
        for (from, to) in map.data.chunks_exact(map.width).zip(data.chunks_exact_mut(width)) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to = sigmoid(*from));
        }
        Ok(Grid::new(map.channels, map.height, width, data))
    }

    fn super_resolve_observed(
        &self,
        features: &Grid,
        observer: Observer<'_>,
    ) -> Result<Grid, ModelError> {
        self.rest.super_resolve_observed(features, observer)
    }
}

impl Network for OneDnnNetwork {
    fn map(&self, image: &Grid) -> Result<Grid, ModelError> {
        self.decode(&self.tokens(image, None)?, None)
    }

    fn style(&self, histogram: &[f32]) -> Result<Vec<f32>, ModelError> {
        self.rest.style(histogram)
    }

    fn sky(&self, style: &[f32]) -> Result<Grid, ModelError> {
        self.sky_observed(style, None)
    }

    fn super_resolve(&self, features: &Grid) -> Result<Grid, ModelError> {
        self.rest.super_resolve(features)
    }
}
