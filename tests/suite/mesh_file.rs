//! Mesh files: parsed back here byte by byte, and opened by what others use.
//!
//! Set `SAT3D_TEST_PYTHON` (or `SAT3D_PYTHON`) to an interpreter with trimesh (and open3d, meshio), and
//! `SAT3D_GLTF_VALIDATOR` to a folder in which `npm install gltf-validator` was run; what is absent is said.

use sat3d::grid::LonLat;
use sat3d::mesh_file::{MeshFileError, MeshFormat, MeshGeoreference, NamedBytes, encode};
use sat3d::model::Image8;
use sat3d::model::mesh::{Axis, Mesh, MeshFrame, mesh_grid};
use serde_json::Value;
use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::process::Command;

const GEOREFERENCE: MeshGeoreference = MeshGeoreference {
    origin: LonLat { lon_deg: -122.330_123_456_789, lat_deg: 47.6 },
    vertical_exaggeration: 0.8,
};

/// What is drawn on the mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Paint {
    None,
    Colors,
    Texture,
}

/// A block with a hole and a smaller one beside it, in metres, without symmetry.
fn mesh(paint: Paint) -> Mesh {
    let shape = [11, 9, 7];
    let axes = shape.map(|n| Axis::new(-1.0, (0..n).map(|k| k as f64), n as f64).expect("an axis"));
    let inside = |[x, y, z]: [usize; 3]| {
        let block = (1..6).contains(&x) && (1..8).contains(&y) && z < 4;
        let hole = x == 3 && (3..5).contains(&y);
        (block && !hole) || (x > 7 && y < 3 && z < 2)
    };
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|k| {
            let point = [k / shape[2] / shape[1], k / shape[2] % shape[1], k % shape[2]];
            if inside(point) { 9.0 + (k % 5) as f32 } else { (k % 3) as f32 }
        })
        .collect();
    let surface = mesh_grid(&axes, &values, 5.0).expect("a surface");
    let vertices: Vec<[f32; 3]> = surface
        .vertices
        .iter()
        .map(|v| [v[0] - 5.5, v[1] - 4.5, v[2] * 2.0].map(|v| v as f32))
        .collect();
    let colors = (0..vertices.len()).map(|k| [k * 7, k * 3, k].map(|v| (v % 256) as u8)).collect();
    let places = vertices.iter().map(|[x, y, _]| [x / 16.0 + 0.5, 0.5 - y / 16.0]).collect();
    Mesh {
        frame: MeshFrame::EastNorthUp,
        vertices,
        triangles: surface.triangles,
        colors: (paint == Paint::Colors).then_some(colors),
        texture_coordinates: (paint == Paint::Texture).then_some(places),
    }
}

fn picture() -> Image8 {
    let data = (0..12 * 10 * 3).map(|k| (k * 5 % 251) as u8).collect();
    Image8::new(12, 10, 3, data).expect("an image")
}

fn files(mesh: &Mesh, format: MeshFormat, stem: &str) -> Vec<NamedBytes> {
    encode(mesh, format, stem, Some(&GEOREFERENCE), Some(&picture())).expect("files")
}

