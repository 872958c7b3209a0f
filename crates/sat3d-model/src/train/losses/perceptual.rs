//! How different two pictures look.
//!
//! [`Lpips`] is what the release and the paper train with, and needs weights that we do not ship. [`Substitute`]
//! needs none, and is another measure: it never stands in by itself, the caller names it.

use super::lpips::Lpips;
use burn::tensor::Tensor;

/// A perceptual distance. Pictures are `batch x 3 x height x width` in [-1, 1].
#[derive(Clone, Debug)]
pub enum Perceptual {
    /// Learned perceptual image patch similarity over VGG16, with the user's weights.
    Lpips(Box<Lpips>),
    /// Structure and edges at several scales, without weights.
    Substitute(Substitute),
}

impl Perceptual {
    /// Distance of each pair of pictures, `[batch]`; 0 for equal ones.
    ///
    /// # Panics
    /// Of the first, on pictures smaller than 16 x 16.
    #[must_use]
    pub fn distance(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<1> {
        match self {
            Self::Lpips(lpips) => lpips.distance(first, second),
            Self::Substitute(substitute) => substitute.distance(first, second),
        }
    }

    /// What to call the measure in a log, so that runs with different ones are not compared.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Lpips(_) => "LPIPS (VGG16)",
            Self::Substitute(_) => "substitute for LPIPS (SSIM and edges, no learned weights)",
        }
    }
}

/// Structural similarity and edges at several scales:
/// `D = mean over scales k of structure (1 - SSIM_k) / 2 + edges E_k`.
///
/// `SSIM_k` is the mean over places and channels of the index of Wang et al. (2004) with a square window
/// of equal weights, wholly inside the picture; `E_k` the mean absolute difference of the two pictures' steps
/// between neighbours along rows and columns. Scale `k` is the picture averaged over squares of `2^k`
/// pixels; scales whose shorter side is below the window are left out, but never the first, whose
/// window then shrinks to the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Substitute {
    /// Greatest number of scales.
    pub scales: usize,
    /// Side of the window in pixels.
    pub window: usize,
    /// Weight of the structural part.
    pub structure: f64,
    /// Weight of the edges.
    pub edges: f64,
    /// Stabiliser of the index's comparison of means.
    pub mean_floor: f64,
    /// Stabiliser of its comparison of variances.
    pub variance_floor: f64,
}

impl Default for Substitute {
    /// Four scales, window 7, equal weights, and the index's usual stabilisers `(0.01 R)^2` and `(0.03
    /// R)^2` for the range `R = 2`.
    fn default() -> Self {
        Self {
            scales: 4,
            window: 7,
            structure: 1.0,
            edges: 1.0,
            mean_floor: 4e-4,
            variance_floor: 3.6e-3,
        }
    }
}

