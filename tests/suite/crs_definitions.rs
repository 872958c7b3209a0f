//! What files and people say about CRSs, as a caller of the library sees it; runs in both builds.

use proptest::prelude::*;
use sat3d::crs::{CrsError, CrsSpec, GeoKeys, ResolveOptions, resolve};
use sat3d::units::LinearUnit;
use serde_json::Value;

/// GeoKeys written by GDAL; `fixtures/crs/make_geokeys.py` made them.
fn cases() -> Vec<(String, Option<u32>, Option<u32>, GeoKeys)> {
    let text = include_str!("../../fixtures/crs/geokeys.json");
    let cases: Vec<Value> = serde_json::from_str(text).expect("JSON");
    let code = |value: &Value| value.as_u64().map(|code| u32::try_from(code).expect("a code"));
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().expect("a list").iter().map(|v| v.as_f64().expect("a number")).collect()
    };
    cases
        .iter()
        .map(|case| {
            let keys = GeoKeys {
                directory: numbers(&case["directory"]).into_iter().map(|v| v as u16).collect(),
                doubles: numbers(&case["doubles"]),
                ascii: case["ascii"].as_str().expect("a text").to_owned(),
            };
            let name = case["name"].as_str().expect("a text").to_owned();
            (name, code(&case["epsg"]), code(&case["vertical"]), keys)
        })
        .collect()
}

fn keys(entries: &[[u16; 4]], doubles: &[f64], ascii: &str) -> GeoKeys {
    let mut directory = vec![1, 1, 0, entries.len() as u16];
    directory.extend(entries.iter().flatten());
    GeoKeys { directory, doubles: doubles.to_vec(), ascii: ascii.to_owned() }
}

fn resolved_name(spec: &CrsSpec) -> String {
    match resolve(spec, &ResolveOptions::default()) {
        Ok(resolved) => resolved.spec.name,
        Err(error) => error.to_string(),
    }
}

#[test]
fn geokeys_of_gdal_lead_to_their_code() {
    let cases = cases();
    assert!(cases.len() >= 16);
    for (name, epsg, vertical, keys) in cases {
        let spec = CrsSpec::from_geokeys(&keys).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(spec.epsg, epsg, "{name}: {spec:?}");
        assert_eq!(spec.vertical.as_ref().and_then(|v| v.epsg), vertical, "{name}: {spec:?}");
        assert_eq!(spec.geographic, name == "geographic", "{name}");
        if vertical == Some(6360) {
            let unit = spec.vertical.as_ref().and_then(|v| v.unit);
            assert_eq!(unit, Some(LinearUnit::UsSurveyFoot));
        }
        if name == "a county's own grid" {
            assert_eq!(spec.linear_unit, Some(LinearUnit::UsSurveyFoot));
            let wkt = spec.wkt.as_deref().expect("a definition for PROJ");
            let again = CrsSpec::from_wkt(wkt).expect("its own WKT");
            assert_eq!((again.name, again.epsg), (spec.name, None));
        }
    }
}

#[test]
fn vertical_keys_stand_alone_or_beside_a_code() {
    let horizontal = [3072, 0, 1, 2927];
    let vertical = |entries: &[[u16; 4]], ascii: &str| {
        let all: Vec<_> = [[1024, 0, 1, 1], horizontal].iter().chain(entries).copied().collect();
        CrsSpec::from_geokeys(&keys(&all, &[], ascii)).expect("keys").vertical
    };
    assert_eq!(vertical(&[], ""), None);
    // Only a unit, as LAStools writes it.
    let found = vertical(&[[4099, 0, 1, 9003]], "").expect("a unit is enough");
    assert_eq!((found.epsg, found.unit), (None, Some(LinearUnit::UsSurveyFoot)));
    // GeoTIFF 1.0's own code for NAVD88, and a unit beside it.
    let found = vertical(&[[4096, 0, 1, 5103], [4099, 0, 1, 9003]], "").expect("NAVD88");
    assert_eq!((found.epsg, found.unit), (Some(6360), Some(LinearUnit::UsSurveyFoot)));
    // EPSG:5703 is in metres, but the file says feet.
    let found = vertical(&[[4096, 0, 1, 5703], [4099, 0, 1, 9002]], "").expect("NAVD88");
    assert_eq!((found.epsg, found.unit), (Some(8228), Some(LinearUnit::Foot)));
    let found = vertical(&[[4096, 0, 1, 5030]], "").expect("an ellipsoid");
    assert_eq!((found.name.as_str(), found.unit), ("ellipsoidal height", None));
    let found = vertical(&[[4097, 34_737, 20, 0]], "NAVD88 height (ft)|").expect("a name");
    assert_eq!(found.unit, Some(LinearUnit::Foot));
}

