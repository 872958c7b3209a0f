use super::*;
use crate::grid::{GeoTransform, Projected};
use crate::lidar::{Lattice, PixelToCrs, TransformForm};

#[test]
fn extremes_are_those_of_the_values_and_never_hide_what_is_not_finite() {
    let values: Vec<f64> = (0..37).map(|k| f64::from((k * 29) % 37) - 11.0).collect();
    assert_eq!(extremes(&values), (-11.0, 25.0));
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for at in [0, 7, 8, 36] {
            let mut values = values.clone();
            values[at] = bad;
            let (low, high) = extremes(&values);
            assert!(!low.is_finite() && !high.is_finite(), "{bad} at {at}");
        }
    }
}

#[test]
fn a_step_into_a_hole_is_no_step() {
    let a = [1.0, f32::NAN, 5.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 9.5];
    let b = [2.0, 900.0, f32::NAN, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0];
    assert_eq!(steepest_step(&a, &b), 7.5);
    assert_eq!(steepest_step(&[], &[]), 0.0);
}

#[test]
fn blocks_are_cut_down_to_single_pixels() {
    let mut blocks = vec![Block { x0: 3, x1: 10, y0: 1, y1: 6 }];
    let mut pixels = 0;
    while let Some(block) = blocks.pop() {
        match split(block) {
            Some(halves) => blocks.extend(halves),
            None => pixels += (block.x1 - block.x0) * (block.y1 - block.y0),
        }
    }
    assert_eq!(pixels, 35);
}

/// A raster in memory on the lattice of cells 2 wide and 0.5 high; its western half is tile 3.
struct Raster {
    extent: LatticeWindow,
    data: Vec<f32>,
}

impl Raster {
    fn of(extent: LatticeWindow, height: impl Fn(i64, i64) -> f32) -> Self {
        let data = (extent.row..extent.bottom())
            .flat_map(|row| (extent.col..extent.right()).map(move |col| (col, row)))
            .map(|(col, row)| height(col, row))
            .collect();
        Self { extent, data }
    }

    fn cells(&self) -> Cells<'_> {
        let LatticeWindow { col, row, width, height } = self.extent;
        Cells { data: &self.data, col, row, width, height }
    }

    fn id(&self, col: i64, row: i64) -> u16 {
        let place = LatticeWindow { col, row, width: 1, height: 1 };
        match self.extent.intersection(&place) {
            Some(_) if col < self.extent.col + self.extent.width as i64 / 2 => 3,
            Some(_) => 8,
            None => u16::MAX,
        }
    }
}

impl WindowSource for Raster {
    fn extent(&self) -> LatticeWindow {
        self.extent
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        ids: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        let places = (window.row..window.bottom())
            .flat_map(|row| (window.col..window.right()).map(move |col| (col, row)));
        let cell = |(col, row): (i64, i64)| {
            let at = (row - self.extent.row) as usize * self.extent.width;
            self.data[at + (col - self.extent.col) as usize]
        };
        for (out, at) in out.iter_mut().zip(places.clone()) {
            if self.id(at.0, at.1) != u16::MAX {
                *out = cell(at);
            }
        }
        for (id, (col, row)) in ids.into_iter().flatten().zip(places) {
            *id = self.id(col, row);
        }
        Ok(())
    }
}

/// An image whose pixel (0, 0) begins at cell `first` and whose pixels are `step` cells.
fn image(first: [f64; 2], step: [f64; 2], (width, height): (u32, u32)) -> PixelMap {
    let at = |x: f64, y: f64| Projected {
        x: 2.0 * (first[0] + x * step[0]),
        y: -0.5 * (first[1] + y * step[1]),
    };
    let (north_west, south_east) = (at(0.0, 0.0), at(width.into(), height.into()));
    let (lattice, ..) =
        Lattice::of(&GeoTransform::north_up(0.0, 0.0, 2.0, 0.5), 24).expect("a lattice");
    let exact = PixelToCrs::Box { north_west, south_east, width, height };
    PixelMap::fit(exact, lattice, TransformForm::Exact).expect("a map")
}

const SETTINGS: WarpSettings = WarpSettings {
    resampling: Resampling::Nearest,
    edge: EdgeRule::Renormalise,
    metres_per_unit: 0.25,
    horizontal_bound: 1e-3,
};

