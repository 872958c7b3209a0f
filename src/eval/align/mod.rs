//! Bringing a ground truth onto a prediction: shift, rotation, vertical offset.
//!
//! **Conventions.** Everything is stated as what is applied to the *ground truth*: first the shift
//! (+x east, +y south, pixels of the prediction), then the rotation about the centre of the image
//! (degrees, sign of `scipy.ndimage.rotate`), then the vertical offset is *subtracted*:
//! `error = prediction - (aligned truth - vertical offset)`.

mod coregister;
mod fit;
#[cfg(test)]
mod hard_cases;
#[cfg(test)]
mod huge_offsets;
mod offset;
mod phase;
mod resample;
mod rotation;
mod shade;
#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests;

pub(crate) use offset::median;
pub use resample::{apply, apply_nearest};

use super::protocol::{OffsetMethod, Protocol};
use super::surface::Surface;
use crate::plan::runs;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// A shift in pixels of the prediction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Shift {
    /// East.
    pub x: f64,
    /// South.
    pub y: f64,
}

/// Something about an alignment that a reader of its scores should know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlignmentFlag {
    /// The shift found is beyond the limit: the image is left where it is.
    ShiftBeyondLimit,
    /// One of the two surfaces is flat, so that nothing can be found: left where it is.
    NoTexture,
    /// No rotation had enough overlapping pixels: none is applied.
    NoRotation,
    /// Fewer than 20 pixels agree with the vertical offset; it is the best draw's, unrefined.
    FewInliers,
    /// Co-registration: slopes or aspects do not determine a shift: left where it is.
    NoInformation,
    /// Co-registration did not settle: left where it is.
    NotConverged,
}

/// Residuals of a co-registration, over the pixels that it used.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Residuals {
    /// Pixels.
    pub pixels: u64,
    /// Mean of prediction - truth, metres.
    pub mean_m: f64,
    /// Median, metres.
    pub median_m: f64,
    /// Population standard deviation, metres.
    pub std_m: f64,
    /// Normalised median absolute deviation (factor 1.4826), metres.
    pub nmad_m: f64,
}

/// What co-registration after Nuth and Kaab did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coregistration {
    /// Iterations.
    pub iterations: u32,
    /// Before any shift.
    pub before: Residuals,
    /// After shift and vertical offset.
    pub after: Residuals,
    /// Standard error of the shift, pixels, as the last fit states it.
    pub shift_error_px: Shift,
}

/// What is applied to a ground truth before it is compared (see the module's conventions).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// Shift, pixels of the prediction.
    pub shift_px: Shift,
    /// Rotation, degrees.
    pub rotation_deg: f64,
    /// Vertical offset, metres; subtracted from the ground truth.
    pub vertical_offset_m: f64,
    /// Correlation at the rotation found (`paper`).
    pub correlation: Option<f64>,
    /// Pixels within 1.5 m of the best draw of RANSAC.
    pub inliers: Option<u64>,
    /// What Nuth and Kaab's method did (`coregister`).
    pub coregistration: Option<Coregistration>,
    /// What a reader should know, sorted.
    pub flags: Vec<AlignmentFlag>,
}

/// How surfaces are aligned.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlignSettings {
    /// The protocol.
    pub protocol: Protocol,
    /// How the vertical offset is found.
    pub offset: OffsetMethod,
    /// Seed of RANSAC's draws for this image.
    pub seed: u64,
    /// Pixels of the prediction on the ground, metres, east-west and north-south.
    pub pixel_m: (f64, f64),
    /// Largest shift, pixels (paper: 20).
    pub max_shift_px: f64,
    /// Largest rotation searched, degrees (paper: 10).
    pub max_rotation_deg: f64,
}

/// Why two surfaces cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// Too few pixels have both heights.
    #[error("only {pixels} pixels have a height in both, {needed} are needed")]
    TooFewPixels {
        /// Pixels with both.
        pixels: u64,
        /// Pixels needed.
        needed: u64,
    },
}

/// Finds the alignment of a ground truth to a prediction of the same size.
///
/// [`Aligner`] does the same and keeps its tables for the next pair.
///
/// # Errors
/// [`AlignError`] when no vertical offset can be found.
///
/// # Panics
/// When the sizes differ.
pub fn align(
    prediction: &Surface,
    truth: &Surface,
    settings: &AlignSettings,
) -> Result<Alignment, AlignError> {
    Aligner::new().align(prediction, truth, settings)
}

