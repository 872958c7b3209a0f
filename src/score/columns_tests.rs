//! Columns against rays through a mesh's triangles, and made grids.

use super::*;
use crate::model::field::closed_form::BoxCity;
use crate::model::mesh::{Mesh, MeshLattice, MeshOptions};
use crate::model::scene::SceneParts;
use crate::random::Draw;

const UNIT_M: f64 = 32.24;

fn city() -> Scene {
    let (inputs, head) = BoxCity { texels: 64, ..BoxCity::example() }.inputs();
    let parts = SceneParts { inputs, head, sky: None, metres_per_unit: UNIT_M };
    Scene::new(parts).expect("a scene")
}

/// The highest point in which vertical rays through pixel centres meet a mesh, exactly: signs of areas of 32-bit
/// coordinates, multiplied in 64 bits. A triangle that stands on edge is met at its corners alone; its edges are
/// those of others. 0 where a ray meets nothing.
fn rasterised(mesh: &Mesh, size: usize, half_m: f64) -> Vec<f32> {
    let centres = Lattice::pixels(size, 0.8);
    // As the mesh rounds coordinates.
    let x: Vec<f64> =
        centres.x.iter().map(|x| f64::from((f64::from(*x) * half_m / 0.8) as f32)).collect();
    let y: Vec<f64> =
        centres.y.iter().map(|y| f64::from((-f64::from(*y) * half_m / 0.8) as f32)).collect();
    let mut top = vec![0.0_f32; size * size];
    for triangle in &mesh.triangles {
        let corners = triangle.map(|index| mesh.vertices[index as usize].map(f64::from));
        let [a, b, c] = corners;
        let area = |p: [f64; 2], q: [f64; 2], r: [f64; 2]| {
            (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        };
        let flat = |p: [f64; 3]| [p[0], p[1]];
        let whole = area(flat(a), flat(b), flat(c));
        let low = |k: usize| corners.iter().map(|p| p[k]).fold(f64::INFINITY, f64::min);
        let high = |k: usize| corners.iter().map(|p| p[k]).fold(f64::NEG_INFINITY, f64::max);
        for row in (0..size).filter(|row| (low(1)..=high(1)).contains(&y[*row])) {
            for column in (0..size).filter(|column| (low(0)..=high(0)).contains(&x[*column])) {
                let ray = [x[column], y[row]];
                let pixel = &mut top[row * size + column];
                for corner in corners.iter().filter(|corner| flat(**corner) == ray) {
                    *pixel = pixel.max(corner[2] as f32);
                }
                let shares = [
                    area(flat(b), flat(c), ray) / whole,
                    area(flat(c), flat(a), ray) / whole,
                    area(flat(a), flat(b), ray) / whole,
                ];
                if whole != 0.0 && shares.iter().all(|share| *share >= 0.0) {
                    let z = shares[0] * a[2] + shares[1] * b[2] + shares[2] * c[2];
                    *pixel = pixel.max(z as f32);
                }
            }
        }
    }
    top
}

#[test]
fn the_top_is_where_rays_meet_the_triangles_of_the_mesh() {
    let scene = city();
    for size in [24, 33] {
        let options = MeshOptions {
            lattice: MeshLattice::Pixels { size },
            vertical_metres_per_unit: UNIT_M,
            ..MeshOptions::default()
        };
        let mesh = scene.mesh(&options).expect("a mesh");
        let half_m = 0.8 * options.horizontal_metres_per_unit[0];
        let rays = rasterised(&mesh, size, half_m);
        let columns = of_scene(&scene, size, options.isovalue, UNIT_M);
        assert_eq!((columns.holes, columns.floaters), (0, 0));
        for (at, (ray, top)) in rays.iter().zip(&columns.top_m).enumerate() {
            assert!((ray - top).abs() < 1e-4, "pixel {at}: {ray} against {top}");
        }
        // Ground at 6.4 m, the tower's roof at 41.9 m; levels are up to 2.2 m apart.
        let (low, high) = columns
            .top_m
            .iter()
            .fold((f32::MAX, f32::MIN), |(low, high), top| (low.min(*top), high.max(*top)));
        assert!((low - 6.4).abs() < 2.3 && (high - 41.9).abs() < 2.3, "{low} to {high}");
    }
}

#[test]
fn the_top_is_the_surface_of_the_city() {
    let (size, city) = (64, BoxCity::example());
    let (inputs, head) = city.inputs();
    let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: UNIT_M });
    let columns = of_scene(&scene.expect("a scene"), size, 5.0, UNIT_M);
    let lattice = Lattice::pixels(size, 0.8);
    // Away from walls, where the map is interpolated.
    let mut seen = 0;
    for (row, y) in lattice.y.iter().enumerate() {
        for (column, x) in lattice.x.iter().enumerate() {
            let z = city.surface(*x, *y);
            let apart = [-0.02, 0.02];
            let other = |dx: f32, dy: f32| city.surface(x + dx, y + dy) != z;
            if apart.iter().any(|dy| apart.iter().any(|dx| other(*dx, *dy))) {
                continue;
            }
            seen += 1;
            // The density reaches 5 about half a level from the surface.
            let error = f64::from(columns.top_m[row * size + column]) - f64::from(z + 1.0) * UNIT_M;
            assert!(error.abs() < 0.9, "{error} m at {row}, {column}");
        }
    }
    assert!(seen > size * size * 3 / 4, "{seen}");
}

