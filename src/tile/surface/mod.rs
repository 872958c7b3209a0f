//! The city's surface: cut into tiles while it is made, welded, simplified and written afterwards.

pub mod distance;
mod near;
mod older;
pub mod output;
pub mod parts;
pub mod simplify;
pub mod sink;
pub mod store;
pub mod weld;

#[cfg(test)]
mod near_tests;
#[cfg(test)]
mod output_tests;
#[cfg(test)]
mod simplify_tests;
#[cfg(test)]
mod tests;

/// Columns and rows of model pixels of one tile.
pub const TILE: u32 = 256;

/// A piece of the surface, in grid coordinates ([`super::city::City`]): the triangles of the cells of
/// [`TILE`] x [`TILE`] pixels. Vertices on its sides have the same bits in the tiles on both sides.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshTile {
    /// Vertices, grid coordinates.
    pub vertices: Vec<[f64; 3]>,
    /// Corners of triangles, counter-clockwise seen from outside in east-north-up.
    pub triangles: Vec<[u32; 3]>,
}

/// Which tile: column and row of tiles from the north-west corner.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TileIndex {
    /// From the north.
    pub row: u32,
    /// From the west.
    pub column: u32,
}