#[test]
fn a_code_with_another_unit_is_another_crs_or_refused() {
    let with_unit = |unit| {
        let entries = [[1024, 0, 1, 1], [3072, 0, 1, 2927], [3076, 0, 1, unit]];
        CrsSpec::from_geokeys(&keys(&entries, &[], ""))
    };
    assert_eq!(with_unit(9003).map(|spec| spec.epsg), Ok(Some(2927)));
    // The same zone in metres has a code of its own.
    assert_eq!(with_unit(9001).map(|spec| spec.epsg), Ok(Some(2856)));
    // In international feet it has none.
    let error = with_unit(9002).expect_err("two statements").to_string();
    assert!(error.contains("EPSG:2927") && error.contains("0.3048") && error.contains("--crs"));
}

#[test]
fn a_citation_alone_may_name_the_crs() {
    let name = "NAD_1983_HARN_StatePlane_Washington_South_FIPS_4602_Feet|";
    let entries = [[1024, 0, 1, 1], [3072, 0, 1, 32_767], [3073, 34_737, name.len() as u16, 0]];
    let spec = CrsSpec::from_geokeys(&keys(&entries, &[], name)).expect("a known name");
    assert_eq!(spec.epsg, Some(2927));
}

#[test]
fn damaged_keys_are_refused_with_their_reason() {
    let refused = |keys: &GeoKeys| match CrsSpec::from_geokeys(keys) {
        Err(CrsError::Malformed { reason, .. }) => reason,
        other => panic!("{other:?}"),
    };
    assert!(refused(&GeoKeys::default()).contains("version 1"));
    let two = GeoKeys { directory: vec![2, 1, 0, 0], ..GeoKeys::default() };
    assert!(refused(&two).contains("version 1"));
    let short = GeoKeys { directory: vec![1, 1, 0, 3, 1024, 0, 1, 1], ..GeoKeys::default() };
    assert!(refused(&short).contains("promises 3 keys and holds 1"));
    assert!(refused(&keys(&[], &[], "")).contains("no CRS"));
    assert!(refused(&keys(&[[1024, 0, 1, 3]], &[], "")).contains("geocentric"));
    assert!(refused(&keys(&[[1024, 0, 1, 1]], &[], "")).contains("no projection"));
    // Everything user-defined, parameters out of reach.
    let lost = [[1024, 0, 1, 1], [3072, 0, 1, 32_767], [3075, 0, 1, 1], [3080, 34_736, 1, 9]];
    assert!(refused(&keys(&lost, &[1.0], "")).contains("no projection"));
}

