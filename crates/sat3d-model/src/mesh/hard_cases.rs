//! Marching cubes where the textbook's breaks: ties, plateaus, ambiguous faces, values that are no numbers, values and
//! places of every size (`docs/numerics-field.md`). What holds of every mesh is in `tests/suite/mesh_topology.rs`.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::cases::CASES;
use super::{Axis, CLAMP, Mesh, Surface, mesh_grid};
use crate::exact::{exact, magnitudes, rounded};
use crate::random::Draw;
use std::cmp::Ordering;
use std::collections::{HashMap, HashSet};

const ISOVALUE: f64 = 5.0;
const SIDE: usize = 9;

/// Axes of points at 0, 1, 2 ...
fn unit(shape: [usize; 3]) -> [Axis; 3] {
    shape.map(|count| Axis::new(-1.0, (0..count).map(|k| k as f64), count as f64).unwrap())
}

/// What is wrong with a mesh.
#[derive(Debug, Default, PartialEq)]
struct Flaws {
    triangles: usize,
    /// Sides without a triangle on the other side.
    open: usize,
    /// Triangles without area.
    flat: usize,
    /// Vertices at the place of another one.
    doubled: usize,
    /// Vertices that are nowhere.
    nowhere: usize,
}

impl Flaws {
    fn of(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Self {
        let sides: HashSet<[u32; 2]> =
            triangles.iter().flat_map(|t| [0, 1, 2].map(|k| [t[k], t[(k + 1) % 3]])).collect();
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|index| vertices[index as usize]);
            let normal = super::cross(super::minus(b, a), super::minus(c, a));
            normal.iter().map(|v| v * v).sum::<f64>()
        };
        let places: HashSet<[u64; 3]> =
            vertices.iter().map(|v| v.map(|v| (v + 0.0).to_bits())).collect();
        Self {
            triangles: triangles.len(),
            open: sides.iter().filter(|[a, b]| !sides.contains(&[*b, *a])).count(),
            flat: triangles.iter().filter(|t| area(t) == 0.0).count(),
            doubled: vertices.len() - places.len(),
            nowhere: vertices.iter().filter(|v| v.iter().any(|v| !v.is_finite())).count(),
        }
    }

    fn none(&self) -> bool {
        let Self { triangles, .. } = *self;
        triangles > 0 && *self == Self { triangles, ..Self::default() }
    }
}

/// What the textbook decides in three places.
#[derive(Clone, Copy)]
struct Textbook {
    inside: fn(f32) -> bool,
    /// Share of an edge from its values' interpolation.
    share: fn(f32, f32) -> f32,
    /// Lorensen and Cline's symmetry: a case of more than four corners is the mirror of its complement.
    complements: bool,
}

const AS_OURS: Textbook = Textbook {
    inside: |value| f64::from(value) >= ISOVALUE,
    share: |a, b| (ISOVALUE as f32 - a) / (b - a),
    complements: false,
};

impl Textbook {
    /// Marching cubes with one vertex for each cut edge, over a cube of values within a rim of zeros.
    fn mesh(self, values: &[f32]) -> Flaws {
        let n = SIDE as i64;
        let value = |[x, y, z]: [i64; 3]| {
            let inside = [x, y, z].iter().all(|k| (0..n).contains(k));
            if inside { values[((x * n + y) * n + z) as usize] } else { 0.0 }
        };
        let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
        let mut numbers = HashMap::new();
        let cells =
            (-1..n).flat_map(|x| (-1..n).flat_map(move |y| (-1..n).map(move |z| [x, y, z])));
        for cell in cells {
            let corner = |c: i64| [0, 1, 2].map(|k| cell[k] + (c >> k & 1));
            let case =
                (0..8).fold(0_u8, |case, c| case | u8::from((self.inside)(value(corner(c)))) << c);
            let mirrored = self.complements && case.count_ones() > 4;
            let drawn = CASES[usize::from(if mirrored { !case } else { case })];
            for edges in &drawn.triangles[..usize::from(drawn.count)] {
                let mut triangle = edges.map(|edge| {
                    let (axis, bits) = (i64::from(edge / 4), i64::from(edge % 4));
                    let others = [0, 1, 2].into_iter().filter(|k| *k != axis);
                    let low = others.zip([bits & 1, bits >> 1]).fold(0, |low, (k, b)| low | b << k);
                    let ends = [corner(low), corner(low | 1 << axis)];
                    *numbers.entry((ends[0], axis)).or_insert_with(|| {
                        let share = (self.share)(value(ends[0]), value(ends[1]));
                        let mut place = ends[0].map(|k| k as f64);
                        place[axis as usize] += f64::from(share);
                        vertices.push(place);
                        vertices.len() as u32 - 1
                    })
                });
                if mirrored {
                    triangle.reverse();
                }
                triangles.push(triangle);
            }
        }
        Flaws::of(&vertices, &triangles)
    }
}

