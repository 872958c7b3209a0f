//! Tiles on disk, pieces, mesh files.

use super::output::{CityMeshColour, CityMeshError, CityMeshOptions, MeshSummary, write_mesh};
use super::parts::{Content, Parts, PartsError};
use super::simplify::Target;
use super::simplify_tests::box_city;
use super::sink::SlabMesher;
use super::store::{StoreError, SurfaceStore, encode, read_tile};
use super::tests::city;
use super::weld::{open_edges, weld};
use super::{MeshTile, TileIndex};
use crate::batch::write_atomic;
use crate::tile::city::{Along, City};
use crate::tile::frame::LocalFrame;
use crate::tile::slabs::{FOLDER, Kind, Slabs};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// The slabs of a city, written into a folder.
fn write_slabs(city: &City, values: &[f32], out: &Path) -> Vec<(TileIndex, MeshTile)> {
    std::fs::create_dir_all(out.join(FOLDER)).expect("a folder");
    let slabs = Slabs { city, out };
    let [_, across] = city.lines_across();
    let size = across as usize * city.levels.z.len();
    let line = |index: u32| &values[index as usize * size..][..size];
    let mut all = Vec::new();
    for slab in 0..city.slabs() {
        let mut mesher = SlabMesher::new(city, slab, 5.0).expect("a mesher");
        let lines = city.lines(slab);
        if slab > 0 {
            mesher.prime(line(lines.start - 1)).expect("primes");
        }
        for index in lines {
            mesher.push(index, line(index)).expect("a line");
        }
        let tiles = mesher.finish().expect("tiles");
        write_atomic(&slabs.path(slab, Kind::Surface), &encode(slab, &tiles)).expect("writes");
        let [x, y] = city.rectangle(slab);
        let colours: Vec<u8> = y
            .flat_map(|y| x.clone().flat_map(move |x| [(x / 3) as u8, (y / 3) as u8, 7]))
            .collect();
        write_atomic(&slabs.path(slab, Kind::Colours), &colours).expect("writes");
        all.extend(tiles);
    }
    all
}

/// A city of 2 x 2 tiles with few levels.
fn small(along: Along) -> (City, Vec<f32>) {
    let city = city([300, 270], 6, along);
    let values = box_city(&city, 0.0);
    (city, values)
}

#[test]
fn tiles_come_back_and_damage_is_found() {
    for along in [Along::X, Along::Y] {
        let (city, values) = small(along);
        let folder = tempfile::tempdir().expect("a folder");
        let tiles = write_slabs(&city, &values, folder.path());
        let slabs = Slabs { city: &city, out: folder.path() };
        let store = SurfaceStore::open(&slabs).expect("opens");
        let found: Vec<TileIndex> = store.tiles().map(|tile| tile.index).collect();
        let index = |row, column| TileIndex { row, column };
        assert_eq!(found, [index(0, 0), index(0, 1), index(1, 0), index(1, 1)]);
        let mut totals = [0; 2];
        for (index, tile) in &tiles {
            assert_eq!(store.read_tile(*index).expect("reads"), *tile);
            assert_eq!(read_tile(&slabs, *index).expect("reads"), *tile);
            totals[0] += tile.vertices.len() as u64;
            totals[1] += tile.triangles.len() as u64;
        }
        assert_eq!(store.totals(), totals);
        let beyond = store.read_tile(index(2, 0)).expect_err("no such tile");
        assert!(matches!(beyond, StoreError::NoTile { rows: 2, columns: 2, .. }), "{beyond}");

        let path = slabs.path(1, Kind::Surface);
        let whole = std::fs::read(&path).expect("reads");
        let opened = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("writes");
            let store = SurfaceStore::open(&slabs)?;
            store.tiles().try_for_each(|tile| store.read_tile(tile.index).map(drop))
        };
        for length in [0, 10, 24, 50, whole.len() - 1] {
            let error = opened(&whole[..length]).expect_err("cut off").to_string();
            assert!(error.contains("00001.surface") && error.contains("damaged"), "{error}");
        }
        for at in [0, 8, 12, 16, 20, 24, 40, 52, 200, whole.len() - 1] {
            let mut bytes = whole.clone();
            bytes[at] ^= 1;
            assert!(matches!(opened(&bytes), Err(StoreError::Damaged { .. })), "byte {at}");
        }
        let longer = [&whole[..], &[0]].concat();
        assert!(opened(&longer).is_err());
        std::fs::remove_file(&path).expect("removes");
        assert!(matches!(SurfaceStore::open(&slabs), Err(StoreError::Io { .. })));
    }
}

