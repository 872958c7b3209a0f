//! `sat3d vigor ingest`, end to end: the built binary on small folders made here, and on the real
//! label files where they are (`SAT3D_TEST_DATA`, else `../shared/data`).

use sat3d::grid::LonLat;
use sat3d::vigor::{UtmZone, UtmZones, corrected_offset};
use serde_json::Value;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;

/// Runs `sat3d vigor ingest` and gives its output.
fn ingest(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sat3d"))
        .args(["vigor", "ingest"])
        .args(arguments)
        .output()
        .expect("the binary runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("UTF-8")
}

fn path_text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Says on the terminal (past the test harness, which hides it) that a test was skipped.
fn skip(why: &str) {
    let _ = writeln!(std::io::stderr(), "SKIPPED: {why}");
}

/// A file or folder of the real test data.
fn real_data(path: &str) -> Option<PathBuf> {
    let base = std::env::var_os("SAT3D_TEST_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let full = base.join(path);
    if full.exists() {
        Some(full)
    } else {
        skip(&format!("no {} (set SAT3D_TEST_DATA)", full.display()));
        None
    }
}

const SEATTLE_RESOLUTION_M: f64 = 0.100_817;

/// A lattice of overlapping images in Seattle; column and row 0 are the south-western.
fn satellite(column: i32, row: i32) -> String {
    let (lon, lat) = center(column, row);
    format!("satellite_{lat}_{lon}.png")
}

fn center(column: i32, row: i32) -> (f64, f64) {
    (-122.33 + 0.000_2 * f64::from(column), 47.6 + 0.000_2 * f64::from(row))
}

/// A panorama a little north-east of an image's centre.
fn panorama(id: &str, column: i32, row: i32) -> (String, LonLat) {
    let (lon, lat) = center(column, row);
    let (lon, lat) = (lon + 0.000_05, lat + 0.000_03);
    (format!("{id},{lat:.6},{lon:.6},.jpg"), LonLat { lon_deg: lon, lat_deg: lat })
}

/// The corrected label of a panorama in an image. (That the formula is right is shown on the real
/// labels.)
fn label(at: LonLat, image: (f64, f64)) -> [i64; 2] {
    let zone = UtmZone::of(at);
    let zones = UtmZones::resolve([zone]).expect("a zone");
    let [panorama, satellite] = [at, LonLat { lon_deg: image.0, lat_deg: image.1 }]
        .map(|position| zones.project(zone, position).expect("a position"));
    corrected_offset(panorama, satellite, SEATTLE_RESOLUTION_M)
}

/// A label line: the image at (`column`, `row`), and three others.
fn label_line(id: &str, column: i32, row: i32, others: [(i32, i32); 3]) -> String {
    let (name, _) = panorama(id, column, row);
    // The name holds six decimals, and so does the label's position.
    let fields: Vec<&str> = name.split(',').collect();
    let at = LonLat {
        lon_deg: fields[2].parse().expect("a longitude"),
        lat_deg: fields[1].parse().expect("a latitude"),
    };
    let mut line = name;
    for (column, row) in [(column, row)].into_iter().chain(others) {
        let [d0, d1] = label(at, center(column, row));
        line += &format!(" {} {d0}.0 {d1}.0", satellite(column, row));
    }
    line
}

fn write(path: &Path, content: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
    fs::write(path, content).expect("a file");
}

fn png(size: u32) -> Vec<u8> {
    let image = image::RgbImage::from_fn(size, size, |x, y| image::Rgb([x as u8, y as u8, 90]));
    let mut out = std::io::Cursor::new(Vec::new());
    image.write_to(&mut out, image::ImageFormat::Png).expect("encodes");
    out.into_inner()
}

fn jpeg() -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(64, 32).write_to(&mut out, image::ImageFormat::Jpeg).expect("encodes");
    out.into_inner()
}

/// A root with two cities in which everything goes wrong that does in practice.
fn messy_root() -> TempDir {
    let root = tempfile::tempdir().expect("a folder");
    let near = [(1, 0), (0, 1), (1, 1)];
    let good = [
        label_line("a", 0, 0, near),
        label_line("b", 1, 1, [(0, 0), (0, 1), (1, 0)]),
        // The third semi-positive is far away: its panorama lies outside it.
        label_line("c", 0, 0, [(1, 0), (0, 1), (5, 5)]),
    ];
    // One label is off by a pixel; one number is none; one field is missing; one name is none.
    let (first, last) = good[0].rsplit_once(' ').expect("fields");
    let last: f64 = last.parse().expect("a number");
    let off = format!("{} {}", first.replacen("a,", "d,", 1), last + 1.0);
    let number = good[1].replacen("b,", "e,", 1).replace(".0 satellite", ".O satellite");
    let short = good[0].rsplit_once(' ').expect("fields").0.replacen("a,", "f,", 1);
    let name = good[0].replacen("a,", "g,", 1).replacen("satellite_", "sat-", 1);
    let train = format!(
        "\u{feff}{}\r\n{}\n\n{}\r\n{off}\r\n{number}\n{short}\n{name}\n{}",
        good[0], good[1], good[1], good[2]
    );
    let seattle = root.path().join("Seattle");
    write(
        &root.path().join("splits__corrected/Seattle/same_area_balanced_train__corrected.txt"),
        train,
    );
    write(
        &root.path().join("splits__corrected/Seattle/same_area_balanced_test__corrected.txt"),
        label_line("t", 1, 0, [(0, 0), (0, 1), (1, 1)]),
    );
    let mut list = String::new();
    for (column, row) in [(0, 0), (1, 0), (0, 1), (1, 1), (2, 2)] {
        list += &satellite(column, row);
        list.push('\n');
    }
    write(&root.path().join("splits__corrected/Seattle/satellite_list.txt"), list);
    let whole = png(640);
    for (column, row) in [(0, 0), (1, 0)] {
        write(&seattle.join("satellite").join(satellite(column, row)), &whole);
    }
    write(&seattle.join("satellite").join(satellite(0, 1)), png(64));
    write(&seattle.join("satellite").join(satellite(1, 1)), &whole[..whole.len() / 2]);
    write(&seattle.join("satellite").join(satellite(9, 9)), &whole);
    write(&seattle.join("satellite/Thumbs.db"), "x");
    // What QGIS leaves beside an image that it has shown belongs to that image.
    write(&seattle.join("satellite").join(satellite(9, 9) + ".aux.xml"), "<PAMDataset/>");
    write(&seattle.join("panorama").join(panorama("a", 0, 0).0), jpeg());
    write(&seattle.join("panorama").join(panorama("b", 1, 1).0), "no JPEG");

    // A split file with five and three fields, for a city without any folder.
    let split = "NewYork/satellite/satellite_40.73_-73.99.png NewYork/panorama/n1,40.7301,-73.9901,.jpg NewYork/pano_sky_mask/n1.png -100 -75\n\
                 NewYork/satellite/satellite_40.73_-73.99.png NewYork/panorama/n2,40.73,-73.9899,.jpg NewYork/pano_sky_mask/n2.png\r\n\
                 NewYork/satellite/satellite_40.73_-73.99.png NewYork/panorama/n3,40.73,-73.9899,.jpg NewYork/pano_sky_mask/n3.png 1\r\n";
    write(&root.path().join("test_remove_building.txt"), split);
    write(&root.path().join("notes.txt"), "nothing of interest\n");
    root
}

fn summary(out: &Path) -> Value {
    serde_json::from_slice(&fs::read(out.join("summary.json")).expect("summary.json"))
        .expect("JSON")
}

fn city<'a>(summary: &'a Value, name: &str) -> &'a Value {
    let cities = summary["cities"].as_array().expect("cities");
    cities.iter().find(|city| city["city"] == name).expect("the city")
}

