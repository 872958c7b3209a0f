//! The small network: a convolutional encoder and decoder with skips in place of DINOv3 and the large
//! decoder. Its field, head and renderer are those of the family.
//!
//! The image becomes patches of 4 x 4 pixels (64 x 64 of them), then three levels of residual blocks (64,
//! 32, 16 to a side) with attention over all places at the lowest, where empty tokens are added around
//! (the paper's spatial tokens, as in MODEL_SPEC section 4; at the upper levels the same width of zeros).
//! The way up adds the levels' maps; the last step puts 2 x 2 texels of the plane at each place. The line
//! over z is a parameter: it is the same for every image.
//!
//! In training each convolution is followed by a batch norm; a trained model has them folded into weight
//! and bias.

use super::layers::{LayerNorm, Linear};
use super::loader::Loader;
use super::normalisation::{After, EPSILON, normalise};
use crate::config::{PATCHES, UNetConfig};
use crate::error::ModelError;
use burn::module::{Module, Param};
use burn::tensor::ops::{ConvOptions, PadMode};
use burn::tensor::{Tensor, activation, module};

/// Pixels along a side of the first patches.
pub(crate) const STEM: usize = 4;
/// Texels of the plane along a side of each place of the uppermost level.
pub(crate) const TEXELS: usize = 2;

/// Means and variances that a forward pass in training met, by the path of their norm.
pub(crate) type Statistics = Vec<(String, Tensor<1>, Tensor<1>)>;

/// Whether norms are folded (as in a finished model), or there, and whose statistics they use.
pub(crate) enum Mode<'a> {
    /// Norms are folded, or use their running statistics.
    Evaluate,
    /// Norms use the batch's statistics and report them.
    #[cfg_attr(not(feature = "train"), expect(dead_code, reason = "only training passes it"))]
    Train(&'a mut Statistics),
}

/// A convolution (3 x 3, zeros around; or patches of its own size) and its norm.
#[derive(Module, Debug)]
pub(crate) struct NormConv {
    weight: Param<Tensor<4>>,
    bias: Param<Tensor<1>>,
    norm: Option<Norm>,
    #[module(skip)]
    stride: usize,
}

/// A batch norm. Its statistics are parameters without gradients, so that they are stored with it.
#[derive(Module, Debug)]
pub(crate) struct Norm {
    weight: Param<Tensor<1>>,
    running_mean: Param<Tensor<1>>,
    running_var: Param<Tensor<1>>,
    #[module(skip)]
    path: String,
}

impl NormConv {
    fn load(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
        side: usize,
        stride: usize,
        normed: bool,
    ) -> Result<Self, ModelError> {
        let norm = |loader: &Loader<'_>| {
            Ok::<_, ModelError>(Norm {
                weight: loader.parameter("weight", [outputs])?,
                running_mean: loader.parameter("running_mean", [outputs])?.no_grad(),
                running_var: loader.parameter("running_var", [outputs])?.no_grad(),
                path: loader.path().to_owned(),
            })
        };
        Ok(Self {
            weight: loader.parameter("weight", [outputs, inputs, side, side])?,
            bias: loader.parameter("bias", [outputs])?,
            norm: if normed { Some(norm(&loader.child("norm"))?) } else { None },
            stride,
        })
    }

    /// The convolution, its norm, then `residual` added and negative values cut off, as wanted.
    fn forward(
        &self,
        input: Tensor<4>,
        residual: Option<Tensor<4>>,
        relu: bool,
        mode: &mut Mode<'_>,
    ) -> Tensor<4> {
        let map = plain(input, self.weight.val(), self.stride);
        let [_, outputs, _, _] = map.dims();
        let shape = [1, outputs, 1, 1];
        let bias = self.bias.val();
        let map = match (&self.norm, mode) {
            (None, _) => map + bias.reshape(shape),
            (Some(norm), Mode::Train(statistics)) => {
                let after = if relu { After::Relu } else { After::Nothing };
                let (map, [mean, variance]) =
                    normalise(map, norm.weight.val(), bias, residual, after);
                statistics.push((norm.path.clone(), mean, variance));
                return map;
            }
            (Some(norm), _) => {
                let (mean, variance) = (norm.running_mean.val(), norm.running_var.val());
                let scale = norm.weight.val() * (variance + EPSILON).sqrt().recip();
                let shift = bias - mean * scale.clone();
                map * scale.reshape(shape) + shift.reshape(shape)
            }
        };
        let map = match residual {
            Some(residual) => map + residual,
            None => map,
        };
        if relu { activation::relu(map) } else { map }
    }
}

/// The convolution alone.
fn plain(input: Tensor<4>, weight: Tensor<4>, stride: usize) -> Tensor<4> {
    let [outputs, inputs, side, _] = weight.dims();
    if side == 3 && stride == 1 {
        return super::convolution::convolve(input, weight);
    }
    if side == 1 || stride == side {
        // Patches as columns of one product.
        let [batch, _, height, width] = input.dims();
        let (rows, columns) = (height / side, width / side);
        let patches: Tensor<6> = input.reshape([batch, inputs, rows, side, columns, side]);
        let patches = patches.permute([0, 1, 3, 5, 2, 4]);
        let patches: Tensor<3> = patches.reshape([batch, inputs * side * side, rows * columns]);
        let weight: Tensor<3> = weight.reshape([1, outputs, inputs * side * side]);
        return weight.matmul(patches).reshape([batch, outputs, rows, columns]);
    }
    module::conv2d(input, weight, None, ConvOptions::new([stride; 2], [side / 2; 2], [1; 2], 1))
}

