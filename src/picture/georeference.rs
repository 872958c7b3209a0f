//! Where a picture lies: its name first, then what the file or the files beside it say, which also know the size of
//! pixels that are not VIGOR's.

use super::PictureError;
use crate::crs::CrsSpec;
use crate::footprint::Place;
use crate::grid::{GeoTransform, ImageGrid};
use crate::raster::{RasterHeader, beside, world_file};
use crate::vigor::{NameError, SatelliteName};
use std::path::Path;

/// Zoom level of VIGOR's satellite images.
const VIGOR_ZOOM: u8 = 20;
/// What stands for "no georeference".
const NOTHING: GeoTransform = GeoTransform([0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);

/// The place that a picture's name states, with a warning where the name states an impossible one.
pub(super) fn from_name(path: &Path, size: [u32; 2]) -> (Option<Place>, Option<String>) {
    let name = match SatelliteName::parse(&path.to_string_lossy()) {
        Ok(name) => name,
        Err(NameError::Form { .. } | NameError::Panorama { .. }) => return (None, None),
        Err(error) => return (None, Some(format!("the name states no place: {error}"))),
    };
    match ImageGrid::new(name.center(), VIGOR_ZOOM, size[0], size[1]) {
        Ok(grid) => (Some(Place::WebMercator(grid)), None),
        Err(error) => (None, Some(format!("the name states no place: {error}"))),
    }
}

/// The place that a raster's header states.
pub(super) fn from_header(header: &RasterHeader, warnings: &mut Vec<String>) -> Option<Place> {
    if header.geotransform == NOTHING {
        return None;
    }
    join(Some(header.geotransform), header.crs.clone(), "gdal_edit.py -a_srs", warnings)
}

/// The place that files beside a PNG or JPEG state: `NAME.png.aux.xml` as GDAL writes it, a world file,
/// and `NAME.prj`.
///
/// # Errors
/// [`PictureError::Georeference`] for side files that cannot be understood.
pub(super) fn from_side_files(
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<Option<Place>, PictureError> {
    let wrong = |reason: String| PictureError::Georeference { path: path.to_owned(), reason };
    let read = |path: &Path| std::fs::read(path).map(|b| String::from_utf8_lossy(&b).into_owned());
    let auxiliary = beside(path, ".aux.xml");
    let text = read(&auxiliary).unwrap_or_default();
    let mut geotransform = None;
    if let Some(numbers) = element(&text, "GeoTransform") {
        let values: Option<Vec<f64>> = numbers.split(',').map(|v| v.trim().parse().ok()).collect();
        let values = values.and_then(|values| <[f64; 6]>::try_from(values).ok());
        geotransform = Some(GeoTransform(values.ok_or_else(|| {
            wrong(format!("{} holds `{numbers}` in place of six numbers", auxiliary.display()))
        })?));
    }
    let geotransform = geotransform.or_else(|| world_file(path, &world_extensions(path)));
    let mut crs = None;
    let from_wkt = |wkt: &str, file: &Path| {
        CrsSpec::from_wkt(wkt).map_err(|error| wrong(format!("{}: {error}", file.display())))
    };
    if let Some(wkt) = element(&text, "SRS") {
        crs = Some(from_wkt(&unescape(wkt), &auxiliary)?);
    } else {
        let projection = path.with_extension("prj");
        if let Ok(wkt) = read(&projection) {
            crs = Some(from_wkt(wkt.trim(), &projection)?);
        }
    }
    Ok(join(geotransform, crs, "a .prj file of the same name", warnings))
}

fn join(
    geotransform: Option<GeoTransform>,
    crs: Option<CrsSpec>,
    remedy: &str,
    warnings: &mut Vec<String>,
) -> Option<Place> {
    match (geotransform, crs) {
        (Some(geotransform), Some(crs)) => Some(Place::Raster { geotransform, crs }),
        (Some(_), None) => {
            warnings.push(format!(
                "the picture has a pixel grid but no coordinate reference system, and so no place; state it \
                 with {remedy}"
            ));
            None
        }
        (None, _) => None,
    }
}

/// First and last letter of the extension and a `w`; the extension and a `w`; `wld`.
fn world_extensions(path: &Path) -> Vec<String> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let mut names = Vec::new();
    if let (Some(first), Some(last)) = (extension.chars().next(), extension.chars().next_back()) {
        names.push(format!("{first}{last}w"));
        names.push(format!("{extension}w"));
    }
    names.push("wld".to_owned());
    let upper: Vec<_> = names.iter().map(|name| name.to_ascii_uppercase()).collect();
    names.into_iter().chain(upper).collect()
}

/// The text of the first element of a name.
fn element<'a>(xml: &'a str, name: &str) -> Option<&'a str> {
    let start = xml.find(&format!("<{name}"))?;
    let (_, rest) = xml[start..].split_once('>')?;
    let (text, _) = rest.split_once("</")?;
    Some(text.trim())
}

fn unescape(text: &str) -> String {
    text.replace("&quot;", "\"").replace("&apos;", "'").replace("&amp;", "&")
}