#[test]
fn a_messy_root_is_read_to_its_end_and_every_problem_is_placed() {
    let root = messy_root();
    let out = root.path().join("out");
    let run = ingest(&[path_text(root.path()), "--out", path_text(&out), "--verify", "full"]);
    assert_eq!(text(&run.stderr), "");
    assert_eq!(run.status.code(), Some(1), "some lines and images are bad");

    let summary = summary(&out);
    let places: Vec<(String, Option<u64>, Option<u64>, String)> = summary["problems"]
        .as_array()
        .expect("problems")
        .iter()
        .map(|p| {
            let words = |key: &str| p[key].as_str().expect("text").to_owned();
            (words("file"), p["line"].as_u64(), p["field"].as_u64(), words("kind"))
        })
        .collect();
    let train = "splits__corrected/Seattle/same_area_balanced_train__corrected.txt";
    let place =
        |file: &str, line, field, kind: &str| (file.to_owned(), Some(line), field, kind.to_owned());
    assert_eq!(
        places,
        [
            place(train, 4, None, "duplicate"),
            place(train, 6, Some(4), "number"),
            place(train, 6, Some(7), "number"),
            place(train, 6, Some(10), "number"),
            place(train, 7, None, "field-count"),
            place(train, 8, Some(2), "name"),
            place("test_remove_building.txt", 3, None, "field-count"),
        ]
    );
    let seattle = city(&summary, "Seattle");
    let labels = &seattle["labels"][0];
    assert_eq!((&labels["reproduced"], &labels["not_reproduced"]), (&19.into(), &1.into()));
    assert_eq!(labels["not_reproduced_examples"][0]["line"], 5);
    assert_eq!(labels["semi_positive"]["outside"], 1);
    assert_eq!(labels["train_test"]["shared_panoramas"], 0);
    assert_eq!(labels["train_test"]["shared_satellites"], 4);
    let images = &seattle["satellite_images"];
    assert_eq!(
        ["good", "missing", "bad", "not_in_lists", "other_files"].map(|key| &images[key]),
        [3, 2, 2, 1, 1].map(Value::from).each_ref()
    );
    assert_eq!(images["missing_files"], Value::from(vec![satellite(5, 5), satellite(2, 2)]));
    let panoramas = &seattle["panorama_images"];
    assert_eq!(
        ["good", "missing", "bad"].map(|key| &panoramas[key]),
        [1, 3, 1].map(Value::from).each_ref()
    );
    let new_york = city(&summary, "NewYork");
    assert_eq!(new_york["labels"][0]["labels"], "sat3dgen");
    assert_eq!(new_york["labels"][0]["without_label"], 1);
    assert_eq!(new_york["satellite_images"], Value::Null);
    // -100 rows and -75 columns: 100 pixels north and 75 west, as the names say.
    let residual = new_york["labels"][0]["positive"]["residual_px"]["max"].as_f64();
    assert!(residual.is_some_and(|px| px < 3.0), "{residual:?}");
    let skipped =
        summary["files"].as_array().expect("files").iter().find(|f| f["file"] == "notes.txt");
    assert!(skipped.expect("the file")["skipped"].as_str().expect("a reason").contains("VIGOR"));

    // The truncated image has a good header.
    let run = ingest(&[path_text(root.path()), "--out", path_text(&out), "--json"]);
    let printed: Value = serde_json::from_slice(&run.stdout).expect("one JSON object");
    assert_eq!(city(&printed, "Seattle")["satellite_images"]["bad"], 1);
    let run =
        ingest(&[path_text(root.path()), "--out", path_text(&out), "--verify", "none", "--json"]);
    let printed: Value = serde_json::from_slice(&run.stdout).expect("one JSON object");
    assert_eq!(city(&printed, "Seattle")["satellite_images"]["bad"], 0);
}

