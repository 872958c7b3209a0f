//! The streamed Cloud Optimized GeoTIFF against the one in memory.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::cog::encode_cog_as;
use super::pyramid::raw_bytes;
use super::tags::Format;
use super::{CogSpec, CogWriter, GeoTiffError, encode_cog};
use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use proptest::prelude::*;
use std::path::Path;

/// Ground with holes of every kind: single pixels, a strip over tiles' borders.
fn heights(width: u32, height: u32) -> Vec<f32> {
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            let hole = (x * 31 + y * 17) % 13 == 0 || (250..259).contains(&y) && x % 400 > 90;
            if hole { f32::NAN } else { ((x * x + 3 * y) % 997) as f32 * 0.37 }
        })
        .collect()
}

fn spec(width: u32, height: u32) -> CogSpec {
    CogSpec {
        width,
        height,
        geotransform: GeoTransform::north_up(-13_615_000.0, 6_041_000.0, 0.149, 0.149),
        epsg: 3857,
        unit: Some(LinearUnit::Metre),
        metadata: vec![("TIFFTAG_SOFTWARE".into(), "sat3d 1".into()), ("A".into(), "b < c".into())],
        ..CogSpec::default()
    }
}

fn write(writer: Result<CogWriter, GeoTiffError>, values: &[f32], samples: usize) {
    let mut writer = writer.unwrap();
    for part in values.chunks(samples) {
        writer.write_rows(part).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn streaming_gives_the_bytes_of_the_encoder_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.tif");
    for (width, height) in [
        (1, 1),
        (1, 1100),
        (1100, 1),
        (255, 257),
        (256, 256),
        (257, 256),
        (512, 513),
        (513, 300),
        (640, 640),
        (1023, 1025),
        (2049, 700),
        (300, 4300),
        (4300, 300),
    ] {
        let values = heights(width, height);
        let spec = spec(width, height);
        let expected = encode_cog(&values, &spec);
        for rows in [1, 7, 256, 300, height as usize] {
            write(CogWriter::create(&path, &spec), &values, rows * width as usize);
            assert!(std::fs::read(&path).unwrap() == expected, "{width} x {height} by {rows}");
        }
        let big = encode_cog_as(&values, &spec, Format::Big);
        assert!(big[2] == 43 && big != expected);
        write(CogWriter::create_as(&path, &spec, Format::Big), &values, 100 * width as usize);
        assert!(std::fs::read(&path).unwrap() == big, "{width} x {height} as BigTIFF");
    }
    // The target alone: what waited is gone.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn big_tiff_begins_before_classic_tiff_ends() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.tif");
    // A third more than the full resolution, which alone takes 3.2 and 2.5 GB.
    for (side, format) in [(28_160, Format::Big), (25_088, Format::Classic)] {
        let _writer = CogWriter::create(&path, &spec(side, side)).unwrap();
        assert_eq!(Format::of_raw(raw_bytes(side, side)), format, "{side}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn wrong_rows_and_wrong_rasters_leave_what_was_there() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.tif");
    std::fs::write(&path, "old").unwrap();
    let create = || CogWriter::create(&path, &spec(8, 4)).unwrap();

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

    for bad in [spec(0, 4), CogSpec { geotransform: GeoTransform([0.0; 6]), ..spec(8, 4) }] {
        let error = CogWriter::create(&path, &bad).unwrap_err();
        assert!(matches!(error, GeoTiffError::Spec { .. }), "{error}");
    }
    assert!(CogWriter::create(Path::new("/no/such/folder/c.tif"), &spec(8, 4)).is_err());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    assert_eq!(std::fs::read(&path).unwrap(), b"old");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_size_by_any_rows(width in 1_u32..900, height in 1_u32..900, rows in 1_usize..600) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.tif");
        let (values, spec) = (heights(width, height), spec(width, height));
        write(CogWriter::create(&path, &spec), &values, rows * width as usize);
        prop_assert!(std::fs::read(&path).unwrap() == encode_cog(&values, &spec));
    }
}
