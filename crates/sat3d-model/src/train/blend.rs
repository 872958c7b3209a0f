//! Weighted sums of a table's rows, as many as there are samples along rays: training spends much of its
//! time in them.
//!
//! Made of `burn`'s own operations, each tap is a pass of its own over all samples and leaves a tensor behind.
//! On the processor this is one pass with a derivative of its own, an extension of the backend as
//! [`crate::network::convolution`] is.

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::{Device, Int, Tensor, TensorData};
use pulp::Arch;
use rayon::prelude::*;
use std::sync::Arc;

/// Points of one parallel piece.
const PIECE: usize = 1024;
/// Channels of one parallel piece of the derivative.
const BLOCK: usize = 16;

/// For each of many points, equally many rows of a table and their weights, point by point.
#[derive(Clone, Debug)]
pub(crate) struct Taps {
    count: usize,
    rows: Vec<(i32, f32)>,
}

impl Taps {
    /// Taps of `points` points.
    pub(crate) fn of<const COUNT: usize>(
        points: usize,
        at: impl Fn(usize) -> [(i32, f32); COUNT] + Sync + Send,
    ) -> Self {
        let mut rows = vec![(0, 0.0); points * COUNT];
        rows.par_chunks_mut(COUNT.max(1)).with_min_len(PIECE).enumerate().for_each(
            |(point, taps)| {
                taps.copy_from_slice(&at(point));
            },
        );
        Self { count: COUNT, rows }
    }

    fn points(&self) -> usize {
        self.rows.len() / self.count.max(1)
    }
}

/// The weighted sums of rows of a table (`rows x channels`), `points x channels`.
pub(crate) fn blend(table: Tensor<2>, taps: Taps) -> Tensor<2> {
    if taps.points() > 0 && table.device().without_autodiff() == Device::flex() {
        let sum = <Dispatch as Blend>::blend(table.into_dispatch(), Arc::new(taps));
        return Tensor::from_dispatch(sum);
    }
    composed(table, &taps)
}

/// The same of the backend's own operations.
fn composed(table: Tensor<2>, taps: &Taps) -> Tensor<2> {
    let (device, points) = (table.device(), taps.points());
    let mut sum: Option<Tensor<2>> = None;
    for tap in 0..taps.count {
        let of_tap = || taps.rows.iter().skip(tap).step_by(taps.count);
        let rows: Vec<i32> = of_tap().map(|(row, _)| *row).collect();
        let weights: Vec<f32> = of_tap().map(|(_, weight)| *weight).collect();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [points]), &device);
        let weights = Tensor::<2>::from_data(TensorData::new(weights, [points, 1]), &device);
        let part = table.clone().select(0, rows) * weights;
        sum = Some(match sum {
            Some(sum) => sum + part,
            None => part,
        });
    }
    sum.unwrap_or_else(|| Tensor::zeros([0, table.dims()[1]], &device))
}

/// The sums and their derivative.
#[backend_extension(Flex, Autodiff)]
pub(crate) trait Blend: Backend {
    /// See [`blend`].
    fn blend(table: FloatTensor<Self>, taps: Arc<Taps>) -> FloatTensor<Self>;

    /// Gradient with respect to the table, which has `rows` rows.
    fn spread(gradient: FloatTensor<Self>, taps: Arc<Taps>, rows: usize) -> FloatTensor<Self>;
}

impl Blend for Flex {
    fn blend(table: FloatTensor<Self>, taps: Arc<Taps>) -> FloatTensor<Self> {
        let table = table.to_contiguous();
        let [_, channels] = table.layout().shape().dims();
        let (arch, points) = (Arch::new(), taps.points());
        let mut sums = vec![0.0_f32; points * channels];
        let source: &[f32] = table.storage();
        let pieces = taps.rows.par_chunks(PIECE * taps.count);
        sums.par_chunks_mut(PIECE * channels).zip(pieces).for_each(|(sums, rows)| {
            arch.dispatch(Gather { table: source, channels, count: taps.count, rows, sums });
        });
        FloatTensor::<Self>::from_data(TensorData::new(sums, [points, channels]))
    }

    fn spread(gradient: FloatTensor<Self>, taps: Arc<Taps>, rows: usize) -> FloatTensor<Self> {
        let gradient = gradient.to_contiguous();
        let [_, channels] = gradient.layout().shape().dims();
        let arch = Arch::new();
        let source: &[f32] = gradient.storage();
        // Threads share channels, not points: the order of each sum is that of the points.
        let blocks: Vec<Vec<f32>> = (0..channels.div_ceil(BLOCK))
            .into_par_iter()
            .map(|block| {
                let first = block * BLOCK;
                let width = BLOCK.min(channels - first);
                let mut sums = vec![0.0_f32; rows * width];
                let taps = &*taps;
                arch.dispatch(Scatter { source, channels, first, width, taps, sums: &mut sums });
                sums
            })
            .collect();
        let mut sums = vec![0.0_f32; rows * channels];
        for (block, part) in blocks.iter().enumerate() {
            let width = BLOCK.min(channels - block * BLOCK);
            let whole = sums.chunks_exact_mut(channels);
            for (row, part) in whole.zip(part.chunks_exact(width)) {
                row[block * BLOCK..][..width].copy_from_slice(part);
            }
        }
        FloatTensor::<Self>::from_data(TensorData::new(sums, [rows, channels]))
    }
}

