//! Points, columns and lines of a field beside one another and beside formulas.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::*;
use crate::field::closed_form::BoxCity;
use crate::field::hard_cases::units;
use crate::field::{FieldInputs, Linear, Representation};
use crate::tensor::Grid;
use pulp::Arch;

#[test]
fn every_vector_unit_gives_the_same_bytes() {
    let (inputs, head) = BoxCity { texels: 24, ..BoxCity::example() }.inputs();
    let field = Field::new(&inputs, &head, Some(&[0.3])).unwrap();
    let points: Vec<[f32; 3]> =
        (0..500).map(|k| [7, 11, 13].map(|step| (k * step % 101) as f32 / 46.0 - 1.1)).collect();
    let bits = |arch: Arch| {
        let field = Field { arch, ..field.clone() };
        let (densities, colors) = field.densities_and_colors(&points);
        let mut column = vec![0.0; 300];
        let heights: Vec<f32> = (0..300).map(|k| k as f32 / 140.0 - 1.07).collect();
        let tables = ColumnTables::new(&field, &[0.4]);
        let row = tables.row(-0.5);
        row.column(0, 0.4, &mut ColumnRoom::default()).raw_at_heights(&heights, &mut column);
        let all = [densities, colors, column].concat();
        all.iter().map(|value| value.to_bits()).collect::<Vec<_>>()
    };
    let units = units();
    let first = bits(units[0]);
    assert!(units[1..].iter().all(|unit| bits(*unit) == first));
}

#[test]
fn another_style_is_another_colour_of_the_same_densities() {
    let (inputs, head) = BoxCity { texels: 24, ..BoxCity::example() }.inputs();
    let mut head = head;
    // The example's colours do not hang on the style.
    for (k, weight) in head.style.weight.iter_mut().enumerate() {
        *weight = 0.3 + 0.1 * (k % 5) as f32;
    }
    for (k, weight) in head.color.weight.iter_mut().enumerate() {
        *weight = 0.2 - 0.03 * (k % 7) as f32;
    }
    let [dark, light] = [0.1, 2.0].map(|s| Field::new(&inputs, &head, Some(&[s])).unwrap());
    let points: Vec<[f32; 3]> =
        (0..50).map(|k| [0.01 * k as f32, 0.2, -0.9 + 0.02 * k as f32]).collect();
    let (densities, colors) = dark.densities_and_colors(&points);
    let (same, others) = light.densities_and_colors(&points);
    assert_eq!(densities, same);
    assert!(colors != others);
    let relit = dark.with_style(&head, Some(&[2.0])).unwrap();
    assert_eq!(relit.densities_and_colors(&points), (same, others));
}

#[test]
fn the_features_of_three_planes_are_averaged() {
    let (inputs, head) = BoxCity { texels: 8, ..BoxCity::example() }.inputs();
    let count = head.net0.inputs;
    // Each channel of each plane has a value of its own, the same everywhere.
    let value = |channel: usize| 0.05 * (channel * 7 % 11) as f32 - 0.2;
    let data = (0..3 * count).flat_map(|channel| vec![value(channel); 64]).collect();
    let map = Grid::new(3 * count, 8, 8, data);
    let inputs = FieldInputs { map, representation: Representation::Triplane, ..inputs };
    let field = Field::new(&inputs, &head, None).unwrap();
    let weight = |layer: &Linear, row: usize, column: usize| {
        f64::from(layer.weight[row * layer.inputs + column])
    };
    let mut expected = f64::from(head.density.bias[0]);
    for unit in 0..head.net0.outputs {
        let mean = |i: usize| (0..3).map(|k| f64::from(value(k * count + i))).sum::<f64>() / 3.0;
        let sum: f64 = (0..count).map(|i| weight(&head.net0, unit, i) * mean(i)).sum();
        let x = sum + f64::from(head.net0.bias[unit]);
        expected +=
            weight(&head.density, 0, unit) * (x.max(0.0) + libm::log1p(libm::exp(-x.abs())));
    }
    for found in field.raw_densities(&[[0.1, -0.2, 0.3], [0.5, 0.4, -0.6]]) {
        let apart = (f64::from(found) - expected).abs();
        assert!(apart <= 1e-5 * expected.abs().max(1.0), "{found} for {expected}");
    }
}

#[test]
fn a_plane_s_lines_are_the_plane_at_their_points() {
    let (rows, columns, hidden) = (5, 3, LANES);
    let texels = (0..(rows + 2) * (columns + 2) * hidden).map(|k| (k * 37 % 101) as f32);
    let plane = Plane { rows, columns, texels: texels.collect() };
    let sum = |taps: &[&[f32]], weights: &[f32], channel: usize| -> f32 {
        taps.iter().zip(weights).map(|(tap, weight)| tap[channel] * weight).sum()
    };
    for k in 0..200 {
        let [u, v] = [7, 11].map(|step| (k * step % 103) as f32 / 50.0 - 1.03);
        let (taps, weights) = plane.taps(u, v, hidden);
        let over_columns = plane.line_over_columns(v, hidden);
        let over_rows = plane.line_over_rows(u, hidden);
        assert_eq!((over_columns.cells, over_rows.cells), (columns, rows));
        for (line, at) in [(&over_columns, u), (&over_rows, v)] {
            let (ends, shares) = line.taps(at, hidden);
            for channel in 0..hidden {
                let expected = sum(&taps, &weights, channel);
                let found = sum(&ends, &shares, channel);
                assert!((found - expected).abs() < 1e-4, "{u} {v}: {found} {expected}");
            }
        }
    }
}

#[test]
fn a_column_is_the_same_as_its_points() {
    let (inputs, head) = BoxCity { texels: 24, ..BoxCity::example() }.inputs();
    let field = Field::new(&inputs, &head, None).unwrap();
    let heights: Vec<f32> = (0..300).map(|k| k as f32 / 140.0 - 1.07).collect();
    let points: Vec<[f32; 3]> = heights.iter().map(|z| [0.41, -0.47, *z]).collect();
    let mut column = vec![0.0; 300];
    let tables = ColumnTables::new(&field, &[0.41]);
    let row = tables.row(-0.47);
    row.column(0, 0.41, &mut ColumnRoom::default()).raw_at_heights(&heights, &mut column);
    for (got, want) in column.iter().zip(field.raw_densities(&points)) {
        assert!((got - want).abs() <= 1e-5 * want.abs().max(100.0), "{got} {want}");
    }
}
