//! The benchmark against `gdalwarp -et 0` on real rasters: every kernel, heights within 1 mm.
#![allow(clippy::unwrap_used, reason = "a test may fail")]
#![allow(
    clippy::disallowed_methods,
    reason = "an oracle of its own need not be the same on every machine"
)]

use crate::common;

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

fn build(
    raster: &Path,
    at: &[LonLat],
    unit: &str,
    zoom: i32,
    size: usize,
    extra: &[&str],
    out: &Path,
) -> Vec<Vec<f32>> {
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
            // Beyond a raster's west and north border GDAL 3.6 repeats the border cell for one more
            // cell's width when it averages; we do not, so averages are compared inside only.
            let at = if kernel == "average" { &at[..2] } else { &at[..] };
            let out = tempfile::tempdir().unwrap();
            let ours = build(&raster, at, unit, 20, 640, &["-r", kernel], out.path());
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
                        !a.is_nan()
                            && !b.is_nan()
                            && (f64::from(**a) - f64::from(**b) * factor).abs() > 1e-3
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
    let cases = [
        (15, 160, "bilinear"),
        (15, 160, "cubic"),
        (14, 100, "bilinear"),
        (15, 160, "average"),
        (13, 60, "average"),
    ];
    for (zoom, size, kernel) in cases {
        let out = tempfile::tempdir().unwrap();
        let ours = build(&raster, at, "metre", zoom, size, &["-r", kernel], out.path());
        // GDAL derives the ratio from the bounding box of the source window; the exact ratio is
        // given to it so that kernels, and not window sizes, are compared.
        let cells = cells_per_pixel(&raster, at[0], zoom, size);
        let x = format!("XSCALE={:.12}", 1.0 / cells.0);
        let y = format!("YSCALE={:.12}", 1.0 / cells.1);
        let theirs = gdalwarp(
            &raster,
            (at[0].lat_deg, at[0].lon_deg),
            zoom,
            size,
            &["-r", kernel, "-wo", &x, "-wo", &y],
        );
        let d = difference(&ours[0], &theirs, 1.0);
        eprintln!(
            "zoom {zoom} {kernel}: {} px, worst {:.2e} m, validity {}",
            d.both, d.worst_m, d.validity
        );
        assert!(
            d.both > 1000 && d.validity <= 4,
            "zoom {zoom} {kernel}: {} {}",
            d.both,
            d.validity
        );
        assert!(d.worst_m < 1e-3, "zoom {zoom} {kernel}: {} m", d.worst_m);
    }
}

/// A raster of one row: gdalwarp falls to nearest there, so the oracle is bilinear interpolation as
/// it is defined, by one projection per pixel.
#[test]
fn a_sliver_of_one_row_is_interpolated_along_it() {
    let test = "a_sliver_of_one_row_is_interpolated_along_it";
    let Some(data) = test_data(test) else { return };
    let raster = data.join("rasters/alki_sliver_2927.tif");
    let mut reader = open(&raster, &OpenOptions::default()).unwrap();
    let header = reader.header().clone();
    let mut row = Vec::new();
    reader.read_block(0, 0, &mut row).unwrap();
    let projection =
        resolve(header.crs.as_ref().unwrap(), &ResolveOptions::default()).unwrap().projection;
    let middle = header.geotransform.to_projected(PixelPoint { x: 190.5, y: 0.5 });
    let at = projection.inverse(middle).unwrap();
    let out = tempfile::tempdir().unwrap();
    let ours = &build(&raster, &[at], "us-survey-foot", 20, 640, &[], out.path())[0];
    let grid = sat3d::grid::ImageGrid::new(at, 20, 640, 640).unwrap();
    let cell = |c: i64| {
        row.get(usize::try_from(c).unwrap_or(usize::MAX)).map_or(f64::NAN, |v| f64::from(*v))
    };
    let mut compared = 0;
    for (k, ours) in ours.iter().enumerate() {
        let centre = PixelPoint { x: (k % 640) as f64 + 0.5, y: (k / 640) as f64 + 0.5 };
        let p = header.geotransform.to_pixel(projection.forward(grid.lonlat(centre)).unwrap());
        let own = if p.y >= 0.0 && p.y < 1.0 { cell(p.x.floor() as i64) } else { f64::NAN };
        let left = (p.x - 0.5).floor();
        let f = p.x - 0.5 - left;
        let (a, b) = (cell(left as i64), cell(left as i64 + 1));
        let value = match (a.is_nan(), b.is_nan()) {
            (false, false) => a + f * (b - a),
            (false, true) => a,
            _ => b,
        };
        let expected = if own.is_nan() { f64::NAN } else { value * 1200.0 / 3937.0 };
        assert_eq!(ours.is_nan(), expected.is_nan(), "pixel {k}: {ours} {expected}");
        if !ours.is_nan() {
            assert!((f64::from(*ours) - expected).abs() < 1e-5, "pixel {k}: {ours} {expected}");
            compared += 1;
        }
    }
    assert!(compared > 1000, "only {compared} pixels lie on the sliver");
}

