//! Every closed form and every reader of definitions against PROJ.

use super::*;
use crate::crs::table::{ENTRIES, Entry};
use crate::crs::{CrsSpec, resolve};
use crate::units::LinearUnit;

/// Agreement that the project promises, with the datum step, metres.
const TOLERANCE_M: f64 = 5e-8;

/// Codes that are always compared in full; of the rest, every eighth.
const ALWAYS: [u32; 16] = [
    2285, 2286, 2855, 2856, 2926, 2927, 2965, 6596, 6597, 6598, 6599, 25832, 26918, 26963, 32161,
    32616,
];

fn closed(code: u32) -> ResolvedCrs {
    let resolved = resolve(&CrsSpec::from_epsg(code), &ResolveOptions::default())
        .expect("every code of the table resolves");
    assert_eq!(resolved.operation.provider, "closed form");
    resolved
}

/// A lattice over an area, `beyond` of its size past every edge.
fn lattice(entry: &Entry, beyond: f64, steps: u32) -> Vec<LonLat> {
    let [west, south, east, north] = entry.area.bounds();
    let (width, height) = ((east - west).rem_euclid(360.0), north - south);
    let part = |i: u32| f64::from(i) / f64::from(steps) * (1.0 + 2.0 * beyond) - beyond;
    let position = |i, j| LonLat {
        lon_deg: west + width * part(i),
        lat_deg: (south + height * part(j)).clamp(-89.0, 89.0),
    };
    (0..=steps).flat_map(|i| (0..=steps).map(move |j| position(i, j))).collect()
}

#[test]
fn every_closed_form_is_proj_forward_and_inverse() {
    let context = Context::new(false).expect("PROJ");
    let (mut there, mut back) = (0.0_f64, 0.0_f64);
    for entry in ENTRIES.iter() {
        let closed = closed(entry.code);
        let proj = context.create(&closed.operation.definition).expect("a valid pipeline");
        for at in lattice(entry, 0.5, 6) {
            let ours = closed.projection.forward(at).expect("in the domain");
            let theirs = proj.run((at.lon_deg, at.lat_deg), true).expect("in PROJ's domain");
            let apart = libm::hypot(ours.x - theirs.x, ours.y - theirs.y) * closed.metres_per_unit;
            assert!(apart < TOLERANCE_M, "EPSG:{} {at:?}: {apart} m", entry.code);
            there = there.max(apart);

            let ours = closed.projection.inverse(theirs).expect("in the domain");
            let theirs = proj.run((theirs.x, theirs.y), false).expect("in PROJ's domain");
            let theirs = LonLat { lon_deg: theirs.x, lat_deg: theirs.y };
            let apart = ground_distance_m(ours, theirs);
            assert!(apart < TOLERANCE_M, "EPSG:{} {at:?}: {apart} m back", entry.code);
            back = back.max(apart);
        }
    }
    println!("largest difference: {there:.1e} m forward, {back:.1e} m inverse");
}

#[test]
fn the_operation_of_a_code_is_the_one_that_proj_prefers() {
    let context = Context::new(false).expect("PROJ");
    for (i, entry) in ENTRIES.iter().enumerate() {
        if i % 8 != 0 && !ALWAYS.contains(&entry.code) {
            continue;
        }
        let closed = closed(entry.code);
        let report = compare(&context, &closed, &lattice(entry, 0.0, 4)).expect("PROJ serves it");
        let code = entry.code;
        assert_eq!(report.points, 25, "EPSG:{code}");
        assert!(report.same_operation_m < TOLERANCE_M, "EPSG:{code}: {report:?}");
        // PROJ ranks by how much of the area an operation covers, so where a zone juts out of an
        // operation's area of use, another may win; the name says which.
        if report.default_operation == closed.operation.name {
            assert!(report.default_operation_m < TOLERANCE_M, "EPSG:{code}: {report:?}");
        } else {
            assert!(
                report.default_operation.contains("NAD83(HARN) to WGS 84 (1)"),
                "EPSG:{code}: {report:?} {}",
                closed.operation.name
            );
        }
    }
}

