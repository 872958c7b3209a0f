//! A picture of a DSM of any size: heights are averaged while rows come, and hillshaded at the end.

use crate::raster::preview::hillshade_png;

/// Longer side of the picture, pixels, at most.
const LONGEST: u32 = 2048;

/// Averages squares of pixels, those that have a height.
#[derive(Debug)]
pub(super) struct Preview {
    width: usize,
    /// Side of a square, pixels.
    step: usize,
    ground_pixel_m: f64,
    /// Sum and number of the heights of each square of the current row.
    sums: Vec<(f64, u32)>,
    /// Rows in `sums`.
    rows: usize,
    heights: Vec<f32>,
}

impl Preview {
    /// Of a raster of `size` columns and rows whose pixels are `ground_pixel_m` metres wide on the ground.
    pub(super) fn new(size: [u32; 2], ground_pixel_m: f64) -> Self {
        let step = size[0].max(size[1]).div_ceil(LONGEST).max(1);
        Self {
            width: size[0] as usize,
            step: step as usize,
            ground_pixel_m: ground_pixel_m * f64::from(step),
            sums: vec![(0.0, 0); size[0].div_ceil(step) as usize],
            rows: 0,
            heights: Vec::new(),
        }
    }

    /// Takes the next rows, whole ones.
    pub(super) fn add(&mut self, rows: &[f32]) {
        for row in rows.chunks_exact(self.width.max(1)) {
            for (square, (sum, count)) in row.chunks(self.step).zip(&mut self.sums) {
                for height in square.iter().filter(|height| !height.is_nan()) {
                    *sum += f64::from(*height);
                    *count += 1;
                }
            }
            self.rows += 1;
            if self.rows == self.step {
                self.flush();
            }
        }
    }

    fn flush(&mut self) {
        let mean = |(sum, count): &(f64, u32)| match count {
            0 => f32::NAN,
            count => (sum / f64::from(*count)) as f32,
        };
        self.heights.extend(self.sums.iter().map(mean));
        self.sums.fill((0.0, 0));
        self.rows = 0;
    }

    /// The picture as PNG.
    pub(super) fn finish(mut self) -> Vec<u8> {
        if self.rows > 0 {
            self.flush();
        }
        let width = self.sums.len();
        hillshade_png(&self.heights, width, self.heights.len() / width.max(1), self.ground_pixel_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_are_averaged_and_the_last_ones_are_smaller() {
        let mut preview = Preview::new([4100, 4], 0.5);
        assert_eq!((preview.step, preview.ground_pixel_m), (3, 1.5));
        let row: Vec<f32> = (0..4100).map(|x| x as f32).collect();
        (0..3).for_each(|_| preview.add(&row));
        let holes: Vec<f32> = (0..4100).map(|x| if x < 3 { f32::NAN } else { 7.0 }).collect();
        preview.add(&holes);
        preview.flush();
        assert_eq!(preview.heights.len(), 2 * 1367);
        assert_eq!(preview.heights[..2], [1.0, 4.0]);
        // Two columns are left of 4100: 4098 and 4099.
        assert_eq!(preview.heights[1366], 4098.5);
        assert!(preview.heights[1367].is_nan());
        assert_eq!(preview.heights[1368], 7.0);
    }

    #[test]
    fn a_small_raster_is_its_own_picture() {
        let heights: Vec<f32> = (0..35).map(|i| (i * i % 11) as f32).collect();
        let mut preview = Preview::new([7, 5], 0.3);
        heights.chunks(14).for_each(|rows| preview.add(rows));
        assert_eq!(preview.finish(), hillshade_png(&heights, 7, 5, 0.3));
    }
}
