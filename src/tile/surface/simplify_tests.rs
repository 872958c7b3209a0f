//! Simplified surfaces beside the originals.

use super::MeshTile;
use super::distance::distance_m;
use super::simplify::{SimplifyError, Target, simplify, simplify_placed};
use super::tests::{Draws, city, is_closed, tiles};
use super::weld::{open_edges, weld};
use crate::tile::city::{Along, City};

const LEVELS: u32 = 32;

/// Densities of boxes on flat ground, whose tops and walls have waves of `noise` metres.
pub(super) fn box_city(city: &City, noise: f64) -> Vec<f32> {
    let mut draws = Draws(3);
    let [lines, across] = city.lines_across();
    let mut values = Vec::new();
    for line in 0..lines {
        for column in 0..across {
            let [block, other] = [line % 40, column % 36];
            let inside = (8..30).contains(&block) && (6..25).contains(&other);
            let height = if inside { 14.0 + f64::from(line / 40) * 9.0 } else { 5.2 };
            let height = height + noise * (draws.next() - 0.5);
            for z in &city.levels.z {
                let above = city.height_m(f64::from(*z)) - height;
                values.push((5.0 - 2.0 * above).clamp(0.0, 10.0) as f32);
            }
        }
    }
    values
}

fn metres(city: &City, mesh: &MeshTile) -> MeshTile {
    let place = |[x, y, z]: &[f64; 3]| [x * 0.25, -y * 0.25, city.height_m(*z)];
    MeshTile {
        vertices: mesh.vertices.iter().map(place).collect(),
        triangles: mesh.triangles.clone(),
    }
}

fn error(error_m: f64) -> Target {
    Target { error_m: Some(error_m), triangles: None }
}

/// Both meshes with one list of vertices, as the measure wants them.
fn distance(a: &MeshTile, b: &MeshTile) -> f64 {
    let mut vertices = a.vertices.clone();
    vertices.extend(&b.vertices);
    let shift = a.vertices.len() as u32;
    let moved: Vec<[u32; 3]> = b.triangles.iter().map(|t| t.map(|corner| corner + shift)).collect();
    distance_m(&vertices, &a.triangles, &moved)
}

/// The largest distance of random points of one mesh from the other, all pairs tried, the triangle cut into
/// small ones instead of solved: an upper bound but for the points' choice.
fn tried(from: &MeshTile, to: &MeshTile, points: usize) -> f64 {
    let mut draws = Draws(11);
    let minus = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|k| a[k] - b[k]);
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let segment = |p: [f64; 3], a: [f64; 3], b: [f64; 3]| {
        let side = minus(b, a);
        let t = (dot(minus(p, a), side) / dot(side, side).max(1e-30)).clamp(0.0, 1.0);
        let to = minus(p, [0, 1, 2].map(|k| a[k] + t * side[k]));
        dot(to, to)
    };
    let mut most = 0.0_f64;
    for _ in 0..points {
        let index = (draws.next() * from.triangles.len() as f64) as usize;
        let [a, b, c] = from.triangles[index].map(|corner| from.vertices[corner as usize]);
        let (mut u, mut v) = (draws.next(), draws.next());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        let p = [0, 1, 2].map(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k]));
        let least = to.triangles.iter().fold(f64::INFINITY, |least, triangle| {
            let [a, b, c] = triangle.map(|corner| to.vertices[corner as usize]);
            let (u, v, w) = (minus(b, a), minus(c, a), minus(p, a));
            // Barycentric coordinates of the foot in the plane; outside, the nearest side.
            let (uu, uv, vv, wu, wv) = (dot(u, u), dot(u, v), dot(v, v), dot(w, u), dot(w, v));
            let whole = uu * vv - uv * uv;
            let (s, t) = ((vv * wu - uv * wv) / whole, (uu * wv - uv * wu) / whole);
            let found = if s >= 0.0 && t >= 0.0 && s + t <= 1.0 {
                let to = minus(p, [0, 1, 2].map(|k| a[k] + s * u[k] + t * v[k]));
                dot(to, to)
            } else {
                segment(p, a, b).min(segment(p, b, c)).min(segment(p, c, a))
            };
            least.min(found)
        });
        most = most.max(least);
    }
    most.sqrt()
}

