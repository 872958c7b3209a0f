//! DINOv3: image to tokens (MODEL_SPEC section 3).

use super::layers::{Conv, LayerNorm, Linear};
use super::loader::Loader;
use super::probe::Probe;
use crate::config::{BackboneConfig, PATCHES};
use crate::error::ModelError;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData, activation};
use std::f64::consts::TAU;

/// The vision transformer.
#[derive(Module, Debug)]
pub(crate) struct Encoder {
    embeddings: Embeddings,
    layer: Vec<Block>,
    norm: LayerNorm,
    #[module(skip)]
    rotary: RotaryTable,
}

impl Encoder {
    pub(crate) fn load(loader: &Loader<'_>, config: &BackboneConfig) -> Result<Self, ModelError> {
        Ok(Self {
            embeddings: Embeddings::load(&loader.child("embeddings"), config)?,
            layer: (0..config.layers)
                .map(|index| Block::load(&loader.child("layer").child(index), config))
                .collect::<Result<_, _>>()?,
            norm: LayerNorm::load(&loader.child("norm"), config.hidden, config.layer_norm_epsilon)?,
            rotary: RotaryTable::new(config),
        })
    }

    /// Image `1 x 3 x side x side` to the patches' map `1 x hidden x 16 x 16`.
    pub(crate) fn forward(&self, image: Tensor<4>, probe: &mut Probe<'_>) -> Tensor<4> {
        self.forward_turned(image, None, probe)
    }

    /// The same with another table of rotary angles, where one is given.
    pub(crate) fn forward_turned(
        &self,
        image: Tensor<4>,
        rotary: Option<&RotaryTable>,
        probe: &mut Probe<'_>,
    ) -> Tensor<4> {
        let (cos, sin) = rotary.unwrap_or(&self.rotary).on(&image.device());
        let mut tokens = self.embeddings.forward(image);
        probe.see("embeddings", &tokens);
        for (index, block) in self.layer.iter().enumerate() {
            let name = format!("layer.{index}");
            tokens = probe.inside(&name, |probe| block.forward(tokens, &cos, &sin, probe));
            probe.see(&name, &tokens);
        }
        let tokens = self.norm.forward(tokens);
        probe.see("last_hidden_state", &tokens);
        let [count, hidden] = tokens.dims();
        let first = count - PATCHES * PATCHES;
        tokens
            .narrow(0, first, PATCHES * PATCHES)
            .transpose()
            .reshape([1, hidden, PATCHES, PATCHES])
    }
}

/// Class token, register tokens, patches.
#[derive(Module, Debug)]
struct Embeddings {
    cls_token: Param<Tensor<3>>,
    register_tokens: Param<Tensor<3>>,
    patch_embeddings: Conv,
}

impl Embeddings {
    fn load(loader: &Loader<'_>, config: &BackboneConfig) -> Result<Self, ModelError> {
        let hidden = config.hidden;
        let patches = loader.child("patch_embeddings");
        Ok(Self {
            cls_token: loader.parameter("cls_token", [1, 1, hidden])?,
            register_tokens: loader.parameter("register_tokens", [1, config.registers, hidden])?,
            patch_embeddings: Conv::load(&patches, 3, hidden, config.patch)?.patches(),
        })
    }

    fn forward(&self, image: Tensor<4>) -> Tensor<2> {
        let [_, registers, hidden] = self.register_tokens.dims();
        let patches = self.patch_embeddings.forward(image);
        let patches = patches.reshape([hidden, PATCHES * PATCHES]).transpose();
        let mut parts = vec![self.cls_token.val().reshape([1, hidden])];
        if registers > 0 {
            parts.push(self.register_tokens.val().reshape([registers, hidden]));
        }
        parts.push(patches);
        Tensor::cat(parts, 0)
    }
}

/// One transformer block, normalised before each half.
#[derive(Module, Debug)]
struct Block {
    norm1: LayerNorm,
    attention: Attention,
    layer_scale1: LayerScale,
    norm2: LayerNorm,
    mlp: Mlp,
    layer_scale2: LayerScale,
}

