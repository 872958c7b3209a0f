//! From what people and files write to a [`CrsSpec`].

use super::identify::entry_by_name;
use super::table::{self, Entry};
use super::{CrsError, CrsSpec, vertical, wkt};

/// Geographic CRSs whose codes turn up in rasters (EPSG), with those of the table's bases.
const GEOGRAPHIC: [(u32, &str); 22] = [
    (4152, "NAD83(HARN)"),
    (4167, "NZGD2000"),
    (4230, "ED50"),
    (4258, "ETRS89"),
    (4267, "NAD27"),
    (4269, "NAD83"),
    (4277, "OSGB36"),
    (4283, "GDA94"),
    (4322, "WGS 72"),
    (4326, "WGS 84"),
    (4490, "China Geodetic Coordinate System 2000"),
    (4612, "JGD2000"),
    (4617, "NAD83(CSRS)"),
    (4674, "SIRGAS 2000"),
    (4759, "NAD83(NSRS2007)"),
    (4937, "ETRS89"),
    (4957, "NAD83(HARN)"),
    (4979, "WGS 84"),
    (6318, "NAD83(2011)"),
    (6319, "NAD83(2011)"),
    (6668, "JGD2011"),
    (7844, "GDA2020"),
];

impl CrsSpec {
    /// Reads what a user typed: `EPSG:2927`, `2927`, `EPSG:2927+5703` (horizontal and vertical),
    /// the name that EPSG or ESRI give a CRS of the table, or WKT. Builds with PROJ also take
    /// whatever PROJ understands (`ESRI:102749`, `+proj=utm +zone=10`).
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the text describes no CRS.
    pub fn from_user_input(text: &str) -> Result<Self, CrsError> {
        let text = text.trim();
        if let Some(entry) = entry_by_name(text) {
            return Ok(Self::from_entry(entry));
        }
        // Names have parentheses too, but not before a quote.
        if text.contains('[') || text.contains("(\"") {
            return Self::from_wkt(text);
        }
        match codes(text) {
            Some((horizontal, None)) if !vertical::is_known(horizontal) => {
                Ok(Self::from_epsg(horizontal))
            }
            Some((horizontal, Some(upright))) => Ok(Self {
                vertical: Some(vertical::describe(Some(upright), None, None)),
                ..Self::from_epsg(horizontal)
            }),
            Some((code, None)) => Err(malformed(
                text,
                &format!(
                    "EPSG:{code} is vertical; give a horizontal CRS, as in `EPSG:2927+{code}`"
                ),
            )),
            None => other(text),
        }
    }

    /// The CRS of an EPSG code; name and unit are filled in where the table knows it.
    #[must_use]
    pub fn from_epsg(code: u32) -> Self {
        if let Some(entry) = table::entry(code) {
            return Self::from_entry(entry);
        }
        let geographic = GEOGRAPHIC.iter().find(|(known, _)| *known == code);
        Self {
            name: geographic.map_or_else(|| format!("EPSG:{code}"), |(_, name)| (*name).to_owned()),
            epsg: Some(code),
            geographic: geographic.is_some(),
            linear_unit: None,
            vertical: None,
            wkt: None,
        }
    }

    /// Reads a WKT definition: WKT 1 (OGC, GDAL, ESRI) or WKT 2, compound or not. A CRS without a
    /// code is identified by datum, projection parameters and unit where the table has it.
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the text is no WKT of a CRS, [`CrsError::Contradiction`] when its
    /// code and its parameters mean different CRSs.
    pub fn from_wkt(wkt: &str) -> Result<Self, CrsError> {
        wkt::spec_from_wkt(wkt)
    }

    /// The CRS as messages call it: `EPSG:2927 (NAD83(HARN) / Washington South (ftUS))`.
    #[must_use]
    pub fn label(&self) -> String {
        match self.epsg {
            Some(code) if self.name != format!("EPSG:{code}") => {
                format!("EPSG:{code} ({})", self.name)
            }
            _ => self.name.clone(),
        }
    }

    fn from_entry(entry: &Entry) -> Self {
        Self {
            name: entry.name.to_owned(),
            epsg: Some(entry.code),
            geographic: false,
            linear_unit: Some(entry.unit),
            vertical: None,
            wkt: None,
        }
    }
}

/// `2927`, `EPSG:2927`, `urn:ogc:def:crs:EPSG::2927`, each perhaps with `+5703`.
fn codes(text: &str) -> Option<(u32, Option<u32>)> {
    let lower = text.to_ascii_lowercase();
    let digits = if let Some(rest) = lower.strip_prefix("epsg:") {
        rest
    } else if let Some(rest) = lower.strip_prefix("urn:ogc:def:crs:epsg:") {
        rest.split_once(':')?.1
    } else {
        &lower
    };
    let mut parts = digits.split('+').map(|part| part.trim().trim_start_matches("epsg:"));
    let horizontal = parts.next()?.parse().ok().filter(|code| *code > 0)?;
    let upright = match parts.next() {
        Some(part) => Some(part.parse().ok()?),
        None => None,
    };
    parts.next().is_none().then_some((horizontal, upright))
}

fn malformed(input: &str, reason: &str) -> CrsError {
    CrsError::Malformed { input: input.chars().take(60).collect(), reason: reason.to_owned() }
}

#[cfg(feature = "proj")]
fn other(text: &str) -> Result<CrsSpec, CrsError> {
    match super::authority::wkt_of(text) {
        Ok(wkt) => CrsSpec::from_wkt(&wkt),
        Err(CrsError::Proj { message, .. }) => Err(malformed(
            text,
            &format!("expected an EPSG code (`EPSG:2927`), WKT, or what PROJ knows ({message})"),
        )),
        Err(error) => Err(error),
    }
}

#[cfg(not(feature = "proj"))]
fn other(text: &str) -> Result<CrsSpec, CrsError> {
    Err(malformed(text, "expected an EPSG code (`EPSG:2927`), a name of EPSG or ESRI, or WKT"))
}
