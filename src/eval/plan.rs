//! The plan of an evaluation: each step with its bound, cost and cause.

use super::inputs::Demands;
use super::options::{EvalOptions, Settings};
use super::protocol::{OffsetMethod, Protocol};
use super::resize::Resize;
use crate::plan::{Bound, Plan, Step};
use serde_json::Value;

/// Steps per pixel of the published shift, and degrees between the rotations that it looks at.
const SHIFT_STEPS: f64 = 10.0;
const ROTATION_STEP_DEG: f64 = 0.5;
/// Size of an error for which the bound of its rounding is stated, metres.
const STATED_ERROR_M: f64 = 1024.0;

/// Resolves the plan from what was asked for and what the files call for.
pub fn resolve(options: &EvalOptions, settings: &Settings, demands: &Demands) -> Plan {
    let mut steps = Vec::from(input_steps(options, demands));
    steps.extend(alignment_steps(options, demands));
    steps.extend(place_steps(options, demands));
    steps.extend(number_steps(options));
    steps.extend(output_steps(options));
    Plan {
        command: "eval".into(),
        tolerance_m: 0.0,
        parameters: match serde_json::to_value(settings) {
            Ok(Value::Object(map)) => map,
            _ => serde_json::Map::new(),
        },
        steps,
    }
}

fn input_steps(options: &EvalOptions, demands: &Demands) -> [Step; 2] {
    let Demands { pairs, scaled, resized, .. } = *demands;
    let stated = options.inputs.metres_per_unit.map(|scale| format!("--metres-per-unit {scale}"));
    let (form, cost, reach_px) = match options.resize {
        Resize::Reference => ("bilinear, no antialiasing", "4 taps per pixel", demands.truth_m),
        Resize::Area => {
            ("mean over a pixel's area", "every truth pixel once", demands.pixel_m / 2.0)
        }
    };
    let known = reach_px > 0.0;
    [
        Step::exact(
            "scale",
            scaled > 0,
            stated.unwrap_or_else(|| "metres_per_unit of the file, else 64.48".to_owned()),
            [
                "1 multiplication per pixel",
                "heights in units of the scene cube",
                &format!("{scaled} of {pairs} pairs have a prediction that is not in metres"),
            ],
        ),
        Step {
            // No height comes from farther away than this along each axis.
            bound: Bound::horizontal(if resized > 0 {
                reach_px * std::f64::consts::SQRT_2
            } else {
                0.0
            }),
            ..Step::exact(
                "resize",
                resized > 0,
                form,
                [
                    cost,
                    "truth and prediction have different numbers of pixels",
                    &match (resized, known) {
                        (0, _) => format!("the sizes of all {pairs} pairs agree"),
                        (_, true) => format!("{resized} of {pairs} pairs differ"),
                        (_, false) => format!(
                            "{resized} of {pairs} pairs differ; no pixel's size on the ground is known, so the bound is NOT counted"
                        ),
                    },
                ],
            )
        },
    ]
}

fn alignment_steps(options: &EvalOptions, demands: &Demands) -> [Step; 4] {
    let with = |wanted: &[Protocol]| options.protocols.iter().any(|p| wanted.contains(p));
    let why = |on: bool, yes: &'static str| if on { yes } else { "no protocol asks for it" };
    let paper = with(&[Protocol::Paper]);
    let coregister = with(&[Protocol::Coregister]);
    let offset = options.protocols.iter().any(|&protocol| protocol != Protocol::Plain);
    let mut methods: Vec<&str> = Vec::new();
    for &protocol in options.protocols.iter().filter(|&&protocol| protocol != Protocol::Plain) {
        let name = match options.offset_for(protocol) {
            OffsetMethod::Ransac => "RANSAC of 150 draws",
            OffsetMethod::Median => "median",
            OffsetMethod::Mean => "mean",
        };
        if !methods.contains(&name) {
            methods.push(name);
        }
    }
    let grid = |on: bool, px: f64| Bound::horizontal(if on { px * demands.pixel_m } else { 0.0 });
    // Half a step of the rotation, at the corner of the image.
    let turned = (ROTATION_STEP_DEG / 2.0).to_radians() * demands.half_diagonal_px;
    [
        Step {
            bound: grid(paper, std::f64::consts::FRAC_1_SQRT_2 / SHIFT_STEPS),
            ..Step::exact(
                "shift",
                paper,
                "phase correlation, steps of 0.1 pixel",
                [
                    "3 Fourier transforms per image",
                    "images and truth lie metres apart",
                    why(paper, "--protocol paper: as published; the bound is half a step"),
                ],
            )
        },
        Step {
            bound: grid(paper, turned),
            ..Step::exact(
                "rotation",
                paper,
                "search over 10 degrees, steps of 0.5",
                [
                    "41 correlations per image",
                    "the published procedure allows for a turn",
                    why(
                        paper,
                        "--protocol paper: as published; the bound is half a step at a corner",
                    ),
                ],
            )
        },
        Step {
            bound: grid(coregister, 0.5),
            ..Step::exact(
                "coregistration",
                coregister,
                "Nuth and Kaab on four levels",
                [
                    "up to 96 fits per image",
                    "images and truth lie metres apart",
                    why(
                        coregister,
                        "--protocol coregister; a standard error over half a pixel is flagged and not applied",
                    ),
                ],
            )
        },
        Step::exact(
            "vertical-offset",
            offset,
            if methods.is_empty() { "none".to_owned() } else { methods.join(", ") },
            [
                "one pass over the pixels; RANSAC 150 of them over 50 pixels",
                "a predicted height has an arbitrary zero",
                why(offset, "every protocol but plain"),
            ],
        ),
    ]
}

