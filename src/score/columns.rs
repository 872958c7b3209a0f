//! What stands in each column of the pixel lattice: the mesh's top, and floaters.
//!
//! The mesh of [`Scene::mesh`](crate::model::Scene::mesh) on the pixel lattice has a vertex wherever a column
//! goes from inside to outside, and columns are pixel centres: a vertical ray through a pixel's centre meets the
//! mesh at these vertices and nowhere else. So its top is the column's highest crossing, placed as the mesh
//! places vertices, and no triangles are needed. Tests hold this against rays through a mesh's triangles.
//!
//! Below the centre of the lowest texel of its line a field fades away by construction, so that the lowest level
//! may be empty under solid ground. That is no gap: nothing can be seen there.

use crate::model::Scene;
use crate::model::mesh::CLAMP;
use crate::model::render::{DensityGrid, Lattice, density_grid};

/// What was found in the columns of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Columns {
    /// Height of the mesh's top in each column, metres over the cube's bottom, rows from the north; 0 where
    /// nothing stands in the column: a hole in the mesh is an error and no gap in the data.
    pub top_m: Vec<f32>,
    /// Columns in which nothing stands.
    pub holes: u64,
    /// Columns in which something stands over an empty cell.
    pub floaters: u64,
}

/// Columns of a scene at the centres of `size x size` pixels of its crop, with levels of about the same pitch:
/// the mesh's lattice. One cube unit is `metres_per_unit` metres high.
#[must_use]
pub fn of_scene(scene: &Scene, size: usize, isovalue: f32, metres_per_unit: f64) -> Columns {
    let field = scene.field();
    let grid = density_grid(field, Lattice::pixels(size, field.scale()));
    let lowest_texel = 1.0 / scene.parts().inputs.map.width as f64 - 1.0;
    of_grid(&grid, isovalue, metres_per_unit, lowest_texel)
}

/// Columns of a grid of densities. A point is inside where its density is at least `isovalue`, as for the
/// mesh; NaN is outside. What is empty below `lowest` (z) is no gap.
#[must_use]
pub fn of_grid(grid: &DensityGrid, isovalue: f32, metres_per_unit: f64, lowest: f64) -> Columns {
    let [across, down, levels] = grid.shape();
    let heights: Vec<f64> = grid.lattice.z.iter().map(|z| f64::from(*z)).collect();
    // Levels that stand at that height but for rounding are not below it.
    let rim = heights.partition_point(|z| *z < lowest - 1e-6);
    let mut found = Columns { top_m: Vec::with_capacity(across * down), holes: 0, floaters: 0 };
    for row in 0..down {
        for column in 0..across {
            let values = &grid.values[(column * down + row) * levels..][..levels];
            let inside = |value: f32| value >= isovalue;
            match values.iter().rposition(|value| inside(*value)) {
                Some(top) => {
                    let z = crossing(values, &heights, top, isovalue);
                    found.top_m.push(((z + 1.0) * metres_per_unit) as f32);
                    found.floaters +=
                        u64::from(values[rim.min(top)..top].iter().any(|v| !inside(*v)));
                }
                None => {
                    found.top_m.push(0.0);
                    found.holes += 1;
                }
            }
        }
    }
    found
}

/// z of the mesh's vertex over the point `top`, above which all is outside: up to the next point, or to the
/// cube's top.
fn crossing(values: &[f32], heights: &[f64], top: usize, isovalue: f32) -> f64 {
    let (low, high) = (heights[top], heights.get(top + 1).copied().unwrap_or(1.0));
    let share = match values.get(top + 1) {
        Some(above) if above.is_finite() && values[top].is_finite() => {
            let (below, above) = (f64::from(values[top]), f64::from(*above));
            (f64::from(isovalue) - below) / (above - below)
        }
        _ => 1.0,
    };
    low + (high - low) * share.clamp(CLAMP, 1.0 - CLAMP)
}

#[cfg(test)]
#[path = "columns_tests.rs"]
mod tests;
