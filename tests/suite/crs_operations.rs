//! Which operation serves a CRS, what it says of itself, and how exact it is; runs in both builds.

use proptest::prelude::*;
use sat3d::crs::{
    CrsError, CrsSpec, ResolveOptions, ResolvedCrs, area_of_use, closed_form_codes, resolve,
    scale_factor,
};
use sat3d::grid::{LonLat, Projected};
use sat3d::units::{LinearUnit, US_SURVEY_FOOT_M};

const SEATTLE: LonLat = LonLat { lon_deg: -122.3129, lat_deg: 47.5903 };
const SEATTLE_AREA: [f64; 4] = [-122.45, 47.48, -122.22, 47.74];

fn with(code: u32, options: &ResolveOptions) -> Result<ResolvedCrs, CrsError> {
    resolve(&CrsSpec::from_epsg(code), options)
}

fn closed(code: u32) -> ResolvedCrs {
    with(code, &ResolveOptions::default()).expect("in the table")
}

fn pinned(code: u32, operation: &str) -> Result<ResolvedCrs, CrsError> {
    let operation = Some(operation.to_owned());
    with(code, &ResolveOptions { operation, ..ResolveOptions::default() })
}

fn seattle(crs: &ResolvedCrs) -> Projected {
    crs.projection.forward(SEATTLE).expect("in the domain")
}

#[test]
fn check_points_of_washington() {
    for (code, x, y) in [
        (2927, 1_193_067.570_541_287, 828_235.976_053_613_7),
        (2926, 1_275_342.425_516_600_5, 218_831.009_527_050_08),
    ] {
        let found = seattle(&closed(code));
        assert!((found.x - x).abs() < 1e-6 && (found.y - y).abs() < 1e-6, "EPSG:{code} {found:?}");
    }
}

#[test]
fn the_datum_step_is_recorded_measured_and_can_be_left_out() {
    let crs = closed(2927);
    assert_eq!(
        crs.operation.name,
        "Inverse of NAD83(HARN) to WGS 84 (3) + SPCS83 Washington South zone (US Survey feet)"
    );
    assert_eq!((crs.operation.code, crs.operation.accuracy_m), (Some(1901), Some(1.0)));
    assert_eq!(crs.operation.provider, "closed form");
    assert_eq!(crs.metres_per_unit, US_SURVEY_FOOT_M);
    assert_eq!(crs.spec.linear_unit, Some(LinearUnit::UsSurveyFoot));
    assert!(crs.operation.grids.is_empty() && crs.warnings.is_empty(), "{:?}", crs.warnings);
    assert!((1.25..1.35).contains(&crs.operation.datum_shift_m), "{:?}", crs.operation);

    let options = ResolveOptions { without_datum_step: true, ..ResolveOptions::default() };
    let without = with(2927, &options).expect("in the table");
    assert_eq!((without.operation.code, without.operation.datum_shift_m), (None, 0.0));
    assert!(without.warnings.is_empty());
    let (a, b) = (seattle(&crs), seattle(&without));
    // Leaving the step out moves everything by (-1.100, +0.657) m.
    assert!(((b.x - a.x) * US_SURVEY_FOOT_M - -1.100).abs() < 1e-3, "{a:?} {b:?}");
    assert!(((b.y - a.y) * US_SURVEY_FOOT_M - 0.657).abs() < 1e-3, "{a:?} {b:?}");
    // A projection without any datum of its own has none to leave out.
    let utm = with(32_610, &options).expect("in the table");
    assert_eq!(utm.operation, closed(32_610).operation);
}

#[test]
fn the_same_lidar_under_another_code_lands_elsewhere() {
    // 2286 and 6599 differ from 2927 only in the datum, and PROJ takes theirs to be WGS 84.
    let harn = seattle(&closed(2927));
    for code in [2286, 6599] {
        let crs = closed(code);
        let other = seattle(&crs);
        let apart = libm::hypot(harn.x - other.x, harn.y - other.y) * US_SURVEY_FOOT_M;
        assert!((apart - 1.28).abs() < 5e-3, "EPSG:{code}: {apart}");
        let accuracy = crs.operation.accuracy_m.expect("stated");
        let warned = format!("good to {accuracy} m at best");
        assert!(crs.warnings.iter().any(|w| w.contains(&warned)), "{:?}", crs.warnings);
    }
}

#[test]
fn a_better_operation_whose_grid_is_missing_is_named() {
    let area = Some(SEATTLE_AREA);
    let crs = with(2285, &ResolveOptions { area, ..ResolveOptions::default() }).expect("listed");
    let better = crs.warnings.iter().find(|w| w.contains("us_noaa_WO.tif")).expect("named");
    assert!(
        better.contains("2 m instead of 4 m") && better.contains("--operation 1737"),
        "{better}"
    );
    // In another state another grid.
    let area = Some([-86.9, 40.0, -86.8, 40.1]);
    let crs = with(2965, &ResolveOptions { area, ..ResolveOptions::default() }).expect("listed");
    assert!(crs.warnings.iter().any(|w| w.contains("us_noaa_inhpgn.tif")), "{:?}", crs.warnings);
}

