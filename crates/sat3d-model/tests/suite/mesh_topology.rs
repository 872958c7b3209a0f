//! Marching cubes on grids of any values: closed, wound outward, the right topology, the right place.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::mesh_support;

use mesh_support::{Checked, Solid, dot, length};
use proptest::prelude::*;
use sat3d_model::mesh::{Axis, CLAMP, LayerMesher, MeshError, Surface, mesh_grid};

const ISOVALUE: f64 = 5.0;

/// Axes with steps that differ.
fn uneven(shape: [usize; 3]) -> [Axis; 3] {
    [0, 1, 2].map(|axis| {
        let at = |k: usize| (k as f64 + 0.3 * ((k * 7 + axis * 3) % 5) as f64 / 5.0) * 0.4 - 1.0;
        let points: Vec<f64> = (0..shape[axis]).map(at).collect();
        let behind = points[points.len() - 1] + 0.11;
        Axis::new(-1.2, points, behind).unwrap()
    })
}

fn unit(shape: [usize; 3]) -> [Axis; 3] {
    shape.map(|count| Axis::new(-1.0, (0..count).map(|k| k as f64), count as f64).unwrap())
}

fn checked(surface: &Surface) -> Checked {
    Checked { vertices: surface.vertices.clone(), triangles: surface.triangles.clone() }
}

/// The same mesh with coordinates rounded as a mesh stores them.
fn rounded(surface: &Surface) -> Checked {
    let round = |v: f64| f64::from((v * 40.3) as f32);
    let vertices = surface.vertices.iter().map(|vertex| vertex.map(round)).collect();
    Checked { vertices, triangles: surface.triangles.clone() }
}

/// Feeds the layers one by one.
fn streamed(axes: &[Axis; 3], values: &[f32]) -> Surface {
    let [layers, rows, columns] = axes;
    let at = layers.with_closing_planes();
    let mut mesher = LayerMesher::new(at[0], rows.clone(), columns.clone(), ISOVALUE).unwrap();
    let mut surface = Surface::default();
    for (values, at) in values.chunks(rows.len() * columns.len()).zip(&at[1..]) {
        mesher.push(*at, values, &mut surface).unwrap();
        // All that a triangle needs has been given.
        let given = surface.vertices.len() as u32;
        assert!(surface.triangles.iter().flatten().all(|corner| *corner < given));
    }
    mesher.finish(at[at.len() - 1], &mut surface).unwrap();
    assert_eq!(mesher.vertices(), surface.vertices.len() as u64);
    surface
}

/// All that holds of every mesh.
fn check(shape: [usize; 3], values: &[f32]) -> Surface {
    let axes = uneven(shape);
    let surface = mesh_grid(&axes, values, ISOVALUE).unwrap();
    assert_eq!(surface, streamed(&axes, values), "layer by layer");
    let mesh = checked(&surface);
    let euler = mesh.manifold().unwrap_or_else(|what| panic!("{what}: {shape:?} {values:?}"));
    let rounded = rounded(&surface).manifold();
    assert_eq!(rounded, Ok(euler), "rounded: {shape:?} {values:?}");
    let index = |[x, y, z]: [usize; 3]| (x * shape[1] + y) * shape[2] + z;
    let inside = |point: [usize; 3]| f64::from(values[index(point)]) >= ISOVALUE;
    let solid = Solid { shape, inside: &inside };
    assert_eq!(euler, solid.euler(), "{shape:?} {values:?}");
    // The surface winds once round every inside point and not round the others.
    let mut any = false;
    for (k, value) in values.iter().enumerate() {
        let point = [k / shape[2] / shape[1], k / shape[2] % shape[1], k % shape[2]];
        let is_inside = f64::from(*value) >= ISOVALUE;
        any |= is_inside;
        if values.len() <= 300 {
            let at = [0, 1, 2].map(|axis| axes[axis].with_closing_planes()[point[axis] + 1]);
            let winding = mesh.winding(at);
            let want = f64::from(u8::from(is_inside));
            assert!((winding - want).abs() < 1e-6, "{point:?} {winding}: {shape:?} {values:?}");
        }
    }
    assert_eq!(any, !surface.triangles.is_empty());
    assert!(!any || mesh.volume() > 0.0);
    for vertex in &surface.vertices {
        for (axis, at) in axes.iter().zip(vertex) {
            let ends = axis.with_closing_planes();
            assert!(ends[0] < *at && *at < ends[ends.len() - 1], "inside the closing planes");
        }
    }
    surface
}

/// Values that hit the isovalue, are near it, have no slope or no value.
fn value() -> impl Strategy<Value = f32> {
    let near = ISOVALUE as f32;
    prop_oneof![
        4 => 0.0_f32..10.0,
        3 => Just(near),
        1 => Just(near.next_up()),
        1 => Just(near.next_down()),
        1 => prop_oneof![Just(0.0_f32), Just(1e30), Just(f32::MAX), Just(f32::MIN)],
        1 => prop_oneof![Just(f32::NAN), Just(f32::INFINITY), Just(f32::NEG_INFINITY)],
    ]
}

