//! What is written is read back by the `tiff` crate and by both of our readers.

#![expect(clippy::unwrap_used, reason = "a test may fail")]

use super::tags::Format;
use super::*;
use crate::grid::GeoTransform;
use crate::raster::{NodataRule, OpenOptions, RasterReader, TiffReader};
use proptest::prelude::*;
use std::io::Cursor;
use std::path::Path;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

/// Heights with valleys, walls, a NaN with a payload, both zeros and the largest float.
fn terrain(width: u32, height: u32) -> Vec<f32> {
    let special = [f32::from_bits(0x7FC0_1234), -0.0, 0.0, f32::MAX, -9999.0];
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            match i.wrapping_mul(2_654_435_761) >> 20 {
                k @ 0..5 => special[k as usize],
                k => ((x * x + 3 * y) % 997) as f32 * 0.37 + (k & 15) as f32 / 64.0,
            }
        })
        .collect()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Every directory of a TIFF, decoded by the `tiff` crate.
fn decode(bytes: &[u8]) -> Vec<(u32, u32, Vec<f32>)> {
    let mut decoder = Decoder::new(Cursor::new(bytes)).unwrap().with_limits(Limits::unlimited());
    let mut images = Vec::new();
    loop {
        let (width, height) = decoder.dimensions().unwrap();
        let DecodingResult::F32(values) = decoder.read_image().unwrap() else { panic!("no f32") };
        images.push((width, height, values));
        if !decoder.more_images() {
            return images;
        }
        decoder.next_image().unwrap();
    }
}

/// All blocks of an open raster, put together.
fn read_all(mut reader: Box<dyn RasterReader>) -> Vec<f32> {
    let header = reader.header().clone();
    let (width, height) = (header.width as usize, header.height as usize);
    let (bw, bh) = (header.block_width as usize, header.block_height as usize);
    let mut all = vec![0.0; width * height];
    let mut block = Vec::new();
    for by in 0..height.div_ceil(bh) {
        for bx in 0..width.div_ceil(bw) {
            reader.read_block(bx as u32, by as u32, &mut block).unwrap();
            for (row, values) in block.chunks_exact(bw).enumerate() {
                let n = bw.min(width - bx * bw);
                let start = (by * bh + row) * width + bx * bw;
                all[start..start + n].copy_from_slice(&values[..n]);
            }
        }
    }
    all
}

/// The build's reader and the pure one.
fn readers(path: &Path, options: &OpenOptions) -> Vec<Box<dyn RasterReader>> {
    let pure = TiffReader::open(path, options).unwrap();
    vec![crate::raster::open(path, options).unwrap(), Box::new(pure)]
}

fn write(path: &Path, spec: &GeoTiffSpec, values: &[f32], rows: usize) {
    let mut writer = GeoTiffWriter::create(path, spec).unwrap();
    for part in values.chunks(rows * spec.width as usize) {
        writer.write_rows(part).unwrap();
    }
    writer.finish().unwrap();
}

fn lidar(width: u32, height: u32) -> GeoTiffSpec {
    GeoTiffSpec {
        width,
        height,
        geotransform: GeoTransform::north_up(1_193_000.5, 828_000.25, 1.5, 1.5),
        epsg: 2927,
        nodata: Some(-9999.0),
        unit: Some(LinearUnit::UsSurveyFoot),
        ..GeoTiffSpec::default()
    }
}

#[test]
fn every_layout_reads_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    for (width, height) in [(1, 1), (256, 256), (257, 255), (300, 530), (1, 700), (700, 1)] {
        let values = terrain(width, height);
        for layout in [Layout::Tiles(256), Layout::Tiles(16), Layout::Strips(1), Layout::Strips(37)]
        {
            for compression in [Compression::Deflate, Compression::None] {
                let spec = GeoTiffSpec { layout, compression, ..lidar(width, height) };
                write(&path, &spec, &values, 1);
                let one_by_one = std::fs::read(&path).unwrap();
                let images = decode(&one_by_one);
                assert_eq!(images.len(), 1);
                assert_eq!((images[0].0, images[0].1), (width, height));
                assert_eq!(bits(&images[0].2), bits(&values), "{spec:?}");
                // The bytes do not depend on how the rows came.
                write(&path, &spec, &values, 101);
                assert!(one_by_one == std::fs::read(&path).unwrap(), "{spec:?}");
            }
        }
    }
}