#[test]
fn the_summary_for_people_says_what_was_done_and_what_not() {
    let root = messy_root();
    let out = root.path().join("out");
    let run = ingest(&[path_text(root.path()), "--out", path_text(&out), "--city", "seattle"]);
    let printed = text(&run.stdout).replace(path_text(root.path()), "ROOT");
    insta::assert_snapshot!(printed);
}

#[test]
fn the_manifest_has_a_row_per_pair_and_the_same_bytes_for_any_number_of_threads() {
    let root = messy_root();
    let run = |threads: &str| {
        let out = root.path().join(format!("out{threads}"));
        let status = Command::new(env!("CARGO_BIN_EXE_sat3d"))
            .args(["vigor", "ingest", "-q", "--out"])
            .args([&out, root.path()])
            .env("RAYON_NUM_THREADS", threads)
            .output()
            .expect("the binary runs");
        assert_eq!(status.status.code(), Some(1));
        ["manifest.csv", "manifest.parquet", "summary.json"]
            .map(|name| fs::read(out.join(name)).expect("an output"))
    };
    let [one, five] = [run("1"), run("5")];
    assert!(one == five, "outputs depend on the number of threads");

    let mut reader = csv::Reader::from_reader(one[0].as_slice());
    let header = reader.headers().expect("a header").clone();
    let column = |name: &str| header.iter().position(|h| h == name).expect("the column");
    let rows: Vec<csv::StringRecord> = reader.records().collect::<Result<_, _>>().expect("records");
    assert_eq!(rows.len(), 5 * 4 + 2);
    let count =
        |name: &str, value: &str| rows.iter().filter(|row| &row[column(name)] == value).count();
    assert_eq!(count("role", "positive"), 7);
    assert_eq!(count("split", "test"), 6);
    assert_eq!(count("inside", "false"), 1);
    assert_eq!(count("reproduced", "false"), 2, "one label is off, Sat3DGen's is made up");
    assert_eq!(count("label_d0", ""), 1);
    assert_eq!(count("sky_mask", "NewYork/pano_sky_mask/n2.png"), 1);
    assert_eq!(count("satellite_status", "unchecked"), 2);
    // Pixel of the panorama: label and exact position agree within the label's known error.
    for row in &rows {
        let number = |name: &str| row[column(name)].parse::<f64>().ok();
        let Some(d0) = number("label_d0") else { continue };
        let expected = 320.0 + d0 - number("residual_y_px").expect("a residual");
        assert!((number("y_px").expect("a pixel") - expected).abs() < 1e-9);
    }
}

