//! The DSM of a city in another CRS against `gdalwarp -et 0` of the DSM in its own.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{has_tool, run};
use sat3d::crs::CrsSpec;
use sat3d::footprint::Footprint;
use sat3d::grid::{ImageGrid, LonLat};
use sat3d::tile::city::{Along, City, Levels};
use sat3d::tile::dsm::{DsmFile, DsmOptions, write_dsm};
use sat3d::tile::slabs::{FOLDER, Kind, Slabs};
use std::path::Path;
use std::process::Command;

/// Columns and rows of the city, model pixels.
const SIZE: [u32; 2] = [900, 700];

/// Hills, houses with walls, a hole.
fn height(x: u32, y: u32) -> f32 {
    let hole = (200..230).contains(&x) && (90..100).contains(&y);
    let house = if x % 40 < 15 && y % 30 < 12 { 12.5 } else { 0.0 };
    if hole { f32::NAN } else { 0.02 * x as f32 + (y % 97) as f32 * 0.05 + house }
}

fn city(at: LonLat, out: &Path) -> City {
    let grid = ImageGrid::new(at, 20, SIZE[0] * 5 / 2, SIZE[1] * 5 / 2).unwrap();
    let city = City {
        size: SIZE,
        footprint: Footprint::of_grid(grid),
        assumed: false,
        levels: Levels { z: vec![-0.5, 0.5], ends: [-1.0, 1.0] },
        vertical_m: 32.24,
        along: Along::X,
    };
    std::fs::create_dir_all(out.join(FOLDER)).unwrap();
    let slabs = Slabs { city: &city, out };
    for slab in 0..city.slabs() {
        let [columns, rows] = city.rectangle(slab);
        let pixels = rows.flat_map(|y| columns.clone().map(move |x| height(x, y)));
        let bytes: Vec<u8> = pixels.flat_map(f32::to_le_bytes).collect();
        std::fs::write(slabs.path(slab, Kind::Heights), bytes).unwrap();
    }
    city
}

fn write(city: &City, out: &Path, name: &str, t_srs: Option<u32>) -> DsmFile {
    let t_srs = t_srs.map(CrsSpec::from_epsg);
    let options = DsmOptions { name: name.to_owned(), t_srs, ..DsmOptions::default() };
    write_dsm(&Slabs { city, out }, &options, &mut |_, _| {}).unwrap()
}

/// All samples of what a tool of GDAL makes of a raster.
fn samples(tool: &str, tif: &Path, arguments: &[String], out: &Path) -> Vec<f32> {
    let target = out.join(format!("{tool}.bin"));
    let mut command = Command::new(tool);
    command.args(["-q", "-of", "ENVI", "-ot", "Float32"]);
    run(command.args(arguments).arg(tif).arg(&target), 0);
    let bytes = std::fs::read(&target).unwrap();
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

fn strings(arguments: &[&str]) -> Vec<String> {
    arguments.iter().map(|argument| (*argument).to_owned()).collect()
}

#[test]
fn a_dsm_in_another_crs_is_what_gdalwarp_makes_of_its_own() {
    let test = "a_dsm_in_another_crs_is_what_gdalwarp_makes_of_its_own";
    if !has_tool(test, "gdalwarp") || !has_tool(test, "gdal_translate") {
        return;
    }
    let seattle = LonLat { lon_deg: -122.33, lat_deg: 47.6 };
    // Near the border of its zone, where north on the grid is 2 degrees off.
    let bonn = LonLat { lon_deg: 6.05, lat_deg: 50.7 };
    for (at, code) in [(seattle, 32610), (seattle, 2927), (seattle, 4326), (bonn, 25832)] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        let city = city(at, out);
        write(&city, out, "own.tif", None);
        let file = write(&city, out, "other.tif", Some(code));
        let c = file.geotransform.0;
        let [width, height] = file.size_px;
        let te = [c[0], c[3] + f64::from(height) * c[5], c[0] + f64::from(width) * c[1], c[3]];
        let t_srs = format!("EPSG:{code}");
        let mut arguments = strings(&["-t_srs", &t_srs, "-r", "bilinear", "-et", "0"]);
        // GDAL derives how much the kernel is widened from the box around a turned window; pixels are as
        // large here.
        arguments.extend(strings(&["-ovr", "NONE", "-wt", "Float32", "-dstnodata", "nan"]));
        arguments.extend(strings(&["-wo", "XSCALE=1", "-wo", "YSCALE=1", "-te"]));
        arguments.extend(te.map(|v| format!("{v:.17e}")));
        arguments.extend(strings(&["-ts", &width.to_string(), &height.to_string()]));
        let theirs = samples("gdalwarp", &out.join("own.tif"), &arguments, out);
        let ours = samples("gdal_translate", &out.join("other.tif"), &[], out);
        assert_eq!((ours.len(), theirs.len()), ((width * height) as usize, ours.len()));
        let (mut both, mut validity, mut worst) = (0, 0, 0.0_f32);
        for (a, b) in ours.iter().zip(&theirs) {
            match (a.is_nan(), b.is_nan()) {
                (false, false) => {
                    both += 1;
                    worst = worst.max((a - b).abs());
                }
                (true, true) => {}
                _ => validity += 1,
            }
        }
        eprintln!("EPSG:{code}: {both} px, worst {worst:.2e} m, validity {validity}");
        assert!(both > 600_000 && validity <= 4, "EPSG:{code}: {both} {validity}");
        assert!(worst < 1e-3, "EPSG:{code}: {worst} m");
    }
}

#[test]
fn as_many_pixels_as_gdalwarp_chooses() {
    let test = "as_many_pixels_as_gdalwarp_chooses";
    if !has_tool(test, "gdalwarp") || !has_tool(test, "gdalinfo") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path();
    let city = city(LonLat { lon_deg: -122.33, lat_deg: 47.6 }, out);
    write(&city, out, "own.tif", None);
    for code in [32610, 2927] {
        let file = write(&city, out, "other.tif", Some(code));
        let vrt = out.join("default.vrt");
        let t_srs = format!("EPSG:{code}");
        let mut command = Command::new("gdalwarp");
        command.args(["-q", "-overwrite", "-of", "VRT", "-t_srs", &t_srs]);
        run(command.arg(out.join("own.tif")).arg(&vrt), 0);
        let info = run(Command::new("gdalinfo").arg("-json").arg(&vrt), 0);
        let info: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
        for axis in 0..2 {
            let theirs = info["size"][axis].as_f64().unwrap();
            let ours = f64::from(file.size_px[axis]);
            assert!((ours / theirs - 1.0).abs() < 0.02, "EPSG:{code}: {ours} {theirs}");
        }
        let theirs = info["geoTransform"][1].as_f64().unwrap();
        assert!((file.geotransform.0[1] / theirs - 1.0).abs() < 0.01, "EPSG:{code}: {theirs}");
    }
}
