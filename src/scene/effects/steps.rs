//! Steps of a simulation's plan that are no effect: what is always done, and what becomes of a finished picture.

use super::HeightBounds;
use crate::plan::{Bound, Step};
use crate::scene::spec::{ImageColours, SceneSpec};

pub(super) fn projection_step() -> Step {
    Step {
        id: "projection".to_owned(),
        on: true,
        form: "EPSG:2927, closed form, every pixel".to_owned(),
        bound: Bound::horizontal(5e-8),
        cost: "0.3 us per pixel".to_owned(),
        cause: "images are Web Mercator, lidar is State Plane".to_owned(),
        reason: "the truth is taken at each pixel's own position".to_owned(),
    }
}

/// What becomes of a finished picture. No height depends on it.
pub(super) fn picture_steps(spec: &SceneSpec) -> [Step; 3] {
    let why = |on: bool, table: &str| {
        if on { "the scene asks for it".to_owned() } else { format!("no {table}") }
    };
    let palette = spec.images.colours == ImageColours::Palette;
    let step = |id: &str, on: bool, form: &str, cost: &str, cause: &str| {
        Step::exact(id, on, form, [cost, cause, &why(on, cause)])
    };
    [
        step(
            "camera",
            spec.camera.is_some(),
            "haze, white balance, contrast, blur, sharpening",
            "two passes over the picture",
            "[camera] table",
        ),
        step(
            "palette",
            palette,
            "256 colours by median cut",
            "one sort of the picture's colours",
            "images.colours = \"palette\"",
        ),
        step(
            "picture",
            spec.picture.is_some(),
            "GeoTIFF of the whole extent, and its heights",
            "as the images, over the whole extent",
            "[picture] table",
        ),
    ]
}

pub(super) fn units_step(heights: &HeightBounds, noise_m: f64) -> Step {
    // Half a step of a 32-bit float at the largest value, in feet: low land may lie deeper than it
    // stands high.
    let lowest = heights.highest - heights.above_ground - heights.ground_range;
    let largest_m = heights.highest.abs().max(lowest.abs()) + noise_m;
    let feet = (largest_m / crate::units::US_SURVEY_FOOT_M) as f32;
    let half_step = f64::from(feet.next_up() - feet) / 2.0;
    Step {
        id: "units".to_owned(),
        on: true,
        form: "metres to US survey feet, 32-bit float".to_owned(),
        bound: Bound::vertical(half_step * crate::units::US_SURVEY_FOOT_M),
        cost: "none".to_owned(),
        cause: "lidar is delivered in feet".to_owned(),
        reason: "rounding of the stored value".to_owned(),
    }
}
