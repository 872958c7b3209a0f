//! Meshes of a city of boxes: orientation, metres, colours, what is refused.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::mesh_support;

use mesh_support::{Checked, length};
use sat3d_model::Scene;
use sat3d_model::field::closed_form::BoxCity;
use sat3d_model::mesh::{CLAMP, Mesh, MeshColor, MeshError, MeshFrame, MeshLattice, MeshOptions};
use sat3d_model::scene::SceneParts;

fn scene() -> Scene {
    let (inputs, head) = BoxCity::example().inputs();
    Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 }).unwrap()
}

const SIZE: usize = 96;

fn options() -> MeshOptions {
    MeshOptions { lattice: MeshLattice::Pixels { size: SIZE }, ..MeshOptions::default() }
}

fn checked(mesh: &Mesh) -> Checked {
    let vertices = mesh.vertices.iter().map(|vertex| vertex.map(f64::from)).collect();
    Checked { vertices, triangles: mesh.triangles.clone() }
}

/// Bounds of the faces that look up and lie within half a metre of a height, and their area.
fn roof(mesh: &Checked, height: f64) -> ([[f64; 2]; 2], f64) {
    let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
    let mut area = 0.0;
    for triangle in &mesh.triangles {
        let corners = mesh.corners(*triangle);
        let normal = mesh.normal(*triangle);
        if corners.iter().any(|c| (c[2] - height).abs() > 0.5) || normal[2] < 0.9 * length(normal) {
            continue;
        }
        area += length(normal) / 2.0;
        for corner in corners {
            for k in 0..2 {
                bounds[0][k] = bounds[0][k].min(corner[k]);
                bounds[1][k] = bounds[1][k].max(corner[k]);
            }
        }
    }
    (bounds, area)
}

/// The tower stands in the north-east, the hall in the south, the house in the west.
#[test]
fn east_is_x_north_is_y_up_is_z() {
    let (scene, options) = (scene(), options());
    let mesh = scene.mesh(&options).unwrap();
    assert_eq!(mesh.frame, MeshFrame::EastNorthUp);
    let checked = checked(&mesh);
    assert_eq!(checked.manifold(), Ok(2), "one closed surface without handles");
    let pixel = 64.48 / SIZE as f64;
    for building in BoxCity::example().buildings {
        let height = f64::from(building.roof + 1.0) * 32.24;
        let ([low, high], area) = roof(&checked, height);
        let [x, y] = [building.x, building.y].map(|range| range.map(|v| f64::from(v) * 40.3));
        let wanted = [x[0], -y[1], x[1], -y[0]];
        let found = [low[0], low[1], high[0], high[1]];
        for (wanted, found) in wanted.iter().zip(found) {
            assert!((wanted - found).abs() < 1.5 * pixel, "roof at {height}: {wanted} {found}");
        }
        // A mirrored building would have its roof's faces look down.
        let wanted = (x[1] - x[0]) * (y[1] - y[0]);
        assert!((area / wanted - 1.0).abs() < 0.25, "roof at {height}: {area} {wanted}");
    }
    let tower = roof(&checked, 1.3 * 32.24).0;
    assert!(tower[0][0] > 0.0 && tower[0][1] > 0.0, "north-east is x > 0, y > 0");
    let [low, high] = mesh.bounds().unwrap().map(|corner| corner.map(f64::from));
    assert!((high[2] - 1.3 * 32.24).abs() < 0.7, "the tower's roof is the highest: {high:?}");
    // Walls and floor stand inside the crop, the clamp's share of half a step from its edge.
    let (half, level) = (pixel / 2.0, 2.0 * 32.24 / 120.0 / 2.0);
    let near = |found: f64, wanted: f64| (found - wanted).abs() < 1e-5;
    for k in 0..2 {
        assert!(near(low[k], -32.24 + half * CLAMP) && near(high[k], 32.24 - half * CLAMP));
    }
    assert!(near(low[2], level * CLAMP), "{low:?}");
}

