//! Density volumes as files: npy, npz and Zarr.
//!
//! The axes are those of [`DensityGrid`]: x to the east, y, z up, and z is fastest. What stands along an
//! axis is said by [`Axes`]; a Zarr volume carries them with it, an npy file cannot and gets a file of
//! coordinates beside it. See `docs/volume.md`.
//!
//! ```
//! use sat3d::model::Scene;
//! use sat3d::model::field::closed_form::BoxCity;
//! use sat3d::model::render::Lattice;
//! use sat3d::model::scene::SceneParts;
//! use sat3d::volume::{Axes, Frame, VolumeDescription, ZarrVolume, save_npy};
//!
//! let (inputs, head) = BoxCity { texels: 64, ..BoxCity::example() }.inputs();
//! let scene = Scene::new(SceneParts { inputs, head, sky: None, metres_per_unit: 32.24 })?;
//! let grid = scene.density_grid(Lattice::pixels(32, 0.8));
//! let axes = Axes::local(&grid.lattice, [40.3, 40.3, 32.24]);
//! let folder = tempfile::tempdir()?;
//!
//! save_npy(&folder.path().join("city.npy"), &grid, &axes)?;
//!
//! let frame = Frame::Local { origin: None };
//! let description = VolumeDescription::new(axes, frame, [40.3, 40.3, 32.24]);
//! let mut volume = ZarrVolume::create(&folder.path().join("city.zarr"), description)?;
//! volume.write_region([0; 3], grid.shape(), &grid.values)?;
//! volume.finish()?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod chunk;
mod metadata;
mod zarr;

pub use zarr::ZarrVolume;

use crate::crs::CrsSpec;
use crate::footprint::Footprint;
use crate::grid::LonLat;
use crate::model::render::{DensityGrid, Lattice};
use crate::raster::npz::{Compression, NpyArray, NpyData, encode, npy_header_f32};
use serde_json::{Map, Value};
use std::io;
use std::path::{Path, PathBuf};

/// Coordinates of a volume's points along its three axes, in their order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axes {
    /// Easting: metres east of the centre, or in units of the CRS.
    pub x: Vec<f64>,
    /// Northing; descending, because rows run south.
    pub y: Vec<f64>,
    /// Height, metres above the bottom of the cube: the zero of the DSM and of the mesh.
    pub z: Vec<f64>,
}

impl Axes {
    /// Metres east and north of the scene's centre and up from its bottom; `metres_per_unit` of the cube along x, y and z.
    #[must_use]
    pub fn local(lattice: &Lattice, metres_per_unit: [f64; 3]) -> Self {
        let [x, y, z] = metres_per_unit;
        let scale = |axis: &[f32], unit: f64| axis.iter().map(|v| f64::from(*v) * unit).collect();
        // The cube's y runs south. 0 - v, so that no zero becomes negative.
        let north = lattice.y.iter().map(|v| 0.0 - f64::from(*v) * y).collect();
        Self { x: scale(&lattice.x, x), y: north, z: heights(lattice, z) }
    }

    /// Coordinates in the CRS of a footprint; `None` where its place is not known. The crop fills
    /// `[-scale, scale]` of the cube; heights are metres.
    #[must_use]
    pub fn on_map(
        lattice: &Lattice,
        footprint: &Footprint,
        scale: f64,
        vertical_metres_per_unit: f64,
    ) -> Option<Self> {
        // One pixel that covers the whole footprint.
        let grid = footprint.ground_grid([1, 1])?.geotransform.0;
        let place = |axis: &[f32], origin: f64, step: f64| {
            let at = |v: &f32| origin + (f64::from(*v) / scale + 1.0) / 2.0 * step;
            axis.iter().map(at).collect()
        };
        Some(Self {
            x: place(&lattice.x, grid[0], grid[1]),
            y: place(&lattice.y, grid[3], grid[5]),
            z: heights(lattice, vertical_metres_per_unit),
        })
    }

    /// Points along x, y and z.
    #[must_use]
    pub fn shape(&self) -> [usize; 3] {
        [self.x.len(), self.y.len(), self.z.len()]
    }
}

fn heights(lattice: &Lattice, metres_per_unit: f64) -> Vec<f64> {
    lattice.z.iter().map(|v| (f64::from(*v) + 1.0) * metres_per_unit).collect()
}

