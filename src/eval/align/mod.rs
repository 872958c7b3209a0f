//! Bringing a ground truth onto a prediction: shift, rotation, vertical offset.
//!
//! **Conventions.** Everything is stated as what is applied to the *ground truth*: first the shift
//! (+x east, +y south, pixels of the prediction), then the rotation about the centre of the image
//! (degrees, sign of `scipy.ndimage.rotate`), then the vertical offset is *subtracted*:
//! `error = prediction - (aligned truth - vertical offset)`.

use super::protocol::{OffsetMethod, Protocol};
use super::surface::Surface;
use serde::{Deserialize, Serialize};

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
/// # Errors
/// [`AlignError`] when no vertical offset can be found.
///
/// # Panics
/// When the sizes differ.
pub fn align(
    _prediction: &Surface,
    _truth: &Surface,
    _settings: &AlignSettings,
) -> Result<Alignment, AlignError> {
    unreachable!("written by the alignment work")
}

/// The ground truth (or another layer on its grid) shifted and rotated, without the vertical
/// offset. Pixels whose source is outside, or touches a pixel without data, become NaN.
#[must_use]
pub fn apply(_alignment: &Alignment, layer: &Surface) -> Surface {
    layer.clone()
}
