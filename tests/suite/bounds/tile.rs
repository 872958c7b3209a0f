//! `tile`: what is asked for beside an output, or has no cause, changes no byte of it; meshes, warps
//! and column integrals keep their bounds.

use super::ledger::Ledger;
use super::{Share, draw};
use crate::common::{run, sat3d, stdout, tiny_weights};
use sat3d::crs::{CrsSpec, ResolveOptions, ResolvedCrs, resolve};
use sat3d::footprint::Footprint;
use sat3d::grid::{GeoTransform, LonLat, PixelPoint};
use sat3d::lidar::{PHASE_BITS, PixelMap, PixelToCrs, TransformForm};
use sat3d::model::Scene;
use sat3d::model::field::Field;
use sat3d::model::field::closed_form::{BoxCity, Building};
use sat3d::model::render::{Lattice, ReferenceGrid, RenderOptions, density_grid};
use sat3d::model::scene::SceneParts;
use sat3d::plan::Plan;
use sat3d::raster::OpenOptions;
use sat3d::tile::ColumnIntegral;
use sat3d::tile::city::{Along, City, Levels};
use sat3d::tile::surface::MeshTile;
use sat3d::tile::surface::simplify::{Target, simplify};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The test of each step of the plan.
pub const LEDGER: Ledger = &[
    ("ground-size", SAME),
    ("spool", SAME),
    ("dsm", SAME),
    ("mesh", SAME),
    ("resample", SAME),
    ("scale", SAME),
    ("no-data", SAME),
    ("network", SAME),
    ("densities", &[the_released_lattice_drifts_by_no_more_than_its_bound]),
    ("blend", SAME),
    ("trim", SAME),
    ("spill", SAME),
    ("precision", &[super::infer::a_precision_errs_within_its_bound_and_the_tolerance]),
    ("column-integral", &[the_column_integral_errs_within_its_bound]),
    ("vertical-scale", &[the_column_integral_errs_within_its_bound]),
    ("warp", &[a_warp_keeps_its_bound_between_any_two_crs]),
    ("storage", &[a_stored_height_is_within_its_bound]),
    ("surface", SAME),
    ("simplify", &[a_simplified_surface_is_within_its_error]),
    ("colour", SAME),
    ("tiles3d", &[a_simplified_surface_is_within_its_error, what_has_no_cause_changes_no_output]),
    ("volume", SAME),
];

/// A step without an error of its own: with its cause absent, or done beside another, no byte changes.
const SAME: &[fn()] = &[what_has_no_cause_changes_no_output];

fn weights() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tiny_weights("bounds-tile-weights"))
}

fn tile(folder: &Path, picture: &str, out: &str, extra: &str) -> Command {
    let mut command = sat3d();
    command.args(["tile", "--quiet"]).arg(folder.join(picture)).arg("--out").arg(folder.join(out));
    command.arg("--weights").arg(weights()).args(extra.split_whitespace());
    command
}

fn pictures() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let colour = |x: u32, y: u32| [(x / 2) as u8, (y / 3) as u8, ((x * y) / 400) as u8];
    let rgb = image::RgbImage::from_fn(256, 256, |x, y| image::Rgb(colour(x, y)));
    rgb.save(folder.path().join("rgb.png")).unwrap();
    image::RgbaImage::from_fn(256, 256, |x, y| {
        let [r, g, b] = colour(x, y);
        image::Rgba([r, g, b, 255])
    })
    .save(folder.path().join("rgba.png"))
    .unwrap();
    folder
}

/// Heights of a DSM; NaN where there are none, as bits so that they can be compared.
fn heights(path: &Path) -> Vec<u32> {
    let mut reader = sat3d::raster::open(path, &OpenOptions::default()).unwrap();
    let (across, down) = reader.header().blocks();
    let (mut block, mut all) = (Vec::new(), Vec::new());
    for (bx, by) in (0..down).flat_map(|by| (0..across).map(move |bx| (bx, by))) {
        reader.read_block(bx, by, &mut block).unwrap();
        all.extend(block.iter().map(|z| z.to_bits()));
    }
    all
}

