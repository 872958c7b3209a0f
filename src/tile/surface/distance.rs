//! How far apart two surfaces lie.

use rayon::prelude::*;
use rstar::{AABB, PointDistance, RTree, RTreeObject};
use std::sync::atomic::{AtomicU64, Ordering};

/// A triangle that can be searched for.
struct Face([[f64; 3]; 3]);

impl RTreeObject for Face {
    type Envelope = AABB<[f64; 3]>;

    fn envelope(&self) -> Self::Envelope {
        AABB::from_points(self.0.iter())
    }
}

impl PointDistance for Face {
    fn distance_2(&self, point: &[f64; 3]) -> f64 {
        squared_distance(*point, self.0)
    }
}

/// Two-sided distance between a surface and a simplified one of the same vertices (metres): the largest of
/// the exact distances from points of each to the nearest triangle of the other. Points are the
/// vertices, and points of larger triangles no further apart than two typical sides of the original's. 0 where
/// either has no triangles. The same for any number of threads.
#[must_use]
pub fn distance_m(vertices: &[[f64; 3]], original: &[[u32; 3]], simplified: &[[u32; 3]]) -> f64 {
    distance_within(vertices, original, simplified, f64::INFINITY).unwrap_or(f64::INFINITY)
}

/// [`distance_m`] if it is at most `limit_m`; a larger one is not measured to its end.
pub(super) fn distance_within(
    vertices: &[[f64; 3]],
    original: &[[u32; 3]],
    simplified: &[[u32; 3]],
    limit_m: f64,
) -> Option<f64> {
    let faces = |triangles: &[[u32; 3]]| -> Vec<[[f64; 3]; 3]> {
        triangles.iter().map(|corners| corners.map(|c| vertices[c as usize])).collect()
    };
    let used = |triangles: &[[u32; 3]]| -> Vec<[f64; 3]> {
        let mut used = vec![false; vertices.len()];
        for corner in triangles.iter().flatten() {
            used[*corner as usize] = true;
        }
        vertices.iter().zip(used).filter(|(_, used)| *used).map(|(vertex, _)| *vertex).collect()
    };
    let corners = [used(original), used(simplified)];
    let [original, simplified] = [faces(original), faces(simplified)];
    if original.is_empty() || simplified.is_empty() {
        return Some(0.0);
    }
    let area: f64 = original.iter().map(|face| area(*face)).sum();
    let step = 2.0 * (2.0 * area / original.len() as f64).sqrt();
    let search = Search { most: AtomicU64::new(0), limit: limit_m * limit_m };
    let tree =
        |faces: &[[[f64; 3]; 3]]| RTree::bulk_load(faces.iter().map(|face| Face(*face)).collect());
    let tree_of_simplified = tree(&simplified);
    search.corners(&corners[0], &tree_of_simplified);
    search.between(&original, &tree_of_simplified, step);
    if search.over() {
        return None;
    }
    let tree_of_original = tree(&original);
    search.corners(&corners[1], &tree_of_original);
    search.between(&simplified, &tree_of_original, step);
    (!search.over()).then(|| search.most().sqrt())
}

/// Points that a thread takes at a time.
const GROUP: usize = 512;

/// The search for the largest distance.
struct Search {
    /// The largest squared distance so far, as bits (of positive numbers these have the same order). What
    /// is below it at any time is below it in the end, so that the order of points does not matter.
    most: AtomicU64,
    limit: f64,
}

impl Search {
    fn most(&self) -> f64 {
        f64::from_bits(self.most.load(Ordering::Relaxed))
    }

    fn over(&self) -> bool {
        self.most() > self.limit
    }

    fn corners(&self, points: &[[f64; 3]], to: &RTree<Face>) {
        points.par_chunks(GROUP).for_each(|points| {
            if !self.over() {
                points.iter().for_each(|point| self.point(*point, to));
            }
        });
    }

    /// Points of triangles, but for the corners of those that need no others.
    fn between(&self, faces: &[[[f64; 3]; 3]], to: &RTree<Face>, step: f64) {
        faces.par_chunks(GROUP).for_each(|faces| {
            for face in faces {
                let count = parts(*face, step);
                if count > 1 && !self.over() {
                    points(*face, count).for_each(|point| self.point(point, to));
                }
            }
        });
    }

    fn point(&self, point: [f64; 3], to: &RTree<Face>) {
        // Nearly always something is near enough, and the nearest need not be found.
        if to.locate_within_distance(point, self.most()).next().is_none()
            && let Some((_, squared)) = to.nearest_neighbor_iter_with_distance_2(point).next()
        {
            self.most.fetch_max(squared.to_bits(), Ordering::Relaxed);
        }
    }
}

/// Parts into which the sides of a triangle are cut, so that they are no longer than a step.
fn parts([a, b, c]: [[f64; 3]; 3], step: f64) -> u32 {
    let longest = [minus(b, a), minus(c, a), minus(c, b)].map(|side| dot(side, side).sqrt());
    let longest = longest.into_iter().fold(0.0, f64::max);
    // A step of 0 (no area at all) leaves the corners.
    if step > 0.0 { (longest / step).ceil().clamp(1.0, 4096.0) as u32 } else { 1 }
}

/// Corners and points between them, with the sides in equal parts.
fn points([a, b, c]: [[f64; 3]; 3], count: u32) -> impl Iterator<Item = [f64; 3]> {
    (0..=count).flat_map(move |i| {
        (0..=count - i).map(move |j| {
            let (u, v) = (f64::from(i) / f64::from(count), f64::from(j) / f64::from(count));
            [0, 1, 2].map(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k]))
        })
    })
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn area([a, b, c]: [[f64; 3]; 3]) -> f64 {
    let (u, v) = (minus(b, a), minus(c, a));
    (dot(u, u) * dot(v, v) - dot(u, v) * dot(u, v)).max(0.0).sqrt() / 2.0
}

/// From a point to the nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
fn squared_distance(p: [f64; 3], [a, b, c]: [[f64; 3]; 3]) -> f64 {
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
