//! What a run is asked for.

use super::layout::WindowOptions;
use super::network::TileLattice;
use super::surface::output::CityMeshColour;
use crate::batch::{Shard, Verify};
use crate::footprint::VerticalScale;
use crate::mesh_file::MeshFormat;
use crate::model::network::Wanted;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The isovalue of the mesh unless another is asked for, density per cube unit: as in `sat3d infer`.
pub const ISOVALUE: f32 = 5.0;
/// Memory for the sums of open lines unless more is allowed, bytes.
pub const MEMORY: u64 = 4 << 30;
/// Error of the finest level of 3D Tiles unless another is asked for, metres: about a model pixel.
pub const TILES3D_ERROR_M: f64 = 0.25;

/// What is written; names are files and folders in the output folder.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TileOutputs {
    /// Heights.
    pub dsm: Option<DsmRequest>,
    /// The surface as a file.
    pub mesh: Option<CityMeshRequest>,
    /// Densities, as a Zarr folder of this name.
    pub density: Option<String>,
    /// The surface as 3D Tiles.
    pub tiles3d: Option<Tiles3dRequest>,
}

impl TileOutputs {
    /// Heights and mesh, named after the picture: what is written where nothing is asked for.
    #[must_use]
    pub fn of_stem(stem: &str) -> Self {
        Self {
            dsm: Some(DsmRequest { file: format!("{stem}_dsm.tif"), preview: false, t_srs: None }),
            mesh: Some(CityMeshRequest::new(format!("{stem}.glb"), MeshFormat::Glb)),
            density: None,
            tiles3d: None,
        }
    }

    /// Whether anything is written.
    #[must_use]
    pub const fn any(&self) -> bool {
        self.dsm.is_some() || self.density.is_some() || self.needs_surface()
    }

    /// Whether the surface is extracted.
    #[must_use]
    pub const fn needs_surface(&self) -> bool {
        self.mesh.is_some() || self.tiles3d.is_some()
    }

    /// Names of all outputs.
    #[must_use]
    pub fn names(&self) -> Vec<&str> {
        let dsm = self.dsm.as_ref().map(|dsm| &*dsm.file);
        let mesh = self.mesh.as_ref().map(|mesh| &*mesh.file);
        let tiles = self.tiles3d.as_ref().map(|tiles| &*tiles.folder);
        [dsm, mesh, self.density.as_deref(), tiles].into_iter().flatten().collect()
    }
}

/// The DSM.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DsmRequest {
    /// File name.
    pub file: String,
    /// Also a hillshaded picture of it.
    pub preview: bool,
    /// Code of the CRS that it is warped to (`EPSG:32610`); the picture's own where there is none.
    pub t_srs: Option<String>,
}

/// The mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CityMeshRequest {
    /// File name, with the format's ending.
    pub file: String,
    /// glb, ply or obj.
    pub format: MeshFormat,
    /// What colours it.
    pub color: CityMeshColour,
    /// Largest error of simplification, metres.
    pub error_m: Option<f64>,
    /// Most triangles.
    pub max_triangles: Option<u64>,
}

impl CityMeshRequest {
    /// The whole surface, coloured at its vertices.
    #[must_use]
    pub const fn new(file: String, format: MeshFormat) -> Self {
        Self { file, format, color: CityMeshColour::Vertices, error_m: None, max_triangles: None }
    }
}

/// 3D Tiles.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tiles3dRequest {
    /// Folder name.
    pub folder: String,
    /// Error of the finest level, metres.
    pub error_m: f64,
    /// Height of the cube's bottom above the ellipsoid, metres.
    pub base_height_m: f64,
}

/// All options of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct TileOptions {
    /// The picture.
    pub input: PathBuf,
    /// Checkpoint folder; else as [`crate::weights::find`] has it.
    pub weights: Option<PathBuf>,
    /// Where, by what and how exactly the network is calculated.
    pub compute: Wanted,
    /// Folder below which the large network's weights are kept as an engine packs them.
    pub packed_weights: Option<PathBuf>,
    /// Output folder.
    pub out: PathBuf,
    /// What is written; heights and mesh where nothing is asked for.
    pub outputs: TileOutputs,
    /// Windows and weights.
    pub windows: WindowOptions,
    /// Where densities are taken.
    pub lattice: TileLattice,
    /// Density of the mesh's surface, per cube unit.
    pub isovalue: f32,
    /// How heights become metres.
    pub vertical: VerticalScale,
    /// Ground metres per pixel of the picture, across and down, over what its place says.
    pub gsd_m: Option<[f64; 2]>,
    /// Ground metres per model pixel.
    pub window_gsd_m: Option<f64>,
    /// Bytes that the sums of open lines may take; beyond, they are kept in a file.
    pub memory: u64,
    /// Threads.
    pub threads: usize,
    /// Part of the slabs.
    pub shard: Shard,
    /// How results of earlier runs are checked.
    pub verify: Verify,
    /// Replace results of another plan.
    pub overwrite: bool,
    /// Refuse to begin anew.
    pub resume: bool,
    /// No progress.
    pub quiet: bool,
}

impl TileOptions {
    /// The defaults.
    #[must_use]
    pub fn new(input: PathBuf, weights: Option<PathBuf>, out: PathBuf) -> Self {
        Self {
            input,
            weights,
            compute: Wanted::default(),
            packed_weights: None,
            out,
            outputs: TileOutputs::default(),
            windows: WindowOptions::default(),
            lattice: TileLattice::default(),
            isovalue: ISOVALUE,
            vertical: VerticalScale::default(),
            gsd_m: None,
            window_gsd_m: None,
            memory: MEMORY,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            shard: Shard::WHOLE,
            verify: Verify::Quick,
            overwrite: false,
            resume: false,
            quiet: false,
        }
    }
}