/// What a volume's x and y are.
#[derive(Clone, Debug, PartialEq)]
pub enum Frame {
    /// Metres east and north of the scene's centre.
    Local {
        /// Where the centre is, if that is known.
        origin: Option<LonLat>,
    },
    /// Coordinates in this CRS.
    Map(CrsSpec),
}

/// What a Zarr volume is.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeDescription {
    /// Where its points are.
    pub axes: Axes,
    /// What x and y are.
    pub frame: Frame,
    /// Points along x, y and z of one chunk: a file of its own.
    pub chunk: [usize; 3],
    /// How chunks are compressed: gzip, unless [`Compression::Stored`].
    pub compression: Compression,
    /// Metres of one unit of the cube along x, y and z; densities are per unit.
    pub metres_per_unit: [f64; 3],
    /// More attributes of the whole (software, weights, settings).
    pub attributes: Map<String, Value>,
}

impl VolumeDescription {
    /// In chunks of 64 x 64 x 64 points (1 MiB), compressed fast.
    #[must_use]
    pub fn new(axes: Axes, frame: Frame, metres_per_unit: [f64; 3]) -> Self {
        Self {
            axes,
            frame,
            chunk: [64; 3],
            compression: Compression::Fast,
            metres_per_unit,
            attributes: Map::new(),
        }
    }
}

/// Why a volume cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum VolumeError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The description describes no volume.
    #[error("{}: cannot be written as a volume: {reason}", path.display())]
    Description {
        /// The volume.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A region that reaches beyond the volume, or values that do not fill it.
    #[error(
        "{}: a region of {size:?} points from {start:?} with {values} values does not fit a volume of {shape:?}",
        path.display()
    )]
    Region {
        /// The volume.
        path: PathBuf,
        /// First point along x, y, z.
        start: [usize; 3],
        /// Points.
        size: [usize; 3],
        /// Values given.
        values: usize,
        /// Points of the volume.
        shape: [usize; 3],
    },
    /// A chunk that was written before and cannot be read back.
    #[error("{}: is damaged: {reason}; remove the folder and write it anew", path.display())]
    Chunk {
        /// The chunk's file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// What stands in the volume's place is something else.
    #[error("{}: {reason}", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
        /// What it is and what to do.
        reason: String,
    },
}

impl VolumeError {
    fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }
}

/// A density grid as a `.npy` file: float32 of shape (x, y, z), C order, per cube unit.
#[must_use]
pub fn npy(grid: &DensityGrid) -> Vec<u8> {
    let mut bytes = npy_header_f32(&grid.shape());
    bytes.reserve(grid.values.len() * 4);
    for value in &grid.values {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    bytes
}

/// The coordinates of a grid as a `.npz` file: float64 arrays `x`, `y` and `z`.
#[must_use]
pub fn coordinates_npz(axes: &Axes) -> Vec<u8> {
    let shapes = axes.shape();
    let array = |name, index: usize, values| NpyArray {
        name,
        shape: std::slice::from_ref(&shapes[index]),
        data: NpyData::F64(values),
    };
    let arrays = [array("x", 0, &axes.x), array("y", 1, &axes.y), array("z", 2, &axes.z)];
    encode(&arrays, Compression::Stored)
}

/// Writes a grid to `path` (`.npy`) and its coordinates beside it, `STEM_coordinates.npz`; each appears whole
/// or not at all. Returns the second path.
///
/// # Errors
/// [`VolumeError::Description`] where grid and axes do not fit, [`VolumeError::Io`].
pub fn save_npy(path: &Path, grid: &DensityGrid, axes: &Axes) -> Result<PathBuf, VolumeError> {
    if grid.shape() != axes.shape() {
        return Err(VolumeError::Description {
            path: path.to_owned(),
            reason: format!("{:?} points, and coordinates of {:?}", grid.shape(), axes.shape()),
        });
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let beside = path.with_file_name(format!("{stem}_coordinates.npz"));
    let write = |path: &Path, bytes: &[u8]| {
        crate::batch::write_atomic(path, bytes).map_err(VolumeError::io(path))
    };
    write(&beside, &coordinates_npz(axes))?;
    write(path, &npy(grid))?;
    Ok(beside)
}
