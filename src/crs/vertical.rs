//! Vertical CRSs: their codes, names and units.

use super::VerticalCrs;
use crate::units::LinearUnit::{self, Foot, Metre, UsSurveyFoot};

/// Vertical CRSs that lidar comes in (EPSG).
const KNOWN: [(u32, &str, LinearUnit); 17] = [
    (3855, "EGM2008 height", Metre),
    (5701, "ODN height", Metre),
    (5702, "NGVD29 height (ftUS)", UsSurveyFoot),
    (5703, "NAVD88 height", Metre),
    (5705, "Baltic 1977 height", Metre),
    (5709, "NAP height", Metre),
    (5711, "AHD height", Metre),
    (5714, "MSL height", Metre),
    (5773, "EGM96 height", Metre),
    (5783, "DHHN92 height", Metre),
    (6360, "NAVD88 height (ftUS)", UsSurveyFoot),
    (6647, "CGVD2013(CGG2013) height", Metre),
    (7837, "DHHN2016 height", Metre),
    (7968, "NGVD29 height (m)", Metre),
    (8050, "MSL height (ft)", Foot),
    (8052, "MSL height (ftUS)", UsSurveyFoot),
    (8228, "NAVD88 height (ft)", Foot),
];

/// Codes of one datum in several units.
const FAMILIES: [&[u32]; 3] = [&[5703, 6360, 8228], &[5702, 7968], &[5714, 8050, 8052]];

/// A vertical CRS from whatever a file says about it: the unit that it states wins over the code's,
/// and the code is then that of the same datum in that unit, if there is one.
pub(super) fn describe(
    epsg: Option<u32>,
    name: Option<&str>,
    unit: Option<LinearUnit>,
) -> VerticalCrs {
    let by_code = |code: u32| KNOWN.iter().find(|(known, ..)| *known == code);
    let by_name = || KNOWN.iter().find(|(_, known, _)| name.is_some_and(|name| name == *known));
    let known = match epsg {
        Some(code) => by_code(code),
        None => by_name(),
    };
    let Some((code, known_name, known_unit)) = known else {
        let name = name.map_or_else(
            || epsg.map_or_else(|| "unknown".to_owned(), |code| format!("EPSG:{code}")),
            str::to_owned,
        );
        return VerticalCrs { name, epsg, unit };
    };
    let unit = unit.unwrap_or(*known_unit);
    if unit == *known_unit {
        return VerticalCrs { name: (*known_name).to_owned(), epsg: Some(*code), unit: Some(unit) };
    }
    let sibling = FAMILIES
        .iter()
        .find(|family| family.contains(code))
        .and_then(|family| family.iter().filter_map(|code| by_code(*code)).find(|k| k.2 == unit));
    match sibling {
        Some((code, name, _)) => {
            VerticalCrs { name: (*name).to_owned(), epsg: Some(*code), unit: Some(unit) }
        }
        None => {
            VerticalCrs { name: format!("{known_name} in {unit}"), epsg: None, unit: Some(unit) }
        }
    }
}

/// Whether a code is that of a vertical CRS which is known here.
pub(super) fn is_known(code: u32) -> bool {
    KNOWN.iter().any(|(known, ..)| *known == code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_bring_their_units() {
        let unit = |code| describe(Some(code), None, None).unit;
        assert_eq!(unit(5703), Some(Metre));
        assert_eq!(unit(6360), Some(UsSurveyFoot));
        assert_eq!(unit(8228), Some(Foot));
        assert_eq!(unit(1), None);
    }

    #[test]
    fn a_stated_unit_wins_and_moves_the_code() {
        let navd88 = describe(Some(5703), None, Some(UsSurveyFoot));
        assert_eq!((navd88.epsg, navd88.unit), (Some(6360), Some(UsSurveyFoot)));
        let ahd = describe(Some(5711), None, Some(Foot));
        assert_eq!((ahd.epsg, ahd.unit), (None, Some(Foot)));
        assert_eq!(ahd.name, "AHD height in foot");
    }

    #[test]
    fn names_stand_in_for_codes() {
        assert_eq!(describe(None, Some("NAVD88 height (ft)"), None).epsg, Some(8228));
        let other = describe(None, Some("local"), Some(Metre));
        assert_eq!((other.name.as_str(), other.epsg), ("local", None));
    }
}
