//! TIFF directories as bytes: classic and BigTIFF, always little-endian.

use std::collections::BTreeMap;

pub(super) const NEW_SUBFILE_TYPE: u16 = 254;
pub(super) const IMAGE_WIDTH: u16 = 256;
pub(super) const IMAGE_LENGTH: u16 = 257;
pub(super) const BITS_PER_SAMPLE: u16 = 258;
pub(super) const COMPRESSION: u16 = 259;
pub(super) const PHOTOMETRIC: u16 = 262;
pub(super) const STRIP_OFFSETS: u16 = 273;
pub(super) const SAMPLES_PER_PIXEL: u16 = 277;
pub(super) const ROWS_PER_STRIP: u16 = 278;
pub(super) const STRIP_BYTE_COUNTS: u16 = 279;
pub(super) const PLANAR_CONFIGURATION: u16 = 284;
pub(super) const SOFTWARE: u16 = 305;
pub(super) const PREDICTOR: u16 = 317;
pub(super) const TILE_WIDTH: u16 = 322;
pub(super) const TILE_LENGTH: u16 = 323;
pub(super) const TILE_OFFSETS: u16 = 324;
pub(super) const TILE_BYTE_COUNTS: u16 = 325;
pub(super) const SAMPLE_FORMAT: u16 = 339;
pub(super) const MODEL_PIXEL_SCALE: u16 = 33_550;
pub(super) const MODEL_TIEPOINT: u16 = 33_922;
pub(super) const MODEL_TRANSFORMATION: u16 = 34_264;
pub(super) const GEO_KEY_DIRECTORY: u16 = 34_735;
pub(super) const GEO_ASCII_PARAMS: u16 = 34_737;
pub(super) const GDAL_METADATA: u16 = 42_112;
pub(super) const GDAL_NODATA: u16 = 42_113;

/// Classic TIFF (offsets of 32 bits) or BigTIFF (64).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Classic,
    Big,
}

/// Raw bytes from which a file is BigTIFF: well under the 4 GiB of classic TIFF, because data that
/// do not compress grow a little and the directory comes on top.
const BIG_FROM_BYTES: u64 = 3_500_000_000;

impl Format {
    /// The format of a file whose samples take `bytes` without compression.
    pub(super) const fn of_raw(bytes: u64) -> Self {
        if bytes >= BIG_FROM_BYTES { Self::Big } else { Self::Classic }
    }

    /// The file's first bytes, up to and with the offset of the first directory.
    pub(super) fn header(self, first_directory: u64) -> Vec<u8> {
        let mut header = b"II".to_vec();
        match self {
            Self::Classic => header.extend(42_u16.to_le_bytes()),
            // Version, bytes of an offset, zero.
            Self::Big => header.extend([43, 0, 8, 0, 0, 0]),
        }
        self.push_offset(&mut header, first_directory);
        header
    }

    /// Bytes of an offset, which is also how many bytes of a value fit into an entry.
    const fn offset_bytes(self) -> usize {
        match self {
            Self::Classic => 4,
            Self::Big => 8,
        }
    }

    /// Bytes before the entries, per entry, and after them.
    const fn sizes(self) -> (usize, usize, usize) {
        match self {
            Self::Classic => (2, 12, 4),
            Self::Big => (8, 20, 8),
        }
    }

    fn push_offset(self, out: &mut Vec<u8>, offset: u64) {
        // Classic files are kept under 4 GiB by the choice of the format.
        out.extend(&offset.to_le_bytes()[..self.offset_bytes()]);
    }
}

/// The value of a tag.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Short(Vec<u16>),
    Long(Vec<u32>),
    Double(Vec<f64>),
    /// Text without its final NUL.
    Ascii(String),
    /// Places in the file: `LONG` in classic files, `LONG8` in BigTIFF.
    Offsets(Vec<u64>),
}