#[test]
pub fn what_has_no_cause_changes_no_output() {
    let folder = pictures();
    let at = folder.path();
    let dsm = |picture: &str, out: &str, extra: &str| {
        run(&mut tile(at, picture, out, &format!("--dsm d.tif {extra}")), 0);
        heights(&at.join(out).join("d.tif"))
    };
    let alone = dsm("rgb.png", "alone", "");
    let beside =
        "--mesh m.ply --tiles3d t --density v.zarr --isovalue 26 --error 2 --memory 1 --preview";
    assert!(dsm("rgb.png", "beside", beside) == alone, "beside everything, its sums in a file");
    // A single window is joined with nothing and has no inner side to trim; opaque is no hole.
    let nothing = "--blend hann --trim 32 --stride 64";
    assert!(dsm("rgba.png", "nothing", nothing) == alone, "{nothing}");
    let plan = plan(at, "rgba.png", "--dsm d.tif --stride 64");
    for id in ["blend", "resample", "trim"] {
        assert!(!plan.step(id).unwrap().on, "{id}");
    }
    // One window is one evaluation of the network, more of them are more.
    let network = |picture: &str, extra: &str| {
        self::plan(at, picture, extra).step("network").unwrap().form.clone()
    };
    assert!(network("rgb.png", "--stride 64").starts_with("1 windows"));
    let wide = image::RgbImage::from_pixel(448, 256, image::Rgb([90, 80, 70]));
    wide.save(at.join("wide.png")).unwrap();
    assert!(network("wide.png", "--stride 192").starts_with("2 windows"));
    assert!(network("wide.png", "--stride 64").starts_with("4 windows"));
}

#[test]
pub fn the_released_lattice_drifts_by_no_more_than_its_bound() {
    let folder = pictures();
    // The training's ground, which is assumed of it: 160 pixels are a cube unit.
    let gsd = 64.48 / 256.0;
    let plan = plan(folder.path(), "rgb.png", "--lattice reference --dsm d.tif");
    assert!(!plan.step("resample").unwrap().on);
    let bound = plan.step("densities").unwrap().bound.horizontal_m;
    let grid = ReferenceGrid::default();
    let step = 2.0 / (grid.count as f64 - 1.0);
    let mut share = Share::new("tile, densities on the released lattice");
    let mut draw = draw(1);
    for _ in 0..20_000 {
        let axes = [0, 1, 2].map(|_| (draw.unit() * grid.count as f64) as usize);
        let index = (axes[0] * grid.count + axes[1]) * grid.count + axes[2];
        let point = grid.point(index);
        // Where the same indices would lie without the drift.
        let off = |k: usize| f64::from(point[k]) + 1.0 - axes[k] as f64 * step;
        let metres = libm::hypot(off(0), off(1)) * 160.0 * gsd;
        share.add(metres, bound, || format!("{axes:?}: {point:?}"));
    }
    share.check();
}

fn city(side: u32, gsd_m: f64, vertical_m: f64) -> City {
    City {
        size: [side; 2],
        footprint: Footprint::of_gsd([side; 2], [gsd_m; 2]),
        assumed: false,
        // As many as a window has.
        levels: Levels { z: Lattice::pixels(256, 0.8).z, ends: [-1.0, 1.0] },
        vertical_m,
        along: Along::X,
    }
}

#[test]
pub fn the_column_integral_errs_within_its_bound() {
    const SIDE: usize = 64;
    let stated = {
        let folder = pictures();
        plan(folder.path(), "rgb.png", "--dsm d.tif").step("column-integral").unwrap().bound
    };
    let mut share = Share::new("tile, column-integral, mean");
    let tall = |roof| Building { x: [-0.5, 0.1], y: [-0.4, 0.3], roof };
    for boxes in [
        BoxCity::example(),
        BoxCity { buildings: vec![tall(0.77)], steepness: 150.0, ..BoxCity::example() },
        BoxCity { buildings: vec![tall(-0.7)], gain: 8.0, bias: -2.0, ..BoxCity::example() },
    ] {
        let (inputs, head) = boxes.inputs();
        let field = Field::new(&inputs, &head, None).unwrap();
        let lattice = Lattice { z: Lattice::pixels(256, 0.8).z, ..Lattice::pixels(SIDE, 0.8) };
        let grid = density_grid(&field, lattice);
        let parts = SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 };
        let dsm = Scene::new(parts).unwrap().dsm(SIDE, &RenderOptions::stable());
        for vertical_m in [32.24, 40.3] {
            let columns =
                ColumnIntegral::new(&city(SIDE as u32, 0.25, vertical_m)).heights(&grid.values);
            let error = (0..SIDE * SIDE)
                .map(|at| {
                    let stable = f64::from(dsm.height[at]) * 2.0 * vertical_m;
                    (stable - f64::from(columns[at % SIDE * SIDE + at / SIDE])).abs()
                })
                .sum::<f64>()
                / (SIDE * SIDE) as f64;
            share.add(error, stated.vertical_m * vertical_m / 32.24, || format!("{vertical_m}"));
        }
    }
    share.check();
}

