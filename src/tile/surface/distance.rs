//! How far apart two surfaces lie.

use super::near::{Near, dot, minus};
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Two-sided distance between a surface and a simplified one of the same vertices (metres): the largest of
/// the exact distances from points of each to the nearest triangle of the other. Points are all
/// vertices, and points of larger triangles no further apart than two typical sides of the original's. 0 where
/// the original has no triangles, infinite where only the simplified one has none. The same for any number of
/// threads.
#[must_use]
pub fn distance_m(vertices: &[[f64; 3]], original: &[[u32; 3]], simplified: &[[u32; 3]]) -> f64 {
    let original = Original::new(vertices, original);
    original.distance_within(simplified, f64::INFINITY).unwrap_or(f64::INFINITY)
}

/// A surface with which simplified ones are compared.
pub(super) struct Original<'a> {
    vertices: &'a [[f64; 3]],
    triangles: &'a [[u32; 3]],
    near: Near<'a>,
    /// Two typical sides of a triangle, metres.
    step: f64,
}

/// Side of a cell in steps, for the original and for a simplified surface. Twice or half as much is not faster.
const SIDES: [f64; 2] = [0.5, 1.5];

/// Most cells of a grid, if it has no more triangles: one tile has fewer cells.
const CELLS: usize = 1 << 22;

/// Points that a thread takes at a time.
const GROUP: usize = 512;

/// Triangles from which on one surface is measured by several threads. Smaller ones are many, and each
/// has its thread: one that waited for others would begin another surface before its own is done.
const SHARED: usize = 1_000_000;

impl<'a> Original<'a> {
    /// Prepares a surface.
    pub fn new(vertices: &'a [[f64; 3]], triangles: &'a [[u32; 3]]) -> Self {
        let places = |corners: &[u32; 3]| corners.map(|corner| vertices[corner as usize]);
        let sum: f64 = triangles.iter().map(|corners| area(places(corners))).sum();
        let step = 2.0 * (2.0 * sum / triangles.len().max(1) as f64).sqrt();
        let near = Near::new(vertices, triangles, SIDES[0] * step, CELLS.max(4 * triangles.len()));
        Self { vertices, triangles, near, step }
    }

    /// [`distance_m`] to a simplified surface if it is at most `limit_m`, otherwise the vertices, ascending, at which
    /// it is larger.
    pub fn distance_within(&self, simplified: &[[u32; 3]], limit_m: f64) -> Result<f64, Vec<u32>> {
        if self.triangles.is_empty() {
            return Ok(0.0);
        }
        let search = Search {
            most: AtomicU64::new(0),
            limit: limit_m * limit_m,
            is_beyond: AtomicBool::new(false),
            far: Mutex::default(),
        };
        self.ask_simplified(simplified, &search);
        self.ask_original(simplified, &search);
        if !search.is_beyond.into_inner() {
            return Ok(f64::from_bits(search.most.into_inner()).sqrt());
        }
        let mut far = search.far.into_inner().unwrap_or_else(PoisonError::into_inner);
        far.sort_unstable();
        far.dedup();
        Err(far)
    }

    fn ask_simplified(&self, simplified: &[[u32; 3]], search: &Search) {
        let cells = CELLS.max(4 * self.triangles.len());
        let to = Near::new(self.vertices, simplified, SIDES[1] * self.step, cells);
        // Vertices that remain lie on both.
        let mut asked = vec![false; self.vertices.len()];
        self.triangles.iter().flatten().for_each(|corner| asked[*corner as usize] = true);
        simplified.iter().flatten().for_each(|corner| asked[*corner as usize] = false);
        self.groups(&asked).for_each(|(group, asked)| {
            for (index, _) in asked.iter().enumerate().filter(|(_, asked)| **asked) {
                let vertex = group * GROUP + index;
                if search.is_far(self.vertices[vertex], &to) {
                    search.note(&[vertex as u32]);
                }
            }
        });
        self.groups(self.triangles).flat_map_iter(|(_, group)| group).for_each(|corners| {
            let face = self.places(corners);
            let count = parts(face, self.step);
            if count > 1 && points(face, count).any(|point| search.is_far(point, &to)) {
                search.note(corners);
            }
        });
    }

    fn ask_original(&self, simplified: &[[u32; 3]], search: &Search) {
        self.groups(simplified).flat_map_iter(|(_, group)| group).for_each(|corners| {
            let face = self.places(corners);
            let count = parts(face, self.step);
            for point in points(face, count).filter(|_| count > 1) {
                if search.is_far(point, &self.near)
                    && let Some(found) = self.near.nearest(point, 0.0, f64::INFINITY)
                {
                    search.note(&self.triangles[found.triangle as usize]);
                }
            }
        });
    }

    /// Parts of a list, taken by several threads if the surface is large.
    fn groups<'b, T: Sync>(
        &self,
        list: &'b [T],
    ) -> impl IndexedParallelIterator<Item = (usize, &'b [T])> {
        let alone = self.triangles.len() < SHARED;
        let least = if alone { list.len().max(1) } else { 1 };
        list.par_chunks(GROUP).enumerate().with_min_len(least)
    }

    fn places(&self, corners: &[u32; 3]) -> [[f64; 3]; 3] {
        corners.map(|corner| self.vertices[corner as usize])
    }
}

/// The search for the largest distance.
struct Search {
    /// The largest squared distance so far, as bits (of positive numbers these have the same order). What
    /// is below it at any time is below it in the end, so that the order of points does not matter.
    most: AtomicU64,
    limit: f64,
    /// Whether a point was beyond the limit.
    is_beyond: AtomicBool,
    /// Vertices of the original near such points.
    far: Mutex<Vec<u32>>,
}

impl Search {
    fn note(&self, corners: &[u32]) {
        self.far.lock().unwrap_or_else(PoisonError::into_inner).extend(corners);
    }

    /// Whether a point is beyond the limit. How far is then not asked.
    fn is_far(&self, point: [f64; 3], to: &Near<'_>) -> bool {
        let most = f64::from_bits(self.most.load(Ordering::Relaxed));
        // Nearly always something is near enough, and the nearest need not be found.
        let found = to.nearest(point, most, self.limit.next_up());
        match found {
            Some(found) => {
                self.most.fetch_max(found.squared.to_bits(), Ordering::Relaxed);
            }
            None => self.is_beyond.store(true, Ordering::Relaxed),
        }
        found.is_none()
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

fn area([a, b, c]: [[f64; 3]; 3]) -> f64 {
    let (u, v) = (minus(b, a), minus(c, a));
    (dot(u, u) * dot(v, v) - dot(u, v) * dot(u, v)).max(0.0).sqrt() / 2.0
}
