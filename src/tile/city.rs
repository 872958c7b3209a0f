//! What all outputs of a run share: the lattice, its place, its scale.

use crate::footprint::{Footprint, GroundGrid};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Lines of one slab: the piece that is finished, written and forgotten.
pub const SLAB: u32 = 256;

/// Which way slabs follow each other: along the longer side of the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Along {
    /// From west to east; a line is a column of pixels.
    X,
    /// From north to south; a line is a row of pixels.
    Y,
}

/// Levels of density along z, cube units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Levels {
    /// Where the densities are taken, ascending.
    pub z: Vec<f32>,
    /// Where the cells of the first and the last level end: the closing planes of the mesh.
    pub ends: [f64; 2],
}

/// The city's lattice of density columns, one at the centre of each model pixel, and where it lies. It is
/// stored with the slabs, so that joining parts needs nothing else.
///
/// **Grid coordinates** `[x, y, z]`, in which meshes are kept until they are written: x and y count
/// model pixels from the north-west corner, east and south (the centre of pixel i is i + 1/2); z is in cube
/// units, -1 at the bottom.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct City {
    /// Columns and rows, model pixels.
    pub size: [u32; 2],
    /// Place and size on the ground of the picture as it was given.
    pub footprint: Footprint,
    /// Whether the size on the ground was assumed, for want of a georeference and of `--gsd`.
    pub assumed: bool,
    /// Levels of density.
    pub levels: Levels,
    /// Metres of height per cube unit.
    pub vertical_m: f64,
    /// Which way slabs follow each other.
    pub along: Along,
}

impl City {
    /// Lines (along the slabs) and columns of one line (across).
    #[must_use]
    pub const fn lines_across(&self) -> [u32; 2] {
        match self.along {
            Along::X => self.size,
            Along::Y => [self.size[1], self.size[0]],
        }
    }

    /// Number of slabs.
    #[must_use]
    pub const fn slabs(&self) -> u32 {
        self.lines_across()[0].div_ceil(SLAB)
    }

    /// Lines of a slab.
    #[must_use]
    pub fn lines(&self, slab: u32) -> Range<u32> {
        let end = self.lines_across()[0];
        (slab * SLAB).min(end)..((slab + 1) * SLAB).min(end)
    }

    /// The rectangle of a slab: columns and rows, model pixels.
    #[must_use]
    pub fn rectangle(&self, slab: u32) -> [Range<u32>; 2] {
        match self.along {
            Along::X => [self.lines(slab), 0..self.size[1]],
            Along::Y => [0..self.size[0], self.lines(slab)],
        }
    }

    /// Ground metres per model pixel, across and down, at the picture's centre.
    #[must_use]
    pub fn gsd_m(&self) -> [f64; 2] {
        let ground = self.footprint.ground_m();
        [0, 1].map(|axis| ground[axis] / f64::from(self.size[axis]))
    }

    /// Metres above the bottom of the cube: the zero of DSM, mesh and volume.
    #[must_use]
    pub fn height_m(&self, z: f64) -> f64 {
        (z + 1.0) * self.vertical_m
    }

    /// The raster of the DSM in the picture's own CRS; `None` where its place is not known.
    #[must_use]
    pub fn grid(&self) -> Option<GroundGrid> {
        self.footprint.ground_grid(self.size)
    }
}
