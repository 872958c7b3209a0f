use super::*;
use crate::raster::geotiff::{GeoTiffSpec, GeoTiffWriter, Layout};
use std::path::Path;

const SEATTLE: LonLat = LonLat { lon_deg: -122.334_567, lat_deg: 47.612_345 };

fn grid(size: u32) -> ImageGrid {
    ImageGrid::new(SEATTLE, 20, size, size).unwrap()
}

fn write(
    path: &Path,
    epsg: u32,
    geotransform: GeoTransform,
    size: (u32, u32),
    unit: Option<LinearUnit>,
    at: impl Fn(u32, u32) -> f32,
) {
    let spec = GeoTiffSpec {
        width: size.0,
        height: size.1,
        geotransform,
        epsg,
        unit,
        layout: Layout::Tiles(32),
        ..GeoTiffSpec::default()
    };
    let mut writer = GeoTiffWriter::create(path, &spec).unwrap();
    for row in 0..size.1 {
        let row: Vec<f32> = (0..size.0).map(|col| at(col, row)).collect();
        writer.write_rows(&row).unwrap();
    }
    writer.finish().unwrap();
}

fn open(path: &Path) -> SingleRaster {
    SingleRaster::open(path, &OpenOptions::default(), None).unwrap()
}

fn noise(col: u32, row: u32) -> f32 {
    if (col * 7 + row * 13).is_multiple_of(11) {
        return f32::NAN;
    }
    crate::random::unit(crate::random::key(&[u64::from(col), u64::from(row)])) as f32 * 300.0
}

fn same_bits(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()))
}

const KERNELS: [Resampling; 4] =
    [Resampling::Nearest, Resampling::Bilinear, Resampling::Cubic, Resampling::Average];

#[test]
fn a_raster_on_the_grid_comes_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    let grid = grid(70);
    write(&path, 3857, grid.geotransform(), (70, 70), None, noise);
    let expected: Vec<f32> = (0..4900).map(|k| noise(k % 70, k / 70)).collect();
    let raster = open(&path);
    for kernel in KERNELS {
        let found = raster.on_grid(&grid, kernel, EdgeRule::Renormalise).unwrap();
        assert!(same_bits(&found, &expected), "{kernel:?}");
    }
    // Threads share it.
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let found = raster.on_grid(&grid, Resampling::Nearest, EdgeRule::Strict).unwrap();
                assert!(same_bits(&found, &expected));
            });
        }
    });
    // A grid of another size is not this grid.
    let smaller = ImageGrid::new(SEATTLE, 20, 68, 68).unwrap();
    let found = raster.on_grid(&smaller, Resampling::Nearest, EdgeRule::Renormalise).unwrap();
    let inside: Vec<f32> = (0..68 * 68).map(|k| noise(k % 68 + 1, k / 68 + 1)).collect();
    assert!(same_bits(&found, &inside));
}

#[test]
fn a_thousandth_of_a_pixel_is_not_on_the_grid() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    let grid = grid(40);
    let mut shifted = grid.geotransform();
    shifted.0[0] += shifted.0[1] * 1e-3;
    write(&path, 3857, shifted, (40, 40), None, |c, _| c as f32);
    let raster = open(&path);
    assert!(!raster.lies_on(&grid));
    let found = raster.on_grid(&grid, Resampling::Bilinear, EdgeRule::Renormalise).unwrap();
    // The target lies a thousandth of a pixel west: so much less of a ramp that rises to the east.
    assert!((f64::from(found[20]) - 19.999).abs() < 1e-5, "{}", found[20]);
}

/// A plane in any CRS is a plane under bilinear interpolation; the oracle is one projection per pixel.
#[test]
fn planes_come_back_from_every_kind_of_crs() {
    let folder = tempfile::tempdir().unwrap();
    let grid = grid(96);
    for (epsg, step) in [(4326, 2e-6), (4269, 2e-6), (3857, 0.31), (26910, 0.27), (2927, 0.9)] {
        let spec = CrsSpec::from_epsg(epsg);
        let placement = Placement::of(&spec, None).unwrap();
        let middle = placement.projection.forward(SEATTLE).unwrap();
        let (west, north) = (middle.x - 200.0 * step, middle.y + 200.0 * step);
        let geotransform = GeoTransform::north_up(west, north, step, step);
        let path = folder.path().join(format!("{epsg}.tif"));
        write(&path, epsg, geotransform, (400, 400), None, |c, r| c as f32 * 0.25 - r as f32 * 0.5);
        let raster = open(&path);
        assert_eq!(raster.header().crs.as_ref().unwrap().epsg, Some(epsg));
        let found = raster.on_grid(&grid, Resampling::Bilinear, EdgeRule::Renormalise).unwrap();
        let mut worst: f64 = 0.0;
        for (k, found) in found.iter().enumerate() {
            let centre = PixelPoint { x: (k % 96) as f64 + 0.5, y: (k / 96) as f64 + 0.5 };
            let at = placement.projection.forward(grid.lonlat(centre)).unwrap();
            let cell = geotransform.to_pixel(at);
            let expected = (cell.x - 0.5) * 0.25 - (cell.y - 0.5) * 0.5;
            worst = worst.max((f64::from(*found) - expected).abs());
        }
        // A micrometre of position, an f32 of height 200.
        assert!(worst < 3e-5, "EPSG:{epsg}: {worst}");
    }
}

