//! The network: image to feature map, histogram to sky, rendered features to a sharp image.
//!
//! [`Network`] is the plain interface, so that another engine can stand in; [`BurnNetwork`] serves
//! it with `burn` modules, on the CPU or a graphics card. Modules are read from the checkpoint when
//! an output first needs them.

use crate::config::Config;
use crate::error::ModelError;
use crate::tensor::Grid;

mod burned;
pub(crate) mod convolution;
pub(crate) mod decoder;
pub(crate) mod device;
pub(crate) mod encoder;
mod execution;
pub(crate) mod layers;
pub(crate) mod loader;
pub(crate) mod normalisation;
#[cfg(feature = "onednn")]
mod onednn;
mod precision;
pub(crate) mod probe;
pub(crate) mod sky;
mod small;
pub(crate) mod super_resolution;
pub(crate) mod unet;

pub use burned::{BurnNetwork, Observer};
pub use device::Device;
pub use execution::{Engine, Execution, Wanted};
#[cfg(feature = "onednn")]
pub use onednn::OneDnnNetwork;
pub use precision::{Precision, PrecisionBound};
pub use probe::Stage;
pub use small::SmallNetwork;
pub(crate) use unet::{STEM as UNET_STEM, TEXELS as UNET_TEXELS};

/// The stages of the network. Inputs and outputs are plain tensors in memory; each call is one
/// image.
pub trait Network: Send + Sync {
    /// Normalised image (`3 x 256 x 256`) to the decoder's map (`64 x 320 x 320`, or `96` for a
    /// triplane; other sizes as configured).
    ///
    /// # Errors
    /// [`ModelError::Shape`] for another image size; those of loading weights, and
    /// [`ModelError::Backend`].
    fn map(&self, image: &Grid) -> Result<Grid, ModelError>;

    /// Illumination histogram (270 values) to the style code (512 values).
    ///
    /// # Errors
    /// As [`Network::map`].
    fn style(&self, histogram: &[f32]) -> Result<Vec<f32>, ModelError>;

    /// Style code to the sky map (`24 x 512 x 921`: rows are azimuths, columns zenith angles from 0
    /// to 180 degrees, the last 409 of them empty).
    ///
    /// # Errors
    /// As [`Network::map`].
    fn sky(&self, style: &[f32]) -> Result<Grid, ModelError>;

    /// A rendered view's features (`24 x h x w`) to its image (`3 x 2h x 2w`, in [0, 1]). Every
    /// output pixel depends on the whole view.
    ///
    /// # Errors
    /// As [`Network::map`]; [`ModelError::Absent`] for a model without super-resolution.
    fn super_resolve(&self, features: &Grid) -> Result<Grid, ModelError>;
}

/// The large network's stages one by one, with a look at what passes between the layers.
pub trait StagedNetwork: Network {
    /// What the network is made of.
    fn config(&self) -> &Config;

    /// Normalised image (`3 x 256 x 256`) to the encoder's patch tokens (`1024 x 16 x 16`).
    ///
    /// # Errors
    /// As [`Network::map`].
    fn tokens(&self, image: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError>;

    /// Patch tokens (`1024 x 16 x 16`) to the decoder's map; the padding is added here.
    ///
    /// # Errors
    /// As [`Network::map`].
    fn decode(&self, tokens: &Grid, observer: Observer<'_>) -> Result<Grid, ModelError>;

    /// As [`Network::sky`], with a look at the stages.
    ///
    /// # Errors
    /// As [`Network::sky`].
    fn sky_observed(&self, style: &[f32], observer: Observer<'_>) -> Result<Grid, ModelError>;

    /// As [`Network::super_resolve`], with a look at the stages.
    ///
    /// # Errors
    /// As [`Network::super_resolve`].
    fn super_resolve_observed(
        &self,
        features: &Grid,
        observer: Observer<'_>,
    ) -> Result<Grid, ModelError>;
}

#[cfg(test)]
mod tests;
