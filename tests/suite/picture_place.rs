//! Where a picture lies and how large it is on the ground, by its name, its side files and its own georeference.

#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::picture::{noise, write_png};
use sat3d::footprint::{Footprint, FootprintError, Place};
use sat3d::grid::{GeoTransform, ImageGrid, LonLat};
use sat3d::picture::{PictureError, open};

fn seattle() -> LonLat {
    LonLat { lon_deg: -122.33, lat_deg: 47.6 }
}

#[test]
fn a_name_places_a_picture_and_a_bad_one_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let image = noise(64, 64, 3, 1);
    let at = |name: &str| {
        let path = folder.path().join(name);
        write_png(&path, &image);
        open(&path).unwrap()
    };
    let picture = at("satellite_47.6_-122.33.png");
    let grid = ImageGrid::new(seattle(), 20, 64, 64).unwrap();
    assert_eq!(picture.place(), Some(&Place::WebMercator(grid)));
    let footprint = picture.footprint(None).unwrap();
    assert_eq!(footprint, Footprint::of_grid(grid));
    let stated = picture.footprint(Some([0.2, 0.3])).unwrap();
    assert_eq!((stated.gsd_m, stated.place), ([0.2, 0.3], footprint.place));
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(picture.footprint(Some([0.1, bad])), Err(PictureError::Gsd { .. })));
    }
    let nowhere = at("satellite_95_10.png");
    assert_eq!(nowhere.place(), None);
    assert!(nowhere.warnings()[0].contains("latitude `95`"), "{:?}", nowhere.warnings());
    let plain = at("plain.png");
    assert!(plain.place().is_none() && plain.warnings().is_empty());
    assert_eq!(plain.footprint(None).unwrap(), Footprint::of_training([64, 64]));
}

#[test]
fn a_name_states_the_centre_and_a_side_file_the_size_of_other_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("satellite_47.6_-122.33.png");
    write_png(&path, &noise(64, 64, 3, 1));
    let vigor = ImageGrid::new(seattle(), 20, 640, 640).unwrap();
    let side_file = |metres_aside: f64, factor: f64| {
        let GeoTransform([x, width, _, y, _, height]) = vigor.geotransform();
        // Around the same centre, whatever the pixels.
        let west = x + 320.0 * width - 32.0 * factor * width + metres_aside;
        let north = y + 320.0 * height - 32.0 * factor * height;
        let (width, height) = (width * factor, height * factor);
        std::fs::write(
            folder.path().join("satellite_47.6_-122.33.pgw"),
            format!("{width}\n0\n0\n{height}\n{}\n{}\n", west + width / 2.0, north + height / 2.0),
        )
        .unwrap();
        let picture = open(&path).unwrap();
        let warnings = picture.warnings().join("; ");
        (picture.footprint(None).unwrap(), warnings)
    };
    let wkt = "PROJCS[\"WGS 84 / Pseudo-Mercator\",GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563]],PRIMEM[\"Greenwich\",0],UNIT[\"degree\",0.0174532925199433]],PROJECTION[\"Mercator_1SP\"],PARAMETER[\"central_meridian\",0],PARAMETER[\"scale_factor\",1],PARAMETER[\"false_easting\",0],PARAMETER[\"false_northing\",0],UNIT[\"metre\",1],AUTHORITY[\"EPSG\",\"3857\"]]";
    std::fs::write(folder.path().join("satellite_47.6_-122.33.prj"), wkt).unwrap();
    let of_name = Footprint::of_grid(ImageGrid::new(seattle(), 20, 64, 64).unwrap());
    // 64 pixels of an image that was 640: ten times as large.
    let (resized, warnings) = side_file(0.0, 10.0);
    assert!((resized.gsd_m[0] / of_name.gsd_m[0] - 10.0).abs() < 1e-6, "{resized:?}");
    assert!(
        matches!(resized.place, Some(Place::Raster { .. })) && warnings.is_empty(),
        "{warnings}"
    );
    let (same, warnings) = side_file(0.0, 1.0);
    assert_eq!((same, warnings.as_str()), (of_name.clone(), ""));
    let (elsewhere, warnings) = side_file(50.0, 10.0);
    assert_eq!(elsewhere, of_name);
    assert!(warnings.contains("m apart; the name counts"), "{warnings}");
}

