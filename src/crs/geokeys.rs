//! The CRS in a GeoTIFF's GeoKeys (OGC 19-008r4, and GeoTIFF 1.0 as written in the wild).

use super::identify::{Definition, datum_by_code, datum_by_name, entry_by_name};
use super::table::{self, Method};
use super::{CrsError, CrsSpec, VerticalCrs, vertical};
use crate::units::LinearUnit;

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

/// Numbers of the keys that are read.
mod key {
    pub const MODEL_TYPE: u16 = 1024;
    pub const CITATION: u16 = 1026;
    pub const GEODETIC_CRS: u16 = 2048;
    pub const GEODETIC_CITATION: u16 = 2049;
    pub const GEODETIC_DATUM: u16 = 2050;
    pub const ANGULAR_UNITS: u16 = 2054;
    pub const ANGULAR_UNIT_SIZE: u16 = 2055;
    pub const PRIME_MERIDIAN_LONGITUDE: u16 = 2061;
    pub const PROJECTED_CRS: u16 = 3072;
    pub const PROJECTED_CITATION: u16 = 3073;
    pub const PROJECTION: u16 = 3074;
    pub const METHOD: u16 = 3075;
    pub const LINEAR_UNITS: u16 = 3076;
    pub const LINEAR_UNIT_SIZE: u16 = 3077;
    pub const STANDARD_PARALLEL_1: u16 = 3078;
    pub const STANDARD_PARALLEL_2: u16 = 3079;
    pub const NATURAL_ORIGIN_LONGITUDE: u16 = 3080;
    pub const NATURAL_ORIGIN_LATITUDE: u16 = 3081;
    pub const FALSE_EASTING: u16 = 3082;
    pub const FALSE_NORTHING: u16 = 3083;
    pub const FALSE_ORIGIN_LONGITUDE: u16 = 3084;
    pub const FALSE_ORIGIN_LATITUDE: u16 = 3085;
    pub const FALSE_ORIGIN_EASTING: u16 = 3086;
    pub const FALSE_ORIGIN_NORTHING: u16 = 3087;
    pub const CENTRE_LONGITUDE: u16 = 3088;
    pub const SCALE_AT_NATURAL_ORIGIN: u16 = 3092;
    pub const VERTICAL_CRS: u16 = 4096;
    pub const VERTICAL_CITATION: u16 = 4097;
    pub const VERTICAL_DATUM: u16 = 4098;
    pub const VERTICAL_UNITS: u16 = 4099;
}

/// The value that means "see the other keys".
const USER_DEFINED: u16 = 32_767;

impl CrsSpec {
    /// Reads the CRS that a GeoTIFF's keys describe: by code, by an ESRI definition in a citation,
    /// or by projection parameters.
    ///
    /// # Errors
    /// [`CrsError::Malformed`] when the keys are damaged or describe no CRS,
    /// [`CrsError::Contradiction`] when they describe two.
    pub fn from_geokeys(keys: &GeoKeys) -> Result<Self, CrsError> {
        let reader = Reader::new(keys)?;
        let mut spec = reader.horizontal()?;
        if let Some(upright) = reader.vertical() {
            spec.vertical = Some(upright);
        }
        Ok(spec)
    }
}

struct Reader<'a> {
    keys: &'a GeoKeys,
    entries: &'a [[u16; 4]],
}

impl<'a> Reader<'a> {
    fn new(keys: &'a GeoKeys) -> Result<Self, CrsError> {
        let [1, _, _, count, rest @ ..] = keys.directory.as_slice() else {
            return Err(malformed("their directory does not begin with version 1"));
        };
        let (entries, _) = rest.as_chunks::<4>();
        match entries.get(..usize::from(*count)) {
            Some(entries) => Ok(Self { keys, entries }),
            None => Err(malformed(&format!(
                "their directory promises {count} keys and holds {}",
                entries.len()
            ))),
        }
    }

    fn entry(&self, key: u16) -> Option<[u16; 4]> {
        self.entries.iter().find(|entry| entry[0] == key).copied()
    }

    /// A code; 0 means undefined and counts as absent.
    fn short(&self, key: u16) -> Option<u16> {
        let [_, location, count, value] = self.entry(key)?;
        let value = match location {
            0 => value,
            34_735 if count > 0 => *self.keys.directory.get(usize::from(value))?,
            _ => return None,
        };
        (value != 0).then_some(value)
    }

    /// A code of EPSG's registry.
    fn code(&self, key: u16) -> Option<u32> {
        self.short(key).filter(|code| *code != USER_DEFINED).map(u32::from)
    }

