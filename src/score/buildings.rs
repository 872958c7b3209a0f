//! How high buildings are: each over the ground around it, so that no vertical offset matters.

use crate::eval::align::median;
use serde::{Deserialize, Serialize};

/// A component of fewer pixels is no building.
pub const LEAST_PX: usize = 60;
/// Ground up to this distance from a building is the ground around it, pixels.
pub const REACH_PX: usize = 12;
/// Fewer pixels of ground around it say nothing.
pub const LEAST_GROUND_PX: usize = 12;

/// Numbers of [`Sample::classes`](crate::scene::random::Sample::classes).
const GROUND: u8 = 0;
const BUILDING: u8 = 1;

/// A building, or the part of one that is in the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Building {
    /// Its pixels.
    pub pixels: usize,
    /// How high it is, metres.
    pub truth_m: f64,
    /// How high the prediction has it, metres.
    pub prediction_m: f64,
}

/// The buildings of an image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Buildings {
    /// In the order of their first pixels.
    pub list: Vec<Building>,
    /// How many more there are that have no ground around them.
    pub without_ground: u64,
}

/// The buildings of a square image: pixels of class building that share a side, at least [`LEAST_PX`] of them,
/// cut by the border or not. A building's height is the median over its pixels less that over the pixels of
/// class ground up to [`REACH_PX`] away; heights are metres over any datum, NaN is left out.
///
/// # Panics
/// When the lists do not hold `side * side` pixels.
#[must_use]
pub fn buildings(prediction: &[f32], truth: &[f32], classes: &[u8], side: usize) -> Buildings {
    let area = side * side;
    assert!([prediction.len(), truth.len(), classes.len()] == [area; 3], "{side} x {side} pixels");
    let mut found = Buildings::default();
    for pixels in components(classes, side).into_iter().filter(|pixels| pixels.len() >= LEAST_PX) {
        let ground = around(&pixels, classes, side);
        let height = |heights: &[f32]| middle(heights, &pixels) - middle(heights, &ground);
        let (truth_m, prediction_m) = (height(truth), height(prediction));
        if ground.len() < LEAST_GROUND_PX || !(truth_m.is_finite() && prediction_m.is_finite()) {
            found.without_ground += 1;
        } else {
            found.list.push(Building { pixels: pixels.len(), truth_m, prediction_m });
        }
    }
    found
}

/// Pixels of each component of class building, in the order of their first pixels.
fn components(classes: &[u8], side: usize) -> Vec<Vec<usize>> {
    let mut seen = vec![false; classes.len()];
    let mut all = Vec::new();
    for first in 0..classes.len() {
        if seen[first] || classes[first] != BUILDING {
            continue;
        }
        seen[first] = true;
        let mut pixels = vec![first];
        let mut next = 0;
        while let Some(&at) = pixels.get(next) {
            next += 1;
            let (row, column) = (at / side, at % side);
            let neighbours = [
                (column > 0).then(|| at - 1),
                (column + 1 < side).then_some(at + 1),
                (row > 0).then(|| at - side),
                (row + 1 < side).then_some(at + side),
            ];
            for neighbour in neighbours.into_iter().flatten() {
                if !seen[neighbour] && classes[neighbour] == BUILDING {
                    seen[neighbour] = true;
                    pixels.push(neighbour);
                }
            }
        }
        all.push(pixels);
    }
    all
}

/// Pixels of class ground up to [`REACH_PX`] from the nearest of a component's pixels, centre to centre.
fn around(pixels: &[usize], classes: &[u8], side: usize) -> Vec<usize> {
    // Columns to the nearest pixel of the component in the same row.
    let mut across = vec![usize::MAX; side * side];
    for at in pixels {
        across[*at] = 0;
    }
    for row in across.chunks_exact_mut(side) {
        for column in 1..side {
            row[column] = row[column].min(row[column - 1].saturating_add(1));
        }
        for column in (1..side).rev() {
            row[column - 1] = row[column - 1].min(row[column].saturating_add(1));
        }
    }
    let near = |at: usize| {
        let (row, column) = (at / side, at % side);
        let rows = row.saturating_sub(REACH_PX)..side.min(row + REACH_PX + 1);
        rows.into_iter().any(|other| {
            let (down, across) = (other.abs_diff(row), across[other * side + column]);
            across <= REACH_PX && down * down + across * across <= REACH_PX * REACH_PX
        })
    };
    (0..classes.len()).filter(|at| classes[*at] == GROUND && near(*at)).collect()
}

