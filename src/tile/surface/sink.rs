//! A slab's surface out of its lines of density, cut into tiles.
//!
//! A slab holds the cells between line `first - 1` and its last line, so that each cell belongs to one
//! slab and each vertex between two slabs is computed in both from the same line: with the same bits.
//! Across the slab, the cells between point `c - 1` and point `c` belong to the tile of point `c`. The cells beyond
//! the lattice, where the mesh closes, belong to the first or last tile.

use super::{MeshTile, TILE, TileIndex};
use crate::tile::city::{Along, City, SLAB};
use sat3d_model::mesh::{Axis, LayerMesher, MeshError, SurfaceSink};

/// Meshes one slab. Lines come in their order, each with `across x levels` densities, the levels of a column
/// beside each other; NaN is outside.
#[derive(Debug)]
pub struct SlabMesher {
    along: Along,
    slab: u32,
    lines: std::ops::Range<u32>,
    /// Lines of the city.
    count: u32,
    rows: Axis,
    columns: Axis,
    isovalue: f64,
    /// `None` until it is known where the mesh begins.
    mesher: Option<LayerMesher<f32>>,
    next: u32,
    cutter: Cutter,
}

impl SlabMesher {
    /// A mesher of a slab. The surface is where the density is the isovalue.
    ///
    /// # Errors
    /// [`MeshError`] where the levels do not ascend or the isovalue is not finite.
    pub fn new(city: &City, slab: u32, isovalue: f64) -> Result<Self, MeshError> {
        // Slabs and tiles are equally wide, so that a tile lies in one slab.
        const { assert!(SLAB == TILE) };
        Self::with_side(city, slab, isovalue, TILE)
    }

    pub(super) fn with_side(
        city: &City,
        slab: u32,
        isovalue: f64,
        side: u32,
    ) -> Result<Self, MeshError> {
        let [lines, across] = city.lines_across();
        let centres = (0..across).map(|index| f64::from(index) + 0.5);
        let rows = Axis::new(0.0, centres, across.into())?;
        let [bottom, top] = city.levels.ends;
        let columns = Axis::new(bottom, city.levels.z.iter().map(|z| f64::from(*z)), top)?;
        let first = slab.saturating_mul(side).min(lines);
        let mut mesher = None;
        if slab == 0 {
            mesher = Some(LayerMesher::new(0.0, rows.clone(), columns.clone(), isovalue)?);
        } else if !isovalue.is_finite() {
            return Err(MeshError::Isovalue(isovalue));
        }
        let cutter = Cutter {
            along: city.along,
            side,
            tile: 0,
            vertices: Vec::new(),
            triangles: vec![Vec::new(); across.div_ceil(side) as usize],
            priming: false,
        };
        let lines_of_slab = first..first.saturating_add(side).min(lines);
        Ok(Self {
            along: city.along,
            slab,
            lines: lines_of_slab,
            count: lines,
            rows,
            columns,
            isovalue,
            mesher,
            next: first,
            cutter,
        })
    }

    /// Takes the line before the slab's first one; of the first slab there is none.
    ///
    /// # Errors
    /// [`MeshError::Layer`] where it has another number of values than a line.
    pub fn prime(&mut self, values: &[f32]) -> Result<(), MeshError> {
        let Some(before) = self.lines.start.checked_sub(1) else { return Ok(()) };
        let at = f64::from(before) + 0.5;
        let (rows, columns) = (self.rows.clone(), self.columns.clone());
        let mut mesher = LayerMesher::new(at - 0.5, rows, columns, self.isovalue)?;
        // A cap would close the mesh here; its vertices in the line are the slab's.
        self.cutter.priming = true;
        let primed = mesher.push(at, values, &mut self.cutter);
        self.cutter.priming = false;
        self.mesher = Some(mesher);
        primed
    }

