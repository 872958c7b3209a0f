//! Files that are damaged, foreign or no use: each a clear error, in both builds and both readers.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::raster_support;

use proptest::prelude::*;
use raster_support::{Image, KEYS_2927, KEYS_4326, Tag, Tiff, bits, height, read_all};
use sat3d::lidar::TileStore;
use sat3d::raster::{OpenOptions, RasterHeader, RasterReader, TiffReader, open};
use std::path::Path;
use tempfile::TempDir;

const WIDTH: u32 = 40;
const HEIGHT: u32 = 30;

fn values() -> Vec<f32> {
    let side = WIDTH as usize;
    (0..(WIDTH * HEIGHT) as usize).map(|i| height(i % side, i / side) as f32).collect()
}

fn sound() -> Image {
    Image::floats(WIDTH, HEIGHT, 10, &values(), false)
}

/// The build's reader, and the pure one.
fn readers(path: &Path) -> Vec<Result<Box<dyn RasterReader>, String>> {
    let options = OpenOptions::default();
    let pure = TiffReader::open(path, &options);
    vec![
        open(path, &options).map_err(|e| e.to_string()),
        pure.map(|r| Box::new(r) as Box<dyn RasterReader>).map_err(|e| e.to_string()),
    ]
}

/// The messages with which both readers refuse to open a file; each must name it.
fn refusals(path: &Path) -> Vec<String> {
    let refused = readers(path).into_iter().map(|r| r.err().expect("it must not open"));
    let messages: Vec<String> = refused.collect();
    let name = path.file_name().unwrap().to_string_lossy().into_owned();
    assert!(messages.iter().all(|m| m.contains(&name)), "{messages:?}");
    messages
}

fn headers(image: Image) -> Vec<RasterHeader> {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile.tif");
    Tiff::of(image).write(&path);
    readers(&path).into_iter().map(|r| r.unwrap().header().clone()).collect()
}

/// The reason for which both readers' header is not usable as a tile.
fn unusable(image: Image, words: &str) {
    for header in headers(image) {
        let message = header.check_usable().unwrap_err().to_string();
        assert!(message.contains("tile.tif") && message.contains(words), "{message}");
    }
}

#[test]
fn a_sound_file_is_usable() {
    for header in headers(sound()) {
        header.check_usable().unwrap();
        assert!(header.warnings.is_empty(), "{:?}", header.warnings);
        assert_eq!(header.crs.and_then(|crs| crs.epsg), Some(2927));
    }
}

#[test]
fn what_is_no_raster_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("notes.tif");
    std::fs::write(&path, "These are notes on tiles, in a file with a misleading name.\n").unwrap();
    let messages = refusals(&path);
    assert!(messages[1].contains("no TIFF file"), "{messages:?}");
    assert!(messages[0].contains("no TIFF file") || messages[0].contains("GDAL"), "{messages:?}");

    std::fs::write(&path, "").unwrap();
    assert!(refusals(&path).iter().all(|m| m.contains("empty (0 bytes)")));

    let subfolder = folder.path().join("folder.tif");
    std::fs::create_dir(&subfolder).unwrap();
    assert!(refusals(&subfolder).iter().all(|m| m.contains("folder")));

    refusals(&folder.path().join("missing.tif"));

    let bytes = Tiff::of(sound()).bytes();
    for length in [3, 7, 20, 100] {
        std::fs::write(&path, &bytes[..length]).unwrap();
        refusals(&path);
    }
}

