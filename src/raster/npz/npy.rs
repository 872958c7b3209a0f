//! The `.npy` format: a Python dictionary as text, then the values.

use super::{NpyOwned, NpyValues, Reason};

pub(super) const MAGIC: &[u8] = b"\x93NUMPY";

/// Header of version 1.0 for a row-major array. numpy pads to 64 bytes so that values are aligned.
pub(super) fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let axes = match shape {
        [only] => format!("{only},"),
        _ => shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", "),
    };
    let text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({axes}), }}");
    // Magic, version, length and the final line feed take 11 bytes.
    let total = (11 + text.len()).next_multiple_of(64);
    let mut header = MAGIC.to_vec();
    header.extend_from_slice(&[1, 0]);
    // 65 kB of header would be an array of thousands of axes, which numpy does not have.
    header.extend_from_slice(&((total - 10) as u16).to_le_bytes());
    header.extend_from_slice(text.as_bytes());
    header.resize(total - 1, b' ');
    header.push(b'\n');
    header
}

/// Lengths of the axes of an array, of whose bytes only the first are there.
pub(super) fn shape(bytes: &[u8]) -> Option<Vec<usize>> {
    let (header, _) = split(bytes).ok()?;
    Some(Dictionary::new(std::str::from_utf8(header).ok()?).header()?.shape)
}

/// Reads one array.
pub(super) fn parse(bytes: &[u8]) -> Result<NpyOwned, Reason> {
    let (header, data) = split(bytes)?;
    let text = std::str::from_utf8(header).map_err(|_| "its header is no text")?;
    let Header { descr, fortran_order, shape } =
        Dictionary::new(text).header().ok_or_else(|| {
            let start: String = text.trim().chars().take(200).collect();
            format!("its header is not numpy's: `{start}`")
        })?;
    let kind = Kind::of(&descr)?;
    let count = shape.iter().try_fold(1_usize, |n, &d| n.checked_mul(d));
    let expected = count.and_then(|n| n.checked_mul(kind.size));
    if expected != Some(data.len()) {
        return Err(format!(
            "shape {shape:?} of `{descr}` does not fit its {} bytes of values",
            data.len()
        ));
    }
    let values = kind.decode(data)?;
    let values = if fortran_order { values.to_row_major(&shape) } else { values };
    Ok(NpyOwned { shape, values })
}

fn split(bytes: &[u8]) -> Result<(&[u8], &[u8]), Reason> {
    let rest = bytes.strip_prefix(MAGIC).ok_or("it is not in npy format")?;
    let cut_off = "its header is cut off";
    let (&[major, _], rest) = rest.split_first_chunk().ok_or(cut_off)?;
    let (len, rest) = match major {
        1 => {
            let (len, rest) = rest.split_first_chunk().ok_or(cut_off)?;
            (usize::from(u16::from_le_bytes(*len)), rest)
        }
        2 | 3 => {
            let (len, rest) = rest.split_first_chunk().ok_or(cut_off)?;
            (u32::from_le_bytes(*len) as usize, rest)
        }
        other => return Err(format!("version {other} of the npy format is not known")),
    };
    rest.split_at_checked(len).ok_or_else(|| cut_off.to_owned())
}

struct Header {
    descr: String,
    fortran_order: bool,
    shape: Vec<usize>,
}

/// A reader of the one dictionary that npy headers hold: string keys; strings, booleans and tuples
/// of integers as values, in any order and spacing.
struct Dictionary<'a> {
    rest: &'a str,
}

impl<'a> Dictionary<'a> {
    const fn new(text: &'a str) -> Self {
        Self { rest: text }
    }

    fn header(mut self) -> Option<Header> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        self.token("{")?;
        while self.token("}").is_none() {
            let key = self.string()?;
            self.token(":")?;
            match key {
                // A structured type is a list, which `string` does not take.
                "descr" => descr = Some(self.string()?.to_owned()),
                "fortran_order" => fortran_order = Some(self.boolean()?),
                "shape" => shape = Some(self.tuple()?),
                _ => return None,
            }
            if self.token(",").is_none() {
                self.token("}")?;
                break;
            }
        }
        let rest = self.rest.trim();
        rest.is_empty().then_some(())?;
        Some(Header { descr: descr?, fortran_order: fortran_order?, shape: shape? })
    }

    fn token(&mut self, token: &str) -> Option<()> {
        self.rest = self.rest.trim_start().strip_prefix(token)?;
        Some(())
    }

    fn string(&mut self) -> Option<&'a str> {
        let rest = self.rest.trim_start();
        let quote = rest.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
        let (text, after) = rest[1..].split_once(quote)?;
        self.rest = after;
        Some(text)
    }

    fn boolean(&mut self) -> Option<bool> {
        if self.token("True").is_some() {
            return Some(true);
        }
        self.token("False").map(|()| false)
    }

    fn tuple(&mut self) -> Option<Vec<usize>> {
        let mut values = Vec::new();
        self.token("(")?;
        while self.token(")").is_none() {
            let rest = self.rest.trim_start();
            let digits = rest.find(|c: char| !c.is_ascii_digit())?;
            values.push(rest[..digits].parse().ok()?);
            self.rest = &rest[digits..];
            // Python 2 wrote its long integers so.
            let _ = self.token("L");
            if self.token(",").is_none() {
                self.token(")")?;
                break;
            }
        }
        Some(values)
    }
}

/// An element type: letter of its kind, bytes, byte order.
struct Kind {
    letter: char,
    size: usize,
    big_endian: bool,
}

