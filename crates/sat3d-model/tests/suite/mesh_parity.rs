//! The mesher against the reference's meshes: the published density grids, and what PyMCubes made of them.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::mesh_support;

use mesh_support::{Checked, golden, length, minus};
use sat3d_model::mesh::{Axis, CLAMP, mesh_grid};

const COUNT: usize = 64;

fn surface(mut values: Vec<f32>, border: usize) -> Checked {
    for (index, value) in values.iter_mut().enumerate() {
        let [x, y, z] = [index / COUNT / COUNT, index / COUNT % COUNT, index % COUNT];
        let inside = |k: usize| (border..COUNT - border).contains(&k);
        if !(inside(x) && inside(y) && z >= border) {
            *value = 0.0;
        }
    }
    let last = COUNT as f64 - 1.0;
    let half = 1.0 / last;
    let points = (0..COUNT).map(|k| k as f64 / last * 2.0 - 1.0);
    let axis = Axis::new(-1.0 - half, points, 1.0 + half).unwrap();
    let surface = mesh_grid(&[axis.clone(), axis.clone(), axis], &values, 5.0).unwrap();
    Checked { vertices: surface.vertices, triangles: surface.triangles }
}

/// The reference leaves its mesh open at the top of the cube; here that part is cut off again.
fn open_at_the_top(mesh: &Checked) -> (Vec<[f64; 3]>, Checked) {
    let vertices = mesh.vertices.iter().copied().filter(|v| v[2] <= 1.0).collect();
    let below = |triangle: &[u32; 3]| mesh.corners(*triangle).iter().all(|v| v[2] <= 1.0);
    let triangles = mesh.triangles.iter().copied().filter(below).collect();
    (vertices, Checked { vertices: mesh.vertices.clone(), triangles })
}

#[test]
fn the_references_meshes_vertex_for_vertex() {
    for config in ["tiny", "full"] {
        let (Some(grid), Some(golden)) = (golden(config, "08_grid"), golden(config, "09_mesh"))
        else {
            continue;
        };
        let closed = surface(grid.f32("grid64_raw"), grid.i64("pad")[0] as usize);
        closed.manifold().unwrap();
        let (vertices, open) = open_at_the_top(&closed);
        let [count, faces, area, volume, ..] = golden.f64("counts_area_volume_bbox")[..] else {
            panic!("counts")
        };
        // The same edges are cut, and faces with two inside corners across are joined alike.
        assert_eq!((vertices.len(), open.triangles.len()), (count as usize, faces as usize));
        let relative = |found: f64, wanted: f64| found / wanted - 1.0;
        let (area, volume) = (relative(open.area(), area), relative(open.volume(), volume));
        // Polygons of more than three corners are not flat, and are filled with other triangles; the volume
        // is small beside the many that cancel.
        assert!(area.abs() < 5e-3 && volume.abs() < 5e-3, "{config}: {area} {volume}");
        let bounds = &golden.f64("counts_area_volume_bbox")[4..];
        let step = 2.0 / (COUNT as f64 - 1.0);
        let mut worst = 0.0_f64;
        for k in 0..3 {
            let low = vertices.iter().fold(f64::INFINITY, |low, v| low.min(v[k]));
            let high = vertices.iter().fold(f64::NEG_INFINITY, |high, v| high.max(v[k]));
            worst = worst.max((low - bounds[k]).abs()).max((high - bounds[3 + k]).abs());
        }
        // The clamp moves a vertex by at most its share of a step.
        assert!(worst < CLAMP * step + 1e-6, "{config}: bounds {worst}");
        let samples = golden.f32("vert_sample");
        let mut exact = 0;
        for sample in samples.as_chunks::<3>().0 {
            let sample = sample.map(f64::from);
            let nearest = vertices.iter().map(|v| length(minus(*v, sample))).fold(1.0, f64::min);
            assert!(nearest < CLAMP * step + 1e-6, "{config}: {sample:?} {nearest}");
            exact += usize::from(nearest < 1e-6);
        }
        let total = samples.len() / 3;
        assert!(exact * 100 >= total * 98, "{exact} of {total}: the rest is at the clamp");
        eprintln!(
            "{config}: {count} vertices, {faces} triangles as the reference; area {area:+.2e}, \
             volume {volume:+.2e}, bounds {worst:.1e}; {exact} of {total} vertices within 1e-6"
        );
    }
}