#[test]
pub fn a_stored_height_is_within_its_bound() {
    let folder = pictures();
    let mut share = Share::new("tile, storage");
    for scale in ["paper", "isotropic"] {
        let extra = format!("--dsm d.tif --vertical-scale {scale} --gsd 0.4");
        let plan = plan(folder.path(), "rgb.png", &extra);
        let bound = plan.step("storage").unwrap().bound.vertical_m;
        let highest = 2.0 * plan.parameters["city"]["vertical_m"].as_f64().unwrap();
        let mut draw = draw(3);
        for _ in 0..2000 {
            let height = draw.range(0.0, highest);
            share.add((f64::from(height as f32) - height).abs(), bound, || format!("{height}"));
        }
    }
    share.check();
}

fn crs(code: u32) -> ResolvedCrs {
    resolve(&CrsSpec::from_epsg(code), &ResolveOptions::default()).unwrap()
}

#[test]
pub fn a_warp_keeps_its_bound_between_any_two_crs() {
    let mut share = Share::new("tile, warp");
    let mut polynomials = 0;
    let places = [
        (47.6, -122.3, 2927, 32_610),
        (59.9, 10.7, 25_832, 25_833),
        (-84.0, 14.0, 32_733, 32_732),
        (84.0, 3.1, 32_631, 32_632),
        (-14.3, -169.5, 2195, 32_702),
    ];
    for (k, (lat_deg, lon_deg, a, b)) in (0_u64..).zip(places) {
        for (from, to) in [(a, b), (b, a)] {
            let (from, to) = (crs(from), crs(to));
            let at = LonLat { lon_deg, lat_deg };
            let (p, q) = (from.projection.forward(at).unwrap(), to.projection.forward(at).unwrap());
            for pixel in [0.1, 0.25, 2.0] {
                // A block of a band: 256 pixels of the one CRS over pixels of the other.
                let pixel_units = pixel / from.metres_per_unit;
                let exact = PixelToCrs::Raster {
                    geotransform: GeoTransform::north_up(p.x, p.y, pixel_units, pixel_units),
                    width: 256,
                    height: 256,
                    from: from.projection.clone(),
                    to: to.projection.clone(),
                };
                let cells = pixel / to.metres_per_unit;
                let grid = GeoTransform::north_up(q.x, q.y, cells, cells);
                let (lattice, _, _) = sat3d::lidar::Lattice::of(&grid, PHASE_BITS).unwrap();
                let fit = |form| PixelMap::fit(exact.clone(), lattice, form).unwrap();
                let (map, truth) = (fit(TransformForm::Chebyshev), fit(TransformForm::Exact));
                // What errs more is projected pixel by pixel.
                if map.errors().chebyshev * to.metres_per_unit > 1e-6 {
                    continue;
                }
                polynomials += 1;
                let mut draw = draw(k);
                for _ in 0..40 {
                    let p = PixelPoint { x: draw.range(0.0, 256.0), y: draw.range(0.0, 256.0) };
                    let (a, b) = (map.coordinate(p).unwrap(), truth.coordinate(p).unwrap());
                    let miss = libm::hypot(a.x - b.x, a.y - b.y) * pixel;
                    share.add(miss, 1e-6, || format!("{} to {}", from.spec.name, to.spec.name));
                }
            }
        }
    }
    assert!(polynomials > 10, "{polynomials}");
    share.check();
}

/// A height field as triangles, a metre apart.
fn terrain(side: u32, height: impl Fn(f64, f64) -> f64) -> MeshTile {
    let vertices = (0..side * side)
        .map(|k| {
            let (x, y) = (f64::from(k % side), f64::from(k / side));
            [x, y, height(x, y)]
        })
        .collect();
    let triangles = (0..(side - 1) * (side - 1))
        .flat_map(|k| {
            let at = k / (side - 1) * side + k % (side - 1);
            [[at, at + 1, at + side + 1], [at, at + side + 1, at + side]]
        })
        .collect();
    MeshTile { vertices, triangles }
}

