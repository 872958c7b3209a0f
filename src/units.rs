//! Units at public boundaries: lengths and angles that cannot be mixed up.
//!
//! Inside a kernel a number is a plain `f64`; where it crosses a module's public boundary it says
//! what it measures. Feet are never just feet: the US survey foot and the international foot differ
//! by 2 parts per million, which is 0.73 m at the eastings of Washington's State Plane.

use serde::{Deserialize, Serialize};
use std::fmt;

macro_rules! quantity {
    ($(#[$doc:meta])* $name:ident, $symbol:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub f64);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)?;
                f.write_str(concat!(" ", $symbol))
            }
        }
    };
}

quantity!(
    /// A length in metres.
    Metres,
    "m"
);
quantity!(
    /// An angle in degrees.
    Degrees,
    "deg"
);
quantity!(
    /// A length in US survey feet (1200/3937 m).
    UsSurveyFeet,
    "US survey ft"
);

/// Metres in one US survey foot, exactly 1200/3937 (EPSG:9003).
pub const US_SURVEY_FOOT_M: f64 = 1200.0 / 3937.0;
/// Metres in one international foot (EPSG:9002).
pub const FOOT_M: f64 = 0.3048;

impl From<UsSurveyFeet> for Metres {
    fn from(feet: UsSurveyFeet) -> Self {
        Self(feet.0 * US_SURVEY_FOOT_M)
    }
}

impl Degrees {
    /// The angle in radians.
    #[must_use]
    pub fn radians(self) -> f64 {
        self.0.to_radians()
    }
}

/// The linear unit of a coordinate system's axes or of a raster's heights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LinearUnit {
    /// SI metre (EPSG:9001).
    Metre,
    /// International foot, 0.3048 m (EPSG:9002).
    Foot,
    /// US survey foot, 1200/3937 m (EPSG:9003).
    UsSurveyFoot,
}

impl LinearUnit {
    /// Metres in one unit.
    #[must_use]
    pub const fn metres_per_unit(self) -> f64 {
        match self {
            Self::Metre => 1.0,
            Self::Foot => FOOT_M,
            Self::UsSurveyFoot => US_SURVEY_FOOT_M,
        }
    }

    /// The unit's EPSG code (9001, 9002 or 9003).
    #[must_use]
    pub const fn epsg(self) -> u16 {
        match self {
            Self::Metre => 9001,
            Self::Foot => 9002,
            Self::UsSurveyFoot => 9003,
        }
    }

    /// The name used on the command line and in files: `metre`, `foot` or `us-survey-foot`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Metre => "metre",
            Self::Foot => "foot",
            Self::UsSurveyFoot => "us-survey-foot",
        }
    }

    /// Recognises a unit by one of the names that GDAL, PROJ, ESRI and people write.
    ///
    /// A bare `ft`, `feet` or `foot` is the international foot; callers that know better (an
    /// `UNITS=feet` tag in a State Plane raster) must decide before they ask.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        let key: String = name
            .trim()
            .to_ascii_lowercase()
            .chars()
            .map(|c| if c == '-' || c == '_' { ' ' } else { c })
            .collect();
        match key.as_str() {
            "m" | "metre" | "metres" | "meter" | "meters" => Some(Self::Metre),
            "ft"
            | "foot"
            | "feet"
            | "international foot"
            | "international feet"
            | "foot (international)"
            | "intl foot" => Some(Self::Foot),
            "us survey foot" | "us survey feet" | "us ft" | "ftus" | "foot us"
            | "foot (us survey)" | "us foot" | "survey foot" | "u.s. survey foot"
            | "u.s. survey feet" | "foot us survey" | "sft" => Some(Self::UsSurveyFoot),
            _ => None,
        }
    }

    /// Recognises a unit by its size in metres, as WKT and GeoKeys give it (relative 1e-9).
    #[must_use]
    pub fn from_metres_per_unit(metres: f64) -> Option<Self> {
        [Self::Metre, Self::Foot, Self::UsSurveyFoot]
            .into_iter()
            .find(|unit| (metres / unit.metres_per_unit() - 1.0).abs() < 1e-9)
    }
}

impl fmt::Display for LinearUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for LinearUnit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::from_name(text).ok_or_else(|| {
            format!("`{text}` is no unit of length; use metre, foot or us-survey-foot")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_two_feet_are_different_lengths() {
        assert_eq!(Metres::from(UsSurveyFeet(3937.0)).0, 1200.0);
        // EPSG:2927's easting at Seattle, read with the wrong foot, is 0.73 m off.
        let easting = 1_193_067.57;
        let error = easting * (US_SURVEY_FOOT_M - FOOT_M);
        assert!((error - 0.727).abs() < 1e-3, "{error}");
    }

    #[test]
    fn units_are_recognised_by_name_and_by_size() {
        for unit in [LinearUnit::Metre, LinearUnit::Foot, LinearUnit::UsSurveyFoot] {
            assert_eq!(unit.name().parse(), Ok(unit));
            assert_eq!(LinearUnit::from_metres_per_unit(unit.metres_per_unit()), Some(unit));
        }
        assert_eq!(LinearUnit::from_name("Foot_US"), Some(LinearUnit::UsSurveyFoot));
        assert_eq!(
            LinearUnit::from_metres_per_unit(0.304_800_609_601_219_2),
            Some(LinearUnit::UsSurveyFoot)
        );
        assert_eq!(LinearUnit::from_metres_per_unit(0.3047), None);
        assert!("cubit".parse::<LinearUnit>().is_err());
    }
}
