//! The endless pixel lattice that a raster is a window of.
//!
//! Coordinates of pixels are taken relative to the lattice and not to a tile's own corner, so that
//! the same ground point has the same coordinate, to the last bit, whichever tile it is read from.
//! That is what makes a raster cut into abutting tiles give the bytes of the uncut raster.

use crate::grid::{GeoTransform, PixelPoint, Projected};
use serde::{Deserialize, Serialize};

/// Binary digits of a pixel to which a tile's phase on the lattice is rounded. The corners of tiles
/// cut from one raster differ by rounding errors of some 1e-10 pixels; a step of 2^-24 = 6e-8
/// pixels (27 nanometres of a 1.5 ft pixel) absorbs them.
pub const PHASE_BITS: u32 = 24;

/// Roundings by which the corners and pixel sizes of two tiles of one raster may differ: those of a
/// product, a sum and the digits that a file keeps of either.
const ROUNDINGS: f64 = 4.0;

/// Pixel size and phase of a north-up lattice in one CRS.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lattice {
    /// Width of a pixel in CRS units.
    pub pixel_width: f64,
    /// Height of a pixel in CRS units (positive).
    pub pixel_height: f64,
    /// Column phase in units of 2^-bits pixels, `0 <= phase < 2^bits`.
    phase_x: i64,
    /// Row phase, likewise.
    phase_y: i64,
    /// Binary digits to which the phase is rounded.
    bits: u32,
}

/// A rectangle of lattice cells: first column and row, size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LatticeWindow {
    /// First column.
    pub col: i64,
    /// First row.
    pub row: i64,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl LatticeWindow {
    /// The common part of two windows, if any.
    #[must_use]
    pub fn intersection(&self, other: &Self) -> Option<Self> {
        let (col, row) = (self.col.max(other.col), self.row.max(other.row));
        let right = self.right().min(other.right());
        let bottom = self.bottom().min(other.bottom());
        (right > col && bottom > row).then(|| Self {
            col,
            row,
            width: (right - col) as usize,
            height: (bottom - row) as usize,
        })
    }

    /// First column beyond the window.
    #[must_use]
    pub const fn right(&self) -> i64 {
        self.col + self.width as i64
    }

    /// First row beyond the window.
    #[must_use]
    pub const fn bottom(&self) -> i64 {
        self.row + self.height as i64
    }

    /// Whether a lattice coordinate lies inside, at least `margin` cells from the edge.
    #[must_use]
    pub fn contains(&self, p: PixelPoint, margin: f64) -> bool {
        p.x >= self.col as f64 + margin
            && p.x <= self.right() as f64 - margin
            && p.y >= self.row as f64 + margin
            && p.y <= self.bottom() as f64 - margin
    }
}

impl Lattice {
    /// The lattice of a north-up raster and the cell of it at which the raster begins.
    ///
    /// `bits` is normally [`PHASE_BITS`]. Returns `None` for a raster that is not north-up.
    #[must_use]
    pub fn of(grid: &GeoTransform, bits: u32) -> Option<(Self, i64, i64)> {
        if !grid.is_north_up() {
            return None;
        }
        let (pixel_width, pixel_height) = (grid.0[1], -grid.0[5]);
        let steps = (1_i64 << bits) as f64;
        // Exact up to 2^53 steps: 5e8 pixels from the CRS's origin at 24 bits.
        let x = (grid.0[0] / pixel_width * steps).round() as i64;
        let y = (grid.0[3] / pixel_height * steps).round() as i64;
        let whole = 1_i64 << bits;
        let lattice = Self {
            pixel_width,
            pixel_height,
            phase_x: x.rem_euclid(whole),
            phase_y: y.rem_euclid(whole),
            bits,
        };
        Some((lattice, x.div_euclid(whole), -y.div_euclid(whole)))
    }

