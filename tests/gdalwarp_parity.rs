//! The benchmark against `gdalwarp -et 0` on real rasters: every kernel, heights within 1 mm.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

mod common;

use common::{gdalwarp, has_tool, npz, run, sat3d, test_data};
use sat3d::crs::{CrsSpec, ResolveOptions, resolve};
use sat3d::grid::{LonLat, PixelPoint};
use sat3d::raster::{OpenOptions, open};
use std::path::Path;

/// Rasters with the factor from their heights to metres and whether the program must be told.
const RASTERS: [(&str, f64, &str); 5] = [
    ("alki_rgb_2927.tif", 1200.0 / 3937.0, "us-survey-foot"),
    ("nrw_dsm_25832.tif", 1.0, "metre"),
    ("muncie_feet_2965.tif", 1200.0 / 3937.0, "us-survey-foot"),
    ("lidar_dsm_26918.tif", 1.0, "metre"),
    ("codem_compound_f64_32616.tif", 1.0, "metre"),
];

/// Positions inside a raster, at fractions of its width and height; two lie near an edge.
fn positions(path: &Path) -> Vec<LonLat> {
    let reader = open(path, &OpenOptions::default()).unwrap();
    let header = reader.header();
    let crs: &CrsSpec = header.crs.as_ref().unwrap();
    let projection = resolve(crs, &ResolveOptions::default()).unwrap().projection;
    let (w, h) = (f64::from(header.width), f64::from(header.height));
    [(0.5, 0.5), (0.31, 0.62), (0.02, 0.5), (0.97, 0.985)]
        .into_iter()
        .map(|(u, v)| {
            let at = header.geotransform.to_projected(PixelPoint { x: u * w, y: v * h });
            projection.inverse(at).unwrap()
        })
        .collect()
}

struct Difference {
    both: usize,
    worst_m: f64,
    validity: usize,
}

fn difference(ours: &[f32], theirs: &[f32], factor: f64) -> Difference {
    assert_eq!(ours.len(), theirs.len());
    let mut d = Difference { both: 0, worst_m: 0.0, validity: 0 };
    for (a, b) in ours.iter().zip(theirs) {
        match (a.is_nan(), b.is_nan()) {
            (false, false) => {
                d.both += 1;
                d.worst_m = d.worst_m.max((f64::from(*a) - f64::from(*b) * factor).abs());
            }
            (true, true) => {}
            _ => d.validity += 1,
        }
    }
    d
}

fn build(raster: &Path, at: &[LonLat], unit: &str, zoom: i32, size: usize, extra: &[&str], out: &Path) -> Vec<Vec<f32>> {
    let list = out.join("names.txt");
    let stems: Vec<String> =
        at.iter().map(|p| format!("satellite_{}_{}", p.lat_deg, p.lon_deg)).collect();
    std::fs::write(&list, stems.join("\n")).unwrap();
    let dsm = out.join("dsm");
    let mut command = sat3d();
    command
        .args(["dsm-bench", "build", "--max-nan", "100", "--vertical-unit", unit])
        .args(["--zoom", &zoom.to_string(), "--size", &size.to_string(), "--lidar"])
        .arg(raster)
        .arg("--images")
        .arg(&list)
        .arg("--out")
        .arg(&dsm)
        .args(extra);
    run(&mut command, 0);
    stems.iter().map(|stem| npz(&dsm.join(format!("{stem}_dsm.npz")), "dsm")).collect()
}

