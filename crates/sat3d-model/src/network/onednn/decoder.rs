//! The convolutional decoder (MODEL_SPEC section 5) on the library's convolutions.

use super::attention::Heads;
use super::layers::{Conv, ConvShape, Dense, DenseProduct, Numerics, Upsample};
use super::map::{Context, Map, Shape};
use super::passes::{Change, GroupNorm, Target, constants, prepared};
use crate::config::{Border, DecoderConfig};
use crate::error::ModelError;
use crate::network::loader::Place;
use crate::network::probe::Probe;
use crate::tensor::Grid;
use rayon::prelude::*;
use sat3d_onednn::{BLOCK, Element, Layout, Library, Memory, Order};

/// Low-resolution map to high-resolution map.
#[derive(Debug)]
pub(super) struct Decoder {
    conv_in: Conv,
    block_1: ResidualBlock,
    attention: Option<SpatialAttention>,
    block_2: ResidualBlock,
    /// From level 0 up; the last comes first.
    up: Vec<Level>,
    norm_out: GroupNorm,
    conv_out: Conv,
    order: Order,
}

impl Decoder {
    /// `side` is that of the input. `border` is that of `conv_in`, `conv_out` and each level's first convolutions; all
    /// others have zeros around.
    pub(super) fn load(
        library: &'static Library,
        place: &Place<'_>,
        config: &DecoderConfig,
        (side, border): (usize, Border),
        numerics: Numerics,
    ) -> Result<Self, ModelError> {
        let numerics = fitting(config, numerics);
        let top = config.multipliers.len() - 1;
        let width = config.width(top);
        let block = |place: &Place<'_>, [inputs, outputs]: [usize; 2], side: usize, border| {
            ResidualBlock::load(library, place, (inputs, outputs, side), border, numerics)
        };
        let levels: Vec<Level> = (0..=top)
            .into_par_iter()
            .map(|level| {
                let place = place.child("up").child(level);
                let (before, own) = (config.width((level + 1).min(top)), config.width(level));
                let side = side << (top - level);
                let blocks = (0..3)
                    .map(|index| {
                        let inputs = if index == 0 { before } else { own };
                        block(&place.child("block").child(index), [inputs, own], side, border)
                    })
                    .collect::<Result<_, _>>()?;
                let upsample = |place: Place<'_>| {
                    Upsample::load(library, &place.child("conv"), (own, side), numerics)
                };
                let upsample =
                    (level > 0).then(|| upsample(place.child("upsample"))).transpose()?;
                Ok(Level { blocks, upsample })
            })
            .collect::<Result<_, ModelError>>()?;
        let conv = |name, inputs, outputs, side| {
            let shape = ConvShape { inputs, outputs, side, kernel: 3, border, sum: false };
            Conv::load(library, &place.child(name), shape, numerics)
        };
        let mid = place.child("mid");
        let attention = || SpatialAttention::load(library, &mid.child("attn_1"), width, side);
        let first = config.width(0);
        Ok(Self {
            conv_in: conv("conv_in", config.inputs, width, side)?,
            block_1: block(&mid.child("block_1"), [width; 2], side, Border::Zeros)?,
            attention: config.attention.then(attention).transpose()?,
            block_2: block(&mid.child("block_2"), [width; 2], side, Border::Zeros)?,
            up: levels,
            norm_out: GroupNorm::load(&place.child("norm_out"), first)?,
            conv_out: conv("conv_out", first, config.outputs, side << top)?,
            order: numerics.order,
        })
    }

    /// `grid` is the input without its border of `margin` empty places.
    pub(super) fn forward(
        &self,
        context: &mut Context,
        grid: &Grid,
        margin: usize,
        probe: &mut Probe<'_>,
    ) -> Result<Grid, ModelError> {
        let input = Map::of_grid(context, grid, margin, self.order)?;
        let map = self.conv_in.forward(context, &input, &Change::Copy)?;
        context.put(input.memory);
        see(probe, "conv_in", &map);
        let map = probe.inside("mid", |probe| {
            let mut map = self.block_1.forward(context, map, "block_1", probe)?;
            if let Some(attention) = &self.attention {
                attention.forward(context, &mut map)?;
                see(probe, "attn_1", &map);
            }
            self.block_2.forward(context, map, "block_2", probe)
        });
        let mut map = map?;
        for (index, level) in self.up.iter().enumerate().rev() {
            map =
                probe.inside(&format!("up.{index}"), |probe| level.forward(context, map, probe))?;
        }
        let norm = constants(&map, &self.norm_out);
        let result = self.conv_out.forward(context, &map, &Change::NormSwish(&norm))?;
        context.put(map.memory);
        see(probe, "conv_out", &result);
        let grid = result.to_grid();
        context.put(result.memory);
        Ok(grid)
    }
}

