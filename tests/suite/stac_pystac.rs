//! A STAC collection as pystac sees it: read, walked, and validated with the schemas that it bundles.
//!
//! Set `SAT3D_TEST_PYTHON` (or `SAT3D_PYTHON`, as the other tests do) to an interpreter that has
//! pystac with its validation extra; without one the test says that it was skipped.

use sat3d::grid::{ImageGrid, LonLat, PixelPoint};
use sat3d::stac::{Asset, Collection, Item, ProjectedGrid, Provider, TimeRange, write};
use serde_json::json;
use std::io::Write as _;
use std::process::Command;

/// Fails if anything asks the network, so that what passes here passes offline.
const SCRIPT: &str = r#"
import hashlib, json, socket, sys
def refuse(*args, **kwargs):
    raise OSError("the network was asked")
socket.socket.connect = refuse
import pystac
from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension
folder = sys.argv[1]
collection = pystac.Collection.from_file(folder + "/collection.json")
count = collection.validate_all()
items = list(collection.get_items(recursive=True))
assert count == len(items) == 3, (count, len(items))
assert collection.extent.temporal.intervals == [[None, None]], collection.extent.temporal.intervals
assert collection.get_root() is collection
for item in items:
    assert item.get_parent() is collection and item.get_collection() is collection
    projection = ProjectionExtension.ext(item, add_if_missing=True)
    assert projection.code == "EPSG:3857" and projection.shape == [4, 4]
    a, b, west, d, e, north = projection.transform[:6]
    assert a > 0 and b == 0 and d == 0 and e < 0 and west < 0 and north > 0
    for asset in item.assets.values():
        path = asset.get_absolute_href()
        data = open(path, "rb").read()
        file = FileExtension.ext(asset, add_if_missing=True)
        assert file.size == len(data)
        assert file.checksum == "1220" + hashlib.sha256(data).hexdigest()
known = [item for item in items if item.common_metadata.start_datetime.year == 2021]
assert len(known) == 1 and known[0].common_metadata.end_datetime.month == 4
broken = json.load(open(folder + "/items/" + items[0].id + ".json"))
del broken["properties"]["end_datetime"]
try:
    pystac.validation.validate_dict(broken)
except pystac.STACValidationError:
    print("valid")
"#;

#[test]
fn pystac_validates_a_collection_with_its_own_schemas() {
    let interpreter = ["SAT3D_TEST_PYTHON", "SAT3D_PYTHON"].iter().find_map(std::env::var_os);
    let interpreter = interpreter.unwrap_or_else(|| "python3".into());
    let has = Command::new(&interpreter).args(["-c", "import pystac, jsonschema"]).output();
    if !has.is_ok_and(|output| output.status.success()) {
        // The test harness hides what `eprintln!` says; this reaches the terminal.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: no python with pystac and jsonschema (set SAT3D_TEST_PYTHON)"
        );
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let items: Vec<Item> = (0..3).map(|number| item(folder.path(), number)).collect();
    let collection = Collection {
        id: "test".into(),
        title: "A title".into(),
        description: "A *description* with \"quotes\" and \u{e9}".into(),
        license: "other".into(),
        keywords: vec!["DSM".into()],
        providers: vec![Provider {
            name: "Someone".into(),
            roles: vec!["producer".into()],
            url: None,
        }],
        extra: [("sat3d:software".to_owned(), json!("sat3d"))].into_iter().collect(),
    };
    write(folder.path(), &collection, &items).expect("writes");
    let output = Command::new(interpreter)
        .args(["-c", SCRIPT])
        .arg(folder.path())
        .output()
        .expect("python runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "valid");
}

fn item(folder: &std::path::Path, number: u8) -> Item {
    let id = format!("satellite_47.6{number}_-122.3");
    let path = format!("{id}_dsm.npz");
    let data = vec![number; 10 + usize::from(number)];
    std::fs::write(folder.join(&path), &data).expect("writes");
    let center = LonLat { lon_deg: -122.3, lat_deg: 47.6 + f64::from(number) / 100.0 };
    let grid = ImageGrid::new(center, 20, 4, 4).expect("a grid");
    let corners = [(0.0, 4.0), (4.0, 4.0), (4.0, 0.0), (0.0, 0.0)];
    let captured =
        TimeRange { start: "2021-03-01T00:00:00Z".into(), end: "2021-04-30T23:59:59Z".into() };
    Item {
        id,
        corners: corners.map(|(x, y)| grid.lonlat(PixelPoint { x, y })),
        captured: (number == 1).then_some(captured),
        grid: Some(ProjectedGrid {
            code: "EPSG:3857".into(),
            shape: [4, 4],
            geotransform: grid.geotransform(),
        }),
        properties: [("gsd".to_owned(), json!(0.1))].into_iter().collect(),
        assets: vec![("dsm".into(), asset(path, &data))],
    }
}

fn asset(path: String, data: &[u8]) -> Asset {
    use sha2::{Digest, Sha256};
    Asset {
        path,
        title: "Heights".into(),
        media_type: "application/zip".into(),
        roles: vec!["data".into()],
        bytes: Some(data.len() as u64),
        sha256: Some(sat3d::plan::hex(&Sha256::digest(data))),
        extra: [
            ("data_type".to_owned(), json!("float32")),
            ("nodata".to_owned(), json!("nan")),
            ("unit".to_owned(), json!("m")),
            (
                "statistics".to_owned(),
                json!({"minimum": 1.5, "maximum": 9.0, "mean": 4.0, "valid_percent": 99.0}),
            ),
        ]
        .into_iter()
        .collect(),
    }
}
