//! The small model: sizes, fresh weights, the head that starts as flat ground, folding of norms.

use super::error::TrainError;
use super::learner::NamedTensor;
use crate::config::{Config, SMALL_STYLE};
use crate::error::ModelError;
use crate::network::layers::Linear;
use crate::network::loader::Loader;
use crate::network::normalisation::EPSILON;
use crate::network::unet::TEXELS;
use crate::random::{key, normal};
use crate::weights::{TensorSource, expected};
use burn::module::Module;
use burn::tensor::{Tensor, activation};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Metres of ground under the image, at zoom 20 in Seattle (MODEL_SPEC section 1).
const GROUND_M: f32 = 64.48;
/// Metres of one cube unit in height: the published scale, which is the true proportion of a model without
/// empty tokens around it.
pub const METRES_PER_UNIT: f32 = GROUND_M / 2.0;
/// Height of the mean ground in the cube: 2.5 m below the street camera's -0.85.
pub const GROUND_Z: f32 = -0.85 - 2.5 / METRES_PER_UNIT;
/// Metres of one unit of the plane's first channel.
pub const HEIGHT_UNIT_M: f32 = 8.0;
/// Per cube unit: how fast the first hidden unit changes across the surface.
const SHARPNESS: f32 = 200.0;
/// Weight of that unit in the density.
const OPAQUENESS: f32 = 100.0;
/// Raw density of empty space.
const EMPTY: f32 = -6.0;

/// Sizes of the small model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MiniSettings {
    /// Channels at 64, 32 and 16 places to a side.
    pub widths: [usize; 3],
    /// Residual blocks at each.
    pub blocks: [usize; 3],
    /// Blocks of attention at the lowest level.
    pub attention: usize,
    /// Heads of each.
    pub heads: usize,
    /// Channels of the plane and of the line.
    pub channels: usize,
    /// Hidden channels of the head.
    pub hidden: usize,
    /// Share of the image added as empty tokens on each side, a multiple of 1/16.
    pub pad: f64,
}

impl Default for MiniSettings {
    fn default() -> Self {
        Self {
            widths: [48, 96, 144],
            blocks: [1, 1, 2],
            attention: 2,
            heads: 4,
            channels: 16,
            hidden: 32,
            pad: 0.0,
        }
    }
}

impl MiniSettings {
    /// Text of `config.json`, with channels beside the plane's.
    #[must_use]
    pub fn json(&self, auxiliary: usize) -> String {
        let value = serde_json::json!({
            "_class_name": "Sat3DMini",
            "opt": {
                "backbone": "unet",
                "backbone_config": {
                    "model_type": "unet",
                    "widths": self.widths,
                    "blocks": self.blocks,
                    "attention": self.attention,
                    "heads": self.heads,
                    "auxiliary": auxiliary,
                },
                "pad": self.pad,
                "representation_type": "oneplane",
                "network": {
                    "mlp_hidden_dim": self.hidden,
                    "triplane": { "dim": self.channels },
                    "point_sampling_kwargs": { "num_points": 48, "num_importance": 48 },
                    "ray_marching_kwargs": { "density_clamp_mode": "mipnerf", "scale_color": false },
                },
            },
        });
        format!("{value:#}\n")
    }

    /// The same, read.
    ///
    /// # Errors
    /// [`TrainError::Model`] for sizes that make no network.
    pub fn config(&self, auxiliary: usize) -> Result<Config, TrainError> {
        if self.channels < 2 || self.hidden < 2 {
            let value = format!("{} and {}", self.channels, self.hidden);
            let why = "at least 2 each: the first carries heights".into();
            return Err(TrainError::Setting { key: "channels, hidden", value, why });
        }
        Ok(Config::from_json(&self.json(auxiliary))?)
    }
}

/// z in the cube of a height over the mean ground.
#[must_use]
pub fn z_of(metres: f32) -> f32 {
    GROUND_Z + metres / METRES_PER_UNIT
}

