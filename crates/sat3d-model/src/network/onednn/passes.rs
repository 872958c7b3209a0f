//! What lies between two convolutions: statistics of the map, its normalisation and swish, its border, its
//! doubling, its conversion; each in one pass over memory.

use super::map::{Context, Map, Shape};
use crate::config::{Border, GROUPS};
use crate::error::ModelError;
use crate::field::kernel::sigmoid;
use pulp::{Arch, NullaryFnOnce};
use rayon::prelude::*;
use sat3d_onednn::{BLOCK, Element, Memory};

/// Pixels whose values are summed in 32-bit floats before they join a 64-bit sum.
const RUN: usize = 256;
const EPSILON: f64 = 1e-6;

/// Gain and shift of a normalisation over [`GROUPS`] groups of channels.
#[derive(Debug)]
pub(super) struct GroupNorm {
    pub gain: Vec<f32>,
    pub shift: Vec<f32>,
}

/// What becomes of each value on its way.
pub(super) enum Change<'a> {
    /// Nothing.
    Copy,
    /// `(value - mean) * scale + shift`, three numbers for each channel.
    Norm(&'a [[f32; 3]]),
    /// The same, times its own logistic function.
    NormSwish(&'a [[f32; 3]]),
}

/// Where values go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Target {
    /// Type.
    pub element: Element,
    /// A border of one pixel that is written, rather than left to the convolution as zeros.
    pub wrapped: bool,
    /// Each pixel becomes four.
    pub doubled: bool,
}

impl Target {
    /// As it is.
    pub(super) fn plain(element: Element) -> Self {
        Self { element, wrapped: false, doubled: false }
    }

    /// For a convolution of that border.
    pub(super) fn bordered(element: Element, border: Border) -> Self {
        Self { element, wrapped: border == Border::Circular, doubled: false }
    }

    /// Height and width of what is written.
    pub(super) fn size(&self, size: [usize; 2]) -> [usize; 2] {
        size.map(|side| side * if self.doubled { 2 } else { 1 } + if self.wrapped { 2 } else { 0 })
    }

    /// The source's row or column of each of the target's.
    fn sources(&self, side: usize) -> Vec<usize> {
        let scale = if self.doubled { 2 } else { 1 };
        let inner = (0..side * scale).map(|at| at / scale);
        if self.wrapped {
            std::iter::once(side - 1).chain(inner).chain(std::iter::once(0)).collect()
        } else {
            inner.collect()
        }
    }
}

/// Mean, scale and shift of each channel: `gain / deviation of the channel's group`.
pub(super) fn constants(map: &Map, norm: &GroupNorm) -> Vec<[f32; 3]> {
    let Shape { channels, height, width } = map.shape;
    let count = (height * width) as f64;
    let moments = moments(map.values(), map.lanes(), channels, height * width);
    let members = channels / GROUPS;
    let mut constants = Vec::with_capacity(channels);
    for (group, moments) in moments.chunks_exact(members).enumerate() {
        let mean = moments.iter().map(|[mean, _]| mean).sum::<f64>() / members as f64;
        let spread = |[own, within]: &[f64; 2]| within + count * (own - mean) * (own - mean);
        let variance = moments.iter().map(spread).sum::<f64>() / (count * members as f64);
        let inverse = 1.0 / (variance.max(0.0) + EPSILON).sqrt();
        for channel in group * members..(group + 1) * members {
            let scale = f64::from(norm.gain[channel]) * inverse;
            constants.push([mean as f32, scale as f32, norm.shift[channel]]);
        }
    }
    constants
}