#[test]
fn unusable_folders_are_refused_with_what_to_do() {
    let root = tempfile::tempdir().expect("a folder");
    let file = root.path().join("file.txt");
    write(&file, "x");
    let empty = root.path().join("empty");
    fs::create_dir(&empty).expect("a folder");
    let nonsense = root.path().join("nonsense");
    write(&nonsense.join("a.txt"), "one\ntwo words\n");
    let out = root.path().join("out");
    for (folder, more, said) in [
        (root.path().join("none"), vec![], "does not exist"),
        (file.clone(), vec![], "is a file"),
        (empty.clone(), vec![], "holds nothing of VIGOR"),
        (nonsense, vec![], "nothing could be read of the 1 text files"),
        (messy_root().keep(), vec!["--city", "Delft"], "has no city `Delft`; it has Seattle"),
    ] {
        let mut arguments = vec![path_text(&folder), "--out", path_text(&out)];
        arguments.extend(more);
        let run = ingest(&arguments);
        let error = text(&run.stderr);
        assert_eq!(run.status.code(), Some(2), "{error}");
        assert!(error.starts_with("error: ") && error.contains(said), "{error}");
        assert!(!out.exists(), "nothing is written: {said}");
        if said.contains("Delft") {
            fs::remove_dir_all(folder).expect("removes");
        }
    }
    // The output cannot be written: a file is in the way.
    let labels = root.path().join("Seattle/same_area_balanced_test.txt");
    write(&labels, label_line("a", 0, 0, [(1, 0), (0, 1), (1, 1)]));
    let run = ingest(&[path_text(&root.path().join("Seattle")), "--out", path_text(&file)]);
    assert_eq!(run.status.code(), Some(2));
    assert!(text(&run.stderr).contains("file.txt"), "{}", text(&run.stderr));
}

#[test]
fn a_city_without_a_known_resolution_needs_one_for_the_formula() {
    let root = tempfile::tempdir().expect("a folder");
    let folder = root.path().join("Atlantis");
    let line = label_line("a", 0, 0, [(1, 0), (0, 1), (1, 1)]);
    write(&folder.join("same_area_balanced_test__corrected.txt"), line);
    let out = root.path().join("out");
    let base = [path_text(&folder), "--out", path_text(&out)];
    let run = ingest(&base);
    assert_eq!(run.status.code(), Some(0));
    assert!(text(&run.stdout).contains("give --resolution"), "{}", text(&run.stdout));
    let reproduced = |more: &[&str]| {
        let run = ingest(&[&base[..], more].concat());
        assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
        summary(&out)["cities"][0]["labels"][0]["reproduced"].as_u64()
    };
    assert_eq!(reproduced(&["--resolution", "0.100817"]), Some(4));
    assert_eq!(reproduced(&["--city", "Seattle"]), Some(4));
    assert_eq!(reproduced(&["--resolution", "0.114"]), Some(0));
    assert_eq!(ingest(&["--resolution", "-1", path_text(&folder)]).status.code(), Some(2));
}

#[test]
fn a_geopackage_on_request() {
    let root = messy_root();
    let out = root.path().join("out");
    let gpkg = root.path().join("vigor.gpkg");
    let run =
        ingest(&[path_text(root.path()), "--out", path_text(&out), "--gpkg", path_text(&gpkg)]);
    #[cfg(feature = "gdal")]
    {
        use gdal::vector::LayerAccess as _;
        assert_eq!(run.status.code(), Some(1), "{}", text(&run.stderr));
        let dataset = gdal::Dataset::open(&gpkg).expect("opens");
        let features = |name: &str| dataset.layer_by_name(name).expect("the layer").feature_count();
        assert_eq!(features("panoramas"), 7);
        assert_eq!(features("satellite_images"), 8);
    }
    #[cfg(not(feature = "gdal"))]
    {
        assert_eq!(run.status.code(), Some(2));
        assert!(text(&run.stderr).contains("built without GDAL"), "{}", text(&run.stderr));
        assert!(!gpkg.exists() && !out.exists());
    }
}

#[test]
fn help_shows_examples() {
    let help = text(&ingest(&["--help"]).stdout);
    assert!(help.contains("sat3d vigor ingest VIGOR/ --city Seattle"), "{help}");
}

