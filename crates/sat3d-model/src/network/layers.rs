//! Layers that more than one module is made of. Field names are those of the checkpoint's keys.

use super::loader::Loader;
use crate::config::{Border, GROUPS};
use crate::error::ModelError;
use burn::module::{Module, Param};
use burn::tensor::ops::{ConvOptions, InterpolateMode, InterpolateOptions, PadMode};
use burn::tensor::{Tensor, activation, module};

/// A dense layer; the weight is `outputs x inputs`, as stored.
#[derive(Module, Debug)]
pub(crate) struct Linear {
    pub(crate) weight: Param<Tensor<2>>,
    pub(crate) bias: Option<Param<Tensor<1>>>,
}

impl Linear {
    pub(crate) fn load(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
    ) -> Result<Self, ModelError> {
        let bias = Some(loader.parameter("bias", [outputs])?);
        Ok(Self { bias, ..Self::without_bias(loader, inputs, outputs)? })
    }

    pub(crate) fn without_bias(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
    ) -> Result<Self, ModelError> {
        Ok(Self { weight: loader.parameter("weight", [outputs, inputs])?, bias: None })
    }

    /// `rows x inputs` to `rows x outputs`.
    pub(crate) fn forward(&self, input: Tensor<2>) -> Tensor<2> {
        let bias = self.bias.as_ref().map(Param::val);
        module::linear(input, self.weight.val().transpose(), bias)
    }
}

/// A convolution that keeps the size of its input (or, for patches, steps by its own size).
#[derive(Module, Debug)]
pub(crate) struct Conv {
    weight: Param<Tensor<4>>,
    bias: Option<Param<Tensor<1>>>,
    #[module(skip)]
    border: Border,
    #[module(skip)]
    stride: usize,
}

impl Conv {
    /// A `side x side` convolution, zeros around its input.
    pub(crate) fn load(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
        side: usize,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            weight: loader.parameter("weight", [outputs, inputs, side, side])?,
            bias: Some(loader.parameter("bias", [outputs])?),
            border: Border::Zeros,
            stride: 1,
        })
    }

    /// A 1 x 1 convolution without bias.
    pub(crate) fn without_bias(
        loader: &Loader<'_>,
        inputs: usize,
        outputs: usize,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            weight: loader.parameter("weight", [outputs, inputs, 1, 1])?,
            bias: None,
            border: Border::Zeros,
            stride: 1,
        })
    }

    /// The same with another border.
    pub(crate) fn with_border(self, border: Border) -> Self {
        Self { border, ..self }
    }

    /// The same, one output per patch of the kernel's size.
    pub(crate) fn patches(self) -> Self {
        let [_, _, side, _] = self.weight.dims();
        Self { stride: side, ..self }
    }

    pub(crate) fn forward(&self, input: Tensor<4>) -> Tensor<4> {
        let [_, _, side, _] = self.weight.dims();
        let margin = if self.stride == 1 { side / 2 } else { 0 };
        let (input, zeros) = match self.border {
            _ if margin == 0 => (input, 0),
            Border::Zeros => (input, margin),
            Border::Reflect => (input.pad([(margin, margin); 2], PadMode::Reflect), 0),
            Border::Circular => (wrap(wrap(input, 2, margin), 3, margin), 0),
        };
        let (weight, bias) = (self.weight.val(), self.bias.as_ref().map(Param::val));
        // What is rendered goes through the backend's own kernel, with or without the feature.
        if side == 3 && self.stride == 1 && input.is_autodiff() {
            return trained(input, weight, bias, 1 - zeros);
        }
        let options = ConvOptions::new([self.stride; 2], [zeros; 2], [1, 1], 1);
        module::conv2d(input, weight, bias, options)
    }
}

/// A 3 x 3 convolution in training; `rim` pixels on each side of the input are a border of their own, for
/// which nothing is asked.
fn trained(input: Tensor<4>, weight: Tensor<4>, bias: Option<Tensor<1>>, rim: usize) -> Tensor<4> {
    let [outputs, ..] = weight.dims();
    let mut map = super::convolution::convolve(input, weight);
    if rim > 0 {
        let [_, _, height, width] = map.dims();
        map = map.narrow(2, rim, height - 2 * rim).narrow(3, rim, width - 2 * rim);
    }
    match bias {
        Some(bias) => map + bias.reshape([1, outputs, 1, 1]),
        None => map,
    }
}

