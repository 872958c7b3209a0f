//! Density must not grow upwards: floaters and hollow roofs cost (paper, equation of the gravity-based
//! density variation loss; MODEL_SPEC sections 11 and 12).

use crate::random;
use burn::tensor::{Device, Tensor, TensorData, activation};

/// Names the points among the uses of the random numbers.
const PURPOSE: u64 = 0x6772_6176_6974_7900;

/// Constants of the gravity term.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gravity {
    /// Pairs of points of an image.
    pub points: usize,
    /// Greatest distance of the upper point above the lower one, in units of the cube (half its height).
    pub reach: f64,
    /// How much denser the upper point may be at no cost.
    pub margin: f64,
}

impl Gravity {
    /// 1000 pairs, up to 0.008 apart, margin 1.
    #[must_use]
    pub const fn release() -> Self {
        Self { points: 1000, reach: 0.008, margin: 1.0 }
    }

    /// As [`release`](Self::release): the paper gives the same numbers.
    #[must_use]
    pub const fn paper() -> Self {
        Self::release()
    }

    /// Draws the pairs of a step: lower points uniform in the cube `[-1, 1)^3`, and above each, `U(0, 1)` times
    /// [`reach`](Self::reach) higher in z, the upper one (which may leave the cube by that much, as in
    /// the release).
    ///
    /// Two tensors of `batch x points x 3`, lower then upper, the coordinates in the order x, y, z.
    /// They depend on the seed, the step and the image's place in the batch, and on nothing else.
    #[must_use]
    pub fn pairs(&self, batch: usize, seed: u64, step: u64, device: &Device) -> [Tensor<3>; 2] {
        let mut lower = Vec::with_capacity(batch * self.points * 3);
        let mut upper = Vec::with_capacity(batch * self.points * 3);
        for image in 0..batch {
            let mut draw = random::Draw::new(&[PURPOSE, seed, step, image as u64]);
            for _ in 0..self.points {
                let [x, y, z] = [(); 3].map(|()| draw.range(-1.0, 1.0));
                let raised = z + draw.unit() * self.reach;
                lower.extend([x, y, z].map(|v| v as f32));
                upper.extend([x, y, raised].map(|v| v as f32));
            }
        }
        let shape = [batch, self.points, 3];
        [lower, upper].map(|points| Tensor::from_data(TensorData::new(points, shape), device))
    }
}

/// Gravity term: the mean over all pairs of `max(0, upper - lower - margin)`, where `lower` and `upper`
/// are the activated densities (`softplus(d - 1)`) of the two points of a pair, in one shape.
#[must_use]
pub fn gravity<const D: usize>(lower: Tensor<D>, upper: Tensor<D>, options: &Gravity) -> Tensor<1> {
    activation::relu(upper - lower - options.margin).mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{check_gradients, device, golden, scalar, values};

    #[test]
    fn the_reference_gives_the_same_numbers() {
        let density: Tensor<3> = golden("tv_density");
        let [lower, upper] = [0, 40].map(|from| density.clone().narrow(1, from, 40));
        for (margin, key) in [(1.0, "tv_alpha1"), (0.0, "tv_alpha0")] {
            let options = Gravity { margin, ..Gravity::release() };
            let ours = scalar(gravity(lower.clone(), upper.clone(), &options));
            let theirs = scalar(golden::<1>(key));
            assert!((ours - theirs).abs() < 1e-6, "{key}: {ours} {theirs}");
        }
    }

    #[test]
    fn pairs_are_of_the_seed_the_step_and_the_image() {
        let options = Gravity::release();
        let draw = |batch, seed, step| options.pairs(batch, seed, step, &device()).map(values);
        let [lower, upper] = draw(2, 5, 7);
        assert_eq!([lower.clone(), upper.clone()], draw(2, 5, 7));
        assert_ne!(lower, draw(2, 6, 7)[0]);
        assert_ne!(lower, draw(2, 5, 8)[0]);
        assert_ne!(lower[..3000], lower[3000..]);
        assert_eq!(lower[..3000], draw(1, 5, 7)[0]);
        let mut distances = Vec::new();
        for (low, high) in lower.chunks(3).zip(upper.chunks(3)) {
            assert_eq!(low[..2], high[..2]);
            assert!(low.iter().all(|v| (-1.0..=1.0).contains(v)), "{low:?}");
            distances.push(high[2] - low[2]);
        }
        assert!(distances.iter().all(|d| (0.0..=0.008_001).contains(d)));
        let mean = distances.iter().sum::<f64>() / distances.len() as f64;
        assert!((mean - 0.004).abs() < 2e-4, "{mean}");
        let mean = lower.iter().sum::<f64>() / lower.len() as f64;
        assert!(mean.abs() < 0.03, "{mean}");
    }

    #[test]
    fn gradients_agree_with_differences() {
        check_gradients("gravity", &[[2, 1, 5, 6]; 2], [-3.0, 3.0], 1e-6, |input| {
            let [lower, upper] = [0, 1].map(|i| input[i].clone());
            gravity(lower, upper, &Gravity { margin: 0.3, ..Gravity::release() })
        });
    }
}
