//! Tiles that become one mesh again.

use super::MeshTile;
use std::collections::HashMap;

/// Joins meshes: vertices on open edges that have the same bits become one. Vertices and triangles stay in
/// the order in which they come.
#[derive(Debug, Default)]
pub struct Welder {
    mesh: MeshTile,
    /// Numbers of the vertices on open edges. Only looked up, so its order does not matter.
    border: HashMap<[u64; 3], u32>,
}

impl Welder {
    /// Adds a mesh; all together have fewer than 2^32 vertices.
    pub fn push(&mut self, tile: &MeshTile) {
        let open = on_border(&tile.triangles, tile.vertices.len());
        let mut numbers = Vec::with_capacity(tile.vertices.len());
        for (vertex, open) in tile.vertices.iter().zip(open) {
            let next = self.mesh.vertices.len() as u32;
            let number = if open {
                *self.border.entry(vertex.map(f64::to_bits)).or_insert(next)
            } else {
                next
            };
            if number == next {
                self.mesh.vertices.push(*vertex);
            }
            numbers.push(number);
        }
        let corners = tile.triangles.iter();
        self.mesh.triangles.extend(corners.map(|c| c.map(|corner| numbers[corner as usize])));
    }

    /// The mesh.
    #[must_use]
    pub fn finish(self) -> MeshTile {
        self.mesh
    }
}

/// One mesh of several, in their order.
#[must_use]
pub fn weld<'a>(tiles: impl IntoIterator<Item = &'a MeshTile>) -> MeshTile {
    let mut welder = Welder::default();
    for tile in tiles {
        welder.push(tile);
    }
    welder.finish()
}

/// Edges of one triangle only, lower corner first, ascending.
#[must_use]
pub fn open_edges(triangles: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let mut edges: Vec<u64> = Vec::with_capacity(3 * triangles.len());
    for [a, b, c] in triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            edges.push(u64::from(*from.min(to)) << 32 | u64::from(*from.max(to)));
        }
    }
    edges.sort_unstable();
    let once = edges.chunk_by(|a, b| a == b).filter(|same| same.len() == 1);
    once.map(|edge| [(edge[0] >> 32) as u32, edge[0] as u32]).collect()
}

/// Which vertices lie on open edges.
fn on_border(triangles: &[[u32; 3]], vertices: usize) -> Vec<bool> {
    let mut on = vec![false; vertices];
    for vertex in open_edges(triangles).into_iter().flatten() {
        on[vertex as usize] = true;
    }
    on
}
