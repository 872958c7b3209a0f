//! Parity with the reference: every stage of the network against what the reference computed.
//!
//! The data of the small networks lies in `fixtures`. With `SAT3D_GOLDENS` (or a folder
//! `shared/goldens` beside the checkout) the published set is used instead, and with
//! `SAT3D_FULL_PARITY=1` the full network is run too (its weights are made by rule; 2 minutes, 3 GB):
//!
//! ```text
//! SAT3D_FULL_PARITY=1 cargo test --release -p sat3d-model --test parity -- --nocapture
//! ```
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use safetensors::SafeTensors;
use sat3d_model::config::{Config, RELEASED};
use sat3d_model::field::{DensityActivation, Representation};
use sat3d_model::network::{BurnNetwork, Stage};
use sat3d_model::weights::rule::{
    Override, RuleWeights, full_overrides, tiny_overrides, write_checkpoint,
};
use sat3d_model::weights::{Checkpoint, TensorSource, expected};
use sat3d_model::{Device, Grid, Image8, Model, Network, preprocess};
use std::path::{Path, PathBuf};

/// Stride, in values, between the samples that the parity data holds of a large tensor.
const STRIDE: usize = 1_000_003;

/// A file of the parity data.
fn golden(name: &str) -> Option<PathBuf> {
    let crate_root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let published = std::env::var_os("SAT3D_GOLDENS").map(PathBuf::from);
    [published, Some(crate_root.join("../../../shared/goldens")), Some(crate_root.join("fixtures"))]
        .into_iter()
        .flatten()
        .map(|root| root.join(name))
        .find(|path| path.is_file())
}

struct Golden {
    name: String,
    bytes: Vec<u8>,
}

impl Golden {
    fn open(name: &str) -> Self {
        let path = golden(name).unwrap_or_else(|| panic!("no {name} in the parity data"));
        Self { name: name.into(), bytes: std::fs::read(path).unwrap() }
    }

    fn values(&self, key: &str) -> Option<Vec<f32>> {
        let file = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = file.tensor(key).ok()?;
        let (items, _) = tensor.data().as_chunks::<4>();
        Some(items.iter().map(|&item| f32::from_le_bytes(item)).collect())
    }

    fn shape(&self, key: &str) -> Option<Vec<usize>> {
        let file = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = file.tensor(&format!("{key}:shape")).ok()?;
        let (items, _) = tensor.data().as_chunks::<8>();
        Some(items.iter().map(|&item| usize::try_from(i64::from_le_bytes(item)).unwrap()).collect())
    }

    /// Holds a tensor against its samples; all stages of a name must be within `tolerance` in
    /// relative L2, and within `largest` in the largest single error.
    fn compare(&self, key: &str, shape: &[usize], values: &[f32], bound: Bound) {
        let known = self.shape(key).unwrap_or_else(|| panic!("{}: no {key}", self.name));
        // The batch (and, for planes, the place among them) are axes of length 1.
        let squeezed = |shape: &[usize]| -> Vec<usize> {
            shape.iter().copied().filter(|&side| side != 1).collect()
        };
        assert_eq!(squeezed(&known), squeezed(shape), "{}: {key}", self.name);
        let samples = self.values(&format!("{key}:s")).unwrap();
        let picked: Vec<f32> =
            (0..samples.len()).map(|index| values[index * STRIDE % values.len()]).collect();
        bound.check(&format!("{} {key}", self.name), &picked, &samples);
    }
}

/// How far a stage may be from the reference.
#[derive(Clone, Copy)]
struct Bound {
    /// Relative L2 error.
    relative: f64,
    /// Largest single error.
    largest: f64,
}

impl Bound {
    /// `oracle` is the largest error of an independent NumPy implementation at the same stage; ours
    /// may be 20 times that.
    const fn new(relative: f64, oracle: f64) -> Self {
        Self { relative, largest: 20.0 * oracle }
    }

