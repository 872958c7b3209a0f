//! Fewer triangles, within an error in metres that is measured and not only estimated.
//!
//! The triangles are chosen by meshoptimizer's edge collapses with quadrics (Garland and Heckbert 1997), in its Rust
//! version. Its own error is a mean over planes, weighted by area, which the largest distance
//! exceeds. So the two-sided distance between both surfaces is measured afterwards ([`distance_m`](super::distance::distance_m)), that
//! is what is stated, and a result beyond the wanted error is made again with the vertices locked at which it was.

use super::MeshTile;
use super::distance::Original;
use meshoptimizer_rs::{
    Attributes, Error, Limits, Positions, SimplifyOptions, SimplifySettings, VertexFlags,
    Workspace, simplify_with_attributes,
};

/// How far to simplify. Of two limits the one that is reached first ends it; without any the mesh stays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Target {
    /// Largest distance between the surfaces, metres.
    pub error_m: Option<f64>,
    /// Number of triangles to come down to. More remain where the surface's holes or a locked border do
    /// not let it.
    pub triangles: Option<usize>,
}

/// Why a mesh is not simplified.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimplifyError {
    /// The error is no length.
    #[error("a simplification error of {0} m; it must be a number above 0")]
    ErrorM(f64),
    /// The library refuses the mesh.
    #[error("simplifying a mesh of {vertices} vertices and {triangles} triangles: {source}")]
    Library {
        /// Number of vertices.
        vertices: usize,
        /// Number of triangles.
        triangles: usize,
        /// What it says.
        source: Error,
    },
}

/// Share of the wanted error that is asked of the library: its mean over planes is less than the largest
/// distance. With a fifth most tiles are within the error at once, and those that have to be made again have fewer
/// triangles than with more or less (`docs/tile-mesh.md`).
const ASKED: f64 = 0.2;

/// How often it is tried, the vertices locked that were too far off.
const TRIES: usize = 5;

/// How often then, with ever smaller limits too.
const SMALLER_TRIES: usize = 2;

/// Share of the last limit that is tried next.
const NEXT: f64 = 0.25;

/// An error that nothing reaches, metres; its square is still far from the largest 32-bit float.
const NONE_M: f64 = 1e9;

/// Simplifies a mesh whose vertices are in metres. With `lock_border` vertices on open edges stay and so do
/// the edges. The vertices that remain are some of the mesh's, with their bits and in their order.
/// Beside the mesh: the two-sided distance to the one given, metres, as
/// [`distance_m`](super::distance::distance_m) measures it.
///
/// # Errors
/// [`SimplifyError`]; coordinates that are not finite are one.
pub fn simplify(
    mesh: &MeshTile,
    target: Target,
    lock_border: bool,
) -> Result<(MeshTile, f64), SimplifyError> {
    simplify_placed(mesh, |vertex| vertex, target, lock_border)
}

/// [`simplify`] for a mesh in other coordinates, which the result keeps; `place` says where in metres a vertex
/// lies.
///
/// # Errors
/// [`SimplifyError`].
pub fn simplify_placed(
    mesh: &MeshTile,
    place: impl Fn([f64; 3]) -> [f64; 3],
    target: Target,
    lock_border: bool,
) -> Result<(MeshTile, f64), SimplifyError> {
    if let Some(error_m) = target.error_m
        && !(error_m > 0.0 && error_m.is_finite())
    {
        return Err(SimplifyError::ErrorM(error_m));
    }
    let enough = target.triangles.is_some_and(|most| mesh.triangles.len() <= most);
    if mesh.triangles.is_empty() || target == Target::default() || enough {
        return Ok((mesh.clone(), 0.0));
    }
    let metres: Vec<[f64; 3]> = mesh.vertices.iter().map(|vertex| place(*vertex)).collect();
    let local = around_middle(&metres);
    let mut limit_m = target.error_m.map_or(NONE_M, |error_m| error_m * ASKED);
    let most_m = target.error_m.unwrap_or(f64::INFINITY);
    let mut flags = vec![VertexFlags::EMPTY; mesh.vertices.len()];
    let original = Original::new(&metres, &mesh.triangles);
    for attempt in 1..=TRIES + SMALLER_TRIES {
        let triangles = collapse(&local, mesh, target.triangles, limit_m, lock_border, &flags)?;
        match original.distance_within(&triangles, most_m) {
            Ok(found_m) => return Ok((compact(mesh, &triangles), found_m)),
            Err(far) => lock_around(&far, mesh, &mut flags),
        }
        if attempt >= TRIES {
            limit_m *= NEXT;
        }
    }
    Ok((mesh.clone(), 0.0))
}