fn grid(
    value: impl Strategy<Value = f32> + Clone,
) -> impl Strategy<Value = ([usize; 3], Vec<f32>)> {
    (1..7_usize, 1..7_usize, 1..7_usize).prop_flat_map(move |(x, y, z)| {
        (Just([x, y, z]), prop::collection::vec(value.clone(), x * y * z))
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn any_grid((shape, values) in grid(value().boxed())) {
        check(shape, &values);
    }

    /// Ties and plateaus only: every case with every neighbour, all vertices at the clamp.
    #[test]
    fn ties((shape, values) in grid(prop_oneof![Just(5.0_f32), Just(4.0)].boxed())) {
        check(shape, &values);
    }

    /// Points that are rarely inside, and rarely outside: blobs and bubbles.
    #[test]
    fn blobs(
        (shape, values) in grid(prop_oneof![6 => Just(1.0_f32), 1 => 5.0_f32..9.0].boxed()),
    ) {
        check(shape, &values);
        let turned: Vec<f32> = values.iter().map(|value| 10.0 - value).collect();
        check(shape, &turned);
    }

    /// Rows longer than a word of bits, and more layers than a thread takes.
    #[test]
    fn long_rows(
        values in prop::collection::vec(value(), 2 * 2 * 131),
        layers in prop::collection::vec(value(), 2 * 2 * 35),
    ) {
        check([2, 2, 131], &values);
        check([2, 131, 2], &values);
        check([35, 2, 2], &layers);
    }
}

#[test]
fn rows_that_end_with_a_word() {
    for columns in 60..=68 {
        let values: Vec<f32> = (0..4 * columns).map(|k| (k * 7919 % 11) as f32).collect();
        check([2, 2, columns], &values);
        check([2, 2, columns], &vec![7.0; 4 * columns]);
    }
}

#[test]
fn every_case_and_every_pair_of_neighbours() {
    let values = |bits: u32, count: u32, inside: f32| -> Vec<f32> {
        (0..count).map(|k| if bits >> k & 1 == 1 { inside } else { 2.0 }).collect()
    };
    for inside in [5.0, 9.0] {
        for bits in 0..1 << 8 {
            check([2, 2, 2], &values(bits, 8, inside));
        }
    }
    for bits in 0..1 << 12 {
        for shape in [[3, 2, 2], [2, 3, 2], [2, 2, 3]] {
            check(shape, &values(bits, 12, 5.5));
        }
    }
}

#[test]
fn checkerboards_plateaus_nothing_and_everything() {
    for shape in [[4, 5, 6], [1, 1, 1], [1, 7, 3], [9, 1, 1]] {
        let count: usize = shape.iter().product();
        let grid = |value: &dyn Fn(usize) -> f32| (0..count).map(value).collect::<Vec<f32>>();
        let odd = |k: usize| (k / shape[2] / shape[1] + k / shape[2] % shape[1] + k % shape[2]) % 2;
        check(shape, &grid(&|k| if odd(k) == 1 { 5.0 } else { 0.0 }));
        check(shape, &grid(&|k| if odd(k) == 1 { 5.0 } else { f32::NAN }));
        check(shape, &grid(&|k| if odd(k) == 1 { f32::INFINITY } else { f32::NEG_INFINITY }));
        for nothing in [0.0, f32::NAN, f32::NEG_INFINITY, 5.0_f32.next_down()] {
            assert_eq!(check(shape, &grid(&|_| nothing)), Surface::default());
        }
        for all in [5.0, f32::INFINITY, 1e30] {
            let surface = check(shape, &grid(&|_| all));
            // A box whose walls are 1/256 of the outer steps from the closing planes.
            let mesh = checked(&surface);
            let low = mesh
                .vertices
                .iter()
                .fold([f64::INFINITY; 3], |low, v| [0, 1, 2].map(|k| low[k].min(v[k])));
            for (axis, low) in uneven(shape).iter().zip(low) {
                let [plane, point, ..] = axis.with_closing_planes() else { panic!("an axis") };
                assert!((low - (plane + (point - plane) * CLAMP)).abs() < 1e-12, "{low}");
            }
        }
    }
}

#[test]
fn a_vertex_lies_where_the_value_is_the_isovalue_but_never_in_a_grid_point() {
    let axes = unit([1, 1, 2]);
    let top = |values: [f32; 2]| {
        let surface = mesh_grid(&axes, &values, ISOVALUE).unwrap();
        let on_axis = |v: &&[f64; 3]| v[0] == 0.0 && v[1] == 0.0 && v[2] > 0.0;
        surface.vertices.iter().find(on_axis).unwrap()[2]
    };
    assert_eq!(top([9.0, 1.0]), 0.5);
    assert_eq!(top([6.0, 2.0]), 0.25);
    assert_eq!(top([5.0, 2.0]), CLAMP, "a tie");
    assert_eq!(top([6.0, 5.0_f32.next_down()]), 1.0 - CLAMP);
    assert_eq!(top([6.0, f32::NAN]), 1.0 - CLAMP);
    assert_eq!(top([6.0, f32::NEG_INFINITY]), 1.0 - CLAMP);
    assert_eq!(top([f32::INFINITY, 1.0]), 1.0 - CLAMP);
}

/// Radius 0.75 about a point without symmetry, in the cube; densities fall with the radius.
fn sphere(count: usize) -> (f64, f64, f64) {
    let step = 2.0 / count as f64;
    let axis = || Axis::new(-1.0, (0..count).map(|k| (k as f64 + 0.5) * step - 1.0), 1.0).unwrap();
    let axes = [axis(), axis(), axis()];
    let center = [0.031, -0.017, 0.053];
    let at = |k: usize| (k as f64 + 0.5) * step - 1.0;
    let values: Vec<f64> = (0..count.pow(3))
        .map(|k| {
            let point = [at(k / count / count), at(k / count % count), at(k % count)];
            ISOVALUE + 4.0 * (0.75 - length(mesh_support::minus(point, center)))
        })
        .collect();
    let surface = mesh_grid(&axes, &values, ISOVALUE).unwrap();
    let mesh = checked(&surface);
    assert_eq!(mesh.manifold(), Ok(2));
    let pi = std::f64::consts::PI;
    let (volume, area) = (4.0 / 3.0 * pi * 0.75_f64.powi(3), 4.0 * pi * 0.75_f64.powi(2));
    let farthest = surface.vertices.iter().fold(0.0, |far: f64, vertex| {
        far.max((length(mesh_support::minus(*vertex, center)) - 0.75).abs())
    });
    for triangle in &surface.triangles {
        let [a, ..] = mesh.corners(*triangle);
        assert!(dot(mesh.normal(*triangle), mesh_support::minus(a, center)) > 0.0, "outward");
    }
    (mesh.volume() / volume - 1.0, mesh.area() / area - 1.0, farthest)
}

#[test]
fn a_sphere_converges_with_the_square_of_the_step() {
    let errors: Vec<_> = [16, 32, 64, 128].map(sphere).into();
    for (pair, count) in errors.windows(2).zip([16, 32, 64]) {
        let order = |a: f64, b: f64| libm::log2(a.abs() / b.abs());
        let (volume, area) = (order(pair[0].0, pair[1].0), order(pair[0].1, pair[1].1));
        eprintln!("{count}: {:?}, then order {volume:.2} of volume, {area:.2} of area", pair[0]);
        assert!((1.7..2.3).contains(&volume), "volume: order {volume}");
        assert!((1.7..2.3).contains(&area), "area: order {area}");
        // Linear interpolation and, at worst, the clamp.
        assert!(pair[1].2 < 0.6 * pair[0].2, "vertices");
    }
    let (volume, area, farthest) = errors[3];
    eprintln!("128: {:?}", errors[3]);
    assert!(volume.abs() < 1e-3 && area.abs() < 1e-3 && farthest < 2e-4);
}

#[test]
fn any_number_of_threads_gives_the_same_mesh() {
    let shape = [67, 21, 70];
    let mut state = 7_u64;
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 40) as f32 / (1 << 24) as f32 * 9.0
        })
        .collect();
    let axes = uneven(shape);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| mesh_grid(&axes, &values, ISOVALUE).unwrap())
    };
    let one = with(1);
    assert!(one.triangles.len() > 10_000);
    assert_eq!(one, with(5));
    assert_eq!(one, streamed(&axes, &values));
}