#[test]
fn our_readers_see_what_was_meant() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    let values: Vec<f32> = terrain(300, 270).iter().map(|v| v.min(1e6)).collect();
    let spec = lidar(300, 270);
    write(&path, &spec, &values, 270);
    let expected: Vec<f32> =
        values.iter().map(|v| if *v == -9999.0 { f32::NAN } else { *v }).collect();
    for reader in readers(&path, &OpenOptions::default()) {
        let header = reader.header().clone();
        assert_eq!(header.geotransform, spec.geotransform);
        assert_eq!(header.crs.as_ref().and_then(|crs| crs.epsg), Some(2927));
        assert_eq!((header.nodata, header.sample_type.as_str()), (Some(-9999.0), "Float32"));
        assert_eq!((header.block_width, header.block_height), (256, 256));
        assert_eq!(header.compression, "deflate");
        assert_eq!(header.vertical_unit.as_ref().map(|u| u.0), Some(LinearUnit::UsSurveyFoot));
        let read = read_all(reader);
        let same = |(a, b): (&f32, &f32)| a == b || (a.is_nan() && b.is_nan());
        assert!(read.iter().zip(&expected).all(same));
    }
}

#[test]
fn grids_that_are_not_north_up_come_back_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    for grid in [
        [1_193_000.5, 1.49, 0.1, 828_000.25, 0.1, -1.49],
        [0.1, 1.5, 0.0, 0.2, 0.0, 1.5],
        [0.1, -1.5, 0.0, 0.2, 0.0, -1.5],
    ] {
        let spec = GeoTiffSpec { geotransform: GeoTransform(grid), ..lidar(20, 10) };
        write(&path, &spec, &terrain(20, 10), 3);
        for reader in readers(&path, &OpenOptions::default()) {
            assert_eq!(reader.header().geotransform.0, grid);
        }
    }
}

#[test]
fn big_tiff_holds_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    let values = terrain(600, 300);
    let metadata = vec![("A".to_owned(), "1 < 2".to_owned())];
    for layout in [Layout::Tiles(128), Layout::Strips(10)] {
        let spec = GeoTiffSpec { layout, metadata: metadata.clone(), ..lidar(600, 300) };
        let mut writer = GeoTiffWriter::create_as(&path, &spec, Format::Big).unwrap();
        writer.write_rows(&values).unwrap();
        writer.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(bytes[..8], [73, 73, 43, 0, 8, 0, 0, 0]);
        assert_eq!(bits(&decode(&bytes)[0].2), bits(&values));
        for reader in readers(&path, &OpenOptions::default()) {
            assert_eq!(reader.header().geotransform, spec.geotransform);
            assert_eq!(reader.header().crs.as_ref().and_then(|crs| crs.epsg), Some(2927));
        }
    }
}

#[test]
fn big_tiff_begins_before_classic_tiff_ends() {
    let folder = tempfile::tempdir().unwrap();
    for (side, version) in [(20_000, 42), (30_000, 43)] {
        let path = folder.path().join("t.tif");
        let spec = GeoTiffSpec { width: side, height: side, ..GeoTiffSpec::default() };
        let writer = GeoTiffWriter::create(&path, &spec).unwrap();
        let expected = if version == 42 { Format::Classic } else { Format::Big };
        assert_eq!(writer.format, expected);
    }
}

