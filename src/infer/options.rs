//! What a user can ask of an inference run.

use crate::batch::{Shard, Verify};
use crate::footprint::VerticalScale;
use crate::model::Device;
use crate::model::render::{RenderOptions, SampleCounts};
use serde::Serialize;
use std::path::PathBuf;

/// What is made of each image. The plan's steps and parameters follow from it: what no output needs is
/// neither loaded nor computed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Outputs {
    /// `<stem>.npz`: heights, opacity, spread.
    pub dsm: bool,
    /// `<stem>.tif`: the heights in metres as a Cloud Optimized GeoTIFF.
    pub geotiff: bool,
    /// `<stem>.scene.safetensors`: the scene, to be rendered again without the network.
    pub scene: bool,
}

impl Default for Outputs {
    fn default() -> Self {
        Self { dsm: true, geotiff: false, scene: false }
    }
}

impl Outputs {
    /// Whether there is anything to do.
    #[must_use]
    pub const fn any(&self) -> bool {
        self.dsm || self.geotiff || self.scene
    }

    /// Whether the heights of the crop are rendered.
    #[must_use]
    pub const fn needs_heights(&self) -> bool {
        self.dsm || self.geotiff
    }

    /// Whether rays leave the scene, so that the sky branch runs (street views).
    #[must_use]
    pub const fn needs_sky(&self) -> bool {
        false
    }

    /// Whether colours are evaluated (views, coloured meshes).
    #[must_use]
    pub const fn needs_colour(&self) -> bool {
        false
    }

    /// Whether views are enlarged by the super-resolution network.
    #[must_use]
    pub const fn needs_super_resolution(&self) -> bool {
        false
    }

    /// Files of one image, for messages and collisions.
    #[must_use]
    pub fn files_of(&self, stem: &str) -> Vec<String> {
        let ends =
            [(self.dsm, ".npz"), (self.geotiff, ".tif"), (self.scene, super::outputs::SCENE_END)];
        ends.iter().filter(|(on, _)| *on).map(|(_, end)| format!("{stem}{end}")).collect()
    }
}

/// Everything that `sat3d infer` can be asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct InferOptions {
    /// An image, a folder of images, a VIGOR city folder, a list or manifest, or a scene file.
    pub input: PathBuf,
    /// Folder that names in a list are relative to; the list's own where absent.
    pub root: Option<PathBuf>,
    /// Checkpoint folder; not needed where the input is scene files alone.
    pub weights: Option<PathBuf>,
    /// Where the network runs.
    pub device: Device,
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
            device: Device::Cpu,
            out,
            outputs: Outputs::default(),
            size: 256,
            render: RenderOptions::default(),
            samples: None,
            vertical: VerticalScale::Paper,
            gsd_m: None,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            shard: Shard::WHOLE,
            verify: Verify::Quick,
            overwrite: false,
            quiet: false,
        }
    }
}