#[test]
fn definitions_in_every_dialect_lead_to_their_code() {
    let context = Context::new(false).expect("PROJ");
    let dialects = [
        proj_sys::PJ_WKT_TYPE_PJ_WKT1_GDAL,
        proj_sys::PJ_WKT_TYPE_PJ_WKT1_ESRI,
        proj_sys::PJ_WKT_TYPE_PJ_WKT2_2015,
        proj_sys::PJ_WKT_TYPE_PJ_WKT2_2019,
    ];
    for (i, entry) in ENTRIES.iter().enumerate() {
        if i % 4 != 0 && !ALWAYS.contains(&entry.code) {
            continue;
        }
        let crs = context.create(&format!("EPSG:{}", entry.code)).expect("PROJ knows it");
        for dialect in dialects {
            let wkt = crs.wkt_as(dialect).expect("WKT");
            let spec = CrsSpec::from_wkt(&wkt).expect("understood");
            assert_eq!(spec.epsg, Some(entry.code), "{wkt}");
            assert_eq!(spec.linear_unit, Some(entry.unit), "{wkt}");
            // Without any code, parameters decide; some CRSs share them.
            let bare = wkt.replace("EPSG", "LOCAL");
            let spec = CrsSpec::from_wkt(&bare).expect("understood");
            let found = spec.epsg.and_then(crate::crs::table::entry);
            let found = found.unwrap_or_else(|| panic!("not identified: {bare}"));
            assert!(found.method.is_close_to(&entry.method), "{bare}");
            assert_eq!((found.base, found.unit), (entry.base, entry.unit), "{bare}");
            assert_eq!(found.code, entry.code, "{bare}");
        }
    }
}

#[test]
fn the_check_names_the_metres() {
    let around_seattle: Vec<_> = (0..25)
        .map(|i| LonLat {
            lon_deg: -122.45 + 0.05 * f64::from(i % 5),
            lat_deg: 47.48 + 0.06 * f64::from(i / 5),
        })
        .collect();
    let report = check_against_proj(&closed(2927), &around_seattle).expect("PROJ serves it");
    assert_eq!(report.points, 25);
    assert!(report.same_operation_m < 1e-8, "{report:?}");
    assert!(report.warnings(&closed(2927)).is_empty(), "{report:?}");
    let operation = Some("null".to_owned());
    let options = ResolveOptions { operation, ..ResolveOptions::default() };
    let null = resolve(&CrsSpec::from_epsg(2927), &options).expect("no step");
    let report = check_against_proj(&null, &around_seattle).expect("PROJ serves it");
    assert!(report.same_operation_m < 1e-8, "{report:?}");
    assert!((report.default_operation_m - 1.28).abs() < 0.01, "{report:?}");
    let warnings = report.warnings(&null);
    assert!(matches!(&warnings[..], [one] if one.contains("1.28")), "{warnings:?}");
    // Nothing to compare is no agreement, but no failure either.
    let nothing = check_against_proj(&null, &[]).expect("PROJ serves it");
    assert_eq!(nothing.points, 0);
}

#[test]
fn crs_outside_the_table_is_served_by_proj() {
    let spec = CrsSpec::from_user_input("EPSG:31370").expect("a code");
    let resolved = resolve(&spec, &ResolveOptions::default()).expect("PROJ serves it");
    assert_eq!(resolved.spec.name, "BD72 / Belgian Lambert 72");
    assert_eq!(resolved.spec.linear_unit, Some(LinearUnit::Metre));
    assert!(resolved.operation.provider.starts_with("PROJ "));
    assert!((80.0..150.0).contains(&resolved.operation.datum_shift_m));
    // The grand-place of Brussels.
    let at = LonLat { lon_deg: 4.3525, lat_deg: 50.8467 };
    let there = resolved.projection.forward(at).expect("projects");
    assert!((there.x - 148_900.0).abs() < 500.0 && (there.y - 170_900.0).abs() < 500.0);
    let back = resolved.projection.inverse(there).expect("projects");
    assert!(ground_distance_m(at, back) < 1e-3);
    let nowhere = LonLat { lon_deg: 4.0, lat_deg: f64::NAN };
    assert!(matches!(resolved.projection.forward(nowhere), Err(CrsError::Domain { .. })));
}

#[test]
fn proj_projections_run_on_many_threads() {
    let spec = CrsSpec::from_user_input("EPSG:2154").expect("a code");
    let resolved = resolve(&spec, &ResolveOptions::default()).expect("PROJ serves it");
    let at = LonLat { lon_deg: 2.35, lat_deg: 48.85 };
    let expected = resolved.projection.forward(at).expect("projects");
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for _ in 0..1000 {
                    assert_eq!(resolved.projection.forward(at), Ok(expected));
                }
            });
        }
    });
}

