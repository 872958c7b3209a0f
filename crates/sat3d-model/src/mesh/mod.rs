//! Surfaces out of density grids: marching cubes whose meshes are always closed.
//!
//! **Tie rule**, the same for every cell: a grid point is inside where its density is at least the
//! isovalue. NaN is outside. A face with two inside corners across from each other keeps the solid in one
//! piece; the face alone decides, so both its cells agree. The table of cases is made from this rule, and
//! the surface is a closed 2-manifold, wound outward, for any values whatever.
//!
//! **Clamp**: a vertex keeps 1/256 of its edge's length from both ends, so that a density that equals the
//! isovalue makes no degenerate triangle and no two vertices at one place. On the default lattice over a
//! crop of 64.48 m that is at most 1.0 mm across and 0.8 mm in height.
//!
//! **Border**: all is outside beyond the grid. On the pixel lattice columns are pixel centres, and the
//! mesh closes at the crop's edge, half a pixel further out (and at z = -1 and 1): its walls stand inside the
//! crop, less than 1/256 of that half pixel from the edge. On the released grid it closes half a step
//! beyond the outermost points; there only the top matters, because the grid's border is zeroed.
//!
//! **Frames**: see [`MeshFrame`]. Coordinates are computed in `f64` and rounded once.

mod cases;
mod grid;
#[cfg(test)]
mod hard_cases;
mod layers;
mod of_field;

pub use grid::mesh_grid;
pub use layers::{Axis, LayerMesher, Surface, SurfaceSink};
pub(crate) use of_field::scene_mesh;

use serde::{Deserialize, Serialize};

/// Share of an edge that a vertex keeps from each of its ends. Two vertices near a grid point are then
/// 1/256 of a step apart, which 32-bit floats tell apart within 2^13 steps of the origin.
pub const CLAMP: f64 = 1.0 / 256.0;

/// A triangle mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// The frame of the vertices.
    pub frame: MeshFrame,
    /// Vertices, metres (or cube units) in that frame.
    pub vertices: Vec<[f32; 3]>,
    /// Corners of triangles, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Red, green, blue of each vertex, as in an image (sRGB).
    pub colors: Option<Vec<[u8; 3]>>,
    /// Texture coordinates of each vertex in the satellite image: (0, 0) its north-west, (1, 1) its
    /// south-east corner.
    pub texture_coordinates: Option<Vec<[f32; 2]>>,
}

/// Axes and unit of a mesh; both are right-handed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeshFrame {
    /// Metres: x east, y north, z up. The origin is under the crop's centre, at the cube's bottom, so that
    /// z is the height of the DSM: `arr_0` times the metres of the whole cube.
    #[default]
    EastNorthUp,
    /// Cube units, as the reference writes OBJ: x south, y up, z west; the cube is `[-1, 1]^3`.
    Reference,
}

/// Where densities are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeshLattice {
    /// [`Lattice::pixels`](crate::render::Lattice::pixels): a column for each of `size x size` pixels.
    Pixels {
        /// Pixels along a side of the crop.
        size: usize,
    },
    /// The released grid with its drift and its zeroed border ([`crate::render::reference_grid`]).
    Reference {
        /// Points along each axis (320 as released).
        count: usize,
    },
}

impl Default for MeshLattice {
    fn default() -> Self {
        Self::Pixels { size: 256 }
    }
}

/// What colours a mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeshColor {
    /// Nothing.
    #[default]
    None,
    /// The field at each vertex, with the zero style code: red, green and blue times 255, the rest cut off.
    Field,
    /// The satellite image, by texture coordinates.
    Texture,
}

/// How a scene becomes a mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeshOptions {
    /// Density of the surface, per cube unit.
    pub isovalue: f32,
    /// Where densities are taken.
    pub lattice: MeshLattice,
    /// Axes and unit.
    pub frame: MeshFrame,
    /// What colours it.
    pub color: MeshColor,
    /// Ground metres per cube unit, across (x) and down (y).
    pub horizontal_metres_per_unit: [f64; 2],
    /// Metres of height per cube unit.
    pub vertical_metres_per_unit: f64,
}

