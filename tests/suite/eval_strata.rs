//! Masks and single rasters against other programs: rasterio (GDAL's rasterize), geopandas and
//! gdalwarp.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{gdalwarp, has_tool, test_data};
use sat3d::eval::strata::{Mask, MaskOptions};
use sat3d::grid::{ImageGrid, LonLat};
use sat3d::lidar::{EdgeRule, Resampling, SingleRaster};
use sat3d::raster::OpenOptions;
use std::path::Path;
use std::process::Command;

const AT: LonLat = LonLat { lon_deg: -122.334_567, lat_deg: 47.612_345 };

/// Python with what a test imports; prints that the test was skipped where there is none.
fn python(test: &str, imports: &str) -> Option<String> {
    let python = std::env::var("SAT3D_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let works = Command::new(&python).args(["-c", imports]).output();
    if works.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    eprintln!("SKIPPED {test}: `{python}` cannot run `{imports}` (set SAT3D_TEST_PYTHON)");
    None
}

/// Random polygons around the image in UTM, written in three CRSs with geopandas; rasterized with
/// rasterio on the image's grid, from coordinates brought to EPSG:3857 with densified edges.
const SCRIPT: &str = r#"
import sys, json, numpy as np, geopandas as gpd, rasterio.features
from shapely.geometry import Polygon
from rasterio.transform import Affine
folder, c = sys.argv[1], [float(v) for v in sys.argv[2:8]]
x0, y0 = float(sys.argv[8]), float(sys.argv[9])
rng = np.random.default_rng(11)
rows = []
for k in range(60):
    cx, cy = x0 + rng.uniform(-90, 90), y0 + rng.uniform(-90, 90)
    n = rng.integers(4, 12)
    t = np.sort(rng.uniform(0, 2 * np.pi, n))
    r = rng.uniform(3, 25, n)
    outer = np.c_[cx + r * np.cos(t), cy + r * np.sin(t)]
    hole = [np.c_[cx + 0.3 * r * np.cos(t), cy + 0.3 * r * np.sin(t)]] if k % 3 == 0 else []
    rows.append((Polygon(outer, hole), int(rng.integers(0, 5))))
# A band 30 km long: its edges bend.
rows.insert(0, (Polygon([(x0 - 15000, y0 - 20), (x0 + 15000, y0 + 15), (x0 + 15000, y0 + 45), (x0 - 15000, y0 + 5)]), 9))
frame = gpd.GeoDataFrame({"use": [v for _, v in rows]}, geometry=[g for g, _ in rows], crs=26910)
for code in (26910, 2927, 4326):
    part = frame.to_crs(code)
    names = part.to_json(drop_id=True) if code == 4326 else None
    doc = json.loads(part.to_json(drop_id=True))
    doc.pop("crs", None)
    if code == 2927:
        doc["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::2927"}}
    json.dump(doc, open(f"{folder}/{code}.geojson", "w"))
    dense = part.copy()
    dense.geometry = part.geometry.segmentize(5.0 if code != 4326 else 5e-5)
    dense = dense.to_crs(3857)
    out = rasterio.features.rasterize(zip(dense.geometry, dense.use), (256, 256), fill=255,
        transform=Affine(c[1], 0, c[0], 0, c[5], c[3]), dtype="uint8")
    out.tofile(f"{folder}/{code}.bin")
"#;