fn place_steps(options: &EvalOptions, demands: &Demands) -> [Step; 4] {
    let Demands { pairs, placed, ground, .. } = *demands;
    let mask = options.mask.is_some() && demands.named > 0;
    let registration = options.registration_images > 0 && placed > 0;
    let unplaced = "no pixel's size on the ground is known; say --gsd";
    [
        Step::exact(
            "strata",
            placed > 0,
            "slope, distance to the nearest edge",
            [
                "two passes over the truth per image and protocol",
                "errors differ by kind of place",
                &if placed > 0 {
                    format!("{placed} of {pairs} pairs say how large a pixel is")
                } else {
                    unplaced.to_owned()
                },
            ],
        ),
        Step::exact(
            "height-above-ground",
            ground > 0,
            "truth minus bare earth",
            [
                "bare earth is moved as the truth is",
                "truths with a bare earth (dtm)",
                &if ground > 0 {
                    format!("{ground} of {pairs} truths have one")
                } else {
                    "no truth has one".to_owned()
                },
            ],
        ),
        Step::exact(
            "classes",
            mask,
            "class at a pixel's centre",
            [
                "one look-up per pixel",
                "--mask: classes of places",
                match (mask, options.mask.is_some()) {
                    (true, _) => "asked for",
                    (_, true) => "no name says where an image lies",
                    (_, false) => "not asked for",
                },
            ],
        ),
        Step::exact(
            "registration",
            registration,
            format!("least squares over up to {} images", options.registration_images),
            [
                "about as much as the paper's alignment, per image that it takes",
                "an offset that all images share is not the model's fault",
                match (registration, options.registration_images) {
                    (true, _) => "estimated and reported, never applied",
                    (_, 0) => "--registration 0",
                    _ => unplaced,
                },
            ],
        ),
    ]
}

fn number_steps(options: &EvalOptions) -> [Step; 4] {
    let sets = options.predictions.len();
    let [draws, block] = [f64::from(options.replicates), options.block_m];
    [
        Step::exact(
            "sums",
            true,
            "64 bits, chunks of 16 images in order",
            [
                "one pass over the errors",
                "the last digits must not depend on threads",
                "means, shares, histogram, map of positions",
            ],
        ),
        Step {
            bound: Bound::vertical(STATED_ERROR_M * f64::from(f32::EPSILON) / 2.0),
            ..Step::exact(
                "quantiles",
                true,
                "exact order statistics, two passes",
                [
                    "errors beyond --memory are computed twice",
                    "a city's errors do not fit memory",
                    &format!(
                        "errors are rounded to f32 (bound for errors under {STATED_ERROR_M} m)"
                    ),
                ],
            )
        },
        Step::exact(
            "bootstrap",
            options.replicates > 0,
            format!("{draws} draws of blocks of {block} m"),
            [
                "draws times images, on sketches of their errors",
                "images overlap and are no independent samples",
                if options.replicates > 0 {
                    "95 % intervals; seeded, so that they are the same again"
                } else {
                    "--replicates 0"
                },
            ],
        ),
        Step::exact(
            "differences",
            sets > 1,
            "paired, over the same blocks",
            [
                "one bootstrap per pair of models",
                "several models on the same images",
                if sets > 1 {
                    "Holm's correction over the pairs"
                } else {
                    "one set of predictions"
                },
            ],
        ),
    ]
}

fn output_steps(options: &EvalOptions) -> [Step; 4] {
    let outputs = options.outputs;
    let output = |id: &str, on: bool, form: &str, cost: &str, cause: &str| {
        Step::exact(id, on, form, [cost, cause, if on { "asked for" } else { "not asked for" }])
    };
    [
        output(
            "error-rasters",
            options.errors.is_some(),
            "COG where the place is known, else npz",
            "one file per image, model and protocol",
            "--errors: errors on a map",
        ),
        output(
            "table",
            outputs.table,
            "a row per image",
            "one file each",
            "--csv, --parquet: scores for other programs",
        ),
        output(
            "report",
            outputs.report,
            "one HTML file",
            "up to nine images are read again",
            "--report: charts, maps, pictures",
        ),
        output(
            "published",
            outputs.published,
            "rows of the paper's table",
            "none",
            "--against paper: numbers to stand beside",
        ),
    ]
}
