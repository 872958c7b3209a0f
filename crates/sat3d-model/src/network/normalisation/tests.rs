use super::*;
use burn::tensor::Distribution;

fn random(shape: [usize; 4], device: &Device) -> Tensor<4> {
    Tensor::random(shape, Distribution::Normal(0.3, 2.0), device).require_grad()
}

fn worst<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> f32 {
    let largest = b.clone().abs().max().into_scalar::<f32>().max(1e-3);
    (a - b).abs().max().into_scalar::<f32>() / largest
}

#[test]
fn values_and_gradients_are_those_of_the_composed_form() {
    let device = Device::flex().autodiff();
    for ([batch, channels, height, width], with_residual, after) in [
        ([3, 5, 7, 9], false, After::Relu),
        ([3, 5, 7, 9], true, After::Relu),
        ([2, 4, 33, 64], true, After::Nothing),
        ([1, 2, 3, 5], false, After::Nothing),
    ] {
        let map = random([batch, channels, height, width], &device);
        let residual = random([batch, channels, height, width], &device);
        let vector =
            || Tensor::random([channels], Distribution::Normal(1.0, 1.0), &device).require_grad();
        let (gain, shift): (Tensor<1>, Tensor<1>) = (vector(), vector());
        let upstream = random([batch, channels, height, width], &device).detach();
        let run = |form: &dyn Fn(
            Tensor<4>,
            Tensor<1>,
            Tensor<1>,
            Option<Tensor<4>>,
        ) -> (Tensor<4>, [Tensor<1>; 2])| {
            let beside = with_residual.then(|| residual.clone());
            let (output, seen) = form(map.clone(), gain.clone(), shift.clone(), beside);
            let gradients = (output.clone() * upstream.clone()).sum().backward();
            let of_map = map.grad(&gradients).expect("a gradient");
            let vectors =
                [&gain, &shift].map(|tensor| tensor.grad(&gradients).expect("a gradient"));
            let of_residual = with_residual.then(|| residual.grad(&gradients).expect("a gradient"));
            (output, seen, of_map, vectors, of_residual)
        };
        let ours = run(&|map, gain, shift, beside| normalise(map, gain, shift, beside, after));
        let theirs = run(&|map, gain, shift, beside| composed(map, gain, shift, beside, after));
        assert!(worst(ours.0, theirs.0) < 1e-5, "values");
        for (ours, theirs) in ours.1.into_iter().zip(theirs.1) {
            assert!(worst(ours, theirs) < 1e-5, "statistics");
        }
        assert!(worst(ours.2, theirs.2) < 2e-5, "gradient of the map");
        for (ours, theirs) in ours.3.into_iter().zip(theirs.3) {
            assert!(worst(ours, theirs) < 2e-5, "gradient of gain and shift");
        }
        if let (Some(ours), Some(theirs)) = (ours.4, theirs.4) {
            assert!(worst(ours, theirs) < 1e-6, "gradient of the residual");
        }
    }
}

#[test]
fn a_constant_map_stays_finite() {
    let device = Device::flex().autodiff();
    let map = Tensor::<4>::full([2, 3, 4, 4], 1e4, &device).require_grad();
    let gain = Tensor::<1>::ones([3], &device).require_grad();
    let shift = Tensor::<1>::zeros([3], &device).require_grad();
    let (output, _) = normalise(map.clone(), gain, shift, None, After::Relu);
    let gradients = output.sum().backward();
    let gradient = map.grad(&gradients).expect("a gradient");
    assert!(gradient.abs().max().into_scalar::<f32>().is_finite());
}