/// Blocks of channels only where all maps have whole ones; Winograd's convolutions need them.
fn fitting(config: &DecoderConfig, numerics: Numerics) -> Numerics {
    let widths = (0..config.multipliers.len()).map(|level| config.width(level));
    let whole = widths.chain([config.inputs, config.outputs]).all(|c| c.is_multiple_of(BLOCK));
    Numerics { order: if whole { numerics.order } else { Order::Pixels }, ..numerics }
}

fn see(probe: &mut Probe<'_>, name: &str, map: &Map) {
    probe.see_values(name, || {
        let Shape { channels, height, width } = map.shape;
        (vec![channels, height, width], map.to_grid().data)
    });
}

/// Three residual blocks, then twice the size (all but level 0).
#[derive(Debug)]
struct Level {
    blocks: Vec<ResidualBlock>,
    upsample: Option<Upsample>,
}

impl Level {
    fn forward(
        &self,
        context: &mut Context,
        mut map: Map,
        probe: &mut Probe<'_>,
    ) -> Result<Map, ModelError> {
        for (index, block) in self.blocks.iter().enumerate() {
            map = block.forward(context, map, &format!("block.{index}"), probe)?;
        }
        if let Some(upsample) = &self.upsample {
            let doubled = upsample.forward(context, &map)?;
            context.put(std::mem::replace(&mut map, doubled).memory);
            see(probe, "upsample", &map);
        }
        Ok(map)
    }
}

/// Norm, swish, convolution, twice, beside the input.
#[derive(Debug)]
struct ResidualBlock {
    norm1: GroupNorm,
    conv1: Conv,
    norm2: GroupNorm,
    conv2: Conv,
    nin_shortcut: Option<Conv>,
}

impl ResidualBlock {
    fn load(
        library: &'static Library,
        place: &Place<'_>,
        (inputs, outputs, side): (usize, usize, usize),
        border: Border,
        numerics: Numerics,
    ) -> Result<Self, ModelError> {
        let conv = |name, shape| Conv::load(library, &place.child(name), shape, numerics);
        let zeros = Border::Zeros;
        let first = ConvShape { inputs, outputs, side, kernel: 3, border, sum: false };
        let second = ConvShape { inputs: outputs, border: zeros, sum: true, ..first };
        let shortcut = ConvShape { kernel: 1, border: zeros, ..first };
        Ok(Self {
            norm1: GroupNorm::load(&place.child("norm1"), inputs)?,
            conv1: conv("conv1", first)?,
            norm2: GroupNorm::load(&place.child("norm2"), outputs)?,
            conv2: conv("conv2", second)?,
            nin_shortcut: (inputs != outputs)
                .then(|| conv("nin_shortcut", shortcut))
                .transpose()?,
        })
    }

    /// The second convolution adds to the input where that lies, or to the shortcut's result.
    fn forward(
        &self,
        context: &mut Context,
        input: Map,
        name: &str,
        probe: &mut Probe<'_>,
    ) -> Result<Map, ModelError> {
        let norm = constants(&input, &self.norm1);
        let map = self.conv1.forward(context, &input, &Change::NormSwish(&norm))?;
        probe.inside(name, |probe| see(probe, "conv1", &map));
        let mut result = match &self.nin_shortcut {
            None => input,
            Some(shortcut) => {
                let result = shortcut.forward(context, &input, &Change::Copy)?;
                context.put(input.memory);
                result
            }
        };
        let norm = constants(&map, &self.norm2);
        self.conv2.add(context, &map, &Change::NormSwish(&norm), &mut result)?;
        context.put(map.memory);
        see(probe, name, &result);
        Ok(result)
    }
}

