//! From coefficients to samples, and from samples to RGB, in the integer arithmetic of the
//! Independent JPEG Group's library: the pixels are the ones that Pillow and GDAL read.

/// Fraction bits of the constants, and of values between the two passes.
const CONST_BITS: i32 = 13;
const PASS1_BITS: i32 = 2;

/// One pass over eight values (Loeffler, Ligtenberg and Moschytz 1989, 12 multiplications),
/// scaled by 2^`CONST_BITS` and then shifted right by `shift` with rounding.
fn pass(input: [i32; 8], shift: i32) -> [i32; 8] {
    let mul = i32::wrapping_mul;
    let [s0, s1, s2, s3, s4, s5, s6, s7] = input;
    let z1 = mul(s2.wrapping_add(s6), 4433);
    let even2 = z1.wrapping_sub(mul(s6, 15_137));
    let even3 = z1.wrapping_add(mul(s2, 6270));
    let even0 = s0.wrapping_add(s4).wrapping_shl(CONST_BITS as u32);
    let even1 = s0.wrapping_sub(s4).wrapping_shl(CONST_BITS as u32);
    let a = [
        even0.wrapping_add(even3),
        even1.wrapping_add(even2),
        even1.wrapping_sub(even2),
        even0.wrapping_sub(even3),
    ];
    let (z1, z2) = (s7.wrapping_add(s1), s5.wrapping_add(s3));
    let (z3, z4) = (s7.wrapping_add(s3), s5.wrapping_add(s1));
    let z5 = mul(z3.wrapping_add(z4), 9633);
    let (z1, z2) = (mul(z1, -7373), mul(z2, -20_995));
    let z3 = mul(z3, -16_069).wrapping_add(z5);
    let z4 = mul(z4, -3196).wrapping_add(z5);
    let b = [
        mul(s1, 12_299).wrapping_add(z1).wrapping_add(z4),
        mul(s3, 25_172).wrapping_add(z2).wrapping_add(z3),
        mul(s5, 16_819).wrapping_add(z2).wrapping_add(z4),
        mul(s7, 2446).wrapping_add(z1).wrapping_add(z3),
    ];
    let scale = |value: i32| value.wrapping_add(1 << (shift - 1)) >> shift;
    std::array::from_fn(|i| {
        if i < 4 { scale(a[i].wrapping_add(b[i])) } else { scale(a[7 - i].wrapping_sub(b[7 - i])) }
    })
}

/// Coefficients (row-major, not in zigzag order) to samples: dequantised, transformed, moved to 0 to 255.
pub(super) fn samples(coefficients: &[i16; 64], quantisation: &[u16; 64]) -> [u8; 64] {
    let mut between = [0_i32; 64];
    for column in 0..8 {
        let input = std::array::from_fn(|row| {
            let at = row * 8 + column;
            i32::from(coefficients[at]).wrapping_mul(i32::from(quantisation[at]))
        });
        let output = pass(input, CONST_BITS - PASS1_BITS);
        for (row, value) in output.into_iter().enumerate() {
            between[row * 8 + column] = value;
        }
    }
    let mut out = [0; 64];
    for (row, out) in between.as_chunks::<8>().0.iter().zip(out.as_chunks_mut::<8>().0) {
        *out = pass(*row, CONST_BITS + PASS1_BITS + 3)
            .map(|v| (v.saturating_add(128)).clamp(0, 255) as u8);
    }
    out
}

/// How a component's row becomes a full one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Upsample {
    /// It is full.
    None,
    /// Twice as wide, by a triangle filter.
    Across,
    /// Twice as high, by a triangle filter.
    Down,
    /// Both.
    Both,
    /// Each sample as often as it takes, across.
    Repeat(usize),
}

impl Upsample {
    /// For a component that is `across` and `down` times smaller than the picture, `width` samples wide.
    pub(super) fn of(across: usize, down: usize, width: usize) -> Self {
        match (across, down) {
            (1, 1) => Self::None,
            (2, 1) if width > 2 => Self::Across,
            (2, 2) if width > 2 => Self::Both,
            (1, 2) => Self::Down,
            _ => Self::Repeat(across),
        }
    }

    /// Whether the rows above and below count.
    pub(super) fn looks_around(self) -> bool {
        matches!(self, Self::Down | Self::Both)
    }

    /// One full row from the row that it lies in and the nearer of the neighbouring rows, `below` if
    /// that is the next one.
    pub(super) fn row(self, near: &[u8], far: &[u8], below: bool, out: &mut Vec<u8>) {
        out.clear();
        match self {
            Self::None => out.extend_from_slice(near),
            Self::Repeat(times) => {
                out.extend(near.iter().flat_map(|value| std::iter::repeat_n(*value, times)));
            }
            Self::Across => {
                let last = near.len() - 1;
                for (i, &value) in near.iter().enumerate() {
                    let at = |i: usize| u16::from(near[i]);
                    let three = 3 * u16::from(value);
                    out.push(if i == 0 { value } else { ((three + at(i - 1) + 1) >> 2) as u8 });
                    out.push(if i == last { value } else { ((three + at(i + 1) + 2) >> 2) as u8 });
                }
            }
            Self::Down => {
                let bias = if below { 2 } else { 1 };
                let mix =
                    |(n, f): (&u8, &u8)| ((3 * u16::from(*n) + u16::from(*f) + bias) >> 2) as u8;
                out.extend(near.iter().zip(far).map(mix));
            }
            Self::Both => {
                let sum = |i: usize| 3 * u16::from(near[i]) + u16::from(far[i]);
                let last = near.len() - 1;
                for i in 0..near.len() {
                    let this = sum(i);
                    let (before, after) = (sum(i.saturating_sub(1)), sum((i + 1).min(last)));
                    out.push(((3 * this + before + 8) >> 4) as u8);
                    out.push(((3 * this + after + 7) >> 4) as u8);
                }
            }
        }
    }
}

/// JFIF's colours to RGB.
pub(super) fn rgb(y: u8, cb: u8, cr: u8) -> [u8; 3] {
    const HALF: i32 = 1 << 15;
    let (y, cb, cr) = (i32::from(y), i32::from(cb) - 128, i32::from(cr) - 128);
    [
        y + ((91_881 * cr + HALF) >> 16),
        y + ((-22_554 * cb - 46_802 * cr + HALF) >> 16),
        y + ((116_130 * cb + HALF) >> 16),
    ]
    .map(|value| value.clamp(0, 255) as u8)
}
