#![allow(clippy::unwrap_used, reason = "a test may fail")]
use super::*;
use crate::footprint::Footprint;
use crate::grid::{ImageGrid, LonLat};
use crate::raster::geotiff::encode_cog;
use crate::raster::{OpenOptions, RasterReader, TiffReader};
use crate::tile::city::{Along, Levels};
use crate::tile::slabs::{FOLDER, Kind};

/// A city of `size` model pixels at zoom 18 in Seattle.
fn city(size: [u32; 2], along: Along) -> City {
    let center = LonLat { lon_deg: -122.33, lat_deg: 47.6 };
    let grid = ImageGrid::new(center, 20, size[0] * 5 / 2, size[1] * 5 / 2).unwrap();
    City {
        size,
        footprint: Footprint::of_grid(grid),
        assumed: false,
        levels: Levels { z: vec![-0.5, 0.5], ends: [-1.0, 1.0] },
        vertical_m: 32.24,
        along,
    }
}

/// Hills, houses, and a hole.
fn height(x: u32, y: u32) -> f32 {
    let hole = (200..230).contains(&x) && (90..100).contains(&y);
    let house = if x % 40 < 15 && y % 30 < 12 { 8.0 } else { 0.0 };
    if hole { f32::NAN } else { 0.01 * x as f32 + (y % 97) as f32 * 0.05 + house }
}

fn write_slabs(city: &City, out: &Path) -> Vec<f32> {
    std::fs::create_dir_all(out.join(FOLDER)).unwrap();
    let slabs = Slabs { city, out };
    for slab in 0..city.slabs() {
        let [columns, rows] = city.rectangle(slab);
        let pixels = rows.flat_map(|y| columns.clone().map(move |x| height(x, y)));
        let bytes: Vec<u8> = pixels.flat_map(f32::to_le_bytes).collect();
        std::fs::write(slabs.path(slab, Kind::Heights), bytes).unwrap();
    }
    (0..city.size[1]).flat_map(|y| (0..city.size[0]).map(move |x| height(x, y))).collect()
}

fn options() -> DsmOptions {
    DsmOptions { name: "city.tif".into(), preview: true, ..DsmOptions::default() }
}

fn read(path: &Path) -> (crate::raster::RasterHeader, Vec<f32>) {
    let mut reader = TiffReader::open(path, &OpenOptions::default()).unwrap();
    let header = reader.header().clone();
    let (width, height) = (header.width as usize, header.height as usize);
    let mut all = vec![f32::NAN; width * height];
    let mut block = Vec::new();
    for by in 0..height.div_ceil(256) {
        for bx in 0..width.div_ceil(256) {
            reader.read_block(bx as u32, by as u32, &mut block).unwrap();
            for (row, values) in block.chunks_exact(256).enumerate() {
                let n = 256.min(width - bx * 256);
                let start = (by * 256 + row) * width + bx * 256;
                all[start..start + n].copy_from_slice(&values[..n]);
            }
        }
    }
    (header, all)
}

#[test]
fn the_dsm_is_the_slabs_whichever_way_they_lie() {
    let mut files = Vec::new();
    for along in [Along::X, Along::Y] {
        let folder = tempfile::tempdir().unwrap();
        let city = city([600, 400], along);
        let heights = write_slabs(&city, folder.path());
        let slabs = Slabs { city: &city, out: folder.path() };
        let windows = Windows::of_starts(&[0, 128, 256, 344], &[0, 128, 144], 256);
        let options = DsmOptions { windows: Some(windows.clone()), ..options() };
        let mut seen = Vec::new();
        let file = write_dsm(&slabs, &options, &mut |done, all| seen.push((done, all))).unwrap();
        assert_eq!(seen, [(256, 400), (400, 400)]);

        let grid = DsmGrid::new(&city, None).unwrap();
        let expected = encode_cog(&heights, &cog_spec(&city, &grid, &[]));
        let bytes = std::fs::read(folder.path().join("city.tif")).unwrap();
        assert!(bytes == expected);
        assert_eq!(file.dsm, OutputFile::of("city.tif", &bytes));
        let preview = file.preview.clone().unwrap();
        assert_eq!(preview.file, "city_dsm_preview.png");
        assert!(preview.holds(folder.path(), crate::batch::Verify::Hashes));

        assert_eq!((file.size_px, file.empty_px), ([600, 400], 300));
        assert_eq!(file.geotransform, city.grid().unwrap().geotransform);
        let valid: Vec<f32> = heights.iter().copied().filter(|h| !h.is_nan()).collect();
        let high = valid.iter().copied().fold(0.0, f32::max);
        assert_eq!((file.min_m, file.max_m), (Some(0.0), Some(f64::from(high))).clone());
        let mean = valid.iter().map(|h| f64::from(*h)).sum::<f64>() / valid.len() as f64;
        assert!((file.mean_m.unwrap() - mean).abs() < 1e-9);
        let mut seams = SeamCounter::new([600, 400], &windows);
        seams.add(&heights);
        assert_eq!(file.seams, Some(seams.finish()));
        assert!(file.warnings.is_empty());
        files.push((bytes, serde_json::to_string(&file).unwrap()));
    }
    assert!(files[0] == files[1]);
}

