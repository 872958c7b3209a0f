#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::layers::{Conv, bilinear, standardise};
use super::loader::Loader;
use super::*;
use crate::config::{Border, Config};
use crate::weights::rule::{RuleWeights, tiny_overrides};
use crate::weights::{Need, TensorSource, expected};
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};

const TINY: &str = include_str!("../../fixtures/tiny/model/config.json");

fn tiny() -> Config {
    Config::from_json(TINY).unwrap()
}

fn network(config: &Config) -> BurnNetwork {
    let weights = RuleWeights::new(config, tiny_overrides());
    BurnNetwork::new(config.clone(), Box::new(weights), Device::Cpu).unwrap()
}

/// Paths and shapes of a module's parameters, as `burn` names them.
pub(super) fn listed(root: &str, module: &impl Module) -> Vec<(String, Vec<usize>)> {
    struct Lister {
        path: Vec<String>,
        found: Vec<(String, Vec<usize>)>,
    }
    impl ModuleVisitor for Lister {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            self.found.push((self.path.join("."), param.val().dims().to_vec()));
        }
    }
    let mut lister = Lister { path: vec![root.into()], found: Vec::new() };
    module.visit(&mut lister);
    lister.found
}

#[test]
fn modules_have_the_names_and_shapes_of_the_checkpoint() {
    let config = tiny();
    let modules: BTreeMap<_, _> = network(&config).parameters().unwrap().into_iter().collect();
    let file: BTreeMap<_, _> = expected(&config)
        .into_iter()
        .filter(|spec| spec.need == Need::Required && !spec.key.starts_with("mlp."))
        .map(|spec| (spec.key, spec.shape))
        .collect();
    assert_eq!(modules, file);
}

#[test]
fn wrong_shapes_are_refused_before_anything_runs() {
    let network = network(&tiny());
    let grid = |channels, height, width| {
        Grid::new(channels, height, width, vec![0.0; channels * height * width])
    };
    let errors = [
        network.map(&grid(3, 256, 255)).unwrap_err(),
        network.map(&grid(1, 256, 256)).unwrap_err(),
        network.decode(&grid(64, 16, 15), None).unwrap_err(),
        network.style(&[0.0; 269]).unwrap_err(),
        network.sky(&[0.0; 33]).unwrap_err(),
        network.super_resolve(&grid(3, 8, 8)).unwrap_err(),
        network.super_resolve(&grid(8, 1, 8)).unwrap_err(),
    ];
    for error in errors {
        assert!(matches!(error, ModelError::Shape { .. }), "{error}");
    }
}

#[test]
fn a_model_without_super_resolution_says_so() {
    let config = Config::from_json(&TINY.replace("\"sr_factor\": 2", "\"sr_factor\": 1")).unwrap();
    let error = network(&config).super_resolve(&Grid::new(8, 2, 2, vec![0.0; 32])).unwrap_err();
    assert!(matches!(error, ModelError::Absent { .. }), "{error}");
    assert!(error.to_string().contains("sr_factor"), "{error}");
}

#[test]
fn devices_are_named_or_refused() {
    for (name, device) in
        [("cpu", Device::Cpu), ("cuda", Device::Cuda(0)), ("cuda:3", Device::Cuda(3))]
    {
        assert_eq!(name.parse::<Device>().unwrap(), device);
    }
    for name in ["gpu", "cuda:", "cuda:x", "cpu:0", ""] {
        let error = name.parse::<Device>().unwrap_err();
        assert!(error.to_string().contains("one of cpu, cuda"), "{error}");
    }
    #[cfg(not(feature = "cuda"))]
    {
        let error = Device::Cuda(1).open().unwrap_err().to_string();
        assert!(error.contains("`cuda:1`") && error.contains("--features cuda"), "{error}");
    }
}