#[test]
fn every_kernel_agrees_with_gdalwarp_on_real_rasters() {
    let test = "every_kernel_agrees_with_gdalwarp_on_real_rasters";
    let (Some(data), true) = (test_data(test), has_tool(test, "gdalwarp")) else { return };
    for (name, factor, unit) in RASTERS {
        let raster = data.join("rasters").join(name);
        let at = positions(&raster);
        for kernel in ["bilinear", "cubic", "average", "nearest"] {
            let gdal_name = if kernel == "nearest" { "near" } else { kernel };
            let out = tempfile::tempdir().unwrap();
            let ours = build(&raster, &at, unit, 20, 640, &["-r", kernel], out.path());
            for (p, ours) in at.iter().zip(&ours) {
                let theirs = gdalwarp(&raster, (p.lat_deg, p.lon_deg), 20, 640, &["-r", gdal_name]);
                let d = difference(ours, &theirs, factor);
                eprintln!(
                    "{name} {kernel}: {} px, worst {:.2e} m, validity {}",
                    d.both, d.worst_m, d.validity
                );
                assert!(d.both > 1000, "{name} {kernel}: too few pixels to compare");
                assert!(d.validity <= 4, "{name} {kernel}: {} validity differences", d.validity);
                if kernel == "nearest" {
                    // A step function: position differences of nanometres may pick the neighbour.
                    let other = ours.iter().zip(&theirs).filter(|(a, b)| {
                        !a.is_nan() && !b.is_nan() && (f64::from(**a) - f64::from(**b) * factor).abs() > 1e-3
                    });
                    assert!(other.count() <= 4, "{name} nearest");
                } else {
                    assert!(d.worst_m < 1e-3, "{name} {kernel}: {} m", d.worst_m);
                }
            }
        }
    }
}

#[test]
fn a_coarser_target_widens_the_kernel_as_gdalwarp_does() {
    let test = "a_coarser_target_widens_the_kernel_as_gdalwarp_does";
    let (Some(data), true) = (test_data(test), has_tool(test, "gdalwarp")) else { return };
    let raster = data.join("rasters/nrw_dsm_25832.tif");
    let at = &positions(&raster)[..1];
    for (zoom, kernel) in [(15, "bilinear"), (15, "cubic"), (14, "bilinear"), (15, "average"), (13, "average")] {
        let out = tempfile::tempdir().unwrap();
        let size = 160;
        let ours = build(&raster, at, "metre", zoom, size, &["-r", kernel], out.path());
        // GDAL derives the ratio from the bounding box of the source window; the exact ratio is
        // given to it so that kernels, and not window sizes, are compared.
        let cells = cells_per_pixel(&raster, at[0], zoom);
        let x = format!("XSCALE={:.12}", 1.0 / cells.0);
        let y = format!("YSCALE={:.12}", 1.0 / cells.1);
        let theirs =
            gdalwarp(&raster, (at[0].lat_deg, at[0].lon_deg), zoom, size, &["-r", kernel, "-wo", &x, "-wo", &y]);
        let d = difference(&ours[0], &theirs, 1.0);
        eprintln!("zoom {zoom} {kernel}: {} px, worst {:.2e} m, validity {}", d.both, d.worst_m, d.validity);
        assert!(d.both > 1000 && d.validity <= 4, "zoom {zoom} {kernel}: {} {}", d.both, d.validity);
        assert!(d.worst_m < 1e-3, "zoom {zoom} {kernel}: {} m", d.worst_m);
    }
}

/// Source cells per image pixel at the middle, along columns and rows, by central differences.
fn cells_per_pixel(raster: &Path, at: LonLat, zoom: i32) -> (f64, f64) {
    let reader = open(raster, &OpenOptions::default()).unwrap();
    let header = reader.header();
    let projection = resolve(header.crs.as_ref().unwrap(), &ResolveOptions::default()).unwrap().projection;
    let grid = sat3d::grid::ImageGrid::new(at, zoom as u8, 160, 160).unwrap();
    let cell = |x: f64, y: f64| {
        let p = projection.forward(grid.lonlat(PixelPoint { x: 80.0 + x, y: 80.0 + y })).unwrap();
        header.geotransform.to_pixel(p)
    };
    let (west, east, north, south) = (cell(-0.5, 0.0), cell(0.5, 0.0), cell(0.0, -0.5), cell(0.0, 0.5));
    ((east.x - west.x).hypot(south.x - north.x), (east.y - west.y).hypot(south.y - north.y))
}
