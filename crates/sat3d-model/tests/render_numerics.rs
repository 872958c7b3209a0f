//! Quadrature at its limits: huge and tiny densities, widths and counts.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use proptest::prelude::*;
use pulp::Arch;
use sat3d_model::field::DensityActivation::{Mipnerf, Relu};
use sat3d_model::field::Field;
use sat3d_model::field::closed_form::BoxCity;
use sat3d_model::render::quadrature::{CellRoom, Hit, ImportanceRoom, cells, midpoint};
use sat3d_model::render::{Camera, Intrinsics, Pose, RenderOptions, Wanted, render};

fn check(hit: Hit, weights: &[f32], from: f64, to: f64) {
    assert!(weights.iter().all(|weight| (0.0..=1.0).contains(weight)), "{weights:?}");
    let sum: f64 = weights.iter().map(|weight| f64::from(*weight)).sum();
    assert!((sum - (1.0 - hit.transmittance)).abs() < 1e-6, "{sum} {hit:?}");
    assert!((hit.opacity - (1.0 - hit.transmittance)).abs() < 1e-6, "{hit:?}");
    assert!(hit.distance.is_finite() && hit.variance >= 0.0, "{hit:?}");
    if hit.opacity > 0.0 {
        let slack = 1e-6 * to.abs().max(1.0);
        assert!((from - slack..=to + slack).contains(&hit.mean()), "{from} {to} {hit:?}");
        assert!(hit.spread() <= (to - from) * 0.51 + slack, "{hit:?}");
    }
}

fn both(radii: &[f32], sigma: &[f32]) {
    let mut weights = Vec::new();
    // The relu activation gives any density exactly: sigma = raw + 3.
    let raw: Vec<f32> = sigma.iter().map(|sigma| sigma - 3.0).collect();
    let hit = midpoint(Arch::new(), radii, &raw, Relu, &mut weights);
    let (first, last) = (f64::from(radii[0]), f64::from(radii[radii.len() - 1]));
    check(hit, &weights, first, last);
    let mut edges = vec![first];
    edges.extend(radii.windows(2).map(|pair| 0.5 * (f64::from(pair[0]) + f64::from(pair[1]))));
    edges.push(last);
    let hit = cells(Arch::new(), &edges, sigma, &mut CellRoom::default(), &mut weights);
    check(hit, &weights, first, last);
}

#[test]
fn densities_and_widths_of_every_size() {
    let sizes = [0.0_f32, 1e-38, 1e-30, 1e-12, 1e-4, 0.3, 1.0, 20.0, 1e4, 1e15, 1e30];
    for sigma in sizes {
        for width in [1e-30_f32, 1e-20, 1e-7, 0.02, 1.0, 1e10] {
            let radii: Vec<f32> = (0..96).map(|k| k as f32 * width).collect();
            both(&radii, &vec![sigma; 96]);
            let mixed: Vec<f32> = (0..96).map(|k| sizes[k * 7 % sizes.len()]).collect();
            both(&radii, &mixed);
            // All samples at one place.
            both(&[width; 96], &mixed);
        }
    }
}

#[test]
fn ten_thousand_samples() {
    let radii: Vec<f32> = (0..10_000).map(|k| k as f32 * 2e-4).collect();
    for sigma in [1e-6, 0.5, 3.0, 1e5] {
        both(&radii, &vec![sigma; 10_000]);
    }
    // A homogeneous medium: everything is known.
    let edges: Vec<f64> = (0..=10_000).map(|k| f64::from(k) * 2e-4).collect();
    let mut weights = Vec::new();
    let hit = cells(Arch::new(), &edges, &[3.0; 10_000], &mut CellRoom::default(), &mut weights);
    let rest = libm::exp(-6.0);
    assert!((hit.transmittance - rest).abs() < 1e-12);
    let mean = 1.0 / 3.0 - 2.0 * rest / (1.0 - rest);
    assert!((hit.mean() - mean).abs() < 1e-10, "{} {mean}", hit.mean());
    let variance = 1.0 / 9.0 - 4.0 * rest / (1.0 - rest) / (1.0 - rest);
    assert!((hit.spread() - variance.sqrt()).abs() < 1e-8, "{} {}", hit.spread(), variance.sqrt());
}

#[test]
fn one_cell_is_exact_and_continuous_where_the_formula_changes() {
    let one = |tau: f64| {
        let mut weights = Vec::new();
        let sigma = tau as f32;
        cells(Arch::new(), &[0.0, 1.0], &[sigma], &mut CellRoom::default(), &mut weights)
    };
    for (a, b) in [(0.999e-4, 1.001e-4), (0.04999, 0.05001)] {
        let (a, b) = (one(a), one(b));
        assert!((a.mean() - b.mean()).abs() < 1e-5 && (a.spread() - b.spread()).abs() < 1e-5);
    }
    assert_eq!(one(0.0).opacity, 0.0);
    assert!(one(0.0).mean().is_nan() && one(0.0).spread().is_nan());
    let solid = one(1e30);
    assert_eq!((solid.opacity, solid.transmittance < 1e-300), (1.0, true));
    assert!(solid.mean().abs() < 1e-29);
}