/// Two convolutions around which the input passes.
#[derive(Module, Debug)]
pub(crate) struct Block {
    conv1: NormConv,
    conv2: NormConv,
}

impl Block {
    fn load(loader: &Loader<'_>, width: usize, normed: bool) -> Result<Self, ModelError> {
        let conv = |name| NormConv::load(&loader.child(name), width, width, 3, 1, normed);
        Ok(Self { conv1: conv("conv1")?, conv2: conv("conv2")? })
    }

    fn forward(&self, input: Tensor<4>, mode: &mut Mode<'_>) -> Tensor<4> {
        let map = self.conv1.forward(input.clone(), None, true, mode);
        self.conv2.forward(map, Some(input), true, mode)
    }
}

/// Attention over all places, then a small network at each: a transformer's block.
#[derive(Module, Debug)]
pub(crate) struct Attention {
    norm1: LayerNorm,
    qkv: Linear,
    proj: Linear,
    norm2: LayerNorm,
    up: Linear,
    down: Linear,
    #[module(skip)]
    heads: usize,
}

impl Attention {
    fn load(loader: &Loader<'_>, width: usize, heads: usize) -> Result<Self, ModelError> {
        let linear = |name, inputs, outputs| Linear::load(&loader.child(name), inputs, outputs);
        let norm = |name| LayerNorm::load(&loader.child(name), width, 1e-5);
        Ok(Self {
            norm1: norm("norm1")?,
            qkv: linear("qkv", width, 3 * width)?,
            proj: linear("proj", width, width)?,
            norm2: norm("norm2")?,
            up: linear("up", width, 2 * width)?,
            down: linear("down", 2 * width, width)?,
            heads,
        })
    }

    /// `batch * places x width`, `places` of each image.
    fn forward(&self, tokens: Tensor<2>, batch: usize) -> Tensor<2> {
        let [rows, width] = tokens.dims();
        let (places, head) = (rows / batch, width / self.heads);
        let qkv = self.qkv.forward(self.norm1.forward(tokens.clone()));
        let qkv: Tensor<5> = qkv.reshape([batch, places, 3, self.heads, head]);
        let part = |which: usize| -> Tensor<4> {
            let part = qkv.clone().narrow(2, which, 1);
            part.reshape([batch, places, self.heads, head]).swap_dims(1, 2)
        };
        let logits = part(0).matmul(part(1).swap_dims(2, 3)) / (head as f64).sqrt();
        let mixed = activation::softmax(logits, 3).matmul(part(2)).swap_dims(1, 2);
        let tokens = tokens + self.proj.forward(mixed.reshape([rows, width]));
        let hidden = activation::relu(self.up.forward(self.norm2.forward(tokens.clone())));
        tokens + self.down.forward(hidden)
    }
}

/// The whole network.
#[derive(Module, Debug)]
pub(crate) struct UNet {
    stem: NormConv,
    level0: Vec<Block>,
    down1: NormConv,
    level1: Vec<Block>,
    down2: NormConv,
    level2: Vec<Block>,
    position: Param<Tensor<2>>,
    attention: Vec<Attention>,
    up1: NormConv,
    merge1: Vec<Block>,
    up0: NormConv,
    merge0: Vec<Block>,
    plane: NormConv,
    line: Param<Tensor<2>>,
    #[module(skip)]
    pad: usize,
}

impl UNet {
    /// Reads the network below `loader`; `normed` where norms are not folded yet.
    pub(crate) fn load(
        loader: &Loader<'_>,
        config: &UNetConfig,
        channels: usize,
        pad: usize,
        normed: bool,
    ) -> Result<Self, ModelError> {
        let [wide, middle, deep] = config.widths;
        let conv = |name: &str, inputs, outputs, side, stride| {
            NormConv::load(&loader.child(name), inputs, outputs, side, stride, normed)
        };
        let blocks = |name: &str, width, count| {
            let place = loader.child(name);
            (0..count)
                .map(|index| Block::load(&place.child(index), width, normed))
                .collect::<Result<Vec<_>, _>>()
        };
        let attention = loader.child("attention");
        let side = TEXELS * STEM * (PATCHES + 2 * pad);
        Ok(Self {
            stem: conv("stem", 3, wide, STEM, STEM)?,
            level0: blocks("level0", wide, config.blocks[0])?,
            down1: conv("down1", wide, middle, 2, 2)?,
            level1: blocks("level1", middle, config.blocks[1])?,
            down2: conv("down2", middle, deep, 2, 2)?,
            level2: blocks("level2", deep, config.blocks[2])?,
            position: loader.parameter("position", [PATCHES * PATCHES, deep])?,
            attention: (0..config.attention)
                .map(|index| Attention::load(&attention.child(index), deep, config.heads))
                .collect::<Result<_, _>>()?,
            up1: conv("up1", deep, middle, 1, 1)?,
            merge1: blocks("merge1", middle, config.blocks[1])?,
            up0: conv("up0", middle, wide, 1, 1)?,
            merge0: blocks("merge0", wide, config.blocks[0])?,
            plane: NormConv::load(
                &loader.child("plane"),
                wide,
                TEXELS * TEXELS * (channels + config.auxiliary),
                1,
                1,
                false,
            )?,
            line: loader.parameter("line", [channels, side])?,
            pad,
        })
    }

