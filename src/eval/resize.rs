//! Bringing a ground truth to the number of pixels that a prediction has.
//!
//! Both ways lay the two grids over each other so that their outer edges agree.

use super::surface::Surface;
use serde::{Deserialize, Serialize};

/// How a ground truth is resized.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resize {
    /// Bilinear between the centres of the source, without antialiasing, as the reference does
    /// (OpenCV's `INTER_LINEAR`). One tap without data makes the pixel empty.
    #[default]
    Reference,
    /// Mean over the area that a pixel covers, by exact shares. A pixel is empty when less than half
    /// of its area has data.
    Area,
}

/// Resizes a surface; the same size gives a copy.
#[must_use]
pub fn resize(source: &Surface, width: usize, height: usize, how: Resize) -> Surface {
    if source.size() == (width, height) {
        return source.clone();
    }
    match how {
        Resize::Reference => bilinear(source, width, height),
        Resize::Area => area(source, width, height),
    }
}

/// Resizes classes to the class at each pixel's centre.
#[must_use]
pub fn resize_nearest(
    classes: &[u16],
    (source_width, source_height): (usize, usize),
    width: usize,
    height: usize,
) -> Vec<u16> {
    let column = |x: usize| (2 * x + 1) * source_width / (2 * width);
    let columns: Vec<usize> = (0..width).map(column).collect();
    let mut out = Vec::with_capacity(width * height);
    for y in 0..height {
        let row = (2 * y + 1) * source_height / (2 * height);
        let line = &classes[row * source_width..][..source_width];
        out.extend(columns.iter().map(|&x| line[x]));
    }
    out
}

/// The two taps of every target pixel along one axis: the first tap, the second, its weight.
fn taps(source: usize, target: usize) -> Vec<(usize, usize, f32)> {
    let scale = source as f64 / target as f64;
    (0..target)
        .map(|x| {
            // The fraction is rounded to single precision before it is split, as OpenCV does.
            let at = ((x as f64 + 0.5) * scale - 0.5) as f32;
            let first = at.floor();
            if first < 0.0 {
                return (0, 0, 0.0);
            }
            let index = first as usize;
            if index + 1 >= source {
                return (source - 1, source - 1, 0.0);
            }
            (index, index + 1, at - first)
        })
        .collect()
}

fn bilinear(source: &Surface, width: usize, height: usize) -> Surface {
    let columns = taps(source.width, width);
    let mut values = Vec::with_capacity(width * height);
    let mut lines = [vec![0.0_f32; width], vec![0.0_f32; width]];
    let mut rows_of = [usize::MAX; 2];
    let fill = |line: &mut Vec<f32>, row: usize| {
        let from = &source.values[row * source.width..][..source.width];
        for (value, &(a, b, weight)) in line.iter_mut().zip(&columns) {
            // In this form, across and then down, it is OpenCV's to the bit: the height of a peak in the
            // phase correlation can hang on the last digit.
            *value = from[a] + (from[b] - from[a]) * weight;
        }
    };
    for (top, bottom, weight) in taps(source.height, height) {
        for (k, row) in [top, bottom].into_iter().enumerate() {
            if rows_of[k] != row {
                fill(&mut lines[k], row);
                rows_of[k] = row;
            }
        }
        let [upper, lower] = &lines;
        values.extend(upper.iter().zip(lower).map(|(&u, &l)| u + (l - u) * weight));
    }
    Surface::new(width, height, values)
}

/// The source pixels that a target pixel covers along one axis, and how much of each, in units of
/// `1 / target` source pixels: whole numbers, so that shares are exact.
fn spans(source: usize, target: usize) -> Vec<(usize, Vec<u32>)> {
    (0..target)
        .map(|x| {
            let (from, to) = (x * source, (x + 1) * source);
            let first = from / target;
            let last = (to - 1) / target;
            let shares = (first..=last)
                .map(|cell| (to.min((cell + 1) * target) - from.max(cell * target)) as u32)
                .collect();
            (first, shares)
        })
        .collect()
}

