//! Views of a city whose surface is known: which way pictures lie, where cameras stand, what they hit.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::views_support;

use sat3d::footprint::Footprint;
use sat3d::grid::{LonLat, PixelPoint};
use sat3d::model::Scene;
use sat3d::model::render::{Angles, Intrinsics, RenderOptions};
use sat3d::views::{
    CameraFile, FrameKind, Height, Lens, Optics, PathRequest, Place, Trajectory, ViewContext,
    ViewError, ViewRequests, gif, render,
};
use std::path::Path;
use views_support::{Array, Pixels, SKY_BYTES, city, file, files, pixel_of, seattle};

/// Metres of the cube's unit across and up.
const ACROSS: f64 = 64.412_8 / 1.6;
const UP: f64 = 32.24;
/// Metres of the street camera above the cube's bottom: z = -0.85 of the crop is -0.68.
const STREET_M: f64 = (1.0 - 0.68) * UP;
/// The ground's z is -0.8.
const GROUND_M: f64 = 0.2 * UP;
/// The tower's roof is at z = 0.3; its middle is east 0.475, north 0.475.
const ROOF_M: f64 = 1.3 * UP;
const TOWER: [f64; 2] = [0.475, -0.475];

fn base() -> ViewRequests {
    ViewRequests { options: RenderOptions::stable(), depth: true, ..ViewRequests::default() }
}

fn at(x: f64, y: f64) -> Option<Place> {
    Some(Place::Pixel(pixel_of(x, y)))
}

fn small(side: u32) -> Optics {
    Optics { size: [side, side], ..Optics::default() }
}

fn turned(yaw: f64) -> Angles {
    Angles { yaw, ..Angles::default() }
}

#[test]
fn the_satellite_view_has_north_up_and_east_right() {
    let files = files(&ViewRequests { satellite: true, ..base() });
    let picture = Pixels::of(&files, "city_satellite.png");
    assert_eq!(picture.size(), (256, 256));
    // Red grows with the roof's height. The tower is up and to the right.
    let [column, row] = pixel_of(TOWER[0], TOWER[1]).map(|v| (v * 0.4) as usize);
    let red = |row: usize, column: usize| picture.at(row, column)[0];
    let others = [red(255 - row, column), red(row, 255 - column), red(255 - row, 255 - column)];
    assert!(row < 128 && column > 128);
    assert!(others.iter().all(|other| red(row, column) > other + 20), "{others:?}");
    // Nothing of the sky is in it, and the points are where the picture has them.
    let points = Array::of(&files, "city_satellite_depth.npz", "points");
    assert_eq!(points.shape, [256, 256, 3]);
    let [east, north, up] = points.vector(row, column);
    assert!((east - 0.475 * ACROSS).abs() < 0.2 && (north - 0.475 * ACROSS).abs() < 0.2);
    assert!((up - ROOF_M).abs() < 0.3, "{up} {ROOF_M}");
    assert!((points.vector(10, 10)[2] - GROUND_M).abs() < 0.3);
    let normal = Array::of(&files, "city_satellite_depth.npz", "normals").vector(10, 10);
    assert!(normal[2] > 0.99, "{normal:?}");
}

