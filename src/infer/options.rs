//! What a user can ask of an inference run.

use crate::batch::{Shard, Verify};
use crate::footprint::VerticalScale;
use crate::illumination::Illumination;
use crate::mesh_file::{self, MeshFormat};
use crate::model::mesh::{MeshColor, MeshFrame, MeshLattice};
use crate::model::network::Wanted;
use crate::model::render::{RenderOptions, SampleCounts};
use crate::views::ViewRequests;
use serde::Serialize;
use std::path::PathBuf;

/// What is made of each image. The plan's steps and parameters follow from it: what no output needs is
/// neither loaded nor computed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outputs {
    /// `<stem>.npz`: heights, opacity, spread.
    pub dsm: bool,
    /// `<stem>.tif`: the heights in metres as a Cloud Optimized GeoTIFF.
    pub geotiff: bool,
    /// `<stem>.scene.safetensors`: the scene, to be rendered again without the network.
    pub scene: bool,
    /// A mesh.
    pub mesh: Option<MeshRequest>,
    /// The density volume.
    pub density: Option<VolumeRequest>,
    /// Pictures from above and from the street.
    pub views: ViewRequests,
}

/// A mesh, and how it is made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshRequest {
    /// The file's kind.
    pub format: MeshFormat,
    /// Its name in the output folder, for one image; `<stem>.<format>` where absent.
    pub file: Option<String>,
    /// Density of the surface, per cube unit.
    pub isovalue: f32,
    /// Where densities are taken.
    pub lattice: MeshLattice,
    /// Axes and unit.
    pub frame: MeshFrame,
    /// What colours it.
    pub color: MeshColor,
}

impl MeshRequest {
    /// The mesh file's stem.
    #[must_use]
    pub fn stem<'a>(&'a self, image: &'a str) -> &'a str {
        self.file.as_deref().map_or(image, |file| {
            let end = self.format.extension().len() + 1;
            &file[..file.len().saturating_sub(end)]
        })
    }
}

/// A density volume, and where its points are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct VolumeRequest {
    /// The file's kind.
    pub format: VolumeFormat,
    /// Where densities are taken; of the released grid the part over the crop.
    pub lattice: MeshLattice,
}

/// How a density volume is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum VolumeFormat {
    /// `<stem>_density.npy`, and `<stem>_density_coordinates.npz` beside it.
    Npy,
    /// `<stem>_density.zarr/`, Zarr v3.
    Zarr,
}

/// End of a density volume's name, before its format's ending.
pub const DENSITY_END: &str = "_density";

impl Default for Outputs {
    fn default() -> Self {
        Self {
            dsm: true,
            geotiff: false,
            scene: false,
            mesh: None,
            density: None,
            views: ViewRequests::default(),
        }
    }
}

impl Outputs {
    /// Whether there is anything to do.
    #[must_use]
    pub fn any(&self) -> bool {
        self.dsm
            || self.geotiff
            || self.scene
            || self.mesh.is_some()
            || self.density.is_some()
            || !self.views.is_empty()
    }

    /// Whether the heights of the crop are rendered.
    #[must_use]
    pub const fn needs_heights(&self) -> bool {
        self.dsm || self.geotiff
    }

    /// Whether rays leave the scene, so that the sky branch runs (street views).
    #[must_use]
    pub fn needs_sky(&self) -> bool {
        self.views.needs_sky()
    }

    /// Whether colours are evaluated (views, coloured meshes).
    #[must_use]
    pub fn needs_colour(&self) -> bool {
        !self.views.is_empty()
            || self.mesh.as_ref().is_some_and(|mesh| mesh.color == MeshColor::Field)
    }

    /// Whether views are enlarged by the super-resolution network.
    #[must_use]
    pub fn needs_super_resolution(&self) -> bool {
        self.views.needs_super_resolution()
    }

    /// Whether the image itself is needed beside the scene (textures).
    #[must_use]
    pub fn needs_image(&self) -> bool {
        self.mesh.as_ref().is_some_and(|mesh| mesh.color == MeshColor::Texture)
    }

    /// Files of one image, for messages and collisions; a Zarr volume is its folder.
    #[must_use]
    pub fn files_of(&self, stem: &str) -> Vec<String> {
        let ends =
            [(self.dsm, ".npz"), (self.geotiff, ".tif"), (self.scene, super::outputs::SCENE_END)];
        let mut files: Vec<String> =
            ends.iter().filter(|(on, _)| *on).map(|(_, end)| format!("{stem}{end}")).collect();
        if let Some(mesh) = &self.mesh {
            let own = mesh.stem(stem);
            files.push(format!("{own}.{}", mesh.format.extension()));
            if mesh.format == MeshFormat::Obj && mesh.color == MeshColor::Texture {
                files.extend(mesh_file::companions(own));
            }
        }
        match self.density.map(|volume| volume.format) {
            Some(VolumeFormat::Npy) => files.extend([
                format!("{stem}{DENSITY_END}.npy"),
                format!("{stem}{DENSITY_END}_coordinates.npz"),
            ]),
            Some(VolumeFormat::Zarr) => files.push(format!("{stem}{DENSITY_END}.zarr")),
            None => {}
        }
        files.extend(self.views.files(stem));
        files
    }
}

/// Everything that `sat3d infer` can be asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct InferOptions {
    /// An image, a folder of images, a VIGOR city folder, a list or manifest, or a scene file.
    pub input: PathBuf,
    /// Folder that names in a list are relative to; the list's own where absent.
    pub root: Option<PathBuf>,
    /// Checkpoint folder, else found as [`crate::weights::find`] says; not needed where the input is scene files
    /// alone and no street view is asked for.
    pub weights: Option<PathBuf>,
    /// Where, by what and how exactly the network is calculated.
    pub compute: Wanted,
    /// Folder below which the large network's weights are kept as an engine packs them.
    pub packed_weights: Option<PathBuf>,
    /// Output folder.
    pub out: PathBuf,
    /// What is made of each image.
    pub outputs: Outputs,
    /// Pixels of the DSM across and down.
    pub size: u32,
    /// How rays are sampled and integrated.
    pub render: RenderOptions,
    /// Samples along a ray; the checkpoint's own where absent.
    pub samples: Option<SampleCounts>,
    /// How heights become metres.
    pub vertical: VerticalScale,
    /// Ground metres per pixel across and down, over what images say.
    pub gsd_m: Option<[f64; 2]>,
    /// The light of street views, where one was named; else the default sky.
    pub illumination: Option<Illumination>,
    /// Threads of the network and the renderer.
    pub threads: usize,
    /// Part of the batch.
    pub shard: Shard,
    /// How earlier results are checked.
    pub verify: Verify,
    /// Replaces results of another plan.
    pub overwrite: bool,
    /// No progress output.
    pub quiet: bool,
}

impl InferOptions {
    /// The defaults of the command line.
    #[must_use]
    pub fn new(input: PathBuf, weights: Option<PathBuf>, out: PathBuf) -> Self {
        Self {
            input,
            root: None,
            weights,
            compute: Wanted::default(),
            packed_weights: None,
            out,
            outputs: Outputs::default(),
            size: 256,
            render: RenderOptions::default(),
            samples: None,
            vertical: VerticalScale::Paper,
            gsd_m: None,
            illumination: None,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            shard: Shard::WHOLE,
            verify: Verify::Quick,
            overwrite: false,
            quiet: false,
        }
    }
}
