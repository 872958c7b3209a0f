//! A plain image-like tensor: what the network hands to the field and the renderer back to it.

/// `channels x height x width` values, row-major, the last axis fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Channels, slowest.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// `channels * height * width` values.
    pub data: Vec<f32>,
}

impl Grid {
    /// A grid of the given shape.
    ///
    /// # Panics
    /// When `data` does not hold `channels * height * width` values.
    #[must_use]
    pub fn new(channels: usize, height: usize, width: usize, data: Vec<f32>) -> Self {
        assert_eq!(
            data.len(),
            channels * height * width,
            "a grid of {channels} x {height} x {width}"
        );
        Self { channels, height, width, data }
    }

    /// One channel, row-major.
    #[must_use]
    pub fn channel(&self, channel: usize) -> &[f32] {
        let size = self.height * self.width;
        &self.data[channel * size..][..size]
    }
}
