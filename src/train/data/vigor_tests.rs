//! A small VIGOR folder with everything that can be wrong with it.

use super::*;
use image::{GrayImage, Rgb, RgbImage};
use std::fs;
use std::path::PathBuf;

const PLACE: &str = "47.600000,-122.330000";

struct Case {
    root: tempfile::TempDir,
}

impl Case {
    /// A city with four good items: `a` to `d`.
    fn new() -> Self {
        let case = Self { root: tempfile::tempdir().expect("a folder") };
        for name in ["satellite", "panorama", "pano_sky_mask", "sat_depth"] {
            fs::create_dir_all(case.path(&format!("Seattle/{name}"))).expect("a folder");
        }
        let mut lines = String::new();
        for (i, id) in ["a", "b", "c", "d"].into_iter().enumerate() {
            let satellite = format!("satellite_47.600{i}_-122.3300.png");
            let panorama = Self::panorama(id);
            let picture = RgbImage::from_fn(64, 64, |x, y| Rgb([x as u8, y as u8, i as u8]));
            picture.save(case.path(&format!("Seattle/satellite/{satellite}"))).expect("saves");
            RgbImage::from_pixel(64, 32, Rgb([9, 9, 200]))
                .save(case.path(&format!("Seattle/panorama/{panorama}")))
                .expect("saves");
            case.save_mask(id, 64, 32);
            let mask = format!("Seattle/pano_sky_mask/{id},{PLACE},.png");
            let (h, w) = (i as i32 * 10, -(i as i32) * 20);
            lines += &format!(
                "Seattle/satellite/{satellite} Seattle/panorama/{panorama} {mask} {h} {w}\r\n"
            );
        }
        fs::write(case.path("train_pairs.txt"), lines).expect("writes");
        case
    }

    fn panorama(id: &str) -> String {
        format!("{id},{PLACE},.png")
    }

    fn save_mask(&self, id: &str, width: u32, height: u32) {
        let path = self.path(&format!("Seattle/pano_sky_mask/{id},{PLACE},.png"));
        GrayImage::from_fn(width, height, |_, y| image::Luma([if y < 10 { 255 } else { 0 }]))
            .save(path)
            .expect("saves");
    }

    fn path(&self, below: &str) -> PathBuf {
        self.root.path().join(below)
    }

    fn settings(&self) -> VigorSettings {
        VigorSettings { folder: self.root.path().to_owned(), side: 32, ..VigorSettings::default() }
    }

    fn open(&self) -> Vigor {
        Vigor::open(&self.settings(), 5).expect("opens")
    }
}

/// Every item by itself: its name, or why there is no example.
fn all(source: &Vigor) -> Vec<Result<Example, SkipReason>> {
    source.items.iter().map(|item| source.load(item)).collect()
}

#[test]
fn an_item_is_read_as_the_reference_reads_it() {
    let case = Case::new();
    let depth = case.path("Seattle/sat_depth/satellite_47.6001_-122.3300_depth.png");
    let picture = RgbImage::from_fn(64, 64, |x, y| Rgb([(4 * x) as u8, (3 * y) as u8, 77]));
    picture.save(depth).expect("saves");
    let source = case.open();
    assert_eq!(source.len(), 4);
    let example = all(&source).remove(1).expect("good");
    assert_eq!((example.satellite.width, example.satellite.height), (32, 32));
    let street = example.street.expect("a street");
    assert_eq!((street.panorama.width, street.sky.width), (64, 64));
    assert_eq!((street.sky.data[0], street.sky.data[64 * 31]), (255, 0));
    // h = 10 px down, w = -20 px right of the centre of 640.
    assert_eq!(street.position, [10.0 / 320.0, -20.0 / 320.0, -0.85]);
    let depth = example.depth.expect("a label");
    assert_eq!((depth.channels, depth.height, depth.width), (1, 32, 32));
    let small = resize_bicubic(&rgb(image::DynamicImage::ImageRgb8(picture)), 32, 32);
    let expected = pillow_grey(&small.data);
    assert_eq!(depth.data[500], f32::from(expected[500]) / 255.0);
    // The others have no label, and that is no fault of theirs.
    assert_eq!(all(&source).remove(0).expect("good").depth, None);
}