impl Substitute {
    /// Distance of each pair, `[batch]`.
    #[must_use]
    pub fn distance(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<1> {
        let batch = first.dims()[0];
        let mut pair = [first, second];
        let mut total: Option<Tensor<2>> = None;
        let mut scales = 0;
        for scale in 0..self.scales.max(1) {
            if scale > 0 {
                let [.., height, width] = pair[0].dims();
                if height.min(width) / 2 < self.window {
                    break;
                }
                pair = pair.map(halved);
            }
            let [a, b] = pair.clone();
            let part = self.structure(a.clone(), b.clone()) * (0.5 * self.structure)
                + edges(a - b) * self.edges;
            total = Some(match total {
                Some(sum) => sum + part,
                None => part,
            });
            scales += 1;
        }
        match total {
            Some(total) => (total / f64::from(scales)).reshape([batch]),
            None => pair[0].clone().sum_dims(&[1, 2, 3]).reshape([batch]) * 0.0,
        }
    }

    /// `1 - SSIM`, `batch x 1`.
    fn structure(&self, a: Tensor<4>, b: Tensor<4>) -> Tensor<2> {
        let [.., height, width] = a.dims();
        let window = [self.window.clamp(1, height), self.window.clamp(1, width)];
        let mean = |v: Tensor<4>| window_mean(v, window);
        let [ma, mb] = [mean(a.clone()), mean(b.clone())];
        // Rounding must not make a variance negative.
        let va = (mean(a.clone() * a.clone()) - ma.clone() * ma.clone()).clamp_min(0.0);
        let vb = (mean(b.clone() * b.clone()) - mb.clone() * mb.clone()).clamp_min(0.0);
        let covariance = mean(a * b) - ma.clone() * mb.clone();
        // The two fractions apart, so that no fourth power overflows.
        let means = (ma.clone() * mb.clone() * 2.0 + self.mean_floor)
            / (ma.clone() * ma + mb.clone() * mb + self.mean_floor);
        let variances = (covariance * 2.0 + self.variance_floor) / (va + vb + self.variance_floor);
        -mean_of_each(means * variances) + 1.0
    }
}

/// Mean absolute step of the difference picture along rows and columns, `batch x 1`.
fn edges(difference: Tensor<4>) -> Tensor<2> {
    let shape = difference.dims();
    let mut total = mean_of_each(difference.clone()) * 0.0;
    for dim in [2, 3] {
        let size = shape[dim];
        if size > 1 {
            let next = difference.clone().narrow(dim, 1, size - 1);
            total =
                total + mean_of_each((next - difference.clone().narrow(dim, 0, size - 1)).abs());
        }
    }
    total
}

fn mean_of_each(values: Tensor<4>) -> Tensor<2> {
    values.flatten::<2>(1, 3).mean_dim(1)
}

/// Means of squares of two by two.
fn halved(picture: Tensor<4>) -> Tensor<4> {
    let [batch, channels, height, width] = picture.dims();
    let [rows, columns] = [height / 2, width / 2];
    let even = picture.narrow(2, 0, 2 * rows).narrow(3, 0, 2 * columns);
    let split = even.reshape([batch, channels, rows, 2, columns, 2]);
    split.mean_dim(5).mean_dim(3).reshape([batch, channels, rows, columns])
}

/// Means of all windows, one dimension after the other. burn's pooling visits every pixel of every window, here a
/// window of 7 costs four additions a dimension.
fn window_mean(picture: Tensor<4>, window: [usize; 2]) -> Tensor<4> {
    let area = (window[0] * window[1]) as f64;
    window_sum(window_sum(picture, 2, window[0]), 3, window[1]) / area
}

/// Sums of `window` neighbours along a dimension, from sums of 1, 2, 4 and so on.
fn window_sum(values: Tensor<4>, dim: usize, window: usize) -> Tensor<4> {
    let outputs = values.dims()[dim] + 1 - window;
    let mut power = values;
    let (mut length, mut start) = (1, 0);
    let mut total: Option<Tensor<4>> = None;
    loop {
        if window & length != 0 {
            let part = power.clone().narrow(dim, start, outputs);
            start += length;
            total = Some(match total {
                Some(sum) => sum + part,
                None => part,
            });
        }
        if 2 * length > window {
            return total.unwrap_or(power);
        }
        let count = power.dims()[dim] - length;
        power = power.clone().narrow(dim, 0, count) + power.narrow(dim, length, count);
        length *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{check_gradients, scalar, uniform, values, wide};
    use burn::tensor::module;
    use burn::tensor::ops::AvgPoolOptions;

    /// The formula, pixel by pixel, for one channel and one scale.
    fn slow(a: &[f64], b: &[f64], [height, width]: [usize; 2], options: &Substitute) -> f64 {
        let w = options.window;
        let mut index = 0.0;
        for y in 0..=height - w {
            for x in 0..=width - w {
                let cells: Vec<usize> =
                    (0..w * w).map(|i| (y + i / w) * width + x + i % w).collect();
                let mean = |f: &dyn Fn(usize) -> f64| {
                    cells.iter().map(|i| f(*i)).sum::<f64>() / cells.len() as f64
                };
                let [ma, mb] = [mean(&|i| a[i]), mean(&|i| b[i])];
                let va = mean(&|i| (a[i] - ma).powi(2));
                let vb = mean(&|i| (b[i] - mb).powi(2));
                let both = mean(&|i| (a[i] - ma) * (b[i] - mb));
                index += (2.0 * ma * mb + 4e-4) / (ma * ma + mb * mb + 4e-4)
                    * (2.0 * both + 3.6e-3)
                    / (va + vb + 3.6e-3);
            }
        }
        index /= ((height - w + 1) * (width - w + 1)) as f64;
        let d = |i: usize| a[i] - b[i];
        let mut rows = 0.0;
        let mut columns = 0.0;
        for y in 0..height {
            for x in 0..width {
                let i = y * width + x;
                rows += if x > 0 { (d(i) - d(i - 1)).abs() } else { 0.0 };
                columns += if y > 0 { (d(i) - d(i - width)).abs() } else { 0.0 };
            }
        }
        (1.0 - index) / 2.0
            + rows / (height * (width - 1)) as f64
            + columns / ((height - 1) * width) as f64
    }

    #[test]
    fn one_scale_is_the_formula() {
        let options = Substitute { scales: 1, window: 5, ..Substitute::default() };
        let [a, b] = [1, 2].map(|seed| uniform(seed, 99, -1.0, 1.0));
        let of = |v: &[f64]| wide(v.to_vec(), [1, 1, 9, 11]);
        let ours = scalar(options.distance(of(&a), of(&b)));
        let want = slow(&a, &b, [9, 11], &options);
        assert!((ours - want).abs() < 1e-10, "{ours} {want}");
    }

    #[test]
    fn windows_and_squares_are_those_of_the_pooling() {
        let picture = || wide::<4>(uniform(1, 2 * 9 * 21, -1.0, 1.0), [1, 2, 9, 21]);
        let check = |ours: Tensor<4>, window: [usize; 2], stride: usize| {
            let pool = AvgPoolOptions::new(window).with_stride([stride; 2]);
            let theirs = module::avg_pool2d(picture(), pool);
            assert_eq!(ours.dims(), theirs.dims());
            for (ours, theirs) in values(ours).iter().zip(values(theirs)) {
                assert!((ours - theirs).abs() < 1e-14, "{window:?}: {ours} {theirs}");
            }
        };
        for window in [[1, 1], [2, 3], [7, 7], [5, 8], [9, 21]] {
            check(window_mean(picture(), window), window, 1);
        }
        check(halved(picture()), [2, 2], 2);
    }

    #[test]
    fn scales_are_averages_of_squares_and_stop_at_the_window() {
        let options = Substitute { window: 3, ..Substitute::default() };
        let [a, b] = [1, 2].map(|seed| wide::<4>(uniform(seed, 96, -1.0, 1.0), [1, 1, 8, 12]));
        let half = |v: &Tensor<4>| halved(v.clone());
        let one = Substitute { scales: 1, ..options };
        let want = (scalar(one.distance(a.clone(), b.clone()))
            + scalar(one.distance(half(&a), half(&b))))
            / 2.0;
        assert!((scalar(options.distance(a, b)) - want).abs() < 1e-12);
    }

    #[test]
    fn equal_pictures_are_at_distance_nought_and_blur_is_not() {
        let options = Substitute::default();
        let sharp = uniform(3, 3 * 32 * 32, -1.0, 1.0);
        let of = |v: &[f64]| wide(v.to_vec(), [1, 3, 32, 32]);
        assert!(scalar(options.distance(of(&sharp), of(&sharp))).abs() < 1e-12);
        let grey = vec![sharp.iter().sum::<f64>() / sharp.len() as f64; sharp.len()];
        assert!(scalar(options.distance(of(&grey), of(&sharp))) > 0.3);
        // Two pictures of a batch do not see each other.
        let both = wide([grey.clone(), sharp.clone()].concat(), [2, 3, 32, 32]);
        let truth = wide([sharp.clone(), sharp.clone()].concat(), [2, 3, 32, 32]);
        let both = values(options.distance(both, truth));
        assert!((both[0] - scalar(options.distance(of(&grey), of(&sharp)))).abs() < 1e-12);
        assert!(both[1].abs() < 1e-12);
    }

    #[test]
    fn gradients_agree_with_differences() {
        let options = Substitute { window: 3, ..Substitute::default() };
        check_gradients("substitute", &[[2, 3, 12, 13]; 2], [-1.0, 1.0], 2e-6, |input| {
            options.distance(input[0].clone(), input[1].clone()).mean()
        });
    }
}
