//! The discriminators (MODEL_SPEC section 11): strided convolutions with spectral norm, instance norm from
//! the second on, and a mean score.
//!
//! The gradient penalty needs the slope of the score in the picture, and then gradients of that slope. The
//! backward pass is therefore written out as a forward computation ([`Pass::slope`]), which is exact,
//! because the slope of a leaky ReLU is piecewise constant.

use super::learner::NamedTensor;
use super::losses::spectral::Spectral;
use crate::random::Draw;
use burn::module::{Module, Param};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{Device, Tensor, TensorData, activation, module};

const LEAK: f64 = 0.2;
const INSTANCE_EPSILON: f64 = 1e-5;

/// A discriminator of pictures of one size.
#[derive(Module, Debug)]
pub(crate) struct Discriminator {
    encoder: Vec<NormedConv>,
    shuffle: Plain,
}

/// Channels of each layer of a discriminator built for pictures of this side, at most `most` of them.
pub(crate) fn widths(side: usize, most: usize) -> Vec<usize> {
    let depth = (side.max(1).ilog2() as usize).saturating_sub(2).max(2);
    // As in the release, whose depth is 5 or 6; a shallower one ends with fewer channels.
    let halvings = depth.saturating_sub(3).max(3);
    (0..depth).map(|layer| (most >> halvings.saturating_sub(layer)).max(1)).collect()
}

impl Discriminator {
    /// A new one for pictures whose height is `side` (for panoramas: half of it), with starting weights
    /// drawn as PyTorch draws them.
    pub(crate) fn new(side: usize, most: usize, seed: &[u64], device: &Device) -> Self {
        let mut inputs = 3;
        let mut encoder = Vec::new();
        for (layer, outputs) in widths(side, most).into_iter().enumerate() {
            let name: Vec<u64> = seed.iter().copied().chain([layer as u64]).collect();
            encoder.push(NormedConv::new(inputs, outputs, Draw::new(&name), device));
            inputs = outputs;
        }
        let name: Vec<u64> = seed.iter().copied().chain([u64::MAX]).collect();
        let mut draw = Draw::new(&name);
        let bound = 1.0 / (inputs as f64).sqrt();
        let weight = uniform(&mut draw, [1, inputs, 1, 1], bound, device);
        let bias = uniform(&mut draw, [1], bound, device);
        Self { encoder, shuffle: Plain { weight, bias } }
    }

    /// The weights divided by their spectral norms, for one pass. In training each layer's vectors take
    /// one step of the power iteration first.
    pub(crate) fn pass(&mut self, training: bool) -> Pass {
        let layers = self.encoder.iter_mut().map(|layer| layer.normed(training)).collect();
        Pass { layers, weight: self.shuffle.weight.val(), bias: self.shuffle.bias.val() }
    }

    /// The same for pictures whose own gradients are wanted and not the weights'.
    pub(crate) fn frozen(&self) -> Pass {
        let mut own = self.clone();
        let Pass { layers, weight, bias } = own.pass(false);
        let layers = layers
            .into_iter()
            .map(|layer| Layer { weight: layer.weight.detach(), bias: layer.bias.detach() })
            .collect();
        Pass { layers, weight: weight.detach(), bias: bias.detach() }
    }

    /// The vectors of the power iteration, which are no parameters.
    pub(crate) fn buffers(&self, prefix: &str) -> Vec<NamedTensor> {
        let mut list = Vec::new();
        for (layer, conv) in self.encoder.iter().enumerate() {
            for (name, vector) in [("u", &conv.spectral.u), ("v", &conv.spectral.v)] {
                let values: Vec<f32> = vector.clone().into_data().iter::<f32>().collect();
                let name = format!("{prefix}.encoder.{layer}.{name}");
                list.push(NamedTensor { name, shape: vec![values.len()], values });
            }
        }
        list
    }

    /// Puts back what [`Self::buffers`] gave, in its order.
    pub(crate) fn set_buffers(&mut self, buffers: &[NamedTensor]) {
        for (conv, pair) in self.encoder.iter_mut().zip(buffers.chunks_exact(2)) {
            let device = conv.spectral.u.device();
            conv.spectral = Spectral {
                u: vector(pair[0].values.clone(), &device),
                v: vector(pair[1].values.clone(), &device),
            };
        }
    }
}

fn uniform<const D: usize>(
    draw: &mut Draw,
    shape: [usize; D],
    bound: f64,
    device: &Device,
) -> Param<Tensor<D>> {
    let count = shape.iter().product();
    let values: Vec<f32> = (0..count).map(|_| draw.range(-bound, bound) as f32).collect();
    Param::from_data(TensorData::new(values, shape), device)
}

fn vector(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let length = values.len();
    Tensor::from_data(TensorData::new(values, [length]), device)
}

/// The last layer, 1 x 1.
#[derive(Module, Debug)]
struct Plain {
    weight: Param<Tensor<4>>,
    bias: Param<Tensor<1>>,
}

/// A 3 x 3 convolution with stride 2 whose weights are divided by their largest singular value.
#[derive(Module, Debug)]
struct NormedConv {
    weight: Param<Tensor<4>>,
    bias: Param<Tensor<1>>,
    /// Without gradient.
    #[module(skip)]
    spectral: Spectral,
}

