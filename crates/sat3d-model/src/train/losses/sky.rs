//! Where the sky is, and its colours (MODEL_SPEC sections 11 and 12).
//!
//! `sky` is the share of sky in a pixel of the true picture, `batch x 1 x height x width`: 1 sky, 0 not. NaN is
//! unknown; a picture that is absent has a mask of NaN.

use super::safe::{keep, mean_where, softplus, weights};
use burn::tensor::{Bool, Tensor};

/// How opacity is held against the sky mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Opacity {
    /// The release's: opacity, in [0, 1], is fed to the cross-entropy as if it were a logit. The best
    /// it can reach is ln(1 + 1/e) = 0.31 where there is no sky and ln 2 = 0.69 where there is.
    AsLogit,
    /// The paper's: cross-entropy of the transmittance `1 - opacity` as a probability.
    Probability {
        /// Probabilities are squeezed into `[floor, 1 - floor]`: the slope stays below `1 / floor` and
        /// never vanishes, however sure and wrong.
        floor: f64,
    },
}

impl Opacity {
    /// The release's form.
    #[must_use]
    pub const fn release() -> Self {
        Self::AsLogit
    }

    /// The paper's form; the floor is ours.
    #[must_use]
    pub const fn paper() -> Self {
        Self::Probability { floor: 1e-5 }
    }
}

/// Opacity term of a view with sky: binary cross-entropy between opacity and `1 - sky`, averaged over the
/// known pixels of the batch. `opacity` has the shape of `sky`.
///
/// `AsLogit`: `softplus(o) - o (1 - sky)`. `Probability`: `-(1 - sky) ln q(o) - sky ln q(1 - o)` with
/// `q(o) = floor + (1 - 2 floor) o`.
#[must_use]
pub fn opacity(opacity: Tensor<4>, sky: Tensor<4>, form: &Opacity) -> Tensor<1> {
    let known = sky.clone().is_finite();
    let solid = -keep(sky, &known) + 1.0;
    let opacity = keep(opacity, &known);
    let entropy = match form {
        Opacity::AsLogit => softplus(opacity.clone()) - opacity * solid,
        Opacity::Probability { floor } => {
            let log = |p: Tensor<4>| (p.clamp(0.0, 1.0) * (1.0 - 2.0 * floor) + *floor).log();
            let clear = -opacity.clone() + 1.0;
            -(solid.clone() * log(opacity)) - (-solid + 1.0) * log(clear)
        }
    };
    mean_where(entropy, &known)
}

/// Opacity term of the view from above, which sees no sky: [`opacity`] with a mask of zeros. The release adds
/// it with weight 0.1 ([`ORTHO_WEIGHT`]).
#[must_use]
pub fn ortho_opacity(seen: Tensor<4>, form: &Opacity) -> Tensor<1> {
    let sky = seen.clone().detach().zeros_like();
    opacity(seen, sky, form)
}

/// Weight of [`ortho_opacity`] beside [`opacity`] in the release.
pub const ORTHO_WEIGHT: f64 = 0.1;

/// Constants of the two terms of the sky's colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SkyColour {
    /// Added to the numbers of pixels that are divided by.
    pub epsilon: f64,
    /// Mean colour: where the predicted red, green and blue sum to less, there is no prediction (the sky
    /// map's empty columns).
    pub least_sum: f64,
    /// Mean colour: images with a smaller share of sky are left out.
    pub least_share: f64,
}

impl SkyColour {
    /// 1e-8, 0.03, 10 %.
    #[must_use]
    pub const fn release() -> Self {
        Self { epsilon: 1e-8, least_sum: 0.03, least_share: 0.1 }
    }

    /// As the release; the paper has no mean colour term.
    #[must_use]
    pub const fn paper() -> Self {
        Self::release()
    }
}

/// Sky colour term: `sum sky |predicted - truth| / (channels * sum sky)`.
///
/// `predicted` and `truth` are `batch x 3 x height x width` in one range (the release's is [-1, 1]): the sky
/// map looked up along the rays and the panorama at that size (release), or the rendered panorama (paper).
/// Pixels of unknown colour are left out.
#[must_use]
pub fn sky_colour(
    predicted: Tensor<4>,
    truth: Tensor<4>,
    sky: Tensor<4>,
    options: &SkyColour,
) -> Tensor<1> {
    let shape = predicted.dims();
    let inside = known_sky(&sky, &truth);
    let share = keep(sky, &inside);
    let inside = inside.expand(shape);
    let error = (keep(predicted, &inside) - keep(truth, &inside)).abs() * share.clone();
    error.sum() / (share.sum() * shape[1] as f64 + options.epsilon)
}

