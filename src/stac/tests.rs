use super::*;
use serde_json::json;

fn item(id: &str, west: f64) -> Item {
    let corner = |lon_deg, lat_deg| LonLat { lon_deg, lat_deg };
    Item {
        id: id.into(),
        corners: [
            corner(west, 47.0),
            corner(west + 1.0, 47.0),
            corner(west + 1.0, 48.0),
            corner(west, 48.0),
        ],
        captured: None,
        grid: Some(ProjectedGrid {
            code: "EPSG:3857".into(),
            shape: [2, 3],
            geotransform: GeoTransform::north_up(10.0, 20.0, 0.5, 0.25),
        }),
        properties: Map::new(),
        assets: vec![(
            "dsm".into(),
            Asset {
                path: format!("{id}_dsm.npz"),
                bytes: Some(7),
                sha256: Some("ab".repeat(32)),
                ..Asset::default()
            },
        )],
    }
}

fn collection() -> Collection {
    Collection {
        id: "c".into(),
        description: "d".into(),
        license: "other".into(),
        ..Collection::default()
    }
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("reads")).expect("is JSON")
}

#[test]
fn documents_say_what_the_structures_say() {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), &collection(), &[item("a", -122.0), item("b", -120.0)]).expect("writes");
    let a = read(&folder.path().join("items/a.json"));
    assert_eq!(a["bbox"], json!([-122.0, 47.0, -121.0, 48.0]));
    assert_eq!(
        a["geometry"]["coordinates"],
        json!([[[-122.0, 47.0], [-121.0, 47.0], [-121.0, 48.0], [-122.0, 48.0], [-122.0, 47.0]]])
    );
    assert_eq!(a["properties"]["proj:transform"], json!([0.5, 0.0, 10.0, 0.0, -0.25, 20.0]));
    assert_eq!(a["properties"]["proj:shape"], json!([2, 3]));
    assert_eq!(a["properties"]["datetime"], Value::Null);
    assert_eq!(a["assets"]["dsm"]["href"], "../a_dsm.npz");
    assert_eq!(a["assets"]["dsm"]["file:checksum"], format!("1220{}", "ab".repeat(32)));
    assert_eq!(a["assets"]["dsm"]["file:size"], 7);
    let c = read(&folder.path().join(COLLECTION_FILE));
    assert_eq!(c["extent"]["spatial"]["bbox"], json!([[-122.0, 47.0, -119.0, 48.0]]));
    assert_eq!(c["extent"]["temporal"]["interval"], json!([[null, null]]));
    let links: Vec<&Value> =
        c["links"].as_array().expect("links").iter().map(|l| &l["href"]).collect();
    assert_eq!(links, ["./collection.json", "./items/a.json", "./items/b.json"]);
}

#[test]
fn the_interval_is_known_only_if_every_time_is() {
    let range = |start: &str, end: &str| Some(TimeRange { start: start.into(), end: end.into() });
    let mut items = [item("a", 1.0), item("b", 2.0)];
    items[0].captured = range("2021-03-01T00:00:00Z", "2021-03-09T00:00:00Z");
    assert_eq!(
        json::collection(&collection(), &items)["extent"]["temporal"]["interval"],
        json!([[null, null]])
    );
    items[1].captured = range("2021-02-01T00:00:00Z", "2021-03-02T00:00:00Z");
    assert_eq!(
        json::collection(&collection(), &items)["extent"]["temporal"]["interval"],
        json!([["2021-02-01T00:00:00Z", "2021-03-09T00:00:00Z"]])
    );
    assert_eq!(
        json::item(&items[1], &collection())["properties"]["start_datetime"],
        "2021-02-01T00:00:00Z"
    );
}

#[test]
fn writing_again_gives_the_same_bytes_and_removes_only_what_was_linked() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).expect("reads");
    let exists = |name: &str| folder.path().join(name).exists();
    write(folder.path(), &collection(), &[item("a", 1.0), item("b", 2.0)]).expect("writes");
    let first = [bytes("collection.json"), bytes("items/a.json")];
    std::fs::write(folder.path().join("items/mine.json"), "{}").expect("writes");
    write(folder.path(), &collection(), &[item("a", 1.0)]).expect("writes");
    assert!(exists("items/a.json") && exists("items/mine.json") && !exists("items/b.json"));
    write(folder.path(), &collection(), &[item("a", 1.0), item("b", 2.0)]).expect("writes");
    assert_eq!([bytes("collection.json"), bytes("items/a.json")], first);
    let parts = std::fs::read_dir(folder.path().join("items")).expect("lists");
    assert_eq!(parts.count(), 3, "nothing half-written is left");
}

#[test]
fn an_earlier_collection_from_elsewhere_cannot_make_it_delete_other_files() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("keep.json"), "{}").expect("writes");
    let evil = json!({"links": [
        {"rel": "item", "href": "./items/../keep.json"},
        {"rel": "item", "href": "/keep.json"},
        {"rel": "item"},
        7,
    ]});
    std::fs::write(folder.path().join(COLLECTION_FILE), evil.to_string()).expect("writes");
    write(folder.path(), &collection(), &[]).expect("writes");
    assert!(folder.path().join("keep.json").exists());
    let extent = &read(&folder.path().join(COLLECTION_FILE))["extent"]["spatial"]["bbox"];
    assert_eq!(extent, &json!([[-180.0, -90.0, 180.0, 90.0]]));
}

#[test]
fn what_cannot_be_written_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |items: &[Item]| {
        write(folder.path(), &collection(), items).expect_err("is refused").to_string()
    };
    for id in ["", "..", "a/b", "a\\b", ".hidden"] {
        assert!(refused(&[item(id, 0.0)]).contains(&format!("\"{id}\"")));
    }
    assert!(
        refused(&[item("twice", 0.0), item("twice", 1.0)])
            .contains("two STAC items are called \"twice\"")
    );
    assert!(refused(&[item("nowhere", f64::NAN)]).contains("nowhere"));
    let mut bad = item("digest", 0.0);
    bad.assets[0].1.sha256 = Some("12".into());
    assert!(refused(&[bad]).contains("asset dsm: \"12\""));
    assert!(!folder.path().join(COLLECTION_FILE).exists());
    let missing = write(Path::new("/no/such/folder"), &collection(), &[]).expect_err("is refused");
    assert!(missing.to_string().contains("/no/such/folder"));
}