#[test]
fn operations_can_be_pinned_through_proj() {
    let spec = CrsSpec::from_epsg(2927);
    let pin = |text: &str| {
        let operation = Some(text.to_owned());
        resolve(&spec, &ResolveOptions { operation, ..ResolveOptions::default() })
    };
    // A pipeline as `projinfo` prints it, latitude first.
    let pipeline = "+proj=pipeline
        +step +proj=axisswap +order=2,1
        +step +proj=unitconvert +xy_in=deg +xy_out=rad
        +step +proj=lcc +lat_0=45.3333333333333 +lon_0=-120.5 +lat_1=47.3333333333333
              +lat_2=45.8333333333333 +x_0=500000.0001016 +y_0=0 +ellps=GRS80
        +step +proj=unitconvert +xy_in=m +xy_out=us-ft";
    let pinned = pin(pipeline).expect("leads there");
    assert!(pinned.operation.provider.starts_with("PROJ "));
    let null = pin("1580").expect("in the table");
    assert_eq!(null.operation.provider, "closed form");
    let at = LonLat { lon_deg: -122.3129, lat_deg: 47.5903 };
    let (a, b) = (pinned.projection.forward(at), null.projection.forward(at));
    let (a, b) = (a.expect("projects"), b.expect("projects"));
    assert!((a.x - b.x).abs() < 1e-7 && (a.y - b.y).abs() < 1e-7);

    // Metres instead of feet: elsewhere by hundreds of kilometres.
    let metres = pipeline.replace("+step +proj=unitconvert +xy_in=m +xy_out=us-ft", "");
    let refused = pin(&metres).expect_err("leads elsewhere");
    assert!(refused.to_string().contains("km from where"), "{refused}");
    // A grid that is not here, an operation of another datum, nonsense.
    let harn = |text| pin(text).expect_err("refused").to_string();
    assert!(harn("1188").contains("is none of"), "{}", harn("1188"));
    assert!(harn("999999").contains("EPSG:999999"), "{}", harn("999999"));
    assert!(harn("+proj=nonsense").contains("nonsense"), "{}", harn("+proj=nonsense"));
    assert!(harn("best").contains("give an EPSG code"), "{}", harn("best"));
    let nad83 = CrsSpec::from_epsg(2285);
    let operation = Some("EPSG:1737".to_owned());
    let other = resolve(&nad83, &ResolveOptions { operation, ..ResolveOptions::default() });
    let refused = other.expect_err("its grid is missing").to_string();
    assert!(refused.contains("us_noaa_WO.tif"), "{refused}");
}

#[test]
fn what_proj_understands_can_be_typed() {
    let spec = CrsSpec::from_user_input("+proj=utm +zone=10 +datum=NAD83 +type=crs").expect("PROJ");
    assert_eq!(spec.epsg, Some(26910));
    let spec = CrsSpec::from_user_input("ESRI:102749").expect("PROJ");
    assert_eq!(spec.epsg, Some(2286));
    assert!(CrsSpec::from_user_input("nonsense").is_err());
    let spec = CrsSpec::from_user_input("EPSG:4978").expect("a code");
    let error = resolve(&spec, &ResolveOptions::default()).expect_err("geocentric");
    assert!(matches!(error, CrsError::Unsupported { .. }), "{error}");
    let spec = CrsSpec::from_user_input("EPSG:4313").expect("a code");
    let error = resolve(&spec, &ResolveOptions::default()).expect_err("geographic");
    assert!(matches!(error, CrsError::Geographic { .. }), "{error}");
    let spec = CrsSpec::from_user_input("999999").expect("a number");
    assert!(resolve(&spec, &ResolveOptions::default()).is_err());
}

#[test]
fn datum_steps_are_taken_out_of_a_pipeline() {
    let with = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=push +v_3 +step +proj=cart +ellps=WGS84 +step +inv +proj=helmert +x=1 +step +inv +proj=cart +ellps=GRS80 +step +proj=pop +v_3 +step +proj=utm +zone=10";
    let without =
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=utm +zone=10";
    assert_eq!(without_datum_steps(with), without);
    assert_eq!(without_datum_steps(without), without);
}

#[test]
fn steps_are_found_in_the_names_of_operations() {
    let name = "Inverse of NAD83(HARN) to WGS 84 (3) + SPCS83 Washington South zone";
    assert!(is_step_of("NAD83(HARN) to WGS 84 (3)", name));
    assert!(!is_step_of("NAD83(HARN) to WGS 84", name));
}
