//! Image file directories: the tags of a TIFF or BigTIFF, little-endian.

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
pub(super) const GDAL_METADATA: u16 = 42_112;
pub(super) const GDAL_NODATA: u16 = 42_113;

/// Classic TIFF (offsets of 32 bits, files up to 4 GB) or BigTIFF.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Flavour {
    Classic,
    Big,
}

impl Flavour {
    /// Bytes of an offset.
    const fn word(self) -> usize {
        match self {
            Self::Classic => 4,
            Self::Big => 8,
        }
    }

    /// The header of the file, whose first directory lies at `first`.
    pub(super) fn header(self, first: u64) -> Vec<u8> {
        let mut header = b"II".to_vec();
        match self {
            Self::Classic => header.extend_from_slice(&42_u16.to_le_bytes()),
            // 43, offsets of 8 bytes, reserved.
            Self::Big => header.extend_from_slice(&[43, 0, 8, 0, 0, 0]),
        }
        self.append_word(&mut header, first);
        header
    }

    fn append_word(self, out: &mut Vec<u8>, value: u64) {
        out.extend_from_slice(&value.to_le_bytes()[..self.word()]);
    }
}

/// The value of a tag.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Short(Vec<u16>),
    Long(Vec<u32>),
    Double(Vec<f64>),
    Ascii(String),
    /// File positions and sizes: as wide as the flavour's offsets.
    Words(Vec<u64>),
}

impl Value {
    pub(super) fn short(value: u16) -> Self {
        Self::Short(vec![value])
    }

    pub(super) fn long(value: u32) -> Self {
        Self::Long(vec![value])
    }

    const fn type_code(&self, flavour: Flavour) -> u16 {
        match (self, flavour) {
            (Self::Ascii(_), _) => 2,
            (Self::Short(_), _) => 3,
            (Self::Long(_), _) | (Self::Words(_), Flavour::Classic) => 4,
            (Self::Double(_), _) => 12,
            (Self::Words(_), Flavour::Big) => 16,
        }
    }

    const fn count(&self) -> usize {
        match self {
            Self::Short(v) => v.len(),
            Self::Long(v) => v.len(),
            Self::Double(v) => v.len(),
            Self::Words(v) => v.len(),
            // The terminating zero counts.
            Self::Ascii(text) => text.len() + 1,
        }
    }

    const fn byte_len(&self, flavour: Flavour) -> usize {
        self.count()
            * match self {
                Self::Ascii(_) => 1,
                Self::Short(_) => 2,
                Self::Long(_) => 4,
                Self::Double(_) => 8,
                Self::Words(_) => flavour.word(),
            }
    }

    fn append(&self, flavour: Flavour, out: &mut Vec<u8>) {
        match self {
            Self::Short(v) => v.iter().for_each(|n| out.extend_from_slice(&n.to_le_bytes())),
            Self::Long(v) => v.iter().for_each(|n| out.extend_from_slice(&n.to_le_bytes())),
            Self::Double(v) => v.iter().for_each(|n| out.extend_from_slice(&n.to_le_bytes())),
            Self::Words(v) => v.iter().for_each(|&n| flavour.append_word(out, n)),
            Self::Ascii(text) => {
                out.extend_from_slice(text.as_bytes());
                out.push(0);
            }
        }
    }
}

/// One image file directory: tags in ascending order, as TIFF wants them.
#[derive(Clone, Debug, Default)]
pub(super) struct Directory(pub(super) BTreeMap<u16, Value>);

impl Directory {
    pub(super) fn set(&mut self, tag: u16, value: Value) {
        self.0.insert(tag, value);
    }

    fn table_len(&self, flavour: Flavour) -> usize {
        match flavour {
            Flavour::Classic => 2 + 12 * self.0.len() + 4,
            Flavour::Big => 8 + 20 * self.0.len() + 8,
        }
    }

    /// Bytes of the directory with the values that do not fit into it, a multiple of 8.
    pub(super) fn byte_len(&self, flavour: Flavour) -> u64 {
        let outside: usize = self
            .0
            .values()
            .map(|value| value.byte_len(flavour))
            .filter(|&len| len > flavour.word())
            .map(|len| len.next_multiple_of(8))
            .sum();
        (self.table_len(flavour).next_multiple_of(8) + outside) as u64
    }

    /// Appends the directory, which will lie at file position `at` (a multiple of 8), with the
    /// position of the next one (0: none).
    pub(super) fn append(&self, flavour: Flavour, at: u64, next: u64, out: &mut Vec<u8>) {
        let start = out.len();
        let mut outside = Vec::new();
        let outside_at = at + self.table_len(flavour).next_multiple_of(8) as u64;
        match flavour {
            Flavour::Classic => out.extend_from_slice(&(self.0.len() as u16).to_le_bytes()),
            Flavour::Big => out.extend_from_slice(&(self.0.len() as u64).to_le_bytes()),
        }
        for (&tag, value) in &self.0 {
            out.extend_from_slice(&tag.to_le_bytes());
            out.extend_from_slice(&value.type_code(flavour).to_le_bytes());
            flavour.append_word(out, value.count() as u64);
            if value.byte_len(flavour) <= flavour.word() {
                let end = out.len() + flavour.word();
                value.append(flavour, out);
                out.resize(end, 0);
            } else {
                flavour.append_word(out, outside_at + outside.len() as u64);
                value.append(flavour, &mut outside);
                outside.resize(outside.len().next_multiple_of(8), 0);
            }
        }
        flavour.append_word(out, next);
        let table = (out.len() - start).next_multiple_of(8);
        out.resize(start + table, 0);
        out.extend_from_slice(&outside);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_is_as_long_as_it_says() {
        let mut directory = Directory::default();
        directory.set(IMAGE_WIDTH, Value::long(7));
        directory.set(BITS_PER_SAMPLE, Value::Short(vec![8; 3]));
        directory.set(GDAL_NODATA, Value::Ascii("nan".to_owned()));
        directory.set(TILE_OFFSETS, Value::Words(vec![1, 2]));
        for flavour in [Flavour::Classic, Flavour::Big] {
            let mut out = Vec::new();
            directory.append(flavour, 16, 0, &mut out);
            assert_eq!(out.len() as u64, directory.byte_len(flavour));
            assert_eq!(out.len() % 8, 0);
        }
    }
}