fn f32s(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn u32s(bytes: &[u8]) -> Vec<u32> {
    bytes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect()
}

struct Glb {
    json: Value,
    binary: Vec<u8>,
}

impl Glb {
    fn parse(bytes: &[u8]) -> Self {
        let number = |at: usize| u32s(&bytes[at..at + 4])[0] as usize;
        assert_eq!((&bytes[..4], number(4), number(8)), (&b"glTF"[..], 2, bytes.len()));
        let json = number(12);
        assert_eq!((&bytes[16..20], json % 4), (&b"JSON"[..], 0));
        let binary = 20 + json;
        let length = number(binary);
        assert_eq!((&bytes[binary + 4..binary + 8], length % 4), (&b"BIN\0"[..], 0));
        assert_eq!(binary + 8 + length, bytes.len());
        Self {
            json: serde_json::from_slice(&bytes[20..binary]).expect("JSON"),
            binary: bytes[binary + 8..].to_vec(),
        }
    }

    fn view(&self, index: usize) -> &[u8] {
        let view = &self.json["bufferViews"][index];
        let number = |key: &str| view[key].as_u64().expect("a number") as usize;
        assert_eq!(number("byteOffset") % 4, 0);
        &self.binary[number("byteOffset")..][..number("byteLength")]
    }

    fn attribute(&self, name: &str) -> Option<(&Value, &[u8])> {
        let primitive = &self.json["meshes"][0]["primitives"][0];
        let index = match name {
            "indices" => &primitive["indices"],
            _ => &primitive["attributes"][name],
        };
        let accessor = &self.json["accessors"][index.as_u64()? as usize];
        Some((accessor, self.view(accessor["bufferView"].as_u64()? as usize)))
    }
}

#[test]
fn glb_holds_the_mesh_with_y_up() {
    for paint in [Paint::None, Paint::Colors, Paint::Texture] {
        let mesh = mesh(paint);
        let files = files(&mesh, MeshFormat::Glb, "a mesh");
        assert_eq!((files.len(), &*files[0].name), (1, "a mesh.glb"));
        let glb = Glb::parse(&files[0].bytes);
        let (accessor, bytes) = glb.attribute("POSITION").expect("positions");
        let places = f32s(bytes);
        let wanted: Vec<f32> = mesh.vertices.iter().flat_map(|[x, y, z]| [*x, *z, -*y]).collect();
        assert_eq!(places, wanted);
        for k in 0..3 {
            let along = || places.iter().skip(k).step_by(3).copied();
            let [low, high] = ["min", "max"].map(|key| accessor[key][k].as_f64().expect("a bound"));
            assert_eq!(low, f64::from(along().fold(f32::INFINITY, f32::min)));
            assert_eq!(high, f64::from(along().fold(f32::NEG_INFINITY, f32::max)));
        }
        let (accessor, bytes) = glb.attribute("indices").expect("indices");
        assert_eq!(u32s(bytes), mesh.triangles.concat());
        assert_eq!(accessor["count"].as_u64(), Some(3 * mesh.triangles.len() as u64));
        let extras = &glb.json["scenes"][0]["extras"];
        assert_eq!(extras["origin_longitude_deg"].as_f64(), Some(-122.330_123_456_789));
        assert_eq!(extras["origin_latitude_deg"].as_f64(), Some(47.6));
        assert_eq!(extras["vertical_exaggeration"].as_f64(), Some(0.8));
        assert_eq!(extras["frame"], "east-north-up");
        assert_eq!(extras["axes"], "metres, x east, y up, z south");

        let unlit = !glb.json["materials"][0]["extensions"]["KHR_materials_unlit"].is_null();
        assert_eq!(unlit, paint != Paint::None);
        assert_eq!(glb.attribute("NORMAL").is_some(), paint == Paint::None);
        if let Some((_, bytes)) = glb.attribute("NORMAL") {
            for normal in f32s(bytes).as_chunks::<3>().0 {
                let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
                assert!((length - 1.0).abs() < 1e-5);
            }
        }
        assert_eq!(glb.attribute("COLOR_0").is_some(), paint == Paint::Colors);
        if let Some((accessor, bytes)) = glb.attribute("COLOR_0") {
            assert_eq!(accessor["normalized"], true);
            let values = bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b));
            let values: Vec<f64> = values.map(|v| f64::from(v) / 65535.0).collect();
            let colors = mesh.colors.as_ref().expect("colours");
            for (linear, color) in values.chunks_exact(4).zip(colors) {
                for (linear, wanted) in linear.iter().zip(color) {
                    let shown = if *linear <= 0.003_130_8 {
                        12.92 * linear
                    } else {
                        1.055 * libm::pow(*linear, 1.0 / 2.4) - 0.055
                    };
                    assert_eq!((shown * 255.0).round(), f64::from(*wanted));
                }
                assert_eq!(linear[3], 1.0);
            }
        }
        assert_eq!(glb.attribute("TEXCOORD_0").is_some(), paint == Paint::Texture);
        if let Some((_, bytes)) = glb.attribute("TEXCOORD_0") {
            assert_eq!(f32s(bytes), mesh.texture_coordinates.as_ref().expect("places").concat());
            let view = glb.json["images"][0]["bufferView"].as_u64().expect("a view");
            assert_eq!(decoded(glb.view(view as usize)), picture().data);
        }
    }
}

