//! Slope after Horn: the gradient from the eight neighbours, those beside the pixel counting twice.

use super::super::surface::Surface;
use super::{NO_CLASS, bin};

/// The bin of each pixel; `limits` are squared tangents, so that no arc tangent is needed.
pub(super) fn classes(truth: &Surface, pixel_m: (f64, f64), limits: &[f64]) -> Vec<u16> {
    let mut classes = vec![NO_CLASS; truth.values.len()];
    each_gradient(truth, pixel_m, |at, squared| classes[at] = bin(limits, squared));
    classes
}

/// Calls `each` with the number of every pixel that has all eight neighbours and its squared
/// gradient, metres per metre.
fn each_gradient(truth: &Surface, pixel_m: (f64, f64), mut each: impl FnMut(usize, f64)) {
    let (width, height) = truth.size();
    if width < 3 || height < 3 {
        return;
    }
    // Eight times the distance of two neighbours, halved by the weights' sum of four.
    let (over_x, over_y) = (1.0 / (8.0 * pixel_m.0), 1.0 / (8.0 * pixel_m.1));
    for y in 1..height - 1 {
        let row = |y: usize| &truth.values[y * width..(y + 1) * width];
        let (above, own, below) = (row(y - 1), row(y), row(y + 1));
        for x in 1..width - 1 {
            let at = |row: &[f32], x: usize| f64::from(row[x]);
            let (a, b, c) = (at(above, x - 1), at(above, x), at(above, x + 1));
            let (d, e, f) = (at(own, x - 1), at(own, x), at(own, x + 1));
            let (g, h, i) = (at(below, x - 1), at(below, x), at(below, x + 1));
            let dx = ((c + 2.0 * f + i) - (a + 2.0 * d + g)) * over_x;
            let dy = ((g + 2.0 * h + i) - (a + 2.0 * b + c)) * over_y;
            // The centre has no weight, but a pixel without height has no slope.
            let squared = dx * dx + dy * dy + 0.0 * e;
            if squared.is_finite() {
                each(y * width + x, squared);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn degrees(truth: &Surface, pixel_m: (f64, f64)) -> Vec<f64> {
        let mut out = vec![f64::NAN; truth.values.len()];
        each_gradient(truth, pixel_m, |at, squared| {
            out[at] = libm::atan(squared.sqrt()).to_degrees();
        });
        out
    }

    #[test]
    fn planes_have_the_slope_of_their_formula_on_pixels_that_are_not_square() {
        for (a, b) in [(0.0, 0.0), (1.0, 0.0), (0.0, -0.3), (0.7, 2.5), (-30.0, 4.0)] {
            let (px, py) = (0.25, 0.4);
            let plane = |k: usize| (a * px * (k % 9) as f64 + b * py * (k / 9) as f64) as f32;
            let truth = Surface::new(9, 7, (0..63).map(plane).collect());
            let expected = libm::atan(libm::hypot(a, b)).to_degrees();
            let found = degrees(&truth, (px, py));
            for y in 0..7 {
                for x in 0..9 {
                    let inside = (1..8).contains(&x) && (1..6).contains(&y);
                    let found = found[y * 9 + x];
                    assert_eq!(found.is_nan(), !inside, "{x} {y}");
                    assert!(!inside || (found - expected).abs() < 1e-4, "{found} {expected}");
                }
            }
        }
    }

    /// numpy: z = default_rng(5).normal(0, 1, (5, 5)).round(3), Horn's formula with px 0.5, py 0.25:
    /// `dx = ((z[:-2,2:]+2*z[1:-1,2:]+z[2:,2:])-(z[:-2,:-2]+2*z[1:-1,:-2]+z[2:,:-2]))/4`, likewise
    /// `dy` / 2, `degrees(arctan(hypot(dx, dy)))`.
    #[test]
    fn rough_ground_agrees_with_numpy() {
        let z = ROUGH.to_vec();
        let found = degrees(&Surface::new(5, 5, z), (0.5, 0.25));
        let inner: Vec<f64> = (0..9).map(|k| found[(k / 3 + 1) * 5 + k % 3 + 1]).collect();
        for (found, expected) in inner.iter().zip(ROUGH_DEGREES) {
            assert!((found - expected).abs() < 1e-4, "{inner:?}");
        }
    }

    #[test]
    fn a_wall_is_steeper_than_eighty_degrees_and_missing_neighbours_leave_no_slope() {
        let mut wall =
            Surface::new(8, 5, (0..40).map(|k| if k % 8 < 4 { 0.0 } else { 4.0 }).collect());
        let found = degrees(&wall, (0.25, 0.25));
        assert!(found[2 * 8 + 3] > 80.0 && found[2 * 8 + 4] > 80.0);
        assert_eq!(found[2 * 8 + 2], 0.0);
        wall.values[2 * 8 + 4] = f32::NAN;
        let found = degrees(&wall, (0.25, 0.25));
        for (x, y) in [(3, 1), (4, 1), (5, 1), (3, 2), (4, 2), (5, 2), (3, 3), (5, 3)] {
            assert!(found[y * 8 + x].is_nan());
        }
        assert_eq!(found[2 * 8 + 2], 0.0);
        wall.values[2 * 8 + 4] = f32::INFINITY;
        assert!(degrees(&wall, (0.25, 0.25))[2 * 8 + 3].is_nan());
    }

    #[test]
    fn images_too_small_for_a_neighbourhood_have_no_slope() {
        for (w, h) in [(0, 0), (1, 1), (2, 9), (9, 2)] {
            let truth = Surface::new(w, h, vec![1.0; w * h]);
            assert!(classes(&truth, (1.0, 1.0), &[0.1]).iter().all(|c| *c == NO_CLASS));
        }
    }

    const ROUGH: [f32; 25] = [
        -0.802, -1.324, -0.248, 0.42, 1.136, 0.11, -0.553, -0.785, 0.749, 1.635, 0.273, -1.233,
        -0.958, 1.6, 0.203, -1.732, -0.084, -1.163, -0.629, -0.488, -0.713, 0.553, -0.063, -0.589,
        0.41,
    ];
    const ROUGH_DEGREES: [f64; 9] = [
        34.0064521, 60.9020293, 62.0000983, 43.4388177, 61.0628747, 71.3146223, 60.1994776,
        35.3591131, 60.9437442,
    ];
}
