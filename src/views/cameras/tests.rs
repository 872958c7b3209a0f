use super::*;
use crate::model::render::frames::rotate;
use serde_json::{Value, json};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/cameras").join(name)
}

/// Where a camera sees a point, by the rays that are rendered: pixels from the upper left corner of the picture;
/// `None` behind it.
fn project(camera: &FileCamera, point: Vector, doubled: bool) -> Option<[f64; 2]> {
    let (_, rays) = camera.optics.rays(doubled);
    let away = [0, 1, 2].map(|axis| point[axis] - camera.position[axis]);
    let back: Matrix = [0, 1, 2].map(|row| [0, 1, 2].map(|column| camera.rotation[column][row]));
    let [x, y, z] = rotate(&back, away);
    if z <= 0.0 {
        return None;
    }
    // A ray at the integer u is the middle of a pixel, or of two where rays are doubled.
    let part = if doubled { 2.0 } else { 1.0 };
    let ray = [rays.fx * x / z + rays.cx, rays.fy * y / z + rays.cy];
    Some(ray.map(|u| part * (u + 0.5)))
}

fn compare(path: &Path, key: &str) {
    let text = std::fs::read_to_string(fixture("pixels.json")).expect("reads");
    let want: Value = serde_json::from_str(&text).expect("JSON");
    let points: Vec<Vector> = serde_json::from_value(want["points"].clone()).expect("points");
    let file = CameraFile::read(path, None).expect("cameras");
    assert_eq!(file.count, 3);
    let mut compared = 0;
    for camera in &file.cameras {
        let pixels: Vec<Option<[f64; 2]>> =
            serde_json::from_value(want[key][&camera.name].clone()).expect(&camera.name);
        for (point, pixel) in points.iter().zip(&pixels) {
            for doubled in [false, true] {
                let got = project(camera, *point, doubled);
                match (got, pixel) {
                    (Some(got), Some(want)) => {
                        let size = 1.0 + want[0].abs().max(want[1].abs());
                        let error = (got[0] - want[0]).abs().max((got[1] - want[1]).abs()) / size;
                        assert!(error < 1e-11, "{}: {got:?} {want:?}", camera.name);
                        compared += 1;
                    }
                    (None, None) => {}
                    other => panic!("{}: {other:?}", camera.name),
                }
            }
        }
    }
    assert!(compared > 60, "{compared} pixels compared");
}

#[test]
fn points_are_where_pycolmap_and_the_formula_have_them() {
    compare(&fixture("text"), "colmap");
    compare(&fixture("binary"), "colmap");
    compare(&fixture("transforms.json"), "nerf");
}

#[test]
fn text_and_binary_are_the_same_cameras() {
    let [text, binary] =
        ["text", "binary"].map(|name| CameraFile::read(&fixture(name), None).expect(name));
    for (a, b) in text.cameras.iter().zip(&binary.cameras) {
        assert_eq!((&a.name, a.optics), (&b.name, b.optics));
        let ends = a.position.iter().zip(b.position);
        assert!(ends.into_iter().all(|(a, b)| (a - b).abs() < 1e-12));
    }
    assert_ne!(text.sha256, binary.sha256);
    assert_eq!(text.cameras[1].optics.size, [65, 33]);
}

#[test]
fn another_size_keeps_what_is_seen() {
    let path = fixture("transforms.json");
    let [whole, half] =
        [None, Some([40, 60])].map(|size| CameraFile::read(&path, size).expect("cameras"));
    let point = [10.0, 20.0, 12.0];
    for (a, b) in whole.cameras.iter().zip(&half.cameras) {
        assert_eq!(b.optics.size, [40, 60]);
        if let (Some(a), Some(b)) = (project(a, point, false), project(b, point, false)) {
            assert!((a[0] - 2.0 * b[0]).abs() < 1e-9 && (a[1] - b[1]).abs() < 1e-9);
        }
    }
}

/// Writes a changed `transforms.json` and reads it.
fn changed(change: impl Fn(&mut Value), size: Option<[u32; 2]>) -> Result<CameraFile, String> {
    let text = std::fs::read_to_string(fixture("transforms.json")).expect("reads");
    let mut file: Value = serde_json::from_str(&text).expect("JSON");
    change(&mut file);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("transforms.json");
    std::fs::write(&path, file.to_string()).expect("writes");
    CameraFile::read(&path, size).map_err(|error| error.to_string())
}

fn says(result: Result<CameraFile, String>, what: &str) {
    let error = result.expect_err(what);
    assert!(error.contains(what), "`{error}` does not say `{what}`");
}

