//! The DSM's rule: one integral over the averaged column.
//!
//! Light comes from straight above. Level k fills a cell that reaches half-way to its neighbours (the
//! outer ones to [`Levels::ends`]) with its density, in cube units. What ends in a cell, and where on
//! average, is exact for that piecewise constant medium: with the optical depth t of a cell and T of all
//! above it, the share exp(-T) (1 - exp(-t)). The height is the expected height of the end, divided by
//! the column's opacity; a column of an opacity under 0.05 has no surface.
//! This is the stable rule of `sat3d infer` on fixed cells.

use super::city::{City, Levels};
use crate::model::render::LEAST_OPACITY;
use crate::model::render::quadrature::{CellRoom, cells};
use crate::plan::runs;
use pulp::Arch;
use rayon::prelude::*;

/// Columns that one thread integrates at a time.
const BATCH: usize = 64;

/// Integrates columns of one city.
#[derive(Clone, Debug)]
pub struct ColumnIntegral {
    arch: Arch,
    /// Ends of the cells as distances from the top, ascending.
    edges: Vec<f64>,
    top: f64,
    metres_per_unit: f64,
}

impl ColumnIntegral {
    /// For the levels and the scale of a city.
    #[must_use]
    pub fn new(city: &City) -> Self {
        let Levels { z, ends: [bottom, top] } = &city.levels;
        let middles = z.windows(2).map(|pair| 0.5 * (f64::from(pair[0]) + f64::from(pair[1])));
        let ascending: Vec<f64> = std::iter::once(*bottom).chain(middles).chain([*top]).collect();
        let edges = ascending.iter().rev().map(|z| top - z).collect();
        Self { arch: Arch::new(), edges, top: *top, metres_per_unit: city.vertical_m }
    }

    /// Heights of a line's columns, metres above the bottom of the cube; NaN where no surface was met or
    /// a density is NaN.
    #[must_use]
    pub fn heights(&self, densities: &[f32]) -> Vec<f32> {
        runs("column-integral");
        runs("vertical-scale");
        let levels = self.edges.len() - 1;
        let columns: Vec<&[f32]> = densities.chunks_exact(levels).collect();
        columns
            .par_chunks(BATCH)
            .flat_map_iter(|columns| {
                let (mut room, mut weights, mut sigma) =
                    (CellRoom::default(), Vec::new(), Vec::new());
                let mut height = |column: &&[f32]| {
                    if column[0].is_nan() {
                        return f32::NAN;
                    }
                    sigma.clear();
                    sigma.extend(column.iter().rev());
                    let hit = cells(self.arch, &self.edges, &sigma, &mut room, &mut weights);
                    if hit.opacity < LEAST_OPACITY {
                        return f32::NAN;
                    }
                    ((self.top - hit.mean() + 1.0) * self.metres_per_unit) as f32
                };
                columns.iter().map(&mut height).collect::<Vec<_>>()
            })
            .collect()
    }
}