#[test]
fn wrong_rows_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    let spec = lidar(8, 4);
    let create = || GeoTiffWriter::create(&path, &spec).unwrap();

    let mut writer = create();
    writer.write_rows(&[0.0; 24]).unwrap();
    let error = writer.finish().unwrap_err();
    assert!(matches!(error, GeoTiffError::Rows { written: 3, height: 4, .. }), "{error}");

    let mut writer = create();
    writer.write_rows(&[0.0; 32]).unwrap();
    let error = writer.write_rows(&[0.0; 8]).unwrap_err();
    assert!(matches!(error, GeoTiffError::Rows { written: 5, height: 4, .. }), "{error}");
    assert!(matches!(writer.finish(), Err(GeoTiffError::Unfinished { .. })));

    let mut writer = create();
    let error = writer.write_rows(&[0.0; 9]).unwrap_err();
    assert!(matches!(error, GeoTiffError::PartialRow { samples: 9, width: 8, .. }), "{error}");
    drop(writer);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

    let missing = folder.path().join("no/t.tif");
    let error = GeoTiffWriter::create(&missing, &spec).unwrap_err();
    assert!(error.to_string().contains("t.tif"), "{error}");
}

#[test]
fn what_is_no_raster_is_refused_by_name() {
    let path = Path::new("x.tif");
    let good = lidar(8, 4);
    let flat = GeoTransform([0.0, 1.0, 1.0, 0.0, 1.0, 1.0]);
    let nan = GeoTransform([f64::NAN, 1.0, 0.0, 0.0, 0.0, -1.0]);
    for (spec, words) in [
        (GeoTiffSpec { width: 0, ..good.clone() }, "width"),
        (GeoTiffSpec { height: 0, ..good.clone() }, "height"),
        (GeoTiffSpec { geotransform: flat, ..good.clone() }, "geotransform"),
        (GeoTiffSpec { geotransform: nan, ..good.clone() }, "geotransform"),
        (GeoTiffSpec { epsg: 102_748, ..good.clone() }, "EPSG:102748"),
        (GeoTiffSpec { vertical_epsg: Some(32_767), ..good.clone() }, "vertical"),
        (GeoTiffSpec { layout: Layout::Tiles(100), ..good.clone() }, "tile size"),
        (GeoTiffSpec { layout: Layout::Strips(0), ..good.clone() }, "strip"),
        (GeoTiffSpec { layout: Layout::Tiles(32_768), ..good.clone() }, "1 GiB"),
    ] {
        let error = GeoTiffWriter::create(path, &spec).unwrap_err().to_string();
        assert!(error.contains("x.tif") && error.contains(words), "{error}");
    }
}

fn cog(width: u32, height: u32) -> CogSpec {
    CogSpec {
        width,
        height,
        geotransform: GeoTransform::north_up(-13_615_000.0, 6_041_000.0, 0.149, 0.149),
        epsg: 3857,
        unit: Some(LinearUnit::Metre),
        ..CogSpec::default()
    }
}

#[test]
fn a_cog_holds_the_heights_and_their_averages() {
    let heights: Vec<f32> = terrain(640, 640).iter().map(|v| v.min(500.0)).collect();
    let images = decode(&encode_cog(&heights, &cog(640, 640)));
    let sizes: Vec<_> = images.iter().map(|(w, h, _)| (*w, *h)).collect();
    assert_eq!(sizes, [(640, 640), (320, 320), (160, 160)]);
    assert_eq!(bits(&images[0].2), bits(&heights));
    for pair in images.windows(2) {
        let (fine, coarse) = (&pair[0], &pair[1]);
        for (i, value) in coarse.2.iter().enumerate() {
            let (x, y) = (i % coarse.0 as usize * 2, i / coarse.0 as usize * 2);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)]
                .map(|(dx, dy)| f64::from(fine.2[(y + dy) * fine.0 as usize + x + dx]));
            let valid: Vec<f64> = four.into_iter().filter(|v| !v.is_nan()).collect();
            if valid.is_empty() {
                assert!(value.is_nan());
            } else {
                let mean = valid.iter().sum::<f64>() / valid.len() as f64;
                assert!((f64::from(*value) - mean).abs() < 1e-3, "{value} {mean}");
            }
        }
    }
}

