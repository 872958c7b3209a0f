//! The two quadrature rules along a ray, on plain slices (MODEL_SPEC section 9).
//!
//! [`midpoint`] is the released rule: raw density averaged over each interval between samples.
//! [`cells`] is the stable rule: each sample's density fills its cell, and everything else is exact.

use crate::field::DensityActivation;
use crate::field::kernel::{exp_nonpositive_f64, one_minus_exp, one_minus_exp_f64};
use pulp::Arch;

/// Added to every factor of the released rule's transmittance.
const RELEASED_EPSILON: f64 = 1e-10;

/// Optical depth under which mean and variance of the distance inside a cell are taken from their series: the closed
/// forms are differences of numbers `1 / tau` and `1 / tau^2` times as large. Series and closed forms are within 1e-11 of
/// the truth on their sides of it.
const THIN: f64 = 0.1;

/// Where along a ray the light ends.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Hit {
    /// Sum of the weights: the part of the light that ends inside.
    pub opacity: f64,
    /// What passes.
    pub transmittance: f64,
    /// Sum of weight times distance.
    pub distance: f64,
    /// Sum of weight times squared distance from the mean.
    pub variance: f64,
}

impl Hit {
    /// The distance at which light ends on average; NaN where none ends.
    #[must_use]
    pub fn mean(&self) -> f64 {
        if self.opacity > 0.0 { self.distance / self.opacity } else { f64::NAN }
    }

    /// Standard deviation of that distance; NaN where no light ends.
    #[must_use]
    pub fn spread(&self) -> f64 {
        if self.opacity > 0.0 { (self.variance / self.opacity).max(0.0).sqrt() } else { f64::NAN }
    }
}

struct AlphaOp<'a> {
    radii: &'a [f32],
    raw: &'a [f32],
    activation: DensityActivation,
    out: &'a mut [f32],
}

impl pulp::NullaryFnOnce for AlphaOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let ends = self.radii.windows(2).zip(self.raw.windows(2));
        for ((radii, raw), out) in ends.zip(self.out) {
            let sigma = self.activation.apply(0.5 * raw[0] + 0.5 * raw[1]);
            *out = one_minus_exp((radii[1] - radii[0]) * sigma);
        }
    }
}

/// The released rule over samples at ascending `radii` with raw densities `raw`: one weight for each
/// interval between two samples goes to `weights`.
///
/// A ray of fewer than two samples has no weights and is empty.
pub fn midpoint(
    arch: Arch,
    radii: &[f32],
    raw: &[f32],
    activation: DensityActivation,
    weights: &mut Vec<f32>,
) -> Hit {
    weights.clear();
    weights.resize(radii.len().saturating_sub(1), 0.0);
    arch.dispatch(AlphaOp { radii, raw, activation, out: weights });
    let mut hit = Hit { transmittance: 1.0, ..Hit::default() };
    for (weight, radii) in weights.iter_mut().zip(radii.windows(2)) {
        let alpha = f64::from(*weight);
        let exact = alpha * hit.transmittance;
        hit.opacity += exact;
        hit.distance += exact * 0.5 * (f64::from(radii[0]) + f64::from(radii[1]));
        hit.transmittance *= 1.0 - alpha + RELEASED_EPSILON;
        *weight = exact as f32;
    }
    if hit.opacity > 0.0 {
        let mean = hit.mean();
        for (weight, radii) in weights.iter().zip(radii.windows(2)) {
            let away = 0.5 * (f64::from(radii[0]) + f64::from(radii[1])) - mean;
            hit.variance += f64::from(*weight) * away * away;
        }
    }
    hit
}

/// Buffers of [`cells`].
#[derive(Clone, Debug, Default)]
pub struct CellRoom {
    depth: Vec<f64>,
    opaque: Vec<f64>,
    distance: Vec<f64>,
    variance: Vec<f64>,
}

struct CellOp<'a> {
    edges: &'a [f64],
    sigma: &'a [f32],
    room: &'a mut CellRoom,
}

impl pulp::NullaryFnOnce for CellOp<'_> {
    type Output = f64;

    /// Fills the room (`opaque` with final weights) and returns the ray's optical depth.
    #[inline(always)]
    fn call(self) -> f64 {
        let count = self.sigma.len();
        let (from, to) = (&self.edges[..count], &self.edges[1..=count]);
        let depth = &mut self.room.depth[..count];
        let opaque = &mut self.room.opaque[..count];
        let distance = &mut self.room.distance[..count];
        let variance = &mut self.room.variance[..count];
        for k in 0..count {
            let width = to[k] - from[k];
            let sigma = f64::from(self.sigma[k]);
            let tau = sigma * width;
            let ends = one_minus_exp_f64(tau);
            let rest = (1.0 - ends) / ends;
            let inside = 1.0 / sigma - width * rest;
            let exact = 1.0 / (sigma * sigma) - width * width * rest / ends;
            let square = tau * tau;
            let early = tau * (1.0 / 12.0 - square * (1.0 / 720.0 - square / 30_240.0));
            let narrowing = square * (1.0 / 240.0 - square * (1.0 / 6_048.0 - square / 172_800.0));
            opaque[k] = ends;
            depth[k] = tau;
            distance[k] = from[k] + if tau < THIN { width * (0.5 - early) } else { inside };
            variance[k] = if tau < THIN { width * width * (1.0 / 12.0 - narrowing) } else { exact };
        }
        let mut sum = 0.0;
        for depth in &mut *depth {
            let tau = *depth;
            *depth = sum;
            sum += tau;
        }
        for k in 0..count {
            opaque[k] *= exp_nonpositive_f64(-depth[k]);
        }
        sum
    }
}

