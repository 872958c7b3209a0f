//! Rays through the field with gradients: the released quadrature of MODEL_SPEC section 9, in tensors.
//!
//! Where samples lie is decided outside the graph, in plain numbers and by the same code that the
//! program renders with; weights, colours and depths are tensors.

use super::blend::Taps;
use super::field::{FieldTensors, Points, Table, activate, cross};
use super::rays::Rays;
use crate::random::Draw;
use crate::render::Composite;
use crate::render::frames::Vector;
use crate::render::padded_width;
use crate::render::quadrature::{ImportanceRoom, midpoint};
use burn::tensor::{Int, Tensor, TensorData};
use pulp::Arch;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Added to every factor of the released rule's transmittance.
const EPSILON: f64 = 1e-10;

/// How rays are sampled.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Samples {
    /// Samples of the first pass.
    pub coarse: usize,
    /// Samples added where the light ends; 0 for none.
    pub fine: usize,
    /// Names this view's random numbers; none puts every sample in the middle of its share.
    pub jitter: Option<u64>,
}

/// What the rays of one view bring, one row a ray.
#[derive(Clone, Debug)]
pub(crate) struct Rendered {
    /// Sum of weight times distance, `rays x 1`: 0 for an empty ray.
    pub depth: Tensor<2>,
    /// How much of the light ends in the scene, `rays x 1`.
    pub opacity: Tensor<2>,
    /// Colours of the scene alone, multiplied by opacity, `rays x colours`; none where no tint was given.
    pub feature: Option<Tensor<2>>,
}

/// Renders rays. Colours are computed where `tint` is given ([`super::field::Head::tint`]).
pub(crate) fn render(
    field: &FieldTensors,
    rays: &Rays,
    samples: Samples,
    tint: Option<&Tensor<2>>,
) -> Rendered {
    let (count, coarse) = (rays.count(), samples.coarse);
    let device = field.device();
    let radii = coarse_radii(rays, samples);
    let coarse_hidden = hidden_at(field, rays, &radii);
    let coarse_raw: Tensor<2> = field.raw(coarse_hidden.clone()).reshape([count, coarse]);
    let mut parts = vec![(coarse_hidden, coarse)];
    let mut raw = coarse_raw.clone();
    let mut merged = Merged { radii, order: None };
    if samples.fine > 0 {
        let seen: Vec<f32> = coarse_raw.detach().into_data().iter::<f32>().collect();
        let fine = fine_radii(field, rays, samples, &merged.radii, &seen);
        let fine_hidden = hidden_at(field, rays, &fine);
        let fine_raw = field.raw(fine_hidden.clone()).reshape([count, samples.fine]);
        parts.push((fine_hidden, samples.fine));
        merged = merge(&merged.radii, &fine, count);
        raw = Tensor::cat(vec![raw, fine_raw], 1);
    }
    let all = coarse + samples.fine;
    let places = |values: &[i32]| {
        let data = TensorData::new(values.to_vec(), [count, all]);
        Tensor::<2, Int>::from_data(data, &device)
    };
    if let Some((order, _)) = &merged.order {
        raw = raw.gather(1, places(order));
    }
    let weights = integrate(field, raw, &merged.radii);
    let opacity = weights.clone().sum_dim(1);
    let middles = pairs(&merged.radii, all, |a, b| ((f64::from(a) + f64::from(b)) * 0.5) as f32);
    let depth = (weights.clone() * plain(middles, [count, all - 1], &device)).sum_dim(1);
    let feature = tint.map(|tint| {
        let none = Tensor::zeros([count, 1], &device);
        // An interval's colour is the mean of those of its ends.
        let mut shares = (Tensor::cat(vec![none.clone(), weights.clone()], 1)
            + Tensor::cat(vec![weights, none], 1))
            / 2.0;
        if let Some((_, rank)) = &merged.order {
            shares = shares.gather(1, places(rank));
        }
        let mut from = 0;
        let mut sum: Option<Tensor<2>> = None;
        for (hidden, steps) in parts {
            let colors = field.colors(hidden, tint);
            let channels = colors.dims()[1];
            let colors: Tensor<3> = colors.reshape([count, steps, channels]);
            let share: Tensor<3> = shares.clone().narrow(1, from, steps).reshape([count, steps, 1]);
            let part: Tensor<2> = (colors * share).sum_dim(1).reshape([count, channels]);
            from += steps;
            sum = Some(match sum {
                Some(sum) => sum + part,
                None => part,
            });
        }
        sum.unwrap_or_else(|| Tensor::zeros([count, 1], &device))
    });
    Rendered { depth, opacity, feature }
}

