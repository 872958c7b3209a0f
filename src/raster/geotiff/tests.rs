use super::tags::Flavour;
use super::writer::flavour_for;
use super::*;
use proptest::prelude::*;
use std::io::Cursor;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

fn heights(width: u32, height: u32) -> Vec<f32> {
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            if (x / 20 + y / 30) % 5 == 4 { f32::NAN } else { 40.0 + (x * y % 97) as f32 * 0.37 }
        })
        .collect()
}

fn decoder(bytes: &[u8]) -> Decoder<Cursor<&[u8]>> {
    Decoder::new(Cursor::new(bytes)).expect("a TIFF").with_limits(Limits::unlimited())
}

fn assert_same_bits(found: DecodingResult, wanted: &[f32]) {
    let DecodingResult::F32(found) = found else { panic!("not f32") };
    assert_eq!(found.len(), wanted.len());
    for (i, (a, b)) in found.iter().zip(wanted).enumerate() {
        assert_eq!(a.to_bits(), b.to_bits(), "sample {i}: {a} for {b}");
    }
}

/// Writes through the row writer and gives the file's bytes.
fn write<T: Sample>(samples: &[T], rows_at_a_time: usize, spec: &GeoTiffSpec) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.tif");
    let mut writer = GeoTiffWriter::create(&path, spec).expect("creates");
    for rows in samples.chunks(rows_at_a_time * spec.width as usize * usize::from(spec.bands)) {
        writer.write_rows(rows).expect("writes");
    }
    writer.finish().expect("finishes");
    std::fs::read(&path).expect("reads")
}

fn spec(width: u32, height: u32) -> GeoTiffSpec {
    GeoTiffSpec { width, height, epsg: 2927, nodata: Some(f64::NAN), ..GeoTiffSpec::default() }
}

const WAYS: [(Layout, TiffCompression); 4] = [
    (Layout::Tiles(64), TiffCompression::Deflate),
    (Layout::Tiles(16), TiffCompression::None),
    (Layout::Strips(7), TiffCompression::Deflate),
    (Layout::Strips(1000), TiffCompression::None),
];

#[test]
fn rows_come_back_bit_for_bit_however_they_are_cut() {
    for (width, height) in [(150, 101), (1, 1), (64, 64), (65, 1), (1, 200)] {
        let samples = heights(width, height);
        for (layout, compression) in WAYS {
            let spec = GeoTiffSpec { layout, compression, ..spec(width, height) };
            let bytes = write(&samples, 1, &spec);
            assert_same_bits(decoder(&bytes).read_image().expect("decodes"), &samples);
            for rows in [3, 64, 500] {
                assert!(bytes == write(&samples, rows, &spec), "{rows} rows at a time differ");
            }
        }
    }
}

#[test]
fn integers_and_colours_come_back() {
    let spec = |bands| GeoTiffSpec { bands, nodata: None, ..spec(50, 40) };
    let words: Vec<u16> = (0..2000_u32).map(|i| (i * 977 % 65_536) as u16).collect();
    let colours: Vec<u8> = (0..6000_u32).map(|i| (i * 31 % 256) as u8).collect();
    for (layout, compression) in WAYS {
        let with = |bands| GeoTiffSpec { layout, compression, ..spec(bands) };
        let bytes = write(&words, 9, &with(1));
        let DecodingResult::U16(found) = decoder(&bytes).read_image().expect("decodes") else {
            panic!("not u16")
        };
        assert_eq!(found, words);
        let bytes = write(&colours, 9, &with(3));
        let mut decoder = decoder(&bytes);
        assert_eq!(decoder.colortype().expect("a type"), tiff::ColorType::RGB(8));
        let DecodingResult::U8(found) = decoder.read_image().expect("decodes") else {
            panic!("not u8")
        };
        assert_eq!(found, colours);
    }
}

#[test]
fn nan_becomes_the_no_data_value_and_is_declared() {
    let samples = [1.0, f32::NAN, 3.0, -9999.0];
    let bytes = write(&samples, 1, &GeoTiffSpec { nodata: Some(-9999.0), ..spec(2, 2) });
    let mut decoder = decoder(&bytes);
    let tag = Tag::Unknown(tags::GDAL_NODATA);
    assert_eq!(decoder.get_tag_ascii_string(tag).expect("nodata"), "-9999");
    assert_same_bits(decoder.read_image().expect("decodes"), &[1.0, -9999.0, 3.0, -9999.0]);
}

#[test]
fn large_rasters_are_big_tiff() {
    // Such a file cannot be written in a test: the decision is tested, and the flavour on its own.
    let spec = |side| GeoTiffSpec { width: side, height: side, ..GeoTiffSpec::default() };
    let blocks = |side: u32| u64::from(side.div_ceil(256)).pow(2);
    let flavour = |side| flavour_for(&spec(side), SampleType::F32, blocks(side));
    assert_eq!(flavour(32_000), Flavour::Classic);
    assert_eq!(flavour(32_768), Flavour::Big);
    assert_eq!(flavour(u32::MAX), Flavour::Big);

    let samples = heights(70, 50);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.tif");
    let small = GeoTiffSpec { width: 70, height: 50, nodata: Some(f64::NAN), ..spec(1) };
    let mut writer = GeoTiffWriter::create(&path, &small).expect("creates");
    writer.make_big().expect("starts again");
    writer.write_rows(&samples).expect("writes");
    writer.finish().expect("finishes");
    let bytes = std::fs::read(&path).expect("reads");
    assert_eq!(bytes[..4], *b"II\x2b\0");
    assert_same_bits(decoder(&bytes).read_image().expect("decodes"), &samples);
}

