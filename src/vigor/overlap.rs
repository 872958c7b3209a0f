//! How far overlapping images repeat the ground: exact areas of "covered at least k times".
//!
//! A sweep from west to east over the edges of the squares. A segment tree over their south and
//! north edges holds, for each stretch, how much of it is covered at least once, twice, ... up to
//! [`MAX_DEPTH`] times. The areas are exact up to the rounding of `f64`; the cost is
//! `O(n log n)` for `n` squares, however they lie.

use serde::Serialize;

/// Depths of cover that are told apart; deeper cover counts into the last.
pub const MAX_DEPTH: usize = 8;

/// An axis-aligned rectangle in any plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rectangle {
    /// Smallest x.
    pub x0: f64,
    /// Smallest y.
    pub y0: f64,
    /// Largest x.
    pub x1: f64,
    /// Largest y.
    pub y1: f64,
}

/// How rectangles cover a plane.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cover {
    /// Sum of the areas, in the plane's unit squared.
    pub total_area: f64,
    /// Area covered at least `k + 1` times; the first is the area of the union.
    pub area_at_least: [f64; MAX_DEPTH],
}

impl Cover {
    /// Measures how rectangles cover the plane. Empty or ill-formed rectangles cover nothing.
    #[must_use]
    pub fn of(rectangles: &[Rectangle]) -> Self {
        let good: Vec<Rectangle> =
            rectangles.iter().copied().filter(|r| r.x0 < r.x1 && r.y0 < r.y1).collect();
        let mut edges: Vec<f64> = good.iter().flat_map(|r| [r.y0, r.y1]).collect();
        edges.sort_by(f64::total_cmp);
        edges.dedup();
        let mut events: Vec<(f64, bool, usize)> = good
            .iter()
            .enumerate()
            .flat_map(|(i, r)| [(r.x0, true, i), (r.x1, false, i)])
            .collect();
        events.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)).then(a.2.cmp(&b.2)));

        let mut cover = Self { total_area: 0.0, area_at_least: [0.0; MAX_DEPTH] };
        for r in &good {
            cover.total_area += (r.x1 - r.x0) * (r.y1 - r.y0);
        }
        let Some(&(mut x, ..)) = events.first() else { return cover };
        let mut tree = Tree::new(edges);
        for (at, opens, i) in events {
            for (area, length) in cover.area_at_least.iter_mut().zip(tree.lengths()) {
                *area += length * (at - x);
            }
            x = at;
            tree.change(good[i].y0, good[i].y1, opens);
        }
        cover
    }

    /// Area of the union.
    #[must_use]
    pub const fn union_area(&self) -> f64 {
        self.area_at_least[0]
    }

    /// Mean number of rectangles over a covered point; `None` if nothing is covered.
    #[must_use]
    pub fn mean_depth(&self) -> Option<f64> {
        (self.union_area() > 0.0).then(|| self.total_area / self.union_area())
    }

    /// Share of the union that is covered at least `k` times (`k` from 1 to [`MAX_DEPTH`]).
    #[must_use]
    pub fn share_at_least(&self, k: usize) -> Option<f64> {
        let area = *self.area_at_least.get(k.checked_sub(1)?)?;
        (self.union_area() > 0.0).then(|| area / self.union_area())
    }
}

/// A segment tree over the stretches between neighbouring edges.
struct Tree {
    edges: Vec<f64>,
    /// Rectangles that cover a node's whole stretch and not its parent's.
    count: Vec<u32>,
    /// Length of a node's stretch covered at least `k + 1` times by what is in its subtree.
    lengths: Vec<[f64; MAX_DEPTH]>,
}

impl Tree {
    fn new(edges: Vec<f64>) -> Self {
        let nodes = 4 * edges.len();
        Self { edges, count: vec![0; nodes], lengths: vec![[0.0; MAX_DEPTH]; nodes] }
    }

    fn lengths(&self) -> [f64; MAX_DEPTH] {
        self.lengths[1]
    }

    fn change(&mut self, y0: f64, y1: f64, opens: bool) {
        let index = |y: f64| self.edges.partition_point(|e| *e < y);
        let (from, to) = (index(y0), index(y1));
        self.change_node(1, 0, self.edges.len() - 1, from, to, opens);
    }