#[test]
fn work_outside_the_area_of_use_is_said() {
    let area = Some([-87.7, 41.8, -87.6, 41.9]);
    let crs = with(2927, &ResolveOptions { area, ..ResolveOptions::default() }).expect("listed");
    assert!(crs.warnings.iter().any(|w| w.contains("right CRS")), "{:?}", crs.warnings);
    let hawaii = pinned(2782, "1901").expect("the same datum");
    assert!(hawaii.warnings.iter().any(|w| w.contains("does not hold")), "{:?}", hawaii.warnings);
    // Puerto Rico: no operation at all, and PROJ says so by calling its own a ballpark.
    let crs = closed(32_161);
    assert_eq!((crs.operation.code, crs.operation.accuracy_m), (None, None));
    assert!(crs.warnings.iter().any(|w| w.contains("nobody states")), "{:?}", crs.warnings);
}

#[test]
fn operations_can_be_pinned_by_code() {
    let null = pinned(2927, "EPSG:1580").expect("a null shift");
    assert_eq!((null.operation.code, null.operation.accuracy_m), (Some(1580), Some(2.0)));
    assert_eq!(null.operation.datum_shift_m, 0.0);
    let older = pinned(2927, "1900").expect("an older Helmert");
    let (a, b) = (seattle(&older), seattle(&closed(2927)));
    let apart = libm::hypot(a.x - b.x, a.y - b.y) * US_SURVEY_FOOT_M;
    assert!((0.01..0.2).contains(&apart), "{apart}");
    for word in ["null", "Ballpark"] {
        let none = pinned(2927, word).expect("no step");
        assert_eq!(seattle(&none), seattle(&null));
        assert_eq!(none.operation.accuracy_m, None);
    }
    // What a manifest recorded can be given back.
    let recorded = closed(2927).operation;
    let again = pinned(2927, &recorded.definition).expect("its own definition");
    assert_eq!(again.operation, recorded);
}

#[test]
fn an_operation_that_does_not_lead_there_is_refused() {
    for (code, operation) in [(2927, "1188"), (2927, "best"), (32_610, "1901"), (2927, "")] {
        let error = pinned(code, operation).expect_err("refused");
        assert!(matches!(error, CrsError::Operation { .. }), "{error}");
        assert!(error.to_string().contains(&format!("EPSG:{code}")), "{error}");
    }
}

#[test]
fn positions_off_the_globe_are_errors_not_numbers() {
    for code in [2927, 32_610, 26_963] {
        let crs = closed(code);
        for (lon_deg, lat_deg) in [
            (f64::NAN, 47.0),
            (-122.0, f64::NAN),
            (f64::INFINITY, 47.0),
            (-122.0, f64::NEG_INFINITY),
            (-122.0, 90.000_001),
            (-122.0, -91.0),
        ] {
            let found = crs.projection.forward(LonLat { lon_deg, lat_deg });
            assert!(matches!(found, Err(CrsError::Domain { .. })), "EPSG:{code} {found:?}");
        }
        for (x, y) in [(f64::NAN, 0.0), (0.0, f64::INFINITY), (f64::NEG_INFINITY, f64::NAN)] {
            let found = crs.projection.inverse(Projected { x, y });
            assert!(matches!(found, Err(CrsError::Domain { .. })), "EPSG:{code} {found:?}");
        }
    }
}

#[test]
fn far_positions_are_right_or_refused() {
    // 90 degrees from the central meridian of a transverse Mercator: refused, not approximated.
    let utm = closed(32_610);
    let far = LonLat { lon_deg: -33.0, lat_deg: 0.0 };
    assert!(utm.projection.forward(far).is_err());
    // Past the pole, down the other side.
    let over = LonLat { lon_deg: 57.0, lat_deg: 85.0 };
    let there = utm.projection.forward(over).expect("in the domain");
    let back = utm.projection.inverse(there).expect("in the domain");
    assert!((back.lat_deg - 85.0).abs() < 1e-12 && (back.lon_deg - 57.0).abs() < 1e-11);
    // In the gap of the unrolled cone there is no place.
    let south = closed(6598);
    let gap = Projected { x: 500_000.0, y: 9_000_000.0 };
    assert!(south.projection.inverse(gap).is_err());
    // Longitudes count modulo a whole turn.
    let turn = LonLat { lon_deg: SEATTLE.lon_deg + 360.0, ..SEATTLE };
    let (a, b) = (seattle(&south), south.projection.forward(turn).expect("in the domain"));
    assert!((a.x - b.x).abs() < 1e-7 && (a.y - b.y).abs() < 1e-7);
}