#[test]
fn what_is_refused() {
    let axis = |points: &[f64]| Axis::new(0.0, points.iter().copied(), 9.0);
    assert_eq!(axis(&[]), Err(MeshError::NoPoints));
    assert_eq!(axis(&[1.0, 1.0]), Err(MeshError::Axis { before: 1.0, next: 1.0 }));
    assert!(matches!(axis(&[1.0, f64::NAN]), Err(MeshError::Axis { .. })));
    assert!(matches!(axis(&[10.0]), Err(MeshError::Axis { before: 10.0, next: 9.0 })));
    assert!(Axis::new(f64::MIN, [0.0], f64::MAX).is_ok());
    assert!(matches!(Axis::new(f64::NEG_INFINITY, [0.0], 1.0), Err(MeshError::Axis { .. })));
    let axes = unit([2, 2, 2]);
    let wrong = MeshError::Layer { found: 7, expected: 8 };
    assert_eq!(mesh_grid(&axes, &[0.0_f32; 7], 1.0), Err(wrong));
    let isovalue = mesh_grid(&axes, &[0.0_f32; 8], f64::INFINITY);
    assert_eq!(isovalue, Err(MeshError::Isovalue(f64::INFINITY)));
    let [_, rows, columns] = axes;
    let mut mesher = LayerMesher::<f32>::new(0.0, rows, columns, 1.0).unwrap();
    let mut sink = Surface::default();
    let wrong = MeshError::Layer { found: 3, expected: 4 };
    assert_eq!(mesher.push(1.0, &[0.0; 3], &mut sink), Err(wrong));
    mesher.push(1.0, &[0.0; 4], &mut sink).unwrap();
    let wrong = MeshError::Axis { before: 1.0, next: 1.0 };
    assert_eq!(mesher.push(1.0, &[0.0; 4], &mut sink), Err(wrong));
}
