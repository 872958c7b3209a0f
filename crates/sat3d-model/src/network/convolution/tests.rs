use super::*;
use burn::tensor::{Device, Distribution, module};

fn random(shape: [usize; 4], device: &Device) -> Tensor<4> {
    Tensor::random(shape, Distribution::Normal(0.0, 1.0), device).require_grad()
}

fn worst(a: Tensor<4>, b: Tensor<4>) -> f32 {
    let largest = b.clone().abs().max().into_scalar::<f32>();
    (a - b).abs().max().into_scalar::<f32>() / largest
}

#[test]
fn values_and_gradients_are_those_of_burn() {
    let device = Device::flex().autodiff();
    // Sizes that fill no block of channels or places, and the smallest there is.
    for [batch, inputs, outputs, height, width] in
        [[2, 5, 11, 13, 17], [1, 1, 1, 1, 1], [3, 8, 16, 64, 66], [1, 3, 9, 1, 5], [2, 4, 3, 7, 1]]
    {
        let input = random([batch, inputs, height, width], &device);
        let weight = random([outputs, inputs, 3, 3], &device);
        let upstream =
            random([batch, outputs, height, width], &device).without_autodiff().autodiff();
        let ours = convolve(input.clone(), weight.clone());
        let theirs = module::conv2d(input.clone(), weight.clone(), None, options());
        assert!(worst(ours.clone(), theirs.clone()) < 1e-5);
        let ours = (ours * upstream.clone()).sum().backward();
        let theirs = (theirs * upstream).sum().backward();
        for tensor in [input, weight] {
            let [ours, theirs] = [&ours, &theirs].map(|g| tensor.grad(g).expect("a gradient"));
            assert!(worst(ours, theirs) < 1e-5, "{batch} {inputs} {outputs} {height} {width}");
        }
    }
}

#[test]
fn a_transposed_view_is_read_as_what_it_shows() {
    let device = Device::flex().autodiff();
    let input = random([1, 2, 6, 4], &device);
    let weight = random([3, 2, 3, 3], &device);
    let ours = convolve(input.clone().swap_dims(2, 3), weight.clone());
    let theirs = module::conv2d(input.swap_dims(2, 3), weight, None, options());
    assert!(worst(ours, theirs) < 1e-5);
}
