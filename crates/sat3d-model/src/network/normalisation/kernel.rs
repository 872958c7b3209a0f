//! Batch normalisation with what follows it, and its gradients, in one pass over memory each.
//!
//! A task holds one channel; its sums run over the images in their order, in 64-bit floats per row of
//! [`RUN`] values, so that they do not depend on the number of threads.

use pulp::Arch;
use rayon::prelude::*;

/// Values summed in 32-bit floats (16 sums side by side) before they join the 64-bit sum.
const RUN: usize = 1024;
const SIDE_BY_SIDE: usize = 16;

/// Sizes of a map: images, channels, values of a channel of one image.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Images.
    pub batch: usize,
    /// Channels.
    pub channels: usize,
    /// Values of one channel of one image.
    pub area: usize,
}

impl Shape {
    fn planes<'a>(&self, map: &'a [f32], channel: usize) -> impl Iterator<Item = &'a [f32]> {
        let (channels, area) = (self.channels, self.area);
        (0..self.batch).map(move |image| &map[(image * channels + channel) * area..][..area])
    }

    fn count(&self) -> f64 {
        (self.batch * self.area) as f64
    }
}

/// What follows the normalisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// Nothing.
    Nothing,
    /// max(0, .).
    Relu,
}

/// Means, then variances, of each channel: `2 x channels`.
pub fn moments(shape: Shape, map: &[f32]) -> Vec<f32> {
    let arch = Arch::new();
    let pairs: Vec<[f32; 2]> = (0..shape.channels)
        .into_par_iter()
        .map(|channel| {
            let mean = |of: &dyn Fn(&[f32]) -> f64| {
                shape.planes(map, channel).map(of).sum::<f64>() / shape.count()
            };
            let centre = mean(&|plane| total(arch, plane, |value| value)) as f32;
            // About the rounded mean; what that is off by is known then, and comes out of both.
            let off = mean(&|plane| total(arch, plane, |value| value - centre));
            let square = |value: f32| (value - centre) * (value - centre);
            let squares = mean(&|plane| total(arch, plane, square));
            [(f64::from(centre) + off) as f32, (squares - off * off).max(0.0) as f32]
        })
        .collect();
    [0, 1].iter().flat_map(|which| pairs.iter().map(move |pair| pair[*which])).collect()
}

/// `after(scale (map - mean) + shift + residual)`, scale being `gain / sqrt(variance + epsilon)`.
pub fn forward(
    shape: Shape,
    map: &[f32],
    constants: &[[f32; 3]],
    residual: Option<&[f32]>,
    after: After,
) -> Vec<f32> {
    let arch = Arch::new();
    let least = match after {
        After::Nothing => f32::NEG_INFINITY,
        After::Relu => 0.0,
    };
    let mut out = vec![0.0; map.len()];
    out.par_chunks_mut(shape.area).enumerate().for_each(|(plane, out)| {
        let [mean, scale, shift] = constants[plane % shape.channels];
        let place = plane * shape.area;
        let map = &map[place..][..shape.area];
        match residual {
            Some(residual) => {
                let residual = &residual[place..][..shape.area];
                arch.dispatch(
                    #[inline(always)]
                    || {
                        for ((out, value), beside) in out.iter_mut().zip(map).zip(residual) {
                            *out = ((value - mean) * scale + shift + beside).max(least);
                        }
                    },
                );
            }
            None => arch.dispatch(
                #[inline(always)]
                || {
                    for (out, value) in out.iter_mut().zip(map) {
                        *out = ((value - mean) * scale + shift).max(least);
                    }
                },
            ),
        }
    });
    out
}

/// Gradients of [`forward`] with its statistics taken from the map itself.
pub struct GradientsOf {
    /// With respect to the map.
    pub map: Vec<f32>,
    /// With respect to the gains.
    pub gain: Vec<f32>,
    /// With respect to the shifts.
    pub shift: Vec<f32>,
    /// With respect to the residual: the gradient where the output is not cut off.
    pub passed: Vec<f32>,
}

/// Gradients, given the output's and the output (which tells where it was cut off). `constants` are mean, one
/// over the deviation, and gain.
pub fn backward(
    shape: Shape,
    map: &[f32],
    constants: &[[f32; 3]],
    output: &[f32],
    gradient: &[f32],
    after: After,
) -> GradientsOf {
    let arch = Arch::new();
    let mut passed = vec![0.0; map.len()];
    passed.par_chunks_mut(shape.area).enumerate().for_each(|(plane, passed)| {
        let place = plane * shape.area;
        let (output, gradient) = (&output[place..][..shape.area], &gradient[place..][..shape.area]);
        arch.dispatch(
            #[inline(always)]
            || match after {
                After::Nothing => passed.copy_from_slice(gradient),
                After::Relu => {
                    for ((passed, output), gradient) in passed.iter_mut().zip(output).zip(gradient)
                    {
                        *passed = if *output > 0.0 { *gradient } else { 0.0 };
                    }
                }
            },
        );
    });
    let sums: Vec<[f64; 2]> = (0..shape.channels)
        .into_par_iter()
        .map(|channel| {
            let [mean, inverse, _] = constants[channel];
            shape.planes(map, channel).zip(shape.planes(&passed, channel)).fold(
                [0.0; 2],
                |[plain, along], (map, passed)| {
                    [
                        plain + total(arch, passed, |value| value),
                        along
                            + total_of(arch, passed, map, |gradient, value| {
                                gradient * ((value - mean) * inverse)
                            }),
                    ]
                },
            )
        })
        .collect();
    let mut of_map = vec![0.0; map.len()];
    of_map.par_chunks_mut(shape.area).enumerate().for_each(|(plane, out)| {
        let channel = plane % shape.channels;
        let [mean, inverse, gain] = constants[channel];
        let [plain, along] = sums[channel].map(|sum| (sum / shape.count()) as f32);
        let place = plane * shape.area;
        let (map, passed) = (&map[place..][..shape.area], &passed[place..][..shape.area]);
        arch.dispatch(
            #[inline(always)]
            || {
                for ((out, value), gradient) in out.iter_mut().zip(map).zip(passed) {
                    let normalised = (value - mean) * inverse;
                    *out = gain * inverse * (gradient - plain - normalised * along);
                }
            },
        );
    });
    GradientsOf {
        map: of_map,
        gain: sums.iter().map(|[_, along]| *along as f32).collect(),
        shift: sums.iter().map(|[plain, _]| *plain as f32).collect(),
        passed,
    }
}

/// Sum of a function of each value.
fn total(arch: Arch, values: &[f32], of: impl Fn(f32) -> f32 + Copy) -> f64 {
    total_of(arch, values, values, move |value, _| of(value))
}

/// Sum of a function of each pair of values.
fn total_of(arch: Arch, a: &[f32], b: &[f32], of: impl Fn(f32, f32) -> f32 + Copy) -> f64 {
    a.chunks(RUN)
        .zip(b.chunks(RUN))
        .map(|(a, b)| {
            arch.dispatch(
                #[inline(always)]
                || {
                    let mut sums = [0.0_f32; SIDE_BY_SIDE];
                    let (a, a_rest) = a.as_chunks::<SIDE_BY_SIDE>();
                    let (b, b_rest) = b.as_chunks::<SIDE_BY_SIDE>();
                    for (a, b) in a.iter().zip(b) {
                        for lane in 0..SIDE_BY_SIDE {
                            sums[lane] += of(a[lane], b[lane]);
                        }
                    }
                    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| of(*a, *b)).sum();
                    f64::from(sums.iter().sum::<f32>() + rest)
                },
            )
        })
        .sum()
}