/// Finds alignments, and keeps transforms, tables and buffers from one pair to the next.
///
/// The result for a pair does not depend on what the aligner saw before.
#[derive(Default)]
pub struct Aligner {
    phase: phase::PhaseCorrelator,
    rotation: rotation::RotationSearch,
    shades: [Vec<u8>; 3],
    keys: Vec<u32>,
    offsets: offset::OffsetFinder,
}

impl std::fmt::Debug for Aligner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Aligner").finish_non_exhaustive()
    }
}

impl Aligner {
    /// An aligner without any tables yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Finds the alignment of a ground truth to a prediction of the same size. Infinite heights are
    /// taken as no data.
    ///
    /// # Errors
    /// [`AlignError`] when no vertical offset can be found.
    ///
    /// # Panics
    /// When the sizes differ.
    pub fn align(
        &mut self,
        prediction: &Surface,
        truth: &Surface,
        settings: &AlignSettings,
    ) -> Result<Alignment, AlignError> {
        self.align_and_apply(prediction, truth, settings).map(|(alignment, _)| alignment)
    }

    /// Like [`Aligner::align`]; also returns what [`apply`] makes of the truth, which is needed on
    /// the way in any case.
    ///
    /// # Errors
    /// As [`Aligner::align`].
    ///
    /// # Panics
    /// When the sizes differ.
    pub fn align_and_apply(
        &mut self,
        prediction: &Surface,
        truth: &Surface,
        settings: &AlignSettings,
    ) -> Result<(Alignment, Surface), AlignError> {
        assert_eq!(prediction.size(), truth.size(), "sizes of prediction and truth");
        let (prediction, truth) = (finite(prediction), finite(truth));
        let mut alignment = Alignment::default();
        match settings.protocol {
            Protocol::Plain | Protocol::Vertical => {}
            Protocol::Paper => self.paper(&prediction, &truth, settings, &mut alignment),
            Protocol::Coregister => {
                runs("coregistration");
                coregister::coregister(&prediction, &truth, settings, &mut alignment);
            }
        }
        let aligned = apply(&alignment, &truth);
        if settings.protocol != Protocol::Plain {
            runs("vertical-offset");
            self.offsets.find(&prediction, &aligned, settings, &mut alignment)?;
        }
        if let Some(coregistration) = &mut alignment.coregistration {
            coregistration.after =
                coregister::residuals(&prediction, &aligned, alignment.vertical_offset_m);
        }
        alignment.flags.sort_unstable();
        Ok((alignment, aligned))
    }

    /// Shift and rotation as published.
    fn paper(
        &mut self,
        prediction: &Surface,
        truth: &Surface,
        settings: &AlignSettings,
        alignment: &mut Alignment,
    ) {
        runs("shift");
        let (width, height) = prediction.size();
        let [reference, moving, shifted] = &mut self.shades;
        let textured = shade::shade(&prediction.values, &mut self.keys, reference)
            & shade::shade(&truth.values, &mut self.keys, moving);
        if !textured {
            alignment.flags.push(AlignmentFlag::NoTexture);
            return;
        }
        let shift = self.phase.shift(reference, moving, width, height);
        // Written so that a limit that is no number lets nothing pass.
        if !(shift.x.abs() <= settings.max_shift_px && shift.y.abs() <= settings.max_shift_px) {
            alignment.flags.push(AlignmentFlag::ShiftBeyondLimit);
            return;
        }
        alignment.shift_px = shift;
        runs("rotation");
        resample::shift_shades(moving, width, height, shift, shifted);
        match self.rotation.search(reference, shifted, width, height, settings.max_rotation_deg) {
            Some(best) => {
                alignment.rotation_deg = best.angle_deg;
                alignment.correlation = Some(best.correlation);
            }
            None => alignment.flags.push(AlignmentFlag::NoRotation),
        }
    }
}

/// The surface with infinite heights as no data; a copy only where there are any.
fn finite(surface: &Surface) -> Cow<'_, Surface> {
    if surface.values.iter().any(|v| v.is_infinite()) {
        let values =
            surface.values.iter().map(|v| if v.is_finite() { *v } else { f32::NAN }).collect();
        Cow::Owned(Surface::new(surface.width, surface.height, values))
    } else {
        Cow::Borrowed(surface)
    }
}
