//! From stored samples to heights: the one place where a no-data marking becomes NaN.
//!
//! Both readers hand their samples through [`SampleDecoder`], so that they cannot differ: every
//! sample type fits into an `f64` without loss, the no-data value is brought into the band's own
//! type once, and the comparison of the two is then a comparison in that type.

use super::NodataRule;

/// A stored sample type that heights come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SampleType {
    Byte,
    Int8,
    UInt16,
    Int16,
    UInt32,
    Int32,
    Float32,
    Float64,
}

impl SampleType {
    /// GDAL's name.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Byte => "Byte",
            Self::Int8 => "Int8",
            Self::UInt16 => "UInt16",
            Self::Int16 => "Int16",
            Self::UInt32 => "UInt32",
            Self::Int32 => "Int32",
            Self::Float32 => "Float32",
            Self::Float64 => "Float64",
        }
    }

    /// Bytes of one sample.
    #[cfg(feature = "gdal")]
    pub(super) const fn bytes(self) -> usize {
        match self {
            Self::Byte | Self::Int8 => 1,
            Self::UInt16 | Self::Int16 => 2,
            Self::UInt32 | Self::Int32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }

    /// Smallest and largest value of an integer type.
    const fn integer_range(self) -> Option<(f64, f64)> {
        match self {
            Self::Byte => Some((0.0, 255.0)),
            Self::Int8 => Some((-128.0, 127.0)),
            Self::UInt16 => Some((0.0, 65_535.0)),
            Self::Int16 => Some((-32_768.0, 32_767.0)),
            Self::UInt32 => Some((0.0, 4_294_967_295.0)),
            Self::Int32 => Some((-2_147_483_648.0, 2_147_483_647.0)),
            Self::Float32 | Self::Float64 => None,
        }
    }

    /// `value` as a sample of this type, or `None` where no sample can equal it.
    fn exactly(self, value: f64) -> Option<f64> {
        match self.integer_range() {
            Some((low, high)) => {
                (value >= low && value <= high && value.fract() == 0.0).then_some(value)
            }
            None => Some(self.nearest(value)),
        }
    }

    /// The sample of this type that is nearest to `value`: what GDAL fills a sparse block with.
    pub(super) fn nearest(self, value: f64) -> f64 {
        match self.integer_range() {
            Some(_) if value.is_nan() => 0.0,
            Some((low, high)) => libm::round(value).clamp(low, high),
            None if self == Self::Float32 => f64::from(value as f32),
            None => value,
        }
    }
}

/// Values that the file does not declare as no-data and that were read as such.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UndeclaredNodata(u8);

impl UndeclaredNodata {
    const MINUS_9999: u8 = 1;
    const MINUS_32768: u8 = 2;
    const HUGE: u8 = 4;

    /// Whether no such value was met.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The values in words: `-9999`, `-32768`, `beyond 1e38`.
    #[must_use]
    pub fn values(self) -> Vec<&'static str> {
        [
            (Self::MINUS_9999, "-9999"),
            (Self::MINUS_32768, "-32768"),
            (Self::HUGE, "beyond 1e38 (like -3.4028235e38)"),
        ]
        .into_iter()
        .filter_map(|(bit, text)| (self.0 & bit != 0).then_some(text))
        .collect()
    }

    /// As a bit set, to be kept in an atomic.
    pub(crate) const fn bits(self) -> u8 {
        self.0
    }

    /// From [`UndeclaredNodata::bits`].
    pub(crate) const fn from_bits(bits: u8) -> Self {
        Self(bits)
    }
}

impl std::ops::BitOrAssign for UndeclaredNodata {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

/// No height is this large; 1.70141e38 and 3.4028235e38 are fill values of well-known programs.
const HUGE: f64 = 1e38;

/// Turns stored samples into heights. A NaN among the values to compare with matches nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct SampleDecoder {
    nodata: f64,
    minus_9999: f64,
    minus_32768: f64,
    huge: f64,
    scale: f64,
    offset: f64,
    /// Whether the file's mask counts.
    pub(super) use_mask: bool,
}

