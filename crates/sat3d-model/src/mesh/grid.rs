//! Marching cubes over a whole grid, on all cores.

use super::layers::{Axis, LayerMesher, Surface};
use super::{MeshError, SurfaceSink};
use rayon::prelude::*;

/// Layers that one thread meshes at a time. Fixed, though the result does not depend on it.
const LAYERS: usize = 8;

/// The closed surface of a grid, `values[(i * axes[1].len() + j) * axes[2].len() + k]`: a point is inside
/// where its value is at least the isovalue. What [`LayerMesher`] gives, on all cores.
///
/// # Errors
/// [`MeshError::Isovalue`], [`MeshError::Layer`] where there are more or fewer values than points,
/// [`MeshError::TooManyVertices`].
pub fn mesh_grid<V: Copy + Into<f64> + Send + Sync>(
    axes: &[Axis; 3],
    values: &[V],
    isovalue: f64,
) -> Result<Surface, MeshError> {
    let [layers, rows, columns] = axes;
    let size = rows.len() * columns.len();
    if values.len() != size * layers.len() {
        return Err(MeshError::Layer { found: values.len(), expected: size * layers.len() });
    }
    let at = layers.with_closing_planes();
    let layer = |index: usize| &values[(index - 1) * size..][..size];
    // Layer 0 closes the mesh before the grid, layer `layers.len() + 1` behind it.
    let chunks: Vec<usize> = (0..=layers.len()).step_by(LAYERS).collect();
    let parts: Result<Vec<Part>, MeshError> = chunks
        .into_par_iter()
        .map(|first| {
            let mut mesher = LayerMesher::new(at[0], rows.clone(), columns.clone(), isovalue)?;
            if first > 0 {
                mesher.prime(at[first], layer(first));
            }
            let mut part = Part { before: mesher.vertices(), surface: Surface::default() };
            for (index, at) in (first + 1..).zip(&at[first + 1..]).take(LAYERS) {
                if index <= layers.len() {
                    mesher.push(*at, layer(index), &mut part.surface)?;
                } else {
                    mesher.finish(*at, &mut part.surface)?;
                }
            }
            Ok(part)
        })
        .collect();
    join(parts?)
}

/// What one thread made.
struct Part {
    /// Vertices of the part before that it refers to: that one's last. They have the numbers from 0.
    before: u64,
    surface: Surface,
}

fn join(parts: Vec<Part>) -> Result<Surface, MeshError> {
    let vertices: usize = parts.iter().map(|part| part.surface.vertices.len()).sum();
    if vertices as u64 > u64::from(u32::MAX) {
        return Err(MeshError::TooManyVertices(vertices as u64));
    }
    let triangles = parts.iter().map(|part| part.surface.triangles.len()).sum();
    let mut all = Surface {
        vertices: Vec::with_capacity(vertices),
        triangles: Vec::with_capacity(triangles),
    };
    for part in parts {
        // Below 2^32, as checked; the vertices before are among those that are there already.
        let shift = (all.vertices.len() as u64 - part.before) as u32;
        all.vertices.extend_from_slice(&part.surface.vertices);
        for corners in part.surface.triangles {
            all.triangle(corners.map(|corner| corner + shift));
        }
    }
    Ok(all)
}
