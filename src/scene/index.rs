//! A uniform grid over things with a box: which of them may be over a point, or along a ray.

use super::shape::Bounds;
use std::ops::ControlFlow;

/// Side of a cell, metres: about the size of a tree or a room.
const CELL_M: f64 = 6.0;

/// The grid. Cells hold numbers of things, in the order in which the things were given.
#[derive(Clone, Debug)]
pub struct CellGrid {
    west: f64,
    south: f64,
    columns: usize,
    rows: usize,
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl CellGrid {
    /// A grid over `area` of things with these boxes; what lies outside the area is not found.
    #[must_use]
    pub fn new(area: Bounds, boxes: &[Bounds]) -> Self {
        let columns = ((area.east - area.west) / CELL_M).ceil().max(1.0) as usize;
        let rows = ((area.north - area.south) / CELL_M).ceil().max(1.0) as usize;
        let mut grid = Self {
            west: area.west,
            south: area.south,
            columns,
            rows,
            starts: vec![0; columns * rows + 1],
            items: Vec::new(),
        };
        for b in boxes {
            grid.each_cell_of(b, |starts, _, cell| starts[cell + 1] += 1);
        }
        for cell in 0..columns * rows {
            grid.starts[cell + 1] += grid.starts[cell];
        }
        grid.items = vec![0; grid.starts[columns * rows] as usize];
        let mut next = grid.starts.clone();
        for (item, b) in boxes.iter().enumerate() {
            grid.each_cell_of(b, |_, items, cell| {
                items[next[cell] as usize] = item as u32;
                next[cell] += 1;
            });
        }
        grid
    }

    fn each_cell_of(
        &mut self,
        b: &Bounds,
        mut visit: impl FnMut(&mut Vec<u32>, &mut Vec<u32>, usize),
    ) {
        let clamp = |v: f64, n: usize| (v.max(-1.0) as isize).clamp(-1, n as isize);
        let cell = |v: f64, origin: f64| ((v - origin) / CELL_M).floor();
        let c0 = clamp(cell(b.west, self.west), self.columns).max(0) as usize;
        let r0 = clamp(cell(b.south, self.south), self.rows).max(0) as usize;
        let c1 = clamp(cell(b.east, self.west), self.columns);
        let r1 = clamp(cell(b.north, self.south), self.rows);
        if c1 < 0 || r1 < 0 {
            return;
        }
        for row in r0..(r1 as usize + 1).min(self.rows) {
            for column in c0..(c1 as usize + 1).min(self.columns) {
                visit(&mut self.starts, &mut self.items, row * self.columns + column);
            }
        }
    }

    /// Number of cells.
    #[must_use]
    pub fn cells(&self) -> usize {
        self.columns * self.rows
    }

    /// Things that may touch a cell.
    #[must_use]
    pub fn in_cell(&self, cell: usize) -> &[u32] {
        &self.items[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// Things that may be over a point.
    #[must_use]
    pub fn over(&self, x: f64, y: f64) -> &[u32] {
        let (c, r) = ((x - self.west) / CELL_M, (y - self.south) / CELL_M);
        if c < 0.0 || r < 0.0 || c >= self.columns as f64 || r >= self.rows as f64 {
            return &[];
        }
        self.in_cell(r as usize * self.columns + c as usize)
    }

    /// Visits the cells that the segment `(x, y) + t (dx, dy)`, `0 <= t <= end`, crosses, in order,
    /// with the parameters where it comes in and goes out, until told to stop.
    pub fn along<B>(
        &self,
        from: [f64; 2],
        step: [f64; 2],
        end: f64,
        mut visit: impl FnMut(usize, f64, f64) -> ControlFlow<B>,
    ) -> Option<B> {
        let size = [self.columns as f64 * CELL_M, self.rows as f64 * CELL_M];
        let origin = [from[0] - self.west, from[1] - self.south];
        // The part of the segment over the grid.
        let (mut enter, mut exit) = (0.0_f64, end);
        for i in 0..2 {
            if step[i] == 0.0 {
                if origin[i] < 0.0 || origin[i] >= size[i] {
                    return None;
                }
            } else {
                let (a, b) = (-origin[i] / step[i], (size[i] - origin[i]) / step[i]);
                enter = enter.max(a.min(b));
                exit = exit.min(a.max(b));
            }
        }
        if enter > exit {
            return None;
        }
        let counts = [self.columns as isize, self.rows as isize];
        let mut cell = [0_isize; 2];
        let mut next = [f64::INFINITY; 2];
        let mut stride = [f64::INFINITY; 2];
        for i in 0..2 {
            let at = (origin[i] + enter * step[i]) / CELL_M;
            cell[i] = (at.floor() as isize).clamp(0, counts[i] - 1);
            if step[i] != 0.0 {
                let edge = cell[i] + isize::from(step[i] > 0.0);
                next[i] = (edge as f64 * CELL_M - origin[i]) / step[i];
                stride[i] = CELL_M / step[i].abs();
            }
        }
        let mut t = enter;
        loop {
            let axis = usize::from(next[1] < next[0]);
            let out = next[axis].min(exit);
            let index = cell[1] as usize * self.columns + cell[0] as usize;
            if let ControlFlow::Break(value) = visit(index, t, out.max(t)) {
                return Some(value);
            }
            if next[axis] >= exit {
                return None;
            }
            t = next[axis];
            next[axis] += stride[axis];
            cell[axis] += if step[axis] > 0.0 { 1 } else { -1 };
            if cell[axis] < 0 || cell[axis] >= counts[axis] {
                return None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;

    #[test]
    fn points_and_segments_find_every_box_that_a_search_finds() {
        let area = Bounds { west: -50.0, south: -30.0, east: 61.0, north: 44.0 };
        let mut draw = Draw::new(&[11]);
        let boxes: Vec<Bounds> = (0..300)
            .map(|_| {
                let (x, y) = (draw.range(-70.0, 80.0), draw.range(-50.0, 60.0));
                Bounds::around(x, y, draw.range(0.1, 7.0))
            })
            .collect();
        let grid = CellGrid::new(area, &boxes);
        for _ in 0..3000 {
            let (x, y) = (draw.range(-50.0, 61.0), draw.range(-30.0, 44.0));
            let found = grid.over(x, y);
            for (i, b) in boxes.iter().enumerate() {
                assert!(!b.contains(x, y) || found.contains(&(i as u32)));
            }
            let angle = draw.range(0.0, 6.3);
            let step = draw.pick([[libm::cos(angle), libm::sin(angle)], [1.0, 0.0], [0.0, -1.0]]);
            let end = draw.range(0.0, 150.0);
            let start = [draw.range(-90.0, 90.0), draw.range(-60.0, 70.0)];
            let mut seen = Vec::new();
            let mut last = 0.0;
            let _: Option<()> = grid.along(start, step, end, |cell, t0, t1| {
                assert!(t0 >= last && t1 >= t0 && t1 <= end);
                last = t0;
                seen.extend_from_slice(grid.in_cell(cell));
                ControlFlow::Continue(())
            });
            for k in 0..200 {
                let t = end * f64::from(k) / 199.0;
                let (x, y) = (start[0] + t * step[0], start[1] + t * step[1]);
                if area.contains(x, y) {
                    for (i, b) in boxes.iter().enumerate() {
                        assert!(!b.contains(x, y) || seen.contains(&(i as u32)));
                    }
                }
            }
        }
        assert!(grid.over(-51.0, 0.0).is_empty());
        assert_eq!(
            grid.along([0.0, 0.0], [1.0, 0.0], 9.0, |_, _, _| ControlFlow::Break(7)),
            Some(7)
        );
    }
}
