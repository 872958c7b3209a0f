//! Batch normalisation for training, with the residual and the ReLU that follow it.
//!
//! As single operations of `burn` it is a dozen passes over memory, and as many for the gradients. On the
//! processor this is two passes for the statistics, one for the values, three for the gradients; elsewhere
//! it is made of `burn`'s operations.

#[cfg(test)]
mod hard_cases;
mod kernel;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::{Device, Tensor, TensorData, activation};
pub use kernel::After;
use kernel::Shape;

/// Added to a variance.
pub const EPSILON: f64 = 1e-5;

/// A map (`batch x channels x height x width`) normalised by the statistics of its channels over images and
/// places, then scaled, shifted, added to `residual` and cut off, as wanted; and those statistics, without
/// gradients: means and variances.
#[must_use]
pub fn normalise(
    map: Tensor<4>,
    gain: Tensor<1>,
    shift: Tensor<1>,
    residual: Option<Tensor<4>>,
    after: After,
) -> (Tensor<4>, [Tensor<1>; 2]) {
    if map.device().without_autodiff() != Device::flex() {
        return composed(map, gain, shift, residual, after);
    }
    let [_, channels, _, _] = map.dims();
    let moments = map.clone().without_autodiff().into_dispatch();
    let moments: Tensor<2> = Tensor::from_dispatch(<Dispatch as Normalisation>::moments(moments));
    let seen = [0, 1].map(|which| moments.clone().narrow(0, which, 1).reshape([channels]));
    let moments = if map.is_autodiff() { moments.autodiff() } else { moments };
    let (map, gain, shift) = (map.into_dispatch(), gain.into_dispatch(), shift.into_dispatch());
    let moments = moments.into_dispatch();
    let relu = after == After::Relu;
    let output = match residual {
        Some(residual) => <Dispatch as Normalisation>::normalise_add(
            map,
            gain,
            shift,
            residual.into_dispatch(),
            moments,
            relu,
        ),
        None => <Dispatch as Normalisation>::normalise(map, gain, shift, moments, relu),
    };
    (Tensor::from_dispatch(output), seen)
}

/// The same of `burn`'s operations.
fn composed(
    map: Tensor<4>,
    gain: Tensor<1>,
    shift: Tensor<1>,
    residual: Option<Tensor<4>>,
    after: After,
) -> (Tensor<4>, [Tensor<1>; 2]) {
    let [batch, channels, height, width] = map.dims();
    // Of each image first, whose means over equally many places then have the mean of all.
    let flat: Tensor<3> = map.clone().reshape([batch, channels, height * width]);
    let over_images = |values: Tensor<3>| -> Tensor<1> {
        let by_image: Tensor<2> = values.mean_dim(2).reshape([batch, channels]);
        by_image.mean_dim(0).reshape([channels])
    };
    let mean = over_images(flat.clone());
    let centred = flat - mean.clone().reshape([1, channels, 1]);
    let variance = over_images(centred.clone() * centred);
    let seen = [&mean, &variance].map(|tensor| tensor.clone().without_autodiff());
    let scale = gain * (variance + EPSILON).sqrt().recip();
    let shift = shift - mean * scale.clone();
    let shape = [1, channels, 1, 1];
    let mut output = map * scale.reshape(shape) + shift.reshape(shape);
    if let Some(residual) = residual {
        output = output + residual;
    }
    (if after == After::Relu { activation::relu(output) } else { output }, seen)
}

/// The operations on the processor.
#[backend_extension(Flex, Autodiff)]
pub(crate) trait Normalisation: Backend {
    /// Means, then variances: `2 x channels`.
    fn moments(map: FloatTensor<Self>) -> FloatTensor<Self>;