    /// Images (`batch x 3 x 256 x 256`, normalised) to planes (`batch x (D + auxiliary) x N x N`, D channels of
    /// features and what else training asks of the same map) .
    pub(crate) fn planes(&self, images: Tensor<4>, mut mode: Mode<'_>) -> Tensor<4> {
        let mode = &mut mode;
        let [batch, ..] = images.dims();
        let through = |blocks: &[Block], map: Tensor<4>, mode: &mut Mode<'_>| {
            blocks.iter().fold(map, |map, block| block.forward(map, mode))
        };
        let map = self.stem.forward(images, None, true, mode);
        let level0 = through(&self.level0, map, mode);
        let map = self.down1.forward(level0.clone(), None, true, mode);
        let level1 = through(&self.level1, map, mode);
        let map = self.down2.forward(level1.clone(), None, true, mode);
        let map = through(&self.level2, map, mode);

        let [_, deep, rows, columns] = map.dims();
        let places = rows * columns;
        let tokens: Tensor<3> = map.reshape([batch, deep, places]).swap_dims(1, 2);
        let position: Tensor<3> = self.position.val().reshape([1, places, deep]);
        let mut tokens: Tensor<2> = (tokens + position).reshape([batch * places, deep]);
        for attention in &self.attention {
            tokens = attention.forward(tokens, batch);
        }
        let tokens: Tensor<3> = tokens.reshape([batch, places, deep]).swap_dims(1, 2);
        let map = self.around(tokens.reshape([batch, deep, rows, columns]), 1);

        let map = double(self.up1.forward(map, None, false, mode)) + self.around(level1, 2);
        let map = through(&self.merge1, activation::relu(map), mode);
        let map = double(self.up0.forward(map, None, false, mode)) + self.around(level0, 4);
        let map = through(&self.merge0, activation::relu(map), mode);
        texels(self.plane.forward(map, None, false, mode))
    }

    /// The line (`D x N`).
    pub(crate) fn line(&self) -> Tensor<2> {
        self.line.val()
    }

    /// Empty tokens around a level's map, `per_token` of its places along a token's side.
    fn around(&self, map: Tensor<4>, per_token: usize) -> Tensor<4> {
        match self.pad * per_token {
            0 => map,
            width => map.pad([(width, width); 2], PadMode::Constant(0.0)),
        }
    }
}

/// Doubles height and width, each pixel becoming four.
fn double(map: Tensor<4>) -> Tensor<4> {
    let [batch, channels, height, width] = map.dims();
    let map: Tensor<6> = map.reshape([batch, channels, height, 1, width, 1]);
    let map = map.expand([batch, channels, height, 2, width, 2]);
    map.reshape([batch, channels, 2 * height, 2 * width])
}

/// Channels become texels: `batch x (T * T * C) x h x w` to `batch x C x T h x T w`.
fn texels(map: Tensor<4>) -> Tensor<4> {
    let [batch, channels, height, width] = map.dims();
    let channels = channels / (TEXELS * TEXELS);
    let map: Tensor<6> = map.reshape([batch, TEXELS, TEXELS, channels, height, width]);
    let map = map.permute([0, 3, 4, 1, 5, 2]);
    map.reshape([batch, channels, TEXELS * height, TEXELS * width])
}

/// Puts running statistics after a step: `momentum` is the batch's share.
#[cfg(feature = "train")]
pub(crate) fn absorb<M: Module>(module: M, statistics: &Statistics, momentum: f64) -> M {
    use burn::module::ModuleMapper;
    struct Absorb<'a> {
        path: Vec<String>,
        statistics: &'a Statistics,
        momentum: f64,
    }
    impl ModuleMapper for Absorb<'_> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            let (last, norm) = match self.path.split_last() {
                Some((last, norm)) => (last.as_str(), norm.join(".")),
                None => return param,
            };
            let Some((_, mean, variance)) =
                self.statistics.iter().find(|(path, ..)| path.ends_with(&norm) && !norm.is_empty())
            else {
                return param;
            };
            let seen = match last {
                "running_mean" => mean,
                "running_var" => variance,
                _ => return param,
            };
            let shape = param.dims();
            let momentum = self.momentum;
            param.map(|value| {
                let new = value.without_autodiff() * (1.0 - momentum)
                    + seen.clone().reshape(shape) * momentum;
                new.autodiff()
            })
        }
    }
    module.map(&mut Absorb { path: Vec::new(), statistics, momentum })
}