#[test]
fn a_truncated_tile_warns_when_it_opens_and_fails_in_the_blocks_that_are_gone() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile_88.tif");
    // Tiles are not merged beyond 256 x 256, so there are six blocks here.
    let (width, height) = (768, 512);
    let tile = vec![0_u8; 256 * 256 * 4];
    let image = Image::floats(width, height, 1, &[], false).tiled(256, 256).chunks(vec![tile; 6]);
    let mut bytes = Tiff::of(image).bytes();
    bytes.truncate(bytes.len() - 300_000);
    std::fs::write(&path, bytes).unwrap();
    for reader in readers(&path) {
        let mut reader = reader.unwrap();
        let warnings = reader.header().warnings.join("\n");
        assert!(warnings.contains("truncated: 2 of 6"), "{warnings}");
        let mut block = Vec::new();
        for (bx, by) in [(0, 0), (1, 0), (2, 0), (0, 1)] {
            reader.read_block(bx, by, &mut block).unwrap();
            assert!(block.iter().all(|v| *v == 0.0));
        }
        for (bx, by) in [(1, 1), (2, 1)] {
            let message = reader.read_block(bx, by, &mut block).unwrap_err().to_string();
            assert!(message.contains("tile_88.tif"), "{message}");
            assert!(message.contains(&format!("block ({bx}, {by})")), "{message}");
        }
    }
    // Through the store: what is there can be read, what is not is an error, again and again.
    let mut store = TileStore::new(1 << 20, OpenOptions::default());
    let tile = store.add(&path).unwrap();
    let mut out = vec![0.0; 100 * 100];
    for _ in 0..2 {
        store.read_window(tile, 0, 0, 100, 100, &mut out).unwrap();
        let error = store.read_window(tile, 600, 400, 100, 100, &mut out).unwrap_err();
        assert!(error.to_string().contains("block (2, 1)"), "{error}");
    }
}

#[test]
fn damaged_data_are_an_error_of_their_block() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("damaged.tif");
    for (compression, data) in [(8, vec![0x78, 0x9C, 1, 2, 3, 4, 5]), (5, vec![0xFF; 9])] {
        let image = sound().tag(259, Tag::Short(vec![compression]));
        Tiff::of(image.chunks(vec![data; 3])).write(&path);
        for reader in readers(&path) {
            let message = read_all(&mut *reader.unwrap()).unwrap_err().to_string();
            assert!(message.contains("damaged.tif: block (0, 0)"), "{message}");
        }
    }
    for reader in readers(&path) {
        let message = reader.unwrap().read_block(1, 0, &mut Vec::new()).unwrap_err().to_string();
        assert!(message.contains("1 x 1 blocks"), "{message}");
    }
}

#[test]
fn a_raster_of_no_use_is_told_why() {
    unusable(sound().without(33550).without(33922), "no georeference");
    unusable(sound().without(34735), "no coordinate reference system");
    unusable(sound().tag(34735, Tag::Short(KEYS_4326.to_vec())), "degrees");
    let matrix = |a: f64, b: f64, d: f64, e: f64| {
        let rows = [[a, b, 0.0, 10.0], [d, e, 0.0, 20.0], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
        let image = sound().without(33550).without(33922);
        image.tag(34264, Tag::Double(rows.concat()))
    };
    unusable(matrix(1.0, 0.5, 0.5, -1.0), "rotated");
    unusable(matrix(1.0, 0.0, 0.0, 1.0), "south up");
    unusable(matrix(-1.0, 0.0, 0.0, -1.0), "south up or mirrored");
    for header in headers(matrix(1.5, 0.0, 0.0, -1.5)) {
        header.check_usable().unwrap();
    }
}

#[test]
fn a_raster_without_size_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("nothing.tif");
    for (width, height) in [(0, 30), (40, 0), (0, 0)] {
        let image = sound().tag(256, Tag::Long(vec![width])).tag(257, Tag::Long(vec![height]));
        Tiff::of(image).write(&path);
        let messages = refusals(&path);
        assert!(messages[1].contains("zero size"), "{messages:?}");
    }
}

#[test]
fn a_world_file_georeferences_the_centre_of_the_first_pixel() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile.tif");
    Tiff::of(sound().without(33550).without(33922)).write(&path);
    std::fs::write(folder.path().join("tile.tfw"), "1.5\n0\n0\n-1.5\n1000.75\n1999.25\n").unwrap();
    for reader in readers(&path) {
        let header = reader.unwrap().header().clone();
        assert_eq!(header.geotransform.0, [1000.0, 1.5, 0.0, 2000.0, 0.0, -1.5]);
    }
}