    /// Takes the next line of the slab.
    ///
    /// # Errors
    /// [`MeshError::Layer`] where it has another number of values, [`MeshError::Axis`] where it is not the
    /// next one (or the slab was not primed), [`MeshError::TooManyVertices`] beyond 32 bits.
    pub fn push(&mut self, line: u32, values: &[f32]) -> Result<(), MeshError> {
        let out_of_turn =
            MeshError::Axis { before: f64::from(self.next) - 0.5, next: f64::from(line) + 0.5 };
        let Some(mesher) = &mut self.mesher else { return Err(out_of_turn) };
        if line != self.next || !self.lines.contains(&line) {
            return Err(out_of_turn);
        }
        mesher.push(f64::from(line) + 0.5, values, &mut self.cutter)?;
        self.next += 1;
        Ok(())
    }

    /// The tiles that hold triangles, in their order across. Of the last slab the mesh is closed at the
    /// city's end first.
    ///
    /// # Errors
    /// [`MeshError::Axis`] where lines are missing, [`MeshError::TooManyVertices`].
    pub fn finish(mut self) -> Result<Vec<(TileIndex, MeshTile)>, MeshError> {
        if self.next != self.lines.end {
            let [before, next] = [self.next, self.lines.end].map(|line| f64::from(line) - 0.5);
            return Err(MeshError::Axis { before, next });
        }
        if self.next == self.count
            && let Some(mesher) = &mut self.mesher
        {
            mesher.finish(self.count.into(), &mut self.cutter)?;
        }
        let (along, slab) = (self.along, self.slab);
        let tiles = self.cutter.into_tiles().into_iter().map(|(across, tile)| {
            let index = match along {
                Along::X => TileIndex { row: across, column: slab },
                Along::Y => TileIndex { row: slab, column: across },
            };
            (index, tile)
        });
        Ok(tiles.collect())
    }
}

/// Sorts triangles into tiles.
#[derive(Debug)]
struct Cutter {
    along: Along,
    /// Points of a tile across.
    side: u32,
    /// The tile of the triangles that come.
    tile: usize,
    /// All vertices of the slab, grid coordinates.
    vertices: Vec<[f64; 3]>,
    /// Of each tile, by the slab's numbers of vertices.
    triangles: Vec<Vec<[u32; 3]>>,
    /// Whether triangles are dropped.
    priming: bool,
}

impl SurfaceSink for Cutter {
    fn vertex(&mut self, [line, across, z]: [f64; 3]) {
        self.vertices.push(match self.along {
            Along::X => [line, across, z],
            Along::Y => [across, line, z],
        });
    }

    fn triangle(&mut self, [a, b, c]: [u32; 3]) {
        if !self.priming {
            // East, south, up is left-handed; south, east, up is right-handed.
            self.triangles[self.tile].push(match self.along {
                Along::X => [c, b, a],
                Along::Y => [a, b, c],
            });
        }
    }

    fn cells(&mut self, cells: usize) {
        self.tile = (cells / self.side as usize).min(self.triangles.len() - 1);
    }
}

impl Cutter {
    /// Tiles with vertices of their own, in the order in which their triangles use them.
    fn into_tiles(self) -> Vec<(u32, MeshTile)> {
        let mut numbers = vec![u32::MAX; self.vertices.len()];
        let mut tiles = Vec::new();
        for (across, mut triangles) in (0..).zip(self.triangles) {
            if triangles.is_empty() {
                continue;
            }
            let mut used = Vec::new();
            for corner in triangles.iter_mut().flatten() {
                let number = &mut numbers[*corner as usize];
                if *number == u32::MAX {
                    *number = used.len() as u32;
                    used.push(*corner);
                }
                *corner = *number;
            }
            let vertices = used.iter().map(|vertex| self.vertices[*vertex as usize]).collect();
            for vertex in used {
                numbers[vertex as usize] = u32::MAX;
            }
            tiles.push((across, MeshTile { vertices, triangles }));
        }
        tiles
    }
}
