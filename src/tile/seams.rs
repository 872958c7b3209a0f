//! The seam measure: height jumps across the borders of windows against all others.
//!
//! Windows that see different surroundings disagree, and a seam is where one of them begins or ends. So the
//! jumps between neighbouring pixels there are compared with those everywhere else in the same raster:
//! without seams both are alike, and their ratio is 1.

use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Jumps are counted in bins of a millimetre, the last bin for all above: 95th percentiles are exact to half
/// of it.
const BINS_PER_M: f64 = 1000.0;
/// Bins up to 262 m, several times the height of a scene.
const BINS: usize = 1 << 18;

/// Windows of a run along both axes, after trimming: which pixels each one gives.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Windows {
    /// Columns of each window.
    pub x: Vec<Range<u32>>,
    /// Rows of each window.
    pub y: Vec<Range<u32>>,
}

impl Windows {
    /// Windows of `side` pixels at these first columns and rows.
    #[must_use]
    pub fn of_starts(x: &[u32], y: &[u32], side: u32) -> Self {
        let ranges =
            |starts: &[u32]| starts.iter().map(|&at| at..at.saturating_add(side)).collect();
        Self { x: ranges(x), y: ranges(y) }
    }
}

/// Height differences, without sign, between neighbouring pixels that both have a height.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Jumps {
    /// Pairs of pixels.
    pub count: u64,
    /// Mean, metres; `None` without pairs.
    pub mean_m: Option<f64>,
    /// The smallest jump that 95 of 100 pairs do not exceed, metres, rounded to the millimetre; `None`
    /// without pairs.
    pub p95_m: Option<f64>,
}

/// Jumps at the borders of windows and elsewhere, across and down taken together.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeamMeasure {
    /// Between pixels of which one lies in a window's first or last column or row, the other just outside.
    pub across_border: Jumps,
    /// Between all other neighbours.
    pub inside: Jumps,
    /// Mean across borders over mean inside: 1 without seams. `None` where one of them has no pairs, or the
    /// inside is flat.
    pub ratio: Option<f64>,
}

/// Measures seams while rows come, from north to south.
#[derive(Debug)]
pub struct SeamCounter {
    width: usize,
    /// Whether a border lies just before a column.
    columns: Vec<bool>,
    /// Likewise before a row.
    rows: Vec<bool>,
    /// Rows taken.
    taken: usize,
    last_row: Vec<f32>,
    across_border: Tally,
    inside: Tally,
}

impl SeamCounter {
    /// Of a raster of `size` columns and rows.
    #[must_use]
    pub fn new(size: [u32; 2], windows: &Windows) -> Self {
        Self {
            width: size[0] as usize,
            columns: borders(size[0], &windows.x),
            rows: borders(size[1], &windows.y),
            taken: 0,
            last_row: Vec::new(),
            across_border: Tally::new(),
            inside: Tally::new(),
        }
    }

    /// Takes the next rows (whole ones, row-major); NaN is no height. Rows beyond the raster's do not count.
    pub fn add(&mut self, rows: &[f32]) {
        for row in rows.chunks_exact(self.width.max(1)) {
            let Some(&border) = self.rows.get(self.taken) else { return };
            // Sums of a row first: few roundings, and always in the same order.
            let (mut at, mut off) = (0.0, 0.0);
            for (pair, &border) in row.windows(2).zip(&self.columns[1..]) {
                let (tally, sum) = match border {
                    true => (&mut self.across_border, &mut at),
                    false => (&mut self.inside, &mut off),
                };
                tally.count(pair[0], pair[1], sum);
            }
            let (tally, sum) = match border {
                true => (&mut self.across_border, &mut at),
                false => (&mut self.inside, &mut off),
            };
            // Before the first row there is none.
            for (&above, &below) in self.last_row.iter().zip(row) {
                tally.count(above, below, sum);
            }
            self.across_border.sum += at;
            self.inside.sum += off;
            self.last_row.clear();
            self.last_row.extend_from_slice(row);
            self.taken += 1;
        }
    }

    /// The measure of all rows taken.
    #[must_use]
    pub fn finish(&self) -> SeamMeasure {
        let (across_border, inside) = (self.across_border.jumps(), self.inside.jumps());
        let ratio = match (across_border.mean_m, inside.mean_m) {
            (Some(at), Some(off)) if off > 0.0 => Some(at / off),
            _ => None,
        };
        SeamMeasure { across_border, inside, ratio }
    }
}

/// Whether a window begins or ends between a pixel and the one before it; the raster's own edges are none.
fn borders(length: u32, windows: &[Range<u32>]) -> Vec<bool> {
    let mut borders = vec![false; length as usize];
    for at in windows.iter().flat_map(|window| [window.start, window.end]) {
        if let Some(border) = borders.get_mut(at as usize).filter(|_| at > 0) {
            *border = true;
        }
    }
    borders
}

/// Jumps of one kind.
#[derive(Debug)]
struct Tally {
    sum: f64,
    bins: Vec<u64>,
}

impl Tally {
    fn new() -> Self {
        Self { sum: 0.0, bins: vec![0; BINS] }
    }

    fn count(&mut self, a: f32, b: f32, sum: &mut f64) {
        let jump = (f64::from(a) - f64::from(b)).abs();
        if !jump.is_nan() {
            *sum += jump;
            self.bins[((jump * BINS_PER_M + 0.5) as usize).min(BINS - 1)] += 1;
        }
    }