    /// Node `node` stands for the stretch between edges `low` and `high`.
    fn change_node(
        &mut self,
        node: usize,
        low: usize,
        high: usize,
        from: usize,
        to: usize,
        opens: bool,
    ) {
        if from <= low && high <= to {
            if opens {
                self.count[node] += 1;
            } else {
                self.count[node] -= 1;
            }
        } else {
            let middle = low.midpoint(high);
            if from < middle {
                self.change_node(2 * node, low, middle, from, to, opens);
            }
            if to > middle {
                self.change_node(2 * node + 1, middle, high, from, to, opens);
            }
        }
        let count = self.count[node] as usize;
        let whole = self.edges[high] - self.edges[low];
        let is_leaf = high - low == 1;
        let (left, right) = (2 * node, 2 * node + 1);
        let lengths: [f64; MAX_DEPTH] = std::array::from_fn(|k| match k.checked_sub(count) {
            None => whole,
            Some(_) if is_leaf => 0.0,
            Some(deeper) => self.lengths[left][deeper] + self.lengths[right][deeper],
        });
        self.lengths[node] = lengths;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn square(x: f64, y: f64, side: f64) -> Rectangle {
        Rectangle { x0: x, y0: y, x1: x + side, y1: y + side }
    }

    #[test]
    fn closed_forms() {
        let none = Cover::of(&[]);
        assert_eq!((none.union_area(), none.mean_depth()), (0.0, None));
        let one = Cover::of(&[square(5.0, 5.0, 2.0)]);
        assert_eq!((one.union_area(), one.mean_depth()), (4.0, Some(1.0)));
        // Two squares that share half of each.
        let two = Cover::of(&[square(0.0, 0.0, 2.0), square(1.0, 0.0, 2.0)]);
        assert_eq!(two.area_at_least[..3], [6.0, 2.0, 0.0]);
        // Ten times the same: the depths beyond the last are not lost.
        let ten = Cover::of(&[square(0.0, 0.0, 1.0); 10]);
        assert_eq!(ten.area_at_least, [1.0; MAX_DEPTH]);
        assert_eq!(ten.mean_depth(), Some(10.0));
        // A lattice with a step of half a side, as VIGOR lays its images: four deep inside.
        let lattice: Vec<_> =
            (0..400).map(|i| square(f64::from(i % 20), f64::from(i / 20), 2.0)).collect();
        let cover = Cover::of(&lattice);
        assert_eq!(cover.area_at_least[..5], [441.0, 437.0, 361.0, 361.0, 0.0]);
    }

    #[test]
    fn ill_formed_rectangles_cover_nothing() {
        let nan = Rectangle { x0: f64::NAN, ..square(0.0, 0.0, 1.0) };
        let cover = Cover::of(&[nan, square(0.0, 0.0, 0.0), square(3.0, 3.0, -1.0)]);
        assert_eq!(cover.total_area, 0.0);
    }

    proptest! {
        /// Against counting unit cells.
        #[test]
        fn agrees_with_a_raster(
            cells in prop::collection::vec((0_u8..12, 0_u8..12, 1_u8..6, 1_u8..6), 0..30)
        ) {
            let mut depth = [[0_usize; 20]; 20];
            let mut rectangles = Vec::new();
            for &(x, y, w, h) in &cells {
                for column in &mut depth[x as usize..(x + w) as usize] {
                    for cell in &mut column[y as usize..(y + h) as usize] {
                        *cell += 1;
                    }
                }
                let f = f64::from;
                rectangles.push(Rectangle { x0: f(x), y0: f(y), x1: f(x + w), y1: f(y + h) });
            }
            let cover = Cover::of(&rectangles);
            for k in 1..=MAX_DEPTH {
                let cells = depth.iter().flatten().filter(|d| **d >= k).count();
                prop_assert_eq!(cover.area_at_least[k - 1], cells as f64);
            }
            let total: usize = depth.iter().flatten().sum();
            prop_assert_eq!(cover.total_area, total as f64);
        }
    }
}
