use super::*;
use proptest::prelude::*;

fn kernel(resampling: Resampling) -> Kernel {
    Kernel::new(resampling, EdgeRule::Renormalise, (0.2, 0.2), (1e-9, 1e-9))
}

fn plane(width: usize, height: usize) -> Vec<f32> {
    (0..width * height).map(|k| 2.0 * (k % width) as f32 - 3.0 * (k / width) as f32 + 7.0).collect()
}

fn cells(data: &[f32], width: usize) -> Cells<'_> {
    Cells { data, col: 100, row: -50, width, height: data.len() / width }
}

#[test]
fn keys_kernel_is_an_interpolating_partition_of_unity() {
    assert_eq!(keys(0.0), 1.0);
    for k in 1..3 {
        assert_eq!(keys(f64::from(k)), 0.0);
    }
    for k in 0..=100 {
        let f = f64::from(k) / 100.0;
        assert!((keys(1.0 + f) + keys(f) + keys(1.0 - f) + keys(2.0 - f) - 1.0).abs() < 1e-14);
    }
}

#[test]
fn a_valid_tap_that_is_not_the_nearest_does_not_bleed() {
    let mut data = plane(4, 4);
    data[5] = f32::NAN; // cell (101, -49)
    let cells = cells(&data, 4);
    let k = kernel(Resampling::Bilinear);
    assert!(k.at_point(&cells, 101.9, -48.1).value.is_nan(), "inside the invalid cell");
    let beside = k.at_point(&cells, 102.1, -48.5).value;
    assert_eq!(beside, 2.0 * 2.0 - 3.0 + 7.0, "only the valid neighbour counts");
    let strict = Kernel { edge: EdgeRule::Strict, ..k };
    assert!(strict.at_point(&cells, 102.1, -48.5).value.is_nan());
}

#[test]
fn validity_that_hangs_on_rounding_is_noticed() {
    let mut data = plane(4, 4);
    data[5] = f32::NAN;
    let cells = cells(&data, 4);
    let k = kernel(Resampling::Bilinear);
    assert!(k.at_point(&cells, 102.0 + 1e-10, -48.5).flips);
    assert!(k.at_point(&cells, 102.0 - 1e-10, -48.5).flips);
    assert!(!k.at_point(&cells, 102.001, -48.5).flips);
}

#[test]
fn a_border_hangs_on_rounding_along_both_axes_and_only_beside_another_validity() {
    let mut data = plane(4, 4);
    data[5] = f32::NAN; // cell (101, -49)
    let cells = cells(&data, 4);
    let k = Kernel { flip_x: 1e-3, flip_y: 0.1, ..kernel(Resampling::Nearest) };
    let flips = |x, y| k.at_point(&cells, x, y).flips;
    for (x, y) in [(101.5, -49.05), (101.5, -48.95), (101.5, -48.05), (101.5, -47.95)] {
        assert!(flips(x, y), "{x} {y}");
    }
    for (x, y) in [(102.000_5, -48.5), (101.999_5, -48.5), (101.000_5, -48.5), (100.999_5, -48.5)] {
        assert!(flips(x, y), "{x} {y}");
    }
    // Too far from the border, or beside cells that are alike.
    for (x, y) in
        [(101.5, -49.15), (101.5, -48.15), (102.05, -48.5), (100.95, -48.5), (102.95, -46.95)]
    {
        assert!(!flips(x, y), "{x} {y}");
    }
}

/// Cells whose holes follow no pattern.
fn pitted(width: usize, height: usize) -> Vec<f32> {
    let hole = |k: usize| (k * 7919 + k * k * 31) % 11 < 4;
    (0..width * height).map(|k| if hole(k) { f32::NAN } else { k as f32 }).collect()
}

#[test]
fn a_rectangle_is_mixed_where_counting_its_cells_one_by_one_finds_both() {
    let data = pitted(9, 6);
    let cells = cells(&data, 9);
    let mut holes = Holes::default();
    // What a former window left behind does not count.
    holes.count(&Cells { data: &data[..8], col: 0, row: 0, width: 4, height: 2 });
    holes.count(&cells);
    let mut found = [0, 0];
    for top in -53..-43 {
        for bottom in top..-42 {
            for left in 97..111 {
                for right in left..112 {
                    let places = (top..=bottom).flat_map(|r| (left..=right).map(move |c| (c, r)));
                    let data = places.clone().filter(|&(c, r)| !cells.at(c, r).is_nan()).count();
                    let expected = data > 0 && data < places.count();
                    let mixed = holes.mixed((left, right), (top, bottom));
                    assert_eq!(
                        mixed, expected,
                        "columns {left} to {right}, rows {top} to {bottom}"
                    );
                    found[usize::from(mixed)] += 1;
                }
            }
        }
    }
    assert!(found[0] > 1000 && found[1] > 1000, "{found:?}");
}

