//! Made-up weights by a rule, the same on every machine: the parity data was computed with them.
//!
//! Value `i` of the tensor with key `K` is drawn from a counter: splitmix64's finaliser of
//! `fnv1a64(K) + i * 0x9E3779B97F4A7C15`, its upper 24 bits mapped exactly to [-1, 1). The rule was
//! published with the parity data; it makes the full network (1.5 GB) a matter of a kilobyte.

use super::expected::own_buffer;
use super::{Need, TensorSource, TensorSpec, WEIGHTS_FILE, expected};
use crate::config::Config;
use crate::error::{Mismatch, ModelError};
use rayon::prelude::*;
use safetensors::tensor::{Dtype, View};
use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The rule with its exceptions, bound to the tensors of one config.
#[derive(Clone, Debug)]
pub struct RuleWeights {
    overrides: Vec<Override>,
    shapes: HashMap<String, Vec<usize>>,
    outliers: Option<u64>,
}

/// A tensor whose values are `offset + scale * u` instead.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// Key of the tensor.
    pub key: String,
    /// Added to every value.
    pub offset: f32,
    /// Multiplies the draw from [-1, 1).
    pub scale: f32,
}

/// The exceptions of the `tiny` parity sets: they spread opacity over [0, 1] and keep colours
/// unclipped.
#[must_use]
pub fn tiny_overrides() -> Vec<Override> {
    overrides(10.0, -4.5, 0.03)
}

/// The exceptions of the `full` parity set.
#[must_use]
pub fn full_overrides() -> Vec<Override> {
    overrides(4.0, -7.5, 0.01)
}

fn overrides(density: f32, bias: f32, rgb: f32) -> Vec<Override> {
    [
        ("mlp.net1_density.weight", 0.0, density),
        ("mlp.net1_density.bias", bias, 0.0),
        ("sr_module.block1.toRGB.weight", 0.0, rgb),
        ("sky_mapping.mapping.0.weight", 0.0, 2.0),
    ]
    .map(|(key, offset, scale)| Override { key: key.into(), offset, scale })
    .to_vec()
}

impl RuleWeights {
    /// Weights for every tensor of a config.
    #[must_use]
    pub fn new(config: &Config, overrides: Vec<Override>) -> Self {
        let shapes = whole(config).into_iter().map(|spec| (spec.key, spec.shape)).collect();
        Self { overrides, shapes, outliers: None }
    }

    /// The same, one output channel of a hundred of every layer of the encoder and the decoder 20 times as large:
    /// trained networks have such channels, and rounding is hard on what lies beside them.
    #[must_use]
    pub fn with_outliers(self, seed: u64) -> Self {
        Self { outliers: Some(seed), ..self }
    }

    fn enlarge(&self, key: &str, shape: &[usize], values: &mut [f32]) {
        let Some(seed) = self.outliers else { return };
        if shape.len() < 2 || !key.starts_with("unet_model.") || values.is_empty() {
            return;
        }
        let start = fnv1a64(key) ^ seed;
        let channel = values.len() / shape[0];
        for (index, values) in values.chunks_exact_mut(channel).enumerate() {
            // Draws from [-1, 1).
            if draw(start, index as u64) >= 0.98 {
                values.iter_mut().for_each(|value| *value *= 20.0);
            }
        }
    }

    /// One tensor's values.
    #[must_use]
    pub fn values(&self, key: &str, shape: &[usize]) -> Vec<f32> {
        match key {
            "point_representer.oneplane_axes" => return vec![1., 0., 0., 0., 1., 0., 0., 0., 1.],
            "point_representer.triplane_axes" => return TRIPLANE_AXES.to_vec(),
            _ => {}
        }
        let (offset, scale) = self.offset_and_scale(key, shape);
        let start = fnv1a64(key);
        let count: usize = shape.iter().product();
        let value = |index: usize| {
            // Rounded after the product and after the sum, as NumPy does.
            let product = scale * draw(start, index as u64);
            offset + product
        };
        (0..count).into_par_iter().with_min_len(1 << 14).map(value).collect()
    }

