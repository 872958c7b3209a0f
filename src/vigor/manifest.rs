//! The manifest: one row per pair of a panorama and a satellite image; and the layers of the
//! GeoPackage, one row per panorama and one per satellite image.

use super::dataset::{Dataset, Pair, Panorama};
use super::kinds::{ImageStatus, LabelKind, Split};
use super::measure::{Measured, Residual};
use crate::grid::{ImageGrid, PixelPoint};
use crate::table::{Column, Table, TableError, wkb};
use std::collections::HashSet;

/// Makes the table. The geometry is the panorama's true position.
///
/// # Errors
/// [`TableError`] never occurs for data that [`Dataset::read`] made; it is passed on.
pub fn table(dataset: &Dataset, measured: &[Measured]) -> Result<Table, TableError> {
    let pairs = &dataset.pairs;
    let panorama = |p: &Pair| &dataset.panoramas[p.panorama as usize];
    let satellite = |p: &Pair| &dataset.satellites[p.satellite as usize];
    let file = |p: &Pair| &dataset.files[p.file as usize];
    let owned = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<String>>();
    let number = |name, description, of: &dyn Fn(&Pair, &Measured) -> Option<f64>| {
        Column::f64(name, description, pairs.iter().zip(measured).map(|(p, m)| of(p, m)))
    };
    let count = |name, description, of: &dyn Fn(&Pair, &Measured) -> Option<i64>| {
        Column::i64(name, description, pairs.iter().zip(measured).map(|(p, m)| of(p, m)))
    };
    let word = |name, description, values, of: &dyn Fn(&Pair) -> Option<u32>| {
        Column::dictionary(name, description, values, pairs.iter().map(of))
    };
    let statuses = owned(&ImageStatus::ALL.map(ImageStatus::name));
    let kinds = owned(&LabelKind::ALL.map(LabelKind::name));
    let splits = owned(&Split::EACH.map(Split::name));
    let files = dataset.files.iter().map(|f| f.file.clone()).collect();
    let panoramas = dataset.panoramas.iter().map(|p| p.name.clone()).collect();
    let satellites = dataset.satellites.iter().map(|s| s.name.clone()).collect();
    Table::new(vec![
        word("city", "City", dataset.cities.clone(), &|p| Some(panorama(p).city)),
        word("split", "Part of the data by the file's name: train, val, test, all", splits, &|p| {
            Some(file(p).split as u32)
        }),
        word("labels", "Kind of labels: original, corrected, sat3dgen", kinds, &|p| {
            file(p).labels.map(|kind| kind as u32)
        }),
        word("file", "File of the line, from the root", files, &|p| Some(p.file)),
        count("line", "Line in the file, from 1", &|p, _| Some(p.line.into())),
        word("role", "positive or semi", owned(&["positive", "semi"]), &|p| {
            Some(u32::from(!p.is_positive()))
        }),
        count(
            "rank",
            "Place in the line: 0 is the positive, 1 to 3 the semi-positives",
            &|p, _| Some(p.rank.into()),
        ),
        word("panorama", "Panorama, file name", panoramas, &|p| Some(p.panorama)),
        number("pano_lat", "Latitude of the panorama, degrees (WGS 84)", &|p, _| {
            Some(panorama(p).position.lat_deg)
        }),
        number("pano_lon", "Longitude of the panorama, degrees (WGS 84)", &|p, _| {
            Some(panorama(p).position.lon_deg)
        }),
        word("satellite", "Satellite image, file name", satellites, &|p| Some(p.satellite)),
        number("sat_lat", "Latitude of the image's centre, degrees (WGS 84)", &|p, _| {
            Some(satellite(p).grid.center().lat_deg)
        }),
        number("sat_lon", "Longitude of the image's centre, degrees (WGS 84)", &|p, _| {
            Some(satellite(p).grid.center().lon_deg)
        }),
        number("label_d0", "Label: pixels that the panorama lies south of the centre", &|p, _| {
            p.offset.map(|o| o[0])
        }),
        number("label_d1", "Label: pixels that the panorama lies west of the centre", &|p, _| {
            p.offset.map(|o| o[1])
        }),
        number("x_px", "Exact Web-Mercator column; the first pixel's centre is 0.5", &|_, m| {
            Some(m.pixel.x)
        }),
        number("y_px", "Exact Web-Mercator row; the first pixel's centre is 0.5", &|_, m| {
            Some(m.pixel.y)
        }),
        count("utm_d0", "d0 by the UTM formula of the corrected labels", &|_, m| {
            m.utm.map(|utm| utm[0])
        }),
        count("utm_d1", "d1 by the UTM formula of the corrected labels", &|_, m| {
            m.utm.map(|utm| utm[1])
        }),
        Column::bool(
            "reproduced",
            "Whether the label is what the UTM formula gives",
            measured.iter().map(|m| m.reproduced),
        ),
        number("residual_x_px", "Label minus exact pixel, pixels to the east", &|_, m| {
            m.residual.map(|r| r.x_px)
        }),
        number("residual_y_px", "Label minus exact pixel, pixels to the south", &|_, m| {
            m.residual.map(|r| r.y_px)
        }),
        number("residual_px", "Length of label minus exact pixel, pixels", &|_, m| {
            m.residual.map(|r| r.px)
        }),
        number("residual_m", "The same on the ground, metres (WGS 84 ellipsoid)", &|_, m| {
            m.residual.map(|r| r.metres)
        }),
        Column::bool(
            "inside",
            "Whether the panorama lies inside the image",
            measured.iter().map(|m| m.inside),
        ),
        word(
            "satellite_status",
            "Satellite image file: ok, found (not looked into), missing, bad, unchecked (no folder)",
            statuses.clone(),
            &|p| Some(satellite(p).status as u32),
        ),
        word("panorama_status", "Panorama file, as satellite_status", statuses, &|p| {
            Some(panorama(p).status as u32)
        }),
        word("sky_mask", "Sky mask as the split file names it", dataset.sky_masks.clone(), &|p| {
            p.sky_mask
        }),
        Column::geometry(
            "geometry",
            "True position of the panorama, longitude and latitude (WGS 84)",
            pairs.iter().map(|p| {
                let at = panorama(p).position;
                wkb::point(at.lon_deg, at.lat_deg)
            }),
        ),
    ])
}