/// Positions, colours and triangles.
type Ply = (Vec<[u32; 3]>, Vec<[u8; 3]>, Vec<[u32; 3]>);

/// What a binary PLY of this program holds.
fn ply(path: &Path, coloured: bool) -> Ply {
    let bytes = std::fs::read(path).expect("reads");
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|part| part == end).expect("an end") + end.len();
    let header = std::str::from_utf8(&bytes[..start]).expect("text");
    let count = |what: &str| -> usize {
        let line = header.lines().find_map(|line| line.strip_prefix(&format!("element {what} ")));
        line.expect("a line").parse().expect("a number")
    };
    let word = |bytes: &[u8], at: usize| {
        u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
    };
    let size = if coloured { 15 } else { 12 };
    let (vertices, faces) = bytes[start..].split_at(size * count("vertex"));
    assert_eq!(faces.len(), 13 * count("face"));
    (
        vertices.chunks(size).map(|b| [0, 4, 8].map(|at| word(b, at))).collect(),
        vertices.chunks(size).filter(|_| coloured).map(|b| [b[12], b[13], b[14]]).collect(),
        faces.chunks(13).map(|b| [1, 5, 9].map(|at| word(b, at))).collect(),
    )
}

/// Triangles by the bits of their corners, over several files.
fn faces<'a>(
    files: impl IntoIterator<Item = &'a (Vec<[u32; 3]>, Vec<[u8; 3]>, Vec<[u32; 3]>)>,
) -> Vec<[[u32; 3]; 3]> {
    let mut all = Vec::new();
    for (vertices, _, triangles) in files {
        for corners in triangles {
            let mut face = corners.map(|corner| vertices[corner as usize]);
            let least = (0..3).min_by_key(|k| face[*k]).unwrap_or_default();
            face.rotate_left(least);
            all.push(face);
        }
    }
    all.sort_unstable();
    all
}

fn write(
    city: &City,
    out: &Path,
    name: &str,
    options: &CityMeshOptions,
) -> Result<MeshSummary, CityMeshError> {
    let slabs = Slabs { city, out };
    let frame = LocalFrame::new(city, 0.0).expect("a frame");
    write_mesh(&slabs, &frame, options, &out.join(name), &|_| ())
}

#[test]
fn one_file_and_its_parts_are_the_same_surface() {
    let (city, values) = small(Along::Y);
    let folder = tempfile::tempdir().expect("a folder");
    let tiles = write_slabs(&city, &values, folder.path());
    let whole = weld(tiles.iter().map(|(_, tile)| tile));
    let options = CityMeshOptions::default();
    let summary = write(&city, folder.path(), "city.ply", &options).expect("writes");
    assert_eq!((summary.parts, summary.files.len(), summary.error_m), (1, 1, 0.0));
    assert_eq!(summary.files[0].name, "city.ply");
    let counts = [summary.vertices as usize, summary.triangles as usize];
    assert_eq!(counts, [whole.vertices.len(), whole.triangles.len()]);
    let one = ply(&folder.path().join("city.ply"), true);
    assert_eq!(one.0.len(), whole.vertices.len());
    assert!(open_edges(&one.2).is_empty());
    // Along its axis a colour is the third of a pixel's index, within what bilinear weights round.
    for (vertex, colour) in one.0.iter().zip(&one.1) {
        let [east, north, _] = vertex.map(f32::from_bits).map(f64::from);
        let [x, y] = [east / 0.25 + 150.0, 135.0 - north / 0.25];
        assert!((f64::from(colour[0]) - (x / 3.0 - 0.5)).abs() < 1.01, "{x} {colour:?}");
        assert!((f64::from(colour[1]) - (y / 3.0 - 0.5)).abs() < 1.01, "{y} {colour:?}");
        assert_eq!(colour[2], 7);
    }
    let tile_bytes = summary.files[0].bytes * 3 / 4;
    let small_parts = CityMeshOptions { part_bytes: tile_bytes, ..options.clone() };
    let summary = write(&city, folder.path(), "parts.ply", &small_parts).expect("writes");
    let names: Vec<&str> = summary.files.iter().map(|file| &*file.name).collect();
    assert_eq!(names, ["parts_1.ply", "parts_2.ply", "parts_3.ply", "parts_4.ply"]);
    assert!(summary.files.iter().all(|file| file.bytes <= tile_bytes));
    let parts: Vec<_> = names.iter().map(|name| ply(&folder.path().join(name), true)).collect();
    assert_eq!(faces(&parts), faces([&one]), "the parts' union is the whole");
    assert_eq!(summary.triangles, one.2.len() as u64);
    // Vertices of the same place have the same colour in all parts.
    let mut colours: HashMap<[u32; 3], [u8; 3]> = HashMap::new();
    for (vertices, found, _) in &parts {
        for (vertex, colour) in vertices.iter().zip(found) {
            assert_eq!(colours.entry(*vertex).or_insert(*colour), colour);
        }
    }
    let none = CityMeshOptions { part_bytes: 10_000, ..options.clone() };
    let error = write(&city, folder.path(), "none.ply", &none).expect_err("a tile is larger");
    assert!(matches!(error, CityMeshError::Tile { most: 10_000, .. }), "{error}");
    let left: Vec<_> = std::fs::read_dir(folder.path()).expect("lists").collect();
    assert_eq!(left.len(), 6, "nothing of the refused one: {left:?}");
}