#[test]
fn importance_sampling_of_nothing_is_even() {
    let radii: Vec<f32> = (0..48).map(|k| (k as f32 + 1.5) / 24.0).collect();
    let mut fine = Vec::new();
    let mut room = ImportanceRoom::default();
    for weight in [0.0, 1.0, 1e-30] {
        room.released(&radii, &[weight; 47], 48, &mut fine);
        assert_eq!(fine.len(), 48);
        let step = (fine[47] - fine[0]) / 47.0;
        assert!(fine.windows(2).all(|pair| (pair[1] - pair[0] - step).abs() < 1e-5), "{fine:?}");
        let edges: Vec<f64> = (0..=48).map(|k| f64::from(k) / 24.0).collect();
        room.over_cells(&edges, &[weight; 48], 48, &mut fine);
        for (k, radius) in fine.iter().enumerate() {
            assert!((radius - (k as f32 + 0.5) / 24.0).abs() < 1e-5, "{k} {radius}");
        }
    }
}

proptest! {
    #[test]
    fn importance_samples_ascend_inside_their_bins(
        weights in prop::collection::vec(prop_oneof![Just(0.0_f32), 0.0..1.0_f32, Just(1.0)], 7..200),
        count in 1_usize..300,
        length in 1e-6..1e6_f64,
    ) {
        let cells = weights.len();
        let edges: Vec<f64> = (0..=cells).map(|k| length * k as f64 / cells as f64).collect();
        let (mut room, mut fine) = (ImportanceRoom::default(), Vec::new());
        room.over_cells(&edges, &weights, count, &mut fine);
        prop_assert!(fine.windows(2).all(|pair| pair[0] <= pair[1]));
        let end = (length * 1.000_001) as f32;
        prop_assert!(fine.len() == count && fine.iter().all(|r| (0.0..=end).contains(r)));
        let radii: Vec<f32> = edges.iter().map(|edge| *edge as f32).collect();
        room.released(&radii, &weights, count, &mut fine);
        prop_assert!(fine.windows(2).all(|pair| pair[0] <= pair[1]));
        prop_assert!(fine.len() == count && fine.iter().all(|r| (0.0..=end).contains(r)));
    }

    #[test]
    fn weights_sum_to_what_does_not_pass(
        steps in prop::collection::vec(1e-9..1.0_f32, 2..120),
        seed in prop::collection::vec(-12.0..12.0_f32, 120),
    ) {
        let mut radius = 0.0;
        let radii: Vec<f32> = steps.iter().map(|step| { radius += step; radius }).collect();
        let sigma: Vec<f32> = seed[..steps.len()].iter().map(|e| libm::powf(10.0, *e)).collect();
        both(&radii, &sigma);
        let mut weights = Vec::new();
        let hit = midpoint(Arch::new(), &radii, &seed[..steps.len()], Mipnerf, &mut weights);
        check(hit, &weights, 0.0, f64::from(radius));
    }
}

/// Rays along axes, through edges and corners, along faces, out of corners, and past the cube: nothing but
/// no-data is NaN.
#[test]
fn awkward_rays() {
    let (inputs, head) = BoxCity { texels: 32, ..BoxCity::example() }.inputs();
    let field = Field::new(&inputs, &head, None).unwrap();
    let values = [-3.0, -1.0, 0.0, 1.0, 1.5];
    let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 };
    let mut missed = 0;
    for x in values {
        for y in values {
            for z in values {
                for target in
                    [[1.0, 1.0, 1.0], [0.0; 3], [-1.0, 0.0, 0.0], [x, y, z - 1.0], [x, y + 1.0, z]]
                {
                    let Some(pose) = Pose::looking_at([x, y, z], target) else { continue };
                    let camera = Camera::Perspective { width: 3, height: 3, intrinsics, pose };
                    for options in [RenderOptions::default(), RenderOptions::stable()] {
                        let wanted = Wanted { color: true, normals: true };
                        let view = render(&field, None, &camera, &options, wanted);
                        let normals = view.normals.unwrap();
                        for (pixel, normal) in normals.iter().enumerate() {
                            let opacity = view.opacity[pixel];
                            assert!((0.0..=1.000_001).contains(&opacity), "{opacity}");
                            let solid = opacity >= 0.05;
                            missed += usize::from(opacity == 0.0);
                            assert_eq!(view.depth_spread[pixel].is_nan(), !solid);
                            assert_eq!(normal.iter().any(|n| n.is_nan()), !solid);
                            if options == RenderOptions::default() {
                                assert!(view.depth[pixel] >= 0.0, "{}", view.depth[pixel]);
                            } else {
                                assert_eq!(view.depth[pixel].is_nan(), !solid);
                            }
                        }
                        assert!(
                            view.feature
                                .unwrap()
                                .data
                                .iter()
                                .all(|v| (0.0..=1.000_001).contains(v))
                        );
                    }
                }
            }
        }
    }
    assert!(missed > 500, "{missed}");
}