#[test]
fn side_files_place_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    write_png(&path, &noise(20, 10, 3, 1));
    let world = folder.path().join("a.pgw");
    std::fs::write(&world, "0.5\n0\n0\n-0.25\n500000.25\n5270000.0\n").unwrap();
    let picture = open(&path).unwrap();
    assert!(picture.place().is_none());
    assert!(picture.warnings()[0].contains("no coordinate reference system"));

    let wkt = "PROJCS[\"WGS 84 / UTM zone 10N\",GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563]],PRIMEM[\"Greenwich\",0],UNIT[\"degree\",0.0174532925199433]],PROJECTION[\"Transverse_Mercator\"],PARAMETER[\"latitude_of_origin\",0],PARAMETER[\"central_meridian\",-123],PARAMETER[\"scale_factor\",0.9996],PARAMETER[\"false_easting\",500000],PARAMETER[\"false_northing\",0],UNIT[\"metre\",1],AUTHORITY[\"EPSG\",\"32610\"]]";
    std::fs::write(folder.path().join("a.prj"), wkt).unwrap();
    let picture = open(&path).unwrap();
    let Some(Place::Raster { geotransform, crs }) = picture.place() else { panic!("{picture:?}") };
    assert_eq!(*geotransform, GeoTransform::north_up(500_000.0, 5_270_000.125, 0.5, 0.25));
    assert_eq!(crs.epsg, Some(32610));
    let [x, y] = picture.footprint(None).unwrap().gsd_m;
    // On the central meridian the map is 0.9996 as large as the ground.
    assert!((x - 0.5 / 0.9996).abs() < 1e-7 && (y - 0.25 / 0.9996).abs() < 1e-7, "{x} {y}");

    // GDAL's own side file counts first; its grid may be one that is refused.
    let quoted = wkt.replace('"', "&quot;");
    let text = format!(
        "<PAMDataset>\n  <SRS dataAxisToSRSAxisMapping=\"1,2\">{quoted}</SRS>\n  \
         <GeoTransform>  1.0,  0.5, 0.1,  2.0, -0.1, -0.5</GeoTransform>\n</PAMDataset>\n"
    );
    std::fs::write(folder.path().join("a.png.aux.xml"), text).unwrap();
    let error = open(&path).unwrap().footprint(None).unwrap_err().to_string();
    assert!(
        error.contains("rotated") && error.contains("0.1") && error.contains("a.png"),
        "{error}"
    );
    std::fs::write(folder.path().join("a.png.aux.xml"), "<GeoTransform>1, 2</GeoTransform>")
        .unwrap();
    let error = open(&path).unwrap_err().to_string();
    assert!(error.contains("`1, 2` in place of six numbers"), "{error}");
}

/// Ground metres per pixel, by differences of what the georeference says, on the ellipsoid.
fn measured(footprint: &Footprint) -> [f64; 2] {
    let way = footprint.georeference().unwrap().unwrap();
    let ends = |a: [f64; 2], b: [f64; 2]| {
        let (a, b) = (way.lonlat_of_crop(a).unwrap(), way.lonlat_of_crop(b).unwrap());
        let earth = sat3d::crs::Ellipsoid::WGS84;
        let lat = 0.5 * (a.lat_deg + b.lat_deg);
        let east = (a.lon_deg - b.lon_deg).to_radians() * earth.parallel_radius(lat);
        let north = (a.lat_deg - b.lat_deg).to_radians() * earth.meridian_radius(lat);
        libm::hypot(east, north)
    };
    let step = 0.01;
    let across = ends([0.0, -step], [0.0, step]) / (step * f64::from(footprint.size_px[0]));
    let down = ends([-step, 0.0], [step, 0.0]) / (step * f64::from(footprint.size_px[1]));
    [across, down]
}

