//! Checkpoints: folders with `config.json` and `diffusion_pytorch_model.safetensors`.
//!
//! The file is memory-mapped and each tensor is converted on its own, when the module that holds it
//! is first needed; its pages are given back at once. So a DSM never reads the sky network, and no
//! more than one tensor is in memory twice.

use crate::config::Config;
use crate::error::{Mismatch, ModelError};
use crate::field::{Linear, PointHead};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod built_in;
mod expected;
mod inspect;
mod mapped;
mod packed;
mod rounded;
pub mod rule;

pub use built_in::{BuiltIn, MINI};
pub use expected::{Need, TensorSpec, expected};
pub use inspect::{Inspection, ModuleSummary, Problems, examine, inspect, inspect_with};
pub use mapped::MappedFile;
pub use packed::PackedWeights;
pub use rounded::{LEAST_NORMAL, Precision, Rounding, RoundingError, write_rounded};

/// Name of the weights' file in a checkpoint folder.
pub const WEIGHTS_FILE: &str = "diffusion_pytorch_model.safetensors";
/// Where a training checkpoint keeps the network; the averaged weights first.
const INSIDE: [&str; 2] = ["vqmodel_ema", "vqmodel"];

/// Something that holds the tensors of a network by their checkpoint keys.
pub trait TensorSource: Send + Sync {
    /// The values of one tensor, row-major, as f32.
    ///
    /// # Errors
    /// [`ModelError::Tensors`] where the key is missing or its shape is not `shape`.
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError>;

    /// The same where they lie, if they lie in memory as f32.
    fn mapped(&self, _key: &str, _shape: &[usize]) -> Option<&[f32]> {
        None
    }

    /// A hint that [`TensorSource::mapped`] will not be read for a while.
    fn release(&self, _key: &str) {}

    /// Where what an engine makes of the tensors may be kept for the next run.
    fn packed(&self) -> Option<&PackedWeights> {
        None
    }
}

impl<T: TensorSource + ?Sized> TensorSource for Arc<T> {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        (**self).read(key, shape)
    }

    fn mapped(&self, key: &str, shape: &[usize]) -> Option<&[f32]> {
        (**self).mapped(key, shape)
    }

    fn release(&self, key: &str) {
        (**self).release(key);
    }

    fn packed(&self) -> Option<&PackedWeights> {
        (**self).packed()
    }
}

/// Finds the checkpoint in a folder: the folder itself, or `vqmodel_ema` or `vqmodel` inside it.
///
/// # Errors
/// [`ModelError::NoCheckpoint`] where none of them holds a `config.json` and a
/// [`WEIGHTS_FILE`].
pub fn locate(folder: &Path) -> Result<PathBuf, ModelError> {
    let no = |why: String| Err(ModelError::NoCheckpoint { folder: folder.into(), why });
    if !folder.is_dir() {
        return no("not a folder".into());
    }
    let candidates =
        std::iter::once(folder.to_path_buf()).chain(INSIDE.map(|inside| folder.join(inside)));
    let mut half = None;
    for candidate in candidates {
        let config = candidate.join("config.json").is_file();
        let weights = candidate.join(WEIGHTS_FILE).is_file();
        match (config, weights) {
            (true, true) => return Ok(candidate),
            (true, false) => half = half.or(Some((candidate, WEIGHTS_FILE))),
            (false, true) => half = half.or(Some((candidate, "config.json"))),
            (false, false) => {}
        }
    }
    match half {
        Some((place, missing)) => no(format!("{} has no {missing}", place.display())),
        None => no(format!("no config.json in it, nor in {} inside it", INSIDE.join(" or "))),
    }
}

/// An opened checkpoint: its config, and its tensors still on disk. Every tensor that the config
/// asks for is there and has the right shape.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    folder: PathBuf,
    config_text: String,
    config: Config,
    file: MappedFile,
    packed: Option<Arc<PackedWeights>>,
}

impl Checkpoint {
    /// Opens a checkpoint folder, or the one inside a training checkpoint (see [`locate`]), and
    /// holds its list of tensors against the config. Reads only the file's header.
    ///
    /// # Errors
    /// Those of [`locate`], [`Config::from_folder`] and [`MappedFile::open`];
    /// [`ModelError::Tensors`] with all tensors that are missing, extra or of another shape.
    pub fn open(folder: &Path) -> Result<Self, ModelError> {
        let folder = locate(folder)?;
        let config = Config::from_folder(&folder)?;
        let file = MappedFile::open(&folder.join(WEIGHTS_FILE))?;
        let path = folder.join("config.json");
        let config_text = std::fs::read_to_string(&path).map_err(ModelError::io(&path))?;
        Self::of(folder, config_text, config, file)
    }