/// One row per panorama and kind of labels, with what its positive says. The geometry is the
/// panorama's true position.
///
/// # Errors
/// As [`table`].
pub fn panorama_layer(dataset: &Dataset, measured: &[Measured]) -> Result<Table, TableError> {
    let file = |p: &Pair| &dataset.files[p.file as usize];
    let mut seen = HashSet::new();
    let rows: Vec<(&Pair, &Measured)> = dataset
        .pairs
        .iter()
        .zip(measured)
        .filter(|(p, _)| p.is_positive() && seen.insert((p.panorama, file(p).labels)))
        .collect();
    let panoramas = || rows.iter().map(|(p, _)| &dataset.panoramas[p.panorama as usize]);
    let residual = |of: fn(&Residual) -> f64| {
        rows.iter().map(|(_, m)| m.residual.as_ref().map(of)).collect::<Vec<_>>()
    };
    let city = |p: &Panorama| dataset.cities[p.city as usize].clone();
    Table::new(vec![
        Column::text("city", "City", panoramas().map(city)),
        Column::text("panorama", "File name", panoramas().map(|p| p.name.clone())),
        Column::text(
            "labels",
            "Kind of labels",
            rows.iter().map(|(p, _)| file(p).labels.map_or("", LabelKind::name)),
        ),
        Column::text("split", "Part of the data", rows.iter().map(|(p, _)| file(p).split.name())),
        Column::text(
            "satellite",
            "Positive satellite image",
            rows.iter().map(|(p, _)| dataset.satellites[p.satellite as usize].name.clone()),
        ),
        Column::f64("x_px", "Exact column in it", rows.iter().map(|(_, m)| m.pixel.x)),
        Column::f64("y_px", "Exact row in it", rows.iter().map(|(_, m)| m.pixel.y)),
        Column::f64("residual_x_px", "Label minus exact pixel, to the east", residual(|r| r.x_px)),
        Column::f64("residual_y_px", "Label minus exact pixel, to the south", residual(|r| r.y_px)),
        Column::f64("residual_m", "Its length on the ground, metres", residual(|r| r.metres)),
        Column::text("status", "Image file", panoramas().map(|p| p.status.name())),
        Column::geometry(
            "geometry",
            "True position",
            panoramas().map(|p| wkb::point(p.position.lon_deg, p.position.lat_deg)),
        ),
    ])
}

/// One row per satellite image, with its footprint.
///
/// # Errors
/// As [`table`].
pub fn satellite_layer(dataset: &Dataset) -> Result<Table, TableError> {
    let mut uses = vec![[0_i64; 2]; dataset.satellites.len()];
    let mut seen = HashSet::new();
    for pair in &dataset.pairs {
        if seen.insert((pair.panorama, pair.satellite)) {
            uses[pair.satellite as usize][usize::from(!pair.is_positive())] += 1;
        }
    }
    let all = &dataset.satellites;
    Table::new(vec![
        Column::text("city", "City", all.iter().map(|s| dataset.cities[s.city as usize].clone())),
        Column::text("satellite", "File name", all.iter().map(|s| s.name.clone())),
        Column::bool("listed", "Whether a list names it", all.iter().map(|s| s.listed)),
        Column::i64("positives", "Panoramas it is the positive of", uses.iter().map(|u| u[0])),
        Column::i64(
            "semi_positives",
            "Panoramas it is a semi-positive of",
            uses.iter().map(|u| u[1]),
        ),
        Column::text("status", "Image file", all.iter().map(|s| s.status.name())),
        Column::geometry("geometry", "Footprint", all.iter().map(|s| footprint(&s.grid))),
    ])
}

fn footprint(grid: &ImageGrid) -> Vec<u8> {
    let (width, height) = (f64::from(grid.width()), f64::from(grid.height()));
    let north_west = grid.lonlat(PixelPoint { x: 0.0, y: 0.0 });
    let south_east = grid.lonlat(PixelPoint { x: width, y: height });
    wkb::rectangle(north_west.lon_deg, south_east.lat_deg, south_east.lon_deg, north_west.lat_deg)
}
