//! Points, rays, views and grids against the reference's own numbers.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

mod support;

use sat3d_model::field::Field;
use sat3d_model::render::{
    Angles, Border, Camera, Pose, ReferenceGrid, RenderOptions, SkyMap, View, Wanted, dsm,
    reference_grid, render, trace,
};
use support::{Tensors, case, compare, golden, sampled};

const CONFIGS: [&str; 3] = ["tiny", "tiny_triplane", "full"];
const TOLERANCE: f64 = 1e-4;
const COLOR: Wanted = Wanted { color: true, normals: false };

fn fields(config: &str) -> Option<(Field, Field, SkyMap)> {
    let case = case(config)?;
    let plain = Field::new(&case.inputs, &case.head, None).unwrap();
    let lit = plain.with_style(&case.head, Some(&case.style)).unwrap();
    Some((plain, lit, SkyMap::from_padded(&case.sky)))
}

#[test]
fn points() {
    for config in CONFIGS {
        let Some((plain, lit, _)) = fields(config) else { continue };
        let Some(golden) = golden(config, "03_points") else { continue };
        let values = golden.f32("points");
        let points = values.as_chunks::<3>().0;
        let name = |what: &str| format!("{config} points {what}");
        let raw = plain.raw_densities(points);
        compare(&name("raw density"), &raw, &golden.f32("density_raw"), TOLERANCE);
        let (density, colors) = plain.densities_and_colors(points);
        compare(&name("density"), &density, &golden.f32("density"), TOLERANCE);
        assert_eq!(density, plain.densities(points));
        compare(&name("colour, style 0"), &colors, &golden.f32("color_style0"), TOLERANCE);
        let colors = lit.densities_and_colors(points).1;
        compare(&name("colour, sky style"), &colors, &golden.f32("color_style_w"), TOLERANCE);
    }
}

fn rays(name: &str, field: &Field, camera: &Camera, golden: &Tensors) {
    let (width, _) = camera.size();
    let mut all: [Vec<f32>; 5] = Default::default();
    for index in golden.i64("ray_idx") {
        let pixel = [index as usize / width, index as usize % width];
        let trace = trace(field, camera, &RenderOptions::default(), pixel);
        let (coarse, fine) = trace.radii.split_at(48);
        all[0].extend(coarse);
        all[1].extend(&trace.coarse_weights);
        all[2].extend(fine);
        all[3].extend(&trace.merged_radii);
        all[4].extend(&trace.merged_raw);
    }
    let keys = ["radii_coarse", "weights_coarse", "radii_fine", "radii_all", "density_all"];
    for (key, got) in keys.iter().zip(&all) {
        let want = golden.f32(&format!("ray_{key}"));
        // Densities along a ray compare at slightly different places; those at the same place follow.
        let tolerance = if *key == "density_all" { 4e-4 } else { TOLERANCE };
        compare(&format!("{name} rays {key}"), got, &want, tolerance);
    }
    let radii = golden.f32("ray_radii_all");
    let mut points = Vec::new();
    for (index, radii) in golden.i64("ray_idx").into_iter().zip(radii.chunks_exact(96)) {
        let ray = camera.ray(index as usize / width, index as usize % width, 0.8);
        let [origin, direction] = [ray.origin, ray.direction].map(|v| v.map(|v| v as f32));
        points.extend(radii.iter().map(|r| [0, 1, 2].map(|k| origin[k] + r * direction[k])));
    }
    let want = golden.f32("ray_density_all");
    let got = field.raw_densities(&points);
    compare(&format!("{name} rays density at the same radii"), &got, &want, TOLERANCE);
}

