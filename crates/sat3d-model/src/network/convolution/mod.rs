//! 3 x 3 convolutions for training: our own kernels on the processor, `burn`'s elsewhere.
//!
//! `burn`'s CPU backend unrolls the input for every convolution and has no kernels of its own for
//! gradients; training spends nearly all its time there. These are 4 to 8 times as fast at the sizes of
//! the small model (`docs/train.md`). The operation is an extension of the backend, with a derivative
//! of its own, so that it takes part in automatic differentiation like any other.

mod kernel;

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Tensor, TensorData};
use kernel::Shape;

/// A convolution with `outputs x inputs x 3 x 3` weights, without bias, zeros around the input, of the
/// input's size: `batch x inputs x height x width` to `batch x outputs x height x width`.
#[must_use]
pub fn convolve(input: Tensor<4>, weight: Tensor<4>) -> Tensor<4> {
    let output = <Dispatch as Convolution>::convolve(input.into_dispatch(), weight.into_dispatch());
    Tensor::from_dispatch(output)
}

fn options() -> ConvOptions<2> {
    ConvOptions::new([1, 1], [1, 1], [1, 1], 1)
}

/// The convolution and its two gradients.
#[backend_extension(Flex, Cube: cfg(any(feature = "cuda", feature = "wgpu")), Autodiff)]
pub(crate) trait Convolution: Backend {
    /// See [`convolve`].
    fn convolve(input: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::conv2d(input, weight, None, options())
    }

    /// Gradient with respect to the input.
    fn input_gradient(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        Self::conv2d_x_backward(input, weight, gradient, options())
    }

    /// Gradient with respect to the weights.
    fn weight_gradient(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        Self::conv2d_weight_backward(input, weight, gradient, options())
    }
}

impl Convolution for Flex {
    fn convolve(input: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        let (input, weight) = (input.to_contiguous(), weight.to_contiguous());
        let shape = sizes(input.layout().shape(), weight.layout().shape());
        let output = kernel::forward(shape, input.storage(), weight.storage());
        tensor(output, [shape.batch, shape.outputs, shape.height, shape.width])
    }

    fn input_gradient(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let (weight, gradient) = (weight.to_contiguous(), gradient.to_contiguous());
        let shape = sizes(input.layout().shape(), weight.layout().shape());
        let result = kernel::input_gradient(shape, gradient.storage(), weight.storage());
        tensor(result, [shape.batch, shape.inputs, shape.height, shape.width])
    }

    fn weight_gradient(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let (input, gradient) = (input.to_contiguous(), gradient.to_contiguous());
        let shape = sizes(input.layout().shape(), weight.layout().shape());
        let result = kernel::weight_gradient(shape, input.storage(), gradient.storage());
        tensor(result, [shape.outputs, shape.inputs, 3, 3])
    }
}

#[cfg(any(feature = "cuda", feature = "wgpu"))]
impl Convolution for burn::backend::CubeBackend {}

impl<B: Convolution, C: CheckpointStrategy> Convolution for Autodiff<B, C> {
    fn convolve(input: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        match Derivative.prepare::<C>([input.node(), weight.node()]).compute_bound().stateful() {
            OpsKind::Tracked(mut preparation) => {
                let states = (preparation.checkpoint(&input), preparation.checkpoint(&weight));
                preparation
                    .finish(states, B::convolve(input.into_primitive(), weight.into_primitive()))
            }
            OpsKind::UnTracked(preparation) => {
                preparation.finish(B::convolve(input.into_primitive(), weight.into_primitive()))
            }
        }
    }
}

#[derive(Debug)]
struct Derivative;

impl<B: Convolution> Backward<B, 2> for Derivative {
    type State = (NodeId, NodeId);

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        gradients: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let [of_input, of_weight] = ops.parents;
        let gradient = gradients.consume::<B>(&ops.node);
        let (input, weight) = ops.state;
        let input: FloatTensor<B> = checkpointer.retrieve_node_output(input);
        let weight: FloatTensor<B> = checkpointer.retrieve_node_output(weight);
        if let Some(node) = of_input {
            let result = B::input_gradient(input.clone(), weight.clone(), gradient.clone());
            gradients.register::<B>(node.id, result);
        }
        if let Some(node) = of_weight {
            let result = B::weight_gradient(input, weight, gradient);
            gradients.register::<B>(node.id, result);
        }
    }
}

fn sizes(input: &burn::tensor::Shape, weight: &burn::tensor::Shape) -> Shape {
    let [batch, inputs, height, width] = input.dims();
    let [outputs, _, _, _] = weight.dims();
    Shape { batch, inputs, outputs, height, width }
}

fn tensor(values: Vec<f32>, shape: [usize; 4]) -> FloatTensor<Flex> {
    FloatTensor::<Flex>::from_data(TensorData::new(values, shape))
}

#[cfg(test)]
mod tests;