#[test]
fn the_manifest_of_ingest_says_the_same_as_the_label_files() {
    let case = Case::new();
    let layout = crate::vigor::Layout::find(case.root.path(), None, &[]).expect("a root");
    let ingest = crate::vigor::Ingest::run(
        &layout,
        &crate::vigor::IngestOptions::default(),
        &crate::batch::Interrupt::default(),
        true,
    )
    .expect("ingests");
    ingest.write(&case.path("ingest")).expect("writes");
    let manifest = Some(case.path("ingest/manifest.csv"));
    let by_manifest =
        Vigor::open(&VigorSettings { manifest, ..case.settings() }, 5).expect("opens");
    assert_eq!(by_manifest.items, case.open().items);
    assert_eq!(by_manifest.identity(), case.open().identity());
    fs::write(case.path("bad.csv"), "city,split\nSeattle,train\n").expect("writes");
    let manifest = Some(case.path("bad.csv"));
    let error =
        Vigor::open(&VigorSettings { manifest, ..case.settings() }, 5).err().expect("refuses");
    assert!(error.to_string().contains("sat3d vigor ingest"), "{error}");
}

#[test]
fn bad_items_are_skipped_with_their_reasons_and_others_take_their_places() {
    let case = Case::new();
    fs::remove_file(case.path(&format!("Seattle/panorama/{}", Case::panorama("a")))).expect("is");
    case.save_mask("b", 32, 16);
    fs::write(case.path("Seattle/satellite/satellite_47.6002_-122.3300.png"), b"\x89PNG\r\n")
        .expect("writes");
    let source = case.open();
    let kinds: Vec<String> = all(&source)
        .into_iter()
        .map(|result| result.map_or_else(|reason| reason.kind(), |example| example.name))
        .collect();
    let expected = [
        "panorama missing",
        "sky mask of another size",
        "satellite image unreadable",
        "d,47.600000,-122.330000,.png",
    ];
    assert_eq!(kinds, expected);
    let reason = all(&source).remove(1).expect_err("is bad").to_string();
    assert!(reason.contains("32 x 16") && reason.contains("64 x 32"), "{reason}");
    // Whatever the draw, the good one is found in the end, and the skips are the same when asked again.
    for draw in 0..8 {
        let attempts = |source: &Vigor| -> Vec<Result<String, Skip>> {
            (0..4).map(|k| source.example(draw, k).map(|example| example.name)).collect()
        };
        let first = attempts(&source);
        assert_eq!(first.iter().filter(|result| result.is_ok()).count(), 1);
        assert_eq!(attempts(&case.open()), first);
    }
}

#[test]
fn a_camera_outside_the_image_makes_no_example() {
    let case = Case::new();
    let text = fs::read_to_string(case.path("train_pairs.txt")).expect("reads");
    fs::write(case.path("train_pairs.txt"), text.replace(" 10 -20", " 330 -20")).expect("writes");
    let reason = all(&case.open()).remove(1).expect_err("is outside");
    assert_eq!(reason.kind(), "camera outside the image");
}

#[test]
fn an_empty_part_and_images_alone() {
    let case = Case::new();
    let settings = VigorSettings { split: "val".into(), ..case.settings() };
    let error = Vigor::open(&settings, 5).err().expect("nothing there");
    assert!(error.to_string().contains("split `val`"), "{error}");
    fs::remove_dir_all(case.path("Seattle/panorama")).expect("is there");
    let source =
        Vigor::open(&VigorSettings { street: false, ..case.settings() }, 5).expect("opens");
    assert!(all(&source).iter().all(|result| result.as_ref().is_ok_and(|e| e.street.is_none())));
}
