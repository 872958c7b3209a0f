//! The pure reader against files written by the `tiff` crate's encoder and by hand, in every build.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::raster_support;

use raster_support::{Image, Tag, Tiff, bits, height, read_all};
use sat3d::lidar::TileStore;
use sat3d::raster::{OpenOptions, RasterReader, TiffReader, open};
use std::fs::File;
use std::path::Path;
use tempfile::TempDir;
use tiff::encoder::colortype::{
    ColorType, Gray8, Gray16, Gray32, Gray32Float, Gray64Float, GrayI16,
};
use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, TiffKindBig, TiffValue};
use tiff::tags::Predictor;

const WIDTH: usize = 301;
const HEIGHT: usize = 187;

fn grid<T>(value: impl Fn(f64) -> T) -> Vec<T> {
    (0..WIDTH * HEIGHT).map(|i| value(height(i % WIDTH, i / WIDTH))).collect()
}

/// Reads with the build's reader and with the pure one; both must agree.
fn samples(path: &Path) -> Vec<f32> {
    let options = OpenOptions::default();
    let mut pure = TiffReader::open(path, &options).unwrap();
    let mut built = open(path, &options).unwrap();
    let read = read_all(&mut pure).unwrap();
    assert!(bits(&read) == bits(&read_all(&mut *built).unwrap()), "{}", path.display());
    read
}

fn encode<C: ColorType>(path: &Path, data: &[C::Inner], compression: Compression, float: bool)
where
    [C::Inner]: TiffValue,
{
    let predictor = match (compression, float) {
        (Compression::Deflate(_) | Compression::Lzw, false) => Predictor::Horizontal,
        _ => Predictor::None,
    };
    let (width, height) = (WIDTH as u32, HEIGHT as u32);
    let big = path.to_string_lossy().contains("big");
    let file = File::create(path).unwrap();
    if big {
        let encoder = TiffEncoder::<_, TiffKindBig>::new_generic(file).unwrap();
        let mut encoder = encoder.with_compression(compression).with_predictor(predictor);
        encoder.write_image::<C>(width, height, data).unwrap();
    } else {
        let encoder = TiffEncoder::new(file).unwrap();
        let mut encoder = encoder.with_compression(compression).with_predictor(predictor);
        encoder.write_image::<C>(width, height, data).unwrap();
    }
}

#[test]
fn what_the_tiff_crate_encodes_is_read_back() {
    let folder = TempDir::new().unwrap();
    for (compression, kind) in [
        (Compression::Uncompressed, "plain"),
        (Compression::Deflate(DeflateLevel::Balanced), "deflate"),
        (Compression::Lzw, "lzw"),
        (Compression::Packbits, "packbits"),
    ] {
        for name in ["classic.tif", "big.tif"] {
            let path = &folder.path().join(name);
            let context = format!("{kind} {name}");
            macro_rules! round_trip {
                ($color:ty, $float:literal, $value:expr) => {{
                    let data = grid($value);
                    encode::<$color>(path, &data, compression, $float);
                    let expected: Vec<f32> = data.iter().map(|v| *v as f32).collect();
                    assert!(bits(&samples(path)) == bits(&expected), "{context}");
                }};
            }
            round_trip!(Gray8, false, |v| v as u8);
            round_trip!(Gray16, false, |v| (v * 500.0) as u16);
            round_trip!(GrayI16, false, |v| (v * 200.0 - 20_000.0) as i16);
            round_trip!(Gray32, false, |v| (v * 3e7) as u32);
            round_trip!(Gray32Float, true, |v| v as f32);
            round_trip!(Gray64Float, true, |v| v);
        }
    }
}

/// A terrain in tiles of 32 x 16, padded at the right and at the bottom, each row of each tile by
/// predictor 3, in the byte order given.
fn float_tiles(pack: impl Fn(&[u8]) -> Vec<u8>) -> (Vec<Vec<u8>>, Vec<f32>) {
    let values = grid(|v| v as f32);
    let mut tiles = Vec::new();
    for top in (0..HEIGHT).step_by(16) {
        for left in (0..WIDTH).step_by(32) {
            let mut tile = Vec::new();
            for y in top..top + 16 {
                let mut row = vec![0_u8; 128];
                for x in left..left + 32 {
                    let value = if x < WIDTH && y < HEIGHT { values[y * WIDTH + x] } else { 7.0 };
                    for (plane, byte) in value.to_be_bytes().into_iter().enumerate() {
                        row[plane * 32 + x - left] = byte;
                    }
                }
                for i in (1..row.len()).rev() {
                    row[i] = row[i].wrapping_sub(row[i - 1]);
                }
                tile.extend(row);
            }
            tiles.push(pack(&tile));
        }
    }
    (tiles, values)
}

