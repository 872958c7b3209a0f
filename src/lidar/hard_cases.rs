//! Tile seams, half pixels, edges of validity, the polynomial where projections bend most, each naive
//! form beside ours; `docs/numerics.md`.

use super::resample::{Cells, EdgeRule, Kernel, Resampling, bilinear_row};
use super::*;
use crate::crs::{CrsSpec, Projection, ResolveOptions, resolve};
use crate::grid::{GeoTransform, ImageGrid, LonLat};
use crate::random::Draw;
use std::sync::Arc;

/// A raster of Seattle's lidar.
const ALKI: GeoTransform = GeoTransform::north_up(
    1_166_191.026_084_756_5,
    824_226.382_066_674_4,
    1.499_114_573_022,
    1.500_441_921_129,
);

/// The grid of a part of a raster, as `gdal_translate -srcwin` computes it.
fn cut(whole: &GeoTransform, cols: i64, rows: i64) -> GeoTransform {
    let mut part = *whole;
    part.0[0] += cols as f64 * whole.0[1];
    part.0[3] += rows as f64 * whole.0[5];
    part
}

#[test]
fn tiles_of_one_raster_share_its_lattice_wherever_their_corners_round() {
    const RASTERS: usize = 20_000;
    // Steps of the phase: 6e-8 pixels, and those of the finest tolerance.
    for (bits, apart) in [(PHASE_BITS, 20), (34, RASTERS / 10)] {
        let mut draw = Draw::new(&[1, u64::from(bits)]);
        let mut naive = 0;
        for _ in 0..RASTERS {
            let (west, north) = (draw.range(3e5, 7e5), draw.range(3e6, 6e6));
            let whole =
                GeoTransform::north_up(west, north, draw.range(0.1, 0.6), draw.range(0.1, 0.6));
            let (cols, rows) = (draw.index(20_000) as i64, draw.index(20_000) as i64);
            let part = cut(&whole, cols, rows);
            let (lattice, col, row) = Lattice::of(&whole, bits).expect("north-up");
            let place = (col + cols, row + rows);
            assert_eq!(lattice.cell_of(&part), Some(place), "{whole:?} {cols} {rows}");
            assert_eq!(lattice.cell_of(&whole), Some((col, row)));
            let (own, col, row) = Lattice::of(&part, bits).expect("north-up");
            naive += usize::from(own != lattice || (col, row) != place);
        }
        println!("{bits} bits: {naive} of {RASTERS} phases round apart");
        assert!(naive > apart, "phases that round apart: {naive} of {RASTERS} at {bits} bits");
    }
}

#[test]
fn another_raster_is_no_part_of_a_lattice() {
    let (lattice, col, row) = Lattice::of(&ALKI, PHASE_BITS).expect("north-up");
    let moved = |by: f64| {
        let mut other = ALKI;
        other.0[0] += by * ALKI.0[1];
        other
    };
    assert_eq!(lattice.cell_of(&moved(1e-9)), Some((col, row)));
    assert_eq!(lattice.cell_of(&moved(1e-6)), None);
    assert_eq!(lattice.cell_of(&moved(0.5)), None);
    let mut larger = ALKI;
    larger.0[1] *= 1.0 + 1e-12;
    assert_eq!(lattice.cell_of(&larger), None, "1e-12 of a pixel is 1e-6 at the origin");
    assert_eq!(lattice.cell_of(&GeoTransform([0.0, 1.5, 0.1, 0.0, 0.1, -1.5])), None);
}

#[test]
fn coordinates_from_a_tiles_own_corner_differ_between_tiles() {
    let east = cut(&ALKI, 4000, 0);
    let (lattice, ..) = Lattice::of(&ALKI, PHASE_BITS).expect("north-up");
    let (own, ..) = Lattice::of(&east, PHASE_BITS).expect("north-up");
    assert_eq!(own, lattice);
    let mut naive = 0;
    for k in 0..10_000 {
        let x = east.0[0] + f64::from(k) * 0.3;
        let (from_whole, from_part) = ((x - ALKI.0[0]) / ALKI.0[1], (x - east.0[0]) / east.0[1]);
        naive += u32::from(from_whole != from_part + 4000.0);
    }
    println!("own corners: {naive} of 10000 positions differ");
    assert!(naive > 5000, "{naive} of 10000 positions");
}

/// Heights `2 col + 3 row` of the cells' numbers, in a window far from the lattice's origin.
const COL: i64 = 1_000_000;
const ROW: i64 = 2_000_000;

fn plane() -> Vec<f32> {
    (0..64).map(|k| (2 * (k % 8) + 3 * (k / 8)) as f32).collect()
}

