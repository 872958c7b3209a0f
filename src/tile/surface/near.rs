//! The triangles of a surface in the cells of a grid, to ask for the nearest.

/// A surface whose triangles are listed by cell.
pub(super) struct Near<'a> {
    vertices: &'a [[f64; 3]],
    triangles: &'a [[u32; 3]],
    /// Least corner of the first cell, metres.
    corner: [f64; 3],
    /// Side of a cell, metres.
    side: f64,
    /// Cells along each axis.
    counts: [usize; 3],
    /// Where the list of each cell begins and, one further, ends.
    starts: Vec<u32>,
    /// Numbers of triangles, cell by cell.
    lists: Vec<u32>,
}

/// The nearest triangle and its squared distance, square metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Found {
    pub triangle: u32,
    pub squared: f64,
}

impl<'a> Near<'a> {
    /// Lists triangles. A cell's side is `side` metres, or twice, four times, ... as much until there
    /// are no more than `cells` of them.
    pub fn new(
        vertices: &'a [[f64; 3]],
        triangles: &'a [[u32; 3]],
        side: f64,
        cells: usize,
    ) -> Self {
        let mut ends = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for corner in triangles.iter().flatten() {
            for (k, value) in vertices[*corner as usize].into_iter().enumerate() {
                ends[0][k] = ends[0][k].min(value);
                ends[1][k] = ends[1][k].max(value);
            }
        }
        let extent = minus(ends[1], ends[0]);
        let longest = extent.into_iter().fold(0.0, f64::max);
        // No extent at all: one cell.
        let mut side = if side > 0.0 { side } else { longest.max(1.0) };
        let along = |side: f64| extent.map(|extent| (extent / side).floor() + 1.0);
        while along(side).into_iter().product::<f64>() > cells.max(1) as f64 {
            side *= 2.0;
        }
        let counts = along(side).map(|count| (count as usize).max(1));
        let mut near = Self {
            vertices,
            triangles,
            corner: ends[0],
            side,
            counts,
            starts: vec![0; counts.iter().product::<usize>() + 1],
            lists: Vec::new(),
        };
        // First how many each cell has, then where its list ends; filled from behind, it is where it begins.
        let mut starts = std::mem::take(&mut near.starts);
        for triangle in triangles {
            near.cells(triangle, |cell| starts[cell] += 1);
        }
        let mut sum = 0;
        for start in &mut starts {
            sum += *start;
            *start = sum;
        }
        let mut lists = vec![0; sum as usize];
        for (number, triangle) in triangles.iter().enumerate().rev() {
            near.cells(triangle, |cell| {
                starts[cell] -= 1;
                lists[starts[cell] as usize] = number as u32;
            });
        }
        (near.starts, near.lists) = (starts, lists);
        near
    }

    /// Least corner of the first cell.
    #[cfg(test)]
    pub fn corner(&self) -> [f64; 3] {
        self.corner
    }

    /// Cells that a triangle touches, and some beside it.
    fn cells(&self, triangle: &[u32; 3], mut give: impl FnMut(usize)) {
        let corners = self
            .places(triangle)
            .map(|vertex| [0, 1, 2].map(|k| (vertex[k] - self.corner[k]) / self.side));
        let range = |axis: usize, polygon: &Polygon| {
            let ends = polygon.points().iter().fold([f64::INFINITY, 0.0_f64], |[low, high], p| {
                [low.min(p[axis]), high.max(p[axis])]
            });
            // Rounding of the cuts below may not lose a cell.
            let last = self.counts[axis] - 1;
            let [low, high] = [ends[0] - SLACK, ends[1] + SLACK].map(|end| end.max(0.0) as usize);
            low.min(last)..=high.min(last)
        };
        let whole = Polygon::new(corners);
        let [xs, ys, zs] = [0, 1, 2].map(|axis| range(axis, &whole));
        let few = [&xs, &ys, &zs].into_iter().all(|range| range.end() - range.start() < 2);
        for x in xs {
            let slice = if few { whole } else { whole.between(0, x) };
            for y in if few { ys.clone() } else { range(1, &slice) } {
                let row = (x * self.counts[1] + y) * self.counts[2];
                let part = if few { zs.clone() } else { range(2, &slice.between(1, y)) };
                part.for_each(|z| give(row + z));
            }
        }
    }

    /// Corners of a triangle, metres.
    fn places(&self, triangle: &[u32; 3]) -> [[f64; 3]; 3] {
        triangle.map(|corner| self.vertices[corner as usize])
    }