/// Fresh weights with norms, each a function of the seed and its name.
pub(crate) fn fresh(config: &Config, seed: u64) -> Vec<NamedTensor> {
    let mut list = Vec::new();
    for spec in expected(config) {
        let name = spec.key.as_str();
        let hash = name.bytes().fold(key(&[seed]), |hash, byte| key(&[hash, u64::from(byte)]));
        let inputs: usize = spec.shape.iter().skip(1).product();
        let deviation = if name.ends_with(".bias") || name == "unet.position" {
            0.0
        } else if name.starts_with("unet.plane") {
            0.1 * (1.0 / inputs as f64).sqrt()
        } else if name.ends_with("proj.weight") || name.ends_with("down.weight") {
            0.2 * (1.0 / inputs as f64).sqrt()
        } else {
            (if name.starts_with("mlp") || name.contains("attention") { 1.0 } else { 2.0 }
                / inputs as f64)
                .sqrt()
        };
        let constant = if spec.shape.len() == 1 && name.ends_with(".weight") { 1.0 } else { 0.0 };
        let mut values: Vec<f32> = (0..spec.values() as u64)
            .map(|index| match constant {
                0.0 => (deviation * normal(key(&[hash, index]))) as f32,
                constant => constant as f32,
            })
            .collect();
        start(config, name, &mut values);
        if let Some(path) = normed(name) {
            let channels = spec.shape[0];
            for (what, value) in [
                ("weight", if name.ends_with("conv2.weight") { 0.2 } else { 1.0 }),
                ("running_mean", 0.0),
                ("running_var", 1.0),
            ] {
                list.push(NamedTensor {
                    name: format!("{path}.norm.{what}"),
                    shape: vec![channels],
                    values: vec![value; channels],
                });
            }
        }
        list.push(NamedTensor { name: spec.key.clone(), shape: spec.shape.clone(), values });
    }
    list
}

/// Path of a convolution that has a norm, from the key of its weights.
fn normed(key: &str) -> Option<&str> {
    let path = key.strip_suffix(".weight")?;
    let named = ["stem", "conv1", "conv2", "down1", "down2", "up1", "up0"];
    let last = path.rsplit('.').next()?;
    (path.starts_with("unet.") && named.contains(&last)).then_some(path)
}

/// The field that everything starts from: flat ground.
fn start(config: &Config, name: &str, values: &mut [f32]) {
    let (channels, inputs) = (config.plane_channels, config.point_features());
    match name {
        // z at the centre of each texel of the line's first channel.
        "unet.line" => {
            let texels = values.len() / channels;
            for (index, value) in values[..texels].iter_mut().enumerate() {
                *value = 2.0 * (index as f32 + 0.5) / texels as f32 - 1.0;
            }
        }
        "mlp.net0.weight" => {
            values[..inputs].fill(0.0);
            values[0] = SHARPNESS * HEIGHT_UNIT_M / METRES_PER_UNIT;
            values[channels] = -SHARPNESS;
        }
        "mlp.net0.bias" => values[0] = SHARPNESS * GROUND_Z,
        "mlp.net1_density.weight" => {
            values.fill(0.0);
            values[0] = OPAQUENESS;
        }
        "mlp.net1_density.bias" => values.fill(EMPTY),
        // The unit of the surface is far too large to carry colour.
        "mlp.net1_feature.weight" => {
            for row in values.chunks_exact_mut(config.head_hidden) {
                row[0] = 0.0;
            }
        }
        "mlp.style_squ.weight" => values.fill(0.0),
        _ => {}
    }
}

/// The point head in training: the unit of the surface stays as it is, the others carry colour.
#[derive(Module, Debug)]
pub(crate) struct MiniHead {
    net0: Linear,
    net1_density: Linear,
    net1_feature: Linear,
    style_squ: Linear,
    grd_color_convert: Linear,
}

impl MiniHead {
    pub(crate) fn load(loader: &Loader<'_>, config: &Config) -> Result<Self, ModelError> {
        let hidden = config.head_hidden;
        let linear = |name, inputs, outputs| Linear::load(&loader.child(name), inputs, outputs);
        Ok(Self {
            net0: linear("net0", config.point_features(), hidden)?,
            net1_density: linear("net1_density", hidden, 1)?,
            net1_feature: linear("net1_feature", hidden, hidden / 2)?,
            style_squ: linear("style_squ", config.style, hidden / 2)?,
            grd_color_convert: linear("grd_color_convert", hidden, config.color_channels)?,
        })
    }