    /// See [`normalise`].
    fn normalise(
        map: FloatTensor<Self>,
        gain: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        moments: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;

    /// See [`normalise`]; with a residual.
    fn normalise_add(
        map: FloatTensor<Self>,
        gain: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        residual: FloatTensor<Self>,
        moments: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
}

type Primitive = FloatTensor<Flex>;

impl Normalisation for Flex {
    fn moments(map: Primitive) -> Primitive {
        let map = map.to_contiguous();
        let shape = sizes(&map);
        let values = kernel::moments(shape, map.storage());
        Primitive::from_data(TensorData::new(values, [2, shape.channels]))
    }

    fn normalise(
        map: Primitive,
        gain: Primitive,
        shift: Primitive,
        moments: Primitive,
        relu: bool,
    ) -> Primitive {
        forward(&map, &gain, &shift, &moments, None, relu)
    }

    fn normalise_add(
        map: Primitive,
        gain: Primitive,
        shift: Primitive,
        residual: Primitive,
        moments: Primitive,
        relu: bool,
    ) -> Primitive {
        forward(&map, &gain, &shift, &moments, Some(&residual), relu)
    }
}

impl<C: CheckpointStrategy> Normalisation for Autodiff<Flex, C> {
    fn moments(map: FloatTensor<Self>) -> FloatTensor<Self> {
        // Statistics have no gradient of their own: it is part of the normalisation's.
        let primitive = Flex::moments(map.into_primitive());
        <Self as burn::backend::AutodiffBackend>::from_inner(primitive)
    }

    fn normalise(
        map: FloatTensor<Self>,
        gain: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        moments: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self> {
        let nodes = [map.node(), gain.node(), shift.node()];
        let inputs = [map, gain, shift, moments].map(FloatTensor::<Self>::into_primitive);
        record::<C, 3>(nodes, inputs, None, relu)
    }

    fn normalise_add(
        map: FloatTensor<Self>,
        gain: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        residual: FloatTensor<Self>,
        moments: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self> {
        let nodes = [map.node(), gain.node(), shift.node(), residual.node()];
        let inputs = [map, gain, shift, moments].map(FloatTensor::<Self>::into_primitive);
        record::<C, 4>(nodes, inputs, Some(&residual.into_primitive()), relu)
    }
}

/// The value, with what its gradients need if one of the `nodes` (map, gain, shift, and the residual if there is
/// one) learns; of map, gain, shift and moments.
fn record<C: CheckpointStrategy, const N: usize>(
    nodes: [NodeGuard; N],
    [map, gain, shift, moments]: [Primitive; 4],
    residual: Option<&Primitive>,
    relu: bool,
) -> FloatTensor<Autodiff<Flex, C>> {
    let output = forward(&map, &gain, &shift, &moments, residual, relu);
    match Derivative.prepare::<C>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(preparation) => {
            let state = State { map, gain, moments, output: output.clone(), relu };
            preparation.finish(state, output)
        }
        OpsKind::UnTracked(preparation) => preparation.finish(output),
    }
}

/// What the gradients need.
#[derive(Clone, Debug)]
struct State {
    map: Primitive,
    gain: Primitive,
    moments: Primitive,
    output: Primitive,
    relu: bool,
}

/// With or without a residual: of as many inputs as are there.
#[derive(Debug)]
struct Derivative;

impl<const N: usize> Backward<Flex, N> for Derivative {
    type State = State;

    fn backward(self, ops: Ops<State, N>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        for (node, gradient) in ops.parents.into_iter().zip(ops.state.gradients(gradient)) {
            if let Some(node) = node {
                gradients.register::<Flex>(node.id, gradient);
            }
        }
    }
}

impl State {
    /// Of map, gain, shift and residual.
    fn gradients(&self, gradient: Primitive) -> [Primitive; 4] {
        let (map, output) = (self.map.to_contiguous(), self.output.to_contiguous());
        let (gain, moments) = (self.gain.to_contiguous(), self.moments.to_contiguous());
        let gradient = gradient.to_contiguous();
        let shape = sizes(&map);
        let constants: Vec<[f32; 3]> = inverses(&moments)
            .zip(gain.storage::<f32>())
            .map(|([mean, inverse], gain)| [mean, inverse, *gain])
            .collect();
        let found = kernel::backward(
            shape,
            map.storage(),
            &constants,
            output.storage(),
            gradient.storage(),
            after(self.relu),
        );
        let like = |values: Vec<f32>, of: &Primitive| {
            Primitive::from_data(TensorData::new(values, of.layout().shape().clone()))
        };
        [
            like(found.map, &map),
            like(found.gain, &gain),
            like(found.shift, &gain),
            like(found.passed, &map),
        ]
    }
}

fn forward(
    map: &Primitive,
    gain: &Primitive,
    shift: &Primitive,
    moments: &Primitive,
    residual: Option<&Primitive>,
    relu: bool,
) -> Primitive {
    let (map, moments) = (map.to_contiguous(), moments.to_contiguous());
    let (gain, shift) = (gain.to_contiguous(), shift.to_contiguous());
    let residual = residual.map(burn::backend::flex::FlexTensor::to_contiguous);
    let constants: Vec<[f32; 3]> = inverses(&moments)
        .zip(gain.storage::<f32>().iter().zip(shift.storage::<f32>()))
        .map(|([mean, inverse], (gain, shift))| [mean, gain * inverse, *shift])
        .collect();
    let residual = residual.as_ref().map(|residual| residual.storage::<f32>());
    let values = kernel::forward(sizes(&map), map.storage(), &constants, residual, after(relu));
    Primitive::from_data(TensorData::new(values, map.layout().shape().clone()))
}

/// Mean and one over the deviation of each channel.
fn inverses(moments: &Primitive) -> impl Iterator<Item = [f32; 2]> {
    let values: &[f32] = moments.storage();
    let (means, variances) = values.split_at(values.len() / 2);
    means.iter().zip(variances).map(|(mean, variance)| {
        let variance = f64::from(*variance) + EPSILON;
        [*mean, (1.0 / variance.sqrt()) as f32]
    })
}

fn after(relu: bool) -> After {
    if relu { After::Relu } else { After::Nothing }
}

fn sizes(map: &Primitive) -> Shape {
    let [batch, channels, height, width] = map.layout().shape().dims();
    Shape { batch, channels, area: height * width }
}

#[cfg(test)]
mod tests;
