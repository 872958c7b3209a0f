//! The table of marching cubes, made from its rule instead of being written down.
//!
//! Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)` along axes 0, 1, 2; a case is the set of
//! its inside corners. On each face alone it is decided which cut edges are joined: walking around the
//! face, an edge that leaves the solid is joined with the next one that enters it, so that on a face
//! with two inside corners across from each other the solid stays in one piece. Both cells of a
//! face see the same corners, hence the same segments. Segments of six faces make closed loops, and each
//! loop is filled with triangles whose inner sides (chords) lie in no face: a chord in a face could
//! coincide with a side of a loop beyond it, and that edge would have four triangles.

use std::sync::LazyLock;

/// Most triangles of a case.
pub(super) const MOST: usize = 5;

/// What is drawn in a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Case {
    /// Number of triangles.
    pub count: u8,
    /// Their corners as edges of the cell, counter-clockwise seen from outside the solid where axes 0, 1,
    /// 2 are right-handed.
    pub triangles: [[u8; 3]; MOST],
}

/// All 256 cases.
pub(super) static CASES: LazyLock<[Case; 256]> =
    LazyLock::new(|| std::array::from_fn(|corners| case(corners as u8)));

/// The edge from corner `low` along `axis`: `4 * axis` and the corner's other two bits.
const fn edge(axis: usize, low: usize) -> usize {
    let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
    // The lower axis has the lower bit.
    let (a, b) = if a < b { (a, b) } else { (b, a) };
    4 * axis + (low >> a & 1) + 2 * (low >> b & 1)
}

/// The edge between two neighbouring corners.
const fn between(a: usize, b: usize) -> usize {
    edge((a ^ b).trailing_zeros() as usize, a & b)
}

/// Corners of a face, counter-clockwise seen from outside the cell.
fn face(index: usize) -> [usize; 4] {
    let (axis, side) = (index / 2, index % 2);
    let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
    let base = side << axis;
    let mut corners = [base, base | u, base | u | v, base | v];
    if side == 0 {
        corners.reverse();
    }
    corners
}

/// Faces that an edge lies in, as bits.
fn faces_of(edge: usize) -> u8 {
    let on = |face: &usize| {
        let corners = self::face(*face);
        (0..4).any(|i| between(corners[i], corners[(i + 1) % 4]) == edge)
    };
    (0..6).filter(on).fold(0, |bits, face| bits | 1 << face)
}

/// Twice the middle of an edge.
fn middle(edge: usize) -> [i32; 3] {
    let (axis, bits) = (edge / 4, edge % 4);
    let mut others = [bits as i32 & 1, bits as i32 >> 1].into_iter();
    [0, 1, 2].map(|k| if k == axis { 1 } else { 2 * others.next().unwrap_or_default() })
}

/// The closed loops of a case, each a list of edges.
fn loops(case: u8) -> Vec<Vec<usize>> {
    let inside = |corner: usize| case >> corner & 1 == 1;
    let mut next = [None; 12];
    for corners in (0..6).map(face) {
        let ends = |i: usize| (corners[i % 4], corners[(i + 1) % 4]);
        let enters = |i: &usize| !inside(ends(*i).0) && inside(ends(*i).1);
        for leaving in (0..4).filter(|i| inside(ends(*i).0) && !inside(ends(*i).1)) {
            if let Some(entering) = (leaving + 1..leaving + 4).find(enters) {
                let ((a, b), (c, d)) = (ends(entering), ends(leaving));
                next[between(a, b)] = Some(between(c, d));
            }
        }
    }
    let mut found = Vec::new();
    for start in 0..12 {
        let mut list = Vec::new();
        let mut at = start;
        while let Some(following) = next[at].take() {
            list.push(at);
            at = following;
        }
        if !list.is_empty() {
            found.push(list);
        }
    }
    found
}

