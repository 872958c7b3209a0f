//! DINOv3 (MODEL_SPEC section 3) on the library's products.

use super::attention::Heads;
use super::layers::{Dense, DenseProduct};
use super::map::{Context, failed};
use super::passes::halve;
use crate::config::{BackboneConfig, PATCHES};
use crate::error::ModelError;
use crate::network::encoder::RotaryTable;
use crate::network::loader::Place;
use crate::network::probe::Probe;
use crate::tensor::Grid;
use rayon::prelude::*;
use sat3d_onednn::{Element, Layout, Library, Memory};

/// Image to tokens.
#[derive(Debug)]
pub(super) struct Encoder {
    config: BackboneConfig,
    element: Element,
    cls_token: Vec<f32>,
    register_tokens: Vec<f32>,
    patches: Dense,
    patches_product: DenseProduct,
    /// Of the layers' four products of the same size.
    square: DenseProduct,
    up: DenseProduct,
    down: DenseProduct,
    heads: Heads,
    /// Rows of tokens, as products read them.
    rows: Layout,
    layers: Vec<Layer>,
    norm: Norm,
    rotary: RotaryTable,
}

/// One transformer block, normalised before each half.
#[derive(Debug)]
struct Layer {
    norm1: Norm,
    /// Queries, keys, values.
    parts: [Dense; 3],
    output: Dense,
    scale1: Vec<f32>,
    norm2: Norm,
    up: Dense,
    down: Dense,
    scale2: Vec<f32>,
}

/// Gain and shift after a normalisation of a token's channels.
#[derive(Debug)]
struct Norm {
    gain: Vec<f32>,
    shift: Vec<f32>,
}

impl Norm {
    fn load(place: &Place<'_>, channels: usize) -> Result<Self, ModelError> {
        Ok(Self { gain: place.read("weight", [channels])?, shift: place.read("bias", [channels])? })
    }
}

impl Encoder {
    pub(super) fn load(
        library: &'static Library,
        place: &Place<'_>,
        config: &BackboneConfig,
        element: Element,
    ) -> Result<Self, ModelError> {
        let (hidden, wide) = (config.hidden, config.intermediate);
        let tokens = 1 + config.registers + PATCHES * PATCHES;
        let product = |rows, inputs, outputs, element, gelu| {
            DenseProduct::new(library, rows, (inputs, outputs), element, gelu)
        };
        let square = product(tokens, hidden, hidden, element, false)?;
        let up = product(tokens, hidden, wide, element, true)?;
        let down = product(tokens, wide, hidden, element, false)?;
        let layer = |index: usize| {
            let place = place.child("layer").child(index);
            let attention = place.child("attention");
            let dense = |name, bias| Dense::load(&square, &attention.child(name), bias);
            let scale = |name: &str| place.child(name).read("lambda1", [hidden]);
            let mlp = place.child("mlp");
            Ok::<_, ModelError>(Layer {
                norm1: Norm::load(&place.child("norm1"), hidden)?,
                parts: [dense("q_proj", true)?, dense("k_proj", false)?, dense("v_proj", true)?],
                output: dense("o_proj", true)?,
                scale1: scale("layer_scale1")?,
                norm2: Norm::load(&place.child("norm2"), hidden)?,
                up: Dense::load(&up, &mlp.child("up_proj"), true)?,
                down: Dense::load(&down, &mlp.child("down_proj"), true)?,
                scale2: scale("layer_scale2")?,
            })
        };
        let embeddings = place.child("embeddings");
        let patch = config.patch;
        // A patch's weights are read as a row; few enough to stay in 32 bits.
        let patches = embeddings.child("patch_embeddings");
        let stored = patches.read("weight", [hidden, 3, patch, patch])?;
        let bias = patches.read("bias", [hidden])?;
        let size = (config.heads, config.head());
        let rows = Layout::dense(library, &[tokens, hidden], element).map_err(failed("encoder"))?;
        Ok(Self {
            config: config.clone(),
            element,
            cls_token: embeddings.read("cls_token", [1, 1, hidden])?,
            register_tokens: embeddings.read("register_tokens", [1, config.registers, hidden])?,
            patches: Dense::of(stored, bias),
            patches_product: product(
                PATCHES * PATCHES,
                3 * patch * patch,
                hidden,
                Element::F32,
                false,
            )?,
            layers: (0..config.layers).into_par_iter().map(layer).collect::<Result<_, _>>()?,
            heads: Heads::new(library, tokens, size, hidden)?,
            norm: Norm::load(&place.child("norm"), hidden)?,
            rotary: RotaryTable::new(config),
            square,
            up,
            down,
            rows,
        })
    }

    /// Image `3 x side x side` to the patches' map `hidden x 16 x 16`. `root` is where all keys begin.
    pub(super) fn forward(
        &self,
        context: &mut Context,
        image: &Grid,
        root: &Place<'_>,
        probe: &mut Probe<'_>,
    ) -> Result<Grid, ModelError> {
        let hidden = self.config.hidden;
        let mut tokens = self.embed(context, image, root)?;
        see(probe, "embeddings", &tokens, hidden);
        for (index, layer) in self.layers.iter().enumerate() {
            self.layer(context, layer, &mut tokens, root)?;
            see(probe, &format!("layer.{index}"), &tokens, hidden);
        }
        normalise(&mut tokens, &self.norm, self.config.layer_norm_epsilon);
        see(probe, "last_hidden_state", &tokens, hidden);
        let first = tokens.len() - PATCHES * PATCHES * hidden;
        let patches = &tokens[first..];
        let channel = |channel: usize| patches.iter().skip(channel).step_by(hidden).copied();
        Ok(Grid::new(hidden, PATCHES, PATCHES, (0..hidden).flat_map(channel).collect()))
    }