#[test]
fn satellite_view_and_dsm() {
    for config in CONFIGS {
        let Some((plain, ..)) = fields(config) else { continue };
        let Some(golden) = golden(config, "04_ortho") else { continue };
        rays(&format!("{config} ortho"), &plain, &Camera::Ortho { size: 64 }, &golden);
        for size in [64, 256] {
            let name = |what: &str| format!("{config} ortho {what} {size}");
            let camera = Camera::Ortho { size };
            let view = render(&plain, None, &camera, &RenderOptions::default(), COLOR);
            compare(&name("depth"), &view.depth, &golden.f32(&format!("depth{size}")), TOLERANCE);
            compare(&name("alpha"), &view.opacity, &golden.f32(&format!("alpha{size}")), TOLERANCE);
            let feature = view.feature.as_ref().unwrap();
            let want = golden.f32(&format!("feature{size}:s"));
            compare(&name("feature"), &sampled(&feature.data, want.len()), &want, TOLERANCE);
            let dsm = dsm(&plain, size, &RenderOptions::default());
            assert_eq!(dsm.opacity, view.opacity, "colour changes nothing else");
            if size == 64 {
                let rgb = &feature.data[..3 * size * size];
                compare(&name("rgb"), rgb, &golden.f32("rgb64"), TOLERANCE);
                compare(&name("dsm"), &dsm.height, &golden.f32("dsm64"), TOLERANCE);
            }
        }
    }
}

fn view(
    name: &str,
    camera: &Camera,
    fields: &(Field, Field, SkyMap),
    golden: &Tensors,
    stride: [usize; 2],
) {
    let (_, lit, sky) = fields;
    let view: View = render(lit, Some(sky), camera, &RenderOptions::default(), COLOR);
    let name = |what: &str| format!("{name} {what}");
    let (mut directions, mut exits) = (Vec::new(), Vec::new());
    for row in (0..view.height).step_by(stride[0]) {
        for column in (0..view.width).step_by(stride[1]) {
            let ray = camera.ray(row, column, 0.8);
            directions.extend(ray.direction.map(|d| d as f32));
            exits.push(ray.inside.unwrap().1 as f32);
        }
    }
    compare(&name("directions"), &directions, &golden.f32("ray_dir_stride"), 1e-6);
    compare(&name("exit distances"), &exits, &golden.f32("tmax_stride"), 1e-6);
    rays(&name(""), lit, camera, golden);
    compare(&name("depth"), &view.depth, &golden.f32("depth"), TOLERANCE);
    compare(&name("alpha"), &view.opacity, &golden.f32("alpha"), TOLERANCE);
    let pixels = view.width * view.height;
    let (feature, composite) = (view.feature.unwrap(), view.composite.unwrap());
    compare(
        &name("feature rgb"),
        &feature.data[..3 * pixels],
        &golden.f32("feature_rgb"),
        TOLERANCE,
    );
    compare(
        &name("composite rgb"),
        &composite.data[..3 * pixels],
        &golden.f32("compo_rgb"),
        TOLERANCE,
    );
    for (key, grid) in [("feature:s", &feature), ("compo:s", &composite)] {
        if golden.has(key) {
            let want = golden.f32(key);
            compare(&name(key), &sampled(&grid.data, want.len()), &want, TOLERANCE);
        }
    }
}

const POSITION: [f64; 3] = [0.25, -0.3, -0.85];

#[test]
fn panorama() {
    for config in CONFIGS {
        let Some(fields) = fields(config) else { continue };
        let Some(golden) = golden(config, "06_pano") else { continue };
        let camera = Camera::panorama(POSITION, 0.8);
        view(&format!("{config} panorama"), &camera, &fields, &golden, [7, 5]);
        let mut sky = Vec::new();
        for channel in 0..3 {
            for index in 0..64 * 256 {
                let mut pixel = vec![0.0; fields.2.channels()];
                let direction = camera.ray(index / 256, index % 256, 0.8).direction;
                fields.2.lookup(direction, RenderOptions::default().sky_seam, &mut pixel);
                sky.push(pixel[channel]);
            }
        }
        compare(&format!("{config} panorama sky"), &sky, &golden.f32("sky_rgb"), TOLERANCE);
    }
}