fn window(data: &[f32]) -> Cells<'_> {
    Cells { data, col: COL, row: ROW, width: 8, height: 8 }
}

fn bilinear(edge: EdgeRule) -> Kernel {
    Kernel::new(Resampling::Bilinear, edge, (0.2, 0.2), (1e-9, 1e-9))
}

/// Four taps with their weights, no questions asked; `centre` is where a cell's height stands in it.
fn naive_bilinear(cells: &Cells<'_>, (x, y): (f64, f64), centre: f64) -> f64 {
    let (x, y) = (x - cells.col as f64 - centre, y - cells.row as f64 - centre);
    let (left, top) = (x.floor(), y.floor());
    let (fx, fy) = (x - left, y - top);
    let tap = |dx: usize, dy: usize| {
        f64::from(cells.data[(top as usize + dy) * cells.width + left as usize + dx])
    };
    (tap(0, 0) * (1.0 - fx) + tap(1, 0) * fx) * (1.0 - fy)
        + (tap(0, 1) * (1.0 - fx) + tap(1, 1) * fx) * fy
}

fn row_of(kernel: &Kernel, cells: &Cells<'_>, points: &[(f64, f64)]) -> (Vec<f32>, u32) {
    let (xs, ys): (Vec<f64>, Vec<f64>) = points.iter().copied().unzip();
    let mut out = vec![0.0; points.len()];
    let flips = bilinear_row(kernel, cells, &xs, &ys, 1.0, &mut out);
    (out, flips)
}

#[test]
fn heights_stand_at_the_centres_of_cells() {
    let data = plane();
    let cells = window(&data);
    let kernel = bilinear(EdgeRule::Strict);
    let (mut half, mut narrow, mut ours) = (0.0_f64, 0.0_f64, 0.0_f64);
    for k in 0..200 {
        let (x, y) = (1.5 + f64::from(k) * 0.021, 1.5 + f64::from(k) * 0.017);
        let truth = 2.0 * (x - 0.5) + 3.0 * (y - 0.5);
        let at = (COL as f64 + x, ROW as f64 + y);
        let (found, _) = row_of(&kernel, &cells, &[at]);
        assert!((f64::from(found[0]) - truth).abs() < 2e-6, "{x} {y}: {} {truth}", found[0]);
        ours = ours.max((kernel.at_point(&cells, at.0, at.1).value - truth).abs());
        half = half.max((naive_bilinear(&cells, at, 0.0) - truth).abs());
        let in_f32 = (f64::from(at.0 as f32), f64::from(at.1 as f32));
        narrow = narrow.max((naive_bilinear(&cells, in_f32, 0.5) - truth).abs());
    }
    println!("from the corner {half} m, in f32 {narrow} m, ours {ours:.1e} m");
    assert!(ours < 3e-9, "{ours:e} m");
    // Half a pixel is (2 + 3) / 2 m here; f32 has steps of 1/16 and 1/8 of a cell this far out.
    assert!((half - 2.5).abs() < 1e-6, "{half} m");
    assert!(narrow > 0.2, "{narrow} m");
}

#[test]
fn a_height_is_its_cells_at_its_centre_and_continuous_across_borders() {
    let data = plane();
    let cells = window(&data);
    for edge in [EdgeRule::Strict, EdgeRule::Renormalise] {
        let kernel = bilinear(edge);
        for cell in 1..6 {
            let centre = (COL + cell) as f64 + 0.5;
            let (found, _) = row_of(&kernel, &cells, &[(centre, (ROW + cell) as f64 + 0.5)]);
            assert_eq!(found[0], data[cell as usize * 9], "a cell's own height, to the last bit");
            // One double to either side of a centre and of a border.
            for x in [centre, centre + 0.5] {
                let at = |x: f64| kernel.at_point(&cells, x, (ROW + cell) as f64 + 0.25).value;
                let jump = (at(x.next_up()) - at(x.next_down())).abs();
                assert!(jump < 1e-9, "{x}: {jump:e} m");
            }
        }
    }
}