/// Statistics over 409600 values with a mean far from 0, as in the last level of the decoder,
/// against f64.
#[test]
fn norms_keep_their_precision_over_large_maps() {
    let (channels, groups, height, width) = (8, 2, 320, 320);
    let count = channels * height * width;
    let weights = RuleWeights::new(&tiny(), Vec::new());
    let data: Vec<f32> =
        weights.values("any", &[count, 1]).iter().map(|value| 100.0 + value).collect();
    let device = Device::Cpu.open().unwrap();
    let shape = [1, channels, height, width];
    let tensor = Tensor::from_data(TensorData::new(data.clone(), shape), &device);
    let (centred, inverse) = standardise(tensor, groups, 1e-6);
    let result: Vec<f32> = (centred * inverse).into_data().try_into_vec().unwrap();
    let size = count / groups;
    for (values, results) in data.chunks(size).zip(result.chunks(size)) {
        let mean = values.iter().map(|&value| f64::from(value)).sum::<f64>() / size as f64;
        let square = |value: f32| (f64::from(value) - mean) * (f64::from(value) - mean);
        let variance = values.iter().copied().map(square).sum::<f64>() / size as f64;
        for (&value, &result) in values.iter().zip(results) {
            let exact = (f64::from(value) - mean) / (variance + 1e-6).sqrt();
            // The input itself is only known to 100 * 2^-24 = 6e-6.
            assert!((f64::from(result) - exact).abs() < 2e-5, "{value}: {result}, exactly {exact}");
        }
    }
}

#[test]
fn the_rotary_table_turns_patches_only() {
    let config = tiny();
    let table = encoder::RotaryTable::new(&config.backbone);
    let (cos, sin) = table.patches();
    let head = config.backbone.head();
    assert_eq!((cos.len(), sin.len()), (256 * head, 256 * head));
    // Patch (0, 0), first frequency 1: 2 pi * (1/16 - 1).
    let angle = std::f64::consts::TAU * (1.0 / 16.0 - 1.0);
    assert!((f64::from(cos[0]) - libm::cos(angle)).abs() < 1e-7);
    assert!((f64::from(sin[0]) - libm::sin(angle)).abs() < 1e-7);
    // The second quarter goes with the column: patch (3, 12) against patch (12, 3).
    let at = |row: usize, column: usize, index: usize| cos[(row * 16 + column) * head + index];
    assert_eq!(at(3, 12, 1).to_bits(), at(12, 3, 1 + head / 4).to_bits());
    assert_eq!(at(3, 12, 1).to_bits(), at(3, 12, 1 + head / 2).to_bits());
}

/// Draws for every key, of any shape.
struct AnyWeights(RuleWeights);

impl TensorSource for AnyWeights {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        Ok(self.0.values(key, shape))
    }
}

#[test]
fn convolutions_continue_their_border_as_named() {
    let (inputs, outputs, height, width) = (3, 2, 5, 4);
    let source = AnyWeights(RuleWeights::new(&tiny(), Vec::new()));
    let device = Device::Cpu.open().unwrap();
    let loader = Loader::new(&source, &device);
    let weight = source.0.values("weight", &[outputs, inputs, 3, 3]);
    let bias = source.0.values("bias", &[outputs]);
    let data = source.0.values("data", &[inputs, height * width]);
    // The index that a place outside stands for.
    let inside = |border: Border, at: isize, length: usize| -> Option<usize> {
        let last = length as isize - 1;
        let at = match border {
            Border::Reflect if at < 0 => -at,
            Border::Reflect if at > last => 2 * last - at,
            Border::Circular => at.rem_euclid(last + 1),
            _ => at,
        };
        usize::try_from(at).ok().filter(|&at| at < length)
    };
    for border in [Border::Zeros, Border::Reflect, Border::Circular] {
        let conv = Conv::load(&loader, inputs, outputs, 3).unwrap().with_border(border);
        let shape = [1, inputs, height, width];
        let input = Tensor::from_data(TensorData::new(data.clone(), shape), &device);
        let result = conv.forward(input);
        assert_eq!(result.dims(), [1, outputs, height, width]);
        let result: Vec<f32> = result.into_data().try_into_vec().unwrap();
        for (at, &found) in result.iter().enumerate() {
            let (output, row, column) = (at / (height * width), at / width % height, at % width);
            let mut exact = f64::from(bias[output]);
            for tap in 0..inputs * 9 {
                let (channel, down, right) = (tap / 9, tap / 3 % 3, tap % 3);
                let row = inside(border, (row + down) as isize - 1, height);
                let column = inside(border, (column + right) as isize - 1, width);
                if let (Some(row), Some(column)) = (row, column) {
                    let value = data[(channel * height + row) * width + column];
                    exact += f64::from(weight[output * inputs * 9 + tap]) * f64::from(value);
                }
            }
            assert!((f64::from(found) - exact).abs() < 1e-5, "{border:?} {at}: {found}, {exact}");
        }
    }
}