#[test]
fn ground_distances_hold_in_every_kind_of_crs() {
    use sat3d::crs::CrsSpec;
    let place = |epsg, geotransform| Place::Raster { geotransform, crs: CrsSpec::from_epsg(epsg) };
    let grid = GeoTransform::north_up;
    let mut cases = vec![
        (place(32610, grid(550_000.0, 5_270_000.0, 0.25, 0.5)), 1e-6),
        // US survey feet.
        (place(2285, grid(1_270_000.0, 225_000.0, 1.0, 1.0)), 1e-6),
        (place(4326, grid(-122.33, 47.6, 1e-6, 2e-6)), 1e-6),
        // The cosine is that of the sphere: up to 0.7 % from the ellipsoid.
        (place(3857, grid(-13_617_000.0, 6_041_000.0, 0.15, 0.15)), 7e-3),
        (Place::WebMercator(ImageGrid::new(seattle(), 20, 640, 640).unwrap()), 7e-3),
    ];
    if cfg!(feature = "proj") {
        // Dutch RD, which has no closed form here; its datum step goes back to half a millimetre.
        cases.push((place(28992, grid(120_000.0, 487_000.0, 0.25, 0.25)), 1e-6));
    }
    for (place, tolerance) in cases {
        let footprint = Footprint::of_place([640, 640], place.clone()).unwrap();
        for (stated, found) in footprint.gsd_m.into_iter().zip(measured(&footprint)) {
            assert!((stated / found - 1.0).abs() < tolerance, "{place:?}: {stated} {found}");
        }
        let way = footprint.georeference().unwrap().unwrap();
        for crop in [[0.0, 0.0], [-1.0, 1.0], [0.3, -0.7]] {
            let there = way.lonlat_of_crop(crop).unwrap();
            let back = footprint.crop_of_lonlat(there).unwrap();
            let apart = (back[0] - crop[0]).abs().max((back[1] - crop[1]).abs());
            assert!(apart < 1e-5, "{place:?}: {crop:?} {back:?}");
        }
        let [row, column] = footprint
            .crop_of_lonlat({
                let center = way.center().unwrap();
                LonLat { lon_deg: center.lon_deg + 1e-5, lat_deg: center.lat_deg + 1e-5 }
            })
            .unwrap();
        assert!(row < 0.0 && column > 0.0, "north is up and east is right: {row} {column}");
    }
}

#[test]
fn a_web_mercator_raster_is_the_image_that_a_name_states() {
    let grid = ImageGrid::new(seattle(), 20, 640, 640).unwrap();
    let named = Footprint::of_grid(grid);
    let crs = sat3d::crs::CrsSpec::from_epsg(3857);
    let place = Place::Raster { geotransform: grid.geotransform(), crs };
    let raster = Footprint::of_place([640, 640], place).unwrap();
    assert!((raster.gsd_m[0] / named.gsd_m[0] - 1.0).abs() < 1e-12);
    let at = LonLat { lon_deg: -122.3301, lat_deg: 47.6002 };
    let (a, b) = (raster.crop_of_lonlat(at).unwrap(), named.crop_of_lonlat(at).unwrap());
    assert!((a[0] - b[0]).abs() < 1e-7 && (a[1] - b[1]).abs() < 1e-7, "{a:?} {b:?}");
    let (a, b) = (raster.dsm_grid(256).unwrap(), named.dsm_grid(256).unwrap());
    assert_eq!(a, b);
    assert_eq!((a.size_px, a.crs.epsg), ([256, 256], Some(3857)));
    let corner = |g: GeoTransform, n: f64| g.to_projected(sat3d::grid::PixelPoint { x: n, y: n });
    let (far, expected) = (corner(a.geotransform, 256.0), corner(grid.geotransform(), 640.0));
    assert!((far.x - expected.x).abs() < 1e-8 && (far.y - expected.y).abs() < 1e-8);
    assert_eq!(Footprint::of_training([8, 8]).dsm_grid(256), None);
}

#[test]
fn places_that_cannot_be_are_refused() {
    use sat3d::crs::CrsSpec;
    let refused = |epsg, grid| {
        let place =
            Place::Raster { geotransform: GeoTransform(grid), crs: CrsSpec::from_epsg(epsg) };
        Footprint::of_place([10, 10], place).unwrap_err()
    };
    let rotated = refused(32610, [5e5, 0.5, 0.1, 5e6, 0.1, -0.5]);
    assert!(matches!(&rotated, FootprintError::Grid { reason } if reason.contains("rotated")));
    let mirrored = refused(32610, [5e5, 0.5, 0.0, 5e6, 0.0, 0.5]);
    assert!(matches!(&mirrored, FootprintError::Grid { reason } if reason.contains("south up")));
    assert!(matches!(
        refused(32610, [f64::NAN, 0.5, 0.0, 5e6, 0.0, -0.5]),
        FootprintError::Grid { .. }
    ));
    assert!(matches!(
        refused(4326, [500.0, 0.1, 0.0, 47.0, 0.0, -0.1]),
        FootprintError::OffEarth { .. }
    ));
}