#[test]
fn beside_a_hole_heights_neither_bleed_nor_vanish() {
    let mut data = vec![120.0_f32; 64];
    data[8 * 3 + 3] = f32::NAN;
    let mut marked = data.clone();
    marked[8 * 3 + 3] = -9999.0;
    let (cells, marked) = (window(&data), window(&marked));
    let (renormalised, strict) = (bilinear(EdgeRule::Renormalise), bilinear(EdgeRule::Strict));
    let at = |x: f64| (COL as f64 + x, ROW as f64 + 3.5);
    // From the centre of the cell before the hole to its border.
    for (x, naive_m) in [(2.5, 120.0), (2.51, 18.9), (2.75, -2409.0), (2.999_999, -4939.0)] {
        let (found, _) = row_of(&renormalised, &cells, &[at(x)]);
        assert_eq!(found[0], 120.0, "{x}");
        // A marker taken for a height is thousands of metres deep.
        let bled = naive_bilinear(&marked, at(x), 0.5);
        assert!((bled - naive_m).abs() < 1.0, "{x}: {bled} m");
        // NaN times a weight of 0 is NaN: the cell's own centre is lost.
        assert!(naive_bilinear(&cells, at(x), 0.5).is_nan(), "{x}");
        let (found, _) = row_of(&strict, &cells, &[at(x)]);
        assert_eq!(found[0].is_nan(), x > 2.5, "{x}: a tap without weight does not count");
    }
    // Within the bound of the border nobody can tell on which side a pixel lies; that is counted.
    for (x, invalid) in [(3.0 - 5e-10, false), (3.0 + 5e-10, true)] {
        let (found, flips) = row_of(&renormalised, &cells, &[at(x)]);
        assert_eq!(
            (found[0].is_nan(), renormalised.at_point(&cells, at(x).0, at(x).1).flips),
            (invalid, true)
        );
        assert_eq!(flips, 1);
    }
    assert_eq!(row_of(&renormalised, &cells, &[at(3.0 - 1e-7), at(3.0 + 1e-7)]).1, 0);
}

fn closed(epsg: u32) -> Arc<dyn Projection> {
    let resolved = resolve(&CrsSpec::from_epsg(epsg), &ResolveOptions::default());
    resolved.expect("in the table").projection
}

/// An image's way to cells of 0.5 units in a CRS.
fn fitted(epsg: u32, center: LonLat, zoom: u8, form: TransformForm) -> PixelMap {
    let grid = ImageGrid::new(center, zoom, 640, 640).expect("a grid");
    let projection = closed(epsg);
    let middle = projection.forward(center).expect("in the domain");
    let cells = GeoTransform::north_up(middle.x, middle.y, 0.5, 0.5);
    let (lattice, ..) = Lattice::of(&cells, PHASE_BITS).expect("north-up");
    let exact = PixelToCrs::WebMercator { grid, projection };
    PixelMap::fit(exact, lattice, form).expect("in the domain")
}

/// Largest distance of two forms over some rows, CRS units.
fn farthest(a: &PixelMap, b: &PixelMap) -> f64 {
    let (mut ac, mut ar, mut bc, mut br) = (vec![], vec![], vec![], vec![]);
    let mut worst: f64 = 0.0;
    for y in (0..640).step_by(71).chain([639]) {
        [&mut ac, &mut ar, &mut bc, &mut br].into_iter().for_each(Vec::clear);
        a.fill_row(y, 0..640, 0.5, &mut ac, &mut ar).expect("in the domain");
        b.fill_row(y, 0..640, 0.5, &mut bc, &mut br).expect("in the domain");
        for k in 0..640 {
            worst = worst.max(0.5 * libm::hypot(ac[k] - bc[k], ar[k] - br[k]));
        }
    }
    worst
}

#[test]
fn the_polynomial_keeps_its_bound_where_projections_bend_most() {
    // UTM near its pole and far from its meridian, Washington's cone near its apex and at the equator.
    for (epsg, lon_deg, lat_deg) in [
        (32_610, -122.3, 47.6),
        (32_610, -123.0, 84.5),
        (32_610, -90.0, 60.0),
        (32_601, -178.0, 70.0),
        (6598, -122.3, 84.5),
        (6598, -60.0, 2.0),
        (6598, 57.0, 84.0),
    ] {
        let center = LonLat { lon_deg, lat_deg };
        for zoom in [23, 20, 16, 12, 9] {
            let exact = fitted(epsg, center, zoom, TransformForm::Exact);
            for form in [TransformForm::Chebyshev, TransformForm::Separable, TransformForm::Affine]
            {
                let miss = farthest(&exact, &fitted(epsg, center, zoom, form));
                let bound = exact.errors().of(form);
                // Beside the rounding of coordinates of 10,000 km, there and in the bound.
                println!(
                    "EPSG:{epsg} {lat_deg} zoom {zoom} {form:?}: {miss:.1e}, bound {bound:.1e}"
                );
                assert!(
                    miss <= bound + 1e-8,
                    "EPSG:{epsg} {center:?} zoom {zoom} {form:?}: {miss:e} > {bound:e}"
                );
            }
        }
    }
}
