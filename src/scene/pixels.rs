//! Where the pixels of a satellite image lie in the local frame.

use super::error::SceneError;
use super::frame::Frame;
use crate::grid::{ImageGrid, PixelPoint};
use rayon::prelude::*;

/// Local positions of the pixel centres of an image and of a margin around it.
#[derive(Clone, Debug)]
pub struct PixelPositions {
    side: usize,
    margin: usize,
    at: Vec<[f64; 2]>,
}

impl PixelPositions {
    /// Projects every pixel centre of a square image, and `margin` pixels more on each side.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection is undefined.
    pub fn new(grid: &ImageGrid, frame: &Frame, margin: usize) -> Result<Self, SceneError> {
        let size = grid.width() as usize;
        let side = size + 2 * margin;
        let mut at = vec![[0.0; 2]; side * side];
        at.par_chunks_mut(side).enumerate().try_for_each(|(row, out)| {
            let y = row as f64 - margin as f64 + 0.5;
            for (column, place) in out.iter_mut().enumerate() {
                let x = column as f64 - margin as f64 + 0.5;
                *place = frame.to_local(grid.lonlat(PixelPoint { x, y }))?;
            }
            Ok::<(), SceneError>(())
        })?;
        Ok(Self { side, margin, at })
    }

    /// Pixels along a side, with the margins.
    #[must_use]
    pub const fn side(&self) -> usize {
        self.side
    }

    /// Pixels of margin on each side.
    #[must_use]
    pub const fn margin(&self) -> usize {
        self.margin
    }

    /// A row of positions, margins included; row 0 is the northernmost of the margin.
    #[must_use]
    pub fn row(&self, row: usize) -> &[[f64; 2]] {
        &self.at[row * self.side..(row + 1) * self.side]
    }

    /// Steps from a pixel to its right and to its lower neighbour in the middle of the image,
    /// metres: within an image the grid is affine to 0.2 mm.
    #[must_use]
    pub fn steps(&self) -> [[f64; 2]; 2] {
        let middle = self.side / 2;
        let here = self.row(middle)[middle];
        let (right, below) = (self.row(middle)[middle - 1], self.row(middle - 1)[middle]);
        [[here[0] - right[0], here[1] - right[1]], [here[0] - below[0], here[1] - below[1]]]
    }
}