    /// The cell at which a raster begins, where it is a part of this lattice: its pixels are as large,
    /// and its corner is off a cell's by no more than rounding.
    ///
    /// That the two phases round to the same number is not asked: where the phase lies near the
    /// middle between two steps, the corners of tiles cut from one raster round to either.
    #[must_use]
    pub fn cell_of(&self, grid: &GeoTransform) -> Option<(i64, i64)> {
        let along = |pixel: f64, own: f64, corner: f64, phase: f64| {
            let cells = corner / own;
            let rounding = ROUNDINGS * f64::EPSILON;
            let cell = (cells - phase).round();
            let off = (cells - cell) - phase;
            let step = 0.5 / (1_i64 << self.bits) as f64;
            let is_part = (pixel / own - 1.0).abs() <= rounding
                && off.abs() <= step + rounding * cells.abs().max(1.0);
            is_part.then_some(cell as i64)
        };
        if !grid.is_north_up() {
            return None;
        }
        let steps = (1_i64 << self.bits) as f64;
        let [x, y] = [self.phase_x, self.phase_y].map(|phase| phase as f64 / steps);
        let col = along(grid.0[1], self.pixel_width, grid.0[0], x)?;
        let row = along(-grid.0[5], self.pixel_height, grid.0[3], y)?;
        Some((col, -row))
    }

    /// Largest displacement that rounding the phase can cause, CRS units.
    #[must_use]
    pub fn phase_bound(&self) -> f64 {
        libm::hypot(self.pixel_width, self.pixel_height) / (1_i64 << (self.bits + 1)) as f64
    }

    /// Binary digits to which the phase is rounded.
    #[must_use]
    pub const fn phase_bits(&self) -> u32 {
        self.bits
    }

    /// Largest displacement of a coordinate within `window`, CRS units: the phase's rounding, and
    /// that of `f64` so far from the CRS's origin (a quotient and a difference here, a quotient in
    /// the phase), which with a fine phase is the larger part.
    #[must_use]
    pub fn bound(&self, window: LatticeWindow) -> f64 {
        let far = |first: i64, beyond: i64| first.abs().max(beyond.abs()) as f64;
        let x = far(window.col, window.right()) * self.pixel_width;
        let y = far(window.row, window.bottom()) * self.pixel_height;
        self.phase_bound() + 1.5 * f64::EPSILON * libm::hypot(x, y)
    }

    /// Lattice coordinate of a position in CRS units: columns to the east, rows to the south.
    #[must_use]
    pub fn coordinate(&self, at: Projected) -> PixelPoint {
        let steps = (1_i64 << self.bits) as f64;
        PixelPoint {
            x: at.x / self.pixel_width - self.phase_x as f64 / steps,
            y: self.phase_y as f64 / steps - at.y / self.pixel_height,
        }
    }