#[test]
fn the_formula_reproduces_every_integer_of_the_real_seattle_labels() {
    let Some(folder) = real_data("vigor/Seattle") else { return };
    let root = tempfile::tempdir().expect("a folder");
    let out = root.path().join("out");
    let run = ingest(&[path_text(&folder), "--out", path_text(&out)]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));

    let summary = summary(&out);
    assert_eq!(summary["problems"], Value::Array(Vec::new()));
    let seattle = city(&summary, "Seattle");
    assert_eq!((&seattle["panoramas"], &seattle["satellites"]), (&23_751.into(), &20_776.into()));
    let labels = &seattle["labels"][0];
    assert_eq!(labels["labels"], "corrected");
    assert_eq!((&labels["reproduced"], &labels["not_reproduced"]), (&95_004.into(), &0.into()));
    // What is known of these labels: PAPER figures for the set, rounded.
    let max = |role: &str| labels[role]["residual_px"]["max"].as_f64().expect("a number");
    assert!((3.0..3.6).contains(&max("positive")), "{}", max("positive"));
    assert!((5.5..6.7).contains(&max("semi_positive")), "{}", max("semi_positive"));
    assert_eq!(labels["positive"]["outside"], 0);
    assert_eq!(labels["train_test"]["shared_panoramas"], 0);

    // The exact pixel, by another formula for the Mercator ordinate than the library's.
    let world = 268_435_456.0;
    let ordinate = |lat: f64| {
        libm::log(libm::tan(std::f64::consts::FRAC_PI_4 + lat.to_radians() / 2.0))
            / (2.0 * std::f64::consts::PI)
    };
    let mut reader = csv::Reader::from_path(out.join("manifest.csv")).expect("opens");
    let header = reader.headers().expect("a header").clone();
    let columns = ["pano_lat", "pano_lon", "sat_lat", "sat_lon", "x_px", "y_px"]
        .map(|name| header.iter().position(|h| h == name).expect("the column"));
    let mut rows = 0;
    for row in reader.records() {
        let row = row.expect("a record");
        let [pano_lat, pano_lon, sat_lat, sat_lon, x, y] =
            columns.map(|c| row[c].parse::<f64>().expect("a number"));
        assert!((320.0 + (pano_lon - sat_lon) / 360.0 * world - x).abs() < 1e-6, "{row:?}");
        let south = (ordinate(sat_lat) - ordinate(pano_lat)) * world;
        assert!((320.0 + south - y).abs() < 1e-6, "{row:?}");
        rows += 1;
    }
    assert_eq!(rows, 95_004);
}

#[test]
fn real_images_are_palettes_and_decode() {
    let Some(folder) = real_data("images") else { return };
    let root = tempfile::tempdir().expect("a folder");
    let city_folder = root.path().join("Seattle");
    for entry in fs::read_dir(folder).expect("lists") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        if name.starts_with("satellite_") {
            write(&city_folder.join("satellite").join(name), fs::read(&path).expect("reads"));
        }
    }
    let out = root.path().join("out");
    let run = ingest(&[path_text(&city_folder), "--out", path_text(&out), "--verify", "full"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stdout));
    assert_eq!(city(&summary(&out), "Seattle")["satellite_images"]["good"], 8);
}

#[test]
fn geopandas_opens_the_manifest() {
    let python = std::env::var_os("SAT3D_PYTHON").unwrap_or_else(|| "python3".into());
    let has = Command::new(&python).args(["-c", "import geopandas, pyarrow"]).output();
    if !has.is_ok_and(|output| output.status.success()) {
        skip("no python with geopandas and pyarrow (set SAT3D_PYTHON)");
        return;
    }
    let root = messy_root();
    let out = root.path().join("out");
    ingest(&[path_text(root.path()), "--out", path_text(&out)]);
    let script = r#"
import sys, geopandas, pandas
g = geopandas.read_parquet(sys.argv[1] + "/manifest.parquet")
c = pandas.read_csv(sys.argv[1] + "/manifest.csv", float_precision="round_trip")
assert len(g) == len(c) == 22, (len(g), len(c))
assert g.crs.to_authority() == ("OGC", "CRS84")
assert (g.geometry.x == g.pano_lon).all() and (g.geometry.y == g.pano_lat).all()
plain = g.drop(columns="geometry")
assert list(plain.columns) == list(c.columns)
for name in plain.select_dtypes("number"):
    assert ((plain[name] == c[name]) | (plain[name].isna() & c[name].isna())).all(), name
print("ok")
"#;
    let run = Command::new(&python).args(["-c", script]).arg(&out).output().expect("python runs");
    assert_eq!(text(&run.stdout), "ok\n", "{}", text(&run.stderr));
}
