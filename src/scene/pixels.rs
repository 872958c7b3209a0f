//! Where the pixels of a satellite image lie in the local frame.

use super::error::SceneError;
use super::frame::Frame;
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use crate::plan::runs;
use rayon::prelude::*;
use std::ops::Range;

/// Local positions of the pixel centres of an image, or of a window of one, and of a margin around it.
#[derive(Clone, Debug)]
pub struct PixelPositions {
    width: usize,
    height: usize,
    margin: usize,
    at: Vec<[f64; 2]>,
}

impl PixelPositions {
    /// Projects every pixel centre of an image, and `margin` pixels more on each side.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection is undefined.
    pub fn new(grid: &ImageGrid, frame: &Frame, margin: usize) -> Result<Self, SceneError> {
        let window = [0..grid.width(), 0..grid.height()];
        Self::of_window(&window, frame, margin, |p| grid.lonlat(p))
    }

    /// Projects the pixel centres of a window (columns, rows) of a grid, and `margin` pixels more on each
    /// side; `lonlat` is where a pixel coordinate of the grid lies.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the projection is undefined.
    pub fn of_window(
        [columns, rows]: &[Range<u32>; 2],
        frame: &Frame,
        margin: usize,
        lonlat: impl Fn(PixelPoint) -> LonLat + Sync,
    ) -> Result<Self, SceneError> {
        runs("projection");
        let (width, height) = (columns.len() + 2 * margin, rows.len() + 2 * margin);
        let (west, north) =
            (f64::from(columns.start) - margin as f64, f64::from(rows.start) - margin as f64);
        let mut at = vec![[0.0; 2]; width * height];
        at.par_chunks_mut(width).enumerate().try_for_each(|(row, out)| {
            let y = north + row as f64 + 0.5;
            for (column, place) in out.iter_mut().enumerate() {
                let x = west + column as f64 + 0.5;
                *place = frame.to_local(lonlat(PixelPoint { x, y }))?;
            }
            Ok::<(), SceneError>(())
        })?;
        Ok(Self { width, height, margin, at })
    }

    /// Pixel centres of a square of `side` pixels and `metres` ground metres, true north up, its middle so
    /// many ground metres east and north of the frame's origin. The projection is taken as affine, which
    /// over 130 m it is to 1 mm.
    #[must_use]
    pub fn square(frame: &Frame, side: usize, middle: [f64; 2], metres: f64) -> Self {
        let step = metres / side.max(1) as f64;
        let half = side as f64 / 2.0;
        let at = (0..side * side)
            .map(|i| {
                let east = middle[0] + ((i % side) as f64 + 0.5 - half) * step;
                let north = middle[1] + (half - (i / side) as f64 - 0.5) * step;
                frame.from_ground([east, north])
            })
            .collect();
        Self { width: side, height: side, margin: 0, at }
    }

    /// Columns and rows, with the margins.
    #[must_use]
    pub const fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Pixels of margin on each side.
    #[must_use]
    pub const fn margin(&self) -> usize {
        self.margin
    }

    /// A row of positions, margins included; row 0 is the northernmost of the margin.
    #[must_use]
    pub fn row(&self, row: usize) -> &[[f64; 2]] {
        &self.at[row * self.width..(row + 1) * self.width]
    }

    /// Steps from a pixel to its right and to its lower neighbour in the middle, metres: within an image
    /// the grid is affine to 0.2 mm. There have to be two columns and rows, margins included.
    #[must_use]
    pub fn steps(&self) -> [[f64; 2]; 2] {
        let [column, row] = self.size().map(|n| n / 2);
        let here = self.row(row)[column];
        let (right, below) = (self.row(row)[column - 1], self.row(row - 1)[column]);
        [[here[0] - right[0], here[1] - right[1]], [here[0] - below[0], here[1] - below[1]]]
    }
}
