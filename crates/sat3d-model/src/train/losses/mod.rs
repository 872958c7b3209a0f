//! The terms of the objectives. Each is a function of tensors and knows nothing of weights of terms.
//!
//! * [`gravity`]: density must not grow upwards.
//! * [`depth`]: relative depth from above, up to a scale and a shift.
//! * [`photometric`]: colours.
//! * [`adversarial`]: what a discriminator says.
//! * [`sky`]: where the sky is, and its colours.
//!
//! All tensors are batch first and lie on one device; a loss is a tensor of one value. Constants are
//! fields of small option types with the values of the release (`release()`, MODEL_SPEC section 11) and
//! of the paper (`paper()`). A target that is not known at a pixel is NaN there and the pixel is left
//! out: it is masked before any arithmetic, so that nothing of it reaches a gradient. Gradients are
//! finite wherever the inputs are, also where a formula has a kink or a pole (`docs/losses.md`).

pub mod adversarial;
pub mod depth;
pub mod gravity;
pub mod photometric;
pub mod sky;

mod safe;
#[cfg(test)]
mod testing;
