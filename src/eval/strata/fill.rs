//! Filling polygons: which pixel centres lie inside, by the even-odd rule.

/// Calls `fill` with every run of pixels (row, first column, column beyond the last) whose centres
/// lie inside a polygon of closed rings, in pixels of an image of the given size; holes are rings
/// like any other.
///
/// A centre on a boundary counts as inside where the polygon lies to the east, or on a horizontal
/// boundary to the south, so that polygons that share a boundary never share a pixel.
pub(super) fn fill<'a>(
    rings: impl Iterator<Item = &'a [[f64; 2]]>,
    (width, height): (usize, usize),
    crossings: &mut Vec<(usize, f64)>,
    mut fill: impl FnMut(usize, usize, usize),
) {
    crossings.clear();
    for ring in rings {
        for edge in ring.windows(2) {
            let ([x0, y0], [x1, y1]) = (edge[0], edge[1]);
            // Rows whose centre line the edge crosses: its upper end belongs to it, its lower does not.
            let first = (y0.min(y1) - 0.5).ceil().max(0.0);
            let beyond = (y0.max(y1) - 0.5).ceil().min(height as f64);
            let mut row = first;
            while row < beyond {
                crossings.push((row as usize, crossing([x0, y0], [x1, y1], row + 0.5)));
                row += 1.0;
            }
        }
    }
    crossings.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    // Rings are closed, so every row is crossed an even number of times.
    for pair in crossings.chunks_exact(2) {
        let column = |x: f64| (x - 0.5).ceil().clamp(0.0, width as f64) as usize;
        let (from, to) = (column(pair[0].1), column(pair[1].1));
        if from < to {
            fill(pair[0].0, from, to);
        }
    }
}

/// Where an edge crosses a horizontal line.
fn crossing([x0, y0]: [f64; 2], [x1, y1]: [f64; 2], y: f64) -> f64 {
    x0 + (y - y0) / (y1 - y0) * (x1 - x0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;
    use proptest::prelude::*;

    fn filled(rings: &[Vec<[f64; 2]>], width: usize, height: usize) -> Vec<u8> {
        let mut out = vec![0; width * height];
        fill(rings.iter().map(Vec::as_slice), (width, height), &mut Vec::new(), |y, from, to| {
            for pixel in &mut out[y * width + from..y * width + to] {
                *pixel += 1;
            }
        });
        out
    }

    /// Even-odd by definition: edges to the west of the centre.
    fn inside(rings: &[Vec<[f64; 2]>], x: f64, y: f64) -> bool {
        let edges = rings.iter().flat_map(|ring| ring.windows(2));
        let west =
            edges.filter(|e| (e[0][1] <= y) != (e[1][1] <= y) && crossing(e[0], e[1], y) <= x);
        west.count() % 2 == 1
    }

    fn closed(mut ring: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
        ring.push(ring[0]);
        ring
    }

    proptest! {
        #[test]
        fn every_pixel_is_what_the_point_test_says(
            seed in any::<u64>(), rings in 1_usize..4, corners in 3_usize..30, snap in any::<bool>(),
        ) {
            let mut draw = Draw::new(&[seed]);
            let mut place = |low: f64, high: f64| {
                let v = draw.range(low, high);
                if snap { (v * 2.0).round() / 2.0 } else { v }
            };
            // Self-crossing, outside, over one another; snapped ones pass through centres.
            let rings: Vec<_> = (0..rings)
                .map(|_| closed((0..corners).map(|_| [place(-9.0, 40.0), place(-9.0, 30.0)]).collect()))
                .collect();
            let found = filled(&rings, 31, 19);
            for (k, found) in found.iter().enumerate() {
                let (x, y) = ((k % 31) as f64 + 0.5, (k / 31) as f64 + 0.5);
                prop_assert_eq!(*found == 1, inside(&rings, x, y), "{} {}", x, y);
                prop_assert!(*found < 2);
            }
        }
    }

    #[test]
    fn neighbours_share_no_pixel_and_leave_none_out() {
        let mut draw = Draw::new(&[3]);
        let line: Vec<[f64; 2]> = (0..=20)
            .map(|k| [(draw.range(4.0, 12.0) * 2.0).round() / 2.0, f64::from(k) * 0.5])
            .collect();
        let west = closed([vec![[0.0, 0.0]], line.clone(), vec![[0.0, 10.0]]].concat());
        let east = closed([vec![[20.0, 0.0]], line, vec![[20.0, 10.0]]].concat());
        let (west, east) = (filled(&[west], 20, 10), filled(&[east], 20, 10));
        assert!(west.iter().zip(&east).all(|(a, b)| a + b == 1));
    }

    #[test]
    fn holes_are_left_out_and_what_is_flat_or_outside_fills_nothing() {
        let square = |a: f64, b: f64| closed(vec![[a, a], [b, a], [b, b], [a, b]]);
        let found = filled(&[square(1.0, 9.0), square(3.0, 6.0)], 10, 10);
        assert_eq!(found.iter().filter(|v| **v == 1).count(), 64 - 9);
        assert!(filled(&[square(4.0, 4.0)], 10, 10).iter().all(|v| *v == 0));
        assert!(filled(&[square(40.0, 50.0)], 10, 10).iter().all(|v| *v == 0));
        assert!(filled(&[square(-1e12, 1e12)], 10, 10).iter().all(|v| *v == 1));
    }
}