#[test]
fn the_panorama_looks_north_in_its_middle_and_east_at_three_quarters() {
    let look = |x, y| {
        let files =
            files(&ViewRequests { panorama: true, position: at(x, y), depth: false, ..base() });
        Pixels::of(&files, "city_panorama.png")
    };
    // 52 degrees above the horizon, where only the tower is.
    let row = 13;
    let seen = |picture: &Pixels| -> Vec<usize> {
        (0..256).filter(|column| !picture.is_sky(row, *column)).collect()
    };
    // South, west, north and east of the tower: it stands north, east, south and west of the camera.
    for (x, y, middle) in [
        (TOWER[0], 0.1, 127.5),
        (-0.1, TOWER[1], 0.75 * 255.0),
        (TOWER[0], -0.75, 0.0),
        (0.78, TOWER[1], 0.25 * 255.0),
    ] {
        let picture = look(x, y);
        assert_eq!(picture.size(), (256, 64));
        let columns = seen(&picture);
        assert!(!columns.is_empty());
        // Distances around the circle: both edges are south.
        for column in columns {
            let away = (column as f64 - middle).abs();
            let away = away.min(255.0 - away);
            assert!(away < 60.0, "{x} {y}: column {column}");
        }
        // Symmetric about the middle within a column.
        let [left, right] = [-9.0, 9.0].map(|by: f64| (middle + by).rem_euclid(255.0) as usize);
        assert_eq!(picture.is_sky(row, left), picture.is_sky(row, right), "{x} {y}");
        assert!(!picture.is_sky(row, middle.min(254.6).round() as usize), "{x} {y}");
    }
    // From the middle of the crop the tower is north-east, the hall south, a little east.
    let picture = look(0.0, 0.0);
    let columns = seen(&picture);
    let middle = columns.iter().sum::<usize>() as f64 / columns.len() as f64;
    assert!((middle - (0.5 + 45.0 / 360.0) * 255.0).abs() < 2.0, "{middle}");
    // The zenith is sky, the nadir is ground.
    assert!(picture.is_sky(0, 40) && !picture.is_sky(63, 40));
}

#[test]
fn yaw_ninety_looks_east_and_pitch_looks_down() {
    // The tower is due east of this place.
    let position = at(-0.1, TOWER[1]);
    let request =
        |angles| ViewRequests { perspective: true, optics: small(65), position, angles, ..base() };
    let middle = |angles| {
        let files = files(&request(angles));
        let opacity = Array::of(&files, "city_perspective_depth.npz", "opacity").at(28, 32);
        let points = Array::of(&files, "city_perspective_depth.npz", "points");
        (opacity, points.vector(28, 32))
    };
    let (opacity, point) = middle(turned(90.0));
    assert!(opacity > 0.99, "{opacity}");
    // The west wall of the tower, straight ahead and a little above the horizon.
    assert!((point[0] - 0.35 * ACROSS).abs() < 0.3, "{point:?}");
    assert!((point[1] - 0.475 * ACROSS).abs() < 0.3 && point[2] > STREET_M);
    for yaw in [0.0, -90.0] {
        assert!(middle(turned(yaw)).0 < 0.01, "{yaw}");
    }
    let (opacity, point) = middle(Angles { pitch: 90.0, ..turned(0.0) });
    assert!(opacity > 0.99 && (point[2] - GROUND_M).abs() < 0.3, "{point:?}");
    // Above the middle of a picture that looks down is north.
    assert!(point[1] > 0.475 * ACROSS + 0.1, "{point:?}");
}

#[test]
fn a_place_is_the_same_place_in_every_form() {
    let footprint = seattle();
    let pixel = [401.25, 190.5];
    let grid = match footprint.place.clone().unwrap() {
        sat3d::footprint::Place::WebMercator(grid) => grid,
        other => panic!("{other:?}"),
    };
    let LonLat { lon_deg, lat_deg } = grid.lonlat(PixelPoint { x: pixel[0], y: pixel[1] });
    let gsd = grid.ground_sample_distance();
    let metres = [(pixel[0] - 320.0) * gsd, (320.0 - pixel[1]) * gsd, STREET_M];
    let request = |text: String| {
        let position = Some(text.parse::<Place>().unwrap());
        let files = files(&ViewRequests { panorama: true, perspective: true, position, ..base() });
        let [a, b] = ["panorama", "perspective"]
            .map(|view| Array::of(&files, &format!("city_{view}_depth.npz"), "points").values);
        ([a, b].concat(), Pixels::of(&files, "city_panorama.png"))
    };
    let (points, picture) = request(format!("px:{},{}", pixel[0], pixel[1]));
    for text in [
        format!("{lat_deg},{lon_deg}"),
        format!("ll:{lat_deg},{lon_deg}"),
        format!("{},{},{}", metres[0], metres[1], metres[2]),
    ] {
        let (others, other) = request(text.clone());
        assert!(picture.differs(&other) <= 1, "{text}");
        // Rays along an edge may fall to one side or the other.
        let near = points
            .iter()
            .zip(&others)
            .filter(|(a, b)| (**a - **b).abs() < 1e-3 || a.is_nan() && b.is_nan())
            .count();
        assert!(near as f64 > 0.999 * points.len() as f64, "{text}: {near} of {}", points.len());
    }
    // Whole numbers without a prefix are pixels.
    let place: Place = "401,190".parse().unwrap();
    assert_eq!(place, Place::Pixel([401.0, 190.0]));
}