    /// The nearest triangle, if it is nearer than the square root of `limit`. As soon as one is no further than that
    /// of `enough`, it is the answer, though another may be nearer. Both are square metres.
    pub fn nearest(&self, point: [f64; 3], enough: f64, limit: f64) -> Option<Found> {
        // In cells from the corner; and the cell, for points outside the nearest one.
        let at = [0, 1, 2].map(|k| (point[k] - self.corner[k]) / self.side);
        let home = [0, 1, 2].map(|k| (at[k].max(0.0) as usize).min(self.counts[k] - 1));
        let mut best = Found { triangle: u32::MAX, squared: limit };
        for ring in 0.. {
            let ends = [0, 1, 2]
                .map(|k| [home[k].saturating_sub(ring), (home[k] + ring).min(self.counts[k] - 1)]);
            for x in ends[0][0]..=ends[0][1] {
                for y in ends[1][0]..=ends[1][1] {
                    let row = (x * self.counts[1] + y) * self.counts[2];
                    let edge = x.abs_diff(home[0]) == ring || y.abs_diff(home[1]) == ring;
                    // Inside, only the two cells at the ends of the row are new.
                    let [low, high] = ends[2];
                    let parts = if edge {
                        [Some((low, high)), None]
                    } else {
                        [
                            (home[2] >= ring).then_some((low, low)),
                            (home[2] + ring == high).then_some((high, high)),
                        ]
                    };
                    for (first, last) in parts.into_iter().flatten() {
                        let list =
                            self.starts[row + first] as usize..self.starts[row + last + 1] as usize;
                        for number in &self.lists[list] {
                            let corners = self.places(&self.triangles[*number as usize]);
                            let squared = squared_distance(point, corners);
                            if squared < best.squared {
                                best = Found { triangle: *number, squared };
                                if squared <= enough {
                                    return Some(best);
                                }
                            }
                        }
                    }
                }
            }
            // What is not in these rings is at least so far away: past one of their sides, if any cell is there.
            let mut beyond = f64::INFINITY;
            for k in 0..3 {
                if ends[k][0] > 0 {
                    beyond = beyond.min(at[k] - ends[k][0] as f64);
                }
                if ends[k][1] + 1 < self.counts[k] {
                    beyond = beyond.min((ends[k][1] + 1) as f64 - at[k]);
                }
            }
            let beyond = (beyond - SLACK).max(0.0) * self.side;
            if beyond * beyond >= best.squared {
                break;
            }
        }
        (best.triangle != u32::MAX).then_some(best)
    }
}

/// Share of a cell that is allowed for rounding.
const SLACK: f64 = 1e-6;

/// A convex polygon: a triangle cut by up to four planes, each of which adds a corner at most.
#[derive(Clone, Copy)]
struct Polygon {
    points: [[f64; 3]; 7],
    count: usize,
}

impl Polygon {
    fn new([a, b, c]: [[f64; 3]; 3]) -> Self {
        Self { points: [a, b, c, a, a, a, a], count: 3 }
    }

    fn points(&self) -> &[[f64; 3]] {
        &self.points[..self.count]
    }

    /// The part in a layer of cells, and a little more.
    fn between(&self, axis: usize, layer: usize) -> Self {
        let low = layer as f64 - SLACK;
        let high = (layer + 1) as f64 + SLACK;
        self.cut(|p| p[axis] - low).cut(|p| high - p[axis])
    }

    /// The part where a linear function is not negative.
    fn cut(&self, height: impl Fn(&[f64; 3]) -> f64) -> Self {
        let mut part = Self { count: 0, ..*self };
        let mut add = |point| {
            if part.count < part.points.len() {
                part.points[part.count] = point;
                part.count += 1;
            }
        };
        let points = self.points();
        for (index, p) in points.iter().enumerate() {
            let q = &points[(index + 1) % points.len()];
            let (from, to) = (height(p), height(q));
            if from >= 0.0 {
                add(*p);
            }
            if (from < 0.0) != (to < 0.0) {
                let share = from / (from - to);
                add([0, 1, 2].map(|k| p[k] + share * (q[k] - p[k])));
            }
        }
        part
    }
}

pub(super) fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// From a point to the nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
pub(super) fn squared_distance(p: [f64; 3], [a, b, c]: [[f64; 3]; 3]) -> f64 {
    let (ab, ac, ap) = (minus(b, a), minus(c, a), minus(p, a));
    let along = |from: [f64; 3], side: [f64; 3], share: f64| {
        let to = minus(p, [0, 1, 2].map(|k| from[k] + share * side[k]));
        dot(to, to)
    };
    let (d1, d2) = (dot(ab, ap), dot(ac, ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return dot(ap, ap);
    }
    let bp = minus(p, b);
    let (d3, d4) = (dot(ab, bp), dot(ac, bp));
    if d3 >= 0.0 && d4 <= d3 {
        return dot(bp, bp);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return along(a, ab, share(d1, d1 - d3));
    }
    let cp = minus(p, c);
    let (d5, d6) = (dot(ab, cp), dot(ac, cp));
    if d6 >= 0.0 && d5 <= d6 {
        return dot(cp, cp);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return along(a, ac, share(d2, d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return along(b, minus(c, b), share(d4 - d3, (d4 - d3) + (d5 - d6)));
    }
    let (v, w) = (share(vb, va + vb + vc), share(vc, va + vb + vc));
    let to = minus(p, [0, 1, 2].map(|k| a[k] + v * ab[k] + w * ac[k]));
    dot(to, to)
}

/// A quotient, 0 where a triangle has no extent.
fn share(part: f64, whole: f64) -> f64 {
    if whole == 0.0 { 0.0 } else { part / whole }
}