#[test]
fn a_warp_is_its_kernel_at_every_pixel_wherever_blocks_begin_and_tiles_end() {
    let extent = LatticeWindow { col: -20, row: 5, width: 60, height: 50 };
    let raster = Raster::of(extent, |col, row| {
        if (col * 7 + row * 3) % 19 == 0 { f32::NAN } else { ((col * 37 + row * 23) % 41) as f32 }
    });
    let (width, height) = (52, 70);
    let mut flips = 0;
    // Finer than the raster, coarser along columns, and with centres a hair beside borders of cells.
    for (first, step) in [
        ([-25.0, 3.0], [0.9375, 0.75]),
        ([-24.5, 0.25], [1.5, 0.875]),
        ([-24.499_8, 3.251], [1.0, 0.5]),
    ] {
        let map = image(first, step, (width, height));
        let at = |x: f64, y: f64| (first[0] + x * step[0], first[1] + y * step[1]);
        for resampling in
            [Resampling::Nearest, Resampling::Bilinear, Resampling::Cubic, Resampling::Average]
        {
            let settings = WarpSettings { resampling, ..SETTINGS };
            let average = resampling == Resampling::Average;
            let kernel = Kernel::new(resampling, settings.edge, (step[0], step[1]), (5e-4, 2e-3));
            let pixels = (width * height) as usize;
            let (mut out, mut ids) = (vec![-1.0; pixels], vec![1; pixels]);
            let seen = warp(&map, &raster, &settings, &mut out, Some(&mut ids)).expect("warps");
            let (mut valid, mut uncertain) = (0, 0);
            for (k, (value, id)) in out.iter().zip(ids).enumerate() {
                let (x, y) = (f64::from(k as u32 % width), f64::from(k as u32 / width));
                let (centre, cells) = (at(x + 0.5, y + 0.5), raster.cells());
                let expected = if average {
                    kernel.average(&cells, at(x, y), at(x + 1.0, y + 1.0))
                } else {
                    kernel.at_point(&cells, centre.0, centre.1)
                };
                let metres = (0.25 * expected.value) as f32;
                let same = (metres - value).abs() < 1e-5 || metres.is_nan() && value.is_nan();
                assert!(same, "{resampling:?} {step:?} pixel {x} {y}: {value} for {metres}");
                // Of an average, the cell half a cell from the pixel's corner.
                let (c, r) = if average { (at(x, y).0 + 0.5, at(x, y).1 + 0.5) } else { centre };
                let own = raster.id(c.floor() as i64, r.floor() as i64);
                assert_eq!(id, if value.is_nan() { u16::MAX } else { own }, "pixel {x} {y}");
                valid += u64::from(!value.is_nan());
                uncertain += u64::from(expected.flips);
            }
            assert_eq!((seen.valid, seen.uncertain), (valid, uncertain), "{resampling:?}");
            assert!(valid > 1_000, "{valid}");
            flips += uncertain;
        }
    }
    assert!(flips > 500, "{flips}");
}

#[test]
fn the_steepest_step_counts_in_units_of_the_crs_along_both_axes() {
    let extent = LatticeWindow { col: 0, row: 0, width: 40, height: 80 };
    // Walls of 6 between columns 19 and 20 and of -4 between rows 69 and 70.
    let raster = Raster::of(extent, |col, row| {
        (if col < 20 { 0.0 } else { 6.0 }) + (if row < 70 { 4.0 } else { 0.0 })
    });
    let mut out = vec![0.0; 40 * 80];
    let map = image([0.0, 0.0], [1.0, 1.0], (40, 80));
    let seen = warp(&map, &raster, &SETTINGS, &mut out, None).expect("warps");
    assert_eq!(seen.steepest, libm::hypot(6.0 / 2.0, 4.0 / 0.5));
    // Beside both walls there is no step.
    let map = image([2.0, 2.0], [1.0, 1.0], (10, 10));
    let seen = warp(&map, &raster, &SETTINGS, &mut out[..100], None).expect("warps");
    assert_eq!(seen.steepest, 0.0);
}

#[test]
fn beside_the_raster_there_is_nothing() {
    let extent = LatticeWindow { col: 0, row: 0, width: 4, height: 4 };
    let raster = Raster::of(extent, |_, _| 1.0);
    let (mut out, mut ids) = (vec![5.0; 6], vec![5; 6]);
    let map = image([-90.0, 0.0], [1.0, 1.0], (3, 2));
    let seen = warp(&map, &raster, &SETTINGS, &mut out, Some(&mut ids)).expect("warps");
    assert_eq!(seen, WarpStatistics::default());
    assert!(out.iter().all(|v| v.is_nan()) && ids.iter().all(|&id| id == u16::MAX));
}

