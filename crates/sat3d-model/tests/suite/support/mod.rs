//! What the tests share: fixtures and goldens, made-up networks, comparison.
#![allow(dead_code, reason = "each test file uses a part")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use safetensors::SafeTensors;
use sat3d_model::field::{FieldInputs, PointHead};
use sat3d_model::network::BurnNetwork;
use sat3d_model::weights::point_head;
use sat3d_model::weights::rule::{RuleWeights, tiny_overrides};
use sat3d_model::{Config, Device, Grid, Image8, Network, preprocess};
use std::path::{Path, PathBuf};

/// A safetensors file in memory.
pub struct Tensors(Vec<u8>);

impl Tensors {
    pub fn open(path: &Path) -> Option<Self> {
        std::fs::read(path).ok().map(Self)
    }

    fn view<T>(&self, name: &str, read: impl Fn(&[u8]) -> T) -> (Vec<usize>, T) {
        let tensors = SafeTensors::deserialize(&self.0).unwrap();
        let view = tensors.tensor(name).unwrap_or_else(|_| panic!("no tensor {name}"));
        (view.shape().to_vec(), read(view.data()))
    }

    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.view(name, |b| b.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()).1
    }

    pub fn i64(&self, name: &str) -> Vec<i64> {
        self.view(name, |b| b.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b)).collect()).1
    }

    pub fn shape(&self, name: &str) -> Vec<usize> {
        self.view(name, |_| ()).0
    }

    pub fn grid(&self, name: &str) -> Grid {
        let shape = self.shape(name);
        let [c, h, w] = shape[shape.len() - 3..] else { panic!("{name}: {shape:?}") };
        Grid::new(c, h, w, self.f32(name))
    }
}

/// A file of the crate's fixtures.
pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name)
}

/// The folder of the published parity data: `SAT3D_GOLDENS`, else `shared/goldens` beside the repository;
/// or a line that says what is skipped.
pub fn goldens(what: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("SAT3D_GOLDENS").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/goldens"),
        PathBuf::from,
    );
    if folder.join("common.safetensors").is_file() {
        return Some(folder);
    }
    eprintln!(
        "SKIPPED {what}: no parity data in {}; name its folder in SAT3D_GOLDENS",
        folder.display()
    );
    None
}

/// An 8-bit RGB image.
pub fn png(path: &Path) -> Image8 {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut data = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut data).unwrap();
    assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
    data.truncate(info.buffer_size());
    Image8::new(info.width as usize, info.height as usize, 3, data).unwrap()
}

/// The synthetic satellite image, as the network takes it.
pub fn satellite() -> Grid {
    preprocess::satellite(&png(&fixture("inputs/satellite_47.6_-122.33.png")), 256).unwrap()
}

/// What a made-up network makes of the synthetic image: map, point head, sky, style code.
pub struct Case {
    pub inputs: FieldInputs,
    pub head: PointHead,
    pub sky: Grid,
    pub style: Vec<f32>,
}

/// Runs `tiny` or `tiny_triplane` with weights by rule.
pub fn case(config: &str) -> Case {
    let text = std::fs::read_to_string(fixture(&format!("{config}/model/config.json"))).unwrap();
    let config = Config::from_json(&text).unwrap();
    let weights = RuleWeights::new(&config, tiny_overrides());
    let head = point_head(&config, &weights).unwrap();
    let network = BurnNetwork::new(config.clone(), Box::new(weights), Device::Cpu).unwrap();
    let inputs = FieldInputs {
        map: network.map(&satellite()).unwrap(),
        representation: config.representation,
        activation: config.activation,
        scale: config.scale as f32,
    };
    let style = network.style(&[1.0 / 270.0; 270]).unwrap();
    Case { inputs, head, sky: network.sky(&style).unwrap(), style }
}

/// Relative L2 error and largest single error.
pub fn errors(got: &[f32], want: &[f32]) -> (f64, f64) {
    assert_eq!(got.len(), want.len());
    let (mut error, mut norm, mut worst) = (0.0, 0.0, 0.0_f64);
    for (got, want) in got.iter().zip(want) {
        let difference = f64::from(*got) - f64::from(*want);
        error += difference * difference;
        norm += f64::from(*want) * f64::from(*want);
        // `max` would swallow a NaN.
        worst = if difference.abs() <= worst { worst } else { difference.abs() };
    }
    ((error / f64::max(norm, 1e-60)).sqrt(), worst)
}

/// As [`errors`]; the first must be within `tolerance`, the second a number.
#[track_caller]
pub fn compare(name: &str, got: &[f32], want: &[f32], tolerance: f64) {
    let (relative, worst) = errors(got, want);
    eprintln!("{name:44} relative L2 {relative:.2e}  largest {worst:.2e}");
    assert!(relative <= tolerance, "{name}: relative L2 {relative:e} above {tolerance:e}");
    assert!(worst.is_finite(), "{name}: {worst}");
}
