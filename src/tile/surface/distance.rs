//! How far apart two surfaces lie.

use rstar::{AABB, PointDistance, RTree, RTreeObject};

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
/// the exact distances from points of each to the nearest triangle of the other. Points are all
/// vertices, and points of each triangle no further apart than a typical side of the original's triangles. 0 where
/// either has no triangles.
#[must_use]
pub fn distance_m(vertices: &[[f64; 3]], original: &[[u32; 3]], simplified: &[[u32; 3]]) -> f64 {
    let faces = |triangles: &[[u32; 3]]| -> Vec<[[f64; 3]; 3]> {
        triangles.iter().map(|corners| corners.map(|c| vertices[c as usize])).collect()
    };
    let (original, simplified) = (faces(original), faces(simplified));
    if original.is_empty() || simplified.is_empty() {
        return 0.0;
    }
    let area: f64 = original.iter().map(|face| area(*face)).sum();
    let step = (2.0 * area / original.len() as f64).sqrt();
    let tree = |faces: &[[[f64; 3]; 3]]| {
        RTree::bulk_load(faces.iter().map(|face| Face(*face)).collect())
    };
    let there = largest(&original, &tree(&simplified), step, 0.0);
    largest(&simplified, &tree(&original), step, there).sqrt()
}

/// The largest squared distance from points of the triangles, if it is above `most`.
fn largest(faces: &[[[f64; 3]; 3]], to: &RTree<Face>, step: f64, mut most: f64) -> f64 {
    for face in faces {
        for point in points(*face, step) {
            // Nearly always something is near enough, and the nearest need not be found.
            if to.locate_within_distance(point, most).next().is_none()
                && let Some((_, squared)) = to.nearest_neighbor_iter_with_distance_2(point).next()
            {
                most = most.max(squared);
            }
        }
    }
    most
}

/// Corners and points between them, no further apart than a step.
fn points([a, b, c]: [[f64; 3]; 3], step: f64) -> impl Iterator<Item = [f64; 3]> {
    let longest = [minus(b, a), minus(c, a), minus(c, b)].map(|side| dot(side, side).sqrt());
    let longest = longest.into_iter().fold(0.0, f64::max);
    // A step of 0 (no area at all) leaves the corners.
    let count = if step > 0.0 { (longest / step).ceil().clamp(1.0, 4096.0) as u32 } else { 1 };
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
