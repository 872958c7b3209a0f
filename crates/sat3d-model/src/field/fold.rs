//! Folding: from feature maps and weights as stored to tables that are fast to read.

use super::color::ColorHead;
use super::kernel::LANES;
use super::{DensityActivation, FieldError, FieldInputs, Linear, PointHead, Representation};
use pulp::Arch;
use rayon::prelude::*;
use std::sync::Arc;

/// A folded plane: `(rows + 2) x (columns + 2)` texels of `hidden` values, with a ring of zeros that
/// stands for everything outside the map.
#[derive(Debug)]
pub(super) struct Plane {
    pub rows: usize,
    pub columns: usize,
    pub texels: Vec<f32>,
}

/// A folded line: `cells + 2` texels of `hidden` values, the first and last of them zero.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub cells: usize,
    pub texels: Vec<f32>,
}

/// Where a point's hidden values come from.
#[derive(Debug)]
pub(super) enum Tables {
    /// A plane over (x, y) and a line over z.
    PlaneAndLine(Plane, Line),
    /// Planes over (x, y), (x, z) and (z, y), columns first.
    Triplane([Plane; 3]),
}

impl Tables {
    fn texels(&self) -> Vec<&[f32]> {
        match self {
            Self::PlaneAndLine(plane, line) => vec![&plane.texels, &line.texels],
            Self::Triplane(planes) => planes.iter().map(|plane| &plane.texels[..]).collect(),
        }
    }
}

/// The radiance field of one image, ready to be evaluated anywhere.
///
/// Cloning and restyling are cheap: the tables are shared.
#[derive(Clone, Debug)]
pub struct Field {
    pub(super) arch: Arch,
    /// Hidden values, rounded up to whole groups of lanes; the additional ones weigh nothing.
    pub(super) hidden: usize,
    pub(super) tables: Arc<Tables>,
    pub(super) bias: Arc<[f32]>,
    pub(super) density_weight: Arc<[f32]>,
    pub(super) density_bias: f32,
    pub(super) color: Arc<ColorHead>,
    pub(super) activation: DensityActivation,
    pub(super) scale: f32,
}

impl Field {
    /// Folds the head into the feature map. `style` is the image's style code (the released width is
    /// 512); none means the zero code, with which the satellite view is trained.
    ///
    /// The inputs are only read; the field holds its own tables (26 MB for a released plane).
    ///
    /// # Errors
    /// When shapes do not fit each other, a value is not finite or its product with the head's weights is beyond
    /// 32-bit floats, or the scale is not in (0, 1].
    pub fn new(
        inputs: &FieldInputs,
        head: &PointHead,
        style: Option<&[f32]>,
    ) -> Result<Self, FieldError> {
        check(inputs, head)?;
        let color = ColorHead::new(head, style)?;
        let hidden = head.net0.outputs.next_multiple_of(LANES);
        let mut bias = head.net0.bias.clone();
        bias.resize(hidden, 0.0);
        let mut density_weight = head.density.weight.clone();
        density_weight.resize(hidden, 0.0);
        let tables = tables(inputs, &head.net0, hidden);
        // A weight of 0 times an infinite texel is no number, and no number is empty space.
        for texels in tables.texels() {
            finite("map times net0.weight", texels)?;
        }
        Ok(Self {
            arch: Arch::new(),
            hidden,
            tables: Arc::new(tables),
            bias: bias.into(),
            density_weight: density_weight.into(),
            density_bias: head.density.bias[0],
            color: Arc::new(color),
            activation: inputs.activation,
            scale: inputs.scale,
        })
    }

    /// The same field with the colours of another style code; the tables are shared.
    ///
    /// # Errors
    /// When the head or the style code does not fit.
    pub fn with_style(&self, head: &PointHead, style: Option<&[f32]>) -> Result<Self, FieldError> {
        check_head(head)?;
        let color = Arc::new(ColorHead::new(head, style)?);
        Ok(Self { color, ..self.clone() })
    }

    /// Colour channels of a point; the first three are red, green and blue in `[0, 1]`.
    #[must_use]
    pub fn color_channels(&self) -> usize {
        self.color.channels
    }