impl Kind {
    fn of(descr: &str) -> Result<Self, Reason> {
        let unknown =
            || format!("values of type `{descr}` are not read; save them as float32, for example");
        let big_endian = match descr.chars().next() {
            Some('<' | '|') => false,
            Some('>') => true,
            // `=` never leaves the machine it was written on.
            Some('=') => cfg!(target_endian = "big"),
            _ => return Err(unknown()),
        };
        let mut rest = descr[1..].chars();
        let letter = rest.next().ok_or_else(unknown)?;
        let size = rest.as_str().parse().map_err(|_| unknown())?;
        match (letter, size) {
            ('f', 2 | 4 | 8) | ('u' | 'i', 1 | 2 | 4 | 8) | ('b', 1) => {
                Ok(Self { letter, size, big_endian })
            }
            _ => Err(unknown()),
        }
    }

    fn decode(&self, data: &[u8]) -> Result<NpyValues, Reason> {
        macro_rules! values {
            ($variant:ident, $type:ty) => {{
                let items = data.as_chunks().0.iter();
                NpyValues::$variant(if self.big_endian {
                    items.map(|b| <$type>::from_be_bytes(*b)).collect()
                } else {
                    items.map(|b| <$type>::from_le_bytes(*b)).collect()
                })
            }};
        }
        Ok(match (self.letter, self.size) {
            ('f', 2) => {
                let items = data.as_chunks().0.iter();
                let be = self.big_endian;
                NpyValues::F32(
                    items
                        .map(|b| if be { u16::from_be_bytes(*b) } else { u16::from_le_bytes(*b) })
                        .map(half_to_f32)
                        .collect(),
                )
            }
            ('f', 4) => values!(F32, f32),
            ('f', 8) => values!(F64, f64),
            ('b' | 'u', 1) => NpyValues::U8(data.to_vec()),
            ('u', 2) => values!(U16, u16),
            ('u', 4) => values!(U32, u32),
            ('u', 8) => values!(U64, u64),
            ('i', 1) => values!(I8, i8),
            ('i', 2) => values!(I16, i16),
            ('i', 4) => values!(I32, i32),
            ('i', 8) => values!(I64, i64),
            (letter, size) => return Err(format!("values of type `{letter}{size}` are not read")),
        })
    }
}

/// IEEE 754 binary16 to binary32, exactly.
fn half_to_f32(half: u16) -> f32 {
    let sign = u32::from(half & 0x8000) << 16;
    let exponent = u32::from(half >> 10 & 0x1f);
    let fraction = u32::from(half & 0x03ff);
    let magnitude = match exponent {
        // Subnormal: a multiple of 2^-24.
        0 => (fraction as f32 * f32::from_bits((127 - 24) << 23)).to_bits(),
        0x1f => 0x7f80_0000 | fraction << 13,
        _ => (exponent + 127 - 15) << 23 | fraction << 13,
    };
    f32::from_bits(sign | magnitude)
}

/// Reorders values whose first axis varies fastest so that the last one does.
pub(super) fn to_row_major<T: Copy>(values: &[T], shape: &[usize]) -> Vec<T> {
    let mut index = vec![0_usize; shape.len()];
    let mut strides = Vec::with_capacity(shape.len());
    let mut stride = 1;
    for &axis in shape {
        strides.push(stride);
        stride *= axis;
    }
    let mut out = Vec::with_capacity(values.len());
    let mut at = 0;
    for _ in 0..values.len() {
        out.push(values[at]);
        // Counts up, last axis first.
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_exact() {
        for (half, value) in [
            (0x0000_u16, 0.0_f32),
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x03ff, 6.097_555e-5),
            (0x0400, 6.103_515_6e-5),
            (0x7c00, f32::INFINITY),
            (0xfc00, f32::NEG_INFINITY),
            (0x3555, 0.333_251_95),
        ] {
            assert_eq!(half_to_f32(half).to_bits(), value.to_bits(), "{half:04x}");
        }
        assert!(half_to_f32(0x7e00).is_nan());
    }

    #[test]
    fn headers_in_any_dress_are_read() {
        let read = |text: &str| {
            Dictionary::new(text).header().map(|h| (h.descr, h.fortran_order, h.shape))
        };
        let plain = Some(("<f4".to_owned(), false, vec![640, 640]));
        for text in [
            "{'descr': '<f4', 'fortran_order': False, 'shape': (640, 640), }          \n",
            "{\"shape\":(640,640),'fortran_order':False,\"descr\":\"<f4\"}",
            " { 'descr' : '<f4' , 'fortran_order' : False , 'shape' : ( 640L , 640L , ) , } \n",
        ] {
            assert_eq!(read(text), plain, "{text}");
        }
        let of_shape = |shape: &str| {
            read(&format!("{{'descr': '|u1', 'fortran_order': True, 'shape': {shape}, }}"))
                .map(|h| h.2)
        };
        assert_eq!(of_shape("()"), Some(vec![]));
        assert_eq!(of_shape("(3,)"), Some(vec![3]));
        for bad in ["(3", "(-1,)", "3", "(3;4)", "(99999999999999999999999,)"] {
            assert_eq!(of_shape(bad), None, "{bad}");
        }
        for bad in [
            "",
            "{",
            "{}",
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<f4', 'fortran_order': 0, 'shape': (1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), } x",
            "{'descr': '<f4, 'fortran_order': False, 'shape': (1,), }",
        ] {
            assert_eq!(read(bad), None, "{bad}");
        }
    }

    #[test]
    fn headers_are_aligned_and_read_back() {
        for shape in [&[][..], &[7], &[640, 640], &[1, 2, 3, 4], &[123_456_789; 9]] {
            let header = header("<f4", shape);
            assert_eq!(header.len() % 64, 0);
            let (text, rest) = split(&header).expect("splits");
            assert!(rest.is_empty() && text.ends_with(b"\n"));
            let text = std::str::from_utf8(text).expect("text");
            assert_eq!(Dictionary::new(text).header().expect("a header").shape, shape);
        }
    }
}