/// Self-attention over all places of the map, one head.
#[derive(Debug)]
struct SpatialAttention {
    norm: GroupNorm,
    /// Queries (scaled already), keys and values as one layer.
    qkv: Dense,
    qkv_product: DenseProduct,
    heads: Heads,
    proj_out: Dense,
    proj_product: DenseProduct,
    rows: Layout,
}

impl SpatialAttention {
    fn load(
        library: &'static Library,
        place: &Place<'_>,
        width: usize,
        side: usize,
    ) -> Result<Self, ModelError> {
        let (rows, f32) = (side * side, Element::F32);
        let (mut weights, mut bias) = (Vec::new(), Vec::new());
        for name in ["q", "k", "v"] {
            let place = place.child(name);
            // sqrt is correctly rounded everywhere.
            let scale = if name == "q" { 1.0 / (width as f32).sqrt() } else { 1.0 };
            let scaled = |values: Vec<f32>| values.into_iter().map(move |value| value * scale);
            weights.extend(scaled(place.read("weight", [width, width, 1, 1])?));
            bias.extend(scaled(place.read("bias", [width])?));
        }
        let qkv_product = DenseProduct::new(library, rows, (width, 3 * width), f32, false)?;
        let proj_product = DenseProduct::new(library, rows, (width, width), f32, false)?;
        let proj = place.child("proj_out");
        let failed = super::map::failed("attention");
        Ok(Self {
            norm: GroupNorm::load(&place.child("norm"), width)?,
            qkv: Dense::of(weights, bias),
            qkv_product,
            heads: Heads::new(library, rows, (1, width), 3 * width)?,
            proj_out: Dense::of(
                proj.read("weight", [width, width, 1, 1])?,
                proj.read("bias", [width])?,
            ),
            proj_product,
            rows: Layout::dense(library, &[rows, width], f32).map_err(failed)?,
        })
    }

    fn forward(&self, context: &mut Context, map: &mut Map) -> Result<(), ModelError> {
        let norm = constants(map, &self.norm);
        let rows = self.normed_rows(context, map, &Change::Norm(&norm))?;
        let qkv = self.qkv.forward(context, &self.qkv_product, None, rows.view())?;
        context.put(rows);
        let width = map.shape.channels;
        let parts = [0, width, 2 * width].map(|first| (qkv.floats(), first));
        let mixed = self.heads.forward(context, parts)?;
        let added = self.proj_out.forward(context, &self.proj_product, None, mixed.view())?;
        for memory in [qkv, mixed] {
            context.put(memory);
        }
        let (lanes, pixels) = (map.lanes(), map.shape.pixels());
        for (block, values) in map.values_mut().chunks_exact_mut(pixels * lanes).enumerate() {
            for (pixel, values) in values.chunks_exact_mut(lanes).enumerate() {
                let from = &added.floats()[pixel * width + block * lanes..][..lanes];
                values.iter_mut().zip(from).for_each(|(value, add)| *value += add);
            }
        }
        context.put(added);
        Ok(())
    }

    /// The map as rows of all channels.
    fn normed_rows(
        &self,
        context: &mut Context,
        map: &Map,
        change: &Change<'_>,
    ) -> Result<Memory, ModelError> {
        let memory = prepared(context, map, change, Target::plain(Element::F32))?;
        if map.order == Order::Pixels {
            return memory.relaid(self.rows).map_err(super::map::failed("attention"));
        }
        let (lanes, pixels, width) = (map.lanes(), map.shape.pixels(), map.shape.channels);
        let mut rows = context.take(self.rows);
        for (pixel, row) in rows.floats_mut().chunks_exact_mut(width).enumerate() {
            for (block, out) in row.chunks_exact_mut(lanes).enumerate() {
                out.copy_from_slice(&memory.floats()[(block * pixels + pixel) * lanes..][..lanes]);
            }
        }
        context.put(memory);
        Ok(rows)
    }
}
