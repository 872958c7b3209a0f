//! A learner that learns next to nothing, but as learners do: weights, a moment, a moving average; and folders to
//! hold what it leaves.
#![allow(dead_code, reason = "each test file uses its own part")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::batch::Interrupt;
use sat3d::model::train::{Example, Exported, Learner, NamedTensor, Outcome, Term, TrainError};
use sat3d::model::weights::expected;
use sat3d::model::weights::rule::{RuleWeights, tiny_overrides};
use sat3d::model::{Config, Device};
use sat3d::random::{key, unit};
use sat3d::train::run::MakeLearner;
use sat3d::train::{Options, Settings, Summary, TrainingError, prepare, run};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What a toy does beside learning.
#[derive(Clone)]
pub struct Habits {
    /// Time that a step takes.
    pub pause: Duration,
    /// Steps whose batch is not finite.
    pub not_finite: fn(u64) -> bool,
    /// Asks for a stop in this step.
    pub stops: Option<(u64, Interrupt)>,
    /// Values of a large tensor in the state.
    pub ballast: usize,
}

pub fn habits() -> Habits {
    Habits { pause: Duration::ZERO, not_finite: |_| false, stops: None, ballast: 0 }
}

/// Follows the mean colour and height of its examples.
pub struct Toy {
    habits: Habits,
    seed: u64,
    weights: Vec<f32>,
    moments: Vec<f32>,
    average: Vec<f32>,
    ballast: Vec<f32>,
}

const SIZE: usize = 4;

fn config_text() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("crates/sat3d-model/fixtures/tiny/model/config.json");
    std::fs::read_to_string(path).unwrap()
}

impl Toy {
    pub fn new(seed: u64, habits: &Habits) -> Self {
        let weights = (0..SIZE as u64).map(|i| unit(key(&[seed, i])) as f32).collect();
        let ballast = vec![1.0; habits.ballast];
        let (moments, average) = (vec![0.0; SIZE], vec![0.0; SIZE]);
        Self { habits: habits.clone(), seed, weights, moments, average, ballast }
    }

    /// The tiny network by rule, one of its tensors moved by the weights.
    fn network(config: &Config, weights: &[f32]) -> Vec<NamedTensor> {
        let rule = RuleWeights::new(config, tiny_overrides());
        let own = |key: &str| !key.contains("_axes") || key.contains("oneplane_axes");
        expected(config)
            .into_iter()
            .filter(|spec| own(&spec.key))
            .map(|spec| {
                let mut values = rule.values(&spec.key, &spec.shape);
                if spec.key == "mlp.net0.bias" {
                    values.iter_mut().zip(weights).for_each(|(value, weight)| *value += weight);
                }
                NamedTensor { name: spec.key, shape: spec.shape, values }
            })
            .collect()
    }
}

impl Learner for Toy {
    fn step(&mut self, step: u64, batch: &[Example]) -> Result<Outcome, TrainError> {
        std::thread::sleep(self.habits.pause);
        if let Some((at, interrupt)) = &self.habits.stops
            && *at == step
        {
            interrupt.request();
        }
        if (self.habits.not_finite)(step) {
            return Ok(Outcome::Skipped("the height is NaN".into()));
        }
        let mut target = [0.0_f32; SIZE];
        for example in batch {
            for (channel, target) in target.iter_mut().take(3).enumerate() {
                let sum: f64 = example
                    .satellite
                    .data
                    .iter()
                    .skip(channel)
                    .step_by(3)
                    .map(|v| f64::from(*v))
                    .sum();
                *target += (sum / example.satellite.data.len() as f64 / 85.0) as f32;
            }
            if let Some(truth) = &example.truth {
                let heights = truth.surface.data.iter().map(|height| f64::from(*height));
                target[3] += (heights.sum::<f64>() / truth.surface.data.len() as f64) as f32;
            }
        }
        let mut loss = 0.0;
        for (i, target) in target.into_iter().enumerate() {
            let noise = unit(key(&[self.seed, step, i as u64])) as f32 - 0.5;
            let error = self.weights[i] - target / batch.len() as f32 + 0.01 * noise;
            loss += error * error;
            self.moments[i] = 0.9 * self.moments[i] + 0.1 * error;
            self.weights[i] -= 0.05 * self.moments[i];
            self.average[i] += 0.1 * (self.weights[i] - self.average[i]);
        }
        let mut terms = vec![Term { name: "total", value: loss }];
        // As a discriminator does: in every other step.
        terms.push(if step.is_multiple_of(2) {
            Term { name: "even", value: loss / 2.0 }
        } else {
            Term { name: "odd", value: loss / 3.0 }
        });
        Ok(Outcome::Stepped(terms))
    }

