//! 3 x 3 convolutions on the processor, forward and both gradients, for channels-first batches.
//!
//! Each image is copied once into planes with a border of zeros. With rows of `width + 2` values, the
//! value under tap (ky, kx) of flat place q is at q + ky * pitch + kx: a tap is an offset, nothing is
//! unrolled in memory, and two columns of garbage a row are the price. Sums run in a fixed order:
//! results do not depend on the number of threads.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Sizes of a convolution whose output has the size of its input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

impl Shape {
    fn pitch(&self) -> usize {
        self.width + 2
    }

    /// Places of a row-padded output plane.
    fn places(&self) -> usize {
        self.height * self.pitch()
    }

    /// Values of a padded plane, with room for the last vectors' overhang.
    fn plane(&self) -> usize {
        (self.height + 2) * self.pitch() + OVERHANG
    }

    fn area(&self) -> usize {
        self.height * self.width
    }

    fn taps(&self) -> [usize; 9] {
        std::array::from_fn(|tap| tap / 3 * self.pitch() + tap % 3)
    }
}

/// Most values that a block of places reads beyond the last place.
const OVERHANG: usize = 64;
/// Vectors of places in a block.
const VECTORS: usize = 3;

/// Output (`batch x outputs x height x width`) of an input (`batch x inputs x height x width`) under
/// weights (`outputs x inputs x 3 x 3`), zeros around the input.
pub fn forward(shape: Shape, input: &[f32], weight: &[f32]) -> Vec<f32> {
    let wide = vectors();
    let packed = pack(shape.outputs, shape.inputs, rows(wide), |o, i, tap| {
        weight[(o * shape.inputs + i) * 9 + tap]
    });
    run(shape, input, &packed)
}

/// Gradient with respect to the input: the same convolution with weights mirrored and transposed.
pub fn input_gradient(shape: Shape, output_gradient: &[f32], weight: &[f32]) -> Vec<f32> {
    let wide = vectors();
    let packed = pack(shape.inputs, shape.outputs, rows(wide), |i, o, tap| {
        weight[(o * shape.inputs + i) * 9 + 8 - tap]
    });
    let shape = Shape { inputs: shape.outputs, outputs: shape.inputs, ..shape };
    run(shape, output_gradient, &packed)
}

/// Gradient with respect to the weights (`outputs x inputs x 3 x 3`).
pub fn weight_gradient(shape: Shape, input: &[f32], output_gradient: &[f32]) -> Vec<f32> {
    let inputs: Vec<Vec<f32>> = (0..shape.batch)
        .into_par_iter()
        .map(|b| padded(shape, &input[b * shape.inputs * shape.area()..], shape.inputs))
        .collect();
    let outputs: Vec<Vec<f32>> = (0..shape.batch)
        .into_par_iter()
        .map(|b| rowed(shape, &output_gradient[b * shape.outputs * shape.area()..], shape.outputs))
        .collect();
    let arch = Arch::new();
    let mut gradient = vec![0.0; shape.outputs * shape.inputs * 9];
    // A task holds a few output channels; an input plane serves all of them at once.
    gradient.par_chunks_mut(GRADIENT_ROWS * shape.inputs * 9).enumerate().for_each(
        |(block, out)| {
            let first = block * GRADIENT_ROWS;
            for (input, output) in inputs.iter().zip(&outputs) {
                arch.dispatch(Correlate { shape, first, input, output, out });
            }
        },
    );
    gradient
}

fn vectors() -> usize {
    struct Lanes;
    impl WithSimd for Lanes {
        type Output = usize;
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }
    Arch::new().dispatch(Lanes)
}

/// Output channels of a block: as many as the registers hold.
fn rows(lanes: usize) -> usize {
    if lanes >= 16 { 8 } else { 4 }
}