    /// Opens the model of a place: a checkpoint folder, or `built-in:<name>`.
    ///
    /// # Errors
    /// As [`Checkpoint::open`].
    pub fn at(place: &Path) -> Result<Self, ModelError> {
        match BuiltIn::at(place) {
            Some(model) => Self::built_in(model),
            None => Self::open(place),
        }
    }

    /// Opens a model that is part of the program.
    ///
    /// # Errors
    /// As [`Checkpoint::open`], should the program have been built with other files than it was tested
    /// with.
    pub fn built_in(model: &BuiltIn) -> Result<Self, ModelError> {
        let config = Config::from_json(model.config)?;
        let place = model.place();
        let file = MappedFile::built_in(&place, model.weights)?;
        Self::of(place.into(), model.config.to_owned(), config, file)
    }

    fn of(
        folder: PathBuf,
        config_text: String,
        config: Config,
        file: MappedFile,
    ) -> Result<Self, ModelError> {
        let mismatch = compare(&expected(&config), &file);
        if !mismatch.is_empty() {
            let path = file.path().into();
            return Err(ModelError::Tensors { path, mismatch: Box::new(mismatch) });
        }
        Ok(Self { folder, config_text, config, file, packed: None })
    }

    /// The same checkpoint, of which networks keep their packed weights below a folder. A model that is part of the
    /// program is too small to gain from it and keeps none.
    ///
    /// # Errors
    /// Those of [`PackedWeights::of`].
    pub fn keep_packed(mut self, cache: &Path) -> Result<Self, ModelError> {
        if self.file.path().is_file() {
            self.packed = Some(Arc::new(PackedWeights::of(&self.file, cache)?));
        }
        Ok(self)
    }

    /// Where packed weights are kept.
    #[must_use]
    pub fn packed(&self) -> Option<&PackedWeights> {
        self.packed.as_deref()
    }

    /// The text of `config.json`.
    #[must_use]
    pub fn config_text(&self) -> &str {
        &self.config_text
    }

    /// The folder that holds `config.json`; `built-in:<name>` for a model that is part of the program.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The network that the tensors make.
    #[must_use]
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The mapped weights.
    #[must_use]
    pub fn file(&self) -> &MappedFile {
        &self.file
    }
}

impl TensorSource for Checkpoint {
    fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
        self.file.read(key, shape)
    }

    fn mapped(&self, key: &str, shape: &[usize]) -> Option<&[f32]> {
        self.file.mapped(key, shape)
    }

    fn release(&self, key: &str) {
        if let Some(bytes) = self.file.raw(key) {
            self.file.release(bytes);
        }
    }

    fn packed(&self) -> Option<&PackedWeights> {
        Self::packed(self)
    }
}

fn compare(specs: &[TensorSpec], file: &MappedFile) -> Mismatch {
    let mut mismatch = Mismatch::default();
    let known: HashMap<&str, &TensorSpec> =
        specs.iter().map(|spec| (spec.key.as_str(), spec)).collect();
    for spec in specs.iter().filter(|spec| spec.need == Need::Required) {
        match file.shape(&spec.key) {
            None => mismatch.missing.push(spec.key.clone()),
            Some(shape) if shape != spec.shape => {
                mismatch.misshaped.push((spec.key.clone(), spec.shape.clone(), shape.to_vec()));
            }
            Some(_) => {
                if let Some(found) = file.unreadable_type(&spec.key) {
                    mismatch.mistyped.push((spec.key.clone(), found));
                }
            }
        }
    }
    mismatch.extra = file.keys().filter(|key| !known.contains_key(key)).map(Into::into).collect();
    mismatch.extra.sort_unstable();
    mismatch
}

/// Reads the point head (`mlp`).
///
/// # Errors
/// Those of [`TensorSource::read`].
pub fn point_head(config: &Config, source: &dyn TensorSource) -> Result<PointHead, ModelError> {
    let linear = |name: &str, inputs: usize, outputs: usize| {
        Ok::<_, ModelError>(Linear {
            inputs,
            outputs,
            weight: source.read(&format!("mlp.{name}.weight"), &[outputs, inputs])?,
            bias: source.read(&format!("mlp.{name}.bias"), &[outputs])?,
        })
    };
    let hidden = config.head_hidden;
    Ok(PointHead {
        net0: linear("net0", config.point_features(), hidden)?,
        density: linear("net1_density", hidden, 1)?,
        feature: linear("net1_feature", hidden, hidden / 2)?,
        style: linear("style_squ", config.style, hidden / 2)?,
        color: linear("grd_color_convert", hidden, config.color_channels)?,
    })
}

#[cfg(test)]
mod tests;
