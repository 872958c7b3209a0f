//! A city of boxes, whose surface is known: accuracy of the quadratures, orientation, cameras.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d_model::Grid;
use sat3d_model::field::Field;
use sat3d_model::field::closed_form::BoxCity;
use sat3d_model::render::{
    Angles, Camera, DepthKind, Dsm, Intrinsics, Lattice, Pose, RELEASED_RMS, RenderOptions,
    STABLE_RMS, SampleCounts, Sampling, SkyMap, View, Wanted, density_grid, dsm, frames, render,
};
use sat3d_model::scene::{Scene, SceneParts, SkyParts};

fn field(city: &BoxCity) -> Field {
    let (inputs, head) = city.inputs();
    Field::new(&inputs, &head, None).unwrap()
}

/// Depth of a column by brute force: density at 20000 heights, integrated in double precision.
fn exact_depth(field: &Field, x: f32, y: f32) -> f64 {
    const COUNT: usize = 20_000;
    let width = 2.0 / COUNT as f64;
    let radius = |k: usize| (k as f64 + 0.5) * width;
    let points: Vec<[f32; 3]> = (0..COUNT).map(|k| [x, y, (1.0 - radius(k)) as f32]).collect();
    let (mut tau, mut sum, mut opacity) = (0.0, 0.0, 0.0);
    for (k, sigma) in field.densities(&points).iter().enumerate() {
        let step = f64::from(*sigma) * width;
        let weight = libm::exp(-tau) * -libm::expm1(-step);
        sum += weight * radius(k);
        opacity += weight;
        tau += step;
    }
    sum / opacity
}

/// Root of the mean squared error in metres, 40.3 to a cube unit.
fn rms(field: &Field, options: &RenderOptions) -> f64 {
    const SIZE: usize = 16;
    let heights = dsm(field, SIZE, options).height;
    let mut sum = 0.0;
    for (index, height) in heights.iter().enumerate() {
        let ray = Camera::Ortho { size: SIZE }.ray(index / SIZE, index % SIZE, 0.8);
        let want = exact_depth(field, ray.origin[0] as f32, ray.origin[1] as f32);
        let error = (2.0 - 2.0 * f64::from(*height) - want) * 40.3;
        sum += error * error;
    }
    (sum / heights.len() as f64).sqrt()
}

#[test]
fn stable_is_several_times_closer_to_the_exact_integral() {
    let released = RenderOptions { depth: DepthKind::Normalised, ..RenderOptions::default() };
    let mut ratios = Vec::new();
    for (steepness, gain, bias) in
        [(400.0, 40.0, -4.0), (400.0, 1.0, -9.0), (400.0, 5.0, -6.0), (150.0, 8.0, -6.0)]
    {
        let city = BoxCity { steepness, gain, bias, ..BoxCity::example() };
        let field = field(&city);
        let (stable, reference) = (rms(&field, &RenderOptions::stable()), rms(&field, &released));
        eprintln!(
            "steepness {steepness}, gain {gain}: stable {stable:.4} m, reference {reference:.4} m"
        );
        assert!(stable < 0.05, "{stable} m");
        assert!(reference > 2.4 * stable, "reference {reference} m, stable {stable} m");
        // What plans say, in cube units.
        assert!(stable <= 40.3 * STABLE_RMS && reference <= 40.3 * RELEASED_RMS);
        ratios.push(reference / stable);
    }
    let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
    assert!(mean > 5.0, "the released rule errs {mean:.1} times as much on average");
}

fn at(dsm: &Dsm, x: f64, y: f64) -> f32 {
    let index = |c: f64| ((c / 0.8 + 1.0) / 2.0 * dsm.size as f64) as usize;
    dsm.height[index(y) * dsm.size + index(x)]
}