struct Gather<'a> {
    table: &'a [f32],
    channels: usize,
    count: usize,
    rows: &'a [(i32, f32)],
    sums: &'a mut [f32],
}

impl pulp::NullaryFnOnce for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { table, channels, count, rows, sums } = self;
        for (sum, taps) in sums.chunks_exact_mut(channels).zip(rows.chunks_exact(count)) {
            for (row, weight) in taps {
                let source = &table[*row as usize * channels..][..channels];
                for (sum, value) in sum.iter_mut().zip(source) {
                    *sum = weight.mul_add(*value, *sum);
                }
            }
        }
    }
}

struct Scatter<'a> {
    source: &'a [f32],
    channels: usize,
    first: usize,
    width: usize,
    taps: &'a Taps,
    sums: &'a mut [f32],
}

impl pulp::NullaryFnOnce for Scatter<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { source, channels, first, width, taps, sums } = self;
        let points = source.chunks_exact(channels).zip(taps.rows.chunks_exact(taps.count));
        for (source, taps) in points {
            let source = &source[first..][..width];
            for (row, weight) in taps {
                let sum = &mut sums[*row as usize * width..][..width];
                for (sum, value) in sum.iter_mut().zip(source) {
                    *sum = weight.mul_add(*value, *sum);
                }
            }
        }
    }
}

impl<B: Blend, C: CheckpointStrategy> Blend for Autodiff<B, C> {
    fn blend(table: FloatTensor<Self>, taps: Arc<Taps>) -> FloatTensor<Self> {
        match Derivative.prepare::<C>([table.node()]).compute_bound().stateful() {
            OpsKind::Tracked(preparation) => {
                let table = table.into_primitive();
                let [rows, _] = burn::backend::TensorMetadata::shape(&table).dims();
                preparation.finish((Arc::clone(&taps), rows), B::blend(table, taps))
            }
            OpsKind::UnTracked(preparation) => {
                preparation.finish(B::blend(table.into_primitive(), taps))
            }
        }
    }

    fn spread(gradient: FloatTensor<Self>, taps: Arc<Taps>, rows: usize) -> FloatTensor<Self> {
        // Nobody differentiates a derivative.
        Self::from_inner(B::spread(gradient.into_primitive(), taps, rows))
    }
}

#[derive(Debug)]
struct Derivative;

impl<B: Blend> Backward<B, 1> for Derivative {
    type State = (Arc<Taps>, usize);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let [of_table] = ops.parents;
        let gradient = gradients.consume::<B>(&ops.node);
        let (taps, rows) = ops.state;
        if let Some(node) = of_table {
            gradients.register::<B>(node.id, B::spread(gradient, taps, rows));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;

    #[test]
    fn one_pass_is_as_many() {
        let device = Device::flex().autodiff();
        let mut draw = Draw::new(&[1]);
        for (rows, channels, points) in [(7, 3, 20), (50, 20, 3000), (5, 16, 1), (4, 40, 2500)] {
            let mut values = |count: usize| -> Vec<f32> {
                (0..count).map(|_| draw.range(-1.0, 1.0) as f32).collect()
            };
            let (table, slopes) = (values(rows * channels), values(points * channels));
            let taps = Taps::of(points, |point| {
                let mut draw = Draw::new(&[point as u64]);
                std::array::from_fn::<_, 4, _>(|_| (draw.index(rows) as i32, draw.unit() as f32))
            });
            let run = |of: &dyn Fn(Tensor<2>) -> Tensor<2>| -> [Vec<f32>; 2] {
                let data = TensorData::new(table.clone(), [rows, channels]);
                let table = Tensor::<2>::from_data(data, &device).require_grad();
                let sums = of(table.clone());
                let data = TensorData::new(slopes.clone(), [points, channels]);
                let gradients = (sums.clone() * Tensor::from_data(data, &device)).sum().backward();
                let gradient = table.grad(&gradients).expect("a gradient");
                [sums, gradient].map(|tensor| tensor.into_data().iter::<f32>().collect())
            };
            let found = run(&|table| blend(table, taps.clone()));
            let wanted = run(&|table| composed(table, &taps));
            for (found, wanted) in found.iter().zip(&wanted) {
                assert_eq!(found.len(), wanted.len());
                for (a, b) in found.iter().zip(wanted) {
                    // A row's gradient is a sum over up to all points.
                    assert!((a - b).abs() < 1e-5 * (points as f32).sqrt(), "{a} {b}");
                }
            }
        }
    }

    #[test]
    fn no_points_have_no_sums() {
        let table = Tensor::<2>::ones([3, 5], &Device::flex().autodiff());
        let taps = Taps::of(0, |_| [(0, 1.0)]);
        assert_eq!(blend(table, taps).dims(), [0, 5]);
    }
}
