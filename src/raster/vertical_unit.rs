//! Finding the unit of a raster's heights, with the evidence in words.

use crate::crs::CrsSpec;
use crate::units::LinearUnit;

/// Metadata items in which programs and people state the unit of heights (compared in lower case).
const METADATA_KEYS: [&str; 14] = [
    "unittype",
    "units",
    "unit",
    "vertical_units",
    "vertical_unit",
    "verticalunits",
    "vert_units",
    "z_units",
    "zunits",
    "z_unit",
    "elevation_units",
    "elevation_unit",
    "height_units",
    "height_unit",
];

/// What was found: the unit with its evidence, and what the user should know.
#[derive(Debug, Default, PartialEq)]
pub(super) struct VerticalUnit {
    pub(super) unit: Option<(LinearUnit, String)>,
    pub(super) warnings: Vec<String>,
}

/// Looks at, in this order, the vertical part of the CRS, the band's unit, and metadata items;
/// `metadata` holds names and values of the dataset and of the band.
pub(super) fn detect(
    crs: Option<&CrsSpec>,
    band_unit: &str,
    metadata: &[(String, String)],
) -> VerticalUnit {
    let horizontal = crs.and_then(|c| c.linear_unit);
    let mut found = VerticalUnit::default();
    let mut statements: Vec<(LinearUnit, String)> = Vec::new();

    if let Some(vertical) = crs.and_then(|c| c.vertical.as_ref())
        && let Some(unit) = vertical.unit
    {
        statements.push((unit, format!("the vertical CRS `{}` is in {unit}", vertical.name)));
    }
    let band = (!band_unit.trim().is_empty()).then_some(("the band's unit".to_owned(), band_unit));
    let items = metadata
        .iter()
        .filter(|(name, _)| is_unit_item(name))
        .map(|(name, value)| (format!("the metadata item {name}"), value.as_str()));
    for (place, text) in band.into_iter().chain(items) {
        match read_name(text, horizontal) {
            Some((unit, how)) => {
                statements.push((unit, format!("{place} is `{}`{how}", text.trim())));
            }
            None => found.warnings.push(format!(
                "{place} is `{}`, which is no unit of length that is known here; it is ignored",
                text.trim()
            )),
        }
    }

    let mut statements = statements.into_iter();
    if let Some((unit, evidence)) = statements.next() {
        for (other, reason) in statements.filter(|(other, _)| *other != unit) {
            found.warnings.push(format!(
                "the file contradicts itself about the unit of heights: {evidence} ({unit}), but \
                 {reason} ({other}); {unit} is used, --vertical-unit overrides it"
            ));
        }
        found.unit = Some((unit, evidence));
    }
    found
}

/// Whether a metadata item of this name states the unit of heights.
pub(super) fn is_unit_item(name: &str) -> bool {
    METADATA_KEYS.contains(&name.to_ascii_lowercase().as_str())
}

/// The unit that `text` names. Bare feet are the feet of the horizontal CRS: surveys in US survey
/// feet write `feet` for both.
fn read_name(text: &str, horizontal: Option<LinearUnit>) -> Option<(LinearUnit, &'static str)> {
    let bare = ["ft", "feet", "foot"].iter().any(|name| text.trim().eq_ignore_ascii_case(name));
    match (bare, horizontal) {
        (true, Some(LinearUnit::UsSurveyFoot)) => {
            Some((LinearUnit::UsSurveyFoot, ", read as the US survey foot of the horizontal CRS"))
        }
        (true, Some(LinearUnit::Foot)) => Some((LinearUnit::Foot, "")),
        (true, _) => Some((
            LinearUnit::Foot,
            ", read as the international foot (a US survey foot is 2 millionths longer)",
        )),
        (false, _) => LinearUnit::from_name(text).map(|unit| (unit, "")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::VerticalCrs;

    fn crs(horizontal: LinearUnit, vertical: Option<LinearUnit>) -> CrsSpec {
        CrsSpec {
            name: "test".to_owned(),
            epsg: None,
            geographic: false,
            linear_unit: Some(horizontal),
            vertical: vertical.map(|unit| VerticalCrs {
                name: "NAVD88 height".to_owned(),
                epsg: None,
                unit: Some(unit),
            }),
            wkt: None,
        }
    }

    fn item(name: &str, value: &str) -> Vec<(String, String)> {
        vec![("TYPE".to_owned(), "Elevation".to_owned()), (name.to_owned(), value.to_owned())]
    }

    #[test]
    fn nothing_said_is_nothing_found() {
        let crs = crs(LinearUnit::UsSurveyFoot, None);
        assert_eq!(detect(Some(&crs), " ", &item("COLOR", "feet")), VerticalUnit::default());
        assert_eq!(detect(None, "", &[]), VerticalUnit::default());
    }

    #[test]
    fn bare_feet_are_the_feet_of_the_horizontal_crs() {
        for (horizontal, expected) in [
            (LinearUnit::UsSurveyFoot, LinearUnit::UsSurveyFoot),
            (LinearUnit::Foot, LinearUnit::Foot),
            (LinearUnit::Metre, LinearUnit::Foot),
        ] {
            let crs = crs(horizontal, None);
            for found in
                [detect(Some(&crs), "Ft", &[]), detect(Some(&crs), "", &item("Units", " feet "))]
            {
                let (unit, evidence) = found.unit.expect("feet are a unit");
                assert_eq!(unit, expected, "{evidence}");
                assert!(found.warnings.is_empty());
            }
        }
        // A full name is what it says.
        let crs = crs(LinearUnit::UsSurveyFoot, None);
        let found = detect(Some(&crs), "international foot", &[]);
        assert_eq!(found.unit.expect("found").0, LinearUnit::Foot);
    }

    #[test]
    fn the_vertical_crs_wins_and_contradictions_are_told() {
        let crs = crs(LinearUnit::Metre, Some(LinearUnit::Metre));
        let found = detect(Some(&crs), "US survey foot", &item("UNITS", "metre"));
        let (unit, evidence) = found.unit.expect("found");
        assert_eq!(unit, LinearUnit::Metre);
        assert!(evidence.contains("NAVD88 height"), "{evidence}");
        assert_eq!(found.warnings.len(), 1, "{:?}", found.warnings);
        assert!(found.warnings[0].contains("US survey foot"), "{:?}", found.warnings);
    }

    #[test]
    fn an_unknown_unit_is_told_and_ignored() {
        let found = detect(None, "cubit", &item("Z_UNITS", "m"));
        assert_eq!(found.unit.expect("found").0, LinearUnit::Metre);
        assert!(found.warnings[0].contains("cubit"));
    }
}
