//! The network that is trained: image to map, map to field, sky, super-resolution.

use super::TrainError;
use super::field::{FieldTensors, Head, HeadSizes};
use super::learner::NamedTensor;
use super::mini;
use super::optimiser::{AdamW, Average, finite, named_parameters};
use super::parameters::{Stored, with_parameters};
use super::rays::Rays;
use super::render::{Rendered, Samples, SkyTensors, compose, render};
use crate::config::{BackboneConfig, Border, Config, SKY_SEED};
use crate::error::ModelError;
use crate::field::{DensityActivation, Representation};
use crate::network::decoder::Decoder;
use crate::network::encoder::{Encoder, RotaryTable};
use crate::network::loader::Loader;
use crate::network::probe::Probe;
use crate::network::sky::SkyMapping;
use crate::network::super_resolution::SuperResolution;
use crate::network::unet::{Mode, Statistics, UNet, absorb};
use crate::random::Draw;
use crate::render::Composite;
use crate::weights::TensorSource;
use burn::module::Module;
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Gradients, Tensor, TensorData, activation};
use std::sync::Arc;

/// What makes maps of images.
pub trait MapNetwork: Module {
    /// Where its parameters lie in a checkpoint.
    const PREFIX: &'static str;

    /// Normalised images (`batch x 3 x side x side`) to maps (`batch x channels x n x n`), in training.
    /// What batch norms meet goes to `statistics`.
    fn maps(&self, images: Tensor<4>, statistics: &mut Statistics) -> Tensor<4>;

    /// Called after a step with what its norms met.
    #[must_use]
    fn absorb(self, _statistics: &Statistics) -> Self {
        self
    }

    /// Called before each step of training with a number that names the step's random numbers.
    fn name_step(&mut self, _name: u64) {}

    /// What a checkpoint holds beside the parameters that are trained.
    fn frozen(&self) -> Vec<NamedTensor> {
        Vec::new()
    }

    /// The tensors of a finished model, from those of one in training.
    ///
    /// # Errors
    /// [`TrainError::State`] where one is missing.
    fn finished(&self, weights: Vec<NamedTensor>) -> Result<Vec<NamedTensor>, TrainError> {
        Ok(weights)
    }
}

/// The released network's encoder, frozen, and its decoder.
#[derive(Module, Debug)]
pub struct ReleasedMap {
    decoder: Decoder,
    #[module(skip)]
    encoder: Frozen,
}

#[derive(Clone, Debug)]
struct Frozen {
    encoder: Arc<Encoder>,
    backbone: BackboneConfig,
    /// Empty tokens on each side.
    pad: usize,
    /// Largest factor of the encoder's coordinates in training; 1 for none.
    rescale: f64,
    /// The table of this step, where it is not the usual one.
    rotary: Option<Arc<RotaryTable>>,
}

impl ReleasedMap {
    /// Places in a checkpoint.
    const ENCODER: &'static str = "unet_model.dino_model";

    /// `rescale` is 2 in the release: training multiplies the coordinates of the encoder's patches by a
    /// number between 1/2 and 2, log-uniform, one for each step.
    pub(crate) fn load(
        config: &Config,
        source: &dyn TensorSource,
        device: &Device,
        rescale: f64,
    ) -> Result<Self, ModelError> {
        let plain = device.clone().without_autodiff();
        let root = Loader::new(source, &plain).child("unet_model");
        let encoder = Encoder::load(&root.child("dino_model"), &config.backbone)?;
        let root = Loader::new(source, device).child("unet_model");
        Ok(Self {
            decoder: Decoder::load(&root.child("decoder"), &config.decoder, Border::Zeros)?,
            encoder: Frozen {
                encoder: Arc::new(encoder),
                backbone: config.backbone.clone(),
                pad: config.pad_tokens(),
                rescale,
                rotary: None,
            },
        })
    }
}

impl MapNetwork for ReleasedMap {
    const PREFIX: &'static str = "unet_model";

    fn maps(&self, images: Tensor<4>, _statistics: &mut Statistics) -> Tensor<4> {
        let Frozen { encoder, pad, rotary, .. } = &self.encoder;
        let tracked = images.is_autodiff();
        let images = images.without_autodiff();
        let rotary = rotary.as_deref();
        one_by_one(images, |image| {
            let mut tokens = encoder.forward_turned(image, rotary, &mut Probe::none());
            if *pad > 0 {
                tokens = tokens.pad([(*pad, *pad); 2], PadMode::Constant(0.0));
            }
            let tokens = if tracked { tokens.autodiff() } else { tokens };
            self.decoder.forward(tokens, &mut Probe::none())
        })
    }