/// One weight for each interval between samples (ascending `radii`), `rays x (samples - 1)`.
fn integrate(field: &FieldTensors, raw: Tensor<2>, radii: &[f32]) -> Tensor<2> {
    let [count, all] = raw.dims();
    let device = field.device();
    let between = (raw.clone().narrow(1, 0, all - 1) + raw.narrow(1, 1, all - 1)) / 2.0;
    let steps = plain(pairs(radii, all, |a, b| b - a), [count, all - 1], &device);
    let passed = (activate(field.activation(), between) * steps).neg().exp();
    // The product of what passed before, as a sum of logarithms: its gradient needs no division.
    let before = (passed.clone() + EPSILON).log().narrow(1, 0, all - 2).cumsum(1);
    let before = Tensor::cat(vec![Tensor::zeros([count, 1], &device), before], 1);
    (passed.neg() + 1.0) * before.exp()
}

/// A value for each two neighbours within a ray.
fn pairs(radii: &[f32], all: usize, of: impl Fn(f32, f32) -> f32) -> Vec<f32> {
    radii
        .chunks_exact(all)
        .flat_map(|ray| ray.windows(2))
        .map(|ends| of(ends[0], ends[1]))
        .collect()
}

fn plain(values: Vec<f32>, shape: [usize; 2], device: &burn::tensor::Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Radii of the first pass: bins start at 1, so that the first interval is never looked into (section 8).
fn coarse_radii(rays: &Rays, samples: Samples) -> Vec<f32> {
    let coarse = samples.coarse;
    let of = |(ray, length): (usize, &f64)| {
        let step = length / coarse as f64;
        let mut draw = samples.jitter.map(|name| Draw::new(&[name, ray as u64, 0]));
        let at = move |k: usize| {
            let within = draw.as_mut().map_or(0.5, Draw::unit);
            ((k as f64 + 1.0 + within) * step) as f32
        };
        (0..coarse).map(at).collect::<Vec<f32>>()
    };
    rays.lengths.par_iter().enumerate().map(of).collect::<Vec<_>>().concat()
}

/// Radii of the second pass, ascending within each ray.
fn fine_radii(
    field: &FieldTensors,
    rays: &Rays,
    samples: Samples,
    radii: &[f32],
    raw: &[f32],
) -> Vec<f32> {
    let (arch, activation, fine) = (Arch::new(), field.activation(), samples.fine);
    let of = |room: &mut (ImportanceRoom, Vec<f32>), ray: usize| {
        let (importance, weights) = room;
        let radii = &radii[ray * samples.coarse..][..samples.coarse];
        let raw = &raw[ray * samples.coarse..][..samples.coarse];
        midpoint(arch, radii, raw, activation, weights);
        let mut shares: Vec<f64> = match samples.jitter {
            Some(name) => {
                let mut draw = Draw::new(&[name, ray as u64, 1]);
                (0..fine).map(|_| draw.unit()).collect()
            }
            None => (0..fine).map(|j| (j as f64 + 0.5) / fine as f64).collect(),
        };
        // Drawn without order, as in the release; their set is what matters.
        shares.sort_by(f64::total_cmp);
        let mut found = Vec::with_capacity(fine);
        importance.released_at(radii, weights, shares.into_iter(), &mut found);
        found
    };
    (0..rays.count())
        .into_par_iter()
        .map_init(Default::default, of)
        .collect::<Vec<Vec<f32>>>()
        .concat()
}

struct Merged {
    /// Ascending within each ray.
    radii: Vec<f32>,
    /// For each place of the merged list the sample that is there, coarse ones counted first, and for each
    /// sample its place; none where there is one pass only.
    order: Option<(Vec<i32>, Vec<i32>)>,
}

/// Two ascending lists a ray into one; of equal radii the coarse one comes first.
fn merge(coarse: &[f32], fine: &[f32], rays: usize) -> Merged {
    let (per_coarse, per_fine) = (coarse.len() / rays.max(1), fine.len() / rays.max(1));
    let all = per_coarse + per_fine;
    let mut radii = Vec::with_capacity(rays * all);
    let (mut order, mut rank) = (Vec::with_capacity(rays * all), vec![0; rays * all]);
    for ray in 0..rays {
        let a = &coarse[ray * per_coarse..][..per_coarse];
        let b = &fine[ray * per_fine..][..per_fine];
        let (mut i, mut j) = (0, 0);
        for place in 0..all {
            let take_coarse = j == per_fine || (i < per_coarse && a[i] <= b[j]);
            let sample = if take_coarse { i } else { per_coarse + j };
            radii.push(if take_coarse { a[i] } else { b[j] });
            i += usize::from(take_coarse);
            j += usize::from(!take_coarse);
            order.push(sample as i32);
            rank[ray * all + sample] = place as i32;
        }
    }
    Merged { radii, order: Some((order, rank)) }
}

fn hidden_at(field: &FieldTensors, rays: &Rays, radii: &[f32]) -> Tensor<2> {
    if rays.vertical {
        let places: Vec<[f32; 2]> = rays.origins.iter().map(|[x, y, _]| [*x, *y]).collect();
        let heights: Vec<f32> = radii.iter().map(|radius| 1.0 - radius).collect();
        return field.hidden(Points::Columns { places: &places, heights: &heights });
    }
    let per_ray = radii.len() / rays.count().max(1);
    let point = |(index, radius): (usize, &f32)| {
        let ray = index / per_ray;
        let (o, d) = (rays.origins[ray], rays.directions[ray].map(|value| value as f32));
        [0, 1, 2].map(|k| o[k] + d[k] * radius)
    };
    let points: Vec<[f32; 3]> = radii.par_iter().enumerate().map(point).collect();
    field.hidden(Points::Scattered(&points))
}

/// A sky map that gradients reach (section 9.1).
#[derive(Clone, Debug)]
pub(crate) struct SkyTensors {
    table: Table,
    rows: usize,
    columns: usize,
}

impl SkyTensors {
    /// From the sky decoder's output after its sigmoid, `channels x rows x columns`.
    pub(crate) fn new(map: Tensor<3>) -> Self {
        let [_, rows, columns] = map.dims();
        Self { table: Table::of_map(map), rows, columns }
    }

    /// The sky in unit directions of the map frame, `directions x channels`, in [0, 1].
    pub(crate) fn lookup(&self, directions: &[Vector]) -> Tensor<2> {
        let (rows, columns) = (self.rows, self.columns);
        let whole = padded_width(columns);
        let taps = Taps::of(directions.len(), |index| {
            let [x, y, z] = directions[index];
            let column = libm::acos(z.clamp(-1.0, 1.0)) / PI * (whole.max(1) - 1) as f64;
            let turn = (libm::atan2(y, x) / PI + 1.0) / 2.0;
            let row = turn * (rows.max(1) - 1) as f64;
            // Beyond the decoder's columns the sky is zero.
            cross(ends(row, rows), ends(column, columns), columns)
        });
        self.table.sum(taps).clamp(0.0, 1.0)
    }
}

/// The two positions around an index with their weights, 0 outside.
fn ends(index: f64, count: usize) -> [(i32, f32); 2] {
    let below = index.floor();
    let tap = |at: f64, weight: f64| {
        if at >= 0.0 && at < count as f64 { (at as i32, weight as f32) } else { (0, 0.0) }
    };
    [tap(below, 1.0 - (index - below)), tap(below + 1.0, index - below)]
}

/// The scene over the sky, `rays x colours`.
pub(crate) fn compose(
    feature: Tensor<2>,
    opacity: Tensor<2>,
    sky: Tensor<2>,
    composite: Composite,
) -> Tensor<2> {
    let scene = match composite {
        Composite::Squared => feature * opacity.clone(),
        Composite::Once => feature,
    };
    scene + sky * (opacity.neg() + 1.0)
}

#[cfg(test)]
mod hard_cases;
#[cfg(test)]
mod tests;