    /// Position in CRS units of a lattice coordinate.
    #[must_use]
    pub fn position(&self, at: PixelPoint) -> Projected {
        let steps = (1_i64 << self.bits) as f64;
        Projected {
            x: (at.x + self.phase_x as f64 / steps) * self.pixel_width,
            y: (self.phase_y as f64 / steps - at.y) * self.pixel_height,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ALKI: GeoTransform = GeoTransform([
        1_166_191.026_084_756_5,
        1.499_114_573_022,
        0.0,
        824_226.382_066_674_4,
        0.0,
        -1.500_441_921_129,
    ]);

    #[test]
    fn a_tile_begins_where_its_corner_is() {
        let (lattice, col, row) = Lattice::of(&ALKI, PHASE_BITS).expect("north-up");
        let corner = lattice.coordinate(Projected { x: ALKI.0[0], y: ALKI.0[3] });
        assert!((corner.x - col as f64).abs() < 6e-8, "{} {col}", corner.x);
        assert!((corner.y - row as f64).abs() < 6e-8, "{} {row}", corner.y);
        assert!(lattice.phase_bound() * 0.3048 < 3e-8);
    }

    #[test]
    fn the_bound_of_a_window_is_that_of_its_phase_and_of_floats_at_its_far_corner() {
        let grid = GeoTransform::north_up(10.25, -3.125, 0.5, 4.0);
        let (lattice, ..) = Lattice::of(&grid, 24).expect("north-up");
        let phase = libm::hypot(0.5, 4.0) / f64::from(1 << 25);
        assert!((lattice.phase_bound() / phase - 1.0).abs() < 1e-12);
        for (col, row, far) in
            [(-700, 30, [-700.0, 90.0]), (2_000_000_000, -9, [2_000_000_040.0, 51.0])]
        {
            let window = LatticeWindow { col, row, width: 40, height: 60 };
            let expected = phase + 1.5 * f64::EPSILON * libm::hypot(far[0] * 0.5, far[1] * 4.0);
            let bound = lattice.bound(window);
            assert!((bound / expected - 1.0).abs() < 1e-12, "{bound} for {expected}");
        }
    }

    #[test]
    fn rotated_and_south_up_rasters_have_no_lattice() {
        assert!(Lattice::of(&GeoTransform([0.0, 1.0, 0.1, 0.0, 0.0, -1.0]), PHASE_BITS).is_none());
        assert!(Lattice::of(&GeoTransform([0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), PHASE_BITS).is_none());
    }

    #[test]
    fn the_phase_bound_is_half_a_step_of_both_axes() {
        let (lattice, ..) =
            Lattice::of(&GeoTransform([0.0, 3.0, 0.0, 0.0, 0.0, -4.0]), 10).expect("north-up");
        assert_eq!(lattice.phase_bound(), 5.0 / 2048.0);
    }

    #[test]
    fn a_window_contains_what_is_a_margin_away_from_every_edge() {
        let window = LatticeWindow { col: -3, row: 10, width: 8, height: 6 };
        let inside = |x, y| window.contains(PixelPoint { x, y }, 1.5);
        assert!(inside(-1.5, 11.5) && inside(3.5, 14.5) && inside(3.5, 11.5));
        assert!(!inside(-1.6, 12.0) && !inside(3.6, 12.0));
        assert!(!inside(0.0, 11.4) && !inside(0.0, 14.6));
        assert!(!inside(f64::NAN, 12.0) && !inside(0.0, f64::NAN));
    }

    proptest! {
        #[test]
        fn tiles_cut_from_one_raster_share_its_lattice(cols in 0_u32..20_000, rows in 0_u32..20_000) {
            let (whole, col, row) = Lattice::of(&ALKI, PHASE_BITS).expect("north-up");
            // As gdal_translate -srcwin computes a corner.
            let mut cut = ALKI;
            cut.0[0] += f64::from(cols) * ALKI.0[1];
            cut.0[3] += f64::from(rows) * ALKI.0[5];
            let (lattice, cut_col, cut_row) = Lattice::of(&cut, PHASE_BITS).expect("north-up");
            prop_assert_eq!(lattice, whole);
            prop_assert_eq!((cut_col, cut_row), (col + i64::from(cols), row + i64::from(rows)));
        }

        #[test]
        fn coordinate_and_position_are_inverse(x in -1e6..4e6_f64, y in -1e6..6e6_f64) {
            let (lattice, _, _) = Lattice::of(&ALKI, PHASE_BITS).expect("north-up");
            let back = lattice.position(lattice.coordinate(Projected { x, y }));
            prop_assert!((back.x - x).abs() < 5e-9 && (back.y - y).abs() < 5e-9);
        }

        #[test]
        fn windows_intersect_like_sets(
            a in (-9_i64..9, -9_i64..9, 1_usize..9, 1_usize..9), b in (-9_i64..9, -9_i64..9, 1_usize..9, 1_usize..9),
        ) {
            let window = |(col, row, width, height)| LatticeWindow { col, row, width, height };
            let (a, b) = (window(a), window(b));
            let inside = |w: &LatticeWindow, c, r| c >= w.col && c < w.right() && r >= w.row && r < w.bottom();
            let cut = a.intersection(&b);
            for c in -10..20 {
                for r in -10..20 {
                    let both = inside(&a, c, r) && inside(&b, c, r);
                    prop_assert_eq!(both, cut.is_some_and(|w| inside(&w, c, r)));
                }
            }
        }
    }
}