#[test]
fn the_dsm_has_north_up_east_right_and_heights_that_rise() {
    let field = field(&BoxCity::example());
    for options in [RenderOptions::default(), RenderOptions::stable()] {
        let dsm = dsm(&field, 128, &options);
        let near = |got: f32, z: f32| (got - (z + 1.0) / 2.0).abs() < 0.01;
        assert!(near(at(&dsm, 0.45, -0.5), 0.3), "tower, north-east {}", at(&dsm, 0.45, -0.5));
        assert!(near(at(&dsm, 0.1, 0.5), -0.35), "hall, south {}", at(&dsm, 0.1, 0.5));
        assert!(near(at(&dsm, -0.5, -0.1), -0.55), "house, west {}", at(&dsm, -0.5, -0.1));
        assert!(near(at(&dsm, -0.5, 0.5), -0.8), "ground {}", at(&dsm, -0.5, 0.5));
        // Row 0 and the last column are where the tower is.
        let quarter = |rows: std::ops::Range<usize>, columns: std::ops::Range<usize>| {
            let cells = rows.flat_map(|r| columns.clone().map(move |c| r * 128 + c));
            cells.map(|k| dsm.height[k]).fold(0.0, f32::max)
        };
        assert!(quarter(0..64, 64..128) > 0.6 && quarter(0..64, 0..64) < 0.3);
        assert!(dsm.opacity.iter().all(|opacity| *opacity > 0.99));
        assert!(dsm.depth_spread.iter().all(|spread| *spread < 0.2));
    }
}

fn color() -> Wanted {
    Wanted { color: true, normals: true }
}

#[test]
fn the_panorama_looks_north_in_its_centre_and_east_to_the_right() {
    let field = field(&BoxCity::example());
    let camera = Camera::panorama([0.0, 0.0, -0.85], 0.8);
    let view = render(&field, None, &camera, &RenderOptions::stable(), color());
    // The horizon: columns whose rays go up by 20 degrees see the tower (north-east) and the hall (south).
    let row = (70.0 / 180.0 * 63.0_f64).round() as usize;
    let (south, north): (Vec<f64>, Vec<f64>) = (0..256)
        .filter(|column| view.opacity[row * 256 + column] > 0.5)
        .map(|column| (column as f64 / 255.0 - 0.5) * 360.0)
        .partition(|azimuth| azimuth.abs() > 100.0);
    assert!(!north.is_empty() && north.iter().all(|a| (30.0..62.0).contains(a)), "{north:?}");
    // The hall reaches further to the east than to the west.
    let (west, east): (Vec<f64>, Vec<f64>) = south.iter().partition(|azimuth| **azimuth < 0.0);
    assert!(west.len() > 5 && east.len() > west.len() + 5, "{west:?} {east:?}");
    // Below the horizon there is ground everywhere; at the zenith nothing.
    assert!(view.opacity[60 * 256..].iter().all(|opacity| *opacity > 0.99));
    assert!(view.depth[0].is_nan() && view.opacity[0] < 0.05);
}

fn centre(view: &View) -> usize {
    view.height / 2 * view.width + view.width / 2
}