#[test]
fn a_hole_counts_where_it_lies_among_the_taps_and_nowhere_else() {
    use {EdgeRule::*, Resampling::*};
    let at = [(103.2, -46.8), (103.7, -46.3)];
    for hole in 0..64_i64 {
        let mut data = plane(8, 8);
        data[hole as usize] = f32::NAN;
        let cells = cells(&data, 8);
        let (col, row) = (100 + hole % 8, -50 + hole / 8);
        for (x, y) in at {
            let distance = |v: f64, cell: i64| (v - (cell as f64 + 0.5)).abs();
            let apart = distance(x, col).max(distance(y, row));
            let own = (col, row) == (x.floor() as i64, y.floor() as i64);
            for (resampling, edge, reach, beside) in [
                (Nearest, Strict, 0.0, Support::None),
                (Bilinear, Renormalise, 0.0, Support::None),
                (Bilinear, Strict, 1.0, Support::None),
                (Cubic, Renormalise, 2.0, Support::Part),
                (Cubic, Strict, 2.0, Support::None),
            ] {
                let expected = match (own, apart < reach) {
                    (true, _) => Support::None,
                    (false, true) => beside,
                    (false, false) => Support::Whole,
                };
                let k = Kernel { edge, ..kernel(resampling) };
                let found = k.support(&cells, x, y);
                assert_eq!(found, expected, "{resampling:?} {edge:?}: hole {col} {row}, {x} {y}");
            }
        }
    }
}

#[test]
fn a_point_that_may_move_far_flips_where_its_box_reaches_a_hole() {
    let mut data = plane(9, 9);
    data[4 * 9 + 4] = f32::NAN; // cell (104, -46)
    let cells = cells(&data, 9);
    let mut holes = Holes::default();
    holes.count(&cells);
    for (resampling, edge, taps) in [
        (Resampling::Bilinear, EdgeRule::Renormalise, 0.0),
        (Resampling::Bilinear, EdgeRule::Strict, 1.0),
        (Resampling::Cubic, EdgeRule::Renormalise, 2.0),
    ] {
        let k = Kernel::new(resampling, edge, (0.5, 0.5), (0.75, 0.6));
        let (reach_x, reach_y) = (0.75 + taps, 0.6 + taps);
        for step in 0..=160 {
            let way = f64::from(step) * 0.05 + 0.013;
            for (a, b) in [
                ((100.5 + way, -45.5), (100.5 + way, -45.5)),
                ((104.5, -49.5 + way), (104.5, -49.5 + way)),
                // A pixel 0.8 wide, its corners in either order.
                ((101.3 + way, -45.5), (100.5 + way, -45.5)),
            ] {
                let inside = |low: f64, high: f64, reach: f64, cell: f64| {
                    (low - reach).floor() <= cell && cell <= (high + reach).floor()
                };
                let expected = inside(a.0.min(b.0), a.0.max(b.0), reach_x, 104.0)
                    && inside(a.1.min(b.1), a.1.max(b.1), reach_y, -46.0);
                let found = k.flips_far(&holes, a, b);
                // Beyond the window there are holes too.
                let near_window = a.0.min(b.0) - reach_x < 100.0
                    || a.0.max(b.0) + reach_x >= 109.0
                    || a.1 - reach_y < -50.0
                    || a.1 + reach_y >= -41.0;
                assert_eq!(found, expected || near_window, "{resampling:?} {edge:?} {a:?} {b:?}");
            }
        }
    }
}

#[test]
fn surfaces_are_as_many_times_steeper_than_their_cells_as_stated() {
    let factor = |resampling, width| kernel(resampling).slope_factor(width);
    assert_eq!(factor(Resampling::Nearest, 1.0), None);
    assert_eq!(factor(Resampling::Bilinear, 1.0), Some(1.0));
    assert_eq!(factor(Resampling::Cubic, 1.0), Some(2.5));
    assert_eq!([0.25, 4.0].map(|w| factor(Resampling::Average, w)), [Some(5.0), Some(1.25)]);
    let wide = Kernel::new(Resampling::Bilinear, EdgeRule::Strict, (3.0, 1.0), (0.0, 0.0));
    assert_eq!(wide.slope_factor(1.0), Some(2.0));
}