    /// From raw to volume density.
    #[must_use]
    pub fn activation(&self) -> DensityActivation {
        self.activation
    }

    /// `position_scale_factor`: the crop covers x and y in `[-scale, scale]`.
    #[must_use]
    pub fn scale(&self) -> f32 {
        self.scale
    }

    /// Half the width of a texel in x, in cube units: the field is bilinear between such steps.
    #[must_use]
    pub fn half_texel(&self) -> f32 {
        let columns = match &*self.tables {
            Tables::PlaneAndLine(plane, _) | Tables::Triplane([plane, _, _]) => plane.columns,
        };
        1.0 / columns as f32
    }
}

fn shape(tensor: &'static str, found: impl ToString, expected: impl ToString) -> FieldError {
    FieldError::Shape { tensor, found: found.to_string(), expected: expected.to_string() }
}

/// Every value finite.
pub(super) fn finite(tensor: &'static str, values: &[f32]) -> Result<(), FieldError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(FieldError::NotFinite { tensor, index, value: values[index] }),
        None => Ok(()),
    }
}

fn check_layer(
    names: [&'static str; 2],
    layer: &Linear,
    inputs: usize,
    outputs: usize,
) -> Result<(), FieldError> {
    let found = format!("{} x {}", layer.outputs, layer.inputs);
    if (layer.inputs, layer.outputs) != (inputs, outputs) {
        return Err(shape(names[0], found, format!("{outputs} x {inputs}")));
    }
    if layer.weight.len() != inputs * outputs {
        return Err(shape(names[0], format!("{} values", layer.weight.len()), found));
    }
    if layer.bias.len() != outputs {
        return Err(shape(names[1], layer.bias.len(), outputs));
    }
    finite(names[0], &layer.weight)?;
    finite(names[1], &layer.bias)
}

fn check_head(head: &PointHead) -> Result<(), FieldError> {
    let hidden = head.net0.outputs;
    let features = head.feature.outputs;
    let some = |name, count: usize| {
        if count == 0 { Err(shape(name, "no output", "one or more")) } else { Ok(()) }
    };
    some("net0.weight", hidden)?;
    some("net1_feature.weight", features)?;
    some("grd_color_convert.weight", head.color.outputs)?;
    check_layer(["net0.weight", "net0.bias"], &head.net0, head.net0.inputs, hidden)?;
    check_layer(["net1_density.weight", "net1_density.bias"], &head.density, hidden, 1)?;
    check_layer(["net1_feature.weight", "net1_feature.bias"], &head.feature, hidden, features)?;
    let codes = head.style.inputs;
    check_layer(["style_squ.weight", "style_squ.bias"], &head.style, codes, features)?;
    let colors = head.color.outputs;
    let names = ["grd_color_convert.weight", "grd_color_convert.bias"];
    check_layer(names, &head.color, 2 * features, colors)
}

fn check(inputs: &FieldInputs, head: &PointHead) -> Result<(), FieldError> {
    if !(inputs.scale > 0.0 && inputs.scale <= 1.0) {
        return Err(FieldError::Scale(inputs.scale));
    }
    let map = &inputs.map;
    let parts = match inputs.representation {
        Representation::Oneplane | Representation::OneplaneMulti => 2,
        Representation::Triplane => 3,
    };
    let size = format!("{} x {} x {}", map.channels, map.height, map.width);
    if map.channels == 0 || !map.channels.is_multiple_of(parts) {
        return Err(shape("map", size, format!("a multiple of {parts} channels")));
    }
    if map.height == 0 || map.width == 0 || map.data.len() != map.channels * map.height * map.width
    {
        return Err(shape("map", format!("{size}, {} values", map.data.len()), "a full map"));
    }
    let features = match inputs.representation {
        Representation::Oneplane => map.channels,
        Representation::OneplaneMulti | Representation::Triplane => map.channels / parts,
    };
    if head.net0.inputs != features {
        return Err(shape("net0.weight", format!("{} inputs", head.net0.inputs), features));
    }
    check_head(head)?;
    finite("map", &map.data)
}

fn tables(inputs: &FieldInputs, net0: &Linear, hidden: usize) -> Tables {
    let map = &inputs.map;
    let size = map.height * map.width;
    let channels = map.channels;
    // Columns `from..from + count` of the layer's weights as count x hidden, divided as the mean asks.
    let weights = |from: usize, count: usize, parts: f64| {
        let mut block = vec![0.0_f32; count * hidden];
        for (input, row) in block.chunks_exact_mut(hidden).enumerate() {
            for (output, value) in row[..net0.outputs].iter_mut().enumerate() {
                *value =
                    (f64::from(net0.weight[output * net0.inputs + from + input]) / parts) as f32;
            }
        }
        block
    };
    let plane = |from: usize, count: usize, weights: &[f32]| {
        fold_plane(&map.data[from * size..][..count * size], map.height, map.width, weights, hidden)
    };
    if inputs.representation == Representation::Triplane {
        let count = channels / 3;
        let weights = weights(0, count, 3.0);
        return Tables::Triplane([0, 1, 2].map(|k| plane(k * count, count, &weights)));
    }
    let count = channels / 2;
    let (over_plane, over_line) = match inputs.representation {
        Representation::Oneplane => (weights(0, count, 1.0), weights(count, count, 1.0)),
        _ => (weights(0, count, 2.0), weights(0, count, 2.0)),
    };
    let line = fold_line(&map.data[count * size..], map.height, map.width, &over_line, hidden);
    Tables::PlaneAndLine(plane(0, count, &over_plane), line)
}

struct FoldRow<'a> {
    channels: &'a [f32],
    size: usize,
    columns: usize,
    row: usize,
    weights: &'a [f32],
    hidden: usize,
    out: &'a mut [f32],
}

