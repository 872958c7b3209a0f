//! The folded field against its definition, computed the long way in double precision.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::support;

use sat3d_model::Grid;
use sat3d_model::field::{
    DensityActivation, Field, FieldError, FieldInputs, Linear, PointHead, Representation,
};
use support::{Tensors, compare};

const ALL: [Representation; 3] =
    [Representation::Oneplane, Representation::OneplaneMulti, Representation::Triplane];

fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

fn linear(inputs: usize, outputs: usize, seed: u64) -> Linear {
    let (weight, bias) = (noise(inputs * outputs, seed), noise(outputs, seed + 1));
    Linear { inputs, outputs, weight, bias }
}

fn case(representation: Representation, activation: DensityActivation) -> (FieldInputs, PointHead) {
    let (channels, features) = match representation {
        Representation::Oneplane => (10, 10),
        Representation::OneplaneMulti => (10, 5),
        Representation::Triplane => (15, 5),
    };
    // The planes of a tri-plane have to be square; an odd size and a hidden width that is not a
    // multiple of the lanes.
    let map = Grid::new(channels, 13, 13, noise(channels * 169, 1));
    let head = PointHead {
        net0: linear(features, 21, 2),
        density: linear(21, 1, 4),
        feature: linear(21, 6, 6),
        style: linear(7, 6, 8),
        color: linear(12, 19, 10),
    };
    (FieldInputs { map, representation, activation, scale: 0.8 }, head)
}

/// One bilinear sample, `align_corners=false`, zeros outside.
fn bilinear(map: &Grid, channel: usize, u: f64, v: f64) -> f64 {
    let index = |c: f64, n: usize| ((c + 1.0) * n as f64 - 1.0) / 2.0;
    let (x, y) = (index(u, map.width), index(v, map.height));
    let mut sum = 0.0;
    for row in 0..map.height {
        for column in 0..map.width {
            let weight = (1.0 - (x - column as f64).abs()).max(0.0)
                * (1.0 - (y - row as f64).abs()).max(0.0);
            sum += weight * f64::from(map.channel(channel)[row * map.width + column]);
        }
    }
    sum
}

fn features(inputs: &FieldInputs, [x, y, z]: [f64; 3]) -> Vec<f64> {
    let map = &inputs.map;
    let half = map.channels / 2;
    let line = |channel: usize| {
        let means = (0..map.width).map(|column| {
            let column = map.channel(channel).iter().skip(column).step_by(map.width);
            (column.map(|v| f64::from(*v)).sum::<f64>() / map.height as f64) as f32
        });
        bilinear(&Grid::new(1, 1, map.width, means.collect()), 0, z, 0.0)
    };
    match inputs.representation {
        Representation::Oneplane => {
            (0..half).map(|c| bilinear(map, c, x, y)).chain((half..2 * half).map(line)).collect()
        }
        Representation::OneplaneMulti => {
            (0..half).map(|c| (bilinear(map, c, x, y) + line(half + c)) / 2.0).collect()
        }
        Representation::Triplane => {
            let third = map.channels / 3;
            let of = |c: usize| {
                bilinear(map, c, x, y)
                    + bilinear(map, third + c, x, z)
                    + bilinear(map, 2 * third + c, z, y)
            };
            (0..third).map(|c| of(c) / 3.0).collect()
        }
    }
}

fn apply(layer: &Linear, input: &[f64]) -> Vec<f64> {
    (0..layer.outputs)
        .map(|output| {
            let row = &layer.weight[output * layer.inputs..][..layer.inputs];
            let sum: f64 = row.iter().zip(input).map(|(w, v)| f64::from(*w) * v).sum();
            sum + f64::from(layer.bias[output])
        })
        .collect()
}

fn softplus(x: f64) -> f64 {
    x.max(0.0) + libm::log1p(libm::exp(-x.abs()))
}

/// Inside, on the rim, between rim and fade-out, outside, far outside.
fn points() -> Vec<[f32; 3]> {
    let mut points: Vec<[f32; 3]> = noise(300, 20).as_chunks::<3>().0.to_vec();
    let rim = [-1.0, 1.0, 1.0 - 1.0 / 13.0, -1.0 - 1.0 / 13.0, 1.04, 0.0, 3.0, -1e30];
    for a in rim {
        for b in rim {
            points.extend([[a, b, 0.3], [a, 0.2, b], [-0.1, a, b], [a, a, b]]);
        }
    }
    points
}