/// Mean, and sum of squared differences from it, of each channel; `values` are blocks of `lanes` channels, each a list of
/// `pixels`.
///
/// One pass over memory: a run stays in cache while it is summed up twice, for its mean and about that. So
/// nothing cancels where a mean is far larger than its deviation, nor behind a pixel that is far from all others.
pub(super) fn moments(
    values: &[f32],
    lanes: usize,
    channels: usize,
    pixels: usize,
) -> Vec<[f64; 2]> {
    let arch = Arch::new();
    let runs = pixels.div_ceil(RUN);
    let length = |run: usize| (pixels - run * RUN).min(RUN);
    // For each block and run: means (rounded), sums of differences from them, sums of their squares, of each lane.
    let partial: Vec<Vec<f32>> = (0..channels / lanes * runs)
        .into_par_iter()
        .map(|task| {
            let (block, run) = (task / runs, task % runs);
            let part = &values[(block * pixels + run * RUN) * lanes..][..length(run) * lanes];
            let mut sums = vec![0.0_f32; 3 * lanes];
            let (about, sums_about) = sums.split_at_mut(lanes);
            // From the first pixel first: a sum of plain values would be rounded at their size.
            about.copy_from_slice(&part[..lanes]);
            arch.dispatch(Sums { part, about, sums: sums_about });
            for (about, sum) in about.iter_mut().zip(&mut sums_about[..lanes]) {
                *about += std::mem::take(sum) / length(run) as f32;
            }
            sums_about.fill(0.0);
            arch.dispatch(Sums { part, about, sums: sums_about });
            sums
        })
        .collect();
    let of_channel = |channel: usize| {
        let (block, lane) = (channel / lanes, channel % lanes);
        // Merged as Chan, Golub and LeVeque (1983) have it.
        let mut all = [0.0, 0.0, 0.0];
        for (run, sums) in partial[block * runs..][..runs].iter().enumerate() {
            let [about, plain, squares] = [0, 1, 2].map(|k| f64::from(sums[k * lanes + lane]));
            let count = length(run) as f64;
            let mean = about + plain / count;
            let [before, so_far, spread] = all;
            let (apart, together) = (mean - so_far, before + count);
            let within = squares - plain * plain / count;
            let between = apart * apart * (before / together * count);
            all = [together, so_far + apart * (count / together), spread + within + between];
        }
        let [_, mean, spread] = all;
        [mean, spread]
    };
    (0..channels).map(of_channel).collect()
}

/// Adds pixels' differences from some values, and their squares, by lane. (Structures, because closures are not
/// compiled into the vector code that they are handed to.)
struct Sums<'a> {
    part: &'a [f32],
    about: &'a [f32],
    sums: &'a mut [f32],
}

impl NullaryFnOnce for Sums<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let lanes = self.about.len();
        let (plain, squares) = self.sums.split_at_mut(lanes);
        if lanes == BLOCK {
            // In registers from the first pixel to the last.
            let (mut sums, mut of_squares) = ([0.0_f32; BLOCK], [0.0_f32; BLOCK]);
            let about: [f32; BLOCK] = std::array::from_fn(|lane| self.about[lane]);
            for pixel in self.part.as_chunks::<BLOCK>().0 {
                for lane in 0..BLOCK {
                    let value = pixel[lane] - about[lane];
                    sums[lane] += value;
                    of_squares[lane] = value.mul_add(value, of_squares[lane]);
                }
            }
            plain.copy_from_slice(&sums);
            squares.copy_from_slice(&of_squares);
            return;
        }
        for pixel in self.part.chunks_exact(lanes) {
            let sums = plain.iter_mut().zip(squares.iter_mut());
            for ((value, about), (plain, square)) in pixel.iter().zip(self.about).zip(sums) {
                let value = value - about;
                *plain += value;
                *square = value.mul_add(value, *square);
            }
        }
    }
}

/// Normalises pixels, with or without the swish.
struct Normalise<'a> {
    from: &'a [f32],
    /// Means, scales and shifts of the lanes.
    constants: [&'a [f32]; 3],
    swish: bool,
    out: &'a mut [f32],
}

impl NullaryFnOnce for Normalise<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        if self.swish {
            self.each(|value| value * sigmoid(value));
        } else {
            self.each(|value| value);
        }
    }
}

impl Normalise<'_> {
    #[inline(always)]
    fn each(self, after: impl Fn(f32) -> f32) {
        let [means, scales, shifts] = self.constants;
        let lanes = means.len();
        if lanes == BLOCK {
            let [means, scales, shifts]: [[f32; BLOCK]; 3] =
                [means, scales, shifts].map(|all| std::array::from_fn(|lane| all[lane]));
            let (from, out) =
                (self.from.as_chunks::<BLOCK>().0, self.out.as_chunks_mut::<BLOCK>().0);
            for (from, out) in from.iter().zip(out) {
                for lane in 0..BLOCK {
                    out[lane] =
                        after((from[lane] - means[lane]).mul_add(scales[lane], shifts[lane]));
                }
            }
            return;
        }
        for (from, out) in self.from.chunks_exact(lanes).zip(self.out.chunks_exact_mut(lanes)) {
            let constants = means.iter().zip(scales).zip(shifts);
            for ((from, out), ((mean, scale), shift)) in from.iter().zip(out).zip(constants) {
                *out = after((from - mean).mul_add(*scale, *shift));
            }
        }
    }
}

