//! What a discriminator's scores are worth to both players (MODEL_SPEC sections 11 and 12).

use super::safe::softplus;
use burn::tensor::{Tensor, activation};

/// Which game is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Adversarial {
    /// Non-saturating: `softplus(-fake)` for the generator, `softplus(fake) + softplus(-real)` for the
    /// discriminator.
    Softplus,
    /// Hinge: `-fake` for the generator, `max(0, margin + fake) + max(0, margin - real)` for the
    /// discriminator.
    Hinge {
        /// Beyond this distance from 0 a score on the right side costs nothing.
        margin: f64,
    },
}

impl Adversarial {
    /// The release's game.
    #[must_use]
    pub const fn release() -> Self {
        Self::Softplus
    }

    /// The paper's game: hinge with the usual margin of 1.
    #[must_use]
    pub const fn paper() -> Self {
        Self::Hinge { margin: 1.0 }
    }

    /// The generator's loss, a mean over the scores of what it made (`[batch]` or any other shape).
    #[must_use]
    pub fn generator<const D: usize>(&self, fake: Tensor<D>) -> Tensor<1> {
        match self {
            Self::Softplus => softplus(-fake).mean(),
            Self::Hinge { .. } => -fake.mean(),
        }
    }

    /// The discriminator's loss, from its scores of real pictures and of the generator's (which have been
    /// detached from the generator). The two need not be equally many.
    #[must_use]
    pub fn discriminator<const D: usize>(&self, real: Tensor<D>, fake: Tensor<D>) -> Tensor<1> {
        match self {
            Self::Softplus => softplus(fake).mean() + softplus(-real).mean(),
            Self::Hinge { margin } => {
                activation::relu(fake + *margin).mean() + activation::relu(-real + *margin).mean()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::losses::testing::{check_gradients, narrow, scalar, values};

    const BOTH: [Adversarial; 2] = [Adversarial::release(), Adversarial::paper()];

    #[test]
    fn values_are_those_of_the_closed_forms() {
        let [real, fake] = [[2.0_f32, -0.5], [0.25, -3.0]];
        let soft = |x: f32| libm::log1p(libm::exp(f64::from(x)));
        let want = [
            [
                (soft(-0.25) + soft(3.0)) / 2.0,
                (soft(0.25) + soft(-3.0)) / 2.0 + (soft(-2.0) + soft(0.5)) / 2.0,
            ],
            [(3.0 - 0.25) / 2.0, 1.25 / 2.0 + 1.5 / 2.0],
        ];
        for (game, want) in BOTH.iter().zip(want) {
            let [real, fake] = [real, fake].map(|v| narrow(&v, [2]));
            let ours = [game.generator(fake.clone()), game.discriminator(real, fake)].map(scalar);
            for (ours, want) in ours.iter().zip(want) {
                assert!((ours - want).abs() < 1e-6, "{game:?}: {ours} {want}");
            }
        }
    }

    #[test]
    fn sure_scores_neither_overflow_nor_stop_learning() {
        for game in BOTH {
            let fake = narrow(&[-1e30, 0.0, 1e4], [3]).require_grad();
            let loss = game.generator(fake.clone());
            let gradients = loss.backward();
            let slopes = values(fake.grad(&gradients).expect("a gradient"));
            assert!(scalar(loss).is_finite());
            // A picture that is surely told apart pulls hardest; the slope at 0 is a half, not 0.
            let want = if game == Adversarial::Softplus { [-1.0, -0.5, 0.0] } else { [-1.0; 3] };
            for (slope, want) in slopes.iter().zip(want) {
                assert!((slope - want / 3.0).abs() < 1e-6, "{game:?}: {slopes:?}");
            }
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        for game in BOTH {
            check_gradients("generator", &[[2, 1, 3, 2]], [-4.0, 4.0], 1e-6, |input| {
                game.generator(input[0].clone())
            });
            check_gradients("discriminator", &[[2, 1, 3, 2]; 2], [-4.0, 4.0], 1e-6, |input| {
                game.discriminator(input[0].clone(), input[1].clone())
            });
        }
    }
}