#[test]
fn zones_at_the_antimeridian_are_continuous() {
    // EPSG:32660 has its central meridian at 177 E; 6328 is UTM 59 N on NAD83(2011), Aleutians.
    for code in [32_660, 32_601, 3373] {
        let crs = closed(code);
        let at = |lon_deg| {
            crs.projection.forward(LonLat { lon_deg, lat_deg: 52.0 }).expect("in the domain")
        };
        let (west, east) = (at(179.999_999), at(-179.999_999));
        let width = libm::hypot(east.x - west.x, east.y - west.y);
        // 2e-6 degrees at 52 N.
        assert!((width - 0.137).abs() < 1e-3, "EPSG:{code}: {width}");
        let back = crs.projection.inverse(east).expect("in the domain");
        assert!((back.lon_deg - -179.999_999).abs() < 1e-9, "EPSG:{code}: {back:?}");
    }
}

#[test]
fn scale_is_one_on_the_standard_parallels_and_known_on_the_meridian() {
    let scale = |code, lon_deg, lat_deg| {
        let at = LonLat { lon_deg, lat_deg };
        scale_factor(&closed(code), at).expect("in the domain")
    };
    // The parallels and the meridian are on NAD83(2011), which differs from WGS 84 by a null shift
    // and 1e-10 of the flattening.
    for lat in [45.833_333_333_333_3, 47.333_333_333_333_3] {
        let found = scale(6598, -121.7, lat);
        assert!((found.east - 1.0).abs() < 1e-8 && (found.north - 1.0).abs() < 1e-8, "{found:?}");
    }
    let utm = scale(32_610, -123.0, 47.6);
    assert!((utm.east - 0.9996).abs() < 1e-9 && (utm.north - 0.9996).abs() < 1e-9, "{utm:?}");
    let seattle = scale(2927, SEATTLE.lon_deg, SEATTLE.lat_deg);
    assert!((seattle.east - seattle.north).abs() < 1e-6, "conformal: {seattle:?}");
    let pole = LonLat { lon_deg: 0.0, lat_deg: 90.0 };
    assert!(scale_factor(&closed(32_610), pole).is_err());
}

#[test]
fn manifests_of_both_builds_say_the_same() {
    let wkt = r#"PROJCS["whatever",GEOGCS["NAD83(HARN)",DATUM["NAD83_High_Accuracy_Reference_Network",SPHEROID["GRS 1980",6378137,298.257222101]]],PROJECTION["Lambert_Conformal_Conic_2SP"],PARAMETER["latitude_of_origin",45.3333333333333],PARAMETER["central_meridian",-120.5],PARAMETER["standard_parallel_1",47.3333333333333],PARAMETER["standard_parallel_2",45.8333333333333],PARAMETER["false_easting",1640416.667],PARAMETER["false_northing",0],UNIT["US survey foot",0.304800609601219],AUTHORITY["EPSG","2927"]]"#;
    let from_wkt = CrsSpec::from_wkt(wkt).expect("WKT");
    let a = resolve(&from_wkt, &ResolveOptions::default()).expect("in the table");
    assert_eq!(a.spec, closed(2927).spec);
    let text = serde_json::to_string(&a.operation).expect("JSON");
    assert!(text.contains("\"code\":1901"), "{text}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Anywhere in the area of use of any CRS and half its size beyond, forward and inverse undo
    /// each other.
    #[test]
    fn there_and_back_for_any_code(
        pick in any::<prop::sample::Index>(), u in -0.5..1.5_f64, v in -0.5..1.5_f64,
    ) {
        let codes: Vec<u32> = closed_form_codes().collect();
        let code = codes[pick.index(codes.len())];
        let crs = closed(code);
        let [west, south, east, north] = area_of_use(code).expect("in the table");
        let at = LonLat {
            lon_deg: west + u * (east - west).rem_euclid(360.0),
            lat_deg: (south + v * (north - south)).clamp(-89.0, 89.0),
        };
        let there = crs.projection.forward(at).expect("in the domain");
        let back = crs.projection.inverse(there).expect("in the domain");
        let turn = (back.lon_deg - at.lon_deg + 540.0).rem_euclid(360.0) - 180.0;
        // PROJ's Helmert step does not undo itself exactly: its heights are dropped, and its inverse
        // is the transpose of a matrix that is only nearly a rotation.
        let bound = if crs.operation.datum_shift_m > 0.0 { 5e-11 } else { 2e-13 };
        prop_assert!(turn.abs() * libm::cos(at.lat_deg.to_radians()) < bound, "{turn:e} {crs:?}");
        prop_assert!((back.lat_deg - at.lat_deg).abs() < bound, "{back:?} {at:?} {crs:?}");
    }
}
