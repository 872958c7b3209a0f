//! Georeference and CRS as GeoTIFF tags (OGC 19-008r4).

use super::geographic::is_geographic;
use super::tags::{self, Directory, Value};
use crate::crs::CrsSpec;
use crate::grid::GeoTransform;

const MODEL_TYPE: u16 = 1024;
const RASTER_TYPE: u16 = 1025;
const CITATION: u16 = 1026;
const GEOGRAPHIC_TYPE: u16 = 2048;
const ANGULAR_UNITS: u16 = 2054;
const PROJECTED_CRS: u16 = 3072;
const PROJECTED_LINEAR_UNITS: u16 = 3076;
const VERTICAL_CRS: u16 = 4096;

const MODEL_PROJECTED: u16 = 1;
const MODEL_GEOGRAPHIC: u16 = 2;
const PIXEL_IS_AREA: u16 = 1;
const DEGREE: u16 = 9102;
/// What a GeoKey says of a CRS that it does not give by code.
const USER_DEFINED: u16 = 32_767;

/// Whether GeoKeys can name a CRS by this code; EPSG's own codes all lie below 32767.
pub(super) fn is_code(epsg: u32) -> bool {
    (1..u32::from(USER_DEFINED)).contains(&epsg)
}

/// Writes the pixel grid: scale and tie point where the raster is north-up, else the matrix.
pub(super) fn set_geotransform(directory: &mut Directory, grid: &GeoTransform) {
    let c = &grid.0;
    if grid.is_north_up() {
        directory.set(tags::MODEL_PIXEL_SCALE, Value::Double(vec![c[1], -c[5], 0.0]));
        directory.set(tags::MODEL_TIEPOINT, Value::Double(vec![0.0, 0.0, 0.0, c[0], c[3], 0.0]));
    } else {
        let mut matrix = vec![0.0; 16];
        matrix[0..4].copy_from_slice(&[c[1], c[2], 0.0, c[0]]);
        matrix[4..8].copy_from_slice(&[c[4], c[5], 0.0, c[3]]);
        matrix[15] = 1.0;
        directory.set(tags::MODEL_TRANSFORMATION, Value::Double(matrix));
    }
}

/// Writes the CRS; `epsg` 0 writes none at all. A code that GeoKeys cannot hold becomes a
/// user-defined CRS that is only cited.
pub(super) fn set_crs(directory: &mut Directory, epsg: u32, vertical: Option<u32>) {
    if epsg == 0 {
        return;
    }
    let code = |epsg: u32| match u16::try_from(epsg) {
        Ok(code) if is_code(epsg) => code,
        _ => USER_DEFINED,
    };
    let horizontal = code(epsg);
    let geographic = is_geographic(horizontal);
    let model = if geographic { MODEL_GEOGRAPHIC } else { MODEL_PROJECTED };
    // Key, tag that holds the value (0: the entry itself), number of values, value or its place.
    let mut keys = vec![[MODEL_TYPE, 0, 1, model], [RASTER_TYPE, 0, 1, PIXEL_IS_AREA]];
    let cited: Vec<String> = std::iter::once(epsg)
        .chain(vertical)
        .filter(|epsg| code(*epsg) == USER_DEFINED)
        .map(|epsg| format!("EPSG:{epsg}"))
        .collect();
    if !cited.is_empty() {
        // The bar ends a text among GeoKeys.
        let citation = cited.join("+") + "|";
        keys.push([CITATION, tags::GEO_ASCII_PARAMS, citation.len() as u16, 0]);
        directory.set(tags::GEO_ASCII_PARAMS, Value::Ascii(citation));
    }
    if geographic {
        keys.push([GEOGRAPHIC_TYPE, 0, 1, horizontal]);
        keys.push([ANGULAR_UNITS, 0, 1, DEGREE]);
    } else {
        keys.push([PROJECTED_CRS, 0, 1, horizontal]);
        // The code says the unit too; software without EPSG's registry wants to be told.
        if let Some(unit) = CrsSpec::from_epsg(epsg).linear_unit {
            keys.push([PROJECTED_LINEAR_UNITS, 0, 1, unit.epsg()]);
        }
    }
    if let Some(vertical) = vertical {
        keys.push([VERTICAL_CRS, 0, 1, code(vertical)]);
    }
    // Version 1 of the directory, revision 1.1: vertical CRSs by code came with it.
    let minor = u16::from(vertical.is_some());
    let header = [1, 1, minor, keys.len() as u16];
    let values = header.into_iter().chain(keys.into_iter().flatten()).collect();
    directory.set(tags::GEO_KEY_DIRECTORY, Value::Short(values));
}
