//! Vertical CRSs: their codes, names and units, from `vertical.tsv` (written by
//! `fixtures/crs/make_table.py`).

use super::VerticalCrs;
use crate::units::LinearUnit;
use std::sync::LazyLock;

/// One vertical CRS of the table.
struct Known {
    code: u32,
    unit: LinearUnit,
    /// EPSG code of its datum: one datum may be counted in several units.
    datum: u32,
    name: &'static str,
}

impl Known {
    fn parse(line: &'static str) -> Option<Self> {
        let mut fields = line.split('\t');
        let mut next = || fields.next();
        Some(Self {
            code: next()?.parse().ok()?,
            unit: LinearUnit::from_name(next()?)?,
            datum: next()?.parse().ok()?,
            name: next()?,
        })
    }
}

const TABLE: &str = include_str!("vertical.tsv");

fn rows() -> impl Iterator<Item = &'static str> {
    TABLE.lines().filter(|line| !line.starts_with('#'))
}

/// Every vertical CRS of EPSG whose heights point up, in metres or either foot.
static KNOWN: LazyLock<Vec<Known>> = LazyLock::new(|| rows().filter_map(Known::parse).collect());

/// A vertical CRS from whatever a file says about it: the unit that it states wins over the code's,
/// and the code is then that of the same datum in that unit, if there is one.
pub(super) fn describe(
    epsg: Option<u32>,
    name: Option<&str>,
    unit: Option<LinearUnit>,
) -> VerticalCrs {
    let known = match epsg {
        Some(code) => KNOWN.iter().find(|known| known.code == code),
        None => KNOWN.iter().find(|known| name == Some(known.name)),
    };
    let Some(known) = known else {
        let name = name.map_or_else(
            || epsg.map_or_else(|| "unknown".to_owned(), |code| format!("EPSG:{code}")),
            str::to_owned,
        );
        return VerticalCrs { name, epsg, unit };
    };
    let unit = unit.unwrap_or(known.unit);
    let in_unit = |other: &&Known| other.datum == known.datum && other.unit == unit;
    let sibling = if unit == known.unit { Some(known) } else { KNOWN.iter().find(in_unit) };
    let (name, epsg) = sibling.map_or_else(
        || (format!("{} in {unit}", known.name), None),
        |known| (known.name.to_owned(), Some(known.code)),
    );
    VerticalCrs { name, epsg, unit: Some(unit) }
}

/// Whether a code is that of a vertical CRS which is known here.
pub(super) fn is_known(code: u32) -> bool {
    KNOWN.iter().any(|known| known.code == code)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::LinearUnit::{Foot, Metre, UsSurveyFoot};

    #[test]
    fn only_codes_of_the_table_are_known() {
        assert!([5703, 6360, 8228].into_iter().all(is_known));
        assert!(![0, 4326, 32610, u32::MAX].into_iter().any(is_known));
    }

    #[test]
    fn every_line_of_the_table_is_understood() {
        assert_eq!(KNOWN.len(), rows().count());
        assert!(KNOWN.len() > 220);
    }

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