    fn jumps(&self) -> Jumps {
        let count: u64 = self.bins.iter().sum();
        if count == 0 {
            return Jumps { count, mean_m: None, p95_m: None };
        }
        // So many pairs must not exceed it; in whole numbers.
        let rank = (u128::from(count) * 95).div_ceil(100);
        let mut seen = 0_u128;
        let p95 = self.bins.iter().position(|bin| {
            seen += u128::from(*bin);
            seen >= rank
        });
        let p95_m = p95.map(|bin| bin as f64 / BINS_PER_M);
        Jumps { count, mean_m: Some(self.sum / count as f64), p95_m }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;

    fn measure(
        size: [u32; 2],
        windows: &Windows,
        height: impl FnMut([u32; 2]) -> f32,
    ) -> SeamMeasure {
        let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| [x, y]));
        let heights: Vec<f32> = pixels.map(height).collect();
        let mut whole = SeamCounter::new(size, windows);
        whole.add(&heights);
        let mut parts = SeamCounter::new(size, windows);
        heights.chunks(3 * size[0] as usize).for_each(|rows| parts.add(rows));
        assert_eq!(whole.finish(), parts.finish(), "the measure does not depend on how rows come");
        whole.finish()
    }

    /// 300 x 200 pixels in windows of 64 by 32; the last ones are snapped to the edge.
    fn windows() -> Windows {
        let starts = |length: u32| -> Vec<u32> {
            (0..length - 64).step_by(32).chain([length - 64]).collect()
        };
        Windows::of_starts(&starts(300), &starts(200), 64)
    }

    #[test]
    fn a_plane_has_no_seams() {
        let m = measure([300, 200], &windows(), |[x, y]| 0.5 * x as f32 - 0.25 * y as f32);
        // Starts at 32 to 224 and 236, ends at 64 to 288 besides; down 32 to 128, 136, 160 and 192.
        let (columns, rows) = (10, 7);
        assert_eq!(m.across_border.count, columns * 200 + rows * 300);
        assert_eq!(m.across_border.count + m.inside.count, 299 * 200 + 199 * 300);
        assert_eq!(m.inside.p95_m, Some(0.5));
        let at = (columns * 200) as f64 * 0.5 + (rows * 300) as f64 * 0.25;
        assert_eq!(m.across_border.mean_m, Some(at / m.across_border.count as f64));
    }

    #[test]
    fn a_known_step_at_borders_is_measured() {
        let windows = Windows { x: vec![0..40, 40..100], y: std::iter::once(0..50).collect() };
        let m =
            measure([100, 50], &windows, |[x, _]| 0.01 * x as f32 + if x < 40 { 0.0 } else { 2.0 });
        assert_eq!(m.across_border.count, 50);
        assert!((m.across_border.mean_m.expect("pairs") - 2.01).abs() < 1e-6);
        assert_eq!(m.across_border.p95_m, Some(2.01));
        // Half of the pairs inside are down, where nothing changes.
        let inside = m.inside;
        assert_eq!((inside.count, inside.p95_m), (98 * 50 + 49 * 100, Some(0.01)));
        let mean = 0.01 * (98.0 * 50.0) / inside.count as f64;
        assert!((inside.mean_m.expect("pairs") - mean).abs() < 1e-7);
        assert!((m.ratio.expect("both") - 2.01 / mean).abs() < 1e-2);
    }

    #[test]
    fn noise_has_a_ratio_of_one() {
        let mut draw = Draw::new(&[7]);
        let m = measure([300, 200], &windows(), |_| draw.unit() as f32 * 10.0);
        // |a - b| of uniform numbers: mean 1/3, 95 of 100 below 1 - sqrt(0.05).
        let ratio = m.ratio.expect("both");
        assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
        assert!((m.inside.mean_m.expect("pairs") - 10.0 / 3.0).abs() < 0.03);
        assert!((m.inside.p95_m.expect("pairs") - 7.764).abs() < 0.05);
    }

    #[test]
    fn holes_and_empty_rasters_have_no_pairs() {
        let nan = |[x, y]: [u32; 2]| if (x + y) % 2 == 0 { f32::NAN } else { 1.0 };
        let m = measure([10, 10], &Windows::of_starts(&[0, 5], &[0], 5), nan);
        let none = Jumps { count: 0, mean_m: None, p95_m: None };
        assert_eq!(m, SeamMeasure { across_border: none, inside: none, ratio: None });
        let flat = measure([10, 10], &Windows::default(), |_| 4.0);
        assert_eq!((flat.across_border, flat.inside.mean_m, flat.ratio), (none, Some(0.0), None));
        let one = measure([1, 1], &Windows::of_starts(&[0], &[0], 256), |_| 4.0);
        assert_eq!(one.inside, none);
        let json = serde_json::to_string(&m).expect("JSON");
        assert_eq!(serde_json::from_str::<SeamMeasure>(&json).expect("comes back"), m);
    }

    #[test]
    fn heights_beyond_all_bins_are_in_the_last() {
        let m = measure([2, 1], &Windows::default(), |[x, _]| x as f32 * 1e6);
        assert_eq!(m.inside.mean_m, Some(1e6));
        assert_eq!(m.inside.p95_m, Some((BINS - 1) as f64 / BINS_PER_M));
    }
}