    fn name_step(&mut self, name: u64) {
        let frozen = &mut self.encoder;
        frozen.rotary = (frozen.rescale != 1.0).then(|| {
            let range = libm::log(frozen.rescale);
            let factor = libm::exp(Draw::new(&[name]).range(-range, range));
            Arc::new(RotaryTable::scaled(&frozen.backbone, factor))
        });
    }

    fn frozen(&self) -> Vec<NamedTensor> {
        named_parameters(Self::ENCODER, self.encoder.encoder.as_ref())
    }
}

/// The small network, fresh, with its norms.
#[derive(Module, Debug)]
pub struct MiniMap {
    unet: UNet,
    #[module(skip)]
    config: Config,
}

impl MiniMap {
    /// Share of a batch in the running statistics of the norms.
    const MOMENTUM: f64 = 0.05;
}

impl MapNetwork for MiniMap {
    const PREFIX: &'static str = "";

    fn maps(&self, images: Tensor<4>, statistics: &mut Statistics) -> Tensor<4> {
        let planes = self.unet.planes(images, Mode::Train(statistics));
        let [batch, _, rows, columns] = planes.dims();
        let channels = self.config.plane_channels;
        // The reader takes the mean over rows, so the line stands in every one.
        let line: Tensor<4> = self.unet.line().reshape([1, channels, 1, columns]);
        Tensor::cat(vec![planes, line.expand([batch, channels, rows, columns])], 1)
    }

    fn absorb(self, statistics: &Statistics) -> Self {
        absorb(self, statistics, Self::MOMENTUM)
    }

    fn finished(&self, weights: Vec<NamedTensor>) -> Result<Vec<NamedTensor>, TrainError> {
        mini::finished(&self.config, weights)
    }
}

/// Runs a module that takes one image at a time.
fn one_by_one(images: Tensor<4>, of: impl FnMut(Tensor<4>) -> Tensor<4>) -> Tensor<4> {
    let results: Vec<Tensor<4>> = images.split(1, 0).into_iter().map(of).collect();
    Tensor::cat(results, 0)
}

/// What does not change while the network is trained.
#[derive(Clone, Debug)]
pub(crate) struct Shape {
    /// How points read the map.
    pub representation: Representation,
    /// From raw to volume density.
    pub activation: DensityActivation,
    /// The crop covers x and y in [-scale, scale].
    pub scale: f64,
    /// Sizes of the point head.
    pub head: HeadSizes,
    /// Side of the images that the map network reads.
    pub image_side: usize,
    /// 2 with super-resolution, else 1.
    pub enlarged: usize,
    /// Whether the style code is the sky's mean colour, as the small network has it.
    pub plain_style: bool,
}

impl Shape {
    /// That of a configured network.
    pub(crate) fn of(config: &Config) -> Self {
        Self {
            representation: config.representation,
            activation: config.activation,
            scale: config.scale,
            head: HeadSizes::of(config),
            image_side: config.image_side(),
            enlarged: config.super_resolution,
            plain_style: config.unet.is_some(),
        }
    }
}

/// The parts of a generator. Sky and super-resolution may be absent.
#[derive(Clone, Debug)]
pub(crate) struct Generator<M> {
    pub map: M,
    pub head: Head,
    pub sky_mapping: Option<SkyMapping>,
    pub sky_decoder: Option<Decoder>,
    pub sharp: Option<SuperResolution>,
}

/// The light of one image's street views.
pub(crate) struct Light {
    /// What all colours have in common.
    tint: Tensor<2>,
    sky: Background,
}

/// What lies behind the scene.
enum Background {
    Map(SkyTensors),
    /// One colour, which has no parameters.
    Plain(Tensor<2>),
}

/// One view of one image, channels first.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// `1 x 1 x height x width`.
    pub depth: Tensor<4>,
    /// `1 x 1 x height x width`.
    pub opacity: Tensor<4>,
    /// `1 x colours x height x width`: over the sky where there is one, else the scene's own.
    pub colors: Tensor<4>,
    /// The sky along the rays, `1 x colours x height x width`.
    pub sky: Option<Tensor<4>>,
    /// `1 x 3 x 2 height x 2 width`, with super-resolution.
    pub sharp: Option<Tensor<4>>,
}

