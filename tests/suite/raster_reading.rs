//! The two readers against each other and against what was written, bit for bit.
#![cfg(feature = "gdal")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::raster_support;

use gdal::config::{clear_thread_local_config_option, set_thread_local_config_option};
use gdal::raster::{Buffer, ColorInterpretation, GdalType, RasterCreationOptions};
use gdal::spatial_ref::SpatialRef;
use gdal::{Dataset, DriverManager, Metadata};
use raster_support::{bits, height, read_all};
use sat3d::raster::{
    GdalReader, NodataRule, OpenOptions, RasterHeader, RasterReader, TiffReader, UndeclaredNodata,
};
use sat3d::units::LinearUnit;
use std::path::{Path, PathBuf};

const WIDTH: usize = 150;
const HEIGHT: usize = 110;

/// Opens a file in both ways, compares everything, and returns header and samples.
fn both_with(path: &Path, options: &OpenOptions) -> (RasterHeader, Vec<f32>, UndeclaredNodata) {
    let mut gdal = GdalReader::open(path, options).unwrap();
    let mut tiff = TiffReader::open(path, options).unwrap();
    let (mut a, mut b) = (gdal.header().clone(), tiff.header().clone());
    match (a.crs.take(), b.crs.take()) {
        (None, None) => {}
        (Some(a), Some(b)) => {
            assert_eq!(a.epsg, b.epsg, "{path:?}");
            assert_eq!(a.geographic, b.geographic, "{path:?}");
            assert_eq!(a.linear_unit, b.linear_unit, "{path:?}");
            let unit = |crs: &sat3d::crs::CrsSpec| crs.vertical.as_ref().and_then(|v| v.unit);
            assert_eq!(unit(&a), unit(&b), "{path:?}");
        }
        (a, b) => panic!("{}: {a:?} {b:?}", path.display()),
    }
    assert_eq!(a.vertical_unit.as_ref().map(|u| u.0), b.vertical_unit.as_ref().map(|u| u.0));
    let same_nodata = a.nodata.map(f64::to_bits) == b.nodata.map(f64::to_bits);
    assert!(same_nodata, "{:?} {:?}", a.nodata, b.nodata);
    let header = a.clone();
    // Names and codes in the evidence come from what each has of the CRS; NaN is not itself.
    (a.vertical_unit, b.vertical_unit) = (None, None);
    (a.nodata, b.nodata) = (None, None);
    assert_eq!(a, b);
    let (x, y) = (read_all(&mut gdal).unwrap(), read_all(&mut tiff).unwrap());
    assert!(bits(&x) == bits(&y), "{}: the samples differ", path.display());
    assert_eq!(gdal.undeclared_nodata(), tiff.undeclared_nodata());
    let mut header = header;
    header.crs = gdal.header().crs.clone();
    (header, x, tiff.undeclared_nodata())
}

fn both(path: &Path) -> (RasterHeader, Vec<f32>) {
    let (header, samples, _) = both_with(path, &OpenOptions::default());
    (header, samples)
}

/// What the tests write: any type, any number of bands, any option.
struct Writer<T> {
    data: Vec<T>,
    bands: usize,
    options: Vec<String>,
    crs: bool,
    prepare: Box<dyn Fn(&mut Dataset)>,
}

impl<T: GdalType + Copy> Writer<T> {
    fn new(value: impl Fn(usize, usize) -> T) -> Self {
        let data = (0..WIDTH * HEIGHT).map(|i| value(i % WIDTH, i / WIDTH)).collect();
        Self { data, bands: 1, options: Vec::new(), crs: true, prepare: Box::new(|_| ()) }
    }

    fn options(mut self, options: &[&str]) -> Self {
        self.options.extend(options.iter().map(|o| (*o).to_owned()));
        self
    }

    /// Writes no CRS, which takes longer than everything else.
    fn without_crs(mut self) -> Self {
        self.crs = false;
        self
    }

    fn bands(mut self, bands: usize) -> Self {
        self.bands = bands;
        self
    }

    fn prepare(mut self, prepare: impl Fn(&mut Dataset) + 'static) -> Self {
        self.prepare = Box::new(prepare);
        self
    }

