//! The discriminators (MODEL_SPEC section 11): strided convolutions with spectral norm, instance norm from
//! the second on, and a mean score.
//!
//! The gradient penalty needs the slope of the score in the picture, and then gradients of that slope. The
//! backward pass is therefore written out as a forward computation ([`Pass::slope`]), which is exact,
//! because the slope of a leaky ReLU is piecewise constant.

use super::learner::NamedTensor;
use crate::random::{Draw, normal};
use burn::module::{Module, Param};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{Device, Tensor, TensorData, activation, module};

const LEAK: f64 = 0.2;
const INSTANCE_EPSILON: f64 = 1e-5;
/// Least length that a vector of the power iteration is divided by.
const LEAST_LENGTH: f32 = 1e-12;

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
            for (name, vector) in [("u", &conv.left), ("v", &conv.right)] {
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
            let device = conv.left.device();
            conv.left = vector(pair[0].values.clone(), &device);
            conv.right = vector(pair[1].values.clone(), &device);
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
    /// Left singular vector, as far as the power iteration has it; without gradient.
    #[module(skip)]
    left: Tensor<1>,
    /// Right singular vector.
    #[module(skip)]
    right: Tensor<1>,
}

impl NormedConv {
    fn new(inputs: usize, outputs: usize, mut draw: Draw, device: &Device) -> Self {
        let bound = 1.0 / (inputs as f64 * 9.0).sqrt();
        let weight = uniform(&mut draw, [outputs, inputs, 3, 3], bound, device);
        let bias = uniform(&mut draw, [outputs], bound, device);
        let plain = device.clone().inner();
        let mut direction = |count: usize| {
            let values = (0..count).map(|_| normal(draw.bits()) as f32).collect();
            unit(vector(values, &plain))
        };
        let left = direction(outputs);
        let right = direction(9 * inputs);
        Self { weight, bias, left, right }
    }

    fn normed(&mut self, training: bool) -> Layer {
        let weight = self.weight.val();
        let [outputs, inputs, _, _] = weight.dims();
        let matrix: Tensor<2> = weight.clone().reshape([outputs, 9 * inputs]);
        if training {
            let plain = matrix.clone().inner();
            self.right = unit(times(plain.clone().transpose(), &self.left));
            self.left = unit(times(plain, &self.right));
        }
        let largest = (times(matrix, &self.right) * self.left.clone()).sum();
        let weight = weight / largest.reshape([1, 1, 1, 1]);
        Layer { weight, bias: self.bias.val() }
    }
}

fn times(matrix: Tensor<2>, vector: &Tensor<1>) -> Tensor<1> {
    let [rows, columns] = matrix.dims();
    matrix.matmul(vector.clone().reshape([columns, 1])).reshape([rows])
}

