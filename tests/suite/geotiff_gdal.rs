//! The GeoTIFFs that sat3d writes, judged by GDAL, by GDAL's COG validator and by rio-cogeo.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::grid::GeoTransform;
use sat3d::raster::geotiff::{
    CogSpec, Compression, GeoTiffSpec, GeoTiffWriter, Layout, encode_cog,
};
use sat3d::units::LinearUnit;
use serde_json::{Value, json};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

fn skipped(why: &str) {
    // The test harness hides what `eprintln!` says; this reaches the terminal.
    let _ = writeln!(std::io::stderr(), "SKIPPED: {why}");
}

/// What `gdalinfo -json` says of a file, which must be without warnings; `None` without GDAL.
fn gdalinfo(path: &Path) -> Option<Value> {
    let Ok(output) = Command::new("gdalinfo").args(["-json", "-checksum"]).arg(path).output()
    else {
        skipped("gdalinfo is not installed");
        return None;
    };
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && errors.is_empty(), "{errors}");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

/// Samples of band 1 as GDAL reads them.
fn gdal_samples(path: &Path) -> Vec<u32> {
    let raw = path.with_extension("bin");
    let mut command = Command::new("gdal_translate");
    command.args(["-q", "-of", "ENVI"]).arg(path).arg(&raw);
    assert!(command.status().unwrap().success());
    let bytes = std::fs::read(raw).unwrap();
    bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

/// A Python interpreter that has a module.
fn python_with(import: &str) -> Option<std::ffi::OsString> {
    // GDAL's own module is the system's; the others may be in an environment.
    let found = std::env::var_os("SAT3D_PYTHON")
        .into_iter()
        .chain(["python3".into(), "/usr/bin/python3".into()])
        .find(|interpreter| {
            let probe =
                Command::new(interpreter).args(["-c", &format!("import {import}")]).output();
            probe.is_ok_and(|output| output.status.success())
        });
    if found.is_none() {
        skipped(&format!("no python with {import} (set SAT3D_PYTHON)"));
    }
    found
}

fn heights(width: u32, height: u32) -> Vec<f32> {
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            let hole = (x as i32 - 200).pow(2) + (y as i32 - 90).pow(2) < 400;
            if hole { f32::NAN } else { 40.0 + ((x * y) % 1009) as f32 / 32.0 }
        })
        .collect()
}

fn lidar() -> GeoTiffSpec {
    GeoTiffSpec {
        width: 300,
        height: 270,
        geotransform: GeoTransform::north_up(1_193_000.5, 828_000.25, 1.5, 1.5),
        epsg: 2927,
        nodata: Some(-9999.0),
        ..GeoTiffSpec::default()
    }
}

fn write(path: &Path, spec: &GeoTiffSpec, values: &[f32]) {
    let mut writer = GeoTiffWriter::create(path, spec).unwrap();
    writer.write_rows(values).unwrap();
    writer.finish().unwrap();
}

fn wkt(info: &Value) -> &str {
    info["coordinateSystem"]["wkt"].as_str().unwrap_or_default()
}

#[test]
fn gdal_reads_a_lidar_tile_as_it_was_meant() {
    let folder = tempfile::tempdir().unwrap();
    let values: Vec<f32> =
        heights(300, 270).iter().map(|v| if v.is_nan() { -9999.0 } else { *v }).collect();
    let bits: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
    for (i, (layout, compression)) in [
        (Layout::Tiles(256), Compression::Deflate),
        (Layout::Tiles(64), Compression::None),
        (Layout::Strips(7), Compression::Deflate),
        (Layout::Strips(1), Compression::None),
    ]
    .into_iter()
    .enumerate()
    {
        let path = folder.path().join(format!("{i}.tif"));
        let spec = GeoTiffSpec {
            layout,
            compression,
            unit: Some(LinearUnit::UsSurveyFoot),
            metadata: vec![("SOURCE".to_owned(), "a & b <c> \"d\" é".to_owned())],
            ..lidar()
        };
        write(&path, &spec, &values);
        let Some(info) = gdalinfo(&path) else { return };
        assert_eq!(info["size"], json!([300, 270]));
        assert_eq!(info["geoTransform"], json!(spec.geotransform.0));
        assert!(wkt(&info).contains("ID[\"EPSG\",2927]"), "{}", wkt(&info));
        assert!(wkt(&info).contains("US survey foot"), "{}", wkt(&info));
        assert_eq!(info["metadata"][""]["AREA_OR_POINT"], "Area");
        assert_eq!(info["metadata"][""]["SOURCE"], "a & b <c> \"d\" é");
        let band = &info["bands"][0];
        assert_eq!((&band["type"], &band["unit"]), (&json!("Float32"), &json!("US survey foot")));
        assert_eq!(band["noDataValue"], json!(-9999.0));
        let block = match layout {
            Layout::Tiles(size) => json!([size, size]),
            Layout::Strips(rows) => json!([300, rows]),
        };
        assert_eq!(band["block"], block);
        assert_eq!(gdal_samples(&path), bits);
    }
}