impl Generator<ReleasedMap> {
    /// The released network, or one of its shape. Without `sky` the sky's modules are left out, and so is
    /// super-resolution without `sharp`.
    pub(crate) fn load(
        config: &Config,
        source: &dyn TensorSource,
        device: &Device,
        rescale: f64,
        [sky, sharp]: [bool; 2],
    ) -> Result<Self, ModelError> {
        let root = Loader::new(source, device);
        let sky_decoder =
            || Decoder::load(&root.child("sky_decoder"), &config.sky, Border::Circular);
        Ok(Self {
            map: ReleasedMap::load(config, source, device, rescale)?,
            head: Head::load(&root.child("mlp"), HeadSizes::of(config))?,
            sky_mapping: sky
                .then(|| SkyMapping::load(&root.child("sky_mapping"), config))
                .transpose()?,
            sky_decoder: sky.then(sky_decoder).transpose()?,
            sharp: (sharp && config.super_resolution == 2)
                .then(|| SuperResolution::load(&root.child("sr_module"), config))
                .transpose()?,
        })
    }
}

impl Generator<MiniMap> {
    /// The small network from a seed, or from the weights of a training that went before.
    pub(crate) fn mini(
        config: &Config,
        source: &dyn TensorSource,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let root = Loader::new(source, device);
        let Some(unet) = &config.unet else {
            return Err(TrainError::State("not a small network".into()));
        };
        let (channels, pad) = (config.plane_channels, config.pad_tokens());
        let unet = UNet::load(&root.child("unet"), unet, channels, pad, true)?;
        Ok(Self {
            map: MiniMap { unet, config: config.clone() },
            head: Head::load(&root.child("mlp"), HeadSizes::of(config))?,
            sky_mapping: None,
            sky_decoder: None,
            sharp: None,
        })
    }
}

impl<M: MapNetwork> Generator<M> {
    /// The fields of normalised images, one each.
    pub(crate) fn fields(
        &self,
        shape: &Shape,
        images: Tensor<4>,
        statistics: &mut Statistics,
    ) -> Vec<FieldTensors> {
        let maps = self.map.maps(images, statistics);
        let [_, channels, height, width] = maps.dims();
        maps.split(1, 0)
            .into_iter()
            .map(|map| {
                let map = map.reshape([channels, height, width]);
                FieldTensors::new(map, &self.head, shape.representation, shape.activation)
            })
            .collect()
    }

    /// The light of the satellite view: no style.
    pub(crate) fn overhead(&self) -> Tensor<2> {
        self.head.tint(None)
    }

    /// The light of street views: from the illumination histogram with the sky's modules, else the plain
    /// colour given.
    pub(crate) fn light(&self, histogram: &[f32], plain: [f32; 3], shape: &Shape) -> Light {
        let device = self.overhead().device();
        let (Some(mapping), Some(decoder)) = (&self.sky_mapping, &self.sky_decoder) else {
            let mut colors = vec![0.0; shape.head.colors];
            colors[..3].copy_from_slice(&plain);
            let data = TensorData::new(colors, [1, shape.head.colors]);
            let sky = Background::Plain(Tensor::from_data(data, &device));
            let style = shape
                .plain_style
                .then(|| Tensor::from_data(TensorData::new(plain.to_vec(), [1, 3]), &device));
            return Light { tint: self.head.tint(style), sky };
        };
        let data = TensorData::new(histogram.to_vec(), [1, histogram.len()]);
        let style = mapping.forward(Tensor::from_data(data, &device));
        let [_, length] = style.dims();
        let seed = style.clone().reshape([1, length, 1, 1]);
        let seed = seed.expand([1, length, SKY_SEED, SKY_SEED]);
        let map = activation::sigmoid(decoder.forward(seed, &mut Probe::none()));
        let [_, channels, height, width] = map.dims();
        let sky = SkyTensors::new(map.reshape([channels, height, width]));
        Light { tint: self.head.tint(Some(style)), sky: Background::Map(sky) }
    }

    /// The crop from above; colours are the scene's own.
    pub(crate) fn above(
        &self,
        field: &FieldTensors,
        rays: &Rays,
        samples: Samples,
        tint: Option<&Tensor<2>>,
    ) -> View {
        let Rendered { depth, opacity, feature } = render(field, rays, samples, tint);
        let colors = feature.unwrap_or_else(|| opacity.clone());
        let planes = |rows| planes(rows, rays);
        View {
            depth: planes(depth),
            opacity: planes(opacity),
            colors: planes(colors),
            sky: None,
            sharp: None,
        }
    }