#[test]
fn polygons_in_other_coordinate_systems_agree_with_rasterio() {
    let test = "polygons_in_other_coordinate_systems_agree_with_rasterio";
    let Some(python) = python(test, "import numpy, geopandas, rasterio, shapely") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("make.py");
    std::fs::write(&script, SCRIPT).unwrap();
    let grid = ImageGrid::new(AT, 20, 256, 256).unwrap();
    let spec = sat3d::crs::CrsSpec::from_epsg(26_910);
    let utm = sat3d::crs::resolve(&spec, &sat3d::crs::ResolveOptions::default()).unwrap();
    let middle = utm.projection.forward(AT).unwrap();
    let numbers = grid.geotransform().0.map(|v| format!("{v:.9}"));
    let output = Command::new(python)
        .arg(&script)
        .arg(folder.path())
        .args(numbers)
        .args([middle.x.to_string(), middle.y.to_string()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    for code in ["26910", "2927", "4326"] {
        let options = MaskOptions {
            class_field: Some("use".to_owned()),
            crs: (code == "26910").then(|| "EPSG:26910".to_owned()),
            ..MaskOptions::default()
        };
        let mask = Mask::open(&folder.path().join(format!("{code}.geojson")), &options).unwrap();
        assert_eq!(mask.labels(), ["0", "1", "2", "3", "4", "9"]);
        let values = [0, 1, 2, 3, 4, 9];
        let ours = mask.classes(&grid).unwrap();
        let theirs = std::fs::read(folder.path().join(format!("{code}.bin"))).unwrap();
        let value = |class: u16| values.get(usize::from(class)).copied().unwrap_or(255);
        let other = ours.iter().zip(&theirs).filter(|(a, b)| value(**a) != **b).count();
        let filled = theirs.iter().filter(|v| **v != 255).count();
        eprintln!("EPSG:{code}: {other} of {filled} pixels differ");
        assert!(filled > 10_000, "{filled}");
        // Centres within a micrometre of an edge may fall on either side.
        assert!(other <= 3, "EPSG:{code}: {other} pixels");
    }
}

#[test]
fn a_raster_in_degrees_agrees_with_gdalwarp() {
    let test = "a_raster_in_degrees_agrees_with_gdalwarp";
    let (Some(data), true) = (test_data(test), has_tool(test, "gdalwarp")) else { return };
    for name in ["srtm_ref_4326.tif", "nrw_dsm_25832.tif"] {
        let path = data.join("rasters").join(name);
        let raster = SingleRaster::open(&path, &OpenOptions::default(), None).unwrap();
        let at = middle(&raster, &path);
        for (kernel, gdal) in [
            (Resampling::Bilinear, "bilinear"),
            (Resampling::Cubic, "cubic"),
            (Resampling::Nearest, "near"),
        ] {
            let zoom = if name.starts_with("srtm") { 13 } else { 20 };
            let grid = ImageGrid::new(at, zoom, 300, 300).unwrap();
            let ours = raster.on_grid(&grid, kernel, EdgeRule::Renormalise).unwrap();
            let place = (at.lat_deg, at.lon_deg);
            let theirs = gdalwarp(&path, place, i32::from(zoom), 300, &["-r", gdal]);
            let mut worst = Vec::new();
            for (a, b) in ours.iter().zip(&theirs) {
                assert_eq!(a.is_nan(), b.is_nan(), "{name} {gdal}");
                if !a.is_nan() {
                    worst.push((f64::from(*a) - f64::from(*b)).abs());
                }
            }
            worst.sort_by(f64::total_cmp);
            // A step function: centres on the border of two cells may go to either.
            let spared = if kernel == Resampling::Nearest { 4 } else { 0 };
            let worst = worst[worst.len() - 1 - spared];
            eprintln!("{name} {gdal}: worst {worst:.1e} m");
            assert!(worst < 1e-3, "{name} {gdal}: {worst}");
        }
    }
}

fn middle(raster: &SingleRaster, path: &Path) -> LonLat {
    let header = raster.header();
    let spec = header.crs.clone().unwrap_or_else(|| panic!("{} has no CRS", path.display()));
    let placement = sat3d::lidar::Placement::of(&spec, None).unwrap();
    let p = sat3d::grid::PixelPoint {
        x: f64::from(header.width) * 0.5,
        y: f64::from(header.height) * 0.4,
    };
    placement.projection.inverse(header.geotransform.to_projected(p)).unwrap()
}
