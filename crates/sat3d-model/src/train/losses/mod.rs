//! The terms of the objectives. Each is a function of tensors and knows nothing of weights of terms.
//!
//! * [`gravity`]: density must not grow upwards.
//! * [`depth`]: relative depth from above, up to a scale and a shift.
//! * [`photometric`]: colours; [`perceptual`] and [`lpips`]: how different pictures look.
//! * [`adversarial`]: what a discriminator says; [`spectral`]: the norm of its weights.
//! * [`sky`]: where the sky is, and its colours.
//! * [`height`]: true heights and classes, of simulated scenes.
//!
//! All tensors are batch first and lie on one device; a loss is a tensor of one value. Constants are
//! fields of small option types with the values of the release (`release()`, MODEL_SPEC section 11) and
//! of the paper (`paper()`). A target that is not known at a pixel is NaN there and the pixel is left
//! out: it is masked before any arithmetic, so that nothing of it reaches a gradient. Gradients are
//! finite wherever the inputs are, also where a formula has a kink or a pole (`docs/losses.md`).

pub mod adversarial;
pub mod depth;
pub mod gravity;
pub mod height;
pub mod lpips;
pub mod perceptual;
pub mod photometric;
pub mod sky;
pub mod spectral;

#[cfg(test)]
mod hard;
mod safe;
#[cfg(test)]
pub(super) mod testing;