fn area(source: &Surface, width: usize, height: usize) -> Surface {
    let columns = spans(source.width, width);
    let rows = spans(source.height, height);
    // A pixel covers `source.width` by `source.height` units in all.
    let half = source.width as f64 * source.height as f64 / 2.0;
    let mut values = Vec::with_capacity(width * height);
    for (top, heights) in &rows {
        for (left, widths) in &columns {
            let (mut sum, mut covered) = (0.0_f64, 0.0_f64);
            for (k, &tall) in heights.iter().enumerate() {
                let line = &source.values[(top + k) * source.width + left..][..widths.len()];
                for (&value, &wide) in line.iter().zip(widths) {
                    if !value.is_nan() {
                        let share = f64::from(tall) * f64::from(wide);
                        sum += share * f64::from(value);
                        covered += share;
                    }
                }
            }
            values.push(if covered >= half { (sum / covered) as f32 } else { f32::NAN });
        }
    }
    Surface::new(width, height, values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ramp(width: usize, height: usize) -> Surface {
        let at = |k: usize| (k % width) as f32 * 0.5 + (k / width) as f32 * 2.0;
        Surface::new(width, height, (0..width * height).map(at).collect())
    }

    #[test]
    fn bilinear_is_what_opencv_gives() {
        // cv2.resize(numpy.arange(20, dtype="float32").reshape(4, 5) ** 2, (3, 2)), OpenCV 5.0
        let source = Surface::new(5, 4, (0..20).map(|k| (k * k) as f32).collect());
        let resized = bilinear(&source, 3, 2);
        let expected = [14.5, 26.5, 44.5, 171.166_66, 216.5, 267.833_3];
        for (value, expected) in resized.values.iter().zip(expected) {
            assert!((value - expected).abs() < 1e-4, "{:?}", resized.values);
        }
    }

    #[test]
    fn enlarging_repeats_the_border_and_keeps_a_ramp_inside() {
        let resized = bilinear(&ramp(4, 3), 8, 6);
        // Target centre 3 lies at source coordinate 1.25, row 2 at 0.75.
        assert!((resized.values[2 * 8 + 3] - (1.25 * 0.5 + 0.75 * 2.0)).abs() < 1e-6);
        assert_eq!(resized.values[0], 0.0);
        assert_eq!(resized.values[5 * 8 + 7], 3.0 * 0.5 + 2.0 * 2.0);
    }

    #[test]
    fn a_hole_empties_what_touches_it_and_under_half_of_the_area_is_no_height() {
        let mut source = ramp(10, 10);
        source.values[0] = f32::NAN;
        assert!(bilinear(&source, 4, 4).values[0].is_nan());
        // Pixel (0, 0) of four covers 2.5 x 2.5 cells; one of them is empty.
        let kept = area(&source, 4, 4).values[0];
        let cells = [
            (0.5, 1.0),
            (1.0, 0.5),
            (2.0, 1.0),
            (2.5, 1.0),
            (3.0, 0.5),
            (4.0, 0.5),
            (4.5, 0.5),
            (5.0, 0.25),
        ];
        let (sum, share) = cells.iter().fold((0.0, 0.0), |(s, w), (v, k)| (s + v * k, w + k));
        assert!((f64::from(kept) - sum / share).abs() < 1e-6, "{kept}");
        for k in [1, 10, 11, 2, 12] {
            source.values[k] = f32::NAN;
        }
        assert!(area(&source, 4, 4).values[0].is_nan());
    }

    #[test]
    fn one_pixel_and_the_same_size_are_no_special_cases() {
        let one = Surface::new(1, 1, vec![7.5]);
        for how in [Resize::Reference, Resize::Area] {
            assert_eq!(resize(&one, 1, 1, how), one);
            assert!(resize(&one, 3, 2, how).values.iter().all(|&v| v == 7.5));
            let whole = resize(&ramp(5, 5), 1, 1, how).values[0];
            assert!((whole - 5.0).abs() < 1e-6, "{whole}");
        }
    }

    #[test]
    fn classes_take_the_pixel_at_the_centre() {
        assert_eq!(resize_nearest(&[1, 2, 3, 4], (2, 2), 1, 1), [4]);
        assert_eq!(resize_nearest(&[1, 2, 3, 4], (4, 1), 2, 1), [2, 4]);
        assert_eq!(resize_nearest(&[1, 2], (2, 1), 4, 1), [1, 1, 2, 2]);
    }

    proptest! {
        /// The mean over all of the area does not change.
        #[test]
        fn area_keeps_the_mean(
            (w, h) in (1_usize..23, 1_usize..23), (tw, th) in (1_usize..23, 1_usize..23), seed: u64,
        ) {
            let value = |k: u64| (crate::random::unit(crate::random::mix(seed ^ k)) * 100.0) as f32;
            let source = Surface::new(w, h, (0..(w * h) as u64).map(value).collect());
            let mean = |s: &Surface| {
                s.values.iter().map(|&v| f64::from(v)).sum::<f64>() / s.values.len() as f64
            };
            prop_assert!((mean(&source) - mean(&area(&source, tw, th))).abs() < 1e-4);
        }
    }
}