#[test]
fn perspective_turns_right_and_normals_face_the_camera() {
    let field = field(&BoxCity::example());
    let of = |pose: Pose| {
        let intrinsics = Intrinsics { fx: 64.0, fy: 64.0, cx: 32.0, cy: 32.0 };
        let camera = Camera::Perspective { width: 65, height: 65, intrinsics, pose };
        render(&field, None, &camera, &RenderOptions::stable(), color())
    };
    // From the west of the tower, looking east: its western wall.
    let angles = Angles { yaw: 90.0, ..Angles::default() };
    let eye = frames::from_crop([-0.6, -0.5, -0.2], 0.8);
    let view = of(Pose { position: eye, rotation: angles.rotation() });
    let middle = centre(&view);
    assert!((f64::from(view.depth[middle]) - (0.35 + 0.4)).abs() < 0.02, "{}", view.depth[middle]);
    let normal = view.normals.as_ref().unwrap()[middle];
    assert!(normal[0] < -0.95, "the western wall faces west: {normal:?}");
    // The wall's northern end is on the left, its southern end on the right; the sky is above.
    assert!(view.opacity[0] < 0.05, "above the tower");
    // Looking down: the ground, whose normal is up.
    let down = of(Pose::looking_at([-0.5, -0.5, 0.5], [-0.5, -0.5, -0.8]).unwrap());
    let middle = centre(&down);
    assert!((down.depth[middle] - 1.3).abs() < 0.02, "{}", down.depth[middle]);
    assert!(down.normals.as_ref().unwrap()[middle][2] > 0.99);
    // The same from far outside the cube: sampling starts at the entry, depth is from the camera.
    let far = of(Pose::looking_at([-0.5, -0.5, 4.0], [-0.5, -0.5, -0.8]).unwrap());
    assert!((far.depth[middle] - 4.8).abs() < 0.02, "{}", far.depth[middle]);
    // A ray that misses the cube is sky.
    let away = of(Pose::looking_at([0.0, 0.0, 4.0], [0.0, 0.0, 9.0]).unwrap());
    assert!(away.opacity.iter().all(|opacity| *opacity == 0.0));
    assert!(away.depth.iter().all(|depth| depth.is_nan()));
    assert!(away.feature.unwrap().data.iter().all(|value| *value == 0.0));
    assert!(away.normals.unwrap().iter().all(|normal| normal[0].is_nan()));
}

#[test]
fn the_grid_is_solid_below_the_surface() {
    let city = BoxCity::example();
    let field = field(&city);
    let grid = density_grid(&field, Lattice::pixels(64, 0.8));
    let [nx, ny, nz] = grid.shape();
    assert_eq!([nx, ny, nz], [64, 64, 80]);
    let mut checked = 0;
    for (index, value) in grid.values.iter().enumerate() {
        let (x, y, z) = (index / (ny * nz), index / nz % ny, index % nz);
        let (x, y, z) = (grid.lattice.x[x], grid.lattice.y[y], grid.lattice.z[z]);
        // Away from walls and from the surface itself.
        let around =
            [-0.02, 0.0, 0.02].map(|a| [-0.02, 0.0, 0.02].map(|b| city.surface(x + a, y + b)));
        let level = around.as_flattened().iter().all(|h| *h == around[0][0]);
        let above = z - around[0][0];
        if level && above.abs() > 0.05 {
            assert_eq!(*value > 1.0, above < 0.0, "{x} {y} {z}: {value}");
            checked += 1;
        }
    }
    assert!(checked > 200_000, "{checked}");
}

#[test]
fn one_thread_and_many_give_the_same_bytes() {
    let field = field(&BoxCity { steepness: 30.0, ..BoxCity::example() });
    let sky =
        SkyMap::from_decoder(&Grid::new(3, 8, 8, (0..192).map(|k| k as f32 / 192.0).collect()));
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let camera = Camera::panorama([0.1, 0.2, -0.3], 0.8);
            let view = render(&field, Some(&sky), &camera, &RenderOptions::default(), color());
            let pose =
                Pose::on_crop([0.1, 0.2, -0.3], Angles { yaw: 40.0, ..Angles::default() }, 0.8);
            let stable = RenderOptions::stable();
            let pinhole = render(&field, Some(&sky), &Camera::perspective(pose), &stable, color());
            let above = render(&field, None, &Camera::Ortho { size: 40 }, &stable, color());
            let dsm = dsm(&field, 50, &stable);
            let grid = density_grid(&field, Lattice::pixels(30, 0.8));
            let colors = view.composite.unwrap().data;
            let normals = [view.normals, pinhole.normals, above.normals]
                .map(|normals| normals.unwrap().concat())
                .concat();
            let colors = [colors, pinhole.composite.unwrap().data, above.feature.unwrap().data];
            let depths = [view.depth, view.depth_spread, pinhole.depth, above.depth, dsm.height];
            let rest = [view.opacity, dsm.opacity, dsm.depth_spread, grid.values, normals];
            [colors.concat(), depths.concat(), rest.concat()]
                .concat()
                .iter()
                .map(|value| value.to_bits())
                .collect::<Vec<_>>()
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(7));
}