impl SampleDecoder {
    /// `declared` is the file's no-data value, `scale` and `offset` the file's.
    pub(super) fn new(
        sample_type: SampleType,
        rule: NodataRule,
        declared: Option<f64>,
        scale: f64,
        offset: f64,
    ) -> Self {
        let nodata = match rule {
            NodataRule::FromFile => declared,
            NodataRule::Value(value) => Some(value),
            NodataRule::None => None,
        };
        let nodata = nodata.and_then(|v| sample_type.exactly(v)).unwrap_or(f64::NAN);
        // Stored integers with a scale are codes: -9999 centimetres are -99.99 m, a height.
        let guess = rule == NodataRule::FromFile && scale == 1.0 && offset == 0.0;
        let unless_declared = |v: f64, on: bool| if on && v != nodata { v } else { f64::NAN };
        Self {
            nodata,
            minus_9999: unless_declared(-9999.0, guess),
            minus_32768: unless_declared(-32768.0, guess && sample_type == SampleType::Int16),
            huge: if rule == NodataRule::None { f64::INFINITY } else { HUGE },
            scale,
            offset,
            use_mask: rule == NodataRule::FromFile,
        }
    }

    /// Decodes a run of samples; where a mask is given, its zeros are no-data.
    pub(super) fn decode(
        &self,
        out: &mut [f32],
        samples: impl Iterator<Item = f64>,
        mask: Option<&[u8]>,
    ) -> UndeclaredNodata {
        if self.scale == 1.0 && self.offset == 0.0 {
            self.decode_scaled(out, samples, mask, |v| v as f32)
        } else {
            let (scale, offset) = (self.scale, self.offset);
            self.decode_scaled(out, samples, mask, move |v| (v * scale + offset) as f32)
        }
    }

    #[inline(always)]
    fn decode_scaled(
        &self,
        out: &mut [f32],
        samples: impl Iterator<Item = f64>,
        mask: Option<&[u8]>,
        height: impl Fn(f64) -> f32,
    ) -> UndeclaredNodata {
        let (mut nines, mut minimum, mut huge) = (false, false, false);
        let mut one = |v: f64, valid: bool| {
            let declared = v == self.nodata;
            let live = valid & !declared;
            let is_nines = live & (v == self.minus_9999);
            let is_minimum = live & (v == self.minus_32768);
            let is_huge = live & (v.abs() >= self.huge) & v.is_finite();
            nines |= is_nines;
            minimum |= is_minimum;
            huge |= is_huge;
            let h = height(v);
            if live & !is_nines & !is_minimum & !is_huge & h.is_finite() { h } else { f32::NAN }
        };
        match mask {
            None => out.iter_mut().zip(samples).for_each(|(o, v)| *o = one(v, true)),
            Some(mask) => out
                .iter_mut()
                .zip(samples)
                .zip(mask)
                .for_each(|((o, v), &valid)| *o = one(v, valid != 0)),
        }
        UndeclaredNodata(
            u8::from(nines) * UndeclaredNodata::MINUS_9999
                + u8::from(minimum) * UndeclaredNodata::MINUS_32768
                + u8::from(huge) * UndeclaredNodata::HUGE,
        )
    }
}

