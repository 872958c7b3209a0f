use super::*;
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use crate::raster::geotiff::{GeoTiffSpec, GeoTiffWriter};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const SEATTLE: LonLat = LonLat { lon_deg: -122.334_567, lat_deg: 47.612_345 };

fn grid(size: u32) -> ImageGrid {
    ImageGrid::new(SEATTLE, 20, size, size).unwrap()
}

#[test]
fn groups_have_a_fixed_order_and_labels_that_read_well() {
    let set = StratumSet::new(true, None, &StrataSettings::default());
    let names: Vec<&str> = set.groups().iter().map(|g| &g.name[..]).collect();
    assert_eq!(names, ["slope", "edge_distance", "height_above_ground"]);
    let labels = |k: usize| set.groups()[k].labels.join(", ");
    assert_eq!(labels(0), "0 to 5, 5 to 15, 15 to 30, 30 to 60, 60 to 90");
    assert_eq!(labels(1), "0 to 0.5, 0.5 to 1, 1 to 2, 2 to 4, 4 to 8, over 8");
    assert_eq!(labels(2), "under -1, -1 to 1, 1 to 3, 3 to 6, 6 to 12, 12 to 25, over 25");
    assert_eq!(StratumSet::new(false, None, &StrataSettings::default()).groups().len(), 2);
    let odd = StrataSettings {
        slope_deg: vec![95.0, 40.0, f64::NAN, 10.0, 10.0, -3.0],
        edge_distance_m: vec![],
        ..StrataSettings::default()
    };
    let set = StratumSet::new(false, None, &odd);
    assert_eq!(set.groups()[0].labels, ["0 to 10", "10 to 40", "40 to 90"]);
    assert_eq!(set.groups()[1].labels, ["over 0"]);
}

#[test]
fn a_house_is_classified_pixel_by_pixel() {
    let set = StratumSet::new(true, None, &StrataSettings::default());
    let at = |k: usize| {
        if (20..40).contains(&(k % 60)) && (10..30).contains(&(k / 60)) { 8.0 } else { 0.5 }
    };
    let truth = Surface::new(60, 40, (0..2400).map(at).collect());
    let mut ground = Surface::new(60, 40, vec![0.0; 2400]);
    ground.values[0] = f32::NAN;
    ground.values[1] = 2.0;
    let strata = set.classify(&truth, Some(&ground), None, (0.25, 0.25));
    let of = |group: usize, x: usize, y: usize| strata.groups[group].classes[y * 60 + x];
    assert_eq!((of(0, 20, 20), of(0, 30, 20), of(0, 0, 5)), (4, 0, NO_CLASS));
    assert_eq!((of(1, 20, 20), of(1, 22, 20), of(1, 59, 39)), (0, 1, 4));
    assert_eq!((of(2, 30, 20), of(2, 5, 5), of(2, 0, 0), of(2, 1, 0)), (4, 1, NO_CLASS, 0));
    // Bare earth that this image lacks.
    let without = set.classify(&truth, None, None, (0.25, 0.25));
    assert!(without.groups[2].classes.iter().all(|c| *c == NO_CLASS));
}

fn json(folder: &Path, text: &str) -> PathBuf {
    let path = folder.join("mask.geojson");
    std::fs::write(&path, text).unwrap();
    path
}

/// A square of the image, in pixels, as a closed ring of longitudes and latitudes.
fn square(grid: &ImageGrid, from: f64, to: f64) -> String {
    let corners = [(from, from), (to, from), (to, to), (from, to), (from, from)];
    let ring: Vec<String> = corners
        .iter()
        .map(|(x, y)| {
            let at = grid.lonlat(PixelPoint { x: *x, y: *y });
            format!("[{:.12},{:.12}]", at.lon_deg, at.lat_deg)
        })
        .collect();
    format!("[{}]", ring.join(","))
}