#[test]
fn volume_and_area_are_the_citys() {
    let city = BoxCity::example();
    let mesh = scene().mesh(&options()).unwrap();
    let base = 64.48 * 64.48 * f64::from(city.ground + 1.0) * 32.24;
    let volume: f64 = base
        + (city.buildings.iter())
            .map(|b| {
                let [x, y] = [b.x, b.y].map(|range| f64::from(range[1] - range[0]) * 40.3);
                x * y * f64::from(b.roof - city.ground) * 32.24
            })
            .sum::<f64>();
    let found = mesh.signed_volume();
    // Density rises so steeply that the surface lies up to a step outside the last inside point.
    assert!((found / volume - 1.0).abs() < 0.06, "{found} {volume}");
    let checked = checked(&mesh);
    assert!((found / checked.volume() - 1.0).abs() < 1e-9);
    assert!((mesh.area() / checked.area() - 1.0).abs() < 1e-9);
}

#[test]
fn metres_per_unit_stretch_each_axis() {
    let scene = scene();
    let one = scene.mesh(&options()).unwrap();
    let stretched = MeshOptions {
        horizontal_metres_per_unit: [80.6, 20.15],
        vertical_metres_per_unit: 40.3,
        ..options()
    };
    let other = scene.mesh(&stretched).unwrap();
    assert_eq!(one.triangles, other.triangles);
    for (one, other) in one.vertices.iter().zip(&other.vertices) {
        for (k, factor) in [2.0, 0.5, 40.3 / 32.24].into_iter().enumerate() {
            assert!((f64::from(one[k]) * factor - f64::from(other[k])).abs() < 2e-5);
        }
    }
}

/// The reference writes x south, y up, z west.
#[test]
fn the_reference_frame_is_the_same_body_turned() {
    let scene = scene();
    let metres = scene.mesh(&options()).unwrap();
    let cube = scene.mesh(&MeshOptions { frame: MeshFrame::Reference, ..options() }).unwrap();
    assert_eq!(metres.triangles, cube.triangles, "wound outward in both");
    assert!(cube.signed_volume() > 0.0);
    for ([east, north, up], [south, level, west]) in metres.vertices.iter().zip(&cube.vertices) {
        let place = [-*west, -*south, *level].map(f64::from);
        let wanted =
            [f64::from(*east) / 40.3, f64::from(*north) / 40.3, f64::from(*up) / 32.24 - 1.0];
        for (found, wanted) in place.iter().zip(wanted) {
            assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
        }
    }
}

#[test]
fn the_reference_lattice_closes_above_the_cube_too() {
    // Solid up to the top in the tower.
    let mut city = BoxCity::example();
    city.buildings[0].roof = 1.5;
    let (inputs, head) = city.inputs();
    let parts = SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 };
    let options = MeshOptions {
        lattice: MeshLattice::Reference { count: 64 },
        frame: MeshFrame::Reference,
        ..MeshOptions::default()
    };
    let mesh = Scene::new(parts).unwrap().mesh(&options).unwrap();
    assert_eq!(checked(&mesh).manifold(), Ok(2));
    let [low, high] = mesh.bounds().unwrap();
    let top = 1.0 + (1.0 - CLAMP as f32) / 63.0;
    assert!((high[1] - top).abs() < 1e-6, "{high:?}");
    // The zeroed border is 6 points wide.
    assert!(low[0] > -1.0 + 5.0 * 2.0 / 63.0 && high[0] < 1.0 - 5.0 * 2.0 / 63.0);
}

