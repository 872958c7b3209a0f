//! Rendered features to an image of twice the size (MODEL_SPEC section 9.2).
#![expect(
    non_snake_case,
    reason = "a parameter's path is made of the names of the fields: `toRGB`"
)]

use super::layers::{Conv, bilinear, standardise};
use super::loader::Loader;
use super::probe::Probe;
use crate::config::Config;
use crate::error::ModelError;
use burn::module::Module;
use burn::tensor::{Tensor, activation};

/// The upsampler.
#[derive(Module, Debug)]
pub(crate) struct SuperResolution {
    block0: Features,
    block1: Residual,
}

impl SuperResolution {
    pub(crate) fn load(loader: &Loader<'_>, config: &Config) -> Result<Self, ModelError> {
        Ok(Self {
            block0: Features::load(&loader.child("block0"), config)?,
            block1: Residual::load(&loader.child("block1"), config)?,
        })
    }

    /// `1 x colours x h x w` to `1 x 3 x 2h x 2w`: the first three channels enlarged, plus a
    /// residual.
    pub(crate) fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let rgb = input.clone().narrow(1, 0, 3);
        let features = probe.inside("block0", |probe| self.block0.forward(input, probe));
        probe.see("block0", &features);
        let residual = probe.inside("block1", |probe| self.block1.forward(features, probe));
        (bilinear(rgb) + residual).clamp(0.0, 1.0)
    }
}

/// Two convolutions beside a 1 x 1 one.
#[derive(Module, Debug)]
struct Features {
    conv0: ConvBlock,
    conv1: ConvBlock,
    skip_conv: Conv,
}

impl Features {
    fn load(loader: &Loader<'_>, config: &Config) -> Result<Self, ModelError> {
        let (inputs, width) = (config.color_channels, config.super_resolution_channels);
        Ok(Self {
            conv0: ConvBlock::load(&loader.child("conv0"), inputs, config)?,
            conv1: ConvBlock::load(&loader.child("conv1"), width, config)?,
            skip_conv: Conv::load(&loader.child("skip_conv"), inputs, width, 1)?,
        })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let skipped = self.skip_conv.forward(input.clone());
        probe.see("skip_conv", &skipped);
        let map = probe.inside("conv0", |probe| self.conv0.forward(input, probe));
        probe.see("conv0", &map);
        let map = probe.inside("conv1", |probe| self.conv1.forward(map, probe));
        probe.see("conv1", &map);
        map + skipped
    }
}

/// Enlarges, two convolutions, to colours.
#[derive(Module, Debug)]
struct Residual {
    conv0: ConvBlock,
    conv1: ConvBlock,
    toRGB: Conv,
}

impl Residual {
    fn load(loader: &Loader<'_>, config: &Config) -> Result<Self, ModelError> {
        let width = config.super_resolution_channels;
        Ok(Self {
            conv0: ConvBlock::load(&loader.child("conv0"), width, config)?,
            conv1: ConvBlock::load(&loader.child("conv1"), width, config)?,
            toRGB: Conv::without_bias(&loader.child("toRGB"), width, 3)?,
        })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let map = bilinear(input);
        let map = probe.inside("conv0", |probe| self.conv0.forward(map, probe));
        probe.see("conv0", &map);
        let map = probe.inside("conv1", |probe| self.conv1.forward(map, probe));
        probe.see("conv1", &map);
        let residual = self.toRGB.forward(map);
        probe.see("toRGB", &residual);
        residual
    }
}

/// Convolution, normalisation of each channel over the whole frame, leaky ReLU.
#[derive(Module, Debug)]
struct ConvBlock {
    conv: Conv,
}

impl ConvBlock {
    const EPSILON: f64 = 1e-5;

    fn load(loader: &Loader<'_>, inputs: usize, config: &Config) -> Result<Self, ModelError> {
        let width = config.super_resolution_channels;
        let conv = Conv::load(&loader.child("conv"), inputs, width, 3)?;
        Ok(Self { conv: conv.with_border(config.super_resolution_border) })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let map = self.conv.forward(input);
        probe.see("conv", &map);
        let channels = map.dims()[1];
        let (centred, inverse) = standardise(map, channels, Self::EPSILON);
        let map = centred * inverse;
        probe.see("norm", &map);
        activation::leaky_relu(map, 0.2)
    }
}