#[test]
fn what_is_looked_at_is_in_the_middle() {
    let [tower_x, tower_y] = pixel_of(TOWER[0], TOWER[1]);
    let roof = [0.475 * ACROSS, 0.475 * ACROSS, ROOF_M];
    for (position, look_at, target) in [
        ("m:-10,-20,60".to_owned(), format!("px:{tower_x},{tower_y}"), roof),
        ("m:5,30,70".to_owned(), format!("m:{},{},{}", roof[0], roof[1], roof[2]), roof),
        ("px:320,320".to_owned(), "m:5.0,21,7.5".to_owned(), [5.0, 21.0, 7.5]),
    ] {
        let request = ViewRequests {
            perspective: true,
            optics: small(65),
            position: Some(position.parse().unwrap()),
            look_at: Some(look_at.parse().unwrap()),
            ..base()
        };
        let files = files(&request);
        let points = Array::of(&files, "city_perspective_depth.npz", "points");
        let middle = points.vector(32, 32);
        // The last target lies a little above the ground: its ray ends behind it.
        let along: f64 = [0, 1, 2].map(|k| (middle[k] - target[k]).powi(2)).iter().sum();
        let bound = if position.starts_with("px") { 10.0 } else { 0.6 };
        assert!(along.sqrt() < bound, "{position} -> {look_at}: {middle:?} {target:?}");
        // Left of the middle is left, above it is farther or higher.
        assert!(points.vector(32, 31) != middle);
    }
    let here = ViewRequests {
        perspective: true,
        position: Some("m:1,2,30".parse().unwrap()),
        look_at: Some("m:1,2,30".parse().unwrap()),
        ..base()
    };
    let (scene, footprint) = (city(), seattle());
    let context = ViewContext { scene: &scene, network: None, footprint: &footprint, stem: "x" };
    assert!(matches!(render(&here, &context), Err(ViewError::SamePlace { .. })));
}

#[test]
fn heights_are_metres_above_the_surface_at_that_place() {
    let below = |x, y, height| {
        let request = ViewRequests { panorama: true, position: at(x, y), height, ..base() };
        let files = files(&request);
        let depth = Array::of(&files, "city_panorama_depth.npz", "depth").at(63, 100);
        (depth, Array::of(&files, "city_panorama_depth.npz", "points").vector(63, 100)[2])
    };
    for (x, y, ground) in
        [(0.0, 0.0, GROUND_M), (TOWER[0], TOWER[1], ROOF_M), (0.1, 0.5, 0.65 * UP)]
    {
        let (depth, surface) = below(x, y, Height::AboveSurface(1.7));
        assert!((surface - ground).abs() < 0.3, "{x} {y}: {surface} {ground}");
        // Straight down to the surface: the height itself, whatever the vertical scale.
        assert!((depth - 1.7).abs() < 0.02, "{x} {y}: {depth}");
    }
    let (depth, _) = below(0.0, 0.0, Height::Street);
    assert!((depth - (STREET_M - GROUND_M)).abs() < 0.3, "{depth}");
}