#[test]
fn a_window_is_cut_until_it_fits_and_one_pixel_that_does_not_fit_is_an_error() {
    let extent = LatticeWindow { col: 0, row: 0, width: 9_000, height: 2 };
    let raster = Raster::of(extent, |col, row| (col + 10_000 * row) as f32);
    let map = image([0.0, -3_000.0], [3_000.0, 2_000.0], (3, 3));
    let (mut out, mut ids) = (vec![0.0; 9], vec![1; 9]);
    let settings = WarpSettings { metres_per_unit: 1.0, ..SETTINGS };
    // Pixel (x, y) has its centre in cell 3000 x + 1500, 2000 y - 2000: only the middle row is in the raster.
    warp(&map, &raster, &settings, &mut out, Some(&mut ids)).expect("warps");
    assert!(out[..3].iter().chain(&out[6..]).all(|v| v.is_nan()), "{out:?}");
    assert_eq!(out[3..6], [1_500.0, 4_500.0, 7_500.0]);
    const NO: u16 = u16::MAX;
    assert_eq!(ids, [NO, NO, NO, 3, 8, 8, NO, NO, NO]);
    let settings = WarpSettings { resampling: Resampling::Average, ..settings };
    let error = warp(&map, &raster, &settings, &mut out, None);
    let Err(WarpError::TooCoarse { cells, limit }) = error else { panic!("{error:?}") };
    // The pixel's corners and a cell beyond each.
    assert_eq!((cells, limit), (3_003 * 2_003, 1 << 22));
}

#[test]
fn beside_holes_the_range_of_what_is_left_of_four_cells_counts_twice() {
    const HOLE: f32 = f32::NAN;
    // No hole; a hole with three, two, one and no cells beside it.
    assert_eq!(range_beside_holes(&[1.0, 9.0, 5.0, 3.0], 2), 0.0);
    assert_eq!(range_beside_holes(&[1.0, 9.0, 5.0, HOLE], 2), 8.0);
    assert_eq!(range_beside_holes(&[HOLE, 9.0, 5.0, HOLE], 2), 4.0);
    assert_eq!(range_beside_holes(&[HOLE, 9.0, HOLE, HOLE], 2), 0.0);
    assert_eq!(range_beside_holes(&[HOLE; 4], 2), 0.0);
    // Cells 2 wide and 0.5 high. A hole in the corner of a plane that rises by 3 a column.
    let extent = LatticeWindow { col: 0, row: 0, width: 40, height: 40 };
    let raster = Raster::of(extent, |col, row| match (col, row) {
        (20, 20) => HOLE,
        _ => 3.0 * col as f32,
    });
    let mut out = vec![0.0; 40 * 40];
    let map = image([0.0, 0.0], [1.0, 1.0], (40, 40));
    for (resampling, steepest) in [
        // Twice the range of 3, as a step along both axes.
        (Resampling::Bilinear, libm::hypot(6.0 / 2.0, 6.0 / 0.5)),
        (Resampling::Average, 3.0 / 2.0),
    ] {
        let settings = WarpSettings { resampling, ..SETTINGS };
        let seen = warp(&map, &raster, &settings, &mut out, None).expect("warps");
        assert!((seen.steepest - steepest).abs() < 1e-12, "{resampling:?}: {}", seen.steepest);
    }
}

#[test]
fn a_mean_is_as_steep_as_its_narrowest_pixel_lets_it_be() {
    let extent = LatticeWindow { col: 0, row: 0, width: 60, height: 60 };
    let raster = Raster::of(extent, |col, row| (col * row % 7) as f32);
    let mut out = vec![0.0; 30 * 20];
    let settings = WarpSettings { resampling: Resampling::Average, ..SETTINGS };
    for step in [[1.5, 0.75], [0.5, 2.5]] {
        let map = image([3.0, 2.0], step, (30, 20));
        let seen = warp(&map, &raster, &settings, &mut out, None).expect("warps");
        let factor = seen.slope_factor.expect("no steps");
        let expected = 1.0 + 1.0 / step[0].min(step[1]);
        assert!((factor - expected).abs() < 1e-9, "{step:?}: {factor} for {expected}");
    }
}
