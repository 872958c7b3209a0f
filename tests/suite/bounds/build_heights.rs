//! Heights of `dsm-bench build`: the step `kernel`, and what a displacement within a horizontal
//! bound does to a height and to the borders of valid data.

use super::{Share, draw};
use sat3d::grid::{GeoTransform, Projected};
use sat3d::lidar::{
    EdgeRule, Lattice, LatticeWindow, PHASE_BITS, PixelMap, PixelToCrs, Resampling, TransformForm,
    WarpSettings, WarpStatistics, WindowSource, warp,
};
use sat3d::random::Draw;
use sat3d::raster::RasterError;
use std::cell::Cell;

const KERNELS: [Resampling; 4] =
    [Resampling::Nearest, Resampling::Bilinear, Resampling::Cubic, Resampling::Average];
const SIDE: u32 = 24;

/// Cells from a formula.
struct Cells<F> {
    extent: LatticeWindow,
    height: F,
    read: Cell<u64>,
}

impl<F: Fn(i64, i64) -> f32> WindowSource for Cells<F> {
    fn extent(&self) -> LatticeWindow {
        self.extent
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        _: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        self.read.set(self.read.get() + out.len() as u64);
        for (k, out) in (0_i64..).zip(out) {
            let (col, row) = (k % window.width as i64, k / window.width as i64);
            let (col, row) = (window.col + col, window.row + row);
            let cell = LatticeWindow { col, row, width: 1, height: 1 };
            *out = match cell.intersection(&self.extent) {
                Some(_) => (self.height)(col, row),
                None => f32::NAN,
            };
        }
        Ok(())
    }
}

fn cells<F: Fn(i64, i64) -> f32>(height: F) -> Cells<F> {
    let extent = LatticeWindow { col: -200, row: -200, width: 400, height: 400 };
    Cells { extent, height, read: Cell::new(0) }
}

/// Walls, slopes, noise, and holes of a share of the cells: a pure function of the cell.
fn scene(seed: u64, holes: f64) -> impl Fn(i64, i64) -> f32 {
    let mut of_scene = draw(seed);
    let (slope, wall, rough) =
        (of_scene.range(-3.0, 3.0), of_scene.range(0.0, 60.0), of_scene.pick([0.0, 0.0, 8.0]));
    let patch = of_scene.pick([1, 2, 5]);
    move |col, row| {
        let of = |purpose: u64, col: i64, row: i64| {
            Draw::new(&[seed, purpose, col.cast_unsigned(), row.cast_unsigned()])
        };
        let hole = of(1, col.div_euclid(patch), row.div_euclid(patch)).unit() < holes;
        let house = (col.div_euclid(7) + row.div_euclid(5)) % 2 == 0;
        let z = slope * col as f64 - 0.4 * row as f64
            + f64::from(u8::from(house)) * wall
            + rough * of(2, col, row).unit();
        if hole { f32::NAN } else { z as f32 }
    }
}

/// An image over a box that is so displaced.
fn image(west: f64, north: f64, pixel: f64, by: [f64; 2]) -> PixelToCrs {
    let side = f64::from(SIDE) * pixel;
    PixelToCrs::Box {
        north_west: Projected { x: west + by[0], y: north + by[1] },
        south_east: Projected { x: west + side + by[0], y: north - side + by[1] },
        width: SIDE,
        height: SIDE,
    }
}

/// One cell per CRS unit, the north-west corner at the origin.
fn lattice() -> Lattice {
    Lattice::of(&GeoTransform::north_up(0.0, 0.0, 1.0, 1.0), PHASE_BITS).expect("north-up").0
}

fn warped(
    image: PixelToCrs,
    source: &dyn WindowSource,
    resampling: Resampling,
    edge: EdgeRule,
    horizontal_bound: f64,
) -> (Vec<f32>, WarpStatistics) {
    let map = PixelMap::fit(image, lattice(), TransformForm::Exact).expect("a box");
    let settings = WarpSettings { resampling, edge, metres_per_unit: 1.0, horizontal_bound };
    let mut out = vec![0.0; (SIDE * SIDE) as usize];
    let statistics = warp(&map, source, &settings, &mut out, None).expect("warps");
    (out, statistics)
}