#[test]
fn places_outside_are_refused_by_value() {
    let (scene, footprint) = (city(), seattle());
    let try_place = |text: &str, height, footprint: &Footprint| {
        let position = Some(text.parse().unwrap());
        let requests = ViewRequests { panorama: true, position, height, ..ViewRequests::default() };
        let context = ViewContext { scene: &scene, network: None, footprint, stem: "x" };
        render(&requests, &context).map(|_| ()).map_err(|error| error.to_string())
    };
    let error = try_place("47.61,-122.33", Height::Street, &footprint).unwrap_err();
    assert!(error.contains("ll:47.61,-122.33 is not in the image") && error.contains("640 x 640"));
    let error = try_place("px:641,3", Height::Street, &footprint).unwrap_err();
    assert!(error.contains("px:641,3"), "{error}");
    assert!(try_place("px:640,640", Height::Street, &footprint).is_ok());
    let nowhere = Footprint::of_training([640, 640]);
    let error = try_place("47.6,-122.33", Height::Street, &nowhere).unwrap_err();
    assert!(error.contains("px:COLUMN,ROW"), "{error}");
    let error = try_place("1,2,3", Height::AboveSurface(1.7), &footprint).unwrap_err();
    assert!(error.contains("--height 1.7"), "{error}");
    let missing = ViewRequests { panorama: true, super_resolution: true, ..base() };
    let context = ViewContext { scene: &scene, network: None, footprint: &footprint, stem: "x" };
    assert!(matches!(render(&missing, &context), Err(ViewError::NoNetwork)));
    let mut parts = scene.parts().clone();
    parts.sky = None;
    let dark = Scene::new(parts).unwrap();
    let context = ViewContext { scene: &dark, ..context };
    let panorama = ViewRequests { panorama: true, ..base() };
    assert!(matches!(render(&panorama, &context), Err(ViewError::NoSky)));
    let satellite = ViewRequests { satellite: true, ..base() };
    assert!(render(&satellite, &context).is_ok());
}

#[test]
fn cameras_outside_the_cube_begin_at_its_entry_and_rays_that_miss_are_sky() {
    let request = ViewRequests {
        perspective: true,
        optics: small(65),
        position: Some("m:0,150,90".parse().unwrap()),
        look_at: Some("m:0,0,6.5".parse().unwrap()),
        ..base()
    };
    let files = files(&request);
    let picture = Pixels::of(&files, "city_perspective.png");
    let opacity = Array::of(&files, "city_perspective_depth.npz", "opacity");
    let depth = Array::of(&files, "city_perspective_depth.npz", "depth");
    let points = Array::of(&files, "city_perspective_depth.npz", "points");
    let [_, north, up] = points.vector(32, 32);
    assert!(north.abs() < 0.7 && (up - GROUND_M).abs() < 0.4, "{north} {up}");
    let straight = libm::hypot(150.0, 90.0 - 6.5);
    assert!((depth.at(32, 32) - straight).abs() < 0.8, "{}", depth.at(32, 32));
    // The upper rays pass above the cube.
    assert!(picture.at(0, 32) == SKY_BYTES && opacity.at(0, 32) == 0.0 && depth.at(0, 32).is_nan());
    assert!((0..65).all(|row| (0..65).all(|column| depth.at(row, column) != 0.0)));
}

/// Writes a path and reads it back.
fn trajectory(text: &str, follows: bool) -> Trajectory {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("path.csv");
    std::fs::write(&path, text).unwrap();
    Trajectory::read(&path, follows).unwrap()
}

fn film(text: &str, kind: FrameKind, every: usize) -> ViewRequests {
    let trajectory = trajectory(text, kind.follows());
    let path = PathRequest { trajectory, kind, every, fps: 5, video: None };
    let optics = small(32);
    ViewRequests { path: Some(path), optics, depth: false, ..base() }
}

fn single(x: f64, y: f64, yaw: f64) -> Pixels {
    let position = Some(Place::Pixel([x, y]));
    let optics = small(32);
    let angles = turned(yaw);
    let request = ViewRequests { perspective: true, optics, position, angles, ..base() };
    Pixels::of(&files(&request), "city_perspective.png")
}

