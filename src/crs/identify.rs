//! From a definition (WKT or GeoKeys) to a CRS of the table, by code or by parameters.

use super::table::{self, BASES, Base, Entry, Method};
use super::{CrsError, CrsSpec};
use crate::units::LinearUnit;

/// What a definition says of a projected CRS, as far as it says it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Definition {
    pub name: String,
    pub epsg: Option<u32>,
    /// EPSG code of the geographic CRS of its datum, if it is one of the table's.
    pub datum: Option<u32>,
    /// Projection parameters, if the method is one of the table's.
    pub method: Option<Method>,
    pub metres_per_unit: Option<f64>,
}

impl Definition {
    /// The specification: with the table's code and name where code or parameters are in the table.
    ///
    /// A code of the table counts unless its definition contradicts it. Then the definition may be
    /// that of another CRS of the table on the same datum (in another unit, say), as GDAL would
    /// take it; else nobody can know what is meant.
    pub(super) fn identify(self) -> Result<CrsSpec, CrsError> {
        let unit = self.metres_per_unit.and_then(LinearUnit::from_metres_per_unit);
        let stated = self.epsg.and_then(table::entry);
        let found = match (stated, self.epsg) {
            (Some(entry), _) => match self.disagreement(entry) {
                None => Some(entry),
                Some(what) => Some(self.sibling(entry).ok_or_else(|| CrsError::Contradiction {
                    name: format!("EPSG:{} ({})", entry.code, entry.name),
                    what,
                })?),
            },
            // A code that the table does not have stands.
            (None, Some(_)) => None,
            (None, None) => self.by_parameters(),
        };
        Ok(match found {
            Some(entry) => CrsSpec {
                name: entry.name.to_owned(),
                epsg: Some(entry.code),
                geographic: false,
                linear_unit: Some(entry.unit),
                vertical: None,
                wkt: None,
            },
            None => CrsSpec {
                name: self.name,
                epsg: self.epsg,
                geographic: false,
                linear_unit: unit,
                vertical: None,
                wkt: None,
            },
        })
    }

    /// What of the definition an entry does not agree with.
    fn disagreement(&self, entry: &Entry) -> Option<String> {
        if self.datum.is_some_and(|datum| datum != entry.base.code) {
            let datum = self.datum.and_then(table::base_by_code).map_or("another", |b| b.name);
            return Some(format!("its code stands for {}, its datum is {datum}", entry.base.name));
        }
        let same_unit = |metres: f64| LinearUnit::from_metres_per_unit(metres) == Some(entry.unit);
        if let Some(metres) = self.metres_per_unit.filter(|metres| !same_unit(*metres)) {
            return Some(format!(
                "its code stands for axes in units of {} m, its unit is {metres} m",
                entry.unit.metres_per_unit()
            ));
        }
        if self.method.is_some_and(|method| !method.is_close_to(&entry.method)) {
            return Some(format!(
                "its code stands for `{}`, its projection is {:?}",
                entry.projection, self.method
            ));
        }
        None
    }

    /// The entry that a definition means whose code stands for `stated`, but not its parameters.
    fn sibling(&self, stated: &Entry) -> Option<&'static Entry> {
        let base = stated.base.code;
        if self.datum.is_some_and(|datum| datum != base) {
            return None;
        }
        let complete = Self {
            datum: Some(base),
            method: self.method.or(Some(stated.method)),
            metres_per_unit: self.metres_per_unit.or(Some(stated.unit.metres_per_unit())),
            ..self.clone()
        };
        complete.by_parameters()
    }

    /// The entry with these parameters, datum and unit. Where several have the same (a state system
    /// under two codes), the one with this name, or else the lowest code.
    fn by_parameters(&self) -> Option<&'static Entry> {
        let (datum, method) = (self.datum?, self.method?);
        let unit = LinearUnit::from_metres_per_unit(self.metres_per_unit?)?;
        let fits = |entry: &&Entry| {
            entry.base.code == datum && entry.unit == unit && entry.method.is_close_to(&method)
        };
        let mut candidates = table::ENTRIES.iter().filter(fits);
        let first = candidates.next();
        let named = first.into_iter().chain(candidates).find(|entry| entry.is_called(&self.name));
        named.or(first)
    }
}

