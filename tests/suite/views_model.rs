//! Views through the whole network, against pictures of the reference (its small network, weights by rule).
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::views_support;

use sat3d::footprint::Footprint;
use sat3d::illumination::{Illumination, sky};
use sat3d::model::config::Config;
use sat3d::model::scene::SceneParts;
use sat3d::model::weights::rule::{RuleWeights, tiny_overrides};
use sat3d::model::{Device, Image8, Model, Scene};
use sat3d::raster::npz;
use sat3d::views::{NamedFile, Optics, Place, ViewContext, ViewRequests, render};
use std::path::{Path, PathBuf};
use views_support::Pixels;

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// One `f32` tensor of a safetensors file.
fn tensor(path: &Path, name: &str) -> Vec<f32> {
    let bytes = std::fs::read(path).unwrap();
    let (length, rest) = bytes.split_at(8);
    let length = u64::from_le_bytes(length.try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&rest[..length]).unwrap();
    let ends = [0, 1].map(|k| header[name]["data_offsets"][k].as_u64().unwrap() as usize);
    let data = &rest[length..][ends[0]..ends[1]];
    data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn run(requests: &ViewRequests) -> Vec<NamedFile> {
    let fixtures = "crates/sat3d-model/fixtures";
    let config = std::fs::read_to_string(root(&format!("{fixtures}/tiny/model/config.json")));
    let config = Config::from_json(&config.unwrap()).unwrap();
    let weights = RuleWeights::new(&config, tiny_overrides());
    let device: Device = "cpu".parse().unwrap();
    let model = Model::from_source(config, Box::new(weights), &device.into()).unwrap();
    let name = root(&format!("{fixtures}/inputs/satellite_47.6_-122.33.png"));
    let image = image::open(name).unwrap().to_rgb8();
    let image = Image8::new(640, 640, 3, image.into_raw()).unwrap();
    let light = Illumination::parse(None, None).unwrap();
    let parts = SceneParts {
        inputs: model.field_inputs(&image).unwrap(),
        head: model.head.clone(),
        sky: Some(sky(model.network.as_ref(), &light).unwrap()),
        metres_per_unit: 32.24,
    };
    let scene = Scene::new(parts).unwrap();
    let footprint = Footprint::of_training([640, 640]);
    let network = Some(model.network.as_ref());
    render(requests, &ViewContext { scene: &scene, network, footprint: &footprint, stem: "tiny" })
        .unwrap()
}

/// The goldens' place: crop position (0.25, -0.3).
fn requests() -> ViewRequests {
    let position = Some(Place::Pixel([224.0, 400.0]));
    ViewRequests { position, super_resolution: true, ..ViewRequests::default() }
}

#[test]
fn pictures_are_the_references() {
    let mut requests =
        ViewRequests { panorama: true, perspective: true, satellite: true, ..requests() };
    requests.angles.yaw = 35.0;
    requests.angles.pitch = 10.0;
    let files = run(&requests);
    let want = root("crates/sat3d-model/fixtures/parity/tiny.safetensors");
    let want = tensor(&want, "06_pano/sr_image:s");
    let panorama = Pixels::of(&files, "tiny_panorama.png");
    assert_eq!(panorama.size(), (512, 128));
    assert_eq!(want.len(), 4096);
    let got = (0..want.len()).map(|k| {
        let flat = (k * 1_000_003) % (3 * 128 * 512);
        let (row, column) = (flat / 512 % 128, flat % 512);
        panorama.at(row, column)[flat / (128 * 512)]
    });
    let off = got.zip(&want).filter(|(byte, want)| {
        let want = (*want * 255.0) as u8;
        assert!(byte.abs_diff(want) <= 1, "{byte} {want}");
        *byte != want
    });
    assert!(off.count() <= 4, "bytes that are off by one");
    let golden = npz::read(&root("fixtures/views/tiny_perspective_stride2.npy")).unwrap();
    let perspective = Pixels::of(&files, "tiny_perspective.png");
    assert_eq!(perspective.size(), (256, 256));
    compare("perspective", &perspective, &golden[0].1.to_f32(), 2);
    assert_eq!(Pixels::of(&files, "tiny_satellite.png").size(), (256, 256));
}

/// Every byte is the reference's, cut off as it does, or next to it.
fn compare(name: &str, got: &Pixels, want: &[f32], stride: usize) {
    let (width, height) = got.size();
    let (width, height) = (width as usize / stride, height as usize / stride);
    assert_eq!(want.len(), 3 * width * height);
    let mut other = 0;
    for row in 0..height {
        for column in 0..width {
            let pixel = got.at(stride * row, stride * column);
            for (channel, byte) in pixel.into_iter().enumerate() {
                let want = (want[(channel * height + row) * width + column] * 255.0) as u8;
                assert!(byte.abs_diff(want) <= 1, "{name} {row} {column}: {byte} {want}");
                other += usize::from(byte != want);
            }
        }
    }
    assert!(other * 1000 < want.len(), "{name}: {other} of {} bytes are off by one", want.len());
}

#[test]
fn odd_sizes_are_cut_from_the_doubled_rays() {
    let optics = Optics { size: [37, 21], ..Optics::default() };
    let files = run(&ViewRequests { perspective: true, optics, ..requests() });
    assert_eq!(Pixels::of(&files, "tiny_perspective.png").size(), (37, 21));
}
