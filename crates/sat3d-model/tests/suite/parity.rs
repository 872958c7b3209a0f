//! Parity with the reference: [`sat3d_model::parity`] on the sets that are built in, and what lies around it.
//!
//! With `SAT3D_GOLDENS` (or a folder `shared/goldens` beside the checkout) every value of the published
//! set is compared too, and with `SAT3D_FULL_PARITY=1` the full network is run (its weights are made
//! by rule):
//!
//! ```text
//! SAT3D_GOLDENS=<folder> SAT3D_FULL_PARITY=1 cargo test -p sat3d-model --test suite parity:: -- --nocapture
//! ```
#![cfg(feature = "parity")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::support;

use sat3d_model::field::{DensityActivation, Representation};
use sat3d_model::network::{BurnNetwork, Engine, Execution, Precision};
use sat3d_model::parity::{Comparison, ParityError, Set, verify};
use sat3d_model::weights::rule::{RuleWeights, tiny_overrides, write_checkpoint};
use sat3d_model::weights::{Checkpoint, TensorSource, expected};
use sat3d_model::{Config, Device, Model, Network, preprocess};
use std::path::Path;
use support::{fixture, goldens, png, satellite};

const SATELLITE: &str = "inputs/satellite_47.6_-122.33.png";

/// Comparisons of each stage. A stage that is lost somewhere must not pass for one that is right.
fn counts(set: Set) -> &'static [(&'static str, usize)] {
    match set {
        Set::Tiny => &[
            ("preprocessing", 2),
            ("illumination", 2),
            ("encoder", 15),
            ("tokens", 1),
            ("decoder", 29),
            ("planes", 3),
            ("sky", 18),
            ("rotations", 8),
            ("directions", 6),
            ("points", 5),
            ("rays", 18),
            ("satellite view", 8),
            ("panorama", 7),
            ("super-resolution", 12),
            ("perspective", 5),
            ("grid", 3),
        ],
        Set::TinyTriplane => &[
            ("preprocessing", 2),
            ("illumination", 2),
            ("decoder", 29),
            ("planes", 1),
            ("rotations", 6),
            ("directions", 3),
            ("points", 5),
            ("rays", 12),
            ("satellite view", 8),
            ("panorama", 7),
            ("super-resolution", 10),
        ],
        Set::Full => &[
            ("preprocessing", 2),
            ("illumination", 2),
            ("encoder", 36),
            ("tokens", 1),
            ("decoder", 29),
            ("planes", 3),
            ("sky", 38),
            ("rotations", 8),
            ("directions", 6),
            ("points", 5),
            ("rays", 18),
            ("satellite view", 8),
            ("panorama", 7),
            ("super-resolution", 12),
            ("perspective", 5),
            ("grid", 3),
        ],
    }
}

#[track_caller]
fn check(set: Set, folder: Option<&Path>) {
    let mut seen = 0;
    let all = verify(set, &Device::Cpu.into(), folder, &mut |comparison| {
        println!("{comparison}");
        seen += 1;
    })
    .unwrap();
    assert_eq!(seen, all.len());
    let failed: Vec<&Comparison> = all.iter().filter(|comparison| !comparison.passes()).collect();
    assert!(failed.is_empty(), "{failed:#?}");
    let of = |stage: &str| all.iter().filter(|comparison| comparison.stage == stage).count();
    for (stage, count) in counts(set) {
        assert_eq!(of(stage), *count, "comparisons of {stage}");
    }
    assert_eq!(all.len(), counts(set).iter().map(|(_, count)| count).sum::<usize>());
}

#[test]
fn tiny() {
    check(Set::Tiny, None);
}

#[test]
fn tiny_triplane() {
    check(Set::TinyTriplane, None);
}

#[test]
fn every_value_of_the_published_set() {
    let Some(folder) = goldens("every_value_of_the_published_set") else { return };
    check(Set::Tiny, Some(&folder));
    check(Set::TinyTriplane, Some(&folder));
}

#[test]
fn full_network() {
    if std::env::var_os("SAT3D_FULL_PARITY").is_none_or(|value| value != "1") {
        eprintln!(
            "SKIPPED full_network: set SAT3D_FULL_PARITY=1 (minutes; the weights alone are 1.5 GB)"
        );
        return;
    }
    let Some(folder) = goldens("full_network") else { return };
    check(Set::Full, Some(&folder));
}