/// What the rounding to 32 bits may add to a difference of two heights.
fn rounding(a: f32, b: f32) -> f64 {
    f64::from(a.abs().max(b.abs())) * f64::from(f32::EPSILON)
}

/// Moves an image by no more than a bound: heights differ by no more than the bound times the
/// steepest gradient times the kernel's factor, but for pixels that were counted as uncertain.
fn displaced(
    kernel: Resampling,
    edge: EdgeRule,
    holes: f64,
    share: &mut Share,
    counted: &mut Share,
) {
    for k in 0..150_u64 {
        let mut draw = draw(1000 + k);
        let source = cells(scene(k, holes));
        // Finer and coarser than the cells, the widened kernels among them.
        let pixel = draw.pick([0.2, 0.31, 0.97, 1.06, 1.5, 3.2]);
        let (west, north) = (draw.range(-40.0, 20.0), draw.range(-20.0, 40.0));
        let bound = draw.pick([1e-7, 1e-3, 0.05, 0.3, 0.5, 1.4, 4.7]);
        let (angle, length) = (draw.range(0.0, 6.3), bound * draw.pick([1.0, 0.6]));
        let by = [length * libm::cos(angle), length * libm::sin(angle)];
        let (a, seen) = warped(image(west, north, pixel, [0.0; 2]), &source, kernel, edge, bound);
        let (b, _) = warped(image(west, north, pixel, by), &source, kernel, edge, bound);
        let limit = seen.slope_factor.map(|factor| factor * seen.steepest * bound);
        // Where weights are shared out anew over what is left of a wide support, a gradient says
        // nothing: the bound is stated for supports without holes.
        let wide =
            kernel == Resampling::Average || (pixel > 1.0 / 0.95 && kernel != Resampling::Nearest);
        let (mut beyond, mut worst) = (0, 0.0_f64);
        for (a, b) in a.iter().zip(&b) {
            let miss = (f64::from(*a) - f64::from(*b)).abs() - rounding(*a, *b);
            let flips = a.is_nan() != b.is_nan();
            let steeper = limit.is_some_and(|limit| miss > limit) && !(wide && holes > 0.0);
            beyond += u64::from(flips || steeper);
            if !flips && !a.is_nan() && !steeper {
                worst = worst.max(miss);
            }
        }
        let at = || format!("scene {k}, {kernel:?}, {edge:?}, pixel {pixel}, {by:?} of {bound}");
        if holes == 0.0
            && let Some(limit) = limit
        {
            assert_eq!((beyond, seen.uncertain), (0, 0), "{}", at());
            share.add(worst, limit.max(f64::MIN_POSITIVE), at);
        } else {
            counted.add(beyond as f64, seen.uncertain as f64, at);
        }
    }
}

#[test]
pub fn a_displacement_moves_no_height_beyond_the_bound_times_the_gradient() {
    for kernel in KERNELS {
        for edge in [EdgeRule::Renormalise, EdgeRule::Strict] {
            let name = format!("{} {edge:?}", kernel.name()).to_lowercase();
            let mut share = Share::new(&format!("height of a displacement, {name}"));
            let mut counted = Share::new(&format!("pixels beyond it beside no-data, {name}"));
            displaced(kernel, edge, 0.0, &mut share, &mut counted);
            displaced(kernel, edge, 0.15, &mut share, &mut counted);
            if kernel != Resampling::Nearest {
                share.check();
            }
            counted.check();
        }
    }
}