/// Median height of pixels; NaN without any.
fn middle(heights: &[f32], pixels: &[usize]) -> f64 {
    let known = pixels.iter().map(|at| f64::from(heights[*at])).filter(|height| !height.is_nan());
    median(&mut known.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 64;

    /// Ground at a height, and rectangles (rows, columns, height, class) on it.
    fn scene(ground: f32, parts: &[([usize; 4], f32, u8)]) -> (Vec<f32>, Vec<u8>) {
        let (mut heights, mut classes) = (vec![ground; SIDE * SIDE], vec![GROUND; SIDE * SIDE]);
        for ([top, bottom, left, right], height, class) in parts {
            for row in *top..*bottom {
                for column in *left..*right {
                    heights[row * SIDE + column] = ground + height;
                    classes[row * SIDE + column] = *class;
                }
            }
        }
        (heights, classes)
    }

    #[test]
    fn a_building_off_by_two_metres_whatever_the_datum() {
        let place = [20, 32, 20, 30];
        let (truth, classes) = scene(100.0, &[(place, 9.0, BUILDING)]);
        let (mut prediction, _) = scene(-3.0, &[(place, 7.0, BUILDING)]);
        // A chimney and a car change no median.
        prediction[25 * SIDE + 25] = 50.0;
        prediction[15 * SIDE + 15] = 50.0;
        let found = buildings(&prediction, &truth, &classes, SIDE);
        let building = Building { pixels: 120, truth_m: 9.0, prediction_m: 7.0 };
        assert_eq!(found, Buildings { list: vec![building], without_ground: 0 });
    }

    #[test]
    fn corners_do_not_join_and_small_ones_do_not_count() {
        let parts = [
            ([0, 8, 0, 8], 3.0, BUILDING),
            ([8, 16, 8, 16], 6.0, BUILDING),
            // 59 pixels in a row, too few; 60 on the border.
            ([40, 41, 0, 59], 5.0, BUILDING),
            ([63, 64, 4, 64], 4.0, BUILDING),
        ];
        let (truth, classes) = scene(0.0, &parts);
        let found = buildings(&truth, &truth, &classes, SIDE);
        let heights: Vec<f64> = found.list.iter().map(|building| building.truth_m).collect();
        assert_eq!(heights, [3.0, 6.0, 4.0]);
        assert!(found.list.iter().all(|building| building.truth_m == building.prediction_m));
    }

    #[test]
    fn ground_is_that_within_the_reach() {
        // A hall with a yard of height 2 around it up to 12 pixels, and a plateau beyond.
        let mut truth = vec![0.0; SIDE * SIDE];
        let mut classes = vec![GROUND; SIDE * SIDE];
        let hall =
            |row: usize, column: usize| (24..40).contains(&row) && (24..40).contains(&column);
        for row in 0..SIDE {
            for column in 0..SIDE {
                let apart = |at: usize| if at < 24 { 24 - at } else { at.saturating_sub(39) };
                let square = apart(row) * apart(row) + apart(column) * apart(column);
                let at = row * SIDE + column;
                truth[at] = if square <= 144 { 2.0 } else { 30.0 };
                if hall(row, column) {
                    (truth[at], classes[at]) = (12.0, BUILDING);
                }
            }
        }
        let hall: Vec<usize> = (0..SIDE * SIDE).filter(|at| classes[*at] == BUILDING).collect();
        let ring = around(&hall, &classes, SIDE);
        assert!(ring.iter().all(|at| truth[*at] == 2.0));
        let expected = truth.iter().filter(|height| **height == 2.0).count();
        assert_eq!(ring.len(), expected);
        assert_eq!(buildings(&truth, &truth, &classes, SIDE).list[0].truth_m, 10.0);
    }

    #[test]
    fn without_ground_around_it_a_building_has_no_height() {
        // In closed forest.
        let (truth, mut classes) = scene(0.0, &[([20, 30, 20, 30], 8.0, BUILDING)]);
        classes.iter_mut().filter(|class| **class == GROUND).for_each(|class| *class = 2);
        let found = buildings(&truth, &truth, &classes, SIDE);
        assert_eq!(found, Buildings { list: Vec::new(), without_ground: 1 });
        assert_eq!(buildings(&[], &[], &[], 0), Buildings::default());
    }

    #[test]
    fn heights_that_are_missing_are_left_out() {
        let place = [20, 32, 20, 30];
        let (truth, classes) = scene(0.0, &[(place, 9.0, BUILDING)]);
        let mut prediction = truth.clone();
        prediction[20 * SIDE + 20] = f32::NAN;
        assert_eq!(buildings(&prediction, &truth, &classes, SIDE).list[0].prediction_m, 9.0);
        prediction.fill(f32::NAN);
        assert_eq!(buildings(&prediction, &truth, &classes, SIDE).without_ground, 1);
    }
}