    fn write(&self, path: &Path) {
        let memory = DriverManager::get_driver_by_name("MEM").unwrap();
        let mut dataset =
            memory.create_with_band_type::<T, _>("", WIDTH, HEIGHT, self.bands).unwrap();
        dataset.set_geo_transform(&[1_180_000.0, 1.5, 0.0, 840_000.0, 0.0, -1.5]).unwrap();
        if self.crs {
            dataset.set_spatial_ref(&SpatialRef::from_epsg(2927).unwrap()).unwrap();
        }
        for band in 1..=self.bands {
            // Other bands hold the rows in reverse, so that mixing bands up shows.
            let mut data = self.data.clone();
            if band > 1 {
                data.reverse();
            }
            let mut buffer = Buffer::new((WIDTH, HEIGHT), data);
            let mut band = dataset.rasterband(band).unwrap();
            band.write((0, 0), (WIDTH, HEIGHT), &mut buffer).unwrap();
        }
        (self.prepare)(&mut dataset);
        let options: RasterCreationOptions = self.options.iter().map(String::as_str).collect();
        let tiff = DriverManager::get_driver_by_name("GTiff").unwrap();
        let copy = dataset.create_copy(&tiff, path, &options).unwrap();
        copy.close().unwrap();
    }
}

/// One type with its values, in every way in which a TIFF file stores them.
fn matrix<T: GdalType + Copy + 'static>(
    name: &str,
    predictors: &[&str],
    extra: &[&str],
    value: impl Fn(usize, usize) -> T + Copy,
    expected: impl Fn(T) -> f32,
) {
    let folder = tempfile::tempdir().unwrap();
    let mut number = 0;
    for compression in ["NONE", "DEFLATE", "LZW", "PACKBITS", "ZSTD"] {
        for predictor in predictors {
            if matches!(compression, "NONE" | "PACKBITS") && *predictor != "1" {
                continue;
            }
            for layout in [
                &["BLOCKYSIZE=7"] as &[&str],
                &["TILED=YES", "BLOCKXSIZE=64", "BLOCKYSIZE=48"],
                &["TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256"],
            ] {
                // Tiles larger than the raster need no more than one compression.
                if layout.contains(&"BLOCKXSIZE=256") && compression != "DEFLATE" {
                    continue;
                }
                for (endianness, big, bands, interleave) in [
                    ("LITTLE", "NO", 1, "PIXEL"),
                    ("BIG", "YES", 1, "PIXEL"),
                    ("BIG", "NO", 3, "PIXEL"),
                    ("LITTLE", "YES", 3, "BAND"),
                ] {
                    let path = folder.path().join(format!("{number}.tif"));
                    number += 1;
                    let options = [
                        format!("COMPRESS={compression}"),
                        format!("PREDICTOR={predictor}"),
                        format!("ENDIANNESS={endianness}"),
                        format!("BIGTIFF={big}"),
                        format!("INTERLEAVE={interleave}"),
                        "PHOTOMETRIC=MINISBLACK".to_owned(),
                    ];
                    let options: Vec<&str> = options
                        .iter()
                        .map(String::as_str)
                        .filter(|o| {
                            !(o.starts_with("PREDICTOR")
                                && matches!(compression, "NONE" | "PACKBITS"))
                        })
                        .chain(layout.iter().copied())
                        .chain(extra.iter().copied())
                        .collect();
                    let writer = Writer::new(value).without_crs().bands(bands).options(&options);
                    writer.write(&path);
                    let (header, samples) = both(&path);
                    let context = format!("{name} {options:?}");
                    assert_eq!(header.sample_type, name, "{context}");
                    assert_eq!(header.bands, bands as u32, "{context}");
                    assert_eq!(header.compression, compression.to_lowercase(), "{context}");
                    let written: Vec<f32> = writer.data.iter().map(|v| expected(*v)).collect();
                    // libtiff 4.5 swaps the bytes of floats before this predictor when it writes the
                    // other byte order, against Adobe's note: what it reads back is not what was
                    // written, and both readers here agree with it.
                    let garbled = endianness == "BIG" && *predictor == "3";
                    assert!(garbled || bits(&samples) == bits(&written), "{context}");
                    std::fs::remove_file(&path).unwrap();
                }
            }
        }
    }
}

#[test]
fn floats_of_32_bits_are_read_from_every_layout() {
    matrix("Float32", &["1", "2", "3"], &[], |x, y| height(x, y) as f32, |v| v);
}

#[test]
fn floats_of_64_bits_are_read_from_every_layout() {
    matrix("Float64", &["1", "3"], &[], height, |v| v as f32);
}

