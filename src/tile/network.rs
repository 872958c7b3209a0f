//! Windows through the network.

use super::city::Levels;
use super::engine::{WindowModel, WindowSource};
use super::layout::WINDOW;
use super::spool::Spool;
use crate::model::field::Field;
use crate::model::render::{
    Border, DensityGrid, Lattice, ReferenceGrid, density_grid, exact_scale, reference_grid,
};
use crate::model::{Image8, Model};
use crate::plan::runs;
use serde::{Deserialize, Serialize};
use std::io;
use std::ops::Range;

/// Points along each axis of the released grid.
const REFERENCE_COUNT: usize = 320;

/// Where densities are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileLattice {
    /// At the centres of the model's pixels, over the cube's whole height: 256 x 256 x 320 points a window.
    #[default]
    Pixels,
    /// The released grid without its border, 256 x 256 x 288 points, as the reference stacks them: its columns
    /// drift by up to one voxel from the pixels that they are taken for.
    Reference,
}

impl TileLattice {
    /// `pixels` or `reference`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pixels => "pixels",
            Self::Reference => "reference",
        }
    }

    /// Levels for a network whose crop fills `[-scale, scale]`.
    ///
    /// # Errors
    /// In words, where the released grid without its border is not as wide as a window.
    pub fn levels(self, scale: f64) -> Result<Levels, String> {
        match self {
            Self::Pixels => {
                let z = Lattice::pixels(WINDOW as usize, scale as f32).z;
                Ok(Levels { z, ends: [-1.0, 1.0] })
            }
            Self::Reference => {
                let grid = released();
                let border = grid.border_width(scale as f32);
                if grid.count - 2 * border != WINDOW as usize {
                    return Err(format!(
                        "--lattice reference: of {} points across, a scale of {scale} leaves {}, and a window has \
                         {WINDOW}; use --lattice pixels",
                        grid.count,
                        grid.count - 2 * border
                    ));
                }
                // As `reference_grid` has them.
                let step = (2.0 / (grid.count as f64 - 1.0)) as f32;
                let z: Vec<f32> = (border..grid.count).map(|k| k as f32 * step - 1.0).collect();
                let half = f64::from(step) / 2.0;
                let ends = [f64::from(z[0]) - half, f64::from(z[z.len() - 1]) + half];
                Ok(Levels { z, ends })
            }
        }
    }
}

const fn released() -> ReferenceGrid {
    ReferenceGrid { count: REFERENCE_COUNT, border: Border::Cut }
}

/// The network as a [`WindowModel`].
#[derive(Debug)]
pub struct NetworkWindows<'a> {
    /// The network.
    pub model: &'a Model,
    /// Where densities are taken.
    pub lattice: TileLattice,
}

impl WindowModel for NetworkWindows<'_> {
    fn densities(&self, picture: &Image8, _start: [i64; 2]) -> Result<DensityGrid, String> {
        runs("network");
        runs("precision");
        let inputs = self.model.field_inputs(picture).map_err(|error| error.to_string())?;
        let field =
            Field::new(&inputs, &self.model.head, None).map_err(|error| error.to_string())?;
        runs("densities");
        Ok(match self.lattice {
            TileLattice::Pixels => {
                let scale = exact_scale(field.scale()) as f32;
                density_grid(&field, Lattice::pixels(WINDOW as usize, scale))
            }
            TileLattice::Reference => reference_grid(&field, &released()),
        })
    }
}

impl WindowSource for Spool {
    fn window(&self, x: i64, y: i64) -> io::Result<(Image8, Vec<bool>)> {
        Self::window(self, x, y, WINDOW)
    }

    fn valid(&self, rectangle: [Range<u32>; 2]) -> io::Result<Option<Vec<bool>>> {
        let (_, valid) = self.rectangle(rectangle)?;
        Ok(valid.contains(&false).then_some(valid))
    }
}
