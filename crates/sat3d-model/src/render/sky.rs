//! The sky: a spherical map looked up by direction (MODEL_SPEC section 9.1).

use super::frames::Vector;
use crate::tensor::Grid;

/// What happens where the sky map's azimuths end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SkySeam {
    /// As trained: the first and the last row both stand for west, with a jump between them.
    #[default]
    Raw,
    /// The map is periodic: rows are centred on equal parts of the circle and the last one joins the
    /// first, which moves the sky by at most half a row.
    Wrap,
}

/// A sky map in the order that a lookup reads: the channels of a pixel side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyMap {
    channels: usize,
    rows: usize,
    columns: usize,
    pixels: Vec<f32>,
}

/// Columns of a lookup over all zenith angles whose first `width` are the sky decoder's map, which ends at 100 of
/// 180 degrees (MODEL_SPEC 9.1).
///
/// ```
/// assert_eq!(sat3d_model::render::padded_width(512), 921);
/// // The reference's int(width * 0.8), in whole numbers.
/// assert!((0..5000).all(|w| w + w * 4 / 5 == w + (w as f64 * 0.8) as usize));
/// ```
#[must_use]
pub fn padded_width(width: usize) -> usize {
    width + width * 4 / 5
}

impl SkyMap {
    /// From the sky decoder's output after its sigmoid (`24 x 512 x 512` as released), whose columns cover
    /// zenith angles up to 100 degrees; beyond, towards the nadir, the sky is zero.
    #[must_use]
    pub fn from_decoder(map: &Grid) -> Self {
        Self::with_columns(map, padded_width(map.width))
    }

    /// From a map that covers all zenith angles (`24 x 512 x 921`: the decoder's with its zero
    /// columns already there).
    #[must_use]
    pub fn from_padded(map: &Grid) -> Self {
        Self::with_columns(map, map.width)
    }

    fn with_columns(map: &Grid, columns: usize) -> Self {
        let (channels, rows) = (map.channels, map.height);
        let mut pixels = vec![0.0; channels * rows * columns];
        for channel in 0..channels {
            for (row, values) in map.channel(channel).chunks_exact(map.width).enumerate() {
                for (column, value) in values.iter().enumerate() {
                    pixels[(row * columns + column) * channels + channel] = *value;
                }
            }
        }
        Self { channels, rows, columns, pixels }
    }

    /// Colour channels.
    #[must_use]
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// The sky in a unit direction of the map frame, into `out` (one value a channel, in `[0, 1]`):
    /// columns are zenith angles, rows are azimuths from x (east) towards y (south); bilinear.
    pub fn lookup(&self, [x, y, z]: Vector, seam: SkySeam, out: &mut [f32]) {
        use std::f64::consts::PI;
        out.fill(0.0);
        let column = libm::acos(z.clamp(-1.0, 1.0)) / PI * (self.columns.max(1) - 1) as f64;
        let turn = (libm::atan2(y, x) / PI + 1.0) / 2.0;
        let row = match seam {
            SkySeam::Raw => turn * (self.rows.max(1) - 1) as f64,
            SkySeam::Wrap => turn * self.rows as f64 - 0.5,
        };
        if !(column.is_finite() && row.is_finite()) {
            return;
        }
        for (row, row_weight) in taps(row) {
            let row = match seam {
                SkySeam::Raw if (0..self.rows as i64).contains(&row) => row as usize,
                SkySeam::Raw => continue,
                SkySeam::Wrap => row.rem_euclid(self.rows.max(1) as i64) as usize,
            };
            for (column, weight) in taps(column) {
                if !(0..self.columns as i64).contains(&column) {
                    continue;
                }
                let weight = (row_weight * weight) as f32;
                let first = (row * self.columns + column as usize) * self.channels;
                for (out, value) in out.iter_mut().zip(&self.pixels[first..][..self.channels]) {
                    *out += weight * value;
                }
            }
        }
        for value in out {
            *value = value.clamp(0.0, 1.0);
        }
    }
}

fn taps(index: f64) -> [(i64, f64); 2] {
    let below = index.floor();
    [(below as i64, 1.0 - (index - below)), (below as i64 + 1, index - below)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map() -> SkyMap {
        let (rows, columns) = (8, 10);
        let value = |row: usize, column: usize| (row * 10 + column) as f32 / 100.0;
        let data = (0..rows * columns).map(|k| value(k / columns, k % columns)).collect();
        SkyMap::from_decoder(&Grid::new(1, rows, columns, data))
    }

    fn at(map: &SkyMap, direction: Vector, seam: SkySeam) -> f32 {
        let mut out = [9.0];
        map.lookup(direction, seam, &mut out);
        out[0]
    }

    #[test]
    fn columns_are_zenith_angles_and_rows_azimuths() {
        let map = map();
        assert_eq!(map.columns, 18);
        // Zenith: column 0; azimuth 0 (east): the middle, between rows 3 and 4.
        assert!((at(&map, [0.0, 0.0, 1.0], SkySeam::Raw) - 0.35).abs() < 1e-6);
        // Nadir: no sky.
        assert_eq!(at(&map, [0.0, 0.0, -1.0], SkySeam::Raw), 0.0);
        // South, level: column 8.5, row 0.75 * 7 = 5.25.
        assert!((at(&map, [0.0, 1.0, 0.0], SkySeam::Raw) - (0.525 + 0.085)).abs() < 1e-6);
        // Periodic: row 0.75 * 8 - 0.5 = 5.5.
        assert!((at(&map, [0.0, 1.0, 0.0], SkySeam::Wrap) - (0.55 + 0.085)).abs() < 1e-6);
        assert_eq!(at(&map, [f64::NAN; 3], SkySeam::Raw), 0.0);
    }

    #[test]
    fn only_the_wrapped_seam_is_continuous() {
        let map = map();
        let west = |y: f64, seam| at(&map, [-1.0, y, 0.0], seam);
        let jump = |seam| (west(1e-9, seam) - west(-1e-9, seam)).abs();
        assert!(jump(SkySeam::Raw) > 0.6);
        assert!(jump(SkySeam::Wrap) < 1e-6);
    }
}