/// Pixels with sky whose colour is known.
fn known_sky(sky: &Tensor<4>, truth: &Tensor<4>) -> Tensor<4, Bool> {
    sky.clone().greater_elem(0.0).bool_and(truth.clone().is_finite().all_dim(1))
}

/// Mean sky colour term: outside the true sky, the sky map is drawn to the mean colour of the true sky
/// of its image.
///
/// Per image and channel the mean of `|predicted - mean|` over the pixels with `sky = 0` whose predicted colour sums
/// to `least_sum` or more; averaged over the channels of the images with at least `least_share` of
/// sky. Colours in [0, 1], shapes as in [`sky_colour`]; 0 when no image has enough sky.
#[must_use]
pub fn mean_sky_colour(
    predicted: Tensor<4>,
    truth: Tensor<4>,
    sky: Tensor<4>,
    options: &SkyColour,
) -> Tensor<1> {
    let shape @ [_, channels, height, width] = predicted.dims();
    let inside = known_sky(&sky, &truth);
    let share = keep(sky.clone(), &inside);
    let seen = share.clone().sum_dims(&[2, 3]);
    let truth = keep(truth, &inside.expand(shape)) * share;
    let mean = truth.sum_dims(&[2, 3]) / (seen.clone() + options.epsilon);

    let there = predicted.clone().detach().sum_dim(1).greater_equal_elem(options.least_sum);
    let outside = there.bool_and(sky.equal_elem(0.0));
    let count = weights(&outside, &seen.clone().expand([shape[0], 1, height, width]));
    let count = count.sum_dims(&[2, 3]);
    let error = keep((predicted - mean).abs(), &outside.expand(shape)).sum_dims(&[2, 3]);
    let error = error / (count + options.epsilon);

    let enough = (seen / (height * width) as f64).greater_equal_elem(options.least_share);
    let images = weights(&enough, &error.clone().detach().narrow(1, 0, 1)).sum();
    let enough = enough.expand([shape[0], channels, 1, 1]);
    keep(error, &enough).sum() / (images * channels as f64 + options.epsilon)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{
        check_gradients, golden, narrow, scalar, uniform, values, wide,
    };

    const FORMS: [Opacity; 2] = [Opacity::release(), Opacity::paper()];

    #[test]
    fn the_reference_gives_the_same_numbers() {
        let options = SkyColour::release();
        let [alpha, sky, predicted, truth] =
            ["alpha", "sky_mask", "sky_pred01", "pano01"].map(golden::<4>);
        let signed = |v: &Tensor<4>| v.clone() * 2.0 - 1.0;
        let ours = [
            opacity(alpha, sky.clone(), &Opacity::release()),
            sky_colour(signed(&predicted), signed(&truth), sky.clone(), &options),
            mean_sky_colour(predicted, truth, sky, &options),
        ];
        for (ours, key) in ours.into_iter().zip(["bce_logits", "sky_l1", "sky_mean"]) {
            let [ours, theirs] = [ours, golden::<1>(key)].map(scalar);
            assert!((ours / theirs - 1.0).abs() < 1e-6, "{key}: {ours} {theirs}");
        }
    }

    #[test]
    fn probabilities_give_the_textbook_entropy() {
        let [alpha, sky] =
            [[0.9, 0.2, 0.5], [0.0, 1.0, 1.0]].map(|v| wide(v.to_vec(), [1, 1, 1, 3]));
        let ours = scalar(opacity(alpha, sky, &Opacity::paper()));
        let want = -(libm::log(0.9) + libm::log(0.8) + libm::log(0.5)) / 3.0;
        assert!((ours - want).abs() < 3e-5, "{ours} {want}");
    }

    #[test]
    fn a_wrong_and_sure_opacity_is_still_corrected() {
        for form in FORMS {
            for (alpha, sky) in [(0.0, 0.0), (1.0, 1.0)] {
                let seen = narrow(&[alpha; 4], [1, 1, 2, 2]).require_grad();
                let loss = opacity(seen.clone(), narrow(&[sky; 4], [1, 1, 2, 2]), &form);
                let slopes = values(seen.grad(&loss.backward()).expect("a gradient"));
                let away = if sky > 0.5 { 1.0 } else { -1.0 };
                assert!(slopes.iter().all(|s| s.is_finite() && s * away > 0.1), "{slopes:?}");
            }
        }
    }

    #[test]
    fn the_mean_colour_term_leaves_out_empty_columns_and_small_skies() {
        let options = SkyColour::release();
        // Two images of 2 x 10 pixels: two pixels of sky (10 %), and one.
        let mut sky = vec![0.0_f32; 40];
        sky[..2].fill(1.0);
        sky[20] = 1.0;
        let mut truth = vec![0.5_f32; 120];
        truth[0] = 0.1;
        truth[1] = 0.3;
        let mut predicted = vec![0.4_f32; 120];
        // An empty column below the sky, in all channels.
        for channel in 0..3 {
            predicted[channel * 20 + 5] = 0.0;
        }
        let term = |predicted: &[f32]| {
            scalar(mean_sky_colour(
                narrow(predicted, [2, 3, 2, 10]),
                narrow(&truth, [2, 3, 2, 10]),
                narrow(&sky, [2, 1, 2, 10]),
                &options,
            ))
        };
        // Means 0.2, 0.5, 0.5 against 0.4.
        let want = (0.2 + 0.1 + 0.1) / 3.0;
        assert!((term(&predicted) - want).abs() < 1e-6);
        // The second image is never looked at, the sky's own pixels of the first neither.
        predicted[60..].fill(0.9);
        predicted[0] = 0.9;
        assert!((term(&predicted) - want).abs() < 1e-6);
        predicted[7] = 0.9;
        assert!((term(&predicted) - want).abs() > 1e-3);
    }

    #[test]
    fn an_absent_panorama_counts_for_nothing() {
        let options = SkyColour::release();
        let [alpha, colours] =
            [uniform(1, 32, 0.0, 1.0), uniform(2, 96, 0.1, 1.0)].map(|v| [v.clone(), v].concat());
        let mut sky: Vec<f64> =
            uniform(3, 32, -1.0, 1.0).iter().map(|v| v.signum().max(0.0)).collect();
        let mut truth = uniform(4, 96, 0.0, 1.0);
        let terms = |n: usize, sky: &[f64], truth: &[f64]| {
            let of =
                |v: &[f64], channels| wide(v[..n * channels * 32].to_vec(), [n, channels, 4, 8]);
            let (sky, truth) = (of(sky, 1), of(truth, 3));
            [
                opacity(of(&alpha, 1), sky.clone(), &Opacity::release()),
                opacity(of(&alpha, 1), sky.clone(), &Opacity::paper()),
                sky_colour(of(&colours, 3), truth.clone(), sky.clone(), &options),
                mean_sky_colour(of(&colours, 3), truth, sky, &options),
            ]
            .map(scalar)
        };
        let alone = terms(1, &sky, &truth);
        sky.extend([f64::NAN; 32]);
        truth.extend([f64::NAN; 96]);
        for (alone, both) in alone.iter().zip(terms(2, &sky, &truth)) {
            assert!((alone - both).abs() < 1e-12, "{alone} {both}");
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        let sky = || {
            let mask = uniform(9, 40, -1.0, 1.0).iter().map(|v| v.signum().max(0.0)).collect();
            wide::<4>(mask, [2, 1, 4, 5])
        };
        for form in FORMS {
            check_gradients("opacity", &[[2, 1, 4, 5]], [0.0, 1.0], 1e-6, |input| {
                opacity(input[0].clone(), sky(), &form)
                    + ortho_opacity(input[0].clone(), &form) * ORTHO_WEIGHT
            });
        }
        let truth = || wide::<4>(uniform(8, 120, 0.0, 1.0), [2, 3, 4, 5]);
        for term in [sky_colour, mean_sky_colour] {
            check_gradients("sky colour", &[[2, 3, 4, 5]], [0.1, 1.0], 1e-6, |input| {
                term(input[0].clone(), truth(), sky(), &SkyColour::release())
            });
        }
    }
}