fn decoded(bytes: &[u8]) -> Vec<u8> {
    let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png).expect("PNG");
    assert_eq!((image.width(), image.height()), (12, 10));
    image.into_rgb8().into_raw()
}

/// Up is y in both, and the reference's own axes stay.
#[test]
fn a_reference_mesh_keeps_its_axes() {
    let mesh = Mesh { frame: MeshFrame::Reference, ..mesh(Paint::None) };
    let files = encode(&mesh, MeshFormat::Glb, "m", None, None).expect("a file");
    let glb = Glb::parse(&files[0].bytes);
    assert_eq!(f32s(glb.attribute("POSITION").expect("positions").1), mesh.vertices.concat());
    let extras = &glb.json["scenes"][0]["extras"];
    assert_eq!(extras["frame"], "reference");
    assert!(extras["origin_longitude_deg"].is_null());
}

#[test]
fn ply_holds_the_mesh() {
    for paint in [Paint::None, Paint::Colors, Paint::Texture] {
        let mesh = mesh(paint);
        let files = files(&mesh, MeshFormat::Ply, "m");
        assert_eq!((files.len(), &*files[0].name), (1, "m.ply"));
        let bytes = &files[0].bytes;
        let end = b"end_header\n";
        let header =
            bytes.windows(end.len()).position(|part| part == end).expect("an end") + end.len();
        let text = std::str::from_utf8(&bytes[..header]).expect("text");
        for line in [
            "ply\nformat binary_little_endian 1.0\n",
            "comment origin_longitude_deg -122.330123456789\n",
            "comment origin_latitude_deg 47.6\n",
            "comment vertical_exaggeration 0.8\n",
            "comment axes metres, x east, y north, z up\n",
            &format!("element vertex {}\n", mesh.vertices.len()),
            &format!("element face {}\n", mesh.triangles.len()),
        ] {
            assert!(text.contains(line), "{line} in {text}");
        }
        let painted = paint != Paint::None;
        assert_eq!(text.contains("property uchar red\n"), painted);
        let size = if painted { 15 } else { 12 };
        let (vertices, faces) = bytes[header..].split_at(size * mesh.vertices.len());
        for (index, (bytes, vertex)) in vertices.chunks(size).zip(&mesh.vertices).enumerate() {
            assert_eq!(f32s(&bytes[..12]), vertex);
            if let Some(colors) = &mesh.colors {
                assert_eq!(bytes[12..], colors[index]);
            }
            if let Some(places) = &mesh.texture_coordinates {
                // Within what neighbouring pixels have.
                let picture = picture();
                let [x, y] =
                    [(places[index][0], 12), (places[index][1], 10)].map(|(value, size)| {
                        (value * size as f32 - 0.5).floor().clamp(0.0, (size - 1) as f32) as usize
                    });
                for k in 0..3 {
                    let at = |x: usize, y: usize| picture.data[(y.min(9) * 12 + x.min(11)) * 3 + k];
                    let near = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
                    let range = *near.iter().min().expect("4")..=*near.iter().max().expect("4");
                    assert!(range.contains(&bytes[12 + k]), "{near:?}");
                }
            }
        }
        assert_eq!(faces.len(), 13 * mesh.triangles.len());
        for (bytes, triangle) in faces.chunks(13).zip(&mesh.triangles) {
            assert_eq!(bytes[0], 3);
            assert_eq!(u32s(&bytes[1..]), triangle);
        }
    }
}