impl Definition {
    /// The definition as WKT 1, if it is complete: what PROJ needs to serve a CRS outside the table.
    pub(super) fn to_wkt(&self) -> Option<String> {
        let base = table::base_by_code(self.datum?)?;
        let unit = self.metres_per_unit?;
        let (projection, parameters) = match self.method? {
            Method::TransverseMercator { lat_0, lon_0, k_0, x_0, y_0 } => (
                "Transverse_Mercator",
                vec![
                    ("latitude_of_origin", lat_0),
                    ("central_meridian", lon_0),
                    ("scale_factor", k_0),
                    ("false_easting", x_0 / unit),
                    ("false_northing", y_0 / unit),
                ],
            ),
            Method::Conic1 { lat_0, lon_0, k_0, x_0, y_0 } => (
                "Lambert_Conformal_Conic_1SP",
                vec![
                    ("latitude_of_origin", lat_0),
                    ("central_meridian", lon_0),
                    ("scale_factor", k_0),
                    ("false_easting", x_0 / unit),
                    ("false_northing", y_0 / unit),
                ],
            ),
            Method::Conic2 { lat_0, lon_0, lat_1, lat_2, x_0, y_0 } => (
                "Lambert_Conformal_Conic_2SP",
                vec![
                    ("latitude_of_origin", lat_0),
                    ("central_meridian", lon_0),
                    ("standard_parallel_1", lat_1),
                    ("standard_parallel_2", lat_2),
                    ("false_easting", x_0 / unit),
                    ("false_northing", y_0 / unit),
                ],
            ),
        };
        let parameters: String = parameters
            .iter()
            .map(|(name, value)| format!("PARAMETER[\"{name}\",{value}],"))
            .collect();
        let name = self.name.replace('"', "\"\"");
        let Base { code, datum, name: base_name, ellipsoid } = base;
        Some(format!(
            "PROJCS[\"{name}\",GEOGCS[\"{base_name}\",DATUM[\"{base_name}\",SPHEROID[\"{}\",{},{}],AUTHORITY[\"EPSG\",\"{datum}\"]],PRIMEM[\"Greenwich\",0],UNIT[\"degree\",{}],AUTHORITY[\"EPSG\",\"{code}\"]],PROJECTION[\"{projection}\"],{parameters}UNIT[\"unit\",{unit}]]",
            ellipsoid.proj_name(),
            ellipsoid.a,
            1.0 / ellipsoid.f,
            1.0_f64.to_radians(),
        ))
    }
}

impl Entry {
    /// Whether EPSG or ESRI call it so.
    pub(super) fn is_called(&self, name: &str) -> bool {
        let same = |known: &str| known.eq_ignore_ascii_case(name.trim());
        same(self.name) || self.esri_name.is_some_and(same)
    }
}

/// The CRS that EPSG or ESRI call so.
pub(super) fn entry_by_name(name: &str) -> Option<&'static Entry> {
    table::ENTRIES.iter().find(|entry| entry.is_called(name))
}

/// EPSG code of the geographic CRS of a datum, from the many names that datums go by.
pub(super) fn datum_by_name(name: &str) -> Option<u32> {
    let lower = name.to_ascii_lowercase();
    // ESRI marks datums with `D_` and geographic CRSs with `GCS_`.
    let lower = lower.strip_prefix("d_").or(lower.strip_prefix("gcs_")).unwrap_or(&lower);
    let key: String = lower.chars().filter(char::is_ascii_alphanumeric).collect();
    let key = key.strip_suffix("ensemble").unwrap_or(&key);
    Some(match key {
        "wgs84" | "wgs1984" | "worldgeodeticsystem1984" => 4326,
        "nad83" | "nad1983" | "northamerican1983" | "northamericandatum1983" => 4269,
        "nad83harn"
        | "nad1983harn"
        | "northamerican1983harn"
        | "nad83highaccuracyreferencenetwork"
        | "nad83highaccuracyregionalnetwork"
        | "nad1983highaccuracyreferencenetwork" => 4152,
        "nad83nsrs2007" | "nad1983nsrs2007" | "nad83nationalspatialreferencesystem2007" => 4759,
        "nad832011" | "nad19832011" | "nad83nationalspatialreferencesystem2011" => 6318,
        "etrs89" | "etrs1989" | "europeanterrestrialreferencesystem1989" => 4258,
        _ => return None,
    })
}

/// EPSG code of the geographic CRS to which a code of a geographic CRS or datum leads.
pub(super) fn datum_by_code(code: u32) -> Option<u32> {
    BASES.iter().find(|base| base.code == code || base.datum == code).map(|base| base.code)
}
