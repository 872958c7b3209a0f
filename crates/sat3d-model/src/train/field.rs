//! The radiance field as tensors that gradients pass through (MODEL_SPEC sections 6 and 7).
//!
//! It is folded as [`crate::field::Field`] is: the head's first layer is applied to the texels, of which
//! there are far fewer than points, and its two linear maps to colours are multiplied into one. Where a
//! point lies between texels is known without gradient, so places and weights are plain numbers.

use super::blend::{Taps, blend};
use crate::config::Config;
use crate::error::ModelError;
use crate::field::{DensityActivation, Representation};
use crate::network::layers::Linear;
use crate::network::loader::Loader;
use burn::module::Module;
use burn::tensor::{Device, Tensor, activation};

/// Sizes of a point head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct HeadSizes {
    /// Features of a point.
    pub features: usize,
    /// Hidden values.
    pub hidden: usize,
    /// Length of the style code.
    pub style: usize,
    /// Colour channels.
    pub colors: usize,
}

impl HeadSizes {
    /// Those of a configured network.
    pub(crate) fn of(config: &Config) -> Self {
        Self {
            features: config.point_features(),
            hidden: config.head_hidden,
            style: config.style,
            colors: config.color_channels,
        }
    }
}

/// The point head `mlp`; its fields are named as the checkpoint's keys.
#[derive(Module, Debug)]
pub(crate) struct Head {
    net0: Linear,
    net1_feature: Linear,
    net1_density: Linear,
    style_squ: Linear,
    grd_color_convert: Linear,
}

impl Head {
    pub(crate) fn load(loader: &Loader<'_>, sizes: HeadSizes) -> Result<Self, ModelError> {
        let HeadSizes { features, hidden, style, colors } = sizes;
        let linear = |name, inputs, outputs| Linear::load(&loader.child(name), inputs, outputs);
        Ok(Self {
            net0: linear("net0", features, hidden)?,
            net1_feature: linear("net1_feature", hidden, hidden / 2)?,
            net1_density: linear("net1_density", hidden, 1)?,
            style_squ: linear("style_squ", style, hidden / 2)?,
            grd_color_convert: linear("grd_color_convert", hidden, colors)?,
        })
    }

    /// What every colour of an image has in common, `1 x colours`: biases and the style code
    /// (`1 x style`; none stands for zeros).
    pub(crate) fn tint(&self, style: Option<Tensor<2>>) -> Tensor<2> {
        let half = self.net1_feature.weight.dims()[0];
        let of_style = match style {
            Some(style) => self.style_squ.forward(style),
            None => bias(&self.style_squ),
        };
        let both = Tensor::cat(vec![bias(&self.net1_feature), of_style], 1);
        debug_assert_eq!(both.dims()[1], 2 * half);
        self.grd_color_convert.forward(both)
    }
}

fn bias(layer: &Linear) -> Tensor<2> {
    match &layer.bias {
        Some(bias) => bias.val().unsqueeze(),
        None => Tensor::zeros([1, layer.weight.dims()[0]], &layer.weight.device()),
    }
}

/// Texels side by side, `texels x channels`, and weighted sums of them.
#[derive(Clone, Debug)]
pub(crate) struct Table {
    values: Tensor<2>,
}

impl Table {
    /// A map `channels x rows x columns` as it is.
    pub(crate) fn of_map(map: Tensor<3>) -> Self {
        let [channels, rows, columns] = map.dims();
        Self { values: map.reshape([channels, rows * columns]).transpose() }
    }

    /// The weighted sums, `points x channels`.
    pub(crate) fn sum(&self, taps: Taps) -> Tensor<2> {
        blend(self.values.clone(), taps)
    }
}

/// The two texels around a coordinate in `[-1, 1]` with their weights, 0 outside the map
/// (`align_corners` false, zeros beyond).
fn cell(coordinate: f32, count: usize) -> [(i32, f32); 2] {
    let size = count as f32;
    let index = ((coordinate + 1.0) * size - 1.0) / 2.0;
    // Written so that NaN lands outside as well.
    if !(index >= -1.0 && index < size) {
        return [(0, 0.0); 2];
    }
    let below = index.floor();
    let above = index - below;
    let tap = |at: f32, weight: f32| {
        if at >= 0.0 && at < size { (at as i32, weight) } else { (0, 0.0) }
    };
    [tap(below, 1.0 - above), tap(below + 1.0, above)]
}

/// Products of two cells: the four texels around a place of a plane.
pub(crate) fn cross(
    rows: [(i32, f32); 2],
    columns: [(i32, f32); 2],
    pitch: usize,
) -> [(i32, f32); 4] {
    std::array::from_fn(|tap| {
        let ((row, down), (column, right)) = (rows[tap / 2], columns[tap % 2]);
        (row * pitch as i32 + column, down * right)
    })
}

/// A folded plane.
#[derive(Clone, Debug)]
struct Plane {
    table: Table,
    rows: usize,
    columns: usize,
}

impl Plane {
    /// At (u, v) of each point, u along columns.
    fn at(&self, points: usize, place: impl Fn(usize) -> [f32; 2] + Sync + Send) -> Tensor<2> {
        let (rows, columns) = (self.rows, self.columns);
        self.table.sum(Taps::of(points, |point| {
            let [u, v] = place(point);
            cross(cell(v, rows), cell(u, columns), columns)
        }))
    }
}

#[expect(clippy::large_enum_variant, reason = "there is one for each image")]
#[derive(Clone, Debug)]
enum Tables {
    PlaneAndLine(Plane, Table, usize),
    Triplane([Plane; 3]),
}