    /// Class token, register tokens, patches: rows of tokens.
    fn embed(
        &self,
        context: &mut Context,
        image: &Grid,
        root: &Place<'_>,
    ) -> Result<Vec<f32>, ModelError> {
        let patch = self.config.patch;
        let mut rows = Vec::with_capacity(image.data.len());
        for row in 0..PATCHES {
            for column in 0..PATCHES {
                for channel in 0..3 {
                    for y in 0..patch {
                        let first = (row * patch + y) * image.width + column * patch;
                        rows.extend_from_slice(&image.channel(channel)[first..][..patch]);
                    }
                }
            }
        }
        let view = self.patches_product.rows(&rows)?;
        let patches = self.patches.forward(context, &self.patches_product, Some(root), view)?;
        let tokens = [&self.cls_token, &self.register_tokens, patches.floats()].concat();
        context.put(patches);
        Ok(tokens)
    }

    fn layer(
        &self,
        context: &mut Context,
        layer: &Layer,
        tokens: &mut [f32],
        root: &Place<'_>,
    ) -> Result<(), ModelError> {
        let epsilon = self.config.layer_norm_epsilon;
        let rows = self.normed(context, tokens, &layer.norm1, epsilon);
        let [q, k, v] = &layer.parts;
        let mut part =
            |dense: &Dense| dense.forward(context, &self.square, Some(root), rows.view());
        let (mut query, mut key, value) = (part(q)?, part(k)?, part(v)?);
        context.put(rows);
        let head = self.config.head();
        // sqrt is correctly rounded everywhere.
        self.rotary.turn(query.floats_mut(), self.config.hidden, 1.0 / (head as f32).sqrt());
        self.rotary.turn(key.floats_mut(), self.config.hidden, 1.0);
        let parts = [&query, &key, &value].map(|memory| (memory.floats(), 0));
        let mixed = self.heads.forward(context, parts)?;
        let rows = self.rows(context, mixed.floats());
        let output = layer.output.forward(context, &self.square, Some(root), rows.view())?;
        add(tokens, output.floats(), &layer.scale1);
        for memory in [query, key, value, mixed, rows, output] {
            context.put(memory);
        }
        let rows = self.normed(context, tokens, &layer.norm2, epsilon);
        let wide = layer.up.forward(context, &self.up, Some(root), rows.view())?;
        let output = layer.down.forward(context, &self.down, Some(root), wide.view())?;
        add(tokens, output.floats(), &layer.scale2);
        for memory in [rows, wide, output] {
            context.put(memory);
        }
        Ok(())
    }

    /// Normalised tokens as a product reads them.
    fn normed(&self, context: &mut Context, tokens: &[f32], norm: &Norm, epsilon: f64) -> Memory {
        let mut normed = tokens.to_vec();
        normalise(&mut normed, norm, epsilon);
        self.rows(context, &normed)
    }

    /// Rows as a product reads them.
    fn rows(&self, context: &mut Context, values: &[f32]) -> Memory {
        let mut rows = context.take(self.rows);
        match self.element {
            Element::F32 => rows.floats_mut().copy_from_slice(values),
            Element::Bf16 => halve(values, rows.halves_mut()),
        }
        rows
    }
}

/// Each row less its mean, over its deviation, scaled and shifted. Sums run in 64-bit floats.
fn normalise(rows: &mut [f32], norm: &Norm, epsilon: f64) {
    let width = norm.gain.len();
    rows.par_chunks_exact_mut(width).for_each(|row| {
        let sum = |of: &dyn Fn(f32) -> f64| {
            let mut sums = [0.0_f64; 8];
            for values in row.chunks(8) {
                values.iter().zip(&mut sums).for_each(|(value, sum)| *sum += of(*value));
            }
            sums.iter().sum::<f64>()
        };
        let mean = sum(&|value| f64::from(value)) / width as f64;
        let variance = sum(&|value| (f64::from(value) - mean) * (f64::from(value) - mean));
        let inverse = (1.0 / (variance / width as f64 + epsilon).sqrt()) as f32;
        let mean = mean as f32;
        for (value, (gain, shift)) in row.iter_mut().zip(norm.gain.iter().zip(&norm.shift)) {
            *value = ((*value - mean) * inverse).mul_add(*gain, *shift);
        }
    });
}

/// Adds rows, each channel times its scale.
fn add(rows: &mut [f32], more: &[f32], scale: &[f32]) {
    for (row, more) in rows.chunks_exact_mut(scale.len()).zip(more.chunks_exact(scale.len())) {
        for ((value, more), scale) in row.iter_mut().zip(more).zip(scale) {
            *value += more * scale;
        }
    }
}

fn see(probe: &mut Probe<'_>, name: &str, tokens: &[f32], hidden: usize) {
    probe.see_values(name, || (vec![tokens.len() / hidden, hidden], tokens.to_vec()));
}