#[test]
fn a_path_becomes_frames_and_a_film() {
    // Towards the south-east, then south; the angle is turned from east, clockwise.
    let text = "w,h,angle\n200,250,0.7853981633974483\n210,260,1.5707963267948966\n210,280,1.5707963267948966\n";
    let files = files(&film(text, FrameKind::Follow, 2));
    let names: Vec<&str> = files.iter().map(|file| file.path.as_str()).collect();
    assert_eq!(
        names,
        ["city_trajectory/0001.png", "city_trajectory/0002.png", "city_trajectory.gif"]
    );
    let frames = [names[0], names[1]].map(|name| Pixels::of(&files, name));
    assert!(frames[0].differs(&single(200.0, 250.0, 135.0)) <= 1);
    assert!(frames[1].differs(&single(210.0, 280.0, 180.0)) <= 1);
    assert!(frames[0].differs(&frames[1]) > 50, "the camera turns");
    let mut options = ::gif::DecodeOptions::new();
    options.set_color_output(::gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(file(&files, names[2])).unwrap();
    let mut count = 0;
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        assert_eq!((frame.width, frame.height, frame.delay), (32, 32, 20));
        count += 1;
    }
    assert_eq!(count, 2);
    // Without --follow a frame is the panorama of its place.
    let files = self::files(&film(text, FrameKind::Panorama, 1));
    let frame = Pixels::of(&files, "city_trajectory/0003.png");
    let request = ViewRequests {
        panorama: true,
        position: Some(Place::Pixel([210.0, 280.0])),
        depth: false,
        ..base()
    };
    let still = self::files(&request);
    assert_eq!(frame.differs(&Pixels::of(&still, "city_panorama.png")), 0);
}

#[test]
fn the_surround_row_is_left_front_right_back() {
    let text = "w,h,angle\n330,330,0.3\n";
    let heading = 0.3_f64.to_degrees() + 90.0;
    for (follow, mirrored) in [(false, true), (false, false), (true, true)] {
        let kind = FrameKind::Surround { follow, mirrored };
        let files = files(&film(text, kind, 1));
        let row = Pixels::of(&files, "city_trajectory/0001.png");
        assert_eq!(row.size(), (128, 32));
        let front = if follow { heading } else { 0.0 };
        for (place, yaw) in [(0, -90.0), (1, 0.0), (2, 90.0), (3, 180.0)] {
            let want = single(330.0, 330.0, front + yaw);
            for y in 0..32 {
                for x in 0..32 {
                    let mirror = mirrored && place == 3;
                    let from = if mirror { 31 - x } else { x };
                    let (got, want) = (row.at(y, 32 * place + x), want.at(y, from));
                    let worst = (0..3).map(|k| got[k].abs_diff(want[k])).max();
                    assert!(worst <= Some(1), "view {place}, {y} {x}: {got:?} {want:?}");
                }
            }
        }
    }
}

/// Where COLMAP's text has a point in a picture: q p q* + t by the product of quaternions, then the pinhole.
fn colmap_pixel(row: &str, camera: [f64; 4], point: [f64; 3]) -> [f64; 2] {
    let n: Vec<f64> = row.split_whitespace().skip(1).take(7).map(|v| v.parse().unwrap()).collect();
    let product = |a: [f64; 4], b: [f64; 4]| {
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    };
    let q = [n[0], n[1], n[2], n[3]];
    let turned =
        product(product(q, [0.0, point[0], point[1], point[2]]), [q[0], -q[1], -q[2], -q[3]]);
    let [x, y, z] = [turned[1] + n[4], turned[2] + n[5], turned[3] + n[6]];
    let [fx, fy, cx, cy] = camera;
    [fx * x / z + cx, fy * y / z + cy]
}