/// `--grid reference`: the published procedure's box, computed here from its formulas, warped by
/// GDAL in the tile's own CRS.
#[test]
fn the_reference_grid_is_the_published_procedure() {
    let test = "the_reference_grid_is_the_published_procedure";
    let (Some(data), true) = (test_data(test), has_tool(test, "gdalwarp")) else { return };
    let raster = data.join("rasters/alki_rgb_2927.tif");
    let at = positions(&raster)[0];
    let out = tempfile::tempdir().unwrap();
    let ours =
        &build(&raster, &[at], "us-survey-foot", 20, 640, &["--grid", "reference"], out.path())[0];
    let crs = CrsSpec::from_user_input("EPSG:2927").unwrap();
    let projection = resolve(&crs, &ResolveOptions::default()).unwrap().projection;
    let cos = at.lat_deg.to_radians().cos();
    let ground_km = 640.0 * (156_543.03 * cos / f64::from(1 << 20)) / 1000.0;
    let (lon_span, lat_span) = (ground_km / (111.32 * cos), ground_km / 111.32);
    let corner = |sign: f64| {
        projection
            .forward(LonLat {
                lon_deg: at.lon_deg + sign * lon_span / 2.0,
                lat_deg: at.lat_deg + sign * lat_span / 2.0,
            })
            .unwrap()
    };
    let (low, high) = (corner(-1.0), corner(1.0));
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("reference.bin");
    let te = [low.x, low.y, high.x, high.y].map(|v| format!("{v:.12}"));
    let mut command = std::process::Command::new("gdalwarp");
    command.args(["-q", "-of", "ENVI", "-t_srs", "EPSG:2927", "-r", "bilinear", "-te"]).args(te);
    command.args(["-ts", "640", "640", "-et", "0", "-ot", "Float32", "-wt", "Float32"]);
    run(command.args(["-dstnodata", "nan"]).arg(&raster).arg(&target), 0);
    let bytes = std::fs::read(&target).unwrap();
    let theirs: Vec<f32> = bytes
        .chunks_exact(4)
        .take(640 * 640)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    let d = difference(ours, &theirs, 1200.0 / 3937.0);
    assert!(
        d.both > 400_000 && d.validity == 0 && d.worst_m < 1e-3,
        "{} {} {}",
        d.both,
        d.validity,
        d.worst_m
    );
    // And it is not the image's own grid, by far.
    let out = tempfile::tempdir().unwrap();
    let exact = &build(&raster, &[at], "us-survey-foot", 20, 640, &[], out.path())[0];
    assert!(difference(exact, &theirs, 1200.0 / 3937.0).worst_m > 1.0);
}

/// Source cells per image pixel at the middle, along columns and rows, by central differences.
fn cells_per_pixel(raster: &Path, at: LonLat, zoom: i32, size: usize) -> (f64, f64) {
    let reader = open(raster, &OpenOptions::default()).unwrap();
    let header = reader.header();
    let projection =
        resolve(header.crs.as_ref().unwrap(), &ResolveOptions::default()).unwrap().projection;
    let grid = sat3d::grid::ImageGrid::new(at, zoom as u8, size as u32, size as u32).unwrap();
    let middle = size as f64 / 2.0;
    let cell = |x: f64, y: f64| {
        let centre = PixelPoint { x: middle + x, y: middle + y };
        let p = projection.forward(grid.lonlat(centre)).unwrap();
        header.geotransform.to_pixel(p)
    };
    let (west, east, north, south) =
        (cell(-0.5, 0.0), cell(0.5, 0.0), cell(0.0, -0.5), cell(0.0, 0.5));
    ((east.x - west.x).hypot(south.x - north.x), (east.y - west.y).hypot(south.y - north.y))
}
