//! A loaded model: config, point head, and the network behind its interface.

use crate::config::Config;
use crate::error::ModelError;
use crate::field::{FieldInputs, PointHead};
use crate::network::{Execution, Network, SmallNetwork};
use crate::preprocess::{self, Image8};
use crate::scene::{Scene, SceneParts, SkyParts};
use crate::weights::{Checkpoint, TensorSource, point_head};
use std::path::Path;

/// A model ready to run. Only the point head is read at once; the network's modules are read when an
/// output first needs them.
///
/// ```
/// use sat3d_model::render::RenderOptions;
/// use sat3d_model::weights::rule::{tiny_overrides, write_checkpoint};
/// use sat3d_model::{Device, Image8, Model};
///
/// // Made-up weights of a small network; a released checkpoint is a folder like this one.
/// let folder = std::env::temp_dir().join(format!("sat3d-model-{}", std::process::id()));
/// let config = include_str!("../fixtures/tiny/model/config.json");
/// write_checkpoint(&folder, config, tiny_overrides())?;
///
/// let model = Model::load(&folder, &Device::Cpu.into())?;
/// // A satellite image, RGB, north up, of any size; here a grey one.
/// let image = Image8::new(64, 64, 3, vec![128; 64 * 64 * 3])?;
/// // 64.48 m of ground under the crop: 32.24 m of height per cube unit by the published scoring.
/// let scene = model.scene(&image, None, 32.24)?;
/// let dsm = scene.dsm(32, &RenderOptions::default());
/// assert!(dsm.height.iter().all(|height| (-0.1..=1.0).contains(height)));
/// # std::fs::remove_dir_all(&folder).ok();
/// # Ok::<(), sat3d_model::ModelError>(())
/// ```
pub struct Model {
    /// The network's description.
    pub config: Config,
    /// Weights of the point head.
    pub head: PointHead,
    /// The network's stages.
    pub network: Box<dyn Network>,
    /// How they are calculated.
    pub execution: Execution,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Model").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Model {
    /// Opens a checkpoint folder (or the one inside a training checkpoint's folder).
    ///
    /// # Errors
    /// Those of [`Checkpoint::open`]; [`ModelError::Device`] for a device that this program was
    /// built without.
    pub fn load(folder: &Path, execution: &Execution) -> Result<Self, ModelError> {
        Self::of_checkpoint(&Checkpoint::open(folder)?, execution)
    }

    /// The model of an opened checkpoint, whose mapping it shares.
    ///
    /// # Errors
    /// As [`Model::from_source`].
    pub fn of_checkpoint(
        checkpoint: &Checkpoint,
        execution: &Execution,
    ) -> Result<Self, ModelError> {
        Self::from_source(checkpoint.config().clone(), Box::new(checkpoint.clone()), execution)
    }

    /// A model whose tensors come from anywhere, as from [`crate::weights::rule`].
    ///
    /// # Errors
    /// [`ModelError::Tensors`] where the source lacks the point head; [`ModelError::Device`].
    pub fn from_source(
        config: Config,
        source: Box<dyn TensorSource>,
        execution: &Execution,
    ) -> Result<Self, ModelError> {
        let head = point_head(&config, source.as_ref())?;
        let network: Box<dyn Network> = match &config.unet {
            Some(unet) => {
                // Too small to gain from another engine.
                Box::new(SmallNetwork::new(config.clone(), unet.clone(), source, execution.device)?)
            }
            None => execution.network(config.clone(), source)?,
        };
        Ok(Self { config, head, network, execution: *execution })
    }

    /// A satellite image of any size (RGB, north up) to all that its field needs: resized,
    /// normalised, encoded, decoded.
    ///
    /// # Errors
    /// [`ModelError::Shape`] where the image is not RGB; those of [`Network::map`].
    pub fn field_inputs(&self, image: &Image8) -> Result<FieldInputs, ModelError> {
        let input = preprocess::satellite(image, self.config.image_side())?;
        Ok(FieldInputs {
            map: self.network.map(&input)?,
            representation: self.config.representation,
            activation: self.config.activation,
            scale: self.config.scale as f32,
        })
    }

    /// The scene of a satellite image of any size (RGB, north up), to be rendered as often as wanted.
    /// `sky` is needed for street views alone; `metres_per_unit` is the height of one cube unit (32.24
    /// by the published scoring).
    ///
    /// # Errors
    /// Those of [`Model::field_inputs`]; [`ModelError::Scene`] where the weights make no field (values
    /// that are not finite).
    pub fn scene(
        &self,
        image: &Image8,
        sky: Option<SkyParts>,
        metres_per_unit: f64,
    ) -> Result<Scene, ModelError> {
        let inputs = self.field_inputs(image)?;
        Ok(Scene::new(SceneParts { inputs, head: self.head.clone(), sky, metres_per_unit })?)
    }
}