#[test]
fn obj_holds_the_mesh() {
    for paint in [Paint::None, Paint::Colors, Paint::Texture] {
        let mesh = mesh(paint);
        let files = files(&mesh, MeshFormat::Obj, "a mesh");
        let names: Vec<&str> = files.iter().map(|file| &*file.name).collect();
        let text = std::str::from_utf8(&files[0].bytes).expect("text");
        if paint == Paint::Texture {
            assert_eq!(names, ["a mesh.obj", "a_mesh.mtl", "a_mesh.png"]);
            assert!(
                text.contains("\nmtllib a_mesh.mtl\n") && text.contains("\nusemtl satellite\n")
            );
            let material = std::str::from_utf8(&files[1].bytes).expect("text");
            assert!(material.starts_with("newmtl satellite\n"));
            assert!(material.contains("\nmap_Kd a_mesh.png\n"));
            assert_eq!(decoded(&files[2].bytes), picture().data);
        } else {
            assert_eq!(names, ["a mesh.obj"]);
        }
        assert!(text.contains("# origin_longitude_deg -122.330123456789\n"));
        let lines = |key: &str| {
            let key = format!("{key} ");
            let lines = text.lines().filter_map(|line| line.strip_prefix(&*key));
            lines.map(|line| line.split(' ').collect::<Vec<_>>()).collect::<Vec<_>>()
        };
        let (vertices, faces, places) = (lines("v"), lines("f"), lines("vt"));
        assert_eq!(vertices.len(), mesh.vertices.len());
        for (index, (fields, vertex)) in vertices.iter().zip(&mesh.vertices).enumerate() {
            let values: Vec<f32> = fields.iter().map(|v| v.parse().expect("a number")).collect();
            assert_eq!(values[..3], *vertex);
            match &mesh.colors {
                Some(colors) => {
                    let color: Vec<u8> = values[3..].iter().map(|v| (v * 255.0) as u8).collect();
                    assert_eq!(color, colors[index]);
                }
                None => assert_eq!(values.len(), 3),
            }
        }
        assert_eq!(faces.len(), mesh.triangles.len());
        for (fields, triangle) in faces.iter().zip(&mesh.triangles) {
            let wanted = triangle.map(|corner| match paint {
                Paint::Texture => format!("{0}/{0}", corner + 1),
                _ => (corner + 1).to_string(),
            });
            assert_eq!(*fields, wanted);
        }
        let wanted = mesh.texture_coordinates.unwrap_or_default();
        assert_eq!(places.len(), wanted.len());
        for (fields, [u, v]) in places.iter().zip(wanted) {
            let values: Vec<f32> = fields.iter().map(|v| v.parse().expect("a number")).collect();
            assert_eq!(values, [u, 1.0 - v]);
        }
    }
}

#[test]
fn the_same_mesh_gives_the_same_bytes() {
    for paint in [Paint::None, Paint::Colors, Paint::Texture] {
        for format in [MeshFormat::Glb, MeshFormat::Ply, MeshFormat::Obj] {
            assert_eq!(files(&mesh(paint), format, "m"), files(&mesh(paint), format, "m"));
        }
    }
}

#[test]
fn what_is_refused() {
    let formats = [MeshFormat::Glb, MeshFormat::Ply, MeshFormat::Obj];
    let refused = |mesh: &Mesh, format| encode(mesh, format, "m", None, None).expect_err("refused");
    for format in formats {
        assert!(matches!(refused(&Mesh::default(), format), MeshFileError::Empty));
        let textured = refused(&mesh(Paint::Texture), format);
        assert!(matches!(textured, MeshFileError::NoTexture), "{format:?}");
        let content = |change: &dyn Fn(&mut Mesh)| {
            let mut mesh = mesh(Paint::Colors);
            change(&mut mesh);
            match refused(&mesh, format) {
                MeshFileError::Content { found, .. } => found,
                other => panic!("{other}"),
            }
        };
        assert_eq!(content(&|mesh| mesh.colors = Some(vec![])), "0 colours");
        assert_eq!(content(&|mesh| mesh.vertices[3][1] = f32::NAN), "the coordinate NaN");
        assert_eq!(
            content(&|mesh| mesh.triangles[2][0] = 1 << 30),
            "a triangle of vertex 1073741824"
        );
        let places = Some(vec![[0.0; 2]]);
        let places = content(&|mesh| mesh.texture_coordinates = places.clone());
        assert_eq!(places, "1 texture coordinates");
        for stem in ["", "a/b", "..\\b", "a\nb"] {
            let error = encode(&mesh(Paint::None), format, stem, None, None).expect_err("refused");
            assert!(matches!(error, MeshFileError::Stem(_)), "{stem}");
        }
        let nowhere = LonLat { lon_deg: f64::NAN, lat_deg: 0.0 };
        let nowhere = MeshGeoreference { origin: nowhere, ..GEOREFERENCE };
        let error = encode(&mesh(Paint::None), format, "m", Some(&nowhere), None);
        assert!(matches!(error, Err(MeshFileError::Georeference(_))));
    }
    let odd = Image8::new(1, 1, 5, vec![0; 5]).expect("an image");
    let error = encode(&mesh(Paint::Texture), MeshFormat::Glb, "m", None, Some(&odd));
    assert!(matches!(error, Err(MeshFileError::Texture { channels: 5, .. })));
}

