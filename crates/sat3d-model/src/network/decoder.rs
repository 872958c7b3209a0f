//! The convolutional decoder (MODEL_SPEC section 5), once for the feature map and once, with
//! circular borders and without attention, for the sky.

use super::layers::{Conv, GroupNorm, nearest, swish};
use super::loader::Loader;
use super::probe::Probe;
use crate::config::{Border, DecoderConfig};
use crate::error::ModelError;
use burn::module::Module;
use burn::tensor::{Tensor, activation};

/// Low-resolution map to high-resolution map.
#[derive(Module, Debug)]
pub(crate) struct Decoder {
    conv_in: Conv,
    mid: Middle,
    up: Vec<Level>,
    norm_out: GroupNorm,
    conv_out: Conv,
}

impl Decoder {
    /// `border` is that of `conv_in`, `conv_out` and each level's first convolutions; all others
    /// pad with zeros.
    pub(crate) fn load(
        loader: &Loader<'_>,
        config: &DecoderConfig,
        border: Border,
    ) -> Result<Self, ModelError> {
        let top = config.multipliers.len() - 1;
        let width = config.width(top);
        let conv = |name, inputs, outputs| {
            Ok::<_, ModelError>(
                Conv::load(&loader.child(name), inputs, outputs, 3)?.with_border(border),
            )
        };
        let up = (0..=top)
            .map(|level| {
                let inputs = config.width((level + 1).min(top));
                let place = loader.child("up").child(level);
                Level::load(&place, inputs, config.width(level), level > 0, border)
            })
            .collect::<Result<_, _>>()?;
        Ok(Self {
            conv_in: conv("conv_in", config.inputs, width)?,
            mid: Middle::load(&loader.child("mid"), width, config.attention)?,
            up,
            norm_out: GroupNorm::load(&loader.child("norm_out"), config.width(0))?,
            conv_out: conv("conv_out", config.width(0), config.outputs)?,
        })
    }

    pub(crate) fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let mut map = self.conv_in.forward(input);
        probe.see("conv_in", &map);
        map = probe.inside("mid", |probe| self.mid.forward(map, probe));
        for (index, level) in self.up.iter().enumerate().rev() {
            map = probe.inside(&format!("up.{index}"), |probe| level.forward(map, probe));
        }
        let map = self.norm_out.forward(map);
        probe.see("norm_out", &map);
        let map = self.conv_out.forward(swish(map));
        probe.see("conv_out", &map);
        map
    }
}

/// Two residual blocks, with attention between them or not.
#[derive(Module, Debug)]
struct Middle {
    block_1: ResidualBlock,
    attn_1: Option<SpatialAttention>,
    block_2: ResidualBlock,
}

impl Middle {
    fn load(loader: &Loader<'_>, width: usize, attention: bool) -> Result<Self, ModelError> {
        let block = |name| ResidualBlock::load(&loader.child(name), width, width, Border::Zeros);
        Ok(Self {
            block_1: block("block_1")?,
            attn_1: attention
                .then(|| SpatialAttention::load(&loader.child("attn_1"), width))
                .transpose()?,
            block_2: block("block_2")?,
        })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let mut map = probe.inside("block_1", |probe| self.block_1.forward(input, probe));
        probe.see("block_1", &map);
        if let Some(attention) = &self.attn_1 {
            map = attention.forward(map);
            probe.see("attn_1", &map);
        }
        let map = probe.inside("block_2", |probe| self.block_2.forward(map, probe));
        probe.see("block_2", &map);
        map
    }
}

/// Three residual blocks, then twice the size (all but level 0).
#[derive(Module, Debug)]
struct Level {
    block: Vec<ResidualBlock>,
    upsample: Option<Upsample>,
}

impl Level {
    fn load(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
        doubles: bool,
        border: Border,
    ) -> Result<Self, ModelError> {
        let block = (0..3)
            .map(|index| {
                let inputs = if index == 0 { inputs } else { outputs };
                ResidualBlock::load(&loader.child("block").child(index), inputs, outputs, border)
            })
            .collect::<Result<_, _>>()?;
        let upsample =
            doubles.then(|| Upsample::load(&loader.child("upsample"), outputs)).transpose()?;
        Ok(Self { block, upsample })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let mut map = input;
        for (index, block) in self.block.iter().enumerate() {
            let name = format!("block.{index}");
            map = probe.inside(&name, |probe| block.forward(map, probe));
            probe.see(&name, &map);
        }
        if let Some(upsample) = &self.upsample {
            map = upsample.conv.forward(nearest(map));
            probe.see("upsample", &map);
        }
        map
    }
}

/// The convolution after a doubling of the map.
#[derive(Module, Debug)]
struct Upsample {
    conv: Conv,
}

impl Upsample {
    fn load(loader: &Loader<'_>, width: usize) -> Result<Self, ModelError> {
        Ok(Self { conv: Conv::load(&loader.child("conv"), width, width, 3)? })
    }
}

/// Norm, swish, convolution, twice, beside the input.
#[derive(Module, Debug)]
struct ResidualBlock {
    norm1: GroupNorm,
    conv1: Conv,
    norm2: GroupNorm,
    conv2: Conv,
    nin_shortcut: Option<Conv>,
}

impl ResidualBlock {
    fn load(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
        border: Border,
    ) -> Result<Self, ModelError> {
        let conv = |name, inputs, side| Conv::load(&loader.child(name), inputs, outputs, side);
        Ok(Self {
            norm1: GroupNorm::load(&loader.child("norm1"), inputs)?,
            conv1: conv("conv1", inputs, 3)?.with_border(border),
            norm2: GroupNorm::load(&loader.child("norm2"), outputs)?,
            conv2: conv("conv2", outputs, 3)?,
            nin_shortcut: (inputs != outputs)
                .then(|| conv("nin_shortcut", inputs, 1))
                .transpose()?,
        })
    }

    fn forward(&self, input: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        let map = self.norm1.forward(input.clone());
        probe.see("norm1", &map);
        let map = self.conv1.forward(swish(map));
        probe.see("conv1", &map);
        let map = self.norm2.forward(map);
        probe.see("norm2", &map);
        let map = self.conv2.forward(swish(map));
        probe.see("conv2", &map);
        match &self.nin_shortcut {
            Some(shortcut) => shortcut.forward(input) + map,
            None => input + map,
        }
    }
}

/// Self-attention over all places of the map, one head.
#[derive(Module, Debug)]
struct SpatialAttention {
    norm: GroupNorm,
    q: Conv,
    k: Conv,
    v: Conv,
    proj_out: Conv,
}

impl SpatialAttention {
    fn load(loader: &Loader<'_>, width: usize) -> Result<Self, ModelError> {
        let conv = |name| Conv::load(&loader.child(name), width, width, 1);
        Ok(Self {
            norm: GroupNorm::load(&loader.child("norm"), width)?,
            q: conv("q")?,
            k: conv("k")?,
            v: conv("v")?,
            proj_out: conv("proj_out")?,
        })
    }

    fn forward(&self, input: Tensor<4>) -> Tensor<4> {
        let [_, channels, height, width] = input.dims();
        let normed = self.norm.forward(input.clone());
        let flat = |conv: &Conv| -> Tensor<2> {
            conv.forward(normed.clone()).reshape([channels, height * width])
        };
        let logits = flat(&self.q).transpose().matmul(flat(&self.k));
        // sqrt is correctly rounded everywhere.
        let weights = activation::softmax(logits / (channels as f64).sqrt(), 1);
        let mixed = flat(&self.v).matmul(weights.transpose());
        input + self.proj_out.forward(mixed.reshape([1, channels, height, width]))
    }
}