#[test]
fn textures_split_by_their_side() {
    let (city, values) = small(Along::X);
    let folder = tempfile::tempdir().expect("a folder");
    write_slabs(&city, &values, folder.path());
    let colour = CityMeshColour::Texture;
    let options = CityMeshOptions { colour, ..CityMeshOptions::default() };
    let names = |summary: MeshSummary| -> Vec<String> {
        summary.files.into_iter().map(|file| file.name).collect()
    };
    let summary = write(&city, folder.path(), "c.obj", &options).expect("writes");
    assert_eq!(names(summary), ["c.obj", "c.mtl", "c.png"]);
    let smaller = CityMeshOptions { texture_side: 299, ..options };
    let summary = write(&city, folder.path(), "c.glb", &smaller).expect("writes");
    assert_eq!(names(summary), ["c_1.glb", "c_2.glb", "c_3.glb", "c_4.glb"]);
}

#[test]
fn files_of_an_earlier_run_go() {
    let (city, values) = small(Along::X);
    let folder = tempfile::tempdir().expect("a folder");
    write_slabs(&city, &values, folder.path());
    let names = || {
        let entries = std::fs::read_dir(folder.path()).expect("lists");
        let names = entries.map(|entry| entry.expect("an entry").file_name().into_string());
        names.map(|name| name.expect("text")).filter(|name| name != FOLDER).collect::<BTreeSet<_>>()
    };
    // Another city's, another format's, no numbers that are written, behind a gap, somebody's picture.
    let others =
        ["cc.obj", "c.glb", "c_1.glb", "c_01.obj", "c_x.obj", "c_6.obj", "c_6.png", "d_1.obj"];
    for name in others {
        std::fs::write(folder.path().join(name), "mine").expect("writes");
    }
    let one = CityMeshOptions { colour: CityMeshColour::Texture, ..CityMeshOptions::default() };
    let four = CityMeshOptions { texture_side: 299, ..one.clone() };
    let parts = |number: &str| ["obj", "mtl", "png"].map(|ending| format!("c{number}.{ending}"));
    let whole: Vec<String> = parts("").to_vec();
    let quarters: Vec<String> = ["_1", "_2", "_3", "_4"].into_iter().flat_map(parts).collect();
    for (options, wanted) in [(&four, &quarters), (&one, &whole), (&four, &quarters)] {
        write(&city, folder.path(), "c.obj", options).expect("writes");
        let wanted = wanted.iter().map(String::as_str).chain(others);
        assert_eq!(names(), wanted.map(str::to_owned).collect());
    }
    // A fifth part of which there was one, whose picture is not its material's.
    for (name, text) in [("c_5.obj", ""), ("c_5.mtl", "map_Kd other.png\n"), ("c_5.png", "")] {
        std::fs::write(folder.path().join(name), text).expect("writes");
    }
    let plain = CityMeshOptions { colour: CityMeshColour::None, ..CityMeshOptions::default() };
    write(&city, folder.path(), "c.obj", &plain).expect("writes");
    // With it the sixth: there is no gap any more.
    let left = ["c.obj", "c_5.mtl", "c_5.png"];
    let others = others.into_iter().filter(|name| *name != "c_6.obj");
    assert_eq!(names(), left.into_iter().chain(others.clone()).map(str::to_owned).collect());
    // One numbered file alone is no part.
    std::fs::write(folder.path().join("c_1.obj"), "mine").expect("writes");
    write(&city, folder.path(), "c.obj", &plain).expect("writes");
    assert!(names().contains("c_1.obj"));
    let mut others = others.chain(["c_1.obj"]);
    assert!(others.all(|name| {
        std::fs::read(folder.path().join(name)).is_ok_and(|bytes| bytes == b"mine")
    }));
}