fn ours(values: &[f32]) -> Flaws {
    let surface = mesh_grid(&unit([SIDE; 3]), values, ISOVALUE).unwrap();
    Flaws::of(&surface.vertices, &surface.triangles)
}

/// A cube of values, each one of these.
fn cube<const N: usize>(seed: u64, of: [f32; N]) -> Vec<f32> {
    let mut draw = Draw::new(&[seed]);
    (0..SIDE.pow(3)).map(|_| draw.pick(of)).collect()
}

#[test]
fn ties_make_no_triangle_without_area_and_no_two_vertices_at_one_place() {
    let values = cube(1, [5.0, 4.0]);
    let naive = AS_OURS.mesh(&values);
    eprintln!("ties, without the clamp: {naive:?}");
    // Every vertex of a tie falls on its grid point.
    assert!(naive.open == 0 && 2 * naive.flat > naive.triangles, "{naive:?}");
    assert!(naive.doubled > naive.triangles / 4, "{naive:?}");
    assert!(ours(&values).none());
}

#[test]
fn faces_with_two_corners_across_are_closed() {
    let values = cube(2, [9.0, 1.0]);
    let naive = Textbook { complements: true, ..AS_OURS }.mesh(&values);
    eprintln!("cases by their complements: {naive:?}");
    assert!(naive.open > 100, "{naive:?}");
    assert!(ours(&values).none());
}

#[test]
fn plateaus_at_the_isovalue_are_one_solid_and_have_no_slope_to_divide_by() {
    // A slab of ties in which every edge has the same value at both ends.
    let values: Vec<f32> = (0..SIDE.pow(3)).map(|k| [5.0, 5.0, 1.0][k / 3 % 3]).collect();
    // "An edge is cut where the isovalue lies between its ends": ends included, so 0 / 0 inside the slab.
    let share = AS_OURS.share;
    assert!(share(5.0, 5.0).is_nan());
    let cut = values.windows(2).filter(|pair| (pair[0] - 5.0) * (pair[1] - 5.0) <= 0.0);
    let nowhere = cut.filter(|pair| share(pair[0], pair[1]).is_nan()).count();
    eprintln!("a plateau: {nowhere} vertices of 0 / 0");
    assert!(nowhere > 300, "{nowhere}");
    assert!(ours(&values).none());
}

#[test]
fn what_is_no_number_is_outside_and_no_vertex_depends_on_it() {
    let values = cube(3, [9.0, 6.5, 1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY]);
    let naive = Textbook {
        inside: |value| f64::from(value).partial_cmp(&ISOVALUE) != Some(Ordering::Less),
        ..AS_OURS
    };
    let naive = naive.mesh(&values);
    eprintln!("no numbers, by the negation of less: {naive:?}");
    assert!(naive.nowhere > 100, "{naive:?}");
    // Even with the right side for NaN the interpolation hands it on.
    assert!(AS_OURS.mesh(&values).nowhere > 100);
    assert!(ours(&values).none());
    let all_nan = vec![f32::NAN; SIDE.pow(3)];
    assert_eq!(ours(&all_nan).triangles, 0);
}