/// The kernels by their definition: weights over all cells of the source, in f64.
fn by_definition(kernel: Resampling, height: impl Fn(i64, i64) -> f32, x: f64, y: f64) -> f64 {
    let keys = |d: f64| match d.abs() {
        d if d <= 1.0 => 1.5 * d * d * d - 2.5 * d * d + 1.0,
        d if d < 2.0 => -0.5 * d * d * d + 2.5 * d * d - 4.0 * d + 2.0,
        _ => 0.0,
    };
    let weight = |d: f64| match kernel {
        Resampling::Cubic => keys(d),
        _ => (1.0 - d.abs()).max(0.0),
    };
    let (col, row) = (x.floor() as i64, y.floor() as i64);
    if kernel == Resampling::Nearest {
        return f64::from(height(col, row));
    }
    (row - 3..row + 4)
        .flat_map(|row| (col - 3..col + 4).map(move |col| (col, row)))
        .map(|(col, row)| {
            let weight = weight(x - col as f64 - 0.5) * weight(y - row as f64 - 0.5);
            if weight == 0.0 { 0.0 } else { weight * f64::from(height(col, row)) }
        })
        .sum()
}

#[test]
pub fn kernels_are_their_definition_but_for_the_rounding_to_32_bits() {
    let mut share = Share::new("kernel");
    for k in 0..60 {
        let mut draw = draw(k);
        let (west, north, pixel) = (draw.range(-40.0, 20.0), draw.range(-20.0, 40.0), 0.31);
        for kernel in [Resampling::Nearest, Resampling::Bilinear, Resampling::Cubic] {
            let source = cells(scene(k, 0.0));
            let map = image(west, north, pixel, [0.0; 2]);
            let (out, _) = warped(map, &source, kernel, EdgeRule::Renormalise, 0.0);
            for (i, z) in (0..).zip(out) {
                let x = west + (f64::from(i % SIDE) + 0.5) * pixel;
                let y = -(north - (f64::from(i / SIDE) + 0.5) * pixel);
                let truth = by_definition(kernel, scene(k, 0.0), x, y);
                // Half a step of 32 bits, and the rounding of the position at a slope of 100.
                let bound = f64::from(z.abs()) * f64::from(f32::EPSILON) / 2.0 + 1e-11;
                share.add((f64::from(z) - truth).abs(), bound, || format!("scene {k}, {kernel:?}"));
            }
        }
    }
    share.check();
}

#[test]
pub fn a_plane_is_a_plane_whatever_the_kernel() {
    let mut share = Share::new("kernel, on planes");
    for k in 0..40 {
        let mut draw = draw(k);
        let (sx, sy) = (draw.range(-8.0, 8.0), draw.range(-8.0, 8.0));
        let plane = move |x: f64, y: f64| 40.0 + sx * x + sy * y;
        let height = move |col: i64, row: i64| plane(col as f64 + 0.5, row as f64 + 0.5) as f32;
        let (west, north, pixel) = (draw.range(-40.0, 20.0), draw.range(-20.0, 40.0), 0.23);
        for kernel in [Resampling::Bilinear, Resampling::Cubic] {
            let source = cells(height);
            let map = image(west, north, pixel, [0.0; 2]);
            let (out, _) = warped(map, &source, kernel, EdgeRule::Renormalise, 0.0);
            for (i, z) in (0..).zip(out) {
                let x = west + (f64::from(i % SIDE) + 0.5) * pixel;
                let y = -(north - (f64::from(i / SIDE) + 0.5) * pixel);
                // The cells are rounded too; cubic weights sum to 1.56 in absolute value.
                let highest = 40.0 + 70.0 * (sx.abs() + sy.abs());
                let bound = 1.5 * highest * f64::from(f32::EPSILON);
                let error = (f64::from(z) - plane(x, y)).abs();
                share.add(error, bound, || format!("plane {sx} {sy}, {kernel:?}"));
            }
        }
    }
    share.check();
}

#[test]
pub fn a_smaller_kernel_reads_fewer_cells() {
    let read = |kernel, bound| {
        let source = cells(scene(1, 0.0));
        warped(image(0.0, 0.0, 0.3, [0.0; 2]), &source, kernel, EdgeRule::Renormalise, bound);
        source.read.get()
    };
    let [nearest, bilinear, cubic, _] = KERNELS.map(|kernel| read(kernel, 1e-6));
    assert!(nearest < bilinear && bilinear < cubic, "{nearest} {bilinear} {cubic}");
    // A datum step left out is paid for with the cells within its bound.
    assert!(read(Resampling::Bilinear, 4.0) > bilinear);
}