impl NormedConv {
    fn new(inputs: usize, outputs: usize, mut draw: Draw, device: &Device) -> Self {
        let bound = 1.0 / (inputs as f64 * 9.0).sqrt();
        let weight = uniform(&mut draw, [outputs, inputs, 3, 3], bound, device);
        let bias = uniform(&mut draw, [outputs], bound, device);
        let spectral = Spectral::start(weight.dims(), draw.bits(), &device.clone().inner());
        Self { weight, bias, spectral }
    }

    fn normed(&mut self, training: bool) -> Layer {
        let weight = self.weight.val();
        if training {
            self.spectral = self.spectral.iterate(&weight.clone().inner());
        }
        Layer { weight: self.spectral.normalise(weight), bias: self.bias.val() }
    }
}

struct Layer {
    weight: Tensor<4>,
    bias: Tensor<1>,
}

/// A discriminator's weights as one pass uses them.
pub(crate) struct Pass {
    layers: Vec<Layer>,
    weight: Tensor<4>,
    bias: Tensor<1>,
}

/// What a layer leaves behind for the slope.
struct Seen {
    /// Height and width of its input.
    size: [usize; 2],
    /// Slope of the leaky ReLU at each place.
    leak: Tensor<4>,
    /// Standardised values and one over the standard deviation, where there is a norm.
    norm: Option<(Tensor<4>, Tensor<4>)>,
}

impl Pass {
    /// Scores of pictures (`batch x 3 x height x width`, in [-1, 1]): one each.
    pub(crate) fn score(&self, pictures: Tensor<4>) -> Tensor<1> {
        self.run(pictures, None)
    }

    /// Scores, and the slope of each picture's score in its values.
    pub(crate) fn score_and_slope(&self, pictures: Tensor<4>) -> (Tensor<1>, Tensor<4>) {
        let mut seen = Vec::new();
        let scores = self.run(pictures, Some(&mut seen));
        (scores, self.slope(seen))
    }

    fn run(&self, pictures: Tensor<4>, mut seen: Option<&mut Vec<Seen>>) -> Tensor<1> {
        let mut map = pictures;
        for (index, layer) in self.layers.iter().enumerate() {
            let [_, _, height, width] = map.dims();
            let options = ConvOptions::new([2; 2], [1; 2], [1; 2], 1);
            let bias = Some(layer.bias.clone());
            map = module::conv2d(map, layer.weight.clone(), bias, options);
            let mut norm = None;
            if index > 0 {
                let centred = map.clone() - mean(map);
                let inverse =
                    (mean(centred.clone().powi_scalar(2)) + INSTANCE_EPSILON).sqrt().recip();
                map = centred * inverse.clone();
                norm = Some((map.clone(), inverse));
            }
            if let Some(seen) = &mut seen {
                let positive = map.clone().detach().greater_elem(0.0).float();
                let leak = positive * (1.0 - LEAK) + LEAK;
                seen.push(Seen { size: [height, width], leak, norm });
            }
            map = activation::leaky_relu(map, LEAK);
        }
        let [batch, _, height, width] = map.dims();
        let options = ConvOptions::new([1; 2], [0; 2], [1; 2], 1);
        let bias = Some(self.bias.clone());
        let scores = module::conv2d(map, self.weight.clone(), bias, options);
        scores.reshape([batch, height * width]).mean_dim(1).reshape([batch])
    }

    /// The backward pass from the scores to the pictures, as a computation with gradients of its own.
    fn slope(&self, seen: Vec<Seen>) -> Tensor<4> {
        let last = seen.last().map_or([1; 4], |seen| seen.leak.dims());
        let device = self.weight.device();
        let mut slope = (self.weight.clone() / (last[2] * last[3]) as f64)
            * Tensor::<4>::ones([last[0], 1, last[2], last[3]], &device);
        for (layer, seen) in self.layers.iter().zip(seen).rev() {
            slope = slope * seen.leak;
            if let Some((standard, inverse)) = seen.norm {
                let along = standard.clone() * mean(slope.clone() * standard);
                slope = inverse * (slope.clone() - mean(slope) - along);
            }
            let [_, _, height, width] = slope.dims();
            let rest = [seen.size[0] + 1 - 2 * height, seen.size[1] + 1 - 2 * width];
            let options = ConvTransposeOptions::new([2; 2], [1; 2], rest, [1; 2], 1);
            slope = module::conv_transpose2d(slope, layer.weight.clone(), None, options);
        }
        slope
    }
}

/// The mean over each channel's pixels.
fn mean(map: Tensor<4>) -> Tensor<4> {
    map.mean_dims(&[2, 3])
}

/// `(length of each picture's slope - 1)^2`, averaged over the batch.
pub(crate) fn gradient_penalty(slope: Tensor<4>) -> Tensor<1> {
    let [batch, channels, height, width] = slope.dims();
    let squares: Tensor<2> = slope.powi_scalar(2).reshape([batch, channels * height * width]);
    // The root has no slope at 0; there this has none either.
    let length = (squares.sum_dim(1) + 1e-30).sqrt();
    (length - 1.0).powi_scalar(2).mean()
}

#[cfg(test)]
mod tests;