/// Fills the polygon from its vertex `first` to its vertex `last` with triangles, without chords in faces;
/// of all ways the one with the least sum of squared chords (at the middles of edges), of equals the
/// first. `None` where there is none.
fn fill(polygon: &[usize], first: usize, last: usize) -> Option<(i32, Vec<[u8; 3]>)> {
    if last - first < 2 {
        return Some((0, Vec::new()));
    }
    let chord = |i: usize, j: usize| -> Option<i32> {
        // Of the polygon's own sides; the one from its last vertex to its first is never asked for.
        if j - i == 1 {
            return Some(0);
        }
        let (a, b) = (middle(polygon[i]), middle(polygon[j]));
        let length = (0..3).map(|k| (a[k] - b[k]).pow(2)).sum();
        (faces_of(polygon[i]) & faces_of(polygon[j]) == 0).then_some(length)
    };
    let mut best: Option<(i32, Vec<[u8; 3]>)> = None;
    for apex in first + 1..last {
        let parts = (chord(first, apex), chord(apex, last));
        let (Some(a), Some(b)) = parts else { continue };
        let filled = (fill(polygon, first, apex), fill(polygon, apex, last));
        let (Some((c, mut triangles)), Some((d, rest))) = filled else { continue };
        let cost = a + b + c + d;
        if best.as_ref().is_none_or(|best| cost < best.0) {
            triangles.extend(rest);
            triangles.push([first, apex, last].map(|index| polygon[index] as u8));
            best = Some((cost, triangles));
        }
    }
    best
}