#[test]
fn a_vertex_lies_where_exact_arithmetic_puts_it_over_sixty_orders_of_magnitude() {
    let axes = unit([1, 1, 2]);
    let on_edge = |values: &[f64; 2], isovalue: f64| {
        let Surface { vertices, .. } = mesh_grid(&axes, values, isovalue).unwrap();
        let inner = |v: &&[f64; 3]| v[0] == 0.0 && v[1] == 0.0 && (0.0..1.0).contains(&v[2]);
        vertices.iter().find(inner).unwrap()[2]
    };
    let mut worst = 0.0_f64;
    for isovalue in magnitudes(-30, 30, 1).step_by(6) {
        for inside in magnitudes(-15, 30, 1).step_by(3).map(|ratio| isovalue * (1.0 + ratio)) {
            for outside in magnitudes(-30, 30, 1).flat_map(|v| [v, -v]).filter(|v| *v < isovalue) {
                let [a, b, at] = [inside, outside, isovalue].map(exact);
                let share = rounded(&((&at - &a) / (b - a)));
                let want = share.clamp(CLAMP, 1.0 - CLAMP);
                worst = worst.max((on_edge(&[inside, outside], isovalue) - want).abs());
            }
        }
    }
    eprintln!("vertices: {worst:e} of an edge");
    assert!(worst < 5e-16, "{worst:e}");
    // Half of an edge whose ends' difference overflows: 32 bits put it at the end, and so would 64.
    assert_eq!((AS_OURS.share)(f32::MAX, -f32::MAX), 0.0);
    assert_eq!((ISOVALUE - f64::MAX) / (-f64::MAX - f64::MAX), 0.0);
    assert_eq!(on_edge(&[f64::MAX, -f64::MAX], ISOVALUE), 0.5);
    assert_eq!(on_edge(&[f64::MAX, -f64::MAX], f64::MAX / 2.0), 0.25);
}

#[test]
fn vertices_stay_apart_at_map_coordinates() {
    // A street corner at an easting of 550 km and a northing of 5273 km, in steps of 0.25 m.
    let axis = |from: f64| {
        let at = |k: usize| from + 0.25 * k as f64;
        Axis::new(at(0) - 0.25, (0..SIDE).map(at), at(SIDE)).unwrap()
    };
    let axes = [axis(550_000.0), axis(5_273_000.0), axis(100.0)];
    let surface = mesh_grid(&axes, &cube(4, [9.0, 5.0, 1.0]), ISOVALUE).unwrap();
    assert!(Flaws::of(&surface.vertices, &surface.triangles).none());
    let narrow: Vec<[f64; 3]> =
        surface.vertices.iter().map(|v| v.map(|v| f64::from(v as f32))).collect();
    let naive = Flaws::of(&narrow, &surface.triangles);
    eprintln!("32-bit map coordinates: {naive:?}");
    assert!(naive.doubled > 200 && naive.flat > 200, "{naive:?}");
}

#[test]
fn a_small_body_far_from_the_origin_keeps_its_volume() {
    // A cube of 1 m at the edge of a city of 100 km: its volume is a difference of numbers 1e9 times as large.
    let corner = |c: u32| {
        [50_000.0 + (c & 1) as f32, -30_000.0 + (c >> 1 & 1) as f32, 100.0 + (c >> 2) as f32]
    };
    let faces: [[u32; 4]; 6] =
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles: Vec<[u32; 3]> =
        faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
    let mesh = Mesh { vertices: (0..8).map(corner).collect(), triangles, ..Mesh::default() };
    let naive: f32 = mesh
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|k| mesh.vertices[k as usize]);
            let cross = |i: usize, j: usize| a[i] * b[j] - a[j] * b[i];
            (cross(1, 2) * c[0] + cross(2, 0) * c[1] + cross(0, 1) * c[2]) / 6.0
        })
        .sum();
    eprintln!("a cube of 1 m: {}, in 32 bits {naive}", mesh.signed_volume());
    assert!((mesh.signed_volume() - 1.0).abs() < 1e-6 && (mesh.area() - 6.0).abs() < 1e-12);
    assert!((naive - 1.0).abs() > 10.0, "{naive}");
}
