//! A grid of heights in memory.

/// Heights on a pixel grid, row-major, row 0 in the north; NaN is no data.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` heights, metres.
    pub values: Vec<f32>,
}

impl Surface {
    /// A surface of the given size.
    ///
    /// # Panics
    /// When `values` does not hold `width * height` heights.
    #[must_use]
    pub fn new(width: usize, height: usize, values: Vec<f32>) -> Self {
        assert_eq!(values.len(), width * height, "a surface of {width} x {height}");
        Self { width, height, values }
    }

    /// A surface without any height.
    #[must_use]
    pub fn empty(width: usize, height: usize) -> Self {
        Self { width, height, values: vec![f32::NAN; width * height] }
    }

    /// Number of pixels that have a height.
    #[must_use]
    pub fn valid(&self) -> u64 {
        self.values.iter().filter(|v| !v.is_nan()).count() as u64
    }

    /// Columns and rows.
    #[must_use]
    pub const fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }
}