impl pulp::NullaryFnOnce for FoldRow<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { channels, size, columns, row, weights, hidden, out } = self;
        for column in 0..columns {
            let texel = &mut out[(column + 1) * hidden..][..hidden];
            let first = row * columns + column;
            for (block, out) in texel.chunks_exact_mut(LANES).enumerate() {
                let mut sum = [0.0_f32; LANES];
                for (channel, weight) in weights.chunks_exact(hidden).enumerate() {
                    let value = channels[channel * size + first];
                    let weight = &weight[block * LANES..][..LANES];
                    for lane in 0..LANES {
                        sum[lane] = value.mul_add(weight[lane], sum[lane]);
                    }
                }
                out.copy_from_slice(&sum);
            }
        }
    }
}

/// `weights` (count x hidden) applied to every texel of `channels` (count x rows x columns).
fn fold_plane(
    channels: &[f32],
    rows: usize,
    columns: usize,
    weights: &[f32],
    hidden: usize,
) -> Plane {
    let arch = Arch::new();
    let size = rows * columns;
    let pitch = (columns + 2) * hidden;
    let mut texels = vec![0.0; (rows + 2) * pitch];
    texels[pitch..][..rows * pitch].par_chunks_mut(pitch).enumerate().for_each(|(row, out)| {
        arch.dispatch(FoldRow { channels, size, columns, row, weights, hidden, out });
    });
    Plane { rows, columns, texels }
}

/// The mean over rows of `channels` (count x rows x columns), then `weights`; columns become cells.
fn fold_line(
    channels: &[f32],
    rows: usize,
    columns: usize,
    weights: &[f32],
    hidden: usize,
) -> Line {
    let mut sums = vec![0.0_f64; columns * hidden];
    for (channel, weight) in channels.chunks_exact(rows * columns).zip(weights.chunks_exact(hidden))
    {
        let mut means = vec![0.0_f64; columns];
        for row in channel.chunks_exact(columns) {
            for (mean, value) in means.iter_mut().zip(row) {
                *mean += f64::from(*value);
            }
        }
        for (mean, sums) in means.iter().zip(sums.chunks_exact_mut(hidden)) {
            // Rounded as the network's own mean is.
            let mean = f64::from((mean / rows as f64) as f32);
            for (sum, weight) in sums.iter_mut().zip(weight) {
                *sum += mean * f64::from(*weight);
            }
        }
    }
    let mut texels = vec![0.0; (columns + 2) * hidden];
    for (texel, sum) in texels[hidden..].iter_mut().zip(&sums) {
        *texel = *sum as f32;
    }
    Line { cells: columns, texels }
}
