//! Relative depth from above: agreement up to a scale and a shift (paper, satellite depth loss;
//! MODEL_SPEC sections 11 and 12; Ranftl et al., "Towards robust monocular depth estimation", 2020).
//!
//! The label is what Depth Anything says of the satellite image: relative inverse depth in [0, 1], larger is
//! higher. A label that is not finite is unknown: its pixel is left out.

use super::safe::{keep, weights};
use burn::tensor::{Bool, Slice, Tensor};

/// Which form of the term.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Depth {
    /// The release's.
    Aligned(Aligned),
    /// The paper's.
    LeastSquares(LeastSquares),
}

impl Depth {
    /// The release's form with its constants.
    #[must_use]
    pub const fn release() -> Self {
        Self::Aligned(Aligned {
            depth_offset: 1.0,
            label_scale: 5.0,
            label_offset: 1.0,
            inverse_epsilon: 1e-6,
            spread_epsilon: 1e-6,
            fit_epsilon: 1e-6,
            gradient_weight: 2.0,
            scales: 4,
        })
    }

    /// The paper's form, with the release's scales and weight of the gradient term.
    #[must_use]
    pub const fn paper() -> Self {
        Self::LeastSquares(LeastSquares { spread_epsilon: 1e-6, gradient_weight: 2.0, scales: 4 })
    }
}

/// The release's form: L1 between depths that were each brought to median 0 and mean absolute deviation
/// 1, and gradient matching on inverse depths after a least-squares fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aligned {
    /// Added to the rendered depth.
    pub depth_offset: f64,
    /// Multiplies the label ...
    pub label_scale: f64,
    /// ... and is added to it: the inverse depth to be met.
    pub label_offset: f64,
    /// Added to what is inverted.
    pub inverse_epsilon: f64,
    /// Added to the mean absolute deviations that are divided by.
    pub spread_epsilon: f64,
    /// Added to the determinant of the fit's normal equations.
    pub fit_epsilon: f64,
    /// Weight of the gradient term.
    pub gradient_weight: f64,
    /// Scales of the gradient term: strides 1, 2, 4 and so on.
    pub scales: u32,
}

/// The paper's form: L1 and gradient matching between the label and the least-squares fit of the
/// rendered depth to it. The fit's scale may have either sign, so a scene that is upside down fits as well as
/// an upright one: other terms have to say which way is up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeastSquares {
    /// Added to the spread of the depths that is divided by.
    pub spread_epsilon: f64,
    /// Weight of the gradient term.
    pub gradient_weight: f64,
    /// Scales of the gradient term: strides 1, 2, 4 and so on.
    pub scales: u32,
}

/// The term and its two parts.
#[derive(Clone, Debug)]
pub struct DepthTerms {
    /// `level + gradient_weight * gradient`.
    pub total: Tensor<1>,
    /// L1 part.
    pub level: Tensor<1>,
    /// Gradient part, unweighted.
    pub gradient: Tensor<1>,
}

/// Satellite depth term.
///
/// `depth` is the rendered depth of vertical rays in units of the cube, `label` the relative inverse depth at
/// the same pixels, both `batch x 1 x height x width`.
///
/// With `p = depth + 1`, `g = 5 label + 1` (release):
/// `level = mean |align(p) - align(1 / g)|` over all known pixels of the batch, `align(v) = (v - t) / (s + e)`, `t`
/// the lower median and `s = sum |v - t| / (n + 1)` of an image's `n` known pixels;
/// `gradient` = [`gradient_matching`] of `a / p + b` and `g`, `a` and `b` the least-squares fit per image.
/// `p` below 0, which no ray gives, counts as 0 in `1 / p`.
#[must_use]
pub fn satellite_depth(depth: Tensor<4>, label: Tensor<4>, options: &Depth) -> DepthTerms {
    let valid = label.clone().is_finite();
    let label = keep(label, &valid);
    let (level, gradient, weight) = match options {
        Depth::Aligned(options) => {
            let [level, gradient] = options.terms(depth, label, &valid);
            (level, gradient, options.gradient_weight)
        }
        Depth::LeastSquares(options) => {
            let [level, gradient] = options.terms(depth, label, &valid);
            (level, gradient, options.gradient_weight)
        }
    };
    DepthTerms { total: level.clone() + gradient.clone() * weight, level, gradient }
}

impl Aligned {
    fn terms(&self, depth: Tensor<4>, label: Tensor<4>, valid: &Tensor<4, Bool>) -> [Tensor<1>; 2] {
        let depth = depth + self.depth_offset;
        let label = label * self.label_scale + self.label_offset;
        let invert = |v: Tensor<4>| (v.clamp_min(0.0) + self.inverse_epsilon).recip();
        let pixels = Pixels::new(valid, &label);
        let aligned = |v: Tensor<4>| pixels.align(v.flatten(1, 3), self.spread_epsilon);
        let difference = aligned(depth.clone()) - aligned(invert(label.clone()));
        let level = pixels.mean_of_all(difference.abs());

        let inverse = invert(depth);
        let shape = inverse.dims();
        let [prediction, target] = [inverse, label.clone()].map(|v| pixels.centre(v.flatten(1, 3)));
        let count = pixels.count.clone();
        let square = (prediction.offsets.clone() * prediction.offsets.clone()).sum_dim(1);
        let product = (prediction.offsets.clone() * target.offsets).sum_dim(1);
        // The determinant of the normal equations, without their cancellation.
        let determinant = count.clone() * square;
        let inverted = (determinant.clone() + self.fit_epsilon).recip();
        let scale = count * product * inverted.clone();
        let shift = target.mean * determinant * inverted - scale.clone() * prediction.mean.clone();
        let fitted = (prediction.offsets + prediction.mean) * scale + shift;
        let gradient = gradient_matching(fitted.reshape(shape), label, valid, self.scales);
        [level, gradient]
    }
}