    fn offset_and_scale(&self, key: &str, shape: &[usize]) -> (f32, f32) {
        if let Some(found) = self.overrides.iter().find(|found| found.key == key) {
            return (found.offset, found.scale);
        }
        if shape.len() >= 2 {
            let inputs: usize = shape[1..].iter().product();
            return (0.0, (3.0 / inputs as f64).sqrt() as f32);
        }
        if key.ends_with(".lambda1") {
            (0.2, 0.1)
        } else if key.ends_with(".bias") {
            (0.0, 0.1)
        } else {
            (1.0, 0.1)
        }
    }
}

impl TensorSource for RuleWeights {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        let mut mismatch = Mismatch::default();
        match self.shapes.get(key) {
            Some(known) if known == shape => {
                let mut values = self.values(key, shape);
                self.enlarge(key, shape, &mut values);
                return Ok(values);
            }
            Some(known) => mismatch.misshaped.push((key.into(), shape.to_vec(), known.clone())),
            None => mismatch.missing.push(key.into()),
        }
        let path = PathBuf::from("(weights by rule)");
        Err(ModelError::Tensors { path, mismatch: Box::new(mismatch) })
    }
}

/// The tensors of a whole checkpoint: all but the buffer of the other representation.
fn whole(config: &Config) -> Vec<TensorSpec> {
    let own = own_buffer(config);
    let mut specs = expected(config);
    specs.retain(|spec| spec.need != Need::Buffer || spec.key == own);
    specs
}

/// Writes a checkpoint folder with rule-made weights: `config.json` (the text given, which must be
/// the one that `config` was read from) and the safetensors file. One tensor is in memory at a time.
///
/// # Errors
/// [`ModelError::Io`] where the folder or a file cannot be written.
pub fn write_checkpoint(
    folder: &Path,
    config_json: &str,
    overrides: Vec<Override>,
) -> Result<(), ModelError> {
    let config = Config::from_json(config_json)?;
    std::fs::create_dir_all(folder).map_err(ModelError::io(folder))?;
    let text = folder.join("config.json");
    std::fs::write(&text, config_json).map_err(ModelError::io(&text))?;
    let weights = RuleWeights::new(&config, overrides);
    let specs = whole(&config);
    let tensors = specs.iter().map(|spec| (&spec.key, Made { weights: &weights, spec }));
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    let path = folder.join(WEIGHTS_FILE);
    safetensors::serialize_to_file(tensors, Some(metadata), &path)
        .map_err(|error| ModelError::Io { path, source: std::io::Error::other(error.to_string()) })
}

/// A tensor made while it is written.
struct Made<'a> {
    weights: &'a RuleWeights,
    spec: &'a TensorSpec,
}

impl View for Made<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.spec.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        let values = self.weights.values(&self.spec.key, &self.spec.shape);
        Cow::Owned(values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    fn data_len(&self) -> usize {
        4 * self.spec.values()
    }
}

/// Planes over (x, y), (x, z) and (z, y), each as the rows that pick its axes.
const TRIPLANE_AXES: [f32; 27] = [
    1., 0., 0., 0., 1., 0., 0., 0., 1., //
    1., 0., 0., 0., 0., 1., 0., 1., 0., //
    0., 0., 1., 0., 1., 0., 1., 0., 0.,
];

fn fnv1a64(key: &str) -> u64 {
    key.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

/// Draw `index`, exact in f32, in [-1, 1).
fn draw(start: u64, index: u64) -> f32 {
    let mut bits = start.wrapping_add(index.wrapping_mul(0x9E37_79B9_7F4A_7C15));
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    bits ^= bits >> 31;
    (bits >> 40) as f32 * (1.0 / 8_388_608.0) - 1.0
}