#[test]
fn cogs_of_every_size_and_content() {
    for (width, height) in [(1, 1), (256, 256), (257, 1), (513, 300)] {
        for heights in [terrain(width, height), vec![f32::NAN; (width * height) as usize]] {
            let bytes = encode_cog(&heights, &cog(width, height));
            let images = decode(&bytes);
            assert_eq!(bits(&images[0].2), bits(&heights));
            let last = images.last().unwrap();
            assert!(last.0.max(last.1) <= 256 && images.len() <= 3);
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("c.tif");
            std::fs::write(&path, &bytes).unwrap();
            let options = OpenOptions { nodata: NodataRule::None, ..OpenOptions::default() };
            for reader in readers(&path, &options) {
                let header = reader.header();
                assert!(header.nodata.is_some_and(f64::is_nan));
                assert_eq!(header.overviews as usize, images.len() - 1);
                assert_eq!(header.vertical_unit.as_ref().map(|u| u.0), Some(LinearUnit::Metre));
                let same = |(a, b): (&f32, &f32)| a == b || (a.is_nan() && b.is_nan());
                assert!(read_all(reader).iter().zip(&heights).all(same));
            }
        }
    }
}

#[test]
fn a_cog_is_the_same_for_any_number_of_threads_and_each_tile_has_its_size() {
    let heights = terrain(700, 640);
    let spec = CogSpec {
        metadata: vec![
            ("TIFFTAG_SOFTWARE".to_owned(), "sat3d 1".to_owned()),
            ("B".to_owned(), "x & \"y\" <z>".to_owned()),
        ],
        ..cog(700, 640)
    };
    let with_threads = |n| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| encode_cog(&heights, &spec))
    };
    let bytes = with_threads(1);
    assert!(bytes == with_threads(3));

    let mut decoder = Decoder::new(Cursor::new(&bytes)).unwrap();
    assert_eq!(decoder.get_tag_ascii_string(Tag::Software).unwrap(), "sat3d 1");
    let xml = decoder.get_tag_ascii_string(Tag::Unknown(42_112)).unwrap();
    let value = "x &amp;amp; &amp;quot;y&amp;quot; &amp;lt;z&amp;gt;";
    assert!(xml.contains(&format!("<Item name=\"B\">{value}</Item>")), "{xml}");
    let mut smallest_so_far = u64::MAX;
    loop {
        let offsets = decoder.get_tag_u64_vec(Tag::TileOffsets).unwrap();
        let counts = decoder.get_tag_u32_vec(Tag::TileByteCounts).unwrap();
        for (offset, count) in offsets.iter().zip(&counts) {
            let (start, end) = (*offset as usize, *offset as usize + *count as usize);
            assert_eq!(bytes[start - 4..start], count.to_le_bytes());
            assert_eq!(bytes[end..end + 4], bytes[end - 4..end]);
        }
        // Coarse levels come first in the file.
        assert!(offsets.windows(2).all(|pair| pair[0] < pair[1]) && offsets[0] < smallest_so_far);
        smallest_so_far = offsets[0];
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().unwrap();
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn any_bits_come_back(
        width in 1_u32..40,
        height in 1_u32..40,
        seed in any::<u32>(),
        layout in prop_oneof![Just(Layout::Tiles(16)), (1_u32..50).prop_map(Layout::Strips)],
        compressed in any::<bool>(),
        rows in 1_usize..50,
        big in any::<bool>(),
    ) {
        let values: Vec<f32> = (0..width * height)
            .map(|i| f32::from_bits((i ^ seed).wrapping_mul(0x9E37_79B9).rotate_left(seed & 31)))
            .collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.tif");
        let compression = if compressed { Compression::Deflate } else { Compression::None };
        let spec = GeoTiffSpec { width, height, layout, compression, ..GeoTiffSpec::default() };
        let format = if big { Format::Big } else { Format::Classic };
        let mut writer = GeoTiffWriter::create_as(&path, &spec, format).unwrap();
        for part in values.chunks(rows * width as usize) {
            writer.write_rows(part).unwrap();
        }
        writer.finish().unwrap();
        let images = decode(&std::fs::read(&path).unwrap());
        prop_assert_eq!(bits(&images[0].2), bits(&values));
    }
}