#[test]
fn weights_that_cancel_make_no_value() {
    let k = kernel(Resampling::Cubic);
    assert_eq!(k.weighted([(5.0, 0.5), (7.0, 0.5)]), 6.0);
    assert_eq!(k.weighted([(5.0, 2e-6), (f64::NAN, 0.9)]), 5.0);
    for weight in [9e-7, 0.0, -0.2] {
        assert!(k.weighted([(5.0, weight), (f64::NAN, 0.9)]).is_nan(), "{weight}");
    }
}

#[test]
fn kernels_widen_beyond_095_pixels_per_cell_and_margins_hold_their_taps() {
    use Resampling::{Average, Bilinear, Cubic, Nearest};
    let margin = |r, cells| Kernel::new(r, EdgeRule::Strict, cells, (0.0, 0.0)).margin();
    let plain =
        |cells| Kernel::new(Bilinear, EdgeRule::Strict, cells, (0.0, 0.0)).is_plain_bilinear();
    assert!(plain((1.05, 1.05)) && !plain((1.06, 0.2)) && !plain((0.2, 1.06)));
    assert!(!kernel(Cubic).is_plain_bilinear());
    assert_eq!(margin(Nearest, (4.0, 4.0)), (1, 1));
    assert_eq!(margin(Average, (4.0, 4.0)), (1, 1));
    assert_eq!((margin(Bilinear, (0.1, 1.0)), margin(Cubic, (0.1, 1.0))), ((2, 2), (3, 3)));
    assert_eq!((margin(Bilinear, (2.5, 0.5)), margin(Cubic, (0.5, 2.25))), ((4, 2), (3, 6)));
}

#[test]
fn a_widened_kernel_is_its_weighted_mean_over_all_valid_cells() {
    let mut data: Vec<f32> = (0..400).map(|k| ((k * 7919) % 1009) as f32 / 8.0).collect();
    for hole in [0, 105, 188, 191, 255] {
        data[hole] = f32::NAN;
    }
    let cells = cells(&data, 20);
    for resampling in [Resampling::Bilinear, Resampling::Cubic] {
        let ratio = (1.75, 2.5);
        let k = Kernel::new(resampling, EdgeRule::Renormalise, ratio, (0.0, 0.0));
        for (x, y) in [(110.2, -40.3), (109.9, -39.6), (106.5, -42.5), (113.0, -36.0)] {
            let weight = |d: f64| {
                if resampling == Resampling::Cubic { keys(d) } else { (1.0 - d.abs()).max(0.0) }
            };
            let (mut sum, mut total) = (0.0, 0.0);
            for (at, value) in data.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
                let (cx, cy) = ((at % 20) as f64 + 100.5, (at / 20) as f64 - 49.5);
                let w = weight((cx - x) / ratio.0) * weight((cy - y) / ratio.1);
                (sum, total) = (sum + w * f64::from(*value), total + w);
            }
            let found = k.at_point(&cells, x, y).value;
            assert!((found - sum / total).abs() < 1e-11, "{resampling:?} {x} {y}: {found}");
        }
    }
}

#[test]
fn a_mean_hangs_on_rounding_where_a_sliver_of_a_cell_decides() {
    let mut data = plane(4, 4);
    data[5] = f32::NAN; // cell (101, -49)
    let cells = cells(&data, 4);
    let k = Kernel { flip_x: 0.01, flip_y: 0.1, ..kernel(Resampling::Average) };
    let mean = |x: (f64, f64), y: (f64, f64)| k.average(&cells, (x.0, y.0), (x.1, y.1));
    for (x, y, valid, flips) in [
        ((101.2, 101.8), (-48.8, -48.2), false, false),
        ((101.2, 101.995), (-48.8, -48.2), false, true),
        ((101.005, 101.8), (-48.8, -48.2), false, true),
        ((101.2, 101.8), (-48.95, -48.2), false, true),
        ((101.2, 101.8), (-48.8, -48.05), false, true),
        ((101.2, 102.005), (-48.8, -48.2), true, true),
        ((101.2, 102.02), (-48.8, -48.2), true, false),
        ((100.995, 101.8), (-48.8, -48.2), true, true),
        ((101.2, 101.8), (-49.05, -48.2), true, true),
        ((101.2, 101.8), (-49.15, -48.2), true, false),
    ] {
        let sample = mean(x, y);
        assert_eq!((!sample.value.is_nan(), sample.flips), (valid, flips), "{x:?} {y:?}");
        // The corners may come in any order.
        let turned = k.average(&cells, (x.1, y.0), (x.0, y.1));
        assert!(turned == sample || turned.value.is_nan() && turned.flips == flips);
    }
}