#[test]
fn every_engine_and_precision() {
    for engine in Engine::ALL {
        for precision in Precision::ALL {
            let execution = Execution { device: Device::Cpu, engine, precision };
            if let Some(why) = execution.refusal() {
                println!("SKIPPED: {execution}: {why}");
                continue;
            }
            for set in [Set::Tiny, Set::TinyTriplane] {
                let all = verify(set, &execution, None, &mut |comparison| {
                    println!("{execution}: {comparison}");
                })
                .unwrap();
                let failed: Vec<&Comparison> =
                    all.iter().filter(|comparison| !comparison.passes()).collect();
                assert!(failed.is_empty(), "{execution}: {failed:#?}");
                let of = |stage| all.iter().filter(|made| made.stage == stage).count();
                assert!(of("planes") > 0 && (of("tokens") > 0 || set == Set::TinyTriplane));
            }
        }
    }
}

#[test]
fn what_is_not_there_is_said() {
    let of = |set, folder: Option<&Path>| verify(set, &Device::Cpu.into(), folder, &mut |_| ());
    let error = of(Set::Full, None).unwrap_err();
    assert!(matches!(error, ParityError::NotBuiltIn(Set::Full)), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let error = of(Set::Full, Some(folder.path())).unwrap_err().to_string();
    assert!(error.contains("common.safetensors"), "{error}");
    std::fs::write(folder.path().join("common.safetensors"), b"no tensors at all").unwrap();
    let error = of(Set::Tiny, Some(folder.path())).unwrap_err().to_string();
    assert!(error.contains("common.safetensors") && error.contains("header"), "{error}");
    // A set that lacks one of its files.
    std::fs::copy(fixture("parity/common.safetensors"), folder.path().join("common.safetensors"))
        .unwrap();
    let error = of(Set::Tiny, Some(folder.path())).unwrap_err().to_string();
    assert!(error.contains("01_encoder.safetensors"), "{error}");
}

#[test]
fn the_resized_image_is_pillows_bit_for_bit() {
    let image = png(&fixture(SATELLITE));
    let resized = preprocess::resize_bicubic(&image, 256, 256);
    assert_eq!(resized, png(&fixture("sat_resized_256.png")));
    // Resizing to the same size changes nothing.
    assert_eq!(preprocess::resize_bicubic(&resized, 256, 256), resized);
    let Some(folder) = goldens("the panorama, resized") else { return };
    let panorama = png(&folder.join("inputs/panorama.png"));
    let resized = preprocess::resize_bicubic(&panorama, 512, 128);
    assert_eq!(resized, png(&fixture("parity/pano_resized.png")));
}

/// The files that the reference saved, tensor by tensor, against the rule that should have made
/// them; and the model that comes from them.
#[test]
fn the_references_files_hold_the_rules_weights() {
    let Some(folder) = goldens("the_references_files_hold_the_rules_weights") else { return };
    for name in ["tiny", "tiny_triplane"] {
        let path = folder.join(name).join("model");
        let checkpoint = Checkpoint::open(&path).unwrap();
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
        let model = Model::load(&path, &Device::Cpu.into()).unwrap();
        assert_eq!(model.head.net0.inputs, config.point_features());
        assert_eq!(model.head.density.bias, [-4.5]);
    }
}

fn tiny_network() -> BurnNetwork {
    let text = std::fs::read_to_string(fixture("tiny/model/config.json")).unwrap();
    let config = Config::from_json(&text).unwrap();
    let weights = Box::new(RuleWeights::new(&config, tiny_overrides()));
    BurnNetwork::new(config, weights, Device::Cpu).unwrap()
}

#[test]
fn a_loaded_model_gives_the_field_its_inputs() {
    let text = std::fs::read_to_string(fixture("tiny/model/config.json")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    write_checkpoint(folder.path(), &text, tiny_overrides()).unwrap();
    let model = Model::load(folder.path(), &Device::Cpu.into()).unwrap();
    let inputs = model.field_inputs(&png(&fixture(SATELLITE))).unwrap();
    assert_eq!(inputs.representation, Representation::Oneplane);
    assert_eq!(inputs.activation, DensityActivation::Mipnerf);
    assert_eq!(inputs.scale.to_bits(), 0.8_f32.to_bits());
    // As from the file, so by the rule, whose map is held against the reference above.
    assert!(inputs.map == tiny_network().map(&satellite()).unwrap());
}

/// The same bytes for any number of threads: stored results hang on it.
#[test]
fn threads_do_not_change_the_result() {
    let image = satellite();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let network = tiny_network();
            let map = network.map(&image).unwrap();
            let style = network.style(&[1.0 / 270.0; 270]).unwrap();
            (map, network.sky(&style).unwrap())
        })
    };
    let one = run(1);
    for threads in [2, 5] {
        assert!(run(threads) == one, "{threads} threads");
    }
}