fn case(corners: u8) -> Case {
    let mut case = Case::default();
    for polygon in loops(corners) {
        // Every loop of the 256 cases can be filled so; the tests say it.
        let (_, triangles) = fill(&polygon, 0, polygon.len() - 1).unwrap_or_default();
        for triangle in triangles {
            case.triangles[usize::from(case.count)] = triangle;
            case.count += 1;
        }
    }
    case
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;
    use std::collections::HashMap;

    #[test]
    fn every_loop_is_filled_and_chords_lie_in_no_face() {
        for corners in 0..=255_u8 {
            let loops = loops(corners);
            let cut: usize = loops.iter().map(Vec::len).sum();
            let crossings = (0..12)
                .filter(|edge| {
                    let [a, b] = [0, 1].map(|end| {
                        let middle = middle(*edge);
                        (0..3).fold(0, |corner, k| {
                            let bit = if middle[k] == 1 { end } else { middle[k] / 2 };
                            corner | (bit as usize) << k
                        })
                    });
                    corners >> a & 1 != corners >> b & 1
                })
                .count();
            assert_eq!(cut, crossings, "{corners:08b}: each cut edge is on one loop");
            let case = CASES[usize::from(corners)];
            assert_eq!(usize::from(case.count), cut - 2 * loops.len(), "{corners:08b}");
            let mut sides: HashMap<(u8, u8), i32> = HashMap::new();
            for triangle in &case.triangles[..usize::from(case.count)] {
                for k in 0..3 {
                    *sides.entry((triangle[k], triangle[(k + 1) % 3])).or_default() += 1;
                }
            }
            assert!(sides.values().all(|count| *count == 1), "{corners:08b}");
            for (a, b) in sides.keys() {
                // A side that has its opposite in the cell is a chord, any other a loop's.
                let common = faces_of((*a).into()) & faces_of((*b).into());
                assert_eq!(sides.contains_key(&(*b, *a)), common == 0, "{corners:08b} {a} {b}");
            }
        }
    }

    /// The chords of every way to cut a polygon into triangles.
    fn cuts(polygon: &[usize]) -> Vec<Vec<[usize; 2]>> {
        let last = polygon.len() - 1;
        if last < 3 {
            return vec![Vec::new()];
        }
        let apices = 1..last;
        apices
            .flat_map(|apex| {
                let own = [(0, apex), (apex, last)].into_iter().filter(|(a, b)| b - a > 1);
                let own: Vec<_> = own.map(|(a, b)| [polygon[a], polygon[b]]).collect();
                let rest = cuts(&polygon[apex..]);
                let parts = cuts(&polygon[..=apex]).into_iter();
                let joined = parts.flat_map(move |part| {
                    let own = own.clone();
                    rest.clone().into_iter().map(move |rest| [&part[..], &rest, &own].concat())
                });
                joined.collect::<Vec<_>>()
            })
            .collect()
    }

    #[test]
    fn no_other_way_to_fill_a_loop_has_shorter_chords() {
        let place = |edge: usize| middle(edge).map(f64::from);
        let square = |a: usize, b: usize| -> f64 {
            place(a).into_iter().zip(place(b)).map(|(a, b)| (a - b) * (a - b)).sum()
        };
        let mut choices = 0;
        for corners in 0..=255_u8 {
            let mut least = 0.0;
            for polygon in loops(corners) {
                let ways = cuts(&polygon);
                // Catalan's numbers: 1, 2, 5, 14, 42 ...
                assert_eq!(ways.len(), [1, 2, 5, 14, 42, 132, 429][polygon.len() - 3]);
                let in_no_face = |way: &&Vec<[usize; 2]>| {
                    way.iter().all(|[a, b]| faces_of(*a) & faces_of(*b) == 0)
                };
                let costs = ways.iter().filter(in_no_face);
                let costs = costs.map(|way| way.iter().map(|[a, b]| square(*a, *b)).sum::<f64>());
                choices += ways.len() - 1;
                least += costs.fold(f64::INFINITY, f64::min);
            }
            let case = CASES[usize::from(corners)];
            let triangles = &case.triangles[..usize::from(case.count)];
            let sides = triangles.iter().flat_map(|t| [0, 1, 2].map(|k| [t[k], t[(k + 1) % 3]]));
            let sides: std::collections::HashSet<[u8; 2]> = sides.collect();
            let chords = sides.iter().filter(|[a, b]| sides.contains(&[*b, *a]));
            // Each is the side of two triangles.
            let found: f64 = chords.map(|[a, b]| square((*a).into(), (*b).into()) / 2.0).sum();
            assert!((found - least).abs() < 1e-9, "{corners:08b}: {found} for {least}");
        }
        assert!(choices > 1000, "{choices}");
    }

    #[test]
    fn one_corner_is_cut_off_with_its_triangle_facing_away() {
        let case = CASES[1];
        assert_eq!(case.count, 1);
        // Edges along the three axes from corner 0.
        let mut triangle = case.triangles[0];
        let least = (0..3).min_by_key(|k| triangle[*k]).unwrap();
        triangle.rotate_left(least);
        assert_eq!(triangle, [0, 4, 8]);
    }

    /// Whether segment `p`-`q` crosses triangle `t` properly.
    fn pierces(p: [f64; 3], q: [f64; 3], t: [[f64; 3]; 3]) -> bool {
        let minus = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|k| a[k] - b[k]);
        let volume = |a: [f64; 3], b: [f64; 3], c: [f64; 3], d: [f64; 3]| {
            let (u, v, w) = (minus(b, a), minus(c, a), minus(d, a));
            u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0])
                + u[2] * (v[0] * w[1] - v[1] * w[0])
        };
        let [a, b, c] = t;
        let (above, below) = (volume(a, b, c, p), volume(a, b, c, q));
        let around = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)];
        above * below < 0.0 && (around.iter().all(|v| *v > 0.0) || around.iter().all(|v| *v < 0.0))
    }

    #[test]
    fn triangles_of_a_cell_do_not_cross() {
        let mut state = 1_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let uniform = (state >> 11) as f64 / (1_u64 << 53) as f64;
            // Both ends of the range, where crossings are likeliest, come often.
            (0.5 + 0.8 * (uniform - 0.5) * if state >> 5 & 1 == 0 { 1.0 } else { 1.24 })
                .clamp(super::super::CLAMP, 1.0 - super::super::CLAMP)
        };
        let mut crossing = 0;
        for _ in 0..200 {
            let points: [[f64; 3]; 12] = std::array::from_fn(|edge| {
                let t = random();
                let middle = middle(edge).map(|v| f64::from(v) / 2.0);
                [0, 1, 2].map(|k| if k == edge / 4 { t } else { middle[k] })
            });
            for case in CASES.iter() {
                let triangles = &case.triangles[..usize::from(case.count)];
                for (index, one) in triangles.iter().enumerate() {
                    for (_, other) in triangles.iter().enumerate().filter(|(k, _)| *k != index) {
                        let place = |t: &[u8; 3]| t.map(|edge| points[usize::from(edge)]);
                        for k in 0..3 {
                            let side = [one[k], one[(k + 1) % 3]];
                            if side.iter().any(|edge| other.contains(edge)) {
                                continue;
                            }
                            let [p, q] = side.map(|edge| points[usize::from(edge)]);
                            crossing += i32::from(pierces(p, q, place(other)));
                        }
                    }
                }
            }
        }
        assert_eq!(crossing, 0);
    }
}
