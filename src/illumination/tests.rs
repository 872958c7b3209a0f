use super::panorama::{luminance, nearest_indices};
use super::*;
use crate::raster::npz::{Compression, NpyArray, NpyData, encode};
use image::DynamicImage;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/illumination").join(name)
}

/// The reference's histogram of the panorama, straight from its file.
fn golden() -> Vec<f32> {
    let bytes = std::fs::read(fixture("z_ill.npy")).expect("reads");
    let values = &bytes[bytes.len() - 4 * HISTOGRAM_LEN..];
    values.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn says(result: Result<Illumination, IlluminationError>, what: &str) {
    let error = result.expect_err(what).to_string();
    assert!(error.contains(what), "`{error}` does not say `{what}`");
}

#[test]
fn a_panorama_has_the_reference_histogram_exactly() {
    let (panorama, mask) = (fixture("panorama.png"), fixture("panorama_sky_mask.png"));
    let from_files = Illumination::from_panorama(&panorama, &mask).expect("light");
    assert_eq!(from_files.histogram, golden());
    assert_eq!(from_files.origin, "panorama panorama.png with sky mask panorama_sky_mask.png");
    let argument = panorama.to_str();
    assert_eq!(Illumination::parse(argument, Some(&mask)).expect("light"), from_files);
    let stored = Illumination::from_histogram(&fixture("z_ill.npy"), None).expect("light");
    assert_eq!(stored.histogram, golden());
    let named = Illumination::named("clear").expect("light");
    assert_eq!(named.histogram, golden());
    assert_eq!(named.sha256(), stored.sha256());
}

#[test]
fn there_is_always_a_named_light() {
    let default = Illumination::parse(None, None).expect("light");
    assert_eq!(default.origin, "bundled sky clear (the default)");
    assert_eq!(default.histogram, golden());
    assert_eq!(default.parameters()["origin"], default.origin);
    for name in NAMES {
        let sky = Illumination::parse(Some(name), None).expect(name);
        assert_eq!(sky.origin, format!("bundled sky {name}"));
        assert_eq!(sky.histogram.len(), HISTOGRAM_LEN);
    }
    let bins = |name: &str| -> Vec<usize> {
        let histogram = Illumination::named(name).expect(name).histogram;
        (0..BINS).filter(|bin| histogram[*bin] > 0.0).collect()
    };
    assert_eq!(bins("white"), [BINS - 1]);
    // Bytes 231 just below the zenith and 143 just above the horizon: 0.812 and 0.122 in [-1, 1], bins 90 and
    // 56, of which ten are left out.
    let overcast = bins("overcast");
    assert_eq!((overcast.first(), overcast.last()), (Some(&46), Some(&80)), "{overcast:?}");
}

#[test]
fn masks_are_pillows_grey_and_nearest() {
    let text = std::fs::read_to_string(fixture("nearest.json")).expect("reads");
    let file: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    for (size, want) in file.as_object().expect("sizes") {
        let (width, height) = size.split_once('x').expect("a size");
        let [width, height] = [width, height].map(|side| side.parse().expect("a side"));
        let got = serde_json::json!([nearest_indices(width, 512), nearest_indices(height, 128)]);
        assert_eq!(&got, want, "{size}");
    }
    // Pillow: Image.new("RGB", ...).convert("L") of pure and mixed colours.
    let colours =
        [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [1, 2, 3], [200, 100, 50]];
    let image = image::RgbImage::from_raw(6, 1, colours.concat()).expect("an image");
    assert_eq!(luminance(&DynamicImage::ImageRgb8(image)).data, [76, 150, 29, 255, 2, 124]);
    let grey = image::GrayImage::from_raw(3, 1, vec![0, 7, 255]).expect("an image");
    assert_eq!(luminance(&DynamicImage::ImageLuma8(grey)).data, [0, 7, 255]);
}

#[test]
fn rows_of_a_file_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut rows = golden();
    rows.extend(Illumination::named("white").expect("light").histogram);
    let write = |name: &str, shape: &[usize], data: &[f32]| {
        let array = NpyArray { name: "histo", shape, data: NpyData::F32(data) };
        let path = folder.path().join(name);
        std::fs::write(&path, encode(&[array], Compression::Stored)).expect("writes");
        path.to_str().expect("a path").to_owned()
    };
    let two = write("histo.npz", &[2, 270], &rows);
    let second = Illumination::parse(Some(&format!("{two}:1")), None).expect("light");
    assert_eq!(second.histogram, &rows[270..]);
    assert_eq!(second.origin, "histogram histo.npz row 1");
    says(Illumination::parse(Some(&two), None), "2 rows; name one, as in histo.npz:0");
    says(Illumination::parse(Some(&format!("{two}:2")), None), "row 2 of 2");
    let one = write("one.npz", &[1, 270], &rows[..270]);
    assert_eq!(Illumination::parse(Some(&one), None).expect("light").histogram, golden());
    let short = write("short.npz", &[269], &rows[..269]);
    says(Illumination::parse(Some(&short), None), "shape [269]");
    let mut wrong = golden();
    wrong[3] = -0.5;
    says(Illumination::parse(Some(&write("a.npz", &[270], &wrong)), None), "value 3 is -0.5");
    wrong[3] = f32::NAN;
    says(Illumination::parse(Some(&write("b.npz", &[270], &wrong)), None), "value 3 is NaN");
    let double: Vec<f32> = golden().iter().map(|v| 2.0 * v).collect();
    says(Illumination::parse(Some(&write("c.npz", &[270], &double)), None), "red sum to 2.0000");
    let mut no_blue = golden();
    no_blue[180..].fill(0.0);
    assert!(Illumination::checked("x".into(), no_blue).is_ok());
}