#[test]
fn bilinear_doubling_takes_pixels_as_areas() {
    let device = Device::Cpu.open().unwrap();
    let data = TensorData::new(vec![0.0_f32, 4.0, 8.0, 16.0], [1, 1, 2, 2]);
    let doubled = bilinear(Tensor::from_data(data, &device));
    let doubled: Vec<f32> = doubled.into_data().try_into_vec().unwrap();
    // A quarter and three quarters between neighbours, the border repeated.
    let wanted = [
        0.0, 1.0, 3.0, 4.0, //
        2.0, 3.25, 5.75, 7.0, //
        6.0, 7.75, 11.25, 13.0, //
        8.0, 10.0, 14.0, 16.0,
    ];
    assert_eq!(doubled, wanted);
}

#[test]
fn padding_and_representation_decide_the_maps_size() {
    let unpadded = TINY.replace("\"pad\": 0.125,", "");
    let multi = TINY.replace("\"oneplane\"", "\"oneplane_multi\"");
    assert!(unpadded != TINY && multi != TINY);
    let tokens = Grid::new(64, 16, 16, vec![0.5; 64 * 256]);
    for (text, side) in [(unpadded, 256), (multi, 320)] {
        let config = Config::from_json(&text).unwrap();
        let map = network(&config).decode(&tokens, None).unwrap();
        assert_eq!((map.channels, map.height, map.width), (16, side, side));
        assert!(map.data.iter().all(|value| value.is_finite()));
    }
}

/// Notes which tensors are read.
struct Noted {
    weights: RuleWeights,
    keys: Arc<Mutex<Vec<String>>>,
}

impl TensorSource for Noted {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        self.keys.lock().unwrap().push(key.into());
        self.weights.read(key, shape)
    }
}

#[test]
fn only_what_an_output_needs_is_read_and_only_once() {
    let config = tiny();
    let keys = Arc::new(Mutex::new(Vec::new()));
    let weights = RuleWeights::new(&config, tiny_overrides());
    let source = Noted { weights, keys: Arc::clone(&keys) };
    let network = BurnNetwork::new(config.clone(), Box::new(source), Device::Cpu).unwrap();
    assert!(keys.lock().unwrap().is_empty());
    let read_by = |stage: &dyn Fn()| -> BTreeSet<String> {
        keys.lock().unwrap().clear();
        stage();
        let keys = keys.lock().unwrap();
        let modules: BTreeSet<String> =
            keys.iter().map(|key| key.split('.').take(2).collect::<Vec<_>>().join(".")).collect();
        let different: BTreeSet<&String> = keys.iter().collect();
        assert_eq!(different.len(), keys.len(), "a tensor was read twice");
        modules
    };
    let image = Grid::new(3, 256, 256, vec![0.0; 3 * 256 * 256]);
    let map = || drop(network.map(&image).unwrap());
    let modules: Vec<String> = read_by(&map).into_iter().collect();
    assert_eq!(modules, ["unet_model.decoder", "unet_model.dino_model"]);
    assert!(read_by(&map).is_empty());
    let style = || drop(network.style(&[0.0; 270]).unwrap());
    assert!(read_by(&style).iter().all(|module| module == "sky_mapping.mapping"));
    let features = Grid::new(8, 4, 4, vec![0.5; 128]);
    let sharp = || drop(network.super_resolve(&features).unwrap());
    assert!(read_by(&sharp).iter().all(|module| module.starts_with("sr_module.")));
}