#[test]
fn float_tiles_with_predictor_3_are_read_in_both_byte_orders_from_zstd_too() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tiles.tif");
    let zstd = |tile: &[u8]| {
        ruzstd::encoding::compress_to_vec(tile, ruzstd::encoding::CompressionLevel::Fastest)
    };
    let deflate = |tile: &[u8]| {
        let mut out = vec![0; tile.len() + 1000];
        let config = zlib_rs::DeflateConfig::default();
        let (packed, code) = zlib_rs::compress_slice(&mut out, tile, config);
        assert_eq!(code, zlib_rs::ReturnCode::Ok);
        packed.to_vec()
    };
    for (big_endian, big_tiff) in [(false, false), (true, false), (true, true)] {
        for (code, (tiles, values)) in [(50_000, float_tiles(zstd)), (8, float_tiles(deflate))] {
            let image = Image::floats(WIDTH as u32, HEIGHT as u32, 1, &[], big_endian)
                .tiled(32, 16)
                .tag(259, Tag::Short(vec![code]))
                .tag(317, Tag::Short(vec![3]))
                .chunks(tiles);
            Tiff { images: vec![image], big_tiff, big_endian }.write(&path);
            let read = samples(&path);
            assert!(bits(&read) == bits(&values), "{code} big-endian {big_endian}");
        }
    }
}

#[test]
fn chunks_that_were_never_written_are_nodata_or_zero() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("sparse.tif");
    for nodata in [Some("-9999"), None] {
        let values = grid(|v| v as f32);
        let mut image = Image::floats(WIDTH as u32, HEIGHT as u32, 10, &values, false);
        if let Some(nodata) = nodata {
            image = image.tag(42113, Tag::Ascii(nodata.to_owned()));
        }
        let mut strips: Vec<Vec<u8>> = values
            .chunks(WIDTH * 10)
            .map(|s| s.iter().flat_map(|v| v.to_le_bytes()).collect())
            .collect();
        strips[3].clear();
        strips[18].clear();
        Tiff::of(image.chunks(strips)).write(&path);
        let fill = if nodata.is_some() { f32::NAN } else { 0.0 };
        let expected: Vec<f32> = values
            .iter()
            .enumerate()
            .map(|(i, v)| if matches!(i / WIDTH / 10, 3 | 18) { fill } else { *v })
            .collect();
        assert!(bits(&samples(&path)) == bits(&expected), "{nodata:?}");
    }
}

#[test]
fn min_is_white_is_not_inverted() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("white.tif");
    let values = grid(|v| v as f32);
    let image = Image::floats(WIDTH as u32, HEIGHT as u32, 20, &values, false);
    Tiff::of(image.tag(262, Tag::Short(vec![0]))).write(&path);
    assert!(bits(&samples(&path)) == bits(&values));
}

#[test]
fn a_raster_in_one_strip_is_read_in_little_memory() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("one_strip.tif");
    let (width, rows) = (64_usize, 2500_usize);
    let values: Vec<f32> = (0..width * rows).map(|i| i as f32 * 0.5).collect();
    let mut tiff = Tiff::of(Image::floats(64, 2500, 2500, &values, true));
    tiff.big_endian = true;
    tiff.write(&path);
    let options = OpenOptions { memory_limit: 550_000, ..OpenOptions::default() };
    for mut reader in [
        Box::new(TiffReader::open(&path, &options).unwrap()) as Box<dyn RasterReader>,
        open(&path, &options).unwrap(),
    ] {
        assert_eq!(reader.header().block_height, 1024);
        assert!(bits(&read_all(&mut *reader).unwrap()) == bits(&values));
    }
}

#[test]
fn windows_of_a_store_are_the_raster_whatever_the_budget() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("tile.tif");
    let values = grid(|v| v as f32);
    let image = Image::floats(WIDTH as u32, HEIGHT as u32, 1, &values, false);
    Tiff::of(image).write(&path);
    for budget in [0, 300_000, 64 << 20] {
        let mut store = TileStore::new(budget, OpenOptions::default());
        let tile = store.add(&path).unwrap();
        let store = &store;
        std::thread::scope(|scope| {
            for thread in 0..4_i64 {
                let values = &values;
                scope.spawn(move || {
                    let mut out = vec![0.0; 50 * 40];
                    for step in 0..20 {
                        let (col, row) = (step * 17 - 20, (step * thread * 11) % 200 - 10);
                        store.read_window(tile, col, row, 50, 40, &mut out).unwrap();
                        for (i, v) in out.iter().enumerate() {
                            let (x, y) = (col + i as i64 % 50, row + i as i64 / 50);
                            let inside =
                                (0..WIDTH as i64).contains(&x) && (0..HEIGHT as i64).contains(&y);
                            let expected = inside.then(|| values[y as usize * WIDTH + x as usize]);
                            assert_eq!((!v.is_nan()).then_some(*v), expected);
                        }
                    }
                });
            }
        });
    }
}