#[test]
fn stated_feet_become_metres_and_classes_stay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    let grid = grid(8);
    let feet = Some(LinearUnit::UsSurveyFoot);
    write(&path, 3857, grid.geotransform(), (8, 8), feet, |c, _| c as f32);
    let heights = open(&path).on_grid(&grid, Resampling::Nearest, EdgeRule::Strict).unwrap();
    assert!((f64::from(heights[5]) - 5.0 * 1200.0 / 3937.0).abs() < 1e-7);
    let classes =
        open(&path).without_unit().on_grid(&grid, Resampling::Nearest, EdgeRule::Strict).unwrap();
    assert_eq!(classes[5], 5.0);
    // Without a statement: metres, and a warning where coordinates are in feet.
    let step = GeoTransform::north_up(1_270_000.0, 230_000.0, 3.0, 3.0);
    write(&path, 2927, step, (8, 8), None, |c, _| c as f32);
    assert!(open(&path).warnings().iter().any(|w| w.contains("taken as metres")));
}

#[test]
fn another_part_of_the_world_has_no_heights() {
    let folder = tempfile::tempdir().unwrap();
    let far = [(-122.3, -47.6), (57.7, 47.6), (57.7, -47.6), (0.0, 0.0)];
    for epsg in [26_910, 3857, 4326] {
        let path = folder.path().join(format!("{epsg}.tif"));
        let placement = Placement::of(&CrsSpec::from_epsg(epsg), None).unwrap();
        let middle = placement.projection.forward(SEATTLE).unwrap();
        let step = if epsg == 4326 { 1e-5 } else { 1.0 };
        let geotransform = GeoTransform::north_up(middle.x, middle.y, step, step);
        write(&path, epsg, geotransform, (50, 50), None, |_, _| 7.0);
        let raster = open(&path);
        for (lon_deg, lat_deg) in far {
            let grid = ImageGrid::new(LonLat { lon_deg, lat_deg }, 20, 32, 32).unwrap();
            let found = raster.on_grid(&grid, Resampling::Cubic, EdgeRule::Renormalise).unwrap();
            assert!(found.iter().all(|v| v.is_nan()), "EPSG:{epsg} at {lon_deg} {lat_deg}");
        }
    }
}

#[test]
fn what_cannot_be_placed_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.tif");
    let refuse = |crs: Option<&str>| {
        let error = SingleRaster::open(&path, &OpenOptions::default(), crs).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("mask.tif"), "{text}");
        text
    };
    let plain = GeoTransform::north_up(500_000.0, 5_000_000.0, 1.0, 1.0);
    write(&path, 0, plain, (4, 4), None, |_, _| 1.0);
    assert!(refuse(None).contains("no coordinate system"));
    // The CRS can be stated instead.
    SingleRaster::open(&path, &OpenOptions::default(), Some("EPSG:32610")).unwrap();
    assert!(refuse(Some("EPSG:4267")).contains("another datum"));
    assert!(refuse(Some("nonsense")).contains("nonsense"));
    let rotated = GeoTransform([500_000.0, 1.0, 0.1, 5_000_000.0, 0.1, -1.0]);
    write(&path, 32_610, rotated, (4, 4), None, |_, _| 1.0);
    assert!(refuse(None).contains("rotated"));
    std::fs::write(&path, b"no raster").unwrap();
    refuse(None);
    std::fs::remove_file(&path).unwrap();
    refuse(None);
}

#[test]
fn web_mercator_is_the_grids_own_projection_and_inverts() {
    let grid = grid(640);
    for (x, y) in [(0.5, 0.5), (320.0, 17.25), (640.0, 640.0), (-3000.0, 9000.0)] {
        let p = PixelPoint { x, y };
        let (at, expected) = (grid.lonlat(p), grid.mercator(p));
        let found = SphericalMercator.forward(at).unwrap();
        assert!((found.x - expected.x).abs() < 5e-9 && (found.y - expected.y).abs() < 2e-8);
        let back = SphericalMercator.inverse(found).unwrap();
        assert!((back.lon_deg - at.lon_deg).abs() < 1e-12);
        assert!((back.lat_deg - at.lat_deg).abs() < 1e-12);
    }
    for lat_deg in [90.0, -90.0, f64::NAN] {
        assert!(SphericalMercator.forward(LonLat { lon_deg: 0.0, lat_deg }).is_err());
    }
}