#[test]
fn what_users_type() {
    for text in ["EPSG:2927", "2927", " epsg:2927 ", "urn:ogc:def:crs:EPSG::2927"] {
        let spec = CrsSpec::from_user_input(text).expect(text);
        assert_eq!(spec.epsg, Some(2927), "{text}");
        assert_eq!(spec.name, "NAD83(HARN) / Washington South (ftUS)");
        assert_eq!(spec.linear_unit, Some(LinearUnit::UsSurveyFoot));
    }
    for text in ["EPSG:2927+5703", "2927+5703", "EPSG:2927+EPSG:5703"] {
        let upright = CrsSpec::from_user_input(text).expect(text).vertical.expect("compound");
        assert_eq!((upright.epsg, upright.unit), (Some(5703), Some(LinearUnit::Metre)), "{text}");
    }
    for text in [
        "NAD83(HARN) / Washington South (ftUS)",
        "NAD_1983_HARN_StatePlane_Washington_South_FIPS_4602_Feet",
        "nad_1983_harn_stateplane_washington_south_fips_4602_feet",
    ] {
        assert_eq!(CrsSpec::from_user_input(text).expect(text).epsg, Some(2927));
    }
    for text in ["", "EPSG:", "EPSG:-1", "0", "2927+", "2927+5703+1", "seattle", "EPSG:29 27"] {
        let error = CrsSpec::from_user_input(text).expect_err(text);
        assert!(matches!(error, CrsError::Malformed { .. }), "{text}: {error}");
    }
    let error = CrsSpec::from_user_input("EPSG:5703").expect_err("vertical").to_string();
    assert!(error.contains("EPSG:2927+5703"), "{error}");
}

#[test]
fn esri_and_compound_wkt() {
    let esri = r#"PROJCS["NAD_1983_HARN_StatePlane_Washington_South_FIPS_4602_Feet",GEOGCS["GCS_North_American_1983_HARN",DATUM["D_North_American_1983_HARN",SPHEROID["GRS_1980",6378137.0,298.257222101]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Lambert_Conformal_Conic"],PARAMETER["False_Easting",1640416.666666667],PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",-120.5],PARAMETER["Standard_Parallel_1",45.83333333333334],PARAMETER["Standard_Parallel_2",47.33333333333334],PARAMETER["Latitude_Of_Origin",45.33333333333334],UNIT["Foot_US",0.3048006096012192]]"#;
    let spec = CrsSpec::from_wkt(esri).expect("ESRI");
    assert_eq!(spec.epsg, Some(2927));
    assert_eq!(resolved_name(&spec), "NAD83(HARN) / Washington South (ftUS)");

    let compound = format!(
        r#"COMPD_CS["both",{esri},VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005],UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]]]"#
    );
    let spec = CrsSpec::from_wkt(&compound).expect("compound");
    let upright = spec.vertical.as_ref().expect("a vertical part");
    assert_eq!((spec.epsg, upright.epsg), (Some(2927), Some(6360)));
    assert_eq!(upright.unit, Some(LinearUnit::UsSurveyFoot));

    // The same with the datum of EPSG:2286: another CRS, 1.3 m away.
    let nad83 = esri.replace("_1983_HARN\"", "_1983\"");
    assert_eq!(CrsSpec::from_wkt(&nad83).expect("ESRI").epsg, Some(2286));
    // An unknown datum, meridian or unit identifies nothing.
    for (from, to) in [
        ("D_North_American_1983_HARN", "D_Somewhere"),
        ("\"Greenwich\",0.0", "\"Paris\",2.3372291666667"),
        ("\"Foot_US\",0.3048006096012192", "\"Yard\",0.9144"),
        ("-120.5", "-120.4"),
    ] {
        let other = esri.replace(from, to).replace("GCS_North_American_1983_HARN", "GCS_X");
        assert_eq!(CrsSpec::from_wkt(&other).expect("WKT").epsg, None, "{from} -> {to}");
    }
}

