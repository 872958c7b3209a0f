//! What the tests of the losses share: the reference's numbers, and finite differences.

use crate::random;
use burn::tensor::{DType, Device, Tensor, TensorData};
use safetensors::SafeTensors;

/// The reference's inputs and scalars.
static GOLDENS: &[u8] = include_bytes!("../../../fixtures/losses.safetensors");

/// Numbers of PyTorch and of the package `lpips`; `fixtures/losses_oracle.py` makes them.
pub(in crate::train) static TORCH: &[u8] =
    include_bytes!("../../../fixtures/losses_torch.safetensors");

/// Step of the central differences, in `f64`.
const STEP: f64 = 1e-6;

/// The processor, with gradients.
pub(super) fn device() -> Device {
    Device::flex().autodiff()
}

/// A tensor of the reference by its name, in `f32`.
pub(super) fn golden<const D: usize>(key: &str) -> Tensor<D> {
    stored(GOLDENS, key)
}

/// A tensor of a safetensors file by its name, in `f32`; a scalar has the shape `[1]`.
pub(in crate::train) fn stored<const D: usize>(file: &[u8], key: &str) -> Tensor<D> {
    let file = SafeTensors::deserialize(file).expect("a whole file");
    let view = file.tensor(key).expect(key);
    let values: Vec<f32> = view
        .data()
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
        .collect();
    let shape = if view.shape().is_empty() { vec![1] } else { view.shape().to_vec() };
    Tensor::from_data(TensorData::new(values, shape), &device())
}

/// A tensor of `f64`.
pub(super) fn wide<const D: usize>(values: Vec<f64>, shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), (&device(), DType::F64))
}

/// A tensor of `f32`.
pub(super) fn narrow<const D: usize>(values: &[f32], shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), &device())
}

/// Uniform numbers in `[low, high)`.
pub(super) fn uniform(seed: u64, count: usize, low: f64, high: f64) -> Vec<f64> {
    let mut draw = random::Draw::new(&[0x7465_7374, seed]);
    (0..count).map(|_| draw.range(low, high)).collect()
}

/// The values of a tensor.
pub(in crate::train) fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().iter::<f64>().collect()
}

/// The value of a loss.
pub(super) fn scalar(tensor: Tensor<1>) -> f64 {
    let values = values(tensor);
    assert_eq!(values.len(), 1);
    values[0]
}

/// Compares gradients with central differences at random inputs in `[low, high)`, in `f64`: no partial
/// derivative may differ by more than `tolerance` of the largest one.
pub(super) fn check_gradients(
    name: &str,
    shapes: &[[usize; 4]],
    [low, high]: [f64; 2],
    tolerance: f64,
    loss: impl Fn(&[Tensor<4>]) -> Tensor<1>,
) {
    let inputs: Vec<_> = shapes
        .iter()
        .zip(0..)
        .map(|(shape, seed)| uniform(seed, shape.iter().product(), low, high))
        .collect();
    check_gradients_at(name, shapes, &inputs, tolerance, loss);
}

/// As [`check_gradients`], at given inputs.
pub(super) fn check_gradients_at(
    name: &str,
    shapes: &[[usize; 4]],
    inputs: &[Vec<f64>],
    tolerance: f64,
    loss: impl Fn(&[Tensor<4>]) -> Tensor<1>,
) {
    let tensors = |inputs: &[Vec<f64>]| -> Vec<Tensor<4>> {
        inputs.iter().zip(shapes).map(|(v, shape)| wide(v.clone(), *shape)).collect()
    };
    let leaves: Vec<_> = tensors(inputs).into_iter().map(Tensor::require_grad).collect();
    let gradients = loss(&leaves).backward();
    let analytic: Vec<Vec<f64>> =
        leaves.iter().map(|leaf| leaf.grad(&gradients).map(values).expect("a gradient")).collect();
    let largest = analytic.iter().flatten().fold(0.0_f64, |m, v| m.max(v.abs()));
    assert!(largest.is_finite() && largest > 0.0, "{name}: largest gradient {largest}");
    let mut worst = (0.0_f64, String::new());
    for which in 0..inputs.len() {
        // At most some fifty of an input: each costs two evaluations.
        let stride = inputs[which].len().div_ceil(50);
        for index in (0..inputs[which].len()).step_by(stride) {
            let at = |offset: f64| {
                let mut moved = inputs.to_vec();
                moved[which][index] += offset;
                scalar(loss(&tensors(&moved)))
            };
            let numeric = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            let error = (numeric - analytic[which][index]).abs() / largest;
            if error.is_nan() || error > worst.0 {
                let text = format!(
                    "input {which}[{index}]: gradient {}, difference {numeric}",
                    analytic[which][index]
                );
                worst = (error, text);
            }
        }
    }
    assert!(worst.0 <= tolerance, "{name}: {} of the largest; {}", worst.0, worst.1);
}