    fn double(&self, key: u16) -> Option<f64> {
        let [_, location, _, value] = self.entry(key)?;
        if location != 34_736 {
            return None;
        }
        self.keys.doubles.get(usize::from(value)).copied().filter(|number| number.is_finite())
    }

    fn first_double(&self, keys: &[u16]) -> Option<f64> {
        keys.iter().find_map(|key| self.double(*key))
    }

    fn text(&self, key: u16) -> Option<&'a str> {
        let [_, location, count, value] = self.entry(key)?;
        if location != 34_737 {
            return None;
        }
        let from = usize::from(value);
        let to = (from + usize::from(count)).min(self.keys.ascii.len());
        let text = self.keys.ascii.get(from..to)?.trim_end_matches(['|', '\0']).trim();
        (!text.is_empty()).then_some(text)
    }

    fn horizontal(&self) -> Result<CrsSpec, CrsError> {
        let model = self.short(key::MODEL_TYPE);
        let has_projection = [key::PROJECTED_CRS, key::PROJECTION, key::METHOD]
            .into_iter()
            .any(|key| self.short(key).is_some());
        match model {
            Some(3) => Err(malformed("they describe geocentric coordinates")),
            Some(1) => self.projected(),
            Some(2) => self.geographic(),
            _ if has_projection => self.projected(),
            _ => self.geographic(),
        }
    }

    fn geographic(&self) -> Result<CrsSpec, CrsError> {
        let code = self.code(key::GEODETIC_CRS);
        let name = self.text(key::GEODETIC_CITATION).or(self.text(key::CITATION));
        if code.is_none() && name.is_none() && self.short(key::GEODETIC_CRS).is_none() {
            return Err(malformed("they name no CRS"));
        }
        let known = code.map(CrsSpec::from_epsg);
        Ok(CrsSpec {
            name: match (&known, name) {
                (Some(known), _) if known.geographic => known.name.clone(),
                (_, Some(name)) => name.to_owned(),
                (Some(known), None) => known.name.clone(),
                (None, None) => "unnamed".to_owned(),
            },
            epsg: code,
            geographic: true,
            linear_unit: None,
            vertical: None,
            wkt: None,
        })
    }

    fn projected(&self) -> Result<CrsSpec, CrsError> {
        let code = self.code(key::PROJECTED_CRS);
        if code.is_none()
            && let Some(wkt) = self.esri_definition()
        {
            return CrsSpec::from_wkt(wkt);
        }
        let name = self
            .text(key::PROJECTED_CITATION)
            .or(self.text(key::CITATION))
            .map(|text| labelled(text, "PCS Name").unwrap_or(text));
        let unit = self.linear_unit();
        // Parameters without a unit are in metres.
        let metres_per_unit = if code.is_some() { unit } else { Some(unit.unwrap_or(1.0)) };
        let mut definition = Definition {
            name: name.unwrap_or("unnamed").to_owned(),
            epsg: code,
            // A code brings its own datum, whatever else a writer put beside it.
            datum: if code.is_some() { None } else { self.datum() },
            method: self.method(metres_per_unit.unwrap_or(1.0)),
            metres_per_unit,
        };
        if code.is_none() {
            if definition.method.is_none() {
                definition.method = self.zone();
            }
            // A citation alone (old ArcGIS): the name says all.
            if definition.method.is_none()
                && let Some(entry) = name.and_then(entry_by_name)
            {
                definition.epsg = Some(entry.code);
                definition.metres_per_unit = unit;
            }
        }
        if definition.epsg.is_none() && definition.method.is_none() && name.is_none() {
            return Err(malformed("they describe no projection"));
        }
        let wkt = definition.to_wkt();
        let spec = definition.identify()?;
        Ok(CrsSpec { wkt: if spec.epsg.is_none() { wkt } else { None }, ..spec })
    }

    /// `ESRI PE String = PROJCS[...]` in any citation.
    fn esri_definition(&self) -> Option<&'a str> {
        [key::PROJECTED_CITATION, key::CITATION, key::GEODETIC_CITATION].into_iter().find_map(
            |key| {
                let text = self.text(key)?;
                let at = text.find("ESRI PE String")?;
                let (_, wkt) = text[at..].split_once('=')?;
                wkt.contains('[').then_some(wkt.trim())
            },
        )
    }

    fn linear_unit(&self) -> Option<f64> {
        match self.short(key::LINEAR_UNITS) {
            Some(USER_DEFINED) => self.double(key::LINEAR_UNIT_SIZE).filter(|metres| *metres > 0.0),
            Some(code) => unit_by_code(code).map(LinearUnit::metres_per_unit),
            None => None,
        }
    }

    fn datum(&self) -> Option<u32> {
        if self.double(key::PRIME_MERIDIAN_LONGITUDE).is_some_and(|longitude| longitude != 0.0) {
            return None;
        }
        let by_code =
            || [key::GEODETIC_CRS, key::GEODETIC_DATUM].into_iter().find_map(|key| self.code(key));
        if let Some(code) = by_code() {
            return datum_by_code(code);
        }
        let text = self.text(key::GEODETIC_CITATION)?;
        ["GCS Name", "Datum"]
            .into_iter()
            .find_map(|label| datum_by_name(labelled(text, label)?))
            .or_else(|| datum_by_name(text))
    }

    /// Projection parameters in metres and degrees.
    fn method(&self, metres_per_unit: f64) -> Option<Method> {
        use key::*;
        let degrees = match self.short(ANGULAR_UNITS) {
            None | Some(9102 | 9122) => 1.0,
            Some(9101) => 1.0_f64.to_degrees(),
            Some(9105 | 9106) => 0.9,
            Some(USER_DEFINED) => self.double(ANGULAR_UNIT_SIZE)?.to_degrees(),
            Some(_) => return None,
        };
        let angle = |keys: &[u16]| self.first_double(keys).map(|value| value * degrees);
        let length = |keys: &[u16]| self.first_double(keys).unwrap_or(0.0) * metres_per_unit;
        let lat_0 = angle(&[NATURAL_ORIGIN_LATITUDE, FALSE_ORIGIN_LATITUDE]);
        let lon_0 = angle(&[NATURAL_ORIGIN_LONGITUDE, FALSE_ORIGIN_LONGITUDE, CENTRE_LONGITUDE])?;
        let x_0 = length(&[FALSE_EASTING, FALSE_ORIGIN_EASTING]);
        let y_0 = length(&[FALSE_NORTHING, FALSE_ORIGIN_NORTHING]);
        let k_0 = self.double(SCALE_AT_NATURAL_ORIGIN).unwrap_or(1.0);
        match self.short(METHOD)? {
            1 => Some(Method::TransverseMercator {
                lat_0: lat_0.unwrap_or(0.0),
                lon_0,
                k_0,
                x_0,
                y_0,
            }),
            8 => {
                let lat_1 = angle(&[STANDARD_PARALLEL_1])?;
                let lat_2 = angle(&[STANDARD_PARALLEL_2])?;
                Some(Method::Conic2 { lat_0: lat_0?, lon_0, lat_1, lat_2, x_0, y_0 })
            }
            9 => Some(Method::Conic1 { lat_0: lat_0?, lon_0, k_0, x_0, y_0 }),
            _ => None,
        }
    }

    /// Parameters of the zone whose EPSG code (of the conversion) ProjectionGeoKey gives.
    fn zone(&self) -> Option<Method> {
        let zone = self.code(key::PROJECTION)?;
        table::ENTRIES.iter().find(|entry| entry.zone == zone).map(|entry| entry.method)
    }

    fn vertical(&self) -> Option<VerticalCrs> {
        let unit = self.short(key::VERTICAL_UNITS).and_then(unit_by_code);
        let citation = self.text(key::VERTICAL_CITATION);
        let code = self.code(key::VERTICAL_CRS).or_else(|| self.code(key::VERTICAL_DATUM));
        match code {
            // GeoTIFF 1.0 had codes of its own.
            Some(5001..=5033) => {
                Some(VerticalCrs { name: "ellipsoidal height".to_owned(), epsg: None, unit })
            }
            Some(5102) => Some(vertical::describe(Some(5702), None, unit)),
            Some(5103) => Some(vertical::describe(Some(5703), None, unit)),
            Some(code) => Some(vertical::describe(Some(code), citation, unit)),
            None if unit.is_some() || citation.is_some() => {
                Some(vertical::describe(None, citation, unit))
            }
            None => None,
        }
    }
}

/// `value` of `label = value` in a citation of parts that `|` divides.
fn labelled<'a>(text: &'a str, label: &str) -> Option<&'a str> {
    text.split('|').find_map(|part| {
        let (key, value) = part.split_once('=')?;
        key.trim().eq_ignore_ascii_case(label).then_some(value.trim())
    })
}

fn unit_by_code(code: u16) -> Option<LinearUnit> {
    [LinearUnit::Metre, LinearUnit::Foot, LinearUnit::UsSurveyFoot]
        .into_iter()
        .find(|unit| unit.epsg() == code)
}

fn malformed(reason: &str) -> CrsError {
    CrsError::Malformed { input: "GeoKeys".to_owned(), reason: reason.to_owned() }
}