/// Where a field is evaluated, map frame.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Points<'a> {
    /// Anywhere.
    Scattered(&'a [[f32; 3]]),
    /// On vertical lines: x and y of each line, and heights in equal numbers a line. What depends on x
    /// and y alone is then read once a line.
    Columns {
        /// x and y.
        places: &'a [[f32; 2]],
        /// z, line by line.
        heights: &'a [f32],
    },
}

impl Points<'_> {
    fn count(&self) -> usize {
        match self {
            Self::Scattered(points) => points.len(),
            Self::Columns { heights, .. } => heights.len(),
        }
    }

    fn at(&self, index: usize) -> [f32; 3] {
        match *self {
            Self::Scattered(points) => points[index],
            Self::Columns { places, heights } => {
                let [x, y] = places[index * places.len() / heights.len()];
                [x, y, heights[index]]
            }
        }
    }
}

/// The field of one image.
#[derive(Clone, Debug)]
pub(crate) struct FieldTensors {
    tables: Tables,
    bias: Tensor<2>,
    density: Linear,
    color: Tensor<2>,
    activation: DensityActivation,
}

impl FieldTensors {
    /// Folds the head into a map (`channels x side x side`).
    pub(crate) fn new(
        map: Tensor<3>,
        head: &Head,
        representation: Representation,
        activation: DensityActivation,
    ) -> Self {
        let [channels, rows, columns] = map.dims();
        let weight = head.net0.weight.val();
        let features = weight.dims()[1];
        let plane = |from: usize, count: usize, weight: Tensor<2>| {
            let texels = map.clone().narrow(0, from, count).reshape([count, rows * columns]);
            Plane {
                table: Table { values: texels.transpose().matmul(weight.transpose()) },
                rows,
                columns,
            }
        };
        let tables = if representation == Representation::Triplane {
            let weight = weight / 3.0;
            Tables::Triplane([0, 1, 2].map(|k| plane(k * features, features, weight.clone())))
        } else {
            let count = channels / 2;
            let (over_plane, over_line) = match representation {
                Representation::Oneplane => {
                    (weight.clone().narrow(1, 0, count), weight.narrow(1, count, count))
                }
                _ => (weight.clone() / 2.0, weight / 2.0),
            };
            let means: Tensor<2> =
                map.clone().narrow(0, count, count).mean_dim(1).reshape([count, columns]);
            let line = Table { values: means.transpose().matmul(over_line.transpose()) };
            Tables::PlaneAndLine(plane(0, count, over_plane), line, columns)
        };
        let half = head.net1_feature.weight.dims()[0];
        let of_point = head.grd_color_convert.weight.val().narrow(1, 0, half);
        let color = of_point.matmul(head.net1_feature.weight.val()).transpose();
        let density = head.net1_density.clone();
        Self { tables, bias: bias(&head.net0), density, color, activation }
    }

    /// The device of the field's tensors.
    pub(crate) fn device(&self) -> Device {
        self.bias.device()
    }

    /// From raw to volume density.
    pub(crate) fn activation(&self) -> DensityActivation {
        self.activation
    }

    /// Hidden values, `points x hidden`.
    pub(crate) fn hidden(&self, points: Points<'_>) -> Tensor<2> {
        let count = points.count();
        let hidden = self.bias.dims()[1];
        let sum = match &self.tables {
            Tables::PlaneAndLine(plane, line, cells) => {
                let cells = *cells;
                let heights = Taps::of(count, |point| cell(points.at(point)[2], cells));
                let over_line = line.sum(heights);
                match points {
                    Points::Scattered(points) => {
                        plane.at(count, |point| [points[point][0], points[point][1]]) + over_line
                    }
                    Points::Columns { places: [], .. } => over_line,
                    Points::Columns { places, .. } => {
                        let lines = places.len();
                        let over_plane: Tensor<3> =
                            plane.at(lines, |line| places[line]).reshape([lines, 1, hidden]);
                        let over_line: Tensor<3> =
                            over_line.reshape([lines, count / lines, hidden]);
                        (over_plane + over_line).reshape([count, hidden])
                    }
                }
            }
            Tables::Triplane(planes) => {
                let [first, second, third] = [[0, 1], [0, 2], [2, 1]];
                let over = |plane: &Plane, axes: [usize; 2]| {
                    plane.at(count, |point| axes.map(|axis| points.at(point)[axis]))
                };
                over(&planes[0], first) + over(&planes[1], second) + over(&planes[2], third)
            }
        };
        softplus(sum + self.bias.clone())
    }

    /// Raw densities of hidden values, `points x 1`.
    pub(crate) fn raw(&self, hidden: Tensor<2>) -> Tensor<2> {
        self.density.forward(hidden)
    }

    /// Colours of hidden values, `points x colours`; `tint` is that of [`Head::tint`].
    pub(crate) fn colors(&self, hidden: Tensor<2>, tint: &Tensor<2>) -> Tensor<2> {
        activation::sigmoid(hidden.matmul(self.color.clone()) + tint.clone())
    }

    /// Volume densities of points, `points x 1`.
    pub(crate) fn densities(&self, points: &[[f32; 3]]) -> Tensor<2> {
        activate(self.activation, self.raw(self.hidden(Points::Scattered(points))))
    }
}

/// ln(1 + exp(x)), stable, with a gradient everywhere.
pub(crate) fn softplus<const D: usize>(input: Tensor<D>) -> Tensor<D> {
    activation::log_sigmoid(input.neg()).neg()
}

/// Raw to volume density.
pub(crate) fn activate<const D: usize>(activation: DensityActivation, raw: Tensor<D>) -> Tensor<D> {
    match activation {
        DensityActivation::Mipnerf => softplus(raw - 1.0),
        DensityActivation::Relu => activation::relu(raw + 3.0),
    }
}

#[cfg(test)]
pub(crate) mod tests;
