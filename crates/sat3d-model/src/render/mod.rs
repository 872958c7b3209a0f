//! Rays through the field: satellite view and DSM, panorama, perspective; the density grid.
//!
//! What the network was trained with and what can be done better are kept apart ([`RenderOptions`]): the
//! default gives the released renderer's numbers, with its random jitter at the middle.
//! Only what an output needs is computed: no colour for a DSM, no colour for a sample that no light
//! reaches.

mod camera;
pub mod frames;
#[cfg(test)]
mod hard_cases;
mod lattice;
mod march;
pub mod quadrature;
mod sky;
mod view;

pub use camera::{Camera, Intrinsics, Pose, Ray};
pub use frames::Angles;
pub use lattice::{Border, DensityGrid, Lattice, ReferenceGrid, density_grid, reference_grid};
pub use sky::{SkyMap, SkySeam, padded_width};
pub use view::exact_scale;
pub use view::{Dsm, View, Wanted, dsm, render};
#[doc(hidden)]
pub use view::{Trace, trace};

use serde::{Deserialize, Serialize};

/// Opacity under which a ray counts as not having hit anything.
pub const LEAST_OPACITY: f64 = 0.05;

/// Error of the released quadrature in a DSM, cube units: rms of normalised depth against the exact integral of
/// the same field, the worst of four closed-form cities at 48 + 48 samples. Measured, not proven
/// (`tests/suite/render_city.rs` holds it).
pub const RELEASED_RMS: f64 = 5.8e-4;
/// The same of [`Sampling::Stable`].
pub const STABLE_RMS: f64 = 6.6e-5;

/// How a ray is sampled and integrated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// As released, with the random jitter at its middle: samples at (k + 3/2) L / n, importance samples at
    /// u = (j + 1/2) / n, raw densities averaged over intervals.
    #[default]
    Reference,
    /// Cell-centre samples, piecewise constant density, exact transmittance and expected distance.
    Stable,
}

/// How the scene is laid over the sky.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Composite {
    /// As trained: the scene's colour, which holds the opacity already, is multiplied by it again.
    #[default]
    Squared,
    /// Scene + sky * (1 - opacity).
    Once,
}

/// What depth means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthKind {
    /// As trained: the sum of weight times distance; an empty ray has depth 0.
    #[default]
    Raw,
    /// That sum divided by the opacity; NaN where the opacity is under [`LEAST_OPACITY`].
    Normalised,
}

/// Samples along a ray, coarse and fine: each 8 to 512, 48 as released.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "RawCounts", into = "RawCounts")]
pub struct SampleCounts {
    coarse: usize,
    fine: usize,
}

#[derive(Serialize, Deserialize)]
struct RawCounts {
    coarse: usize,
    fine: usize,
}

/// A number of samples outside 8 to 512.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} samples along a ray; 8 to 512 can be taken")]
pub struct SampleCountError(pub usize);

impl SampleCounts {
    /// # Errors
    /// When one of the numbers is not in 8 to 512.
    pub fn new(coarse: usize, fine: usize) -> Result<Self, SampleCountError> {
        match [coarse, fine].into_iter().find(|count| !(8..=512).contains(count)) {
            Some(count) => Err(SampleCountError(count)),
            None => Ok(Self { coarse, fine }),
        }
    }

    /// Samples of the first pass.
    #[must_use]
    pub fn coarse(self) -> usize {
        self.coarse
    }

    /// Samples that are added where the light ends.
    #[must_use]
    pub fn fine(self) -> usize {
        self.fine
    }
}

impl Default for SampleCounts {
    fn default() -> Self {
        Self { coarse: 48, fine: 48 }
    }
}

impl TryFrom<RawCounts> for SampleCounts {
    type Error = SampleCountError;

    fn try_from(raw: RawCounts) -> Result<Self, SampleCountError> {
        Self::new(raw.coarse, raw.fine)
    }
}

impl From<SampleCounts> for RawCounts {
    fn from(counts: SampleCounts) -> Self {
        Self { coarse: counts.coarse, fine: counts.fine }
    }
}

/// How a view is rendered; the default is the released renderer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct RenderOptions {
    /// Quadrature.
    pub sampling: Sampling,
    /// Samples along a ray.
    pub samples: SampleCounts,
    /// Scene over sky.
    pub composite: Composite,
    /// The sky map's seam.
    pub sky_seam: SkySeam,
    /// What depth means; [`Sampling::Stable`] implies [`DepthKind::Normalised`].
    pub depth: DepthKind,
}

impl RenderOptions {
    /// The stable quadrature with everything else as trained.
    #[must_use]
    pub fn stable() -> Self {
        Self { sampling: Sampling::Stable, ..Self::default() }
    }

    /// What depth means with these options.
    #[must_use]
    pub fn depth_kind(&self) -> DepthKind {
        match self.sampling {
            Sampling::Stable => DepthKind::Normalised,
            Sampling::Reference => self.depth,
        }
    }
}