#[test]
fn cameras_of_a_file_see_the_scene_in_metres() {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/cameras");
    let cameras = CameraFile::read(&fixtures.join("text"), None).unwrap();
    let request = ViewRequests { cameras: Some(cameras), ..base() };
    let files = files(&request);
    let text = std::fs::read_to_string(fixtures.join("text/images.txt")).unwrap();
    let mut seen = 0;
    for (name, line, camera, size) in [
        ("street_front_1", " street/front 1.jpg", [50.0, 47.0, 30.5, 25.25], [64, 48]),
        ("street_back", " street/back.jpg", [40.0, 40.0, 32.5, 16.5], [65, 33]),
        ("above", " above.png", [50.0, 47.0, 30.5, 25.25], [64, 48]),
    ] {
        let row = text.lines().find(|row| row.ends_with(line)).unwrap();
        let points = Array::of(&files, &format!("city_cameras/{name}_depth.npz"), "points");
        assert_eq!(points.shape, [size[1], size[0], 3]);
        for v in 0..size[1] {
            for u in 0..size[0] {
                let point = points.vector(v, u);
                if point[0].is_nan() {
                    continue;
                }
                // Across and up a cube unit are different metres here: rays must be stretched for this to hold.
                let [x, y] = colmap_pixel(row, camera, point);
                let error = (x - u as f64 - 0.5).abs().max((y - v as f64 - 0.5).abs());
                assert!(error < 2e-3, "{name} {u} {v}: {x} {y}");
                seen += 1;
            }
        }
    }
    assert!(seen > 3000, "{seen} points");
}

#[test]
fn intrinsics_and_fields_of_view_agree() {
    let focal = 32.0 / libm::tan(50.0_f64.to_radians());
    let position = at(0.0, 0.0);
    let angles = turned(45.0);
    let picture = |lens| {
        let optics = Optics { size: [64, 64], lens };
        let request = ViewRequests { perspective: true, optics, position, angles, ..base() };
        Pixels::of(&files(&request), "city_perspective.png")
    };
    let field = picture(Lens::FieldOfView { horizontal: 100.0, vertical: Some(100.0) });
    let given = Intrinsics { fx: focal, fy: focal, cx: 32.0, cy: 32.0 };
    assert!(field.differs(&picture(Lens::Intrinsics(given))) <= 1);
    let narrow = picture(Lens::FieldOfView { horizontal: 30.0, vertical: None });
    // The tower fills more of it.
    let scene = |p: &Pixels| (0..64).filter(|x| !p.is_sky(20, *x)).count();
    assert!(scene(&narrow) > scene(&field), "{} {}", scene(&narrow), scene(&field));
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let text = "w,h\n300,300\n320,310\n340,330\n";
    let mut request = film(text, FrameKind::Surround { follow: true, mirrored: true }, 1);
    request.panorama = true;
    request.depth = true;
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| files(&request))
    };
    let one = run(1);
    assert!(one == run(2) && one == run(5));
    assert!(one.iter().any(|file| file.path.ends_with("0003_back_depth.png")));
}

#[test]
fn requests_say_what_they_need_and_are_serialised_without_the_files_contents() {
    let none = ViewRequests::default();
    assert!(none.is_empty() && !none.needs_sky());
    let satellite = ViewRequests { satellite: true, super_resolution: true, ..none.clone() };
    assert!(!satellite.is_empty() && !satellite.needs_sky() && !satellite.needs_super_resolution());
    let film =
        ViewRequests { super_resolution: true, ..film("w,h\n3,4\n5,6\n", FrameKind::Panorama, 1) };
    assert!(film.needs_sky() && film.needs_super_resolution() && film.notes().len() == 1);
    let json = serde_json::to_value(&film).unwrap();
    assert_eq!(json["path"]["trajectory"]["count"], 2);
    assert!(json["path"]["trajectory"].get("stations").is_none());
    let on = |requests: &ViewRequests, id: &str| {
        requests.steps().into_iter().find(|step| step.id == id).map(|step| step.on)
    };
    assert_eq!(on(&film, "animation"), Some(true), "a plan does not depend on what is installed");
    assert!(json["path"].get("video").is_none());
    assert_eq!((on(&film, "trajectory"), on(&satellite, "trajectory")), (Some(true), Some(false)));
    assert_eq!(on(&satellite, "satellite-view"), Some(true));
    // Another path, another plan.
    let other = self::film("w,h\n3,4\n5,7\n", FrameKind::Panorama, 1);
    assert_ne!(serde_json::to_value(&other).unwrap()["path"], json["path"]);
    assert!(gif(&[], 5).is_err());
}