    fn check(self, name: &str, found: &[f32], wanted: &[f32]) {
        assert_eq!(found.len(), wanted.len(), "{name}");
        let (mut error, mut norm, mut largest) = (0.0, 0.0, 0.0_f64);
        for (&found, &wanted) in found.iter().zip(wanted) {
            let difference = f64::from(found) - f64::from(wanted);
            assert!(difference.is_finite(), "{name}: {found}");
            error += difference * difference;
            norm += f64::from(wanted) * f64::from(wanted);
            largest = largest.max(difference.abs());
        }
        let relative = (error / norm.max(1e-60)).sqrt();
        println!("{name:50} relative L2 {relative:.2e}, largest {largest:.2e}");
        assert!(relative < self.relative, "{name}: relative L2 {relative:e}");
        assert!(largest < self.largest, "{name}: largest error {largest:e}");
    }
}

/// Compares each stage that the parity data knows, and counts them.
struct Watch {
    golden: Golden,
    bound: Bound,
    seen: usize,
}

impl Watch {
    fn new(name: &str, bound: Bound) -> Self {
        Self { golden: Golden::open(name), bound, seen: 0 }
    }

    fn look(&mut self, stage: Stage) {
        // Samples of large tensors are stored, small ones whole.
        if self.golden.shape(&stage.name).is_some() {
            self.golden.compare(&stage.name, &stage.shape, &stage.values, self.bound);
            self.seen += 1;
        }
    }
}

fn png(name: &str) -> Image8 {
    let path = golden(name).unwrap();
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut data = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut data).unwrap();
    assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
    data.truncate(info.buffer_size());
    Image8::new(info.width as usize, info.height as usize, 3, data).unwrap()
}

fn satellite() -> Grid {
    preprocess::satellite(&png("inputs/satellite_47.6_-122.33.png"), 256).unwrap()
}

/// What to hold one set against.
struct Set {
    folder: &'static str,
    network: BurnNetwork,
    tokens: Bound,
    decoder: Bound,
    planes: Bound,
    sky: Bound,
    super_resolution: Bound,
    /// Channels of a plane.
    plane: usize,
}

fn network(config: &str, overrides: Vec<Override>) -> (BurnNetwork, Config) {
    let config = Config::from_json(config).unwrap();
    let weights = Box::new(RuleWeights::new(&config, overrides));
    (BurnNetwork::new(config.clone(), weights, Device::Cpu).unwrap(), config)
}

fn tiny() -> Set {
    let text = std::fs::read_to_string(golden("tiny/model/config.json").unwrap()).unwrap();
    let (network, config) = network(&text, tiny_overrides());
    Set {
        folder: "tiny",
        network,
        tokens: Bound::new(1e-5, 5.2e-6),
        decoder: Bound::new(3e-5, 5.7e-5),
        planes: Bound::new(3e-5, 3.1e-5),
        sky: Bound::new(1e-4, 2.3e-5),
        super_resolution: Bound::new(1e-4, 3.7e-5),
        plane: config.plane_channels,
    }
}

fn full() -> Set {
    let (network, config) = network(RELEASED, full_overrides());
    Set {
        folder: "full",
        network,
        tokens: Bound::new(1e-5, 3.4e-6),
        decoder: Bound::new(3e-5, 4.6e-5),
        planes: Bound::new(3e-5, 2.4e-5),
        sky: Bound::new(1e-4, 2.3e-5),
        super_resolution: Bound::new(1e-4, 2.2e-5),
        plane: config.plane_channels,
    }
}

impl Set {
    fn file(&self, name: &str) -> String {
        format!("{}/{name}.safetensors", self.folder)
    }

    fn check_map(&self) {
        let mut watch = Watch::new(&self.file("01_encoder"), self.tokens);
        let tokens =
            self.network.tokens(&satellite(), Some(&mut |stage| watch.look(stage))).unwrap();
        // Embeddings, each layer, ten stages inside the first one, final tokens.
        assert!(watch.seen >= 15, "{} stages of the encoder", watch.seen);
        let mut watch = Watch::new(&self.file("02_decoder"), self.decoder);
        let map = self.network.decode(&tokens, Some(&mut |stage| watch.look(stage))).unwrap();
        assert_eq!(watch.seen, 29, "stages of the decoder");
        self.check_planes(&map, &watch.golden);
    }