#[test]
fn polygons_have_classes_holes_and_an_order() {
    let folder = tempfile::tempdir().unwrap();
    let grid = grid(40);
    let s = |a, b| square(&grid, a, b);
    let feature = |geometry: String, class: &str| {
        format!(r#"{{"type":"Feature","properties":{{"use":{class}}},"geometry":{geometry}}}"#)
    };
    let polygon = |rings: String| format!(r#"{{"type":"Polygon","coordinates":[{rings}]}}"#);
    let text = format!(
        r#"{{"type":"FeatureCollection","features":[{},{},{},{},{}]}}"#,
        feature(polygon(format!("{},{}", s(2.0, 20.0), s(5.0, 9.0))), "10"),
        feature(
            format!(
                r#"{{"type":"MultiPolygon","coordinates":[[{}],[{}]]}}"#,
                s(18.0, 24.0),
                s(30.0, 35.0)
            ),
            r#""park""#
        ),
        feature(polygon(s(31.0, 32.0)), "2.0"),
        feature(polygon(s(0.0, 40.0)), "null"),
        feature("null".to_owned(), "2"),
    );
    let path = json(folder.path(), &text);
    let options = MaskOptions {
        class_field: Some("use".to_owned()),
        names: Some(BTreeMap::from([("10".to_owned(), "building".to_owned())])),
        ..MaskOptions::default()
    };
    let mask = Mask::open(&path, &options).unwrap();
    assert_eq!(mask.labels(), ["2", "building", "park"]);
    assert_eq!(mask.warnings().len(), 2, "{:?}", mask.warnings());
    let classes = mask.classes(&grid).unwrap();
    let count = |class: u16| classes.iter().filter(|c| **c == class).count();
    // The park covers 2 x 2 of the building, class 2 one pixel of the park.
    assert_eq!((count(0), count(1), count(2)), (1, 324 - 16 - 4, 36 + 25 - 1));
    // Without a field: inside or outside, and the one without a class is a polygon too.
    let mask = Mask::open(&path, &MaskOptions::default()).unwrap();
    assert_eq!(mask.labels(), ["inside", "outside"]);
    assert!(mask.classes(&grid).unwrap().iter().all(|c| *c == 0));
    let path = json(folder.path(), &polygon(s(10.0, 20.0)));
    let mask = Mask::open(&path, &MaskOptions::default()).unwrap();
    assert_eq!(mask.classes(&grid).unwrap().iter().filter(|c| **c == 0).count(), 100);
    let set = StratumSet::new(false, Some(&mask), &StrataSettings::default());
    assert_eq!(set.groups()[2].labels, ["inside", "outside"]);
}

#[test]
fn what_is_no_mask_is_refused_with_the_place_and_the_value() {
    let folder = tempfile::tempdir().unwrap();
    let feature = |geometry: &str| {
        format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","properties":{{"a":1}},"geometry":{geometry}}}]}}"#
        )
    };
    let polygon =
        |ring: &str| feature(&format!(r#"{{"type":"Polygon","coordinates":[[{ring}]]}}"#));
    let cases = [
        ("{".to_owned(), "not JSON"),
        (r#"{"type":"Topology"}"#.to_owned(), "`Topology`"),
        (r#"{"type":"FeatureCollection"}"#.to_owned(), "no `features`"),
        (r#"{"type":"FeatureCollection","features":[]}"#.to_owned(), "no polygon"),
        (feature("null"), "no polygon"),
        (feature(r#"{"type":"Point","coordinates":[1,2]}"#), "`Point`"),
        (feature(r#"{"type":"Polygon"}"#), "no `coordinates`"),
        (polygon("[0,0],[1,0],[1,1],[0,1]"), "not closed"),
        (polygon("[0,0],[1,0],[0,0]"), "3 positions"),
        (polygon(r#"[0,0],[1,"x"],[1,1],[0,0]"#), "position 1"),
        (polygon("[0,0],[1,0],[1,null],[0,0]"), "position 2"),
        (
            polygon("[500000,5000000],[500010,5000000],[500010,5000010],[500000,5000000]"),
            "out of range",
        ),
        (polygon("[0,0],[1,0],[1,91],[0,0]"), "position 2 of ring 0"),
    ];
    for (text, expected) in cases {
        let path = json(folder.path(), &text);
        let error = Mask::open(&path, &MaskOptions::default()).unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains("mask.geojson"), "{error}");
    }
    let good = polygon("[0,0],[1,0],[1,1],[0,0]");
    let path = json(folder.path(), &good);
    let field =
        |name: &str| MaskOptions { class_field: Some(name.to_owned()), ..MaskOptions::default() };
    let error = Mask::open(&path, &field("b")).unwrap_err().to_string();
    assert!(error.contains("`b`") && error.contains("there are: a"), "{error}");
    assert_eq!(Mask::open(&path, &field("a")).unwrap().labels(), ["1"]);
    let list = good.replace(r#""a":1"#, r#""a":[1]"#);
    let error = Mask::open(&json(folder.path(), &list), &field("a")).unwrap_err().to_string();
    assert!(error.contains("[1]") && error.contains("feature 0"), "{error}");
    let crs = good.replacen('{', r#"{"crs":{"type":"link"},"#, 1);
    let error = Mask::open(&json(folder.path(), &crs), &field("a")).unwrap_err().to_string();
    assert!(error.contains("names no CRS"), "{error}");
    let missing = folder.path().join("nothing.tif");
    assert!(Mask::open(&missing, &MaskOptions::default()).is_err());
}

fn raster(path: &Path, grid: &ImageGrid, at: impl Fn(u32) -> f32) {
    let spec = GeoTiffSpec {
        width: grid.width(),
        height: grid.height(),
        geotransform: grid.geotransform(),
        epsg: 3857,
        ..GeoTiffSpec::default()
    };
    let mut writer = GeoTiffWriter::create(path, &spec).unwrap();
    let values: Vec<f32> = (0..grid.width() * grid.height()).map(at).collect();
    writer.write_rows(&values).unwrap();
    writer.finish().unwrap();
}

#[test]
fn rasters_hold_whole_numbers_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.tif");
    let grid = grid(16);
    raster(&path, &grid, |k| [7.0, f32::NAN, 65_534.0, 0.0][k as usize % 4]);
    let mask = Mask::open(&path, &MaskOptions::default()).unwrap();
    assert_eq!(mask.labels(), ["0", "7", "65534"]);
    assert_eq!(mask.classes(&grid).unwrap()[..4], [1, NO_CLASS, 2, 0]);
    for (value, expected) in [(-1.0, "-1"), (2.5, "2.5"), (65_535.0, "65535")] {
        raster(&path, &grid, |k| if k == 77 { value } else { 1.0 });
        let error = Mask::open(&path, &MaskOptions::default()).unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains("mask.tif"), "{error}");
    }
    raster(&path, &ImageGrid::new(SEATTLE, 20, 20, 20).unwrap(), |k| k as f32);
    let error = Mask::open(&path, &MaskOptions::default()).unwrap_err().to_string();
    assert!(error.contains("400 different values"), "{error}");
    raster(&path, &grid, |_| f32::NAN);
    assert!(Mask::open(&path, &MaskOptions::default()).is_err());
}