/// Locks vertices and their neighbours.
fn lock_around(far: &[u32], mesh: &MeshTile, flags: &mut [VertexFlags]) {
    let mut near = vec![false; flags.len()];
    for vertex in far {
        near[*vertex as usize] = true;
    }
    for corners in &mesh.triangles {
        if corners.iter().any(|corner| near[*corner as usize]) {
            for corner in corners {
                flags[*corner as usize] = VertexFlags::LOCK;
            }
        }
    }
}

/// 32-bit positions around the middle of the mesh's box.
fn around_middle(metres: &[[f64; 3]]) -> Vec<[f32; 3]> {
    let mut ends = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for vertex in metres {
        for k in 0..3 {
            ends[0][k] = ends[0][k].min(vertex[k]);
            ends[1][k] = ends[1][k].max(vertex[k]);
        }
    }
    let middle = [0, 1, 2].map(|k| (ends[0][k] + ends[1][k]) / 2.0);
    metres.iter().map(|vertex| [0, 1, 2].map(|k| (vertex[k] - middle[k]) as f32)).collect()
}

fn collapse(
    positions: &[[f32; 3]],
    mesh: &MeshTile,
    triangles: Option<usize>,
    limit_m: f64,
    lock_border: bool,
    flags: &[VertexFlags],
) -> Result<Vec<[u32; 3]>, SimplifyError> {
    let mut options = SimplifyOptions::ERROR_ABSOLUTE;
    if lock_border {
        options |= SimplifyOptions::LOCK_BORDER;
    }
    let settings = SimplifySettings {
        target_index_count: 3 * triangles.unwrap_or(0).min(mesh.triangles.len()),
        target_error: limit_m as f32,
        options,
    };
    // The caller's meshes are bounded; the library's own bounds are for files from strangers.
    let mut workspace = Workspace::new(Limits { max_bytes: usize::MAX, max_work: u64::MAX });
    // No attributes: only this form takes flags of vertices.
    let kept = Attributes::from_interleaved(&[], mesh.vertices.len(), 0, 0, 0).and_then(|none| {
        let positions = Positions::from_packed(positions);
        let indices = mesh.triangles.as_flattened();
        simplify_with_attributes(
            indices,
            positions,
            none,
            &[],
            Some(flags),
            settings,
            &mut workspace,
        )
    });
    let kept = kept.map_err(|source| SimplifyError::Library {
        vertices: mesh.vertices.len(),
        triangles: mesh.triangles.len(),
        source,
    })?;
    Ok(kept.indices.as_chunks::<3>().0.to_vec())
}

/// The triangles with the vertices that they use, in the order of the mesh.
fn compact(mesh: &MeshTile, triangles: &[[u32; 3]]) -> MeshTile {
    let mut numbers = vec![u32::MAX; mesh.vertices.len()];
    for corner in triangles.iter().flatten() {
        numbers[*corner as usize] = 0;
    }
    let mut vertices = Vec::new();
    for (number, vertex) in numbers.iter_mut().zip(&mesh.vertices) {
        if *number == 0 {
            // No more than the mesh has, which 32 bits number.
            *number = vertices.len() as u32;
            vertices.push(*vertex);
        }
    }
    let triangles = triangles.iter().map(|corners| corners.map(|c| numbers[c as usize])).collect();
    MeshTile { vertices, triangles }
}