/// A grid of columns, each given from below.
fn grid(size: [usize; 2], columns: &[&[f32]]) -> DensityGrid {
    let [down, across] = size;
    let levels = columns[0].len();
    let mut values = Vec::new();
    for column in 0..across {
        for row in 0..down {
            values.extend_from_slice(columns[row * across + column]);
        }
    }
    let even = |count: usize| -> Vec<f32> {
        (0..count).map(|k| (2 * k + 1) as f32 / count as f32 - 1.0).collect()
    };
    let lattice = Lattice { x: even(across), y: even(down), z: even(levels) };
    DensityGrid { lattice, values }
}

#[test]
fn floaters_holes_and_tops_of_a_made_grid() {
    let columns: [&[f32]; 6] = [
        // Ground up to the second level: half way to the third, z = -0.25 + 0.25.
        &[9.0, 9.0, 1.0, 0.0],
        // A bird over it.
        &[9.0, 1.0, 1.0, 9.0],
        // Nothing.
        &[0.0, 1.0, 4.9, 0.0],
        // A roof on nothing.
        &[0.0, 0.0, 5.0, 0.0],
        // All of it.
        &[9.0, 9.0, 9.0, 9.0],
        // Not a number is empty.
        &[9.0, f32::NAN, 9.0, f32::NAN],
    ];
    let found = of_grid(&grid([2, 3], &columns), 5.0, 10.0, -1.0);
    assert_eq!((found.holes, found.floaters), (1, 3));
    let near = |at: usize, height: f64| {
        let top = f64::from(found.top_m[at]);
        assert!((top - height).abs() < 1e-5, "column {at}: {top} against {height}");
    };
    near(0, 10.0);
    // Levels stand at -0.75, -0.25, 0.25, 0.75; the last closes at the cube's top.
    near(1, 10.0 * (1.75 + 0.25 * (1.0 - CLAMP)));
    near(2, 0.0);
    // At the isovalue itself: next to the point.
    near(3, 10.0 * (1.25 + 0.5 * CLAMP));
    near(4, 10.0 * (1.75 + 0.25 * (1.0 - CLAMP)));
    near(5, 10.0 * (1.25 + 0.5 * (1.0 - CLAMP)));
}

#[test]
fn what_is_empty_at_the_bottom_is_no_gap() {
    let columns: [&[f32]; 2] = [&[0.0, 9.0, 9.0, 0.0], &[0.0, 9.0, 0.0, 9.0]];
    let floaters = |lowest| of_grid(&grid([1, 2], &columns), 5.0, 1.0, lowest).floaters;
    // Levels stand at -0.75, -0.25, 0.25 and 0.75.
    assert_eq!([-0.75, -0.74, 0.0, 0.25, 0.26, 1.0].map(floaters), [2, 1, 1, 1, 0, 0]);
}

#[test]
fn solid_ground_of_few_texels_has_no_floaters() {
    // 256 levels a cube unit apart from 64 texels: four of them are below the lowest texel's centre.
    let (mut inputs, head) = BoxCity { texels: 64, ground: -0.9, ..BoxCity::example() }.inputs();
    inputs.scale = 1.0;
    let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: UNIT_M });
    let scene = scene.expect("a scene");
    let grid = density_grid(scene.field(), Lattice::pixels(256, 1.0));
    let lowest: Vec<f32> = grid.values.chunks_exact(256).map(|column| column[0]).collect();
    assert!(lowest.iter().filter(|density| **density < 5.0).count() > 40_000);
    assert_eq!(of_scene(&scene, 256, 5.0, UNIT_M).floaters, 0);
}

#[test]
fn tops_of_noise_are_those_of_its_mesh() {
    use crate::model::mesh::{Axis, mesh_grid};
    // Columns of noise have every case of the mesh: holes, floaters, corners that touch.
    let mut draw = Draw::new(&[11]);
    let size = 12;
    let columns: Vec<Vec<f32>> = (0..size * size)
        .map(|_| {
            (0..7).map(|_| if draw.chance(0.3) { 0.0 } else { 8.0 * draw.unit() as f32 }).collect()
        })
        .collect();
    let made = grid([size, size], &columns.iter().map(Vec::as_slice).collect::<Vec<_>>());
    let axis = |points: &[f32]| {
        Axis::new(-1.0, points.iter().map(|p| f64::from(*p)), 1.0).expect("an axis")
    };
    let axes = [axis(&made.lattice.x), axis(&made.lattice.y), axis(&made.lattice.z)];
    let surface = mesh_grid(&axes, &made.values, 5.0).expect("meshes");
    let found = of_grid(&made, 5.0, 1.0, -1.0);
    assert!(found.floaters > 30 && found.holes > 0, "{} {}", found.floaters, found.holes);
    for (at, top) in found.top_m.iter().enumerate() {
        let ray = [made.lattice.x[at % size], made.lattice.y[at / size]].map(f64::from);
        let on_it = surface.vertices.iter().filter(|v| v[0] == ray[0] && v[1] == ray[1]);
        let highest = on_it.map(|v| v[2] + 1.0).fold(0.0, f64::max);
        assert!((highest - f64::from(*top)).abs() < 1e-6, "column {at}: {highest} against {top}");
    }
}
