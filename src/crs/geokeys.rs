//! The CRS in a GeoTIFF's GeoKeys (OGC 19-008r4).

use super::{CrsError, CrsSpec};

/// The three TIFF tags that hold a GeoTIFF's CRS, as read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GeoKeys {
    /// GeoKeyDirectoryTag (34735).
    pub directory: Vec<u16>,
    /// GeoDoubleParamsTag (34736); empty where absent.
    pub doubles: Vec<f64>,
    /// GeoAsciiParamsTag (34737); empty where absent.
    pub ascii: String,
}

impl CrsSpec {
    /// Reads the CRS that a GeoTIFF's keys describe.
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the keys are damaged or describe no CRS.
    pub fn from_geokeys(keys: &GeoKeys) -> Result<Self, CrsError> {
        let entries = keys.directory.get(4..).unwrap_or_default().chunks_exact(4);
        let code = entries.into_iter().find(|e| e[0] == 3072 && e[1] == 0).map(|e| e[3]);
        code.map(|code| Self::from_epsg(u32::from(code))).ok_or_else(|| CrsError::Malformed {
            input: "GeoKeys".to_owned(),
            reason: "no ProjectedCRSGeoKey".to_owned(),
        })
    }
}
