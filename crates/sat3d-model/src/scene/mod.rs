//! A scene: everything that is needed to render one image's field again without the network.
//!
//! ```
//! use sat3d_model::Scene;
//! use sat3d_model::field::closed_form::BoxCity;
//! use sat3d_model::render::{Angles, Camera, Lattice, Pose, RenderOptions, Wanted};
//! use sat3d_model::scene::SceneParts;
//!
//! // A made-up city; a network's scene comes from an image.
//! let (inputs, head) = BoxCity { texels: 64, ..BoxCity::example() }.inputs();
//! let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 })?;
//!
//! let dsm = scene.dsm(64, &RenderOptions::stable());
//! let highest = dsm.height.iter().copied().fold(0.0, f32::max);
//! assert!((highest - 0.65).abs() < 0.01, "the tower's roof is at z = 0.3");
//!
//! // From the middle of the crop at street level, looking east and a little up.
//! let angles = Angles { yaw: 90.0, pitch: -10.0, roll: 0.0 };
//! let camera = Camera::perspective(Pose::on_crop([0.0, 0.0, -0.85], angles, 0.8));
//! let view = scene.render(&camera, &RenderOptions::default(), Wanted { color: true, normals: false });
//! assert_eq!((view.width, view.height), (128, 128));
//!
//! let grid = scene.density_grid(Lattice::pixels(64, 0.8));
//! assert_eq!(grid.shape(), [64, 64, 80]);
//!
//! // One file holds all of it: another program, or another day, renders the same.
//! let path = std::env::temp_dir().join(format!("city-{}.scene.safetensors", std::process::id()));
//! scene.save(&path)?;
//! assert_eq!(Scene::load(&path)?.dsm(64, &RenderOptions::stable()).height, dsm.height);
//! std::fs::remove_file(&path)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod file;

pub use file::SceneFileError;

use crate::field::{Field, FieldError, FieldInputs, PointHead};
use crate::mesh::{Mesh, MeshError, MeshOptions, scene_mesh};
use crate::render::{
    Camera, DensityGrid, Dsm, Lattice, ReferenceGrid, RenderOptions, SkyMap, View, Wanted,
    density_grid, dsm, reference_grid, render,
};
use crate::tensor::Grid;

/// What a scene is made of, as it is stored.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneParts {
    /// Feature map and how it is read.
    pub inputs: FieldInputs,
    /// The point head.
    pub head: PointHead,
    /// Sky: the style code that colours street views, and the sky decoder's map after its sigmoid
    /// (`24 x 512 x 512`).
    pub sky: Option<SkyParts>,
    /// Metres of one cube unit in height: 32.24 by the published scoring, 40.3 isotropic.
    pub metres_per_unit: f64,
}

/// The sky of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyParts {
    /// The style code.
    pub style: Vec<f32>,
    /// The map, `[0, 1]`: channels x azimuth rows x zenith columns up to 100 degrees.
    pub map: Grid,
}

/// A scene, ready to be rendered.
#[derive(Clone, Debug)]
pub struct Scene {
    parts: SceneParts,
    plain: Field,
    styled: Option<(Field, SkyMap)>,
}

/// Why parts do not make a scene.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// The field's parts do not fit.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// The sky map has other channels than the field's colours.
    #[error("a sky map of {sky} channels with a field of {field} colour channels")]
    SkyChannels {
        /// Of the sky map.
        sky: usize,
        /// Of the field.
        field: usize,
    },
    /// The scale of heights is not a positive number.
    #[error("{0} metres per cube unit")]
    MetresPerUnit(f64),
}

impl Scene {
    /// Folds the parts into a field.
    ///
    /// # Errors
    /// When shapes do not fit each other or a value is not finite.
    pub fn new(parts: SceneParts) -> Result<Self, SceneError> {
        if !(parts.metres_per_unit > 0.0 && parts.metres_per_unit.is_finite()) {
            return Err(SceneError::MetresPerUnit(parts.metres_per_unit));
        }
        let plain = Field::new(&parts.inputs, &parts.head, None)?;
        let styled = match &parts.sky {
            Some(sky) => {
                let field = plain.color_channels();
                if sky.map.channels != field {
                    return Err(SceneError::SkyChannels { sky: sky.map.channels, field });
                }
                let styled = plain.with_style(&parts.head, Some(&sky.style))?;
                Some((styled, SkyMap::from_decoder(&sky.map)))
            }
            None => None,
        };
        Ok(Self { parts, plain, styled })
    }

    /// What the scene is made of.
    #[must_use]
    pub fn parts(&self) -> &SceneParts {
        &self.parts
    }

    /// The field with the zero style code, with which the satellite view is trained.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.plain
    }

    /// The field in the light of the scene's sky; without a sky, [`Scene::field`].
    #[must_use]
    pub fn lit_field(&self) -> &Field {
        self.styled.as_ref().map_or(&self.plain, |(field, _)| field)
    }

    /// The DSM of the crop, `size x size` pixels (256 as released). One unit of its heights is
    /// `2 * metres_per_unit` metres.
    #[must_use]
    pub fn dsm(&self, size: usize, options: &RenderOptions) -> Dsm {
        dsm(&self.plain, size, options)
    }

    /// What a camera sees: the satellite view without style and sky, any other view with both.
    #[must_use]
    pub fn render(&self, camera: &Camera, options: &RenderOptions, wanted: Wanted) -> View {
        match (camera, &self.styled) {
            (Camera::Ortho { .. }, _) | (_, None) => {
                render(&self.plain, None, camera, options, wanted)
            }
            (_, Some((field, sky))) => render(field, Some(sky), camera, options, wanted),
        }
    }

    /// Densities on a lattice; [`Lattice::pixels`] has a column for each pixel of the crop.
    #[must_use]
    pub fn density_grid(&self, lattice: Lattice) -> DensityGrid {
        density_grid(&self.plain, lattice)
    }

    /// Densities on the released grid, drift included.
    ///
    /// # Panics
    /// When the grid has fewer than two points along an axis.
    #[must_use]
    pub fn reference_grid(&self, grid: &ReferenceGrid) -> DensityGrid {
        reference_grid(&self.plain, grid)
    }
    /// The scene's surface as a closed mesh, wound outward ([`crate::mesh`] states the conventions).
    /// Without any density at the isovalue it is empty.
    ///
    /// ```
    /// use sat3d_model::Scene;
    /// use sat3d_model::field::closed_form::BoxCity;
    /// use sat3d_model::mesh::{MeshLattice, MeshOptions};
    /// use sat3d_model::scene::SceneParts;
    ///
    /// let (inputs, head) = BoxCity { texels: 64, ..BoxCity::example() }.inputs();
    /// let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 })?;
    /// let options =
    ///     MeshOptions { lattice: MeshLattice::Pixels { size: 64 }, ..MeshOptions::default() };
    /// let mesh = scene.mesh(&options)?;
    /// let [_, highest] = mesh.bounds().expect("a surface");
    /// let roof = (0.3 + 1.0) * 32.24;
    /// assert!((f64::from(highest[2]) - roof).abs() < 1.0, "the tower, in metres");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`MeshError`] for an isovalue or a scale that is not a positive number, a lattice without points, and
    /// one too fine for 32-bit coordinates or indices.
    pub fn mesh(&self, options: &MeshOptions) -> Result<Mesh, MeshError> {
        scene_mesh(&self.plain, options)
    }
}
