//! Small cities, from densities to tiles and files.

use super::sink::SlabMesher;
use super::weld::{open_edges, weld};
use super::{MeshTile, TileIndex};
use crate::footprint::Footprint;
use crate::tile::city::{Along, City, Levels};
use sat3d_model::mesh::{Axis, mesh_grid};
use std::collections::{HashMap, HashSet};

/// Draws that repeat.
pub(super) struct Draws(pub u64);

impl Draws {
    pub fn next(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }
}

pub(super) fn city(size: [u32; 2], levels: u32, along: Along) -> City {
    let z = (0..levels).map(|k| -1.0 + (k as f32 + 0.5) * 2.0 / levels as f32).collect();
    City {
        size,
        footprint: Footprint::of_gsd(size, [0.25, 0.25]),
        assumed: false,
        levels: Levels { z, ends: [-1.0, 1.0] },
        vertical_m: 32.0,
        along,
    }
}

/// Tiles of `side` x `side` columns of a city with densities by line, across, level.
pub(super) fn tiles(
    city: &City,
    values: &[f32],
    isovalue: f64,
    side: u32,
) -> Vec<(TileIndex, MeshTile)> {
    let [lines, across] = city.lines_across();
    let size = across as usize * city.levels.z.len();
    let line = |index: u32| &values[index as usize * size..][..size];
    let mut all = Vec::new();
    for slab in 0..lines.div_ceil(side) {
        let mut mesher = SlabMesher::with_side(city, slab, isovalue, side).expect("a mesher");
        if slab > 0 {
            mesher.prime(line(slab * side - 1)).expect("primes");
        }
        for index in slab * side..((slab + 1) * side).min(lines) {
            mesher.push(index, line(index)).expect("a line");
        }
        all.extend(mesher.finish().expect("tiles"));
    }
    all
}

fn bits(vertex: [f64; 3]) -> [u64; 3] {
    vertex.map(f64::to_bits)
}

/// Triangles by the bits of their corners, the least first.
fn faces(mesh: &MeshTile) -> Vec<[[u64; 3]; 3]> {
    let turned = |corners: &[u32; 3]| {
        let mut face = corners.map(|corner| bits(mesh.vertices[corner as usize]));
        let least = (0..3).min_by_key(|k| face[*k]).unwrap_or_default();
        face.rotate_left(least);
        face
    };
    let mut faces: Vec<_> = mesh.triangles.iter().map(turned).collect();
    faces.sort_unstable();
    faces
}

/// Whether each edge has its opposite exactly once.
pub(super) fn is_closed(mesh: &MeshTile) -> bool {
    let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
    for t in &mesh.triangles {
        for k in 0..3 {
            *edges.entry((t[k], t[(k + 1) % 3])).or_default() += 1;
        }
    }
    edges.iter().all(|((a, b), count)| *count == 1 && edges.get(&(*b, *a)) == Some(&1))
}

/// Six times the volume, in east-north-up.
fn volume(mesh: &MeshTile) -> f64 {
    let place = |corner: u32| {
        let [x, y, z] = mesh.vertices[corner as usize];
        [x, -y, z]
    };
    let term = |t: &[u32; 3]| {
        let [a, b, c] = t.map(place);
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
    };
    mesh.triangles.iter().map(term).sum()
}

/// Densities with blocks, noise, ties at the isovalue, NaN and infinities.
fn random_values(draws: &mut Draws, count: usize) -> Vec<f32> {
    let kind = (draws.next() * 3.0) as u32;
    let value = |draws: &mut Draws| {
        let draw = draws.next();
        match (draws.next() * 20.0) as u32 {
            0 => f32::NAN,
            1..=3 => 5.0,
            4 => f32::INFINITY,
            5 => f32::NEG_INFINITY,
            _ => match kind {
                0 => (draw * 10.0) as f32,
                1 => (draw * 6.0) as f32,
                _ => (draw * 10.0).round() as f32,
            },
        }
    };
    (0..count).map(|_| value(draws)).collect()
}

#[test]
fn tiles_are_the_surface_of_the_whole() {
    let mut draws = Draws(7);
    for (size, side) in
        [([19, 11], 8), ([8, 8], 8), ([33, 17], 16), ([9, 26], 8), ([1, 1], 8), ([3, 40], 8)]
    {
        for along in [Along::X, Along::Y] {
            for _ in 0..3 {
                let city = city(size, 6, along);
                let [lines, across] = city.lines_across();
                let values = random_values(&mut draws, lines as usize * across as usize * 6);
                let tiles = tiles(&city, &values, 5.0, side);
                let whole = weld(tiles.iter().map(|(_, tile)| tile));

                let axis = |count: u32| {
                    let centres = (0..count).map(|k| f64::from(k) + 0.5);
                    Axis::new(0.0, centres, count.into()).expect("an axis")
                };
                let z = city.levels.z.iter().map(|z| f64::from(*z));
                let axes = [axis(lines), axis(across), Axis::new(-1.0, z, 1.0).expect("an axis")];
                let oracle = mesh_grid(&axes, &values, 5.0).expect("a surface");
                let oracle = MeshTile {
                    vertices: oracle
                        .vertices
                        .iter()
                        .map(|[line, across, z]| match along {
                            Along::X => [*line, *across, *z],
                            Along::Y => [*across, *line, *z],
                        })
                        .collect(),
                    triangles: match along {
                        Along::X => oracle.triangles.iter().map(|[a, b, c]| [*c, *b, *a]).collect(),
                        Along::Y => oracle.triangles,
                    },
                };
                let set = |mesh: &MeshTile| -> HashSet<[u64; 3]> {
                    mesh.vertices.iter().map(|v| bits(*v)).collect()
                };
                assert_eq!(whole.vertices.len(), oracle.vertices.len(), "{size:?} {along:?}");
                assert_eq!(set(&whole), set(&oracle));
                let found = faces(&whole);
                assert!(found.windows(2).all(|pair| pair[0] != pair[1]), "a face comes twice");
                assert_eq!(found, faces(&oracle));
                assert!(is_closed(&whole));
                assert!(open_edges(&whole.triangles).is_empty());
                if !whole.triangles.is_empty() {
                    assert!(volume(&whole) > 0.0);
                }
                for (TileIndex { row, column }, tile) in &tiles {
                    let used: HashSet<u32> = tile.triangles.iter().flatten().copied().collect();
                    assert_eq!(used.len(), tile.vertices.len(), "no vertex without a triangle");
                    // Cells of the tile's points reach half a pixel to the north-west.
                    for [x, y, _] in &tile.vertices {
                        for (value, tile) in [(x, column), (y, row)] {
                            let low = f64::from(tile * side) - 0.5;
                            let high = f64::from((tile + 1) * side);
                            assert!((low..=high).contains(value), "{value} {tile}");
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn lines_out_of_turn_are_refused() {
    let city = city([20, 4], 3, Along::X);
    let line = vec![9.0; 12];
    let mesher = |slab| SlabMesher::with_side(&city, slab, 5.0, 8).expect("a mesher");
    assert!(mesher(1).push(8, &line).is_err(), "not primed");
    assert!(mesher(0).push(1, &line).is_err());
    assert!(mesher(0).push(0, &line[1..]).is_err());
    assert!(mesher(0).finish().is_err(), "no lines");
    let mut last = mesher(2);
    last.prime(&line).expect("primes");
    for index in 16..20 {
        last.push(index, &line).expect("a line");
    }
    assert!(last.push(20, &line).is_err());
    assert_eq!(last.finish().expect("tiles").len(), 1);
    assert!(SlabMesher::with_side(&city, 1, f64::NAN, 8).is_err());
}
