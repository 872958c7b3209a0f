//! The colour branch: two linear maps folded into one, then a sigmoid.

use super::fold::finite;
use super::kernel::{LANES, sigmoid};
use super::{FieldError, PointHead};

/// Points whose colours are computed together, so that a row of weights is loaded once for all.
const GROUP: usize = 8;

/// Hidden values -> colour channels.
#[derive(Debug)]
pub(super) struct ColorHead {
    pub channels: usize,
    /// Channels rounded up to whole groups of lanes.
    pub padded: usize,
    /// For each group of lanes: hidden x 16 weights.
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl ColorHead {
    /// Folds `net1_feature` and its half of `grd_color_convert`; the style's half is a constant.
    /// The head's shapes have been checked.
    pub fn new(head: &PointHead, style: Option<&[f32]>) -> Result<Self, FieldError> {
        let codes = head.style.inputs;
        if let Some(style) = style {
            if style.len() != codes {
                return Err(FieldError::Shape {
                    tensor: "style code",
                    found: style.len().to_string(),
                    expected: codes.to_string(),
                });
            }
            finite("style code", style)?;
        }
        let dot = |a: &[f32], b: &[f32]| -> f64 {
            a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        let features = head.feature.outputs;
        let of_style: Vec<f64> = (0..features)
            .map(|feature| {
                let bias = f64::from(head.style.bias[feature]);
                bias + style
                    .map_or(0.0, |style| dot(&head.style.weight[feature * codes..][..codes], style))
            })
            .collect();
        let channels = head.color.outputs;
        let padded = channels.next_multiple_of(LANES);
        let hidden = head.net0.outputs;
        let padded_hidden = hidden.next_multiple_of(LANES);
        let mut weight = vec![0.0_f32; padded_hidden * padded];
        let mut bias = vec![0.0_f32; padded];
        for channel in 0..channels {
            let row = &head.color.weight[channel * 2 * features..][..2 * features];
            let (of_point, of_constant) = row.split_at(features);
            let constant: f64 = of_constant
                .iter()
                .zip(&of_style)
                .map(|(weight, style)| f64::from(*weight) * style)
                .sum();
            bias[channel] = (f64::from(head.color.bias[channel])
                + constant
                + dot(of_point, &head.feature.bias)) as f32;
            let block =
                &mut weight[channel / LANES * padded_hidden * LANES..][..padded_hidden * LANES];
            for unit in 0..hidden {
                let sum: f64 = (of_point.iter().enumerate())
                    .map(|(feature, weight)| {
                        f64::from(*weight) * f64::from(head.feature.weight[feature * hidden + unit])
                    })
                    .sum();
                block[unit * LANES + channel % LANES] = sum as f32;
            }
        }
        finite("grd_color_convert.weight times net1_feature.weight", &weight)?;
        finite("grd_color_convert.weight times features", &bias)?;
        Ok(Self { channels, padded, weight, bias })
    }

    /// Colours (count x padded) of points with the given hidden values (count x hidden).
    #[inline(always)]
    pub fn colors(&self, hidden_values: &[f32], hidden: usize, out: &mut [f32]) {
        let count = hidden_values.len() / hidden;
        let groups = count / GROUP * GROUP;
        let blocks = self.weight.chunks_exact(hidden * LANES).zip(self.bias.chunks_exact(LANES));
        for (block, (weight, bias)) in blocks.enumerate() {
            for first in (0..groups).step_by(GROUP) {
                self.group::<GROUP>(hidden_values, hidden, first, block, weight, bias, out);
            }
            for first in groups..count {
                self.group::<1>(hidden_values, hidden, first, block, weight, bias, out);
            }
        }
    }

    #[expect(clippy::too_many_arguments, reason = "an inlined inner loop, not an interface")]
    #[inline(always)]
    fn group<const N: usize>(
        &self,
        hidden_values: &[f32],
        hidden: usize,
        first: usize,
        block: usize,
        weight: &[f32],
        bias: &[f32],
        out: &mut [f32],
    ) {
        let mut start = [0.0_f32; LANES];
        start.copy_from_slice(bias);
        let mut sums = [start; N];
        let rows: [&[f32]; N] =
            std::array::from_fn(|point| &hidden_values[(first + point) * hidden..][..hidden]);
        for (unit, weight) in weight.chunks_exact(LANES).enumerate() {
            for point in 0..N {
                let value = rows[point][unit];
                for lane in 0..LANES {
                    sums[point][lane] = value.mul_add(weight[lane], sums[point][lane]);
                }
            }
        }
        for point in 0..N {
            let out = &mut out[(first + point) * self.padded + block * LANES..][..LANES];
            for lane in 0..LANES {
                out[lane] = sigmoid(sums[point][lane]);
            }
        }
    }
}
