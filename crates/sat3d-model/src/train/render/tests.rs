use super::*;
use crate::field::{DensityActivation, Field};
use crate::render::{Camera, RenderOptions, SampleCounts, Sampling, SkyMap, Wanted};
use crate::tensor::Grid;
use crate::train::field::tests::{REPRESENTATIONS, both};
use crate::train::rays::Look;
use burn::tensor::Device;

fn values(tensor: Tensor<2>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

fn sky() -> Grid {
    let mut draw = Draw::new(&[9]);
    Grid::new(7, 10, 12, (0..840).map(|_| draw.unit() as f32).collect())
}

fn tensor(grid: &Grid, device: &Device) -> Tensor<3> {
    let shape = [grid.channels, grid.height, grid.width];
    Tensor::from_data(TensorData::new(grid.data.clone(), shape), device)
}

/// Pixels side by side to channel by channel.
fn planes(rows: &[f32], channels: usize) -> Vec<f32> {
    (0..channels).flat_map(|c| rows.iter().skip(c).step_by(channels).copied()).collect()
}

fn cameras() -> [Camera; 3] {
    let look = Look { field_of_view: [105.0, 90.0], pitch: 12.0, yaw: 35.0 };
    [
        Camera::Ortho { size: 12 },
        Camera::Panorama { width: 20, height: 10, position: [0.1, -0.2, -0.3] },
        look.camera(24, 2, [0.2, 0.1, -0.5], 0.8),
    ]
}

#[test]
fn views_are_as_they_are_rendered() {
    for representation in REPRESENTATIONS {
        for activation in [DensityActivation::Mipnerf, DensityActivation::Relu] {
            let (field, tensors, tint) = both(representation, activation, Some(vec![0.2; 5]));
            for camera in cameras() {
                compare(&field, &tensors, &tint, &camera);
            }
        }
    }
}

fn compare(field: &Field, tensors: &FieldTensors, tint: &Tensor<2>, camera: &Camera) {
    let samples = SampleCounts::new(24, 16).expect("counts");
    let options = RenderOptions { sampling: Sampling::Reference, samples, ..Default::default() };
    let wanted = Wanted { color: true, normals: false };
    let sky = sky();
    let map = SkyMap::from_decoder(&sky);
    let view = crate::render::render(field, Some(&map), camera, &options, wanted);
    let rays = Rays::of_camera(camera, 0.8);
    let samples = Samples { coarse: 24, fine: 16, jitter: None };
    let found = render(tensors, &rays, samples, Some(tint));
    assert!(worst(&values(found.depth), &view.depth) < 1e-5, "depth");
    assert!(worst(&values(found.opacity.clone()), &view.opacity) < 1e-5, "opacity");
    let feature = found.feature.expect("colours");
    let scene = view.feature.expect("colours").data;
    assert!(worst(&planes(&values(feature.clone()), 7), &scene) < 1e-5, "colour");
    let above = SkyTensors::new(tensor(&sky, &tensors.device())).lookup(&rays.directions);
    let all = compose(feature, found.opacity, above, Composite::Squared);
    let wanted = view.composite.expect("a sky").data;
    let error = worst(&planes(&values(all), 7), &wanted);
    assert!(error < 1e-5, "over the sky: {error}");
    // The comparison means something: rays differ.
    let (low, high) =
        view.opacity.iter().fold((1.0_f32, 0.0_f32), |(l, h), o| (l.min(*o), h.max(*o)));
    assert!(high - low > 0.05, "{low} {high}");
}

#[test]
fn a_window_is_a_part_of_the_view_and_one_pass_needs_no_merging() {
    let (_, tensors, tint) = both(REPRESENTATIONS[0], DensityActivation::Mipnerf, None);
    let camera = Camera::Ortho { size: 12 };
    for fine in [0, 8] {
        let samples = Samples { coarse: 12, fine, jitter: None };
        let whole = render(&tensors, &Rays::of_camera(&camera, 0.8), samples, Some(&tint));
        let window = Rays::window(&camera, 0.8, [3, 5], [4, 6]);
        let part = render(&tensors, &window, samples, None);
        assert!(part.feature.is_none());
        let (whole, part) = (values(whole.depth), values(part.depth));
        for row in 0..4 {
            let wanted = &whole[(row + 3) * 12 + 5..][..6];
            assert_eq!(&part[row * 6..][..6], wanted);
        }
    }
}

#[test]
fn shaken_samples_are_unbiased_and_named_by_their_view() {
    let (_, tensors, _) = both(REPRESENTATIONS[0], DensityActivation::Mipnerf, None);
    let camera = cameras()[1];
    let rays = Rays::of_camera(&camera, 0.8);
    let depth = |jitter: Option<u64>, coarse: usize| {
        let samples = Samples { coarse, fine: 32, jitter };
        values(render(&tensors, &rays, samples, None).depth)
    };
    let exact = depth(None, 200);
    assert_eq!(depth(Some(4), 24), depth(Some(4), 24));
    assert_ne!(depth(Some(4), 24), depth(Some(5), 24));
    let runs = 64;
    let mut mean = vec![0.0_f64; exact.len()];
    for run in 0..runs {
        for (mean, value) in mean.iter_mut().zip(depth(Some(run), 24)) {
            *mean += f64::from(value) / runs as f64;
        }
    }
    let errors = mean.iter().zip(&exact).map(|(mean, exact)| (mean - f64::from(*exact)).abs());
    let error = errors.sum::<f64>() / exact.len() as f64;
    assert!(error < 0.02, "{error}");
}

#[test]
fn gradients_agree_with_differences_and_stay_finite() {
    let device = Device::flex().autodiff();
    let camera = cameras()[2];
    let rays = Rays::of_camera(&camera, 0.8);
    let sky = tensor(&sky(), &device).require_grad();
    // The bias of the density is enough: every sample depends on it. A graph can be used once.
    let objective = |by: f32| {
        let (_, field, tint) = both(REPRESENTATIONS[0], DensityActivation::Mipnerf, None);
        let field = field.shifted(by);
        let samples = Samples { coarse: 24, fine: 0, jitter: None };
        let view = render(&field, &rays, samples, Some(&tint));
        let above = SkyTensors::new(sky.clone()).lookup(&rays.directions);
        let feature = view.feature.expect("colours");
        let all = compose(feature, view.opacity, above, Composite::Squared);
        (Tensor::cat(vec![all, view.depth], 1).powi_scalar(2), field)
    };
    let sum = |by: f32| values(objective(by).0).into_iter().map(f64::from).sum::<f64>();
    let difference = (sum(5e-3) - sum(-5e-3)) / 1e-2;
    let (terms, field) = objective(0.0);
    let gradients = terms.sum().backward();
    let exact = f64::from(field.density_bias_gradient(&gradients));
    let close = (difference - exact).abs() < 2e-3 * difference.abs();
    assert!(close, "{exact}, by differences {difference}");
    let of_sky = sky.grad(&gradients).expect("a gradient");
    let largest: f32 = of_sky.abs().max().into_scalar();
    assert!(largest > 0.0 && largest.is_finite());
    // Wholly opaque and wholly empty.
    for by in [-300.0, 300.0, 1e6] {
        let (terms, field) = objective(by);
        let gradient = field.density_bias_gradient(&terms.sum().backward());
        assert!(gradient.is_finite(), "{by}: {gradient}");
    }
}