#[test]
fn the_stated_error_holds_and_the_border_stays() {
    for noise in [0.0, 0.5] {
        let city = city([72, 64], LEVELS, Along::X);
        let values = box_city(&city, noise);
        let tiles: Vec<MeshTile> =
            tiles(&city, &values, 5.0, 32).iter().map(|(_, tile)| metres(&city, tile)).collect();
        for error_m in [0.1, 0.8] {
            let mut simple = Vec::new();
            for tile in &tiles {
                let (found, stated) = simplify(tile, error(error_m), true).expect("simplifies");
                assert!(stated <= error_m, "{stated} of {error_m}");
                assert!((distance(tile, &found) - stated).abs() < 1e-12);
                let points = 100;
                let largest = tried(tile, &found, points).max(tried(&found, tile, points));
                assert!(largest <= 1.02 * stated + 1e-9, "{largest}, and {stated} was stated");
                let bits = |vertex: &[f64; 3]| vertex.map(f64::to_bits);
                let kept = |mesh: &MeshTile| {
                    let ends = |edge: [u32; 2]| {
                        let mut ends = edge.map(|v| bits(&mesh.vertices[v as usize]));
                        ends.sort_unstable();
                        ends
                    };
                    let mut edges: Vec<_> =
                        open_edges(&mesh.triangles).into_iter().map(ends).collect();
                    edges.sort_unstable();
                    edges
                };
                assert_eq!(kept(tile), kept(&found), "open edges");
                let mut all: Vec<_> = tile.vertices.iter().map(bits).collect();
                all.sort_unstable();
                assert!(found.vertices.iter().all(|v| all.binary_search(&bits(v)).is_ok()));
                simple.push(found);
            }
            let whole = weld(&simple);
            assert!(open_edges(&whole.triangles).is_empty(), "{noise} {error_m}");
            assert!(noise > 0.0 || is_closed(&whole), "{error_m}");
            let before: usize = tiles.iter().map(|tile| tile.triangles.len()).sum();
            assert!(whole.triangles.len() < before / 2, "{} of {before}", whole.triangles.len());
        }
    }
}

#[test]
fn a_larger_error_leaves_fewer_triangles() {
    for noise in [0.0, 0.3] {
        let city = city([72, 64], LEVELS, Along::X);
        let whole =
            weld(tiles(&city, &box_city(&city, noise), 5.0, 128).iter().map(|(_, tile)| tile));
        let whole = metres(&city, &whole);
        let counts = [0.1, 0.25, 0.5, 1.0].map(|error_m| {
            simplify(&whole, error(error_m), true).expect("simplifies").0.triangles.len()
        });
        assert!(counts.is_sorted_by(|more, fewer| fewer <= more), "{noise}: {counts:?}");
        assert!(counts[3] * 2 < counts[0], "{noise}: {counts:?}");
    }
}

#[test]
fn flat_ground_collapses() {
    let city = city([64, 64], 8, Along::Y);
    let line: Vec<f32> = city.levels.z.iter().map(|z| if *z < -0.5 { 9.0 } else { 1.0 }).collect();
    let values = line.repeat(64 * 64);
    let tiles = tiles(&city, &values, 5.0, 64);
    let slab = metres(&city, &tiles[0].1);
    assert!(slab.triangles.len() > 16_000);
    // A box has 12; the clamp bevels its edges by a hundredth of a pixel or level, which the first keeps.
    for (error_m, most) in [(0.1, 700), (0.5, 50)] {
        let (found, stated) = simplify(&slab, error(error_m), false).expect("simplifies");
        assert!(found.triangles.len() <= most, "{error_m}: {}", found.triangles.len());
        assert!(stated <= error_m && is_closed(&found));
    }
}

#[test]
fn triangles_are_counted_down_to() {
    let city = city([64, 48], LEVELS, Along::X);
    let whole = weld(tiles(&city, &box_city(&city, 0.3), 5.0, 64).iter().map(|(_, tile)| tile));
    let whole = metres(&city, &whole);
    let target = Target { error_m: None, triangles: Some(1500) };
    let (found, stated) = simplify(&whole, target, true).expect("simplifies");
    assert!((1400..=1500).contains(&found.triangles.len()), "{}", found.triangles.len());
    assert!(stated > 0.0 && open_edges(&found.triangles).is_empty());
    // Of both limits the tighter one holds.
    let both = Target { error_m: Some(0.05), triangles: Some(1500) };
    let (fine, fine_m) = simplify(&whole, both, true).expect("simplifies");
    assert!(fine.triangles.len() > found.triangles.len() && fine_m <= 0.05);
    let (same, none) = simplify(&whole, Target::default(), true).expect("stays");
    assert_eq!((same, none), (whole.clone(), 0.0));
    for wrong in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(simplify(&whole, error(wrong), true), Err(SimplifyError::ErrorM(_))));
    }
    let nowhere = |_| [f64::NAN; 3];
    let refused = simplify_placed(&whole, nowhere, error(1.0), true).expect_err("refused");
    assert!(refused.to_string().contains("triangles"), "{refused}");
}
