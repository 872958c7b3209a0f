//! Tiles that become one mesh again.

use super::MeshTile;
use std::collections::HashMap;

/// Numbers the vertices of several meshes as those of one: vertices on open edges that have the same bits
/// become one. All others stay as they are, in the order in which they come.
#[derive(Debug, Default)]
pub struct Welder {
    count: u32,
    /// Numbers of the vertices on open edges. Only looked up, so its order does not matter.
    border: HashMap<[u64; 3], u32>,
}

impl Welder {
    /// The number in the whole of each vertex of the next mesh, and of each whether it is new: new ones have the
    /// numbers that follow. All together have fewer than 2^32 vertices.
    pub fn number(&mut self, tile: &MeshTile) -> Vec<(u32, bool)> {
        let open = on_border(&tile.triangles, tile.vertices.len());
        let vertices = tile.vertices.iter().zip(open);
        vertices
            .map(|(vertex, open)| {
                let next = self.count;
                let number = if open {
                    *self.border.entry(vertex.map(f64::to_bits)).or_insert(next)
                } else {
                    next
                };
                self.count += u32::from(number == next);
                (number, number == next)
            })
            .collect()
    }
}

/// One mesh of several, in their order.
#[must_use]
pub fn weld<'a>(tiles: impl IntoIterator<Item = &'a MeshTile>) -> MeshTile {
    let mut welder = Welder::default();
    let mut mesh = MeshTile::default();
    for tile in tiles {
        let numbers = welder.number(tile);
        let new = tile.vertices.iter().zip(&numbers).filter(|(_, (_, new))| *new);
        mesh.vertices.extend(new.map(|(vertex, _)| *vertex));
        let corners = tile.triangles.iter();
        mesh.triangles.extend(corners.map(|c| c.map(|corner| numbers[corner as usize].0)));
    }
    mesh
}

/// Edges that have not as many triangles on one side as on the other, lower corner first, ascending; of fewer than
/// 2^31 vertices. (Simplified noise may join sheets in one edge: four triangles, and still no hole.)
#[must_use]
pub fn open_edges(triangles: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let mut edges: Vec<u64> = Vec::with_capacity(3 * triangles.len());
    for [a, b, c] in triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let (low, high) = (u64::from(*from.min(to)), u64::from(*from.max(to)));
            edges.push(low << 32 | high << 1 | u64::from(from < to));
        }
    }
    edges.sort_unstable();
    let same = edges.chunk_by(|a, b| a >> 1 == b >> 1);
    let open =
        same.filter(|same| 2 * same.iter().filter(|edge| *edge & 1 == 1).count() != same.len());
    open.map(|edge| [(edge[0] >> 32) as u32, (edge[0] as u32) >> 1]).collect()
}

/// Which vertices lie on open edges.
fn on_border(triangles: &[[u32; 3]], vertices: usize) -> Vec<bool> {
    let mut on = vec![false; vertices];
    for vertex in open_edges(triangles).into_iter().flatten() {
        on[vertex as usize] = true;
    }
    on
}