#[test]
fn integers_of_8_bits_are_read_from_every_layout() {
    matrix("Byte", &["1", "2"], &[], |x, y| height(x, y) as u8, f32::from);
    let value = |x: usize, y: usize| (height(x, y) - 110.0) as i8;
    matrix(
        "Int8",
        &["1", "2"],
        &["PIXELTYPE=SIGNEDBYTE"],
        move |x, y| value(x, y).cast_unsigned(),
        |v| f32::from(v.cast_signed()),
    );
}

#[test]
fn integers_of_16_and_32_bits_are_read_from_every_layout() {
    matrix("UInt16", &["1", "2"], &[], |x, y| (height(x, y) * 500.0) as u16, f32::from);
    matrix("Int16", &["1", "2"], &[], |x, y| (height(x, y) * 250.0 - 25e3) as i16, f32::from);
    matrix("UInt32", &["1", "2"], &[], |x, y| (height(x, y) * 3e7) as u32, |v| v as f32);
    matrix("Int32", &["1", "2"], &[], |x, y| (height(x, y) * 1e7 - 1e9) as i32, |v| v as f32);
}

#[test]
fn sparse_blocks_hold_nodata_or_zero() {
    let folder = tempfile::tempdir().unwrap();
    for (nodata, layout) in [
        (None, "TILED=NO"),
        (Some(-9999.0), "TILED=NO"),
        (Some(-9999.0), "TILED=YES"),
        (None, "TILED=YES"),
    ] {
        let path = folder.path().join("sparse.tif");
        let driver = DriverManager::get_driver_by_name("GTiff").unwrap();
        let options = ["SPARSE_OK=TRUE", "COMPRESS=DEFLATE", layout, "BLOCKYSIZE=16"];
        let options: RasterCreationOptions = options.into_iter().collect();
        let options = if layout == "TILED=YES" {
            let mut options = options;
            options.add_name_value("BLOCKXSIZE", "16").unwrap();
            options
        } else {
            options
        };
        let dataset = driver
            .create_with_band_type_with_options::<f32, _>(&path, WIDTH, HEIGHT, 1, &options)
            .unwrap();
        let mut band = dataset.rasterband(1).unwrap();
        if nodata.is_some() {
            band.set_no_data_value(nodata).unwrap();
        }
        band.write((40, 40), (8, 8), &mut Buffer::new((8, 8), vec![5.0_f32; 64])).unwrap();
        dataset.close().unwrap();

        let (_, samples) = both(&path);
        let of = |v: f32| samples.iter().filter(|s| **s == v).count();
        let empty = samples.iter().filter(|s| s.is_nan()).count();
        assert_eq!(of(5.0), 64);
        if nodata.is_some() {
            assert_eq!((empty, of(0.0)), (WIDTH * HEIGHT - 64, 0), "{layout}");
        } else {
            assert_eq!((empty, of(0.0)), (0, WIDTH * HEIGHT - 64), "{layout}");
        }
    }
}

#[test]
fn nodata_never_bleeds_and_is_compared_in_the_bands_type() {
    let folder = tempfile::tempdir().unwrap();
    let lowest = f64::from(f32::MIN);
    for (nodata, stored) in [
        (Some(lowest), f32::MIN),
        (Some(-3.402_823_466_385_29e38), f32::MIN),
        (Some(0.1), 0.1_f32),
        (Some(f64::NAN), f32::NAN),
        (Some(-32767.0), -32767.0),
        (None, f32::NAN),
        (None, f32::INFINITY),
    ] {
        let path = folder.path().join("nodata.tif");
        let hole = |x: usize, y: usize| (30..60).contains(&x) && (20..50).contains(&y);
        let writer = Writer::new(move |x, y| if hole(x, y) { stored } else { height(x, y) as f32 })
            .options(&["COMPRESS=DEFLATE"])
            .prepare(move |d| {
                d.rasterband(1).unwrap().set_no_data_value(nodata).unwrap();
            });
        writer.write(&path);
        let (header, samples, undeclared) = both_with(&path, &OpenOptions::default());
        assert!(undeclared.is_empty());
        assert_eq!(header.nodata.is_some(), nodata.is_some());
        for (i, v) in samples.iter().enumerate() {
            assert_eq!(v.is_nan(), hole(i % WIDTH, i / WIDTH), "{nodata:?} {stored} {i}");
        }
    }
}

