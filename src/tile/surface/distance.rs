//! How far apart two surfaces lie.

use rayon::prelude::*;
use rstar::{AABB, PointDistance, RTree, RTreeObject};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// A triangle that can be searched for.
struct Face([[f64; 3]; 3], [u32; 3]);

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

/// [`distance_m`] if it is at most `limit_m`, otherwise the vertices of the original, ascending, at which it is
/// larger.
pub(super) fn distance_within(
    vertices: &[[f64; 3]],
    original: &[[u32; 3]],
    simplified: &[[u32; 3]],
    limit_m: f64,
) -> Result<f64, Vec<u32>> {
    let faces = |triangles: &[[u32; 3]]| -> Vec<Face> {
        let places = |corners: &[u32; 3]| corners.map(|corner| vertices[corner as usize]);
        triangles.iter().map(|corners| Face(places(corners), *corners)).collect()
    };
    if original.is_empty() || simplified.is_empty() {
        return Ok(0.0);
    }
    let sum: f64 = faces(original).iter().map(|face| area(face.0)).sum();
    let step = 2.0 * (2.0 * sum / original.len() as f64).sqrt();
    let search =
        Search { most: AtomicU64::new(0), limit: limit_m * limit_m, far: Mutex::default() };
    // The vertices of the simplified surface are the original's: they lie on both.
    search.of_original(vertices, &faces(original), &RTree::bulk_load(faces(simplified)), step);
    search.of_simplified(&faces(simplified), &RTree::bulk_load(faces(original)), step);
    let mut far = search.far.into_inner().unwrap_or_else(PoisonError::into_inner);
    if far.is_empty() {
        return Ok(f64::from_bits(search.most.into_inner()).sqrt());
    }
    far.sort_unstable();
    far.dedup();
    Err(far)
}

/// Points that a thread takes at a time.
const GROUP: usize = 512;

/// The search for the largest distance.
struct Search {
    /// The largest squared distance so far, as bits (of positive numbers these have the same order). What
    /// is below it at any time is below it in the end, so that the order of points does not matter.
    most: AtomicU64,
    limit: f64,
    /// Vertices of the original near points that are further away than the limit.
    far: Mutex<Vec<u32>>,
}

impl Search {
    fn of_original(&self, vertices: &[[f64; 3]], faces: &[Face], to: &RTree<Face>, step: f64) {
        let mut used: Vec<u32> = faces.iter().flat_map(|face| face.1).collect();
        used.par_sort_unstable();
        used.dedup();
        used.par_chunks(GROUP).flatten_iter().for_each(|vertex| {
            if self.point(vertices[*vertex as usize], to).is_some() {
                self.note(&[*vertex]);
            }
        });
        faces.par_chunks(GROUP).flatten_iter().for_each(|Face(face, corners)| {
            let count = parts(*face, step);
            if count > 1 && points(*face, count).any(|point| self.point(point, to).is_some()) {
                self.note(corners);
            }
        });
    }

    fn of_simplified(&self, faces: &[Face], to: &RTree<Face>, step: f64) {
        faces.par_chunks(GROUP).flatten_iter().for_each(|Face(face, _)| {
            let count = parts(*face, step);
            for point in points(*face, count).filter(|_| count > 1) {
                if let Some(nearest) = self.point(point, to) {
                    self.note(&nearest.1);
                }
            }
        });
    }

    fn note(&self, corners: &[u32]) {
        self.far.lock().unwrap_or_else(PoisonError::into_inner).extend(corners);
    }

    /// The triangle that is nearest to a point beyond the limit.
    fn point<'a>(&self, point: [f64; 3], to: &'a RTree<Face>) -> Option<&'a Face> {
        let most = f64::from_bits(self.most.load(Ordering::Relaxed));
        // Nearly always something is near enough, and the nearest need not be found.
        if to.locate_within_distance(point, most.min(self.limit)).next().is_some() {
            return None;
        }
        let (face, squared) = to.nearest_neighbor_iter_with_distance_2(point).next()?;
        self.most.fetch_max(squared.to_bits(), Ordering::Relaxed);
        (squared > self.limit).then_some(face)
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