#[test]
fn odd_headers_are_read_alike_by_both() {
    let keys = |point: u16| {
        let mut keys = KEYS_2927.to_vec();
        keys[11] = point;
        Tag::Short(keys)
    };
    let scale = |x: f64, y: f64| sound().tag(33550, Tag::Double(vec![x, y, 0.0]));
    let tie = |tie: &[f64]| sound().tag(33922, Tag::Double(tie.to_vec()));
    let tied = [10.0, 5.0, 0.0, 1_180_000.3, 840_000.7, 0.0];
    let nodata = |text: &str| sound().tag(42113, Tag::Ascii(text.to_owned()));
    let one_strip = Image::floats(WIDTH, HEIGHT, HEIGHT, &values(), false);
    let odd = [
        ("negative pixel height", scale(1.5, -1.5)),
        ("zero pixel size", scale(0.0, 1.5)),
        ("tie point inside", tie(&tied)),
        ("tie point inside, points", tie(&tied).tag(34735, keys(2))),
        ("two tie points", tie(&[tied, [20.0, 9.0, 0.0, 1.0, 2.0, 0.0]].concat())),
        ("control points", tie(&[tied, tied, tied].concat()).without(33550)),
        ("one tie point alone", tie(&tied).without(33550)),
        ("no tie point", sound().without(33922)),
        ("nodata with a space", nodata(" -9999 ")),
        ("nodata as a word", nodata("nan")),
        ("nodata that is empty", nodata("")),
        ("nodata in few digits", nodata("-3.40282e+38")),
        ("nodata beyond floats", nodata("-1.7976931348623157e+308")),
        ("sample format missing", sound().without(339)),
        ("rows per strip missing", one_strip.without(278)),
    ];
    for (what, image) in odd {
        let mut found = headers(image);
        let nodata: Vec<_> = found.iter().map(|h| h.nodata.map(f64::to_bits)).collect();
        assert_eq!(nodata[0], nodata[1], "{what}");
        for header in &mut found {
            // The temporary file is another time's, NaN is not itself, and names differ.
            (header.crs, header.nodata, header.modified) = (None, None, (0, 0));
        }
        assert_eq!(found[0], found[1], "{what}");
    }
}

/// Refused by the pure reader, by name and with what to do.
fn pure_refuses(image: Image, words: &str) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile.tif");
    Tiff::of(image).write(&path);
    let message = TiffReader::open(&path, &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("tile.tif") && message.contains(words), "{message}");
    assert!(message.contains("gdal_translate"), "{message}");
}

#[test]
fn what_the_pure_reader_cannot_decode_is_refused_by_name() {
    let compressed = |code| sound().tag(259, Tag::Short(vec![code]));
    for (code, name) in
        [(34_887, "lerc"), (7, "jpeg"), (34_925, "lzma"), (50_001, "webp"), (4, "ccittfax4")]
    {
        pure_refuses(compressed(code), name);
    }
    pure_refuses(sound().tag(258, Tag::Short(vec![16])), "floating-point samples of 16 bits");
    pure_refuses(sound().tag(339, Tag::Short(vec![6])), "complex");
    let integers = |bits| sound().tag(339, Tag::Short(vec![1])).tag(258, Tag::Short(vec![bits]));
    pure_refuses(integers(12), "integer samples of 12 bits");
    pure_refuses(integers(64), "integer samples of 64 bits");
    pure_refuses(
        integers(16).tag(259, Tag::Short(vec![8])).tag(317, Tag::Short(vec![3])),
        "predictor",
    );
    pure_refuses(sound().tag(266, Tag::Short(vec![2])), "FillOrder");
}