#[test]
fn perspective() {
    for config in CONFIGS {
        let Some(fields) = fields(config) else { continue };
        let Some(golden) = golden(config, "07_perspective") else { continue };
        let angles = Angles { roll: 0.0, pitch: 10.0, yaw: 35.0 };
        let camera = Camera::perspective(Pose::on_crop(POSITION, angles, 0.8));
        if let Camera::Perspective { intrinsics, pose, .. } = &camera {
            let want = golden.f32("intrinsics");
            let got = [intrinsics.fx, intrinsics.cx, intrinsics.fy, intrinsics.cy];
            for (got, index) in got.into_iter().zip([0, 2, 4, 5]) {
                assert!((got - f64::from(want[index])).abs() < 1e-5, "{got} {}", want[index]);
            }
            let pose: Vec<f32> = (0..3)
                .flat_map(|row| pose.rotation[row].into_iter().chain([pose.position[row]]))
                .map(|value| value as f32)
                .collect();
            compare(&format!("{config} pose"), &pose, &golden.f32("c2w")[..12], 1e-6);
        }
        view(&format!("{config} perspective"), &camera, &fields, &golden, [9, 9]);
    }
}

#[test]
fn rotations_and_panorama_directions() {
    let path = support::goldens().join("common.safetensors");
    let Some(common) = Tensors::open(&path) else {
        eprintln!("SKIPPED rotations: no {}", path.display());
        return;
    };
    for (pitch, yaw) in [(-20, -120), (0, -90), (0, 0), (0, 180), (0, 90), (10, 35)] {
        let want = common.f64(&format!("rot_roll0_pitch{pitch}_yaw{yaw}"));
        let angles = Angles { roll: 0.0, pitch: f64::from(pitch), yaw: f64::from(yaw) };
        for (got, want) in angles.rotation().concat().iter().zip(want) {
            assert!((got - want).abs() < 1e-9, "pitch {pitch} yaw {yaw}: {got} {want}");
        }
    }
    let camera = Camera::panorama(POSITION, 0.8);
    let directions: Vec<f32> = (0..64 * 256)
        .flat_map(|k| {
            let [x, y, z] = camera.ray(k / 256, k % 256, 0.8).direction;
            [x as f32, -y as f32, z as f32]
        })
        .collect();
    compare("panorama directions", &directions, &common.f32("pano_dir_64x256"), 1e-6);
}

#[test]
fn density_grid_with_the_released_drift() {
    for config in CONFIGS {
        let Some((plain, ..)) = fields(config) else { continue };
        let Some(golden) = golden(config, "08_grid") else { continue };
        let of = |border| ReferenceGrid { count: 64, border };
        let points: Vec<f32> =
            (0..256).flat_map(|k| of(Border::Keep).point(k * 1_000_003 % (64 * 64 * 64))).collect();
        compare(&format!("{config} grid points"), &points, &golden.f32("voxel_xyz_samples"), 1e-7);
        let raw = reference_grid(&plain, &of(Border::Keep));
        compare(&format!("{config} grid"), &raw.values, &golden.f32("grid64_raw"), TOLERANCE);
        let (cut, zero) =
            (reference_grid(&plain, &of(Border::Cut)), reference_grid(&plain, &of(Border::Zero)));
        let shape = |key: &str| golden.i64(key).iter().map(|n| *n as usize).collect::<Vec<_>>();
        assert_eq!(cut.shape().to_vec(), shape("grid64_crop_shape"));
        assert_eq!(zero.shape().to_vec(), shape("grid64_nocrop_shape"));
        let p = golden.i64("pad")[0] as usize;
        for (index, value) in raw.values.iter().enumerate() {
            let [x, y, z] = [index / 4096, index / 64 % 64, index % 64];
            let inside = (p..64 - p).contains(&x) && (p..64 - p).contains(&y) && z >= p;
            assert_eq!(zero.values[index], if inside { *value } else { 0.0 });
            if inside {
                let at = ((x - p) * (64 - 2 * p) + y - p) * (64 - p) + z - p;
                assert_eq!(cut.values[at], *value);
            }
        }
    }
}

#[test]
fn illumination_histogram_is_exact() {
    let path = support::goldens().join("common.safetensors");
    let Some(common) = Tensors::open(&path) else {
        eprintln!("SKIPPED histogram: no {}", path.display());
        return;
    };
    let (image, mask) = (common.u8("pano_resized_u8"), common.u8("mask_nearest_u8"));
    let histogram = sat3d_model::illumination::sky_histogram(&image, &mask).unwrap();
    assert_eq!(histogram, common.f32("z_ill"));
}