/// The declared no-data value in the band's own type, and a warning where no sample can have it.
pub(super) fn declared_nodata(
    sample_type: SampleType,
    declared: Option<f64>,
) -> (Option<f64>, Option<String>) {
    let Some(value) = declared else { return (None, None) };
    match sample_type.exactly(value) {
        Some(exact) => (Some(exact), None),
        None => (
            Some(value),
            Some(format!(
                "the declared no-data value {value} cannot occur in samples of type {}",
                sample_type.name()
            )),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode(
        sample_type: SampleType,
        rule: NodataRule,
        declared: Option<f64>,
        samples: &[f64],
    ) -> (Vec<Option<f32>>, UndeclaredNodata) {
        let decoder = SampleDecoder::new(sample_type, rule, declared, 1.0, 0.0);
        let mut out = vec![0.0; samples.len()];
        let found = decoder.decode(&mut out, samples.iter().copied(), None);
        (out.into_iter().map(|v| (!v.is_nan()).then_some(v)).collect(), found)
    }

    #[test]
    fn nodata_is_compared_in_the_bands_own_type() {
        let lowest = f64::from(f32::MIN);
        // Fifteen digits, as GDAL's older versions wrote it, and the neighbouring float.
        let (out, found) = decode(
            SampleType::Float32,
            NodataRule::FromFile,
            Some(-3.402_823_466_385_29e38),
            &[lowest, 1.0],
        );
        assert_eq!(out, [None, Some(1.0)]);
        assert!(found.is_empty(), "declared, so nothing is undeclared");

        // 0.1 as f32 is not 0.1 as f64.
        let tenth = f64::from(0.1_f32);
        assert_eq!(
            decode(SampleType::Float32, NodataRule::FromFile, Some(0.1), &[tenth]).0,
            [None]
        );
        assert_eq!(
            decode(SampleType::Float64, NodataRule::FromFile, Some(0.1), &[tenth, 0.1]).0,
            [Some(0.1), None]
        );
        // A byte cannot be -9999, and 255.5 is not 255.
        assert_eq!(
            decode(SampleType::Byte, NodataRule::FromFile, Some(-9999.0), &[0.0]).0,
            [Some(0.0)]
        );
        assert_eq!(
            decode(SampleType::Byte, NodataRule::FromFile, Some(255.5), &[255.0]).0,
            [Some(255.0)]
        );
        assert_eq!(
            decode(SampleType::Byte, NodataRule::FromFile, Some(0.0), &[0.0, 1.0]).0,
            [None, Some(1.0)]
        );
    }

    #[test]
    fn undeclared_values_are_caught_once_and_only_where_they_cannot_be_heights() {
        let samples = [-9999.0, -32768.0, 1.5, f64::from(f32::MAX), -1.701_41e38];
        let (out, found) = decode(SampleType::Float32, NodataRule::FromFile, None, &samples);
        assert_eq!(out, [None, Some(-32768.0), Some(1.5), None, None]);
        assert_eq!(found.values(), ["-9999", "beyond 1e38 (like -3.4028235e38)"]);

        let (out, found) =
            decode(SampleType::Int16, NodataRule::FromFile, None, &[-32768.0, -9999.0, 7.0]);
        assert_eq!(out, [None, None, Some(7.0)]);
        assert_eq!(found.values(), ["-9999", "-32768"]);

        let (out, found) = decode(SampleType::Float32, NodataRule::None, None, &samples);
        assert!(out.iter().all(Option::is_some) && found.is_empty());

        // With a scale the stored number is a code.
        let decoder = SampleDecoder::new(SampleType::Int32, NodataRule::FromFile, None, 0.01, 0.0);
        let mut out = [0.0];
        assert!(decoder.decode(&mut out, [-9999.0].into_iter(), None).is_empty());
        assert_eq!(out, [-99.99]);
    }

    #[test]
    fn not_finite_is_nodata_under_every_rule() {
        let samples = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
        for rule in [NodataRule::FromFile, NodataRule::Value(5.0), NodataRule::None] {
            let (out, found) = decode(SampleType::Float64, rule, None, &samples);
            assert_eq!(out, [None; 3]);
            assert!(found.is_empty());
        }
        // 1e300 is finite, but no f32.
        assert_eq!(decode(SampleType::Float64, NodataRule::None, None, &[1e300]).0, [None]);
    }

    #[test]
    fn a_rule_given_by_the_user_replaces_the_files_marking() {
        let (out, found) = decode(
            SampleType::Float32,
            NodataRule::Value(5.0),
            Some(1.0),
            &[1.0, 5.0, -9999.0, f64::from(f32::MIN)],
        );
        assert_eq!(out, [Some(1.0), None, Some(-9999.0), None]);
        assert!(!found.is_empty());
    }

    #[test]
    fn masked_samples_are_nodata_and_are_not_counted_as_undeclared() {
        let decoder = SampleDecoder::new(SampleType::Float32, NodataRule::FromFile, None, 1.0, 0.0);
        let mut out = [0.0; 3];
        let found = decoder.decode(&mut out, [-9999.0, 1.0, 2.0].into_iter(), Some(&[0, 255, 1]));
        assert!(found.is_empty() && out[0].is_nan() && out[1..] == [1.0, 2.0]);
    }
}
