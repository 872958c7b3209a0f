//! The network served by `burn` modules.

use super::decoder::Decoder;
use super::encoder::Encoder;
use super::loader::Loader;
use super::probe::{Probe, Stage};
use super::sky::SkyMapping;
use super::super_resolution::SuperResolution;
use super::{Device, Network, StagedNetwork};
use crate::config::{Border, Config, HISTOGRAM, PATCHES, SKY_SEED};
use crate::error::ModelError;
use crate::tensor::Grid;
use crate::weights::TensorSource;
use burn::tensor::ops::PadMode;
use burn::tensor::{Tensor, TensorData, activation};
use std::sync::{Mutex, OnceLock, PoisonError};

/// Something to hand each intermediate stage to, or nothing.
pub type Observer<'a> = Option<&'a mut dyn FnMut(Stage)>;

/// The network on one device. Each module is read from its source when it is first needed and stays
/// from then on.
pub struct BurnNetwork {
    config: Config,
    source: Box<dyn TensorSource>,
    device: burn::tensor::Device,
    encoder: Lazy<Encoder>,
    decoder: Lazy<Decoder>,
    sky_mapping: Lazy<SkyMapping>,
    sky_decoder: Lazy<Decoder>,
    super_resolution: Lazy<SuperResolution>,
}

impl std::fmt::Debug for BurnNetwork {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("BurnNetwork").field("config", &self.config).finish_non_exhaustive()
    }
}

impl BurnNetwork {
    /// A network whose weights are still at their source.
    ///
    /// # Errors
    /// [`ModelError::Device`] where the device was left out of this program.
    pub fn new(
        config: Config,
        source: Box<dyn TensorSource>,
        device: Device,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            config,
            source,
            device: device.open()?,
            encoder: Lazy::default(),
            decoder: Lazy::default(),
            sky_mapping: Lazy::default(),
            sky_decoder: Lazy::default(),
            super_resolution: Lazy::default(),
        })
    }

    fn encoder(&self) -> Result<&Encoder, ModelError> {
        self.encoder.get(|| {
            let place = self.root().child("unet_model").child("dino_model");
            Encoder::load(&place, &self.config.backbone)
        })
    }

    fn decoder(&self) -> Result<&Decoder, ModelError> {
        self.decoder.get(|| {
            let place = self.root().child("unet_model").child("decoder");
            Decoder::load(&place, &self.config.decoder, Border::Zeros)
        })
    }

    fn sky_mapping(&self) -> Result<&SkyMapping, ModelError> {
        self.sky_mapping.get(|| SkyMapping::load(&self.root().child("sky_mapping"), &self.config))
    }

    fn sky_decoder(&self) -> Result<&Decoder, ModelError> {
        self.sky_decoder.get(|| {
            Decoder::load(&self.root().child("sky_decoder"), &self.config.sky, Border::Circular)
        })
    }

    fn super_resolution(&self) -> Result<&SuperResolution, ModelError> {
        self.super_resolution
            .get(|| SuperResolution::load(&self.root().child("sr_module"), &self.config))
    }

    fn root(&self) -> Loader<'_> {
        Loader::new(self.source.as_ref(), &self.device)
    }

    fn upload(&self, grid: &Grid) -> Tensor<4> {
        let shape = [1, grid.channels, grid.height, grid.width];
        Tensor::from_data(TensorData::new(grid.data.clone(), shape), &self.device)
    }

    /// Keys and shapes of all parameters of all modules, loaded for it.
    #[cfg(test)]
    pub(super) fn parameters(&self) -> Result<Vec<(String, Vec<usize>)>, ModelError> {
        use super::tests::listed;
        let mut list = listed("unet_model.dino_model", self.encoder()?);
        list.extend(listed("unet_model.decoder", self.decoder()?));
        list.extend(listed("sky_mapping", self.sky_mapping()?));
        list.extend(listed("sky_decoder", self.sky_decoder()?));
        list.extend(listed("sr_module", self.super_resolution()?));
        Ok(list)
    }
}

impl StagedNetwork for BurnNetwork {
    fn config(&self) -> &Config {
        &self.config
    }