impl Block {
    fn load(loader: &Loader<'_>, config: &BackboneConfig) -> Result<Self, ModelError> {
        let hidden = config.hidden;
        let norm = |name| LayerNorm::load(&loader.child(name), hidden, config.layer_norm_epsilon);
        Ok(Self {
            norm1: norm("norm1")?,
            attention: Attention::load(&loader.child("attention"), config)?,
            layer_scale1: LayerScale::load(&loader.child("layer_scale1"), hidden)?,
            norm2: norm("norm2")?,
            mlp: Mlp::load(&loader.child("mlp"), config)?,
            layer_scale2: LayerScale::load(&loader.child("layer_scale2"), hidden)?,
        })
    }

    fn forward(
        &self,
        tokens: Tensor<2>,
        cos: &Tensor<3>,
        sin: &Tensor<3>,
        probe: &mut Probe<'_>,
    ) -> Tensor<2> {
        let normed = self.norm1.forward(tokens.clone());
        probe.see("norm1", &normed);
        let attended =
            probe.inside("attention", |probe| self.attention.forward(normed, cos, sin, probe));
        let scaled = self.layer_scale1.forward(attended);
        probe.see("layer_scale1", &scaled);
        let tokens = tokens + scaled;
        let normed = self.norm2.forward(tokens.clone());
        probe.see("norm2", &normed);
        let mixed = probe.inside("mlp", |probe| self.mlp.forward(normed, probe));
        let scaled = self.layer_scale2.forward(mixed);
        probe.see("layer_scale2", &scaled);
        tokens + scaled
    }
}

/// A gain per channel.
#[derive(Module, Debug)]
struct LayerScale {
    lambda1: Param<Tensor<1>>,
}

impl LayerScale {
    fn load(loader: &Loader<'_>, channels: usize) -> Result<Self, ModelError> {
        Ok(Self { lambda1: loader.parameter("lambda1", [channels])? })
    }

    fn forward(&self, input: Tensor<2>) -> Tensor<2> {
        input * self.lambda1.val().unsqueeze()
    }
}

/// Two dense layers with the exact GELU between them.
#[derive(Module, Debug)]
struct Mlp {
    up_proj: Linear,
    down_proj: Linear,
}

impl Mlp {
    fn load(loader: &Loader<'_>, config: &BackboneConfig) -> Result<Self, ModelError> {
        let (hidden, wide) = (config.hidden, config.intermediate);
        Ok(Self {
            up_proj: Linear::load(&loader.child("up_proj"), hidden, wide)?,
            down_proj: Linear::load(&loader.child("down_proj"), wide, hidden)?,
        })
    }

    fn forward(&self, input: Tensor<2>, probe: &mut Probe<'_>) -> Tensor<2> {
        let up = self.up_proj.forward(input);
        probe.see("up_proj", &up);
        let active = activation::gelu(up);
        probe.see("act_fn", &active);
        let down = self.down_proj.forward(active);
        probe.see("down_proj", &down);
        down
    }
}

/// Multi-head self-attention with rotary positions on the patches.
#[derive(Module, Debug)]
struct Attention {
    q_proj: Linear,
    k_proj: Linear,
    v_proj: Linear,
    o_proj: Linear,
    #[module(skip)]
    heads: usize,
}

impl Attention {
    fn load(loader: &Loader<'_>, config: &BackboneConfig) -> Result<Self, ModelError> {
        let hidden = config.hidden;
        let linear = |name| Linear::load(&loader.child(name), hidden, hidden);
        Ok(Self {
            q_proj: linear("q_proj")?,
            k_proj: Linear::without_bias(&loader.child("k_proj"), hidden, hidden)?,
            v_proj: linear("v_proj")?,
            o_proj: linear("o_proj")?,
            heads: config.heads,
        })
    }