#[test]
fn options_change_what_they_name_and_nothing_else() {
    let field = field(&BoxCity { steepness: 5.0, gain: 1.0, bias: -1.0, ..BoxCity::example() });
    let sky = SkyMap::from_decoder(&Grid::new(3, 8, 8, vec![0.75; 192]));
    let camera = Camera::panorama([0.1, 0.2, -0.3], 0.8);
    let base = RenderOptions::default();
    let view = |options: &RenderOptions| render(&field, Some(&sky), &camera, options, color());
    let (squared, once) = (
        view(&base),
        view(&RenderOptions { composite: sat3d_model::render::Composite::Once, ..base }),
    );
    assert_eq!((&squared.feature, &squared.opacity), (&once.feature, &once.opacity));
    let pixel = squared.opacity.iter().position(|o| (0.3..0.7).contains(o)).unwrap();
    let feature = squared.feature.unwrap().data[pixel];
    let opacity = squared.opacity[pixel];
    let (a, b) = (squared.composite.unwrap().data[pixel], once.composite.unwrap().data[pixel]);
    assert!((b - a - feature * (1.0 - opacity)).abs() < 1e-6, "{a} {b} {feature} {opacity}");
    let normalised = view(&RenderOptions { depth: DepthKind::Normalised, ..base });
    let raw = squared.depth[pixel] / opacity;
    assert!((normalised.depth[pixel] - raw).abs() < 1e-5);
    // More samples come closer to the exact integral, as far as its own steps let one see.
    let counts = SampleCounts::new(256, 256).unwrap();
    let fine = RenderOptions { samples: counts, ..RenderOptions::stable() };
    let city = BoxCity { steepness: 150.0, gain: 8.0, bias: -6.0, ..BoxCity::example() };
    let field = self::field(&city);
    let (coarse, fine) = (rms(&field, &RenderOptions::stable()), rms(&field, &fine));
    assert!(fine < coarse, "{fine} {coarse}");
    assert_eq!(RenderOptions::stable().sampling, Sampling::Stable);
    assert!(SampleCounts::new(7, 48).is_err() && SampleCounts::new(48, 513).is_err());
}

#[test]
fn a_scene_comes_back_from_its_file() {
    let (inputs, head) = BoxCity { texels: 40, ..BoxCity::example() }.inputs();
    let map = Grid::new(3, 8, 8, (0..192).map(|k| k as f32 / 192.0).collect());
    let sky = Some(SkyParts { style: vec![0.7], map });
    let parts = SceneParts { inputs, head, sky, metres_per_unit: 32.24 };
    let scene = Scene::new(parts.clone()).unwrap();
    let folder = std::env::temp_dir().join(format!("sat3d-scene-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("city.scene");
    scene.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    scene.save(&path).unwrap();
    assert!(bytes == std::fs::read(&path).unwrap(), "the same scene, the same bytes");
    let loaded = Scene::load(&path).unwrap();
    assert_eq!(loaded.parts(), &parts);
    let camera = Camera::panorama([0.0, 0.0, -0.5], 0.8);
    let options = RenderOptions::default();
    let (a, b) =
        (scene.render(&camera, &options, color()), loaded.render(&camera, &options, color()));
    assert_eq!((a.depth, a.composite), (b.depth, b.composite));
    assert_eq!(scene.dsm(32, &options).height, loaded.dsm(32, &options).height);
    // Cut off, not a scene, missing.
    std::fs::write(&path, &bytes[..bytes.len() - 10]).unwrap();
    assert!(Scene::load(&path).unwrap_err().to_string().contains("city.scene"));
    std::fs::write(&path, b"nothing").unwrap();
    assert!(Scene::load(&path).is_err());
    std::fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/representer.safetensors"), &path)
        .unwrap();
    assert!(Scene::load(&path).unwrap_err().to_string().contains("not a scene file"));
    std::fs::remove_file(&path).unwrap();
    assert!(Scene::load(&path).is_err());
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0, "no temporary file is left");
    std::fs::remove_dir(&folder).unwrap();
}