/// Weights in blocks of output channels: `block x inputs x tap x row`, zeros where a block is not full.
fn pack(
    outputs: usize,
    inputs: usize,
    rows: usize,
    weight: impl Fn(usize, usize, usize) -> f32,
) -> Vec<f32> {
    let blocks = outputs.div_ceil(rows);
    let mut packed = vec![0.0; blocks * inputs * 9 * rows];
    for output in 0..outputs {
        for input in 0..inputs {
            for tap in 0..9 {
                let place = ((output / rows * inputs + input) * 9 + tap) * rows + output % rows;
                packed[place] = weight(output, input, tap);
            }
        }
    }
    packed
}

/// One image in planes with a border of zeros.
fn padded(shape: Shape, image: &[f32], channels: usize) -> Vec<f32> {
    let mut planes = vec![0.0; channels * shape.plane()];
    for (plane, source) in
        planes.chunks_exact_mut(shape.plane()).zip(image.chunks_exact(shape.area()))
    {
        for (row, line) in source.chunks_exact(shape.width).enumerate() {
            plane[(row + 1) * shape.pitch() + 1..][..shape.width].copy_from_slice(line);
        }
    }
    planes
}

/// One image with two zeros after each row.
fn rowed(shape: Shape, image: &[f32], channels: usize) -> Vec<f32> {
    let length = shape.places() + OVERHANG;
    let mut planes = vec![0.0; channels * length];
    for (plane, source) in planes.chunks_exact_mut(length).zip(image.chunks_exact(shape.area())) {
        for (row, line) in source.chunks_exact(shape.width).enumerate() {
            plane[row * shape.pitch()..][..shape.width].copy_from_slice(line);
        }
    }
    planes
}

fn run(shape: Shape, input: &[f32], packed: &[f32]) -> Vec<f32> {
    let arch = Arch::new();
    let mut output = vec![0.0; shape.batch * shape.outputs * shape.area()];
    output.par_chunks_mut(shape.outputs * shape.area()).enumerate().for_each(|(b, out)| {
        let planes = padded(shape, &input[b * shape.inputs * shape.area()..], shape.inputs);
        arch.dispatch(Convolve { shape, planes: &planes, packed, out });
    });
    output
}

struct Convolve<'a> {
    shape: Shape,
    planes: &'a [f32],
    packed: &'a [f32],
    out: &'a mut [f32],
}

impl WithSimd for Convolve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if S::F32_LANES >= 16 {
            self.blocks::<S, 8>(simd);
        } else {
            self.blocks::<S, 4>(simd);
        }
    }
}

impl Convolve<'_> {
    #[inline(always)]
    fn blocks<S: Simd, const ROWS: usize>(self, simd: S) {
        let Self { shape, planes, packed, out } = self;
        let taps = shape.taps();
        let step = VECTORS * S::F32_LANES;
        let blocks = shape.outputs.div_ceil(ROWS);
        let per_block = shape.inputs * 9 * ROWS;
        let mut strip = vec![0.0_f32; ROWS * step];
        // Places outside: a strip of the input stays in the nearest cache for all output channels.
        for first in (0..shape.places()).step_by(step) {
            for block in 0..blocks {
                let weights = &packed[block * per_block..][..per_block];
                let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
                for (plane, weights) in
                    planes.chunks_exact(shape.plane()).zip(weights.chunks_exact(9 * ROWS))
                {
                    for (tap, weights) in taps.iter().zip(weights.chunks_exact(ROWS)) {
                        let place = &plane[first + tap..][..step];
                        let (values, _) = S::as_simd_f32s(place);
                        let values: [S::f32s; VECTORS] = std::array::from_fn(|v| values[v]);
                        for row in 0..ROWS {
                            let weight = simd.splat_f32s(weights[row]);
                            for v in 0..VECTORS {
                                sums[row][v] = simd.mul_add_f32s(weight, values[v], sums[row][v]);
                            }
                        }
                    }
                }
                for (row, sums) in sums.iter().enumerate() {
                    let (strip, _) = S::as_mut_simd_f32s(&mut strip[row * step..][..step]);
                    strip.copy_from_slice(sums);
                }
                let last = (first + step).min(shape.places());
                let channels = ROWS.min(shape.outputs - block * ROWS);
                for row in 0..channels {
                    let plane = &mut out[(block * ROWS + row) * shape.area()..][..shape.area()];
                    let strip = &strip[row * step..][..step];
                    // The strip crosses a few rows; their last two places are garbage.
                    let mut place = first;
                    while place < last {
                        let (y, x) = (place / shape.pitch(), place % shape.pitch());
                        let end = last.min((y + 1) * shape.pitch());
                        if x < shape.width {
                            let count = (end - place).min(shape.width - x);
                            plane[y * shape.width + x..][..count]
                                .copy_from_slice(&strip[place - first..][..count]);
                        }
                        place = end;
                    }
                }
            }
        }
    }
}