#[test]
fn colours_are_the_fields_and_texture_is_the_images() {
    let scene = scene();
    let mesh = scene.mesh(&MeshOptions { color: MeshColor::Field, ..options() }).unwrap();
    let colors = mesh.colors.as_ref().unwrap();
    assert_eq!(colors.len(), mesh.vertices.len());
    assert!(mesh.texture_coordinates.is_none());
    let points: Vec<[f32; 3]> =
        (mesh.vertices.iter()).map(|[x, y, z]| [x / 40.3, -y / 40.3, z / 32.24 - 1.0]).collect();
    let wanted = scene.field().densities_and_colors(&points).1;
    for (color, wanted) in colors.iter().zip(wanted.chunks_exact(3)) {
        for (found, wanted) in color.iter().zip(wanted) {
            // Cut off, and the vertex was rounded.
            let below = wanted * 255.0 - f32::from(*found);
            assert!((-0.01..1.01).contains(&below), "{found} {}", wanted * 255.0);
        }
    }
    // Red grows with the roof.
    let red = |low: f32, high: f32| {
        let mean = |(sum, count): (f32, f32)| sum / count;
        mean(mesh.vertices.iter().zip(colors).fold((0.0, 0.0), |(sum, count), (v, c)| {
            if (low..high).contains(&v[2]) {
                (sum + f32::from(c[0]), count + 1.0)
            } else {
                (sum, count)
            }
        }))
    };
    assert!(red(40.0, 45.0) > red(5.0, 8.0) + 20.0);

    let mesh = scene.mesh(&MeshOptions { color: MeshColor::Texture, ..options() }).unwrap();
    assert!(mesh.colors.is_none());
    let texture = mesh.texture_coordinates.as_ref().unwrap();
    for ([x, y, _], [u, v]) in mesh.vertices.iter().zip(texture) {
        assert!((u - (x / 64.48 + 0.5)).abs() < 1e-5 && (v - (0.5 - y / 64.48)).abs() < 1e-5);
        assert!((0.0..=1.0).contains(u) && (0.0..=1.0).contains(v));
    }
    let none = scene.mesh(&options()).unwrap();
    assert!(none.colors.is_none() && none.texture_coordinates.is_none());
    assert_eq!(none.triangles, mesh.triangles);
}

#[test]
fn same_bytes_for_any_number_of_threads() {
    let scene = scene();
    let options = MeshOptions { color: MeshColor::Field, ..options() };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scene.mesh(&options).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn what_is_refused_and_what_is_empty() {
    let scene = scene();
    let refused = |options: MeshOptions| scene.mesh(&options).unwrap_err();
    for isovalue in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(matches!(refused(MeshOptions { isovalue, ..options() }), MeshError::Isovalue(_)));
    }
    for metres in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = || MeshOptions { vertical_metres_per_unit: metres, ..options() };
        assert!(matches!(refused(options()), MeshError::MetresPerUnit(_)));
        let horizontal_metres_per_unit = [40.3, metres];
        let options = MeshOptions { horizontal_metres_per_unit, ..self::options() };
        assert!(matches!(refused(options), MeshError::MetresPerUnit(_)));
    }
    let far = refused(MeshOptions { vertical_metres_per_unit: 1e308, ..options() });
    assert!(matches!(far, MeshError::TooFine { .. }), "{far}");
    let lattice = |lattice| refused(MeshOptions { lattice, ..options() });
    let few = lattice(MeshLattice::Pixels { size: 0 });
    assert_eq!(few, MeshError::Lattice { found: 0, least: 1 });
    let few = lattice(MeshLattice::Reference { count: 1 });
    assert_eq!(few, MeshError::Lattice { found: 1, least: 2 });
    for size in [20_000, usize::MAX] {
        let fine = lattice(MeshLattice::Pixels { size });
        assert!(matches!(fine, MeshError::TooFine { .. }), "{fine}");
        let fine = lattice(MeshLattice::Reference { count: size });
        assert!(matches!(fine, MeshError::TooFine { .. }), "{fine}");
    }
    let empty = scene.mesh(&MeshOptions { isovalue: 1e30, ..options() }).unwrap();
    assert_eq!(empty, Mesh::default());
    assert_eq!((empty.bounds(), empty.area(), empty.signed_volume()), (None, 0.0, 0.0));
    for size in 1..6 {
        let small = MeshOptions { lattice: MeshLattice::Pixels { size }, ..options() };
        checked(&scene.mesh(&small).unwrap()).manifold().unwrap();
    }
}