#[test]
fn densities_and_colours_are_those_of_the_definition() {
    for representation in ALL {
        for activation in [DensityActivation::Mipnerf, DensityActivation::Relu] {
            let (inputs, head) = case(representation, activation);
            let style = noise(7, 30);
            let field = Field::new(&inputs, &head, Some(&style)).unwrap();
            let points = points();
            let (mut raw, mut density, mut color) = (Vec::new(), Vec::new(), Vec::new());
            for point in &points {
                let hidden = features(&inputs, point.map(f64::from));
                let hidden: Vec<f64> =
                    apply(&head.net0, &hidden).into_iter().map(softplus).collect();
                let d = apply(&head.density, &hidden)[0];
                raw.push(d as f32);
                density.push(match activation {
                    DensityActivation::Mipnerf => softplus(d - 1.0),
                    DensityActivation::Relu => (d + 3.0).max(0.0),
                } as f32);
                let style: Vec<f64> = style.iter().map(|v| f64::from(*v)).collect();
                let both = [apply(&head.feature, &hidden), apply(&head.style, &style)].concat();
                color.extend(
                    apply(&head.color, &both).iter().map(|v| (1.0 / (1.0 + libm::exp(-v))) as f32),
                );
            }
            let name = |what: &str| format!("{representation:?} {activation:?} {what}");
            compare(&name("raw"), &field.raw_densities(&points), &raw, 6e-7);
            let (got_density, got_color) = field.densities_and_colors(&points);
            compare(&name("density"), &got_density, &density, 1e-6);
            compare(&name("colour"), &got_color, &color, 5e-7);
        }
    }
}

#[test]
fn outside_the_cube_features_are_zero_but_density_is_not() {
    for representation in ALL {
        let (inputs, head) = case(representation, DensityActivation::Mipnerf);
        let field = Field::new(&inputs, &head, None).unwrap();
        let far = field.densities(&[[2.0; 3], [-1.2, 1.5, 9.0], [f32::NAN, f32::INFINITY, -1e38]]);
        assert!(far.iter().all(|value| *value == far[0] && *value > 0.0), "{far:?}");
    }
}

/// A layer of 1024 times the identity with a bias of 4096, where softplus is its argument: the raw density
/// is a feature.
#[test]
fn features_are_the_references() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/representer.safetensors");
    let Some(golden) = Tensors::open(std::path::Path::new(path)) else { panic!("no {path}") };
    let values = golden.f32("points");
    let points = values.as_chunks::<3>().0;
    let (plane, line) = (golden.grid("plane_in"), golden.grid("line_in"));
    // The golden's line is given as it is; every row of the map's second half is that line.
    let mut data = plane.data.clone();
    for channel in line.data.chunks_exact(line.width) {
        (0..16).for_each(|_| data.extend(channel));
    }
    let map = Grid::new(8, 16, 16, data);
    let triplane = Grid::new(12, 16, 16, golden.f32("triplane_in"));
    for (representation, key, map) in [
        (ALL[0], "oneplane", &map),
        (ALL[1], "oneplane_multi", &map),
        (ALL[2], "triplane", &triplane),
    ] {
        let features = golden.shape(key)[2];
        let unit = |k: usize, value: f32| {
            (0..features).map(|c| if c == k { value } else { 0.0 }).collect::<Vec<_>>()
        };
        let mut got = vec![0.0; points.len() * features];
        for k in 0..features {
            let head = PointHead {
                net0: Linear {
                    inputs: features,
                    outputs: features,
                    weight: (0..features).flat_map(|k| unit(k, 1024.0)).collect(),
                    bias: vec![4096.0; features],
                },
                density: Linear {
                    inputs: features,
                    outputs: 1,
                    weight: unit(k, 1.0 / 1024.0),
                    bias: vec![-4.0],
                },
                feature: linear(features, 1, 1),
                style: linear(1, 1, 1),
                color: linear(2, 3, 1),
            };
            let activation = DensityActivation::Relu;
            let inputs = FieldInputs { map: map.clone(), representation, activation, scale: 0.8 };
            let raw = Field::new(&inputs, &head, None).unwrap().raw_densities(points);
            for (point, value) in raw.iter().enumerate() {
                got[point * features + k] = *value;
            }
        }
        compare(key, &got, &golden.f32(key), 1e-5);
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let (inputs, head) = case(Representation::Oneplane, DensityActivation::Mipnerf);
    let refuse = |inputs: &FieldInputs, head: &PointHead, style: Option<&[f32]>, word: &str| {
        let error = Field::new(inputs, head, style).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    };
    refuse(&inputs, &head, Some(&[0.0; 6]), "style code: 6 where 7");
    let mut bad = head.clone();
    bad.net0.bias.pop();
    refuse(&inputs, &bad, None, "net0.bias: 20 where 21");
    let mut bad = head.clone();
    bad.color.inputs = 11;
    refuse(&inputs, &bad, None, "grd_color_convert.weight: 19 x 11 where 19 x 12");
    let mut bad = head.clone();
    bad.density.weight[3] = f32::NAN;
    refuse(&inputs, &bad, None, "net1_density.weight holds the value NaN at index 3");
    let mut bad = inputs.clone();
    bad.representation = Representation::Triplane;
    refuse(&bad, &head, None, "map: 10 x 13 x 13 where a multiple of 3");
    bad.representation = Representation::OneplaneMulti;
    refuse(&bad, &head, None, "net0.weight: 10 inputs where 5");
    let scaled = FieldInputs { scale: 1.5, ..inputs };
    assert_eq!(Field::new(&scaled, &head, None).unwrap_err(), FieldError::Scale(1.5));
}