fn unit(vector: Tensor<1>) -> Tensor<1> {
    let length = vector.clone().powi_scalar(2).sum().sqrt().clamp_min(LEAST_LENGTH);
    vector / length
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
mod tests {
    use super::*;

    fn pictures(count: usize, height: usize, width: usize, seed: u64) -> Tensor<4> {
        let mut draw = Draw::new(&[seed]);
        let values: Vec<f32> =
            (0..count * 3 * height * width).map(|_| draw.range(-1.0, 1.0) as f32).collect();
        let data = TensorData::new(values, [count, 3, height, width]);
        Tensor::from_data(data, &Device::flex().autodiff())
    }

    fn small(seed: u64) -> Discriminator {
        Discriminator::new(16, 16, &[seed], &Device::flex().autodiff())
    }

    #[test]
    fn layers_are_those_of_the_release() {
        assert_eq!(widths(256, 512), [64, 128, 256, 512, 512, 512]);
        assert_eq!(widths(128, 512), [64, 128, 256, 512, 512]);
        assert_eq!(widths(32, 64), [8, 16, 32]);
        assert_eq!(widths(1, 4).len(), 2);
    }

    #[test]
    fn a_written_out_slope_is_that_of_autodiff() {
        let mut critic = small(1);
        for (height, width) in [(16, 16), (8, 32), (15, 18)] {
            let pass = critic.pass(true);
            let input = pictures(2, height, width, 5).require_grad();
            let (scores, slope) = pass.score_and_slope(input.clone());
            let wanted = input.grad(&scores.sum().backward()).expect("a gradient");
            let error: f32 = (slope.inner() - wanted.clone()).abs().max().into_scalar();
            let size: f32 = wanted.abs().max().into_scalar();
            assert!(error < 1e-5 * size.max(1e-3), "{height} x {width}: {error} of {size}");
        }
    }

    #[test]
    fn gradients_of_the_penalty_agree_with_differences() {
        let mut critic = small(2);
        for _ in 0..20 {
            critic.pass(true);
        }
        let input = pictures(2, 16, 16, 6);
        let penalty = |critic: &mut Discriminator| {
            gradient_penalty(critic.pass(false).score_and_slope(input.clone()).1)
        };
        let gradients = penalty(&mut critic).backward();
        for layer in 0..critic.encoder.len() {
            let weight = critic.encoder[layer].weight.val();
            let shape = weight.dims();
            let gradient = weight.grad(&gradients).expect("a gradient").into_data();
            let gradient: Vec<f32> = gradient.iter::<f32>().collect();
            let values: Vec<f32> = weight.into_data().iter::<f32>().collect();
            let length = gradient.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt();
            let mut at = |step: f64| {
                let moved = values.iter().zip(&gradient);
                let moved: Vec<f32> = moved
                    .map(|(value, g)| (f64::from(*value) + step * f64::from(*g) / length) as f32)
                    .collect();
                let data = TensorData::new(moved, shape);
                critic.encoder[layer].weight = Param::from_data(data, &input.device());
                f64::from(penalty(&mut critic).into_scalar::<f32>())
            };
            let step = 1e-3;
            let difference = (at(step) - at(-step)) / (2.0 * step);
            at(0.0);
            assert!((difference / length - 1.0).abs() < 0.02, "{layer}: {length} {difference}");
        }
    }

    #[test]
    fn weights_come_to_a_largest_singular_value_of_one() {
        let mut critic = small(3);
        let before = critic.buffers("d");
        critic.pass(false);
        assert_eq!(critic.buffers("d"), before, "a pass that does not train moves nothing");
        for _ in 0..200 {
            critic.pass(true);
        }
        let weight = critic.pass(false).layers[1].weight.clone().inner();
        let [rows, inputs, _, _] = weight.dims();
        let matrix: Tensor<2> = weight.reshape([rows, 9 * inputs]);
        // The largest singular value by an iteration of its own.
        let mut vector = vector(vec![1.0; rows], &matrix.device());
        for _ in 0..500 {
            vector = unit(times(matrix.clone(), &times(matrix.clone().transpose(), &vector)));
        }
        let length: f32 =
            times(matrix.transpose(), &vector).powi_scalar(2).sum().sqrt().into_scalar();
        assert!((length - 1.0).abs() < 1e-3, "{length}");
        let mut other = small(4);
        other.set_buffers(&critic.buffers("d"));
        assert_eq!(other.buffers("d"), critic.buffers("d"));
    }

    #[test]
    fn a_flat_picture_has_a_finite_penalty() {
        let mut critic = small(5);
        let flat = pictures(2, 16, 16, 7) * 0.0;
        let (_, slope) = critic.pass(true).score_and_slope(flat);
        let penalty = gradient_penalty(slope);
        let gradients = penalty.clone().backward();
        let value: f32 = penalty.into_scalar();
        let gradient = critic.encoder[0].weight.val().grad(&gradients).expect("a gradient");
        let largest: f32 = gradient.abs().max().into_scalar();
        assert!(value.is_finite() && largest.is_finite(), "{value} {largest}");
    }
}