/// Distance of a point from a triangle, by projection onto its plane and its sides.
fn distance(p: [f64; 3], [a, b, c]: [[f64; 3]; 3]) -> f64 {
    let sub = |u: [f64; 3], v: [f64; 3]| [0, 1, 2].map(|i| u[i] - v[i]);
    let dot = |u: [f64; 3], v: [f64; 3]| (0..3).map(|i| u[i] * v[i]).sum::<f64>();
    let cross = |u: [f64; 3], v: [f64; 3]| {
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    };
    let side = |a: [f64; 3], b: [f64; 3]| {
        let (along, to) = (sub(b, a), sub(p, a));
        let t = (dot(along, to) / dot(along, along)).clamp(0.0, 1.0);
        let off = [0, 1, 2].map(|i| to[i] - t * along[i]);
        dot(off, off).sqrt()
    };
    let normal = cross(sub(b, a), sub(c, a));
    let inside = [(a, b), (b, c), (c, a)]
        .into_iter()
        .all(|(a, b)| dot(cross(sub(b, a), sub(p, a)), normal) >= 0.0);
    if inside && dot(normal, normal) > 0.0 {
        return (dot(sub(p, a), normal) / dot(normal, normal).sqrt()).abs();
    }
    side(a, b).min(side(b, c)).min(side(c, a))
}

#[test]
pub fn a_simplified_surface_is_within_its_error() {
    let mut share = Share::new("tile, simplify");
    let surfaces: [fn(f64, f64) -> f64; 3] = [
        |x, y| 2.0 * libm::sin(x / 3.0) * libm::cos(y / 4.0),
        |x, y| if (6.0..14.0).contains(&x) && (5.0..12.0).contains(&y) { 9.0 } else { 0.2 * x },
        |x, y| 12.0 * libm::exp(-((x - 9.0).powi(2) + (y - 11.0).powi(2)) / 20.0),
    ];
    for (k, surface) in surfaces.into_iter().enumerate() {
        let mesh = terrain(22, surface);
        let corners = |mesh: &MeshTile, t: [u32; 3]| t.map(|i| mesh.vertices[i as usize]);
        let mut before = mesh.triangles.len() + 1;
        for error_m in [0.01, 0.1, 0.5, 2.0] {
            let target = Target { error_m: Some(error_m), triangles: None };
            let (simple, _) = simplify(&mesh, target, false).unwrap();
            // Larger errors leave less to draw.
            assert!(simple.triangles.len() <= before, "surface {k} at {error_m}");
            before = simple.triangles.len();
            let furthest = |of: &MeshTile, from: &MeshTile| {
                let middle = |t: &[u32; 3]| {
                    let c = corners(of, *t);
                    [0, 1, 2].map(|i| (c[0][i] + c[1][i] + c[2][i]) / 3.0)
                };
                let points = of.triangles.iter().flat_map(|t| {
                    let [a, b, c] = corners(of, *t);
                    [a, b, c, middle(t)]
                });
                let nearest = |p| {
                    let all = from.triangles.iter().map(|t| distance(p, corners(from, *t)));
                    all.fold(f64::INFINITY, f64::min)
                };
                points.map(nearest).fold(0.0, f64::max)
            };
            let found = furthest(&mesh, &simple).max(furthest(&simple, &mesh));
            share.add(found, error_m * (1.0 + 1e-6), || format!("surface {k} at {error_m} m"));
        }
        assert!(before < mesh.triangles.len() / 2, "surface {k}: {before} triangles");
    }
    share.check();
}

fn plan(folder: &Path, picture: &str, extra: &str) -> Plan {
    let mut command = tile(folder, picture, "none", extra);
    let text = stdout(&run(command.args(["--explain", "--json"]), 0));
    serde_json::from_str(&text).unwrap()
}

/// Plans with every output and with few.
pub fn plans() -> Vec<Plan> {
    let folder = pictures();
    [
        "",
        "--dsm d.tif --mesh m.glb --tiles3d t --density v.zarr --error 2",
        "--dsm d.tif --lattice reference --trim 32 --stride 64 --blend hann",
    ]
    .iter()
    .map(|extra| plan(folder.path(), "rgb.png", extra))
    .collect()
}
