//! The radiance field: feature maps and point head, folded so that a point costs one bilinear fetch.

use crate::tensor::Grid;
use serde::{Deserialize, Serialize};

/// How a point's features come from the decoder's map (MODEL_SPEC section 6).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Representation {
    /// One plane over x, y and one line over z, concatenated (the released one).
    Oneplane,
    /// The same two, averaged.
    OneplaneMulti,
    /// Three planes, averaged.
    Triplane,
}

/// From raw to volume density (section 7).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DensityActivation {
    /// softplus(d - 1).
    Mipnerf,
    /// max(d + 3, 0).
    Relu,
}

/// A dense layer: `rows x columns` weights, row-major (outputs x inputs), and biases.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear {
    /// Number of inputs.
    pub inputs: usize,
    /// Number of outputs.
    pub outputs: usize,
    /// `outputs * inputs` weights, row-major.
    pub weight: Vec<f32>,
    /// `outputs` biases.
    pub bias: Vec<f32>,
}

/// Weights of the point head `mlp` (section 7), as stored.
#[derive(Clone, Debug, PartialEq)]
pub struct PointHead {
    /// `net0`: features -> hidden.
    pub net0: Linear,
    /// `net1_density`: hidden -> 1.
    pub density: Linear,
    /// `net1_feature`: hidden -> 32 (or as configured).
    pub feature: Linear,
    /// `style_squ`: style code -> 32.
    pub style: Linear,
    /// `grd_color_convert`: 64 -> colour channels.
    pub color: Linear,
}

/// Everything that decides the field of one image, before folding.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldInputs {
    /// The decoder's output: `64 x 320 x 320` (oneplane), `96 x 320 x 320` (triplane).
    pub map: Grid,
    /// How points read it.
    pub representation: Representation,
    /// From raw to volume density.
    pub activation: DensityActivation,
    /// `position_scale_factor`: the crop covers x and y in [-s, s].
    pub scale: f32,
}