impl Value {
    /// TIFF's number of the type, the number of values, and their bytes.
    fn encode(&self, format: Format) -> (u16, usize, Vec<u8>) {
        match self {
            Self::Short(v) => (3, v.len(), v.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::Long(v) => (4, v.len(), v.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::Double(v) => (12, v.len(), v.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::Ascii(text) => {
                // A NUL would end the text early.
                let mut bytes: Vec<u8> = text.bytes().filter(|b| *b != 0).collect();
                bytes.push(0);
                (2, bytes.len(), bytes)
            }
            Self::Offsets(v) => {
                let mut bytes = Vec::with_capacity(v.len() * format.offset_bytes());
                v.iter().for_each(|offset| format.push_offset(&mut bytes, *offset));
                (if format == Format::Big { 16 } else { 4 }, v.len(), bytes)
            }
        }
    }
}

/// One image file directory; its size depends on how many values there are, not on which.
#[derive(Clone, Debug, Default)]
pub(super) struct Directory(BTreeMap<u16, Value>);

impl Directory {
    pub(super) fn set(&mut self, tag: u16, value: Value) {
        self.0.insert(tag, value);
    }

    /// Bytes that [`encode`](Self::encode) will give.
    pub(super) fn size(&self, format: Format) -> u64 {
        self.encode(format, 0, 0).len() as u64
    }

    /// The directory as it lies at `start` (even), values that do not fit into entries right behind
    /// it; `next` is where the next directory lies, 0 after the last.
    pub(super) fn encode(&self, format: Format, start: u64, next: u64) -> Vec<u8> {
        let (before, entry, after) = format.sizes();
        let fixed = before + self.0.len() * entry + after;
        let mut out = Vec::with_capacity(fixed);
        let count = self.0.len() as u64;
        out.extend(&count.to_le_bytes()[..before]);
        let mut values = Vec::new();
        for (tag, value) in &self.0 {
            let (kind, count, mut bytes) = value.encode(format);
            out.extend(tag.to_le_bytes());
            out.extend(kind.to_le_bytes());
            format.push_offset(&mut out, count as u64);
            if bytes.len() <= format.offset_bytes() {
                bytes.resize(format.offset_bytes(), 0);
                out.extend(bytes);
            } else {
                format.push_offset(&mut out, start + (fixed + values.len()) as u64);
                // Values begin on even places.
                bytes.resize(bytes.len().next_multiple_of(2), 0);
                values.extend(bytes);
            }
        }
        format.push_offset(&mut out, next);
        out.extend(values);
        out.resize(out.len().next_multiple_of(8), 0);
        out
    }
}

/// The XML of GDAL's metadata tag: the band's unit and the dataset's items; `None` if there is
/// nothing to say.
pub(super) fn gdal_metadata(unit: Option<&str>, items: &[(String, String)]) -> Option<Value> {
    if unit.is_none() && items.is_empty() {
        return None;
    }
    let mut xml = "<GDALMetadata>\n".to_owned();
    if let Some(unit) = unit {
        xml += &format!(
            "  <Item name=\"UNITTYPE\" sample=\"0\" role=\"unittype\">{}</Item>\n",
            escape(unit)
        );
    }
    for (name, value) in items {
        // GDAL unescapes values twice: once as XML, once because it escapes them itself.
        let value = escape(&escape(value));
        xml += &format!("  <Item name=\"{}\">{value}</Item>\n", escape(name));
    }
    xml += "</GDALMetadata>\n";
    Some(Value::Ascii(xml))
}

/// Text as XML content or as an attribute in double quotes.
fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\n' | '\t' | '\r' => out.push(c),
            // XML 1.0 has no way to write the other control characters.
            c if c.is_control() => out.push(char::REPLACEMENT_CHARACTER),
            c => out.push(c),
        }
    }
    out
}

/// The text of GDAL's no-data tag, which reads back as the same number.
pub(super) fn nodata(value: f64) -> Value {
    let text = if value.is_nan() {
        "nan".to_owned()
    } else if value.abs() < 1e15 {
        value.to_string()
    } else {
        format!("{value:e}")
    };
    Value::Ascii(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_is_as_tiff_6_says() {
        let mut directory = Directory::default();
        directory.set(IMAGE_LENGTH, Value::Long(vec![7]));
        directory.set(BITS_PER_SAMPLE, Value::Short(vec![32]));
        directory.set(MODEL_PIXEL_SCALE, Value::Double(vec![1.0]));
        directory.set(TILE_OFFSETS, Value::Offsets(vec![300]));
        let bytes = directory.encode(Format::Classic, 8, 0x0102);
        let expected = [
            &[4, 0][..],
            &[1, 1, 4, 0, 1, 0, 0, 0, 7, 0, 0, 0],
            &[2, 1, 3, 0, 1, 0, 0, 0, 32, 0, 0, 0],
            &[68, 1, 4, 0, 1, 0, 0, 0, 44, 1, 0, 0],
            // 8 + 2 + 4 * 12 + 4 = 62
            &[14, 131, 12, 0, 1, 0, 0, 0, 62, 0, 0, 0],
            &[2, 1, 0, 0],
            &1.0_f64.to_le_bytes(),
            &[0, 0],
        ]
        .concat();
        assert_eq!(bytes, expected);
        assert_eq!(directory.size(Format::Classic), bytes.len() as u64);

        let big = directory.encode(Format::Big, 16, 0);
        assert_eq!(big[..8], [4, 0, 0, 0, 0, 0, 0, 0]);
        // The double fits into its entry.
        assert_eq!(big.len(), 8 + 4 * 20 + 8);
        assert_eq!(Format::Big.header(16), [73, 73, 43, 0, 8, 0, 0, 0, 16, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(Format::Classic.header(8), [73, 73, 42, 0, 8, 0, 0, 0]);
    }

    #[test]
    fn text_is_safe_in_xml_and_numbers_come_back() {
        assert_eq!(escape("a<b & \"c\"\u{0}é"), "a&lt;b &amp; &quot;c&quot;\u{fffd}é");
        assert_eq!(gdal_metadata(None, &[]), None);
        for value in [-9999.0, 0.1, f64::from(f32::MIN), 1e300, f64::INFINITY, -0.0] {
            let Value::Ascii(text) = nodata(value) else { panic!("no text") };
            assert_eq!(text.parse::<f64>(), Ok(value), "{text}");
        }
        assert_eq!(nodata(f64::NAN), Value::Ascii("nan".to_owned()));
        assert_eq!(nodata(-9999.0), Value::Ascii("-9999".to_owned()));
    }
}
