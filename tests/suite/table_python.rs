//! The tables that sat3d writes, read by the libraries that people use: pyarrow and geopandas.
//!
//! Set `SAT3D_PYTHON` to an interpreter that has them; without one the tests say that they were
//! skipped.

use sat3d::table::{Column, ColumnData, GeometryCrs, Table, wkb};
use std::io::Write as _;
use std::path::Path;
use std::process::Command;

/// The interpreter, if it can import `modules`.
fn python(modules: &str) -> Option<Command> {
    let interpreter = std::env::var_os("SAT3D_PYTHON").unwrap_or_else(|| "python3".into());
    let has = Command::new(&interpreter).args(["-c", &format!("import {modules}")]).output();
    if has.is_ok_and(|output| output.status.success()) {
        Some(Command::new(interpreter))
    } else {
        // The test harness hides what `eprintln!` says; this reaches the terminal.
        let _ = writeln!(std::io::stderr(), "SKIPPED: no python with {modules} (set SAT3D_PYTHON)");
        None
    }
}

fn run(mut python: Command, script: &str, path: &Path) -> String {
    let output = python.args(["-c", script]).arg(path).output().expect("python runs");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{error}");
    String::from_utf8(output.stdout).expect("text")
}

fn sample() -> Table {
    let utm = serde_json::json!({
        "$schema": "https://proj.org/schemas/v0.7/projjson.schema.json",
        "type": "GeographicCRS",
        "name": "WGS 84",
        "datum": {
            "type": "GeodeticReferenceFrame",
            "name": "World Geodetic System 1984",
            "ellipsoid": {
                "name": "WGS 84",
                "semi_major_axis": 6_378_137,
                "inverse_flattening": 298.257_223_563
            }
        },
        "coordinate_system": {
            "subtype": "ellipsoidal",
            "axis": [
                {"name": "Geodetic latitude", "abbreviation": "Lat", "direction": "north", "unit": "degree"},
                {"name": "Geodetic longitude", "abbreviation": "Lon", "direction": "east", "unit": "degree"}
            ]
        },
        "id": {"authority": "EPSG", "code": 4326}
    });
    Table::new(vec![
        Column::text("name", "A name", ["a", "b,\"c\"", "\u{e9}"]),
        Column::f64("metres", "A length, metres", [0.1, f64::NAN, 1e300]),
        Column::i64("count", "A count", [Some(i64::MAX), None, Some(-3)]),
        Column::bool("inside", "A truth", [None, Some(true), Some(false)]),
        Column::dictionary(
            "city",
            "A city",
            vec!["x".into(), "y".into()],
            [Some(1), None, Some(0)],
        ),
        Column::geometry(
            "geometry",
            "A place",
            [Some(wkb::point(-122.3, 47.6)), None, Some(wkb::rectangle(-1.0, 0.0, 1.0, 3.0))],
        ),
        Column::new(
            "other",
            "The same place in another CRS",
            ColumnData::Wkb {
                values: vec![None, None, Some(wkb::point(1.0, 2.0))],
                crs: GeometryCrs::Projjson(utm),
            },
        ),
    ])
    .expect("a table")
}

#[test]
fn pyarrow_reads_every_value_type_and_hole() {
    let Some(python) = python("pyarrow.parquet") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("t.parquet");
    sample().write_parquet(&path).expect("writes");
    let script = r#"
import sys, json, pyarrow.parquet as pq
f = pq.ParquetFile(sys.argv[1])
t = f.read()
assert [str(c.type) for c in t.columns][:5] == ["string", "double", "int64", "bool", "string"]
d = t.select(["name", "metres", "count", "inside", "city"]).to_pydict()
assert d["name"] == ["a", 'b,"c"', "\u00e9"], d
assert d["metres"] == [0.1, None, 1e300], d
assert d["count"] == [2**63 - 1, None, -3], d
assert d["inside"] == [None, True, False], d
assert d["city"] == ["y", None, "x"], d
assert f.metadata.created_by.startswith("sat3d "), f.metadata.created_by
assert f.metadata.row_group(0).column(0).compression == "SNAPPY"
assert json.loads(f.metadata.metadata[b"sat3d:columns"])["metres"] == "A length, metres"
print("ok")
"#;
    assert_eq!(run(python, script, &path), "ok\n");
}

#[test]
fn geopandas_reads_geometry_crs_and_bounds() {
    let Some(python) = python("geopandas, pyarrow") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("t.parquet");
    sample().write_parquet(&path).expect("writes");
    let script = r#"
import sys, geopandas
g = geopandas.read_parquet(sys.argv[1])
assert g.geometry.name == "geometry"
assert g.crs.to_authority() == ("OGC", "CRS84"), g.crs
assert g["other"].crs.to_epsg() == 4326, g["other"].crs
assert g.geometry[0].wkt == "POINT (-122.3 47.6)", g.geometry[0]
assert g.geometry[1] is None
assert g.geometry[2].area == 6.0 and g.geometry[2].exterior.is_ccw
assert list(g.total_bounds) == [-122.3, 0.0, 1.0, 47.6]
print("ok")
"#;
    assert_eq!(run(python, script, &path), "ok\n");
}

#[test]
fn pandas_reads_the_csv_to_the_last_bit() {
    let Some(python) = python("pandas, pyarrow") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("t.csv");
    // Numbers whose shortest forms are hard to read back: halfway cases and subnormals.
    let hard =
        [0.1, 1.0 / 3.0, 5e-324, 2.225_073_858_507_201_4e-308, -122.314_624_788_432_27, 1e23];
    let table = Table::new(vec![
        Column::f64("value", "", hard),
        Column::text("bits", "", hard.map(|v: f64| format!("{:016x}", v.to_bits()))),
    ])
    .expect("a table");
    table.write_csv(&path).expect("writes");
    let script = r#"
import sys, struct, pandas
t = pandas.read_csv(sys.argv[1], float_precision="round_trip", dtype={"bits": str})
assert [struct.pack(">d", v).hex() for v in t["value"]] == list(t["bits"])
print("ok")
"#;
    assert_eq!(run(python, script, &path), "ok\n");
}