#[test]
fn undeclared_nodata_is_caught_and_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("undeclared.tif");
    let writer = Writer::new(|x, y| match (x, y) {
        (3, _) => -9999.0,
        (_, 7) => f32::MIN,
        _ => height(x, y) as f32,
    });
    writer.write(&path);
    let (header, samples, undeclared) = both_with(&path, &OpenOptions::default());
    assert_eq!(header.nodata, None);
    assert_eq!(undeclared.values().len(), 2, "{undeclared:?}");
    assert_eq!(samples.iter().filter(|v| v.is_nan()).count(), WIDTH + HEIGHT - 1);

    let all_valid = OpenOptions { nodata: NodataRule::None, ..OpenOptions::default() };
    let (_, samples, undeclared) = both_with(&path, &all_valid);
    assert!(undeclared.is_empty() && samples.iter().all(|v| v.is_finite()));

    let value = OpenOptions { nodata: NodataRule::Value(-9999.0), ..OpenOptions::default() };
    let (_, samples, _) = both_with(&path, &value);
    assert_eq!(samples.iter().filter(|v| v.is_nan()).count(), WIDTH + HEIGHT - 1);
}

#[test]
fn masks_and_alpha_bands_mark_what_is_valid() {
    let folder = tempfile::tempdir().unwrap();
    let hole = |x: usize, y: usize| x.is_multiple_of(7) || y == 40;
    let mask: Vec<u8> =
        (0..WIDTH * HEIGHT).map(|i| u8::from(!hole(i % WIDTH, i / WIDTH)) * 255).collect();
    let check = |path: &Path, what: &str| {
        let (header, samples) = both(path);
        assert!(header.has_mask, "{what}");
        for (i, v) in samples.iter().enumerate() {
            assert_eq!(v.is_nan(), hole(i % WIDTH, i / WIDTH), "{what} {i}");
        }
        let options = OpenOptions { nodata: NodataRule::None, ..OpenOptions::default() };
        assert!(both_with(path, &options).1.iter().all(|v| v.is_finite()), "{what}");
    };
    for (compression, layout) in
        [("DEFLATE", "TILED=YES"), ("LZW", "TILED=NO"), ("NONE", "BLOCKYSIZE=3")]
    {
        let path = folder.path().join("mask.tif");
        let compress = format!("COMPRESS={compression}");
        let writer = Writer::new(|x, y| height(x, y) as f32).options(&[&compress, layout]);
        writer.write(&path);
        set_thread_local_config_option("GDAL_TIFF_INTERNAL_MASK", "YES").unwrap();
        let flags = gdal::GdalOpenFlags::GDAL_OF_UPDATE;
        let dataset = Dataset::open_ex(
            &path,
            gdal::DatasetOptions { open_flags: flags, ..gdal::DatasetOptions::default() },
        )
        .unwrap();
        let mut band = dataset.rasterband(1).unwrap();
        band.create_mask_band(true).unwrap();
        let mut buffer = Buffer::new((WIDTH, HEIGHT), mask.clone());
        let mut mask_band = band.open_mask_band().unwrap();
        mask_band.write((0, 0), (WIDTH, HEIGHT), &mut buffer).unwrap();
        dataset.close().unwrap();
        clear_thread_local_config_option("GDAL_TIFF_INTERNAL_MASK").unwrap();
        check(&path, compression);
    }

    for interleave in ["INTERLEAVE=PIXEL", "INTERLEAVE=BAND"] {
        let path = folder.path().join("alpha.tif");
        let alpha: Vec<f32> = mask.iter().map(|v| f32::from(*v) / 255.0).collect();
        let writer = Writer::new(|x, y| height(x, y) as f32)
            .bands(2)
            .options(&[interleave, "ALPHA=YES"])
            .prepare(move |dataset| {
                let mut band = dataset.rasterband(2).unwrap();
                band.set_color_interpretation(ColorInterpretation::AlphaBand).unwrap();
                let mut buffer = Buffer::new((WIDTH, HEIGHT), alpha.clone());
                band.write((0, 0), (WIDTH, HEIGHT), &mut buffer).unwrap();
            });
        writer.write(&path);
        check(&path, interleave);
    }
}