#[test]
fn a_side_file_that_would_change_the_heights_is_refused_by_the_pure_reader() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile.tif");
    let side = folder.path().join("tile.tif.aux.xml");
    Tiff::of(sound().tag(42113, Tag::Ascii("-9999".to_owned()))).write(&path);
    let refusal = |content: &str| {
        let band =
            format!("<PAMDataset><PAMRasterBand band=\"1\">{content}</PAMRasterBand></PAMDataset>");
        std::fs::write(&side, band).unwrap();
        TiffReader::open(&path, &OpenOptions::default()).err().map(|e| e.to_string())
    };
    assert_eq!(refusal("<Metadata><MDI key=\"STATISTICS_MEAN\">7</MDI></Metadata>"), None);
    assert_eq!(refusal("<NoDataValue>-9999</NoDataValue>"), None);
    for content in [
        "<NoDataValue>-32767</NoDataValue>",
        "<Scale>2</Scale>",
        "<UnitType>ft</UnitType>",
        "<Metadata><MDI key=\"Units\">feet</MDI></Metadata>",
    ] {
        let message = refusal(content).unwrap();
        assert!(message.contains("tile.tif.aux.xml"), "{message}");
    }
}

/// A file with everything in it that the reader looks at, in tiles, compressed, with a mask.
fn rich() -> Vec<u8> {
    let tile: Vec<u8> = (0..16 * 16 * 4_u32).map(|i| (i * 7) as u8).collect();
    let packed: Vec<u8> = tile.chunks(128).flat_map(|run| [&[127_u8][..], run].concat()).collect();
    let image = sound()
        .tiled(16, 16)
        .tag(259, Tag::Short(vec![32_773]))
        .tag(
            42112,
            Tag::Ascii("<GDALMetadata><Item name=\"UNITS\">feet</Item></GDALMetadata>".into()),
        )
        .tag(42113, Tag::Ascii("-9999".into()))
        .chunks(vec![packed; 6]);
    let mask = Image::default()
        .tag(254, Tag::Long(vec![4]))
        .tag(256, Tag::Long(vec![WIDTH]))
        .tag(257, Tag::Long(vec![HEIGHT]))
        .tag(258, Tag::Short(vec![1]))
        .tag(259, Tag::Short(vec![1]))
        .tag(262, Tag::Short(vec![4]))
        .tag(277, Tag::Short(vec![1]))
        .tag(278, Tag::Long(vec![HEIGHT]))
        .chunks(vec![vec![0b1010_1010; 5 * HEIGHT as usize]]);
    Tiff { images: vec![image, mask], ..Tiff::default() }.bytes()
}

#[test]
fn a_mask_written_by_hand_is_read_by_both() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("rich.tif");
    std::fs::write(&path, rich()).unwrap();
    let samples: Vec<Vec<f32>> =
        readers(&path).into_iter().map(|r| read_all(&mut *r.unwrap()).unwrap()).collect();
    assert!(bits(&samples[0]) == bits(&samples[1]));
    assert!(samples[0].iter().skip(1).step_by(2).all(|v| v.is_nan()));
    assert!(samples[0].iter().step_by(2).any(|v| v.is_finite()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn no_damage_makes_the_pure_reader_panic(
        hits in proptest::collection::vec((0_usize..900, any::<u8>()), 0..6),
        cut in 0_usize..12_000,
    ) {
        let mut bytes = rich();
        for (place, value) in hits {
            bytes[place] = value;
        }
        if cut < bytes.len() && cut.is_multiple_of(3) {
            bytes.truncate(cut);
        }
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("damaged.tif");
        std::fs::write(&path, bytes).unwrap();
        let options = OpenOptions { memory_limit: 1 << 20, ..OpenOptions::default() };
        if let Ok(mut reader) = TiffReader::open(&path, &options) {
            let (across, down) = reader.header().blocks();
            let mut block = Vec::new();
            // Damage can make a raster endless; its first and last blocks stand for all.
            for (bx, by) in [(0, 0), (across - 1, down - 1), (across, 0)] {
                let read = reader.read_block(bx, by, &mut block);
                prop_assert!(bx < across || read.is_err());
            }
        }
    }
}