#[test]
fn simplified_pieces_weld_and_keep_within_the_error() {
    let (city, values) = small(Along::Y);
    let folder = tempfile::tempdir().expect("a folder");
    write_slabs(&city, &values, folder.path());
    let slabs = Slabs { city: &city, out: folder.path() };
    let store = SurfaceStore::open(&slabs).expect("opens");
    let frame = LocalFrame::new(&city, 0.0).expect("a frame");
    let place = |point| frame.place(point);
    let pieces = |target: Target, most: u64| {
        let fits = |piece: &super::parts::Piece| piece.triangles <= most;
        let parts = Parts { store: &store, place: &place, target, fits: &fits, progress: &|_| () };
        let mut found = Vec::new();
        let count = parts.each(|number, only, piece| {
            found.push((number, only, piece));
            Ok::<(), PartsError>(())
        });
        assert_eq!(count.expect("pieces") as usize, found.len());
        found
    };
    let mesh = |piece: &super::parts::Piece| match &piece.content {
        Content::Simplified(mesh) => mesh.clone(),
        Content::Stored(_) => panic!("not simplified"),
    };
    let target = Target { error_m: Some(0.5), triangles: None };
    let one = pieces(target, u64::MAX);
    assert_eq!((one.len(), one[0].0, one[0].1), (1, 1, true));
    let whole = mesh(&one[0].2);
    assert!(one[0].2.error_m > 0.0 && one[0].2.error_m <= 0.5);
    assert!(open_edges(&whole.triangles).is_empty());
    let [_, before] = store.totals();
    assert!((whole.triangles.len() as u64) < before / 20, "{} of {before}", whole.triangles.len());
    // The seams were simplified too: fewer triangles than tile by tile.
    let four = pieces(target, 10);
    assert_eq!(four.len(), 4);
    let meshes: Vec<MeshTile> = four
        .iter()
        .map(|(_, only, piece)| {
            assert!(!only && piece.error_m <= 0.5);
            mesh(piece)
        })
        .collect();
    let welded = weld(&meshes);
    assert!(open_edges(&welded.triangles).is_empty(), "pieces weld without cracks");
    assert!(whole.triangles.len() < welded.triangles.len());
    let counted = pieces(Target { error_m: None, triangles: Some(2000) }, u64::MAX);
    assert!((1800..=2000).contains(&counted[0].2.triangles), "{}", counted[0].2.triangles);
    let stored: BTreeMap<u32, Content> = pieces(Target::default(), u64::MAX)
        .into_iter()
        .map(|(number, _, piece)| (number, piece.content))
        .collect();
    assert!(matches!(&stored[&1], Content::Stored(tiles) if tiles.len() == 4));
}

#[test]
fn what_is_refused() {
    let city = city([20, 10], 4, Along::X);
    let folder = tempfile::tempdir().expect("a folder");
    write_slabs(&city, &[1.0; 800], folder.path());
    let options = CityMeshOptions { isovalue: 7.5, ..CityMeshOptions::default() };
    let error = write(&city, folder.path(), "c.glb", &options).expect_err("empty").to_string();
    assert!(error.contains("7.5"), "{error}");
    write_slabs(&city, &[9.0; 800], folder.path());
    for name in ["city", "city.stl", ".glb"] {
        let error = write(&city, folder.path(), name, &options).expect_err("no format");
        assert!(matches!(error, CityMeshError::Format { .. }), "{error}");
    }
    let error = write(&city, folder.path(), "no/folder/c.glb", &options).expect_err("no folder");
    assert!(matches!(error, CityMeshError::Io { .. }), "{error}");
    // Layers of air and ground a few millionths of a metre thick.
    let mut fine = city.clone();
    fine.levels.z = vec![0.3, 0.300_000_1, 0.300_000_2, 0.300_000_3];
    write_slabs(&fine, &[9.0, 1.0, 9.0, 1.0].repeat(200), folder.path());
    let error = write(&fine, folder.path(), "c.glb", &options).expect_err("too fine");
    assert!(matches!(error, CityMeshError::TooFine { merged: 1.., .. }), "{error}");
}