    /// A view from the street.
    pub(crate) fn street(
        &self,
        field: &FieldTensors,
        rays: &Rays,
        samples: Samples,
        light: &Light,
        composite: Composite,
    ) -> View {
        let Rendered { depth, opacity, feature } = render(field, rays, samples, Some(&light.tint));
        let behind = match &light.sky {
            Background::Map(map) => map.lookup(&rays.directions),
            Background::Plain(color) => color.clone().repeat_dim(0, rays.count()),
        };
        let feature = feature.unwrap_or_else(|| behind.clone());
        let colors = compose(feature, opacity.clone(), behind.clone(), composite);
        let planes = |rows| planes(rows, rays);
        let colors = planes(colors);
        let sharp =
            self.sharp.as_ref().map(|module| module.forward(colors.clone(), &mut Probe::none()));
        View {
            depth: planes(depth),
            opacity: planes(opacity),
            colors,
            sky: Some(planes(behind)),
            sharp,
        }
    }

    /// One step of an optimiser for every part.
    pub(crate) fn step(self, optimiser: &mut AdamW, gradients: &Gradients, scale: f64) -> Self {
        Self {
            map: optimiser.step(M::PREFIX, self.map, gradients, scale),
            head: optimiser.step("mlp", self.head, gradients, scale),
            sky_mapping: self
                .sky_mapping
                .map(|part| optimiser.step("sky_mapping", part, gradients, scale)),
            sky_decoder: self
                .sky_decoder
                .map(|part| optimiser.step("sky_decoder", part, gradients, scale)),
            sharp: self.sharp.map(|part| optimiser.step("sr_module", part, gradients, scale)),
        }
    }

    /// Whether every gradient is finite.
    pub(crate) fn finite(&self, gradients: &Gradients) -> bool {
        finite(&self.map, gradients)
            && finite(&self.head, gradients)
            && self.sky_mapping.as_ref().is_none_or(|part| finite(part, gradients))
            && self.sky_decoder.as_ref().is_none_or(|part| finite(part, gradients))
            && self.sharp.as_ref().is_none_or(|part| finite(part, gradients))
    }

    /// Takes the weights into an average.
    pub(crate) fn average(&self, average: &mut Average) {
        average.update(M::PREFIX, &self.map);
        average.update("mlp", &self.head);
        if let Some(part) = &self.sky_mapping {
            average.update("sky_mapping", part);
        }
        if let Some(part) = &self.sky_decoder {
            average.update("sky_decoder", part);
        }
        if let Some(part) = &self.sharp {
            average.update("sr_module", part);
        }
        average.advance();
    }

    /// The parameters that are trained, by their keys in a checkpoint.
    pub(crate) fn parameters(&self) -> Vec<NamedTensor> {
        let mut list = named_parameters(M::PREFIX, &self.map);
        list.extend(named_parameters("mlp", &self.head));
        if let Some(part) = &self.sky_mapping {
            list.extend(named_parameters("sky_mapping", part));
        }
        if let Some(part) = &self.sky_decoder {
            list.extend(named_parameters("sky_decoder", part));
        }
        if let Some(part) = &self.sharp {
            list.extend(named_parameters("sr_module", part));
        }
        list
    }

    /// The same with other weights.
    ///
    /// # Errors
    /// [`TrainError::State`] where one is missing or of another shape.
    pub(crate) fn with(self, stored: &mut Stored<'_>) -> Result<Self, TrainError> {
        Ok(Self {
            map: with_parameters(M::PREFIX, self.map, stored)?,
            head: with_parameters("mlp", self.head, stored)?,
            sky_mapping: self
                .sky_mapping
                .map(|part| with_parameters("sky_mapping", part, stored))
                .transpose()?,
            sky_decoder: self
                .sky_decoder
                .map(|part| with_parameters("sky_decoder", part, stored))
                .transpose()?,
            sharp: self.sharp.map(|part| with_parameters("sr_module", part, stored)).transpose()?,
        })
    }
}

/// One row a ray to channels first.
fn planes(rows: Tensor<2>, rays: &Rays) -> Tensor<4> {
    let [_, channels] = rows.dims();
    rows.transpose().reshape([1, channels, rays.height, rays.width])
}