#[test]
fn gdal_sees_rotation_degrees_and_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.tif");
    let values = vec![1.0; 300 * 270];
    let rotated = GeoTransform([1_193_000.5, 1.49, 0.1, 828_000.25, 0.1, -1.49]);
    write(&path, &GeoTiffSpec { geotransform: rotated, ..lidar() }, &values);
    let Some(info) = gdalinfo(&path) else { return };
    assert_eq!(info["geoTransform"], json!(rotated.0));

    let degrees = GeoTransform::north_up(-122.32, 47.6, 1e-5, 1e-5);
    write(&path, &GeoTiffSpec { epsg: 4326, geotransform: degrees, ..lidar() }, &values);
    let info = gdalinfo(&path).unwrap();
    assert!(wkt(&info).starts_with("GEOGCRS[\"WGS 84\""), "{}", wkt(&info));
    assert!(wkt(&info).contains("ID[\"EPSG\",4326]"), "{}", wkt(&info));

    write(&path, &GeoTiffSpec { epsg: 0, nodata: None, ..lidar() }, &values);
    let info = gdalinfo(&path).unwrap();
    assert_eq!(wkt(&info), "");
    assert_eq!(info["geoTransform"], json!(lidar().geotransform.0));
    assert!(info["bands"][0].get("noDataValue").is_none());

    let compound = GeoTiffSpec { vertical_epsg: Some(6360), ..lidar() };
    write(&path, &compound, &values);
    let info = gdalinfo(&path).unwrap();
    assert!(wkt(&info).starts_with("COMPOUNDCRS["), "{}", wkt(&info));
    assert!(wkt(&info).contains("ID[\"EPSG\",6360]"), "{}", wkt(&info));
}

/// The COG of one image and its heights.
fn cog(folder: &Path, name: &str, size: (u32, u32), vertical: Option<u32>) -> (PathBuf, Vec<f32>) {
    let (width, height) = size;
    let spec = CogSpec {
        width,
        height,
        geotransform: GeoTransform::north_up(-13_615_000.125, 6_041_000.5, 0.149, 0.149),
        epsg: 3857,
        vertical_epsg: vertical,
        unit: Some(LinearUnit::Metre),
        metadata: vec![
            ("TIFFTAG_SOFTWARE".to_owned(), "sat3d 0".to_owned()),
            ("SOURCE_TILES".to_owned(), "a.tif;b.tif".to_owned()),
        ],
    };
    let values = heights(width, height);
    let path = folder.join(name);
    std::fs::write(&path, encode_cog(&values, &spec)).unwrap();
    (path, values)
}

#[test]
fn gdal_reads_a_cog_as_it_was_meant() {
    let folder = tempfile::tempdir().unwrap();
    let (path, values) = cog(folder.path(), "c.tif", (640, 640), None);
    let Some(info) = gdalinfo(&path) else { return };
    assert!(wkt(&info).starts_with("PROJCRS[\"WGS 84 / Pseudo-Mercator\""), "{}", wkt(&info));
    assert!(wkt(&info).contains("ID[\"EPSG\",3857]"), "{}", wkt(&info));
    let dataset = &info["metadata"][""];
    assert_eq!(dataset["AREA_OR_POINT"], "Area");
    assert_eq!(dataset["TIFFTAG_SOFTWARE"], "sat3d 0");
    assert_eq!(dataset["SOURCE_TILES"], "a.tif;b.tif");
    let structure = &info["metadata"]["IMAGE_STRUCTURE"];
    assert_eq!(
        (&structure["LAYOUT"], &structure["COMPRESSION"]),
        (&json!("COG"), &json!("DEFLATE"))
    );
    let band = &info["bands"][0];
    assert_eq!((&band["unit"], &band["noDataValue"]), (&json!("metre"), &json!("NaN")));
    assert_eq!(band["block"], json!([256, 256]));
    let sizes: Vec<&Value> =
        band["overviews"].as_array().unwrap().iter().map(|overview| &overview["size"]).collect();
    assert_eq!(sizes, [&json!([320, 320]), &json!([160, 160])]);
    let bits: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
    assert_eq!(gdal_samples(&path), bits);

    let (path, _) = cog(folder.path(), "v.tif", (640, 640), Some(5703));
    let info = gdalinfo(&path).unwrap();
    assert!(wkt(&info).starts_with("COMPOUNDCRS["), "{}", wkt(&info));
    for part in ["ID[\"EPSG\",3857]", "ID[\"EPSG\",5703]", "NAVD88"] {
        assert!(wkt(&info).contains(part), "{}", wkt(&info));
    }
}

/// Runs a validator on COGs whose sizes give none, one and several overviews.
fn validate(import: &str, arguments: &[&str]) {
    let Some(interpreter) = python_with(import) else { return };
    let folder = tempfile::tempdir().unwrap();
    for (i, size) in [(640, 640), (1, 1), (513, 300)].into_iter().enumerate() {
        let (path, _) = cog(folder.path(), &format!("{i}.tif"), size, Some(5703));
        let output = Command::new(&interpreter).args(arguments).arg(path).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{text}\n{errors}");
        assert!(text.contains("is a valid cloud optimized GeoTIFF"), "{text}\n{errors}");
        assert!(!text.contains("warning"), "{text}");
    }
}

#[test]
fn rio_cogeo_accepts_the_cogs() {
    let main = "from rasterio.rio.main import main_group; main_group()";
    validate("rio_cogeo", &["-c", main, "cogeo", "validate", "--strict"]);
}

#[test]
fn gdals_validator_accepts_the_cogs() {
    let module = "osgeo_utils.samples.validate_cloud_optimized_geotiff";
    validate(module, &["-m", module, "--full-check=yes"]);
}