#[test]
fn a_mask_in_a_side_file_is_read_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("side.tif");
    Writer::new(|x, y| height(x, y) as f32).write(&path);
    let dataset = Dataset::open(&path).unwrap();
    set_thread_local_config_option("GDAL_TIFF_INTERNAL_MASK", "NO").unwrap();
    let mut band = dataset.rasterband(1).unwrap();
    band.create_mask_band(true).unwrap();
    let mut buffer = Buffer::new((WIDTH, 1), vec![255_u8; WIDTH]);
    band.open_mask_band().unwrap().write((0, 5), (WIDTH, 1), &mut buffer).unwrap();
    dataset.close().unwrap();
    clear_thread_local_config_option("GDAL_TIFF_INTERNAL_MASK").unwrap();
    assert!(folder.path().join("side.tif.msk").exists());

    let mut reader = GdalReader::open(&path, &OpenOptions::default()).unwrap();
    let valid = read_all(&mut reader).unwrap().iter().filter(|v| v.is_finite()).count();
    assert_eq!(valid, WIDTH);
    let message = TiffReader::open(&path, &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("side.tif.msk"), "{message}");
}

#[test]
fn scale_offset_unit_and_metadata_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scaled.tif");
    let writer = Writer::new(|x, y| (height(x, y) * 100.0) as i16).prepare(|dataset| {
        let mut band = dataset.rasterband(1).unwrap();
        band.set_scale(0.01).unwrap();
        band.set_offset(-50.0).unwrap();
        band.set_no_data_value(Some(10_000.0)).unwrap();
        band.set_metadata_item("UNITS", "feet", "").unwrap();
    });
    writer.write(&path);
    let (header, samples) = both(&path);
    assert_eq!((header.scale, header.offset), (0.01, -50.0));
    for (v, stored) in samples.iter().zip(&writer.data) {
        if *stored == 10_000 {
            assert!(v.is_nan());
        } else {
            assert_eq!(*v, (f64::from(*stored) * 0.01 - 50.0) as f32);
        }
    }
    let (unit, evidence) = header.vertical_unit.unwrap();
    // EPSG:2927 is in US survey feet, so its bare feet are too.
    assert_eq!(unit, LinearUnit::UsSurveyFoot, "{evidence}");
}

#[test]
fn points_are_shifted_and_every_georeference_is_gdals() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("grid.tif");
    for (point, grid) in [
        ("Area", [1_180_000.1, 1.5, 0.0, 840_000.7, 0.0, -1.5]),
        ("Point", [1_180_000.1, 1.499_114_573, 0.0, 840_000.7, 0.0, -1.500_441_9]),
        ("Area", [10.0, 1.0, 0.5, 20.0, 0.25, -2.0]),
        ("Point", [10.0, 1.0, 0.5, 20.0, 0.25, -2.0]),
        ("Area", [10.0, 1.0, 0.0, 20.0, 0.0, 2.0]),
    ] {
        let writer = Writer::new(|x, y| height(x, y) as f32).prepare(move |dataset| {
            dataset.set_geo_transform(&grid).unwrap();
            dataset.set_metadata_item("AREA_OR_POINT", point, "").unwrap();
        });
        writer.write(&path);
        let (header, _) = both(&path);
        for (a, b) in header.geotransform.0.iter().zip(grid) {
            assert!((a - b).abs() <= 1e-9 * b.abs(), "{point} {grid:?} {:?}", header.geotransform);
        }
        let usable = header.check_usable();
        let problem = usable.err().map(|e| e.to_string()).unwrap_or_default();
        if grid[2] != 0.0 {
            assert!(problem.contains("rotated"), "{problem}");
        } else if grid[5] > 0.0 {
            assert!(problem.contains("south up"), "{problem}");
        } else {
            assert!(problem.is_empty(), "{problem}");
        }
    }
}

#[test]
fn overviews_are_counted_and_never_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("overviews.tif");
    let writer = Writer::new(|x, y| height(x, y) as f32).options(&["TILED=YES"]);
    writer.write(&path);
    let flags = gdal::GdalOpenFlags::GDAL_OF_UPDATE;
    let mut dataset = Dataset::open_ex(
        &path,
        gdal::DatasetOptions { open_flags: flags, ..gdal::DatasetOptions::default() },
    )
    .unwrap();
    dataset.build_overviews("NEAREST", &[2, 4], &[]).unwrap();
    dataset.close().unwrap();
    let (header, samples) = both(&path);
    assert_eq!(header.overviews, 2);
    assert!(bits(&samples) == bits(&writer.data));
}