    fn forward(
        &self,
        input: Tensor<2>,
        cos: &Tensor<3>,
        sin: &Tensor<3>,
        probe: &mut Probe<'_>,
    ) -> Tensor<2> {
        let [tokens, hidden] = input.dims();
        let size = hidden / self.heads;
        let mut project = |linear: &Linear, name: &str| -> Tensor<3> {
            let projected = linear.forward(input.clone());
            probe.see(name, &projected);
            projected.reshape([tokens, self.heads, size]).swap_dims(0, 1)
        };
        let query = rotate(project(&self.q_proj, "q_proj"), cos, sin);
        let key = rotate(project(&self.k_proj, "k_proj"), cos, sin);
        let value = project(&self.v_proj, "v_proj");
        // sqrt is correctly rounded everywhere.
        let logits = query.matmul(key.swap_dims(1, 2)) / (size as f64).sqrt();
        let mixed = activation::softmax(logits, 2).matmul(value);
        let output = self.o_proj.forward(mixed.swap_dims(0, 1).reshape([tokens, hidden]));
        probe.see("o_proj", &output);
        output
    }
}

/// Turns channel pairs (m, m + size/2) by each token's angles.
fn rotate(input: Tensor<3>, cos: &Tensor<3>, sin: &Tensor<3>) -> Tensor<3> {
    let half = input.dims()[2] / 2;
    let first = input.clone().narrow(2, 0, half);
    let second = input.clone().narrow(2, half, half);
    let turned = Tensor::cat(vec![second.neg(), first], 2);
    input * cos.clone() + turned * sin.clone()
}

/// Cosines and sines of the rotary angles, `tokens x head`; class and register tokens stay as they
/// are (angle 0).
#[derive(Clone, Debug)]
pub(crate) struct RotaryTable {
    tokens: usize,
    head: usize,
    cos: Vec<f32>,
    sin: Vec<f32>,
}

impl RotaryTable {
    /// Patch (row, column) lies at `2 (index + 1/2) / 16 - 1`; the first quarter of a head turns
    /// with the row, the second with the column, and the other half repeats both.
    pub(crate) fn new(config: &BackboneConfig) -> Self {
        Self::scaled(config, 1.0)
    }

    /// The same with all coordinates multiplied by `factor`, as training does at random.
    pub(crate) fn scaled(config: &BackboneConfig, factor: f64) -> Self {
        let head = config.head();
        let quarter = head / 4;
        let tokens = 1 + config.registers + PATCHES * PATCHES;
        let place = |index: usize| (2.0 * (index as f64 + 0.5) / PATCHES as f64 - 1.0) * factor;
        let frequency =
            |index: usize| libm::pow(config.rope_theta, -(index as f64) * 4.0 / head as f64);
        let mut angles = vec![0.0; (1 + config.registers) * head];
        for row in 0..PATCHES {
            for column in 0..PATCHES {
                for _ in 0..2 {
                    for at in [row, column] {
                        angles.extend((0..quarter).map(|index| TAU * place(at) * frequency(index)));
                    }
                }
            }
        }
        let cos = angles.iter().map(|&angle| libm::cos(angle) as f32).collect();
        let sin = angles.iter().map(|&angle| libm::sin(angle) as f32).collect();
        Self { tokens, head, cos, sin }
    }

    /// Values for the patch tokens, `256 x head`: cosines and sines.
    #[cfg(test)]
    pub(crate) fn patches(&self) -> (&[f32], &[f32]) {
        let skipped = (self.tokens - PATCHES * PATCHES) * self.head;
        (&self.cos[skipped..], &self.sin[skipped..])
    }

    /// Turns rows of all heads' channels and multiplies them.
    #[cfg(feature = "onednn")]
    pub(crate) fn turn(&self, rows: &mut [f32], hidden: usize, factor: f32) {
        let half = self.head / 2;
        let angles = self.cos.chunks_exact(self.head).zip(self.sin.chunks_exact(self.head));
        for (row, (cos, sin)) in rows.chunks_exact_mut(hidden).zip(angles) {
            for head in row.chunks_exact_mut(self.head) {
                let (first, second) = head.split_at_mut(half);
                for index in 0..half {
                    let (a, b) = (first[index], second[index]);
                    first[index] = (a * cos[index] - b * sin[index]) * factor;
                    second[index] = (b * cos[half + index] + a * sin[half + index]) * factor;
                }
            }
        }
    }

    fn on(&self, device: &Device) -> (Tensor<3>, Tensor<3>) {
        let shape = [1, self.tokens, self.head];
        let tensor =
            |values: &Vec<f32>| Tensor::from_data(TensorData::new(values.clone(), shape), device);
        (tensor(&self.cos), tensor(&self.sin))
    }
}
