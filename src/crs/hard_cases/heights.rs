//! Units and vertical datums far from Seattle.

use crate::crs::{CrsSpec, ResolveOptions, ground_distance_m, resolve, table};
use crate::grid::LonLat;
use crate::units::{FOOT_M, LinearUnit, US_SURVEY_FOOT_M};
use num_bigint::BigInt;
use num_rational::BigRational;
use num_traits::ToPrimitive;

/// Metres of a whole number of sixteenths of a US survey foot, exactly.
fn exact(sixteenths: i32) -> BigRational {
    let whole = |value: i32| BigRational::from_integer(BigInt::from(value));
    whole(sixteenths) / whole(16) * whole(1200) / whole(3937)
}

#[test]
fn feet_become_metres_without_a_rounding_of_their_own() {
    let metres_per_foot = LinearUnit::UsSurveyFoot.metres_per_unit();
    let (mut narrow, mut ours, mut seven_digits) = (0.0_f64, 0.0_f64, 0.0_f64);
    // Every seventh sixteenth of a foot from the sea to Everest.
    for sixteenths in (1..29_032 * 16).step_by(7) {
        let feet = sixteenths as f32 / 16.0;
        let truth = exact(sixteenths).to_f64().expect("finite");
        let off = |metres: f32| (f64::from(metres) - truth).abs();
        narrow = narrow.max(off(feet * metres_per_foot as f32));
        ours = ours.max(off((f64::from(feet) * metres_per_foot) as f32));
        seven_digits = seven_digits.max((f64::from(feet) * 0.304_800_6 - truth).abs());
    }
    println!("in f32 {narrow:.2e} m, ours {ours:.2e} m, seven digits {seven_digits:.2e} m");
    // Half a step of f32 at 8,849 m is 0.49 mm; arithmetic in f32 adds its own.
    assert!(ours < 4.9e-4, "{ours:e} m");
    assert!(narrow > 6e-4, "{narrow:e} m");
    assert!(seven_digits > 2.5e-4, "{seven_digits:e} m");
    // The other foot: 18 mm on Everest, 0.7 m at an easting of 1.2 million feet.
    assert!((29_032.0 * (metres_per_foot - FOOT_M) - 0.0177).abs() < 1e-4);
    // What is written with seven digits is no unit, and is refused.
    assert_eq!(LinearUnit::from_metres_per_unit(0.304_800_6), None);
}

#[test]
fn every_zone_in_feet_returns_and_the_other_foot_lands_metres_away() {
    let mut farthest = 0.0_f64;
    let mut zones = 0;
    for entry in table::ENTRIES.iter().filter(|entry| entry.unit != LinearUnit::Metre) {
        let crs = resolve(&CrsSpec::from_epsg(entry.code), &ResolveOptions::default());
        let projection = crs.expect("in the table").projection;
        let (lon_deg, lat_deg) = entry.area.centre();
        let at = LonLat { lon_deg, lat_deg };
        let there = projection.forward(at).expect("in the domain");
        let back = projection.inverse(there).expect("in the domain");
        // Helmert's step is undone to micrometres.
        let off = ground_distance_m(at, back);
        assert!(off < 3e-6, "EPSG:{}: {off:e} m", entry.code);
        let (own, other) = match entry.unit {
            LinearUnit::Foot => (FOOT_M, US_SURVEY_FOOT_M),
            _ => (US_SURVEY_FOOT_M, FOOT_M),
        };
        farthest = farthest.max(libm::hypot(there.x, there.y) * (own - other).abs());
        zones += 1;
    }
    println!("{zones} zones in feet: the other foot lands {farthest:.2} m away");
    assert!(zones > 600, "{zones}");
    assert!((16.8..16.9).contains(&farthest), "{farthest} m");
}

#[test]
fn heights_of_another_datum_keep_its_unit_under_coordinates_in_feet() {
    // Ohio North counts eastings in US survey feet, the Great Lakes' datum heights in metres: at Lake
    // Erie (173.5 m) heights taken in the unit of the coordinates are 120 m wrong.
    for (code, vertical) in
        [("EPSG:3734+5609", "IGLD 1985 height"), ("EPSG:2286+5713", "CGVD28 height")]
    {
        let crs = CrsSpec::from_user_input(code).expect("a CRS");
        assert_eq!(crs.linear_unit, Some(LinearUnit::UsSurveyFoot));
        let stated = crs.vertical.expect("a vertical part");
        assert_eq!((stated.name.as_str(), stated.unit), (vertical, Some(LinearUnit::Metre)));
        let naive = 173.5 * crs.linear_unit.expect("feet").metres_per_unit();
        assert!((173.5 - naive) > 120.0, "{naive} m");
    }
    // The same datum in another unit is another code; a unit that no code has is said in the name.
    for (code, unit) in
        [("EPSG:2914+8228", LinearUnit::Foot), ("EPSG:2927+6360", LinearUnit::UsSurveyFoot)]
    {
        let crs = CrsSpec::from_user_input(code).expect("a CRS");
        assert_eq!(crs.linear_unit, Some(unit));
        assert_eq!(crs.vertical.expect("a vertical part").unit, Some(unit));
    }
}