#[test]
fn what_is_no_light_is_refused_by_name() {
    says(
        Illumination::parse(Some("sunset"), None),
        "sunset: neither a bundled sky (clear, overcast",
    );
    says(Illumination::parse(Some("pano.jpg"), None), "pano.jpg: a panorama needs --sky-mask");
    let mask = fixture("panorama_sky_mask.png");
    says(Illumination::parse(None, Some(&mask)), "--illumination is not given");
    says(Illumination::parse(Some("white"), Some(&mask)), "--illumination is white");
    says(Illumination::parse(Some("a.npy"), Some(&mask)), "--illumination is a.npy");
    says(Illumination::parse(Some("/no/such.npy"), None), "/no/such.npy");
    says(Illumination::parse(Some("/no/such.jpg"), Some(&mask)), "/no/such.jpg");
    says(Illumination::from_panorama(&fixture("clear.csv"), &mask), "clear.csv");
    let folder = tempfile::tempdir().expect("a folder");
    let black = folder.path().join("black.png");
    image::GrayImage::new(8, 4).save(&black).expect("writes");
    says(Illumination::from_panorama(&fixture("panorama.png"), &black), "leaves no sky");
}

/// A network of nothing but shapes.
struct Shapes {
    columns: usize,
}

impl Network for Shapes {
    fn map(&self, image: &Grid) -> Result<Grid, ModelError> {
        Ok(image.clone())
    }

    fn style(&self, histogram: &[f32]) -> Result<Vec<f32>, ModelError> {
        Ok(histogram[..4].to_vec())
    }

    fn sky(&self, _: &[f32]) -> Result<Grid, ModelError> {
        let data = (0..2 * 3 * self.columns).map(|k| k as f32).collect();
        Ok(Grid::new(2, 3, self.columns, data))
    }

    fn super_resolve(&self, features: &Grid) -> Result<Grid, ModelError> {
        Ok(features.clone())
    }
}

#[test]
fn the_skys_empty_columns_are_cut_off() {
    let light = Illumination::named("white").expect("light");
    for (columns, width) in [(921, 512), (28, 16), (1, 1), (3, 2)] {
        let parts = sky(&Shapes { columns }, &light).expect("a sky");
        assert_eq!((parts.map.width, parts.map.height, parts.map.channels), (width, 3, 2));
        assert_eq!(parts.map.data[width], columns as f32, "the second row begins");
        assert_eq!(parts.style.len(), 4);
    }
    // No width has 0.8 of itself added to make 4.
    assert!(sky(&Shapes { columns: 4 }, &light).is_err());
}