#[test]
fn a_large_strip_is_refused_by_name_or_read_in_pieces() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("strip.tif");
    let small = OpenOptions { memory_limit: 100_000, ..OpenOptions::default() };
    let whole = format!("BLOCKYSIZE={HEIGHT}");
    Writer::new(|x, y| height(x, y) as f32).options(&[&whole, "COMPRESS=DEFLATE"]).write(&path);
    for message in [
        GdalReader::open(&path, &small).unwrap_err().to_string(),
        TiffReader::open(&path, &small).unwrap_err().to_string(),
    ] {
        assert!(message.contains("strip.tif") && message.contains("150 x 110"), "{message}");
        assert!(message.contains("TILED=YES"), "{message}");
    }
    // Without compression there is no need to read all of it at once.
    let writer = Writer::new(|x, y| height(x, y) as f32).options(&[&whole]);
    writer.write(&path);
    let limit = OpenOptions { memory_limit: 600_000, ..OpenOptions::default() };
    let (_, samples, _) = both_with(&path, &limit);
    assert!(bits(&samples) == bits(&writer.data));
}

#[test]
fn a_vrt_reads_as_the_raster_that_it_stands_for_and_fetches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tile.tif");
    let writer = Writer::new(|x, y| height(x, y) as f32).options(&["COMPRESS=DEFLATE"]);
    writer.write(&path);
    let vrt = folder.path().join("all.vrt");
    let driver = DriverManager::get_driver_by_name("VRT").unwrap();
    let copy = Dataset::open(&path).unwrap();
    copy.create_copy(&driver, &vrt, &RasterCreationOptions::default()).unwrap().close().unwrap();
    let mut reader = GdalReader::open(&vrt, &OpenOptions::default()).unwrap();
    assert!(bits(&read_all(&mut reader).unwrap()) == bits(&writer.data));
    let message = TiffReader::open(&vrt, &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("VRT"), "{message}");

    // A source on the network, here a port of this machine on which nobody may call; were it called,
    // nobody would answer.
    set_thread_local_config_option("GDAL_HTTP_TIMEOUT", "2").unwrap();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    listener.set_nonblocking(true).unwrap();
    let address = listener.local_addr().unwrap();
    let text = std::fs::read_to_string(&vrt).unwrap();
    let remote = text.replace(
        "relativeToVRT=\"1\">tile.tif",
        &format!("relativeToVRT=\"0\">/vsicurl/http://{address}/tile.tif"),
    );
    assert_ne!(text, remote);
    std::fs::write(&vrt, remote).unwrap();
    if let Ok(mut reader) = GdalReader::open(&vrt, &OpenOptions::default()) {
        assert!(reader.read_block(0, 0, &mut Vec::new()).is_err());
    }
    let called = listener.accept();
    assert!(called.is_err(), "the VRT's source was fetched");
}

/// The folder of real rasters, if this machine has it.
fn real_rasters() -> Option<PathBuf> {
    let folder = std::env::var_os("SAT3D_TEST_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from)
        .join("rasters");
    if !folder.is_dir() {
        eprintln!("skipped: no real rasters in {} (SAT3D_TEST_DATA)", folder.display());
        return None;
    }
    Some(folder)
}

#[test]
fn real_rasters_are_the_same_in_both_readers() {
    let Some(folder) = real_rasters() else { return };
    let mut units = Vec::new();
    for path in sat3d::raster::list_tiles(&[folder]).unwrap() {
        let (header, samples) = both(&path);
        let valid = samples.iter().filter(|v| v.is_finite()).count();
        assert!(valid > 0, "{}", path.display());
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        units.push((
            name,
            header.vertical_unit.as_ref().map(|u| u.0),
            header.check_usable().is_ok(),
        ));
    }
    let unit = |name: &str| units.iter().find(|u| u.0.starts_with(name)).map(|u| (u.1, u.2));
    let survey_foot = Some(LinearUnit::UsSurveyFoot);
    assert_eq!(unit("muncie"), Some((survey_foot, true)), "UNITS=feet in a ftUS CRS");
    assert_eq!(unit("codem"), Some((Some(LinearUnit::Metre), true)));
    assert_eq!(unit("alki_rgb"), Some((None, true)));
    assert_eq!(unit("srtm_ref").map(|u| u.1), Some(false), "in degrees");
}