    /// The plane, sampled, and the line, whole.
    fn check_planes(&self, map: &Grid, golden: &Golden) {
        let size = map.height * map.width;
        let (plane, rest) = map.data.split_at(self.plane * size);
        golden.compare("plane", &[self.plane, map.height, map.width], plane, self.planes);
        let every_eighth: Vec<f32> = plane
            .chunks(map.width)
            .step_by(8)
            .flat_map(|row| row.iter().copied().step_by(8))
            .collect();
        let name = format!("{} plane, every 8th", golden.name);
        self.planes.check(&name, &every_eighth, &golden.values("plane_stride8").unwrap());
        let line: Vec<f32> = rest
            .chunks(size)
            .flat_map(|channel| {
                (0..map.width).map(|column| {
                    let rows = channel.iter().skip(column).step_by(map.width);
                    (rows.map(|&value| f64::from(value)).sum::<f64>() / map.height as f64) as f32
                })
            })
            .collect();
        let name = format!("{} line", golden.name);
        self.planes.check(&name, &line, &golden.values("line").unwrap());
    }

    fn check_sky(&self) {
        let mut watch = Watch::new(&self.file("05_sky"), self.sky);
        let histogram = watch.golden.values("z_ill").unwrap();
        let style = self.network.style(&histogram).unwrap();
        let name = format!("{} style", self.folder);
        self.sky.check(&name, &style, &watch.golden.values("w_sky").unwrap());
        let sky = self.network.sky_observed(&style, Some(&mut |stage| watch.look(stage))).unwrap();
        assert!(watch.seen >= 15, "{} stages of the sky decoder", watch.seen);
        let shape = [sky.channels, sky.height, sky.width];
        watch.golden.compare("sky_feature_2D", &shape, &sky.data, self.sky);
        // Below the horizon there is no sky.
        let empty = sky.height * 4 / 5;
        for row in sky.data.chunks(sky.width) {
            assert!(row[row.len() - empty..].iter().all(|value| *value == 0.0));
        }
    }

    /// The composite that goes in was rendered by the NumPy oracle: the reference's own is only
    /// stored in samples, which it meets within 6e-6.
    fn check_super_resolution(&self) {
        let composite = Golden::open(&self.file("06_pano_composite")).values("compo").unwrap();
        let channels = composite.len() / (64 * 256);
        let composite = Grid::new(channels, 64, 256, composite);
        let mut watch = Watch::new(&self.file("06_pano"), self.super_resolution);
        // Stages inside have no bound of an oracle: they are left to the relative one.
        watch.bound.largest = f64::INFINITY;
        let image = self
            .network
            .super_resolve_observed(&composite, Some(&mut |stage| watch.look(stage)))
            .unwrap();
        assert_eq!(watch.seen, 9, "stages of the super-resolution");
        assert_eq!((image.channels, image.height, image.width), (3, 128, 512));
        let wanted = watch.golden.values("sr_image").unwrap();
        let name = format!("{} super-resolution", self.folder);
        self.super_resolution.check(&name, &image.data, &wanted);
    }
}

#[test]
fn the_resized_image_is_pillows_bit_for_bit() {
    let image = png("inputs/satellite_47.6_-122.33.png");
    let resized = preprocess::resize_bicubic(&image, 256, 256);
    assert_eq!(resized, png("sat_resized_256.png"));
    // Resizing to the same size changes nothing.
    assert_eq!(preprocess::resize_bicubic(&resized, 256, 256), resized);
}

#[test]
fn tiny_image_to_map() {
    tiny().check_map();
}

#[test]
fn tiny_sky() {
    tiny().check_sky();
}

#[test]
fn tiny_super_resolution() {
    tiny().check_super_resolution();
}