/// Rounds to 16-bit floats.
struct Halve<'a> {
    values: &'a [f32],
    out: &'a mut [u16],
}

impl NullaryFnOnce for Halve<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (out, value) in self.out.iter_mut().zip(self.values) {
            let bits = value.to_bits();
            // A NaN must not become an infinity when its low bits go.
            let rounded = (bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16) as u16;
            *out = if value.is_nan() { (bits >> 16) as u16 | 0x40 } else { rounded };
        }
    }
}

/// Writes a map, changed, to where a convolution reads it. `to` has the map's order and the target's size.
pub(super) fn write(map: &Map, change: &Change<'_>, target: Target, to: &mut Memory) {
    let Shape { height, width, .. } = map.shape;
    let lanes = map.lanes();
    let [_, columns] = target.size([height, width]);
    let (rows_of, columns_of) = (target.sources(height), target.sources(width));
    let straight = !target.doubled && !target.wrapped;
    let task = |task: usize, temporary: &mut Vec<f32>| {
        let (block, row) = (task / rows_of.len(), task % rows_of.len());
        temporary.resize(width * lanes, 0.0);
        let from =
            &map.values()[(block * height + rows_of[row]) * width * lanes..][..width * lanes];
        changed(from, block * lanes, lanes, change, temporary);
    };
    match target.element {
        Element::F32 => to.floats_mut().par_chunks_mut(columns * lanes).enumerate().for_each_init(
            Vec::new,
            |temporary, (index, out)| {
                if straight {
                    let from = &map.values()[index * width * lanes..][..width * lanes];
                    changed(from, index / height * lanes, lanes, change, out);
                    return;
                }
                task(index, temporary);
                for (out, &column) in out.chunks_exact_mut(lanes).zip(&columns_of) {
                    out.copy_from_slice(&temporary[column * lanes..][..lanes]);
                }
            },
        ),
        Element::Bf16 => to.halves_mut().par_chunks_mut(columns * lanes).enumerate().for_each_init(
            Vec::new,
            |temporary, (index, out)| {
                task(index, temporary);
                for (out, &column) in out.chunks_exact_mut(lanes).zip(&columns_of) {
                    halve(&temporary[column * lanes..][..lanes], out);
                }
            },
        ),
    }
}

/// A row of one block of channels, of which `first` is the first.
fn changed(from: &[f32], first: usize, lanes: usize, change: &Change<'_>, out: &mut [f32]) {
    let arch = Arch::new();
    match change {
        Change::Copy => out.copy_from_slice(from),
        Change::Norm(constants) | Change::NormSwish(constants) => {
            let swish = matches!(change, Change::NormSwish(_));
            let constants = &constants[first..][..lanes];
            let parts =
                [0, 1, 2].map(|which| constants.iter().map(|all| all[which]).collect::<Vec<f32>>());
            let constants = [0, 1, 2].map(|which| parts[which].as_slice());
            arch.dispatch(Normalise { from, constants, swish, out });
        }
    }
}

/// Rounds to 16-bit floats, to the nearest, ties to even.
pub(super) fn halve(values: &[f32], out: &mut [u16]) {
    Arch::new().dispatch(Halve { values, out });
}

/// Four maps, of the even and odd rows and columns, as one of twice the size: `phases[2 * row + column]`.
pub(super) fn interleave(phases: &[Map; 4], to: &mut Map) {
    let Shape { width, height, .. } = to.shape;
    let lanes = to.lanes();
    let half = width / 2;
    to.values_mut().par_chunks_mut(width * lanes).enumerate().for_each(|(index, out)| {
        let (block, row) = (index / height, index % height);
        let place = (block * height / 2 + row / 2) * half * lanes;
        let pair = [0, 1].map(|odd| &phases[row % 2 * 2 + odd].values()[place..][..half * lanes]);
        for (column, out) in out.chunks_exact_mut(lanes).enumerate() {
            out.copy_from_slice(&pair[column % 2][column / 2 * lanes..][..lanes]);
        }
    });
}

/// The map in a memory of its own, changed: what a convolution reads.
pub(super) fn prepared(
    context: &mut Context,
    map: &Map,
    change: &Change<'_>,
    target: Target,
) -> Result<Memory, ModelError> {
    let size = target.size([map.shape.height, map.shape.width]);
    let shape = Shape { height: size[0], width: size[1], ..map.shape };
    let mut to = context.take(shape.layout(context.library(), target.element, map.order)?);
    write(map, change, target, &mut to);
    Ok(to)
}