#[test]
fn the_file_says_what_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let city = city([300, 280], Along::X);
    write_slabs(&city, folder.path());
    let metadata = vec![("BLEND".to_owned(), "mean".to_owned())];
    let options = DsmOptions { metadata, preview: false, ..options() };
    let slabs = Slabs { city: &city, out: folder.path() };
    let file = write_dsm(&slabs, &options, &mut |_, _| {}).unwrap();
    assert_eq!((file.preview, file.seams), (None, None));
    let (header, _) = read(&folder.path().join("city.tif"));
    assert_eq!(header.crs.and_then(|crs| crs.epsg), Some(3857));
    assert!(header.nodata.is_some_and(f64::is_nan));
    assert_eq!(header.vertical_unit.map(|unit| unit.0), Some(LinearUnit::Metre));
    assert_eq!(header.overviews, 1);
    let bytes = std::fs::read(folder.path().join("city.tif")).unwrap();
    let text = String::from_utf8_lossy(&bytes);
    for item in ["\"BLEND\">mean<", "\"METRES_PER_UNIT\">64.48<", "VERTICAL_DATUM\">none:"] {
        assert!(text.contains(item), "{item}");
    }
    // Slabs and the DSM, nothing that was left over.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn a_city_without_a_place_is_in_metres_from_its_corner() {
    let folder = tempfile::tempdir().unwrap();
    let footprint = Footprint::of_gsd([600, 400], [0.5, 0.4]);
    let city = City { size: [300, 200], footprint, ..city([300, 200], Along::X) };
    write_slabs(&city, folder.path());
    let slabs = Slabs { city: &city, out: folder.path() };
    let file = write_dsm(&slabs, &options(), &mut |_, _| {}).unwrap();
    let (header, _) = read(&folder.path().join("city.tif"));
    assert_eq!((header.crs, file.crs), (None, None));
    assert_eq!(header.geotransform, GeoTransform::north_up(0.0, 0.0, 1.0, 0.8));
    assert!(file.warnings[0].contains("north-west corner"));
    let t_srs = Some(CrsSpec::from_epsg(32610));
    let error = write_dsm(&slabs, &DsmOptions { t_srs, ..options() }, &mut |_, _| {});
    assert!(matches!(error, Err(DsmError::NoPlace)));
}