#[test]
fn transforms_that_would_be_misread_are_refused() {
    says(changed(|file| file["k1"] = json!(0.02), None), "distortion k1 = 0.02");
    says(changed(|file| file["frames"][2]["p2"] = json!(-1e-3), None), "frame 2");
    says(changed(|file| file["camera_model"] = json!("OPENCV_FISHEYE"), None), "OPENCV_FISHEYE");
    says(changed(|file| file["is_fisheye"] = json!(true), None), "fisheye");
    says(
        changed(
            |f| f["applied_transform"] = json!([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]),
            None,
        ),
        "undo it",
    );
    says(changed(|file| file["applied_scale"] = json!(0.5), None), "`applied_scale`: 0.5");
    let identity = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]);
    assert!(changed(|file| file["applied_transform"] = identity.clone(), None).is_ok());
    let scaled = |file: &mut Value| {
        for row in file["frames"][0]["transform_matrix"].as_array_mut().expect("rows") {
            row[0] = json!(2.0 * row[0].as_f64().expect("a number"));
        }
    };
    says(changed(scaled, None), "scaled, sheared or mirrored");
    let mirrored = |file: &mut Value| {
        for row in file["frames"][0]["transform_matrix"].as_array_mut().expect("rows") {
            row[1] = json!(-row[1].as_f64().expect("a number"));
        }
    };
    says(changed(mirrored, None), "mirrored");
    let three = |file: &mut Value| file["frames"][1]["transform_matrix"] = json!([[1, 0, 0, 0]]);
    says(changed(three, None), "frame 1 (`./street/back.jpg`)");
    says(changed(|file| file["frames"] = json!([]), None), "there is none");
    says(changed(|file| *file = json!({ "cameras": [] }), None), "is this a transforms.json");
    says(changed(|file| file["w"] = json!("80"), None), "`w` is \"80\"");
    let no_size = |file: &mut Value| {
        file.as_object_mut().expect("an object").remove("w");
    };
    says(changed(no_size, None), "give --size");
    assert_eq!(changed(no_size, Some([20, 10])).expect("cameras").cameras[0].optics.size, [20, 10]);
    says(changed(|file| file["w"] = json!(100_000), None), "100000x60");
    let twice = |file: &mut Value| file["frames"][2]["file_path"] = json!("street/back");
    let names: Vec<String> =
        changed(twice, None).expect("cameras").cameras.into_iter().map(|c| c.name).collect();
    assert_eq!(names, ["street_front_1", "street_back", "street_back_2"]);
}

#[test]
fn models_that_would_be_misread_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let read = || CameraFile::read(path, None).map_err(|error| error.to_string());
    says(read(), "no COLMAP model here");
    let write = |name: &str, bytes: &[u8]| std::fs::write(path.join(name), bytes).expect("writes");
    write("cameras.txt", b"1 OPENCV 64 48 50 47 30.5 25.25 0.1 0 0 0\n");
    write("images.txt", b"1 1 0 0 0 0 0 0 1 a.jpg\n\n");
    says(read(), "camera 1: camera model OPENCV");
    write("cameras.txt", b"1 PINHOLE 64 48 50 47 30.5\n");
    says(read(), "PINHOLE with 3 parameters");
    write("cameras.txt", b"2 PINHOLE 64 48 50 47 30.5 25\n");
    says(read(), "image 1 (`a.jpg`): no camera 1");
    write("cameras.txt", b"1 PINHOLE 64 48 50 x 30.5 25\n");
    says(read(), "line 1: a parameter is `x`");
    write("cameras.txt", b"1 PINHOLE 64 48 50 47 30.5 25\n");
    write("images.txt", b"# no points, one empty line each\n1 0 0 0 0 0 0 0 1 a.jpg\n\n");
    says(read(), "is no rotation");
    write("images.txt", b"1 1 0 0 0 0 0 0\n");
    says(read(), "line 1: the camera's number is missing");
    write("images.txt", b"1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 b.jpg");
    assert_eq!(read().expect("cameras").count, 2);

    // A binary model goes before a text one.
    let binary = |name: &str| std::fs::read(fixture("binary").join(name)).expect("reads");
    write("cameras.bin", &binary("cameras.bin"));
    let images = binary("images.bin");
    write("images.bin", &images[..images.len() - 1]);
    says(read(), "the file ends");
    write("images.bin", &images);
    assert_eq!(read().expect("cameras").count, 3);
    let mut fisheye = binary("cameras.bin");
    fisheye[12] = 5;
    write("cameras.bin", &fisheye);
    says(read(), "OPENCV_FISHEYE");
    fisheye[12] = 99;
    write("cameras.bin", &fisheye);
    says(read(), "number 99");
    // A count that no file holds.
    write("images.bin", &u64::MAX.to_le_bytes());
    write("cameras.bin", &binary("cameras.bin"));
    says(read(), "the file ends");
}

#[test]
fn names_stay_inside_their_folder() {
    for (name, want) in [
        ("images/frame_00001.jpg", "images_frame_00001"),
        ("./train/r_0", "train_r_0"),
        ("../../etc/passwd", "_.._etc_passwd"),
        ("a b:c.png", "a_b_c"),
        (".png", "png"),
        ("", "camera"),
    ] {
        assert_eq!(picture_name(name), want, "{name}");
    }
}