/// The stable rule: cell k lies between `edges[k]` and `edges[k + 1]` (ascending) and holds the volume
/// density `sigma[k]`; its weight goes to `weights[k]`.
///
/// Everything is exact for that field: weight T * (1 - exp(-tau)), with T the exponential of the summed
/// optical depth; the expected distance inside a cell 1/sigma - width * exp(-tau) / (1 - exp(-tau)); the
/// variance of that distance.
pub fn cells(
    arch: Arch,
    edges: &[f64],
    sigma: &[f32],
    room: &mut CellRoom,
    weights: &mut Vec<f32>,
) -> Hit {
    let count = sigma.len();
    for buffer in [&mut room.depth, &mut room.opaque, &mut room.distance, &mut room.variance] {
        buffer.clear();
        buffer.resize(count, 0.0);
    }
    let tau = arch.dispatch(CellOp { edges, sigma, room });
    let mut hit = Hit { transmittance: exp_nonpositive_f64(-tau), ..Hit::default() };
    for (weight, distance) in room.opaque.iter().zip(&room.distance) {
        hit.opacity += weight;
        hit.distance += weight * distance;
    }
    if hit.opacity > 0.0 {
        let mean = hit.mean();
        let of_cells = room.distance.iter().zip(&room.variance);
        for (weight, (distance, variance)) in room.opaque.iter().zip(of_cells) {
            let away = distance - mean;
            hit.variance += weight * (away * away + variance);
        }
    }
    weights.clear();
    weights.extend(room.opaque.iter().map(|weight| *weight as f32));
    hit
}

/// The middles of `count` equal parts of [0, 1].
fn middles(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |j| (j as f64 + 0.5) / count as f64)
}

/// Buffers of the importance samplers.
#[derive(Clone, Debug, Default)]
pub struct ImportanceRoom {
    smooth: Vec<f64>,
    bins: Vec<f64>,
}

impl ImportanceRoom {
    /// The weights with 1e-5 added, the greater of each two neighbours, averaged back, plus 0.01.
    fn smooth(&mut self, weights: &[f32]) {
        let at = |index: usize| f64::from(weights[index]) + 1e-5;
        let count = weights.len();
        self.smooth.clear();
        let mut left = if count > 0 { at(0) } else { 0.0 };
        for index in 0..count {
            let right = if index + 1 < count { at(index).max(at(index + 1)) } else { at(index) };
            self.smooth.push(0.5 * (left + right) + 0.01);
            left = right;
        }
    }

    /// Radii at the cumulated shares `shares` (ascending, in [0, 1)) of the distribution whose density
    /// over the bins `bins[k]..bins[k + 1]` is `smooth[from + k]`, ascending.
    fn invert(
        &self,
        from: usize,
        cells: usize,
        shares: impl Iterator<Item = f64>,
        fine: &mut Vec<f32>,
    ) {
        fine.clear();
        let pdf = &self.smooth[from..][..cells];
        let total: f64 = pdf.iter().map(|weight| weight + 1e-5).sum();
        // The first position whose cumulated share reaches u, and the one before it.
        let (mut index, mut below, mut above) = (0, 0.0, 0.0);
        let mut last = f32::NEG_INFINITY;
        for u in shares {
            while above < u && index < cells {
                below = above;
                above += (pdf[index] + 1e-5) / total;
                index += 1;
            }
            let cell = index.saturating_sub(1);
            let share = above - below;
            let share = if share < 1e-5 { 1.0 } else { share };
            let (left, right) = (self.bins[cell], self.bins[cell + 1]);
            // Rounding may not turn the order round.
            last = last.max((left + (u - below) / share * (right - left)) as f32);
            fine.push(last);
        }
    }

    /// As released: bins are the middles of the coarse intervals, the outer two weights are left out.
    /// The `count` radii lie at the middles of equal shares.
    pub fn released(&mut self, radii: &[f32], weights: &[f32], count: usize, fine: &mut Vec<f32>) {
        self.released_at(radii, weights, middles(count), fine);
    }

    /// The same at given shares of the distribution, ascending in [0, 1).
    pub fn released_at(
        &mut self,
        radii: &[f32],
        weights: &[f32],
        shares: impl Iterator<Item = f64>,
        fine: &mut Vec<f32>,
    ) {
        self.smooth(weights);
        self.bins.clear();
        let middle = |pair: &[f32]| 0.5 * (f64::from(pair[0]) + f64::from(pair[1]));
        self.bins.extend(radii.windows(2).map(middle));
        self.invert(1, weights.len() - 2, shares, fine);
    }

    /// Over the cells themselves, all of them.
    pub fn over_cells(
        &mut self,
        edges: &[f64],
        weights: &[f32],
        count: usize,
        fine: &mut Vec<f32>,
    ) {
        self.smooth(weights);
        self.bins.clear();
        self.bins.extend_from_slice(edges);
        self.invert(0, weights.len(), middles(count), fine);
    }
}