/// Bilinear interpolation as it is defined, by one projection per pixel.
#[test]
fn another_crs_is_a_projection_of_every_pixel() {
    use crate::grid::PixelPoint;
    use crate::lidar::Placement;
    for (code, along) in [(32610, Along::X), (2927, Along::Y), (4326, Along::X)] {
        let folder = tempfile::tempdir().unwrap();
        let city = city([520, 300], along);
        write_slabs(&city, folder.path());
        let slabs = Slabs { city: &city, out: folder.path() };
        let crs = CrsSpec::from_epsg(code);
        let windows = Some(Windows::of_starts(&[0, 264], &[0, 44], 256));
        let options = DsmOptions { t_srs: Some(crs.clone()), windows, ..options() };
        let mut last = (0, 0);
        let file = write_dsm(&slabs, &options, &mut |done, all| last = (done, all)).unwrap();
        assert_eq!(last, (u64::from(file.size_px[1]) + 300, u64::from(file.size_px[1]) + 300));
        let own = DsmOptions { t_srs: None, name: "own.tif".into(), ..options.clone() };
        let own = write_dsm(&slabs, &own, &mut |_, _| {}).unwrap();
        assert_eq!(file.seams, own.seams);

        let (header, heights) = read(&folder.path().join("city.tif"));
        assert_eq!(header.crs.and_then(|crs| crs.epsg), Some(code));
        let (to, grid) = (Placement::of(&crs, None).unwrap(), city.grid().unwrap());
        let from = Placement::of(&grid.crs, None).unwrap();
        let cell = |x: i64, y: i64| match (u32::try_from(x), u32::try_from(y)) {
            (Ok(x), Ok(y)) if x < 520 && y < 300 => f64::from(height(x, y)),
            _ => f64::NAN,
        };
        let (mut valid, mut worst, mut other) = (0, 0.0_f64, 0);
        for (k, value) in heights.iter().enumerate() {
            let (x, y) = (k % file.size_px[0] as usize, k / file.size_px[0] as usize);
            let centre = PixelPoint { x: x as f64 + 0.5, y: y as f64 + 0.5 };
            let at = to.projection.inverse(file.geotransform.to_projected(centre)).unwrap();
            let p = grid.geotransform.to_pixel(from.projection.forward(at).unwrap());
            let (left, top) = ((p.x - 0.5).floor(), (p.y - 0.5).floor());
            let (fx, fy) = (p.x - 0.5 - left, p.y - 0.5 - top);
            let (mut sum, mut weight) = (0.0, 0.0);
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let value = cell(left as i64 + dx, top as i64 + dy);
                let w = if dx == 0 { 1.0 - fx } else { fx } * if dy == 0 { 1.0 - fy } else { fy };
                if !value.is_nan() {
                    (sum, weight) = (sum + w * value, weight + w);
                }
            }
            let hole = cell(p.x.floor() as i64, p.y.floor() as i64).is_nan();
            let expected = if hole { f64::NAN } else { sum / weight };
            match value.is_nan() == expected.is_nan() {
                true if hole => {}
                true => {
                    valid += 1;
                    worst = worst.max((f64::from(*value) - expected).abs());
                }
                // The border of the city lies within rounding of a pixel's centre.
                false => other += 1,
            }
        }
        eprintln!("EPSG:{code}: {valid} pixels, worst {worst:.2e} m, {other} others");
        assert!(worst < 1e-4 && other <= 4, "EPSG:{code}: {worst} {other}");
        // As many pixels as before, within a percent, and as large on the ground.
        let ratio = f64::from(valid) / (520.0 * 300.0 - 300.0);
        assert!((ratio - 1.0).abs() < 0.01, "EPSG:{code}: {ratio}");
        let [across, down] = city.gsd_m();
        assert!((file.gsd_m[0] - (across * down).sqrt()).abs() < 1e-12);
        // Nothing of the city is cut off.
        for corner in [(0.0, 0.0), (520.0, 0.0), (0.0, 300.0), (520.0, 300.0)] {
            let at = grid.geotransform.to_projected(PixelPoint { x: corner.0, y: corner.1 });
            let at = to.projection.forward(from.projection.inverse(at).unwrap()).unwrap();
            let p = file.geotransform.to_pixel(at);
            let inside = |v: f64, size: u32| v > -1e-5 && v < f64::from(size) + 1e-5;
            assert!(inside(p.x, file.size_px[0]) && inside(p.y, file.size_px[1]), "{p:?}");
        }
    }
}

#[test]
fn the_picture_s_own_crs_changes_nothing_and_bad_ones_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let city = city([300, 200], Along::X);
    write_slabs(&city, folder.path());
    let slabs = Slabs { city: &city, out: folder.path() };
    let with = |t_srs| write_dsm(&slabs, &DsmOptions { t_srs, ..options() }, &mut |_, _| {});
    let own = with(None).unwrap();
    assert_eq!(with(Some(CrsSpec::from_epsg(3857))).unwrap(), own);
    let compound = CrsSpec::from_user_input("EPSG:2927+5703").unwrap();
    assert!(matches!(with(Some(compound)), Err(DsmError::Vertical { .. })));
    let error = with(Some(CrsSpec::from_epsg(4277))).unwrap_err().to_string();
    assert!(error.contains("another datum"), "{error}");
    // What was there stays.
    assert!(own.dsm.holds(folder.path(), crate::batch::Verify::Hashes));
}

#[test]
fn a_missing_slab_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let city = city([300, 600], Along::Y);
    write_slabs(&city, folder.path());
    let slabs = Slabs { city: &city, out: folder.path() };
    std::fs::write(slabs.path(1, Kind::Heights), [0; 100]).unwrap();
    for t_srs in [None, Some(CrsSpec::from_epsg(32610))] {
        let error = write_dsm(&slabs, &DsmOptions { t_srs, ..options() }, &mut |_, _| {});
        let error = error.unwrap_err().to_string();
        assert!(error.contains("00001.heights"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

#[test]
fn pictures_are_named_after_their_dsm() {
    assert_eq!(preview_name("city.tif"), "city_dsm_preview.png");
    assert_eq!(preview_name("a/city_dsm.tiff"), "a/city_dsm_preview.png");
}