#[test]
fn wkt_whose_code_and_content_disagree() {
    let wkt = |code: u32, datum: &str, easting: f64| {
        format!(
            r#"PROJCS["x",GEOGCS["{datum}",DATUM["{datum}",SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Lambert_Conformal_Conic_2SP"],PARAMETER["latitude_of_origin",45.3333333333333],PARAMETER["central_meridian",-120.5],PARAMETER["standard_parallel_1",47.3333333333333],PARAMETER["standard_parallel_2",45.8333333333333],PARAMETER["false_easting",{easting}],PARAMETER["false_northing",0],UNIT["US survey foot",0.304800609601219],AUTHORITY["EPSG","{code}"]]"#
        )
    };
    let epsg = |code, datum, easting| CrsSpec::from_wkt(&wkt(code, datum, easting)).map(|s| s.epsg);
    assert_eq!(epsg(2927, "NAD83(HARN)", 1_640_416.667), Ok(Some(2927)));
    // The parameters of the zone next door, under this code.
    let error = epsg(2926, "NAD83(HARN)", 1_640_416.667);
    assert_eq!(error, Ok(Some(2927)), "the parameters are those of EPSG:2927");
    for contradiction in [epsg(2927, "NAD83", 1_640_416.667), epsg(2927, "NAD83(HARN)", 500_000.0)]
    {
        let error = contradiction.expect_err("contradiction");
        assert!(matches!(error, CrsError::Contradiction { .. }), "{error}");
        assert!(error.to_string().contains("--crs"), "{error}");
    }
}

#[test]
fn geographic_and_local_crs_are_refused_by_name() {
    let wkt = r#"GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]"#;
    for spec in [CrsSpec::from_wkt(wkt), CrsSpec::from_user_input("EPSG:4269")] {
        let spec = spec.expect("a CRS");
        assert!(spec.geographic);
        let error = resolve(&spec, &ResolveOptions::default()).expect_err("degrees").to_string();
        assert!(error.contains("EPSG:4") && error.contains("--crs"), "{error}");
    }
    for nothing in
        [r#"LOCAL_CS["site",UNIT["metre",1]]"#, r#"VERT_CS["NAVD88 height"]"#, "ENGCRS[]"]
    {
        let error = CrsSpec::from_wkt(nothing).expect_err("no CRS of use");
        assert!(matches!(error, CrsError::Malformed { .. }), "{error}");
    }
}

#[cfg(not(feature = "proj"))]
#[test]
fn the_pure_build_refuses_by_name_and_says_what_to_do() {
    let error = |spec: &CrsSpec, operation: Option<&str>| {
        let operation = operation.map(str::to_owned);
        let options = ResolveOptions { operation, ..ResolveOptions::default() };
        resolve(spec, &options).expect_err("refused").to_string()
    };
    let belgium = CrsSpec::from_user_input("EPSG:31370").expect("a code");
    let said = error(&belgium, None);
    assert!(said.contains("EPSG:31370") && said.contains("PROJ") && said.contains("--crs"));
    let nad83 = CrsSpec::from_user_input("EPSG:2285").expect("a code");
    let said = error(&nad83, Some("1737"));
    assert!(said.contains("1188") && said.contains("1737"), "{said}");
    let said = error(&nad83, Some("+proj=pipeline +step +proj=noop"));
    assert!(said.contains("feature `proj`"), "{said}");
    assert!(CrsSpec::from_user_input("+proj=utm +zone=10").is_err());
}

proptest! {
    #[test]
    fn no_keys_make_the_reader_panic(
        entries in prop::collection::vec(
            (prop::sample::select(vec![1024_u16, 1026, 2048, 2050, 2054, 3072, 3073, 3074, 3075, 3076,
                3077, 3078, 3080, 3081, 4096, 4097, 4099]),
             prop::sample::select(vec![0_u16, 34_735, 34_736, 34_737, 7]), 0_u16..20, any::<u16>()),
            0..12),
        doubles in prop::collection::vec(any::<f64>(), 0..4), ascii in "[ -~é|=]{0,30}",
    ) {
        let entries: Vec<_> = entries.into_iter().map(|(a, b, c, d)| [a, b, c, d % 3080]).collect();
        if let Ok(spec) = CrsSpec::from_geokeys(&keys(&entries, &doubles, &ascii)) {
            let _ = spec.label();
        }
    }
}