/// The harness hides what `eprintln!` says; this reaches the terminal.
fn skipped(what: &str) {
    let _ = writeln!(std::io::stderr(), "SKIPPED {what}");
}

fn save(folder: &Path, files: &[NamedBytes]) {
    for file in files {
        std::fs::write(folder.join(&file.name), &file.bytes).expect("writes");
    }
}

const VALIDATE: &str = r#"
const validator = require("gltf-validator");
const fs = require("fs");
(async () => {
  for (const path of process.argv.slice(1)) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(path)));
    const { numErrors, numWarnings } = report.issues;
    console.log(numErrors, numWarnings, report.info.totalVertexCount, report.info.totalTriangleCount);
    if (numErrors || numWarnings) console.error(JSON.stringify(report.issues, null, 1));
  }
})();
"#;

#[test]
fn the_khronos_validator_finds_nothing() {
    let Some(folder) = std::env::var_os("SAT3D_GLTF_VALIDATOR") else {
        skipped("gltf-validator: SAT3D_GLTF_VALIDATOR names no folder with it");
        return;
    };
    let output = tempfile::tempdir().expect("a folder");
    let mut paths: Vec<OsString> = Vec::new();
    for (paint, georeference) in [
        (Paint::None, None),
        (Paint::None, Some(&GEOREFERENCE)),
        (Paint::Colors, Some(&GEOREFERENCE)),
        (Paint::Texture, Some(&GEOREFERENCE)),
    ] {
        let stem = format!("mesh{}", paths.len());
        let files = encode(&mesh(paint), MeshFormat::Glb, &stem, georeference, Some(&picture()));
        let files = files.expect("a file");
        save(output.path(), &files);
        paths.push(output.path().join(&files[0].name).into());
    }
    let ran = Command::new("node")
        .args(["-e", VALIDATE, "--"])
        .args(&paths)
        .current_dir(folder)
        .output()
        .expect("node runs");
    let mesh = mesh(Paint::None);
    let line = format!("0 0 {} {}\n", mesh.vertices.len(), mesh.triangles.len());
    let found = String::from_utf8_lossy(&ran.stdout);
    assert_eq!(found, line.repeat(paths.len()), "{}", String::from_utf8_lossy(&ran.stderr));
}

fn python_with(import: &str) -> Option<OsString> {
    let given = ["SAT3D_TEST_PYTHON", "SAT3D_PYTHON"].iter().find_map(std::env::var_os);
    let interpreter = given.unwrap_or_else(|| "python3".into());
    let probe = Command::new(&interpreter).args(["-c", &format!("import {import}")]).output();
    if probe.is_ok_and(|output| output.status.success()) {
        return Some(interpreter);
    }
    skipped(&format!("no python with {import} (set SAT3D_TEST_PYTHON)"));
    None
}

/// Prints vertices, faces, watertight, consistent, volume, bounds, and some colours of each file.
const TRIMESH: &str = r#"
import sys, numpy, trimesh
for path in sys.argv[1:]:
    mesh = trimesh.load(path, process=False)
    if isinstance(mesh, trimesh.Scene):
        (mesh,) = mesh.geometry.values()
    # Beside a material trimesh keeps glTF's colours as they are stored.
    stored = getattr(mesh.visual, "vertex_attributes", {})
    colors = mesh.visual.vertex_colors if mesh.visual.kind == "vertex" else stored.get("color")
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    print(len(mesh.vertices), len(mesh.faces), mesh.is_watertight, mesh.is_winding_consistent)
    print(mesh.volume, *mesh.bounds.ravel())
    print("none" if colors is None else " ".join(map(str, numpy.asarray(colors)[1, :3])),
          "none" if image is None else image.size[0])
"#;

