//! What a GeoTIFF says about place and meaning: GeoKeys, the grid, no-data value, unit, metadata.

use super::tags::{
    Directory, GDAL_METADATA, GDAL_NODATA, GEO_KEY_DIRECTORY, MODEL_PIXEL_SCALE, MODEL_TIEPOINT,
    MODEL_TRANSFORMATION, Value,
};
use crate::grid::GeoTransform;
use crate::units::LinearUnit;

/// The CRS of a GeoTIFF by its EPSG codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CrsKeys {
    pub epsg: u32,
    pub geographic: bool,
    pub linear_unit: Option<LinearUnit>,
    pub vertical_epsg: Option<u32>,
    pub vertical_unit: Option<LinearUnit>,
}

/// GeoKeys hold 16 bits; this stands for a code that they cannot hold ("user-defined").
const USER_DEFINED: u16 = 32_767;

impl CrsKeys {
    /// The GeoKeyDirectory tag (OGC 19-008r4): every key here fits into the directory itself.
    fn directory(&self) -> Vec<u16> {
        let code = |epsg: u32| u16::try_from(epsg).unwrap_or(USER_DEFINED);
        // GTModelTypeGeoKey: 1 projected, 2 geographic. GTRasterTypeGeoKey: 1 PixelIsArea.
        let mut keys = vec![(1024, if self.geographic { 2 } else { 1 }), (1025, 1)];
        if self.geographic {
            // GeodeticCRSGeoKey; GeogAngularUnitsGeoKey: degree.
            keys.extend([(2048, code(self.epsg)), (2054, 9102)]);
        } else {
            // ProjectedCRSGeoKey; ProjLinearUnitsGeoKey.
            keys.push((3072, code(self.epsg)));
            keys.extend(self.linear_unit.map(|unit| (3076, unit.epsg())));
        }
        if let Some(vertical) = self.vertical_epsg {
            // VerticalGeoKey; VerticalUnitsGeoKey.
            keys.push((4096, code(vertical)));
            keys.extend(self.vertical_unit.map(|unit| (4099, unit.epsg())));
        }
        // Version 1, revision 1.1: a vertical code means a vertical CRS from 1.1 on.
        let mut words = vec![1, 1, 1, keys.len() as u16];
        for (key, value) in keys {
            words.extend([key, 0, 1, value]);
        }
        words
    }
}

/// Puts the CRS and the grid into a directory.
pub(super) fn set_georeference(directory: &mut Directory, grid: &GeoTransform, crs: &CrsKeys) {
    let c = &grid.0;
    if grid.is_north_up() {
        directory.set(MODEL_PIXEL_SCALE, Value::Double(vec![c[1], -c[5], 0.0]));
        directory.set(MODEL_TIEPOINT, Value::Double(vec![0.0, 0.0, 0.0, c[0], c[3], 0.0]));
    } else {
        #[rustfmt::skip]
        let matrix = vec![
            c[1], c[2], 0.0, c[0],
            c[4], c[5], 0.0, c[3],
            0.0,  0.0,  0.0, 0.0,
            0.0,  0.0,  0.0, 1.0,
        ];
        directory.set(MODEL_TRANSFORMATION, Value::Double(matrix));
    }
    directory.set(GEO_KEY_DIRECTORY, Value::Short(crs.directory()));
}

/// Puts the no-data value into a directory, as GDAL writes it.
pub(super) fn set_nodata(directory: &mut Directory, nodata: f64) {
    let text = if nodata.is_nan() {
        "nan".to_owned()
    } else if nodata.abs() >= 1e15 {
        format!("{nodata:e}")
    } else {
        nodata.to_string()
    };
    directory.set(GDAL_NODATA, Value::Ascii(text));
}

/// The tag of a metadata item that TIFF itself knows, by GDAL's name for it.
fn baseline_tag(key: &str) -> Option<u16> {
    Some(match key {
        "TIFFTAG_DOCUMENTNAME" => 269,
        "TIFFTAG_IMAGEDESCRIPTION" => 270,
        "TIFFTAG_SOFTWARE" => 305,
        "TIFFTAG_DATETIME" => 306,
        "TIFFTAG_ARTIST" => 315,
        "TIFFTAG_COPYRIGHT" => 33_432,
        _ => return None,
    })
}

/// Puts the unit of the bands and free metadata into a directory. GDAL's `TIFFTAG_...` names become
/// TIFF's own tags, everything else an item of GDAL's XML.
pub(super) fn set_metadata(
    directory: &mut Directory,
    metadata: &[(String, String)],
    unit: Option<LinearUnit>,
    bands: u16,
) {
    let mut items = String::new();
    for (key, value) in metadata {
        // A zero byte ends a TIFF string.
        let value = value.replace('\0', " ");
        match baseline_tag(key) {
            Some(tag) => directory.set(tag, Value::Ascii(value)),
            None => {
                let (key, value) = (escape(key), escape(&value));
                items += &format!("  <Item name=\"{key}\">{value}</Item>\n");
            }
        }
    }
    if let Some(unit) = unit {
        let name = match unit {
            LinearUnit::Metre => "metre",
            LinearUnit::Foot => "foot",
            LinearUnit::UsSurveyFoot => "US survey foot",
        };
        for band in 0..bands {
            items += &format!(
                "  <Item name=\"UNITTYPE\" sample=\"{band}\" role=\"unittype\">{name}</Item>\n"
            );
        }
    }
    if !items.is_empty() {
        let xml = format!("<GDALMetadata>\n{items}</GDALMetadata>\n");
        directory.set(GDAL_METADATA, Value::Ascii(xml));
    }
}

fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\t' | '\n' => out.push(c),
            // XML has no way to write the other control characters.
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_data_values_are_written_so_that_they_parse_back() {
        for value in [-9999.0, 0.0, 0.1, f64::from(f32::MIN), -1e30, 255.0] {
            let mut directory = Directory::default();
            set_nodata(&mut directory, value);
            let Some(Value::Ascii(text)) = directory.0.get(&GDAL_NODATA) else {
                panic!("no value")
            };
            assert_eq!(text.parse(), Ok(value), "{text}");
            assert!(text.len() < 30, "{text}");
        }
    }

    #[test]
    fn metadata_is_escaped_and_baseline_tags_are_used() {
        let mut directory = Directory::default();
        let item = |k: &str, v: &str| (k.to_owned(), v.to_owned());
        let items = [item("TIFFTAG_SOFTWARE", "sat3d"), item("A", "x < \"y\" & z\u{1}")];
        set_metadata(&mut directory, &items, Some(LinearUnit::UsSurveyFoot), 1);
        assert_eq!(directory.0[&305], Value::Ascii("sat3d".to_owned()));
        let Value::Ascii(xml) = &directory.0[&GDAL_METADATA] else { panic!("no text") };
        assert!(xml.contains("<Item name=\"A\">x &lt; &quot;y&quot; &amp; z </Item>"), "{xml}");
        assert!(xml.contains("role=\"unittype\">US survey foot<"), "{xml}");
        assert!(!xml.contains("SOFTWARE"));
    }
}