    /// Colours (`B x 3 x h x w`, [0, 1]) of a map's features (`B x D x h x w`) at heights z (`B x 1 x h x
    /// w`), with the zero style code. The line (`D x N`) is read at the nearest texel.
    pub(crate) fn colour(&self, features: Tensor<4>, line: Tensor<2>, z: Tensor<4>) -> Tensor<4> {
        let [batch, channels, height, width] = features.dims();
        let [_, texels] = line.dims();
        let rows = batch * height * width;
        let plane: Tensor<2> = features.permute([0, 2, 3, 1]).reshape([rows, channels]);
        let index = ((z + 1.0) * (texels as f64 / 2.0)).floor().clamp(0.0, texels as f64 - 1.0);
        let index: Tensor<1, burn::tensor::Int> = index.int().reshape([rows]);
        let along = line.transpose().select(0, index);
        let points = Tensor::cat(vec![plane, along], 1);
        let hidden = self.net0.forward(points);
        let [_, units] = hidden.dims();
        // Without the surface's unit; its weight in the colours stays zero.
        let others = activation::softplus(hidden.narrow(1, 1, units - 1), 1.0);
        let others = others.pad((1, 0, 0, 0), burn::tensor::ops::PadMode::Constant(0.0));
        let feature = self.net1_feature.forward(others);
        let style = self.style_squ.forward(Tensor::zeros([rows, SMALL_STYLE], &feature.device()));
        let colour = self.grd_color_convert.forward(Tensor::cat(vec![feature, style], 1));
        let [_, bands] = colour.dims();
        activation::sigmoid(colour).reshape([batch, height, width, bands]).permute([0, 3, 1, 2])
    }
}

/// A finished model's tensors: norms folded, auxiliary channels left out.
pub(crate) fn finished(
    config: &Config,
    weights: Vec<NamedTensor>,
) -> Result<Vec<NamedTensor>, TrainError> {
    let by_name: BTreeMap<String, NamedTensor> =
        weights.into_iter().map(|tensor| (tensor.name.clone(), tensor)).collect();
    let get = |name: &str| {
        by_name.get(name).ok_or_else(|| TrainError::State(format!("`{name}` is missing")))
    };
    let auxiliary = config.unet.as_ref().map_or(0, |unet| unet.auxiliary);
    let mut list = Vec::new();
    for spec in expected(config) {
        let mut tensor = get(&spec.key)?.clone();
        let path = spec.key.rsplit_once('.').map_or("", |(path, _)| path);
        // A training that began with a finished model has no norms.
        if by_name.contains_key(&format!("{path}.norm.weight")) {
            let of = |what: &str| get(&format!("{path}.norm.{what}"));
            let (gain, mean, variance) = (of("weight")?, of("running_mean")?, of("running_var")?);
            let scale = |channel: usize| {
                gain.values[channel] / (variance.values[channel] + EPSILON as f32).sqrt()
            };
            if spec.key.ends_with(".bias") {
                for (channel, value) in tensor.values.iter_mut().enumerate() {
                    *value -= mean.values[channel] * scale(channel);
                }
            } else {
                let size = tensor.values.len() / spec.shape[0];
                for (channel, kernel) in tensor.values.chunks_exact_mut(size).enumerate() {
                    let scale = scale(channel);
                    kernel.iter_mut().for_each(|value| *value *= scale);
                }
            }
        }
        if path == "unet.plane" && auxiliary > 0 {
            let all = config.plane_channels + auxiliary;
            let size = tensor.values.len() / tensor.shape[0];
            let kept = tensor
                .values
                .chunks_exact(all * size)
                .flat_map(|texel| texel[..config.plane_channels * size].to_vec());
            tensor.values = kept.collect();
            tensor.shape[0] = TEXELS * TEXELS * config.plane_channels;
        }
        list.push(tensor);
    }
    Ok(list)
}

/// What [`finished`] left, as weights to go on from: without norms, and with the auxiliary channels of `fresh`.
pub(crate) fn unfinished(
    finished: &Config,
    training: &Config,
    source: &dyn TensorSource,
    fresh: &[NamedTensor],
) -> Result<Vec<NamedTensor>, TrainError> {
    let mut list = Vec::new();
    for spec in expected(finished) {
        let mut values = source.read(&spec.key, &spec.shape)?;
        let mut shape = spec.shape;
        if spec.key.starts_with("unet.plane.")
            && let Some(wide) = fresh.iter().find(|tensor| tensor.name == spec.key)
        {
            let auxiliary = training.unet.as_ref().map_or(0, |unet| unet.auxiliary);
            let texels = TEXELS * TEXELS;
            let kept = values.len() / texels;
            let all = kept / finished.plane_channels * (finished.plane_channels + auxiliary);
            let texel = |(kept, fresh): (&[f32], &[f32])| [kept, &fresh[kept.len()..]].concat();
            values = values
                .chunks_exact(kept)
                .zip(wide.values.chunks_exact(all))
                .flat_map(texel)
                .collect();
            shape.clone_from(&wide.shape);
        }
        list.push(NamedTensor { name: spec.key, shape, values });
    }
    Ok(list)
}