/// Output channels whose weight gradients are summed together.
const GRADIENT_ROWS: usize = 8;
/// Places summed for one input channel before the next one's turn.
const TILE: usize = 512;

/// Adds one image's share to the weight gradients of a few output channels.
struct Correlate<'a> {
    shape: Shape,
    first: usize,
    input: &'a [f32],
    output: &'a [f32],
    out: &'a mut [f32],
}

impl WithSimd for Correlate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // With 16 registers, three taps of eight channels are too many.
        if S::F32_LANES >= 16 {
            self.tiles::<S, 3>(simd);
        } else {
            self.tiles::<S, 1>(simd);
        }
    }
}

impl Correlate<'_> {
    #[inline(always)]
    fn tiles<S: Simd, const TAPS: usize>(self, simd: S) {
        let Self { shape, first, input, output, out } = self;
        let length = shape.places() + OVERHANG;
        let rows = out.len() / (shape.inputs * 9);
        let taps = shape.taps();
        // A block that is not full repeats its last channel.
        let gradients: [&[f32]; GRADIENT_ROWS] =
            std::array::from_fn(|row| &output[(first + row.min(rows - 1)) * length..][..length]);
        let lanes = S::F32_LANES;
        let end = shape.places().div_ceil(lanes) * lanes;
        // Sums of all input channels, a vector each; a tile of places stays in the nearest cache for
        // all of them.
        let mut all = vec![simd.splat_f32s(0.0); shape.inputs * 9 * GRADIENT_ROWS];
        for start in (0..end).step_by(TILE) {
            let stop = end.min(start + TILE);
            for (plane, all) in
                input.chunks_exact(shape.plane()).zip(all.chunks_exact_mut(9 * GRADIENT_ROWS))
            {
                for (taps, all) in
                    taps.chunks_exact(TAPS).zip(all.chunks_exact_mut(TAPS * GRADIENT_ROWS))
                {
                    let mut sums: [[S::f32s; GRADIENT_ROWS]; TAPS] = std::array::from_fn(|tap| {
                        std::array::from_fn(|row| all[tap * GRADIENT_ROWS + row])
                    });
                    for place in (start..stop).step_by(lanes) {
                        let gradient: [S::f32s; GRADIENT_ROWS] = std::array::from_fn(|row| {
                            S::as_simd_f32s(&gradients[row][place..][..lanes]).0[0]
                        });
                        for tap in 0..TAPS {
                            let value = S::as_simd_f32s(&plane[place + taps[tap]..][..lanes]).0[0];
                            for row in 0..GRADIENT_ROWS {
                                sums[tap][row] =
                                    simd.mul_add_f32s(gradient[row], value, sums[tap][row]);
                            }
                        }
                    }
                    for (all, sums) in all.chunks_exact_mut(GRADIENT_ROWS).zip(sums) {
                        all.copy_from_slice(&sums);
                    }
                }
            }
        }
        for row in 0..rows {
            for (place, sum) in all.chunks_exact(GRADIENT_ROWS).enumerate() {
                out[row * shape.inputs * 9 + place] += simd.reduce_sum_f32s(sum[row]);
            }
        }
    }
}