#[test]
fn cubic_falls_back_to_bilinear_beside_a_hole() {
    let mut data: Vec<f32> = (0..64).map(|k| ((k * 37) % 17) as f32).collect();
    let full = data.clone();
    data[9] = f32::NAN;
    let (x, y) = (103.2, -46.9);
    let (c, b) = (kernel(Resampling::Cubic), kernel(Resampling::Bilinear));
    let value = c.at_point(&cells(&data, 8), x - 0.5, y - 0.5).value;
    assert_eq!(value, b.at_point(&cells(&data, 8), x - 0.5, y - 0.5).value);
    assert_ne!(value, c.at_point(&cells(&full, 8), x - 0.5, y - 0.5).value);
}

#[test]
fn average_weighs_cells_by_coverage() {
    let data = [1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
    let cells = Cells { data: &data, col: 0, row: 0, width: 3, height: 3 };
    let k = kernel(Resampling::Average);
    assert_eq!(k.average(&cells, (0.0, 0.0), (3.0, 3.0)).value, 5.0);
    assert_eq!(k.average(&cells, (0.5, 0.0), (2.0, 1.0)).value, (0.5 * 1.0 + 2.0) / 1.5);
    assert_eq!(k.average(&cells, (1.2, 1.2), (1.3, 1.3)).value, 5.0, "inside one cell");
    let mut hole = data;
    hole[4] = f32::NAN;
    let cells = Cells { data: &hole, ..cells };
    assert!(k.average(&cells, (1.2, 1.2), (1.3, 1.3)).value.is_nan());
    assert_eq!(k.average(&cells, (0.0, 0.0), (3.0, 3.0)).value, 5.0);
}

proptest! {
    #[test]
    fn every_kernel_reproduces_a_plane(x in 107.0..113.0_f64, y in -43.0..-37.0_f64, ratio in 0.1..2.5_f64) {
        let data = plane(20, 20);
        let cells = cells(&data, 20);
        // The value at the centre of cell (0, 0) is 7.
        let truth = 2.0 * (x - 100.5) - 3.0 * (y + 49.5) + 7.0;
        for resampling in [Resampling::Bilinear, Resampling::Cubic] {
            let k = Kernel::new(resampling, EdgeRule::Strict, (ratio, ratio), (0.0, 0.0));
            let value = k.at_point(&cells, x, y).value;
            // A widened kernel sampled at whole cells keeps the mean of a plane only nearly.
            let bound = if ratio > 1.0 / 0.95 { 0.7 } else { 1e-12 };
            prop_assert!((value - truth).abs() < bound, "{resampling:?} {ratio}: {value} {truth}");
        }
        let k = kernel(Resampling::Average);
        let value = k.average(&cells, (x - 0.5, y - 0.5), (x + 0.5, y + 0.5)).value;
        prop_assert!((value - truth).abs() < 1e-9);
    }

    #[test]
    fn the_quick_row_is_the_slow_point(
        points in proptest::collection::vec((101.0..118.9_f64, -49.0..-31.1_f64), 1..40),
        holes in proptest::collection::vec(0_usize..400, 0..60),
    ) {
        let mut data: Vec<f32> = (0..400).map(|k| ((k * 7919) % 1009) as f32 / 8.0).collect();
        for hole in holes {
            data[hole] = f32::NAN;
        }
        let cells = cells(&data, 20);
        let k = kernel(Resampling::Bilinear);
        let (xs, ys): (Vec<_>, Vec<_>) = points.into_iter().unzip();
        let mut out = vec![0.0_f32; xs.len()];
        bilinear_row(&k, &cells, &xs, &ys, 0.3048, &mut out);
        for ((out, &x), &y) in out.iter().zip(&xs).zip(&ys) {
            let slow = (k.at_point(&cells, x, y).value * 0.3048) as f32;
            prop_assert!(
                (out.is_nan() && slow.is_nan()) || (out - slow).abs() <= 2e-5 * slow.abs().max(1.0),
                "{out} {slow}"
            );
        }
    }
}
