//! The radiance field: feature maps and point head, folded so that a point costs one bilinear fetch.
//!
//! `net0`, the head's first layer, is linear in the sampled features, and bilinear sampling (with its
//! zero padding) is linear in the texels. So `net0`'s weights are applied to the texels once
//! ([`Field::new`]); its bias is added per point, because beyond the map's edge the *features* are zero,
//! not the sums. The colour branch is two linear maps in a row, folded into one.
//!
//! Coordinates are those of the map frame ([`crate::render::frames`]): `[-1, 1]` in x (east), y (south)
//! and z (up). Densities are per cube unit.

pub mod closed_form;
mod color;
mod evaluate;
mod fold;
#[cfg(test)]
mod hard_cases;
pub(crate) mod kernel;

pub(crate) use evaluate::{ColumnRoom, ColumnTables, Medium, RayInField};
pub use fold::Field;

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

impl DensityActivation {
    /// Volume density (per cube unit) of a raw density.
    #[inline(always)]
    #[must_use]
    pub fn apply(self, raw: f32) -> f32 {
        match self {
            Self::Mipnerf => kernel::softplus(raw - 1.0),
            Self::Relu => {
                let shifted = raw + 3.0;
                if shifted > 0.0 { shifted } else { 0.0 }
            }
        }
    }
}

/// Why feature maps and a point head do not make a field.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FieldError {
    /// A tensor's shape does not fit the others.
    #[error("{tensor}: {found} where {expected} is needed")]
    Shape {
        /// Which tensor.
        tensor: &'static str,
        /// What it has.
        found: String,
        /// What the field needs.
        expected: String,
    },
    /// A tensor holds an infinity or NaN.
    #[error("{tensor} holds the value {value} at index {index}; every value must be finite")]
    NotFinite {
        /// Which tensor.
        tensor: &'static str,
        /// Flat index of the first such value.
        index: usize,
        /// The value.
        value: f32,
    },
    /// The position scale factor is not in (0, 1].
    #[error("a position scale factor of {0} (it must be above 0 and at most 1)")]
    Scale(f32),
}