/// Puts the far side's `margin` rows (axis 2) or columns (axis 3) before and after.
fn wrap(input: Tensor<4>, axis: usize, margin: usize) -> Tensor<4> {
    let length = input.dims()[axis];
    let before = input.clone().narrow(axis, length - margin, margin);
    let after = input.clone().narrow(axis, 0, margin);
    Tensor::cat(vec![before, input, after], axis)
}

/// Scale and shift after a normalisation over the last axis.
#[derive(Module, Debug)]
pub(crate) struct LayerNorm {
    weight: Param<Tensor<1>>,
    bias: Param<Tensor<1>>,
    #[module(skip)]
    epsilon: f64,
}

impl LayerNorm {
    pub(crate) fn load(
        loader: &Loader<'_>,
        channels: usize,
        epsilon: f64,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            weight: loader.parameter("weight", [channels])?,
            bias: loader.parameter("bias", [channels])?,
            epsilon,
        })
    }

    pub(crate) fn forward(&self, input: Tensor<2>) -> Tensor<2> {
        module::layer_norm(input, self.weight.val(), Some(self.bias.val()), self.epsilon)
    }
}

/// Normalisation over [`GROUPS`] groups of channels, then scale and shift per channel.
#[derive(Module, Debug)]
pub(crate) struct GroupNorm {
    weight: Param<Tensor<1>>,
    bias: Param<Tensor<1>>,
}

impl GroupNorm {
    const EPSILON: f64 = 1e-6;

    pub(crate) fn load(loader: &Loader<'_>, channels: usize) -> Result<Self, ModelError> {
        Ok(Self {
            weight: loader.parameter("weight", [channels])?,
            bias: loader.parameter("bias", [channels])?,
        })
    }

    pub(crate) fn forward(&self, input: Tensor<4>) -> Tensor<4> {
        let [_, channels, _, _] = input.dims();
        let per_channel = [1, channels, 1, 1];
        let (centred, inverse) = standardise(input, GROUPS, Self::EPSILON);
        let scale = inverse * self.weight.val().reshape(per_channel);
        centred * scale + self.bias.val().reshape(per_channel)
    }
}

/// The input less its groups' means, and one over its groups' standard deviations, by channel.
///
/// Means are taken over rows first and over their means then: every row has the same length, so
/// that is exact, and in f32 it errs by the square root of what one long sum would.
pub(crate) fn standardise(input: Tensor<4>, groups: usize, epsilon: f64) -> (Tensor<4>, Tensor<4>) {
    let [_, channels, height, width] = input.dims();
    let rows = channels / groups * height;
    let mean = |values: Tensor<4>| {
        let by_row = values.reshape([groups, rows, width]).mean_dim(2);
        let by_group: Tensor<2> = by_row.reshape([groups, rows]).mean_dim(1);
        let spread: Tensor<2> = by_group.repeat_dim(1, channels / groups);
        spread.reshape([1, channels, 1, 1])
    };
    let centred = input.clone() - mean(input);
    let variance = mean(centred.clone() * centred.clone());
    (centred, (variance + epsilon).sqrt().recip())
}

/// x * sigmoid(x).
pub(crate) fn swish(input: Tensor<4>) -> Tensor<4> {
    activation::silu(input)
}

/// Doubles height and width, each pixel becoming four.
pub(crate) fn nearest(input: Tensor<4>) -> Tensor<4> {
    double(input, InterpolateMode::Nearest)
}

/// Doubles height and width bilinearly, pixels being areas (`align_corners` false).
pub(crate) fn bilinear(input: Tensor<4>) -> Tensor<4> {
    double(input, InterpolateMode::Bilinear)
}

fn double(input: Tensor<4>, mode: InterpolateMode) -> Tensor<4> {
    let [_, _, height, width] = input.dims();
    let options = InterpolateOptions::new(mode)
        .with_align_corners(false)
        .with_output_size([2 * height, 2 * width]);
    module::interpolate(input, options)
}
