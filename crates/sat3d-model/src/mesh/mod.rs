//! Surfaces out of density grids.

/// A triangle mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertices, metres (or cube units) in the frame that was asked for.
    pub vertices: Vec<[f32; 3]>,
    /// Corners of triangles, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Red, green, blue of each vertex.
    pub colors: Option<Vec<[u8; 3]>>,
    /// Texture coordinates of each vertex in the satellite image: (0, 0) its north-west, (1, 1) its
    /// south-east corner.
    pub texture_coordinates: Option<Vec<[f32; 2]>>,
}