#[test]
fn impossible_specifications_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.tif");
    let good = spec(4, 4);
    let nan_grid = GeoTransform::north_up(f64::NAN, 0.0, 1.0, 1.0);
    for (bad, word) in [
        (GeoTiffSpec { width: 0, ..good.clone() }, "no raster"),
        (GeoTiffSpec { layout: Layout::Tiles(100), ..good.clone() }, "multiple of 16"),
        (GeoTiffSpec { layout: Layout::Strips(0), ..good.clone() }, "no rows"),
        (GeoTiffSpec { epsg: 70_000, ..good.clone() }, "EPSG:70000"),
        (GeoTiffSpec { vertical_epsg: Some(0), ..good.clone() }, "EPSG:0"),
        (GeoTiffSpec { geotransform: nan_grid, ..good.clone() }, "not finite"),
        (GeoTiffSpec { nodata: Some(0.1), ..good.clone() }, "no 32-bit float"),
    ] {
        let error = GeoTiffWriter::<f32>::create(&path, &bad).expect_err("must be refused");
        assert!(error.to_string().contains(word), "{error}");
    }
    let missing = folder.path().join("none/x.tif");
    let error = GeoTiffWriter::<f32>::create(&missing, &good).expect_err("no folder");
    assert!(matches!(error, GeoTiffError::Io { .. }));
}

#[test]
fn wrong_rows_are_refused_and_leave_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.tif");
    let mut writer = GeoTiffWriter::create(&path, &spec(4, 2)).expect("creates");
    assert!(matches!(writer.write_rows(&[1.0; 3]), Err(GeoTiffError::Rows { .. })));
    assert!(matches!(writer.write_rows(&[1.0; 12]), Err(GeoTiffError::Rows { .. })));
    writer.write_rows(&[1.0; 4]).expect("writes");
    let error = writer.finish().expect_err("a row is missing").to_string();
    assert!(error.contains("1 of 2 rows"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 0);
}

fn cog(width: u32, height: u32, tile_size: u32) -> (Vec<f32>, Vec<u8>) {
    let samples = heights(width, height);
    let spec = CogSpec { width, height, tile_size, ..CogSpec::default() };
    let bytes = encode_cog(&samples, &spec);
    assert!(bytes == encode_cog(&samples, &spec));
    (samples, bytes)
}

#[test]
fn a_cog_holds_the_grid_and_its_exact_means() {
    for (width, height) in [(200, 130), (128, 128), (33, 257), (1, 1), (16, 16)] {
        let (samples, bytes) = cog(width, height, 32);
        let mut decoder = decoder(&bytes);
        assert_same_bits(decoder.read_image().expect("decodes"), &samples);
        let (mut level, mut size) = (1_u32, (width, height));
        while size.0.max(size.1) > 32 {
            level *= 2;
            size = (size.0.div_ceil(2), size.1.div_ceil(2));
            assert!(decoder.more_images());
            decoder.next_image().expect("an overview");
            assert_eq!(decoder.dimensions().expect("a size"), size);
            // The slow definition: the mean over the square of full-resolution pixels.
            let mut wanted = Vec::new();
            for y in 0..size.1 {
                for x in 0..size.0 {
                    let (mut sum, mut count) = (0.0_f64, 0);
                    for row in level * y..(level * (y + 1)).min(height) {
                        for column in level * x..(level * (x + 1)).min(width) {
                            let h = samples[(row * width + column) as usize];
                            if !h.is_nan() {
                                sum += f64::from(h);
                                count += 1;
                            }
                        }
                    }
                    wanted.push((count > 0).then(|| sum / f64::from(count)));
                }
            }
            let DecodingResult::F32(found) = decoder.read_image().expect("decodes") else {
                panic!("not f32")
            };
            for (a, b) in found.iter().zip(&wanted) {
                match b {
                    Some(b) => assert!((f64::from(*a) - b).abs() < 1e-5, "{a} for {b}"),
                    None => assert!(a.is_nan()),
                }
            }
        }
        assert!(!decoder.more_images());
    }
}

#[test]
fn a_cog_is_laid_out_as_gdal_says() {
    let (_, bytes) = cog(200, 130, 32);
    let ghost = b"GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\nLAYOUT=IFDS_BEFORE_DATA\n";
    assert!(bytes[8..].starts_with(ghost), "{}", String::from_utf8_lossy(&bytes[8..90]));
    let mut decoder = decoder(&bytes);
    let mut last_level = usize::MAX;
    loop {
        let read = |d: &mut Decoder<_>, tag| d.get_tag_u64_vec(tag).expect("a tag");
        let offsets = read(&mut decoder, Tag::TileOffsets);
        let sizes = read(&mut decoder, Tag::TileByteCounts);
        for (&offset, &size) in offsets.iter().zip(&sizes) {
            let (from, to) = (offset as usize, (offset + size) as usize);
            assert_eq!(bytes[from - 4..from], (size as u32).to_le_bytes());
            assert_eq!(bytes[to..to + 4], bytes[to - 4..to]);
        }
        assert!(offsets.is_sorted());
        // Smaller levels lie before larger ones.
        let (first, end) = (offsets[0] as usize, *offsets.last().expect("tiles") as usize);
        assert!(end < last_level);
        last_level = first;
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().expect("the next");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn any_floats_of_any_shape_come_back(
        width in 1..70_u32, height in 1..70_u32, seed in any::<u32>(), way in 0..4_usize,
    ) {
        let mut state = seed;
        let samples: Vec<f32> = (0..width * height).map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f32::from_bits(state)
        }).collect();
        let (layout, compression) = WAYS[way];
        // Without a no-data value every bit pattern of NaN is kept.
        let spec = GeoTiffSpec { layout, compression, nodata: None, ..spec(width, height) };
        assert_same_bits(decoder(&write(&samples, 5, &spec)).read_image().expect("decodes"), &samples);
    }
}