impl LeastSquares {
    fn terms(&self, depth: Tensor<4>, label: Tensor<4>, valid: &Tensor<4, Bool>) -> [Tensor<1>; 2] {
        let shape = depth.dims();
        let pixels = Pixels::new(valid, &label);
        let [prediction, target] = [depth, label.clone()].map(|v| pixels.centre(v.flatten(1, 3)));
        // The fit does not depend on the unit of the depth; one near 1 keeps the squares in range.
        let unit = prediction.offsets.clone().detach().abs().max_dim(1) + self.spread_epsilon;
        let offsets = prediction.offsets / unit;
        let square = (offsets.clone() * offsets.clone()).sum_dim(1);
        let flat = square.clone().equal_elem(0.0);
        let product = (offsets.clone() * target.offsets.clone()).sum_dim(1);
        let scale = product / square.mask_fill(flat, 1.0);
        let fitted = offsets * scale;
        let level = pixels.mean_of_all((fitted.clone() - target.offsets).abs());
        let fitted = (fitted + target.mean).reshape(shape);
        [level, gradient_matching(fitted, label, valid, self.scales)]
    }
}

/// Gradient matching term: for strides `1, 2, 4, ...`, the sum of `|d/dx r| + |d/dy r|` of the difference `r =
/// prediction - target` (differences of neighbours in the thinned image, both known) divided by the number of
/// known pixels there; summed over the scales, averaged over the images. An image without a known
/// pixel counts as 0.
///
/// All of `batch x 1 x height x width`.
#[must_use]
pub fn gradient_matching(
    prediction: Tensor<4>,
    target: Tensor<4>,
    valid: &Tensor<4, Bool>,
    scales: u32,
) -> Tensor<1> {
    let [batch, _, height, width] = prediction.dims();
    let difference = keep(prediction - target, valid);
    let mut total: Option<Tensor<4>> = None;
    for stride in (0..scales).map(|scale| 1_usize << scale) {
        let thin = || {
            let full = Slice::new(0, None, 1);
            let step = Slice::new(0, None, stride as isize);
            [full, full, step, step]
        };
        let known = valid.clone().slice(thin());
        let r = difference.clone().slice(thin());
        let count = weights(&known, &r).sum_dims(&[1, 2, 3]).clamp_min(1.0);
        for (dim, size) in [(2, height.div_ceil(stride)), (3, width.div_ceil(stride))] {
            if size < 2 {
                continue;
            }
            let both = known.clone().narrow(dim, 1, size - 1);
            let both = both.bool_and(known.clone().narrow(dim, 0, size - 1));
            let steps = r.clone().narrow(dim, 1, size - 1) - r.clone().narrow(dim, 0, size - 1);
            let part = keep(steps.abs(), &both).sum_dims(&[1, 2, 3]) / count.clone();
            total = Some(match total {
                Some(sum) => sum + part,
                None => part,
            });
        }
    }
    match total {
        Some(total) => total.sum() / batch as f64,
        None => difference.sum() * 0.0,
    }
}

/// The known pixels of each image; images are rows.
struct Pixels {
    /// `batch x pixels`.
    valid: Tensor<2, Bool>,
    /// Number of known pixels, `batch x 1`.
    count: Tensor<2>,
}

/// Values about their mean.
struct Centred {
    /// `batch x pixels`, 0 where unknown.
    offsets: Tensor<2>,
    /// `batch x 1`, 0 without a known pixel.
    mean: Tensor<2>,
}

impl Pixels {
    fn new(valid: &Tensor<4, Bool>, like: &Tensor<4>) -> Self {
        let valid: Tensor<2, Bool> = valid.clone().flatten(1, 3);
        let count = weights(&valid, &like.clone().flatten(1, 3)).sum_dim(1);
        Self { valid, count }
    }

    /// Mean over the known pixels of the whole batch.
    fn mean_of_all(&self, values: Tensor<2>) -> Tensor<1> {
        keep(values, &self.valid).sum() / self.count.clone().sum().clamp_min(1.0)
    }

    fn centre(&self, values: Tensor<2>) -> Centred {
        let count = self.count.clone().clamp_min(1.0);
        let mean = keep(values.clone(), &self.valid).sum_dim(1) / count.clone();
        let offsets = keep(values - mean.clone(), &self.valid);
        // What rounding has left of the mean: under a large offset it would be the fit's error.
        let rest = offsets.clone().sum_dim(1) / count;
        Centred { offsets: keep(offsets - rest.clone(), &self.valid), mean: mean + rest }
    }

    /// `(v - t) / (s + epsilon)`, 0 where unknown.
    fn align(&self, values: Tensor<2>, epsilon: f64) -> Tensor<2> {
        let median = self.lower_median(values.clone());
        let offsets = keep(values - median, &self.valid);
        let spread = offsets.clone().abs().sum_dim(1) / (self.count.clone() + 1.0);
        offsets / (spread + epsilon)
    }

    /// The lower median of each image's known pixels, `batch x 1`; 0 without one. Its gradient goes to
    /// one pixel of that value.
    fn lower_median(&self, values: Tensor<2>) -> Tensor<2> {
        let last = f64::INFINITY;
        let ranked = values.clone().detach().mask_fill(self.valid.clone().bool_not(), last);
        let order = ranked.argsort(1);
        let rank = ((self.count.clone() - 1.0) / 2.0).floor().clamp_min(0.0).int();
        keep(values, &self.valid).gather(1, order.gather(1, rank))
    }
}

#[cfg(test)]
mod hard_cases;
#[cfg(test)]
mod tests;
