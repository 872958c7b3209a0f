//! Whole numbers that sort as errors do: how quantiles are counted.

/// Coarse bins: the upper 16 of the 32 bits of a key (sign, exponent, 7 bits of the mantissa).
pub(super) const COARSE: usize = 1 << 16;

/// Position of zero among the keys.
const ZERO: u32 = 1 << 31;

/// An error rounded to `f32`, beyond its range the largest `f32`, and never -0.
#[inline(always)]
pub(super) fn rounded(error: f64) -> f32 {
    (error as f32).clamp(f32::MIN, f32::MAX) + 0.0
}

/// The key of a finite `f32`: keys sort as the numbers do.
#[inline(always)]
pub(super) fn key(value: f32) -> u32 {
    let bits = value.to_bits();
    // All ones for negative numbers, the sign alone for others.
    bits ^ (((bits as i32 >> 31) as u32) | ZERO)
}

/// The number of a key.
pub(super) fn value(key: u32) -> f32 {
    f32::from_bits(if key >= ZERO { key ^ ZERO } else { !key })
}

/// Coarse bin of a key.
#[inline(always)]
pub(super) fn coarse(key: u32) -> usize {
    (key >> 16) as usize
}

/// Smallest and largest number of a coarse bin, cut to the finite ones.
pub(super) fn limits(bin: usize) -> (f32, f32) {
    let low = (bin as u32) << 16;
    let finite = |key: u32| value(key.clamp(self::key(f32::MIN), self::key(f32::MAX)));
    (finite(low), finite(low | 0xFFFF))
}

/// The coarse bin of the numbers of opposite sign.
pub(super) fn mirrored(bin: usize) -> usize {
    COARSE - 1 - bin
}

/// Numbers that are `f32` from `2^exponent` upwards, and multiples of the spacing found there below
/// it: `f32` whose subnormal numbers begin early. Codes are consecutive whole numbers, odd about 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Grid {
    /// Bits of the `f32` number `2^exponent`.
    floor_bits: u32,
    /// `2^(exponent - 23)`.
    spacing_bits: u32,
}

impl Grid {
    /// Every `f32` for itself.
    pub const EXACT: Self = Self { floor_bits: 1 << 23, spacing_bits: 1 };

    /// The grid whose spacing near zero is that of `f32` just under `scale` (a finite number above
    /// 0), or half of it.
    pub fn for_scale(scale: f32) -> Self {
        let exponent = (scale.to_bits() >> 23).saturating_sub(1).max(1);
        let spacing_bits = if exponent > 23 { (exponent - 23) << 23 } else { 1 << (exponent - 1) };
        Self { floor_bits: exponent << 23, spacing_bits }
    }

    fn spacing(self) -> f64 {
        f64::from(f32::from_bits(self.spacing_bits))
    }

    /// The code of a number: the nearest of the grid.
    #[inline(always)]
    pub fn code(self, value: f32) -> i64 {
        let magnitude = value.to_bits() & 0x7FFF_FFFF;
        let code = if magnitude >= self.floor_bits {
            i64::from(magnitude - self.floor_bits) + (1 << 23)
        } else {
            // Both are exact: the spacing is a power of two.
            (f64::from(value.abs()) / self.spacing()).round() as i64
        };
        if value < 0.0 { -code } else { code }
    }

    /// The number of a code.
    pub fn value(self, code: i64) -> f64 {
        let magnitude = code.unsigned_abs();
        let value = if magnitude >= 1 << 23 {
            f64::from(f32::from_bits((magnitude - (1 << 23)) as u32 + self.floor_bits))
        } else {
            magnitude as f64 * self.spacing()
        };
        if code < 0 { -value } else { value }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HARD: [f32; 14] = [
        f32::MIN,
        -4000.001,
        -1.0,
        -f32::MIN_POSITIVE,
        -1e-45,
        0.0,
        1e-45,
        3e-45,
        f32::MIN_POSITIVE,
        1e-20,
        0.1,
        1.0,
        1.000_000_1,
        f32::MAX,
    ];

    #[test]
    fn keys_and_codes_sort_as_numbers_and_return() {
        for pair in HARD.windows(2) {
            assert!(key(pair[0]) < key(pair[1]) && pair[0] < pair[1]);
            assert!(Grid::EXACT.code(pair[0]) < Grid::EXACT.code(pair[1]));
        }
        for number in HARD {
            assert_eq!(value(key(number)).to_bits(), number.to_bits());
            assert_eq!(Grid::EXACT.value(Grid::EXACT.code(number)), f64::from(number));
            let (low, high) = limits(coarse(key(number)));
            assert!(low <= number && number <= high);
            if number != 0.0 {
                assert_eq!(coarse(key(-number)), mirrored(coarse(key(number))));
            }
        }
        assert_eq!(rounded(-0.0).to_bits(), 0);
        assert_eq!(rounded(-1e-300).to_bits(), 0);
        assert_eq!(rounded(7e38), f32::MAX);
        assert_eq!(rounded(-7e38), f32::MIN);
    }

    #[test]
    fn a_coarser_grid_is_off_by_half_its_spacing_at_most_and_keeps_order() {
        for scale in [1e-45_f32, 1e-38, 3e-38, 1e-31, 0.3, 1.0, 5.0, 4000.0, 3e38] {
            let grid = Grid::for_scale(scale);
            assert!(grid.spacing() <= f64::from(scale) * 2f64.powi(-23) || scale < 2e-38);
            assert!(grid.spacing() >= f64::from(scale) * 2f64.powi(-26));
            let mut last = i64::MIN;
            for number in HARD {
                let code = grid.code(number);
                assert!(code >= last);
                last = code;
                let back = grid.value(code);
                let off = (back - f64::from(number)).abs();
                assert!(off <= grid.spacing() / 2.0, "{scale} {number} {back}");
                assert_eq!(grid.code(back as f32), code);
            }
        }
    }
}