#[test]
fn tiny_triplane_map() {
    let path = golden("tiny_triplane/model/config.json").unwrap();
    let (network, config) = network(&std::fs::read_to_string(path).unwrap(), tiny_overrides());
    let tokens = network.tokens(&satellite(), None).unwrap();
    let mut watch = Watch::new("tiny_triplane/02_decoder.safetensors", Bound::new(3e-5, 5.7e-5));
    let map = network.decode(&tokens, Some(&mut |stage| watch.look(stage))).unwrap();
    assert_eq!(watch.seen, 29, "stages of the decoder");
    let shape = [3, config.plane_channels, map.height, map.width];
    watch.golden.compare("triplane", &shape, &map.data, Bound::new(3e-5, 3.1e-5));
}

#[test]
fn full_network() {
    if std::env::var_os("SAT3D_FULL_PARITY").is_none_or(|value| value != "1") {
        eprintln!("SKIPPED full_network: set SAT3D_FULL_PARITY=1 (2 minutes, 3 GB)");
        return;
    }
    let Some(_) = golden("full/01_encoder.safetensors") else {
        eprintln!("SKIPPED full_network: no parity data; name its folder in SAT3D_GOLDENS");
        return;
    };
    let set = full();
    set.check_map();
    set.check_sky();
    set.check_super_resolution();
}

/// The files that the reference saved, tensor by tensor, against the rule that should have made
/// them; and the model that comes from them.
#[test]
fn the_references_files_hold_the_rules_weights() {
    for name in ["tiny", "tiny_triplane"] {
        let file = format!("{name}/model/diffusion_pytorch_model.safetensors");
        let Some(path) = golden(&file) else {
            eprintln!("SKIPPED the_references_files_hold_the_rules_weights: no {file}");
            return;
        };
        let checkpoint = Checkpoint::open(path.parent().unwrap()).unwrap();
        let config = checkpoint.config().clone();
        let rule = RuleWeights::new(&config, tiny_overrides());
        let mut compared = 0;
        for spec in expected(&config) {
            let Some(shape) = checkpoint.file().shape(&spec.key) else { continue };
            assert_eq!(shape, spec.shape, "{}", spec.key);
            let stored = checkpoint.read(&spec.key, shape).unwrap();
            let made = rule.read(&spec.key, shape).unwrap();
            assert!(
                stored.iter().zip(&made).all(|(a, b)| a.to_bits() == b.to_bits()),
                "{}",
                spec.key
            );
            compared += 1;
        }
        assert_eq!(compared, checkpoint.file().keys().count());
        let model = Model::load(path.parent().unwrap(), &Device::Cpu).unwrap();
        assert_eq!(model.head.net0.inputs, config.point_features());
        assert_eq!(model.head.density.bias, [-4.5]);
    }
}

#[test]
fn a_loaded_model_gives_the_field_its_inputs() {
    let text = std::fs::read_to_string(golden("tiny/model/config.json").unwrap()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    write_checkpoint(folder.path(), &text, tiny_overrides()).unwrap();
    let model = Model::load(folder.path(), &Device::Cpu).unwrap();
    let inputs = model.field_inputs(&png("inputs/satellite_47.6_-122.33.png")).unwrap();
    assert_eq!(inputs.representation, Representation::Oneplane);
    assert_eq!(inputs.activation, DensityActivation::Mipnerf);
    assert_eq!(inputs.scale.to_bits(), 0.8_f32.to_bits());
    tiny().check_planes(&inputs.map, &Golden::open("tiny/02_decoder.safetensors"));
    // As from the file, so by the rule.
    assert!(inputs.map == tiny().network.map(&satellite()).unwrap());
}

/// The same bytes for any number of threads: stored results hang on it.
#[test]
fn threads_do_not_change_the_result() {
    let image = satellite();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let set = tiny();
            let map = set.network.map(&image).unwrap();
            let style = set.network.style(&[1.0 / 270.0; 270]).unwrap();
            (map, set.network.sky(&style).unwrap())
        })
    };
    let one = run(1);
    for threads in [2, 5] {
        assert!(run(threads) == one, "{threads} threads");
    }
}