impl Default for MeshOptions {
    /// The released isovalue, on the pixels of a crop of 64.48 m with the published scale of heights.
    fn default() -> Self {
        Self {
            isovalue: 5.0,
            lattice: MeshLattice::default(),
            frame: MeshFrame::default(),
            color: MeshColor::default(),
            horizontal_metres_per_unit: [40.3; 2],
            vertical_metres_per_unit: 32.24,
        }
    }
}

/// Why there is no mesh.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// The isovalue is not finite; of a scene, not above 0 (there all of space is inside).
    #[error("an isovalue of {0}; it must be a finite number, and above 0 for densities")]
    Isovalue(f64),
    /// A scale is not a positive number.
    #[error("{0} metres per cube unit; it must be a number above 0")]
    MetresPerUnit(f64),
    /// Coordinates along an axis do not ascend or are not finite.
    #[error("a grid's coordinate {before} is followed by {next}; they must ascend and be finite")]
    Axis {
        /// A coordinate.
        before: f64,
        /// The one after it.
        next: f64,
    },
    /// A grid without points.
    #[error("a grid without points along an axis")]
    NoPoints,
    /// A grid with too few points.
    #[error("a lattice of {found} points along an axis; at least {least} are needed")]
    Lattice {
        /// As asked for.
        found: usize,
        /// The least number.
        least: usize,
    },
    /// A layer or grid with another number of values than points.
    #[error("{found} values where the grid has {expected} points")]
    Layer {
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// More vertices than 32 bits number.
    #[error(
        "{0} vertices; a mesh holds at most 4294967295: use a coarser lattice or mesh it in parts"
    )]
    TooManyVertices(u64),
    /// 32-bit coordinates would merge vertices.
    #[error(
        "grid steps of {step} are too fine for 32-bit coordinates up to {extent}: use a coarser lattice"
    )]
    TooFine {
        /// The least step, in the mesh's unit.
        step: f64,
        /// The largest coordinate, in the mesh's unit.
        extent: f64,
    },
}

impl Mesh {
    /// Least and greatest coordinate along each axis; `None` without vertices.
    #[must_use]
    pub fn bounds(&self) -> Option<[[f32; 3]; 2]> {
        let first = *self.vertices.first()?;
        Some(self.vertices.iter().fold([first; 2], |[low, high], vertex| {
            [[0, 1, 2].map(|k| low[k].min(vertex[k])), [0, 1, 2].map(|k| high[k].max(vertex[k]))]
        }))
    }

    /// Area, in the square of the frame's unit.
    #[must_use]
    pub fn area(&self) -> f64 {
        let area = |[a, b, c]: [[f64; 3]; 3]| {
            let normal = cross(minus(b, a), minus(c, a));
            normal.iter().map(|v| v * v).sum::<f64>().sqrt() / 2.0
        };
        self.sum(area)
    }

    /// Volume inside, in the cube of the frame's unit; positive where triangles are wound outward.
    #[must_use]
    pub fn signed_volume(&self) -> f64 {
        let volume = |[a, b, c]: [[f64; 3]; 3]| {
            cross(a, b).iter().zip(c).map(|(normal, c)| normal * c).sum::<f64>() / 6.0
        };
        self.sum(volume)
    }

    /// Sum over triangles, in groups of fixed size, so that many small terms are not lost in a large sum.
    fn sum(&self, term: impl Fn([[f64; 3]; 3]) -> f64) -> f64 {
        let of_triangle = |corners: &[u32; 3]| {
            term(corners.map(|index| self.vertices[index as usize].map(f64::from)))
        };
        self.triangles.chunks(4096).map(|group| group.iter().map(of_triangle).sum::<f64>()).sum()
    }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