    fn tokens(&self, image: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError> {
        let side = self.config.image_side();
        check("image", image, [3, side, side])?;
        let tokens = self.encoder()?.forward(self.upload(image), &mut probe(observer));
        download("encoder", tokens)
    }

    fn decode(&self, tokens: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError> {
        check("tokens", tokens, [self.config.backbone.hidden, PATCHES, PATCHES])?;
        let mut tokens = self.upload(tokens);
        let pad = self.config.pad_tokens();
        if pad > 0 {
            tokens = tokens.pad([(pad, pad); 2], PadMode::Constant(0.0));
        }
        download("decoder", self.decoder()?.forward(tokens, &mut probe(observer)))
    }

    fn sky_observed(&self, style: &[f32], observer: Observer<'_>) -> Result<Grid, ModelError> {
        let channels = self.config.style;
        check_length("style code", style, channels)?;
        let seed: Vec<f32> = style.iter().flat_map(|&value| [value; SKY_SEED * SKY_SEED]).collect();
        let seed = self.upload(&Grid::new(channels, SKY_SEED, SKY_SEED, seed));
        let map = self.sky_decoder()?.forward(seed, &mut probe(observer));
        let below = self.config.sky_width() - self.config.sky_side();
        let map = activation::sigmoid(map).pad([(0, 0), (0, below)], PadMode::Constant(0.0));
        download("sky decoder", map)
    }

    fn super_resolve_observed(
        &self,
        features: &Grid,
        observer: Observer<'_>,
    ) -> Result<Grid, ModelError> {
        if self.config.super_resolution != 2 {
            let why = "`opt.network.sr_factor` is 1".into();
            return Err(ModelError::Absent { part: "super-resolution", why });
        }
        // Mirroring the border takes a second row and column.
        let least = |side: usize| side.max(2);
        let shape = [self.config.color_channels, least(features.height), least(features.width)];
        check("rendered features", features, shape)?;
        let module = self.super_resolution()?;
        let image = module.forward(self.upload(features), &mut probe(observer));
        download("super-resolution", image)
    }
}

impl Network for BurnNetwork {
    fn map(&self, image: &Grid) -> Result<Grid, ModelError> {
        self.decode(&self.tokens(image, None)?, None)
    }

    fn style(&self, histogram: &[f32]) -> Result<Vec<f32>, ModelError> {
        check_length("illumination histogram", histogram, HISTOGRAM)?;
        let data = TensorData::new(histogram.to_vec(), [1, HISTOGRAM]);
        let code = self.sky_mapping()?.forward(Tensor::from_data(data, &self.device));
        values("sky mapping", code)
    }

    fn sky(&self, style: &[f32]) -> Result<Grid, ModelError> {
        self.sky_observed(style, None)
    }

    fn super_resolve(&self, features: &Grid) -> Result<Grid, ModelError> {
        self.super_resolve_observed(features, None)
    }
}

pub(super) fn probe(observer: Observer<'_>) -> Probe<'_> {
    match observer {
        Some(sink) => Probe::new(sink),
        None => Probe::none(),
    }
}

pub(super) fn check(what: &'static str, grid: &Grid, shape: [usize; 3]) -> Result<(), ModelError> {
    let [channels, height, width] = shape;
    if [grid.channels, grid.height, grid.width] == shape {
        return Ok(());
    }
    Err(ModelError::Shape {
        what,
        expected: format!("{channels} x {height} x {width}"),
        found: format!("{} x {} x {}", grid.channels, grid.height, grid.width),
    })
}

pub(super) fn check_length(
    what: &'static str,
    values: &[f32],
    length: usize,
) -> Result<(), ModelError> {
    if values.len() == length {
        return Ok(());
    }
    let (expected, found) = (format!("{length} values"), format!("{} values", values.len()));
    Err(ModelError::Shape { what, expected, found })
}

/// Brings a tensor back from the device.
fn values<const D: usize>(stage: &'static str, tensor: Tensor<D>) -> Result<Vec<f32>, ModelError> {
    let failed = |why: String| ModelError::Backend { stage, why };
    let data = tensor.try_into_data().map_err(|error| failed(error.to_string()))?;
    data.try_into_vec().map_err(|error| failed(error.to_string()))
}

pub(super) fn download(stage: &'static str, tensor: Tensor<4>) -> Result<Grid, ModelError> {
    let [_, channels, height, width] = tensor.dims();
    Ok(Grid::new(channels, height, width, values(stage, tensor)?))
}

/// A value made at its first use; a failed attempt leaves it to be made.
struct Lazy<T> {
    value: OnceLock<T>,
    making: Mutex<()>,
}

impl<T> Default for Lazy<T> {
    fn default() -> Self {
        Self { value: OnceLock::new(), making: Mutex::new(()) }
    }
}

impl<T> Lazy<T> {
    fn get(&self, make: impl FnOnce() -> Result<T, ModelError>) -> Result<&T, ModelError> {
        if let Some(value) = self.value.get() {
            return Ok(value);
        }
        // The lock guards no data: a panic elsewhere has left nothing half done.
        let _making = self.making.lock().unwrap_or_else(PoisonError::into_inner);
        match self.value.get() {
            Some(value) => Ok(value),
            None => {
                let value = make()?;
                Ok(self.value.get_or_init(|| value))
            }
        }
    }
}