#[test]
fn trimesh_finds_the_same_body() {
    let Some(python) = python_with("trimesh, PIL") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    for paint in [Paint::None, Paint::Colors, Paint::Texture] {
        let mesh = mesh(paint);
        let mut paths = Vec::new();
        for format in [MeshFormat::Glb, MeshFormat::Ply, MeshFormat::Obj] {
            let files = files(&mesh, format, &format!("{paint:?}"));
            save(folder.path(), &files);
            paths.push(folder.path().join(&files[0].name));
        }
        let ran = Command::new(&python).args(["-c", TRIMESH]).args(&paths).output().expect("runs");
        assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
        let text = String::from_utf8_lossy(&ran.stdout).into_owned();
        let lines: Vec<&str> = text.lines().collect();
        for (index, lines) in lines.chunks(3).enumerate() {
            let counts = format!("{} {} True True", mesh.vertices.len(), mesh.triangles.len());
            assert_eq!(lines[0], counts, "{:?}", paths[index]);
            let numbers = lines[1].split(' ').map(|v| v.parse().expect("a number"));
            let numbers: Vec<f64> = numbers.collect();
            assert!((numbers[0] / mesh.signed_volume() - 1.0).abs() < 1e-6);
            let [low, high] = mesh.bounds().expect("bounds").map(|c| c.map(f64::from));
            let wanted = match index {
                // glTF: x east, y up, z south.
                0 => [low[0], low[2], -high[1], high[0], high[2], -low[1]],
                _ => [low[0], low[1], low[2], high[0], high[1], high[2]],
            };
            for (found, wanted) in numbers[1..].iter().zip(wanted) {
                assert!((found - wanted).abs() < 1e-6, "{:?}: {lines:?}", paths[index]);
            }
            let wanted = match (paint, index) {
                // Linear light of 7, 3, 1 in 16 bits.
                (Paint::Colors, 0) => "139 60 20 none",
                (Paint::Colors, _) => "7 3 1 none",
                (Paint::Texture, 0 | 2) => "none 12",
                _ => continue,
            };
            assert_eq!(lines[2], wanted, "{:?}", paths[index]);
        }
    }
}

const OPEN3D: &str = r#"
import sys, numpy, open3d
open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
for path in sys.argv[1:]:
    mesh = open3d.io.read_triangle_mesh(path)
    # In a sum: vertices of an OBJ come in the order of the faces.
    color = numpy.rint(numpy.asarray(mesh.vertex_colors) * 255).astype(int).sum(0)
    print(len(mesh.vertices), len(mesh.triangles), mesh.is_watertight(), round(mesh.get_volume(), 3), *color)
"#;

const MESHIO: &str = r#"
import sys, meshio
for path in sys.argv[1:]:
    mesh = meshio.read(path)
    print(len(mesh.points), sum(len(block.data) for block in mesh.cells))
"#;

#[test]
fn open3d_and_meshio_find_the_same_body() {
    let mesh = mesh(Paint::Colors);
    let folder = tempfile::tempdir().expect("a folder");
    let paths = [MeshFormat::Ply, MeshFormat::Obj, MeshFormat::Glb].map(|format| {
        let files = files(&mesh, format, "m");
        save(folder.path(), &files);
        folder.path().join(&files[0].name)
    });
    let run = |python: OsString, script: &str, paths: &[std::path::PathBuf]| {
        let ran = Command::new(python).args(["-c", script]).args(paths).output().expect("runs");
        assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8_lossy(&ran.stdout).into_owned()
    };
    let counts = format!("{} {}", mesh.vertices.len(), mesh.triangles.len());
    if let Some(python) = python_with("open3d") {
        let volume = (mesh.signed_volume() * 1000.0).round() / 1000.0;
        let colors = mesh.colors.as_ref().expect("colours");
        let [r, g, b] = [0, 1, 2].map(|k| colors.iter().map(|c| u64::from(c[k])).sum::<u64>());
        let text = run(python, OPEN3D, &paths);
        let lines: Vec<&str> = text.lines().collect();
        for line in &lines[..2] {
            assert_eq!(*line, format!("{counts} True {volume} {r} {g} {b}"));
        }
        assert!(lines[2].starts_with(&format!("{counts} True {volume}")), "{}", lines[2]);
    }
    if let Some(python) = python_with("meshio") {
        let text = run(python, MESHIO, &paths[..1]);
        assert_eq!(text, format!("{counts}\n"));
    }
}