    fn state(&self) -> Result<Vec<NamedTensor>, TrainError> {
        let tensor = |name: &str, values: &[f32]| NamedTensor {
            name: name.into(),
            shape: vec![values.len()],
            values: values.to_vec(),
        };
        Ok(vec![
            tensor("weights", &self.weights),
            tensor("moments", &self.moments),
            tensor("average", &self.average),
            tensor("ballast", &self.ballast),
        ])
    }

    fn restore(&mut self, state: &[NamedTensor]) -> Result<(), TrainError> {
        for (name, to) in [
            ("weights", &mut self.weights),
            ("moments", &mut self.moments),
            ("average", &mut self.average),
            ("ballast", &mut self.ballast),
        ] {
            let found = state.iter().find(|tensor| tensor.name == name);
            let found = found.ok_or_else(|| TrainError::State(format!("{name} is missing")))?;
            to.clone_from(&found.values);
        }
        Ok(())
    }

    fn export(&self) -> Result<Exported, TrainError> {
        let config = config_text();
        let parsed = Config::from_json(&config)?;
        let model = Self::network(&parsed, &self.weights);
        let average = Self::network(&parsed, &self.average);
        Ok(Exported { config, model, average })
    }
}

/// Settings of a short training on small simulated scenes.
pub const SHORT: &str = r#"
[data]
threads = 2
held_out = 2
simulated = { scenes = 3, scene_side = 48, side = 32, pixel_m = 0.5 }
[run]
steps = 24
batch = 3
seed = 11
checkpoint_every = 6
log_every = 4
preview_every = 12
keep = 2
threads = 2
"#;

/// Trains a toy into a folder.
pub fn train(
    text: &str,
    changes: &[&str],
    out: &Path,
    interrupt: &Interrupt,
    habits: &Habits,
) -> Result<Summary, TrainingError> {
    let changes: Vec<String> = changes.iter().map(|change| (*change).to_owned()).collect();
    let settings = Settings::parse(Path::new("train.toml"), text, &changes)?;
    let habits = habits.clone();
    let make: Box<MakeLearner> = Box::new(move |_: &Settings, _: &Device, seed: u64| {
        Ok(Box::new(Toy::new(seed, &habits)) as Box<dyn Learner>)
    });
    let options = Options { out: out.to_owned(), quiet: true };
    run(&prepare(settings)?, &options, interrupt, &make)
}

/// Everything that a training leaves and that must not depend on how it was interrupted, by path.
pub fn left(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    fn walk(root: &Path, folder: &Path, into: &mut BTreeMap<PathBuf, Vec<u8>>) {
        for item in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
            let path = item.path();
            if path.is_dir() {
                if item.file_name() != ".sat3d" {
                    walk(root, &path, into);
                }
            } else if item.file_name() != "run.json" {
                into.insert(
                    path.strip_prefix(root).unwrap().to_owned(),
                    std::fs::read(&path).unwrap(),
                );
            }
        }
    }
    let mut files = BTreeMap::new();
    walk(out, out, &mut files);
    files
}

/// Two trainings left the same.
#[track_caller]
pub fn assert_same(a: &Path, b: &Path) {
    let (a, b) = (left(a), left(b));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for ((path, x), (_, y)) in a.iter().zip(&b) {
        assert!(x == y, "{} differs", path.display());
    }
}
