//! The plan of an inference run: each step with its bound, cost and cause.

use super::GROUND_TOLERANCE;
use super::options::InferOptions;
use crate::footprint::{Footprint, TRAINING_WIDTH_M, VerticalScale};
use crate::illumination::Illumination;
use crate::model::mesh::MeshLattice;
use crate::model::network::Execution;
use crate::model::render::{DepthKind, RELEASED_RMS, STABLE_RMS, SampleCounts, Sampling};
use crate::plan::network::{kind, precision_step};
use crate::plan::{Bound, Plan, Step};
use crate::weights::Identity;
use serde_json::{Map, Value, json};

/// Floating-point operations of the point head per point, density alone, before folding.
const HEAD_FLOP: f64 = 8.3e3;

/// What the inputs are, as far as the plan depends on it.
pub struct Inputs<'a> {
    /// Whether there are pictures, so that the network runs.
    pub pictures: bool,
    /// The weights, where there are any.
    pub identity: Option<&'a Identity>,
    /// Pixels that the network takes across and down.
    pub side: usize,
    /// The light of street views.
    pub light: Option<&'a Illumination>,
    /// How the network is calculated, where there is one.
    pub execution: Option<Execution>,
}

/// Metres of height per cube unit of an image as large on the ground as those of the training: for
/// these the bounds are stated. Under [`VerticalScale::Isotropic`] those of another image are in
/// proportion to its ground.
pub fn usual_metres_per_unit(vertical: VerticalScale) -> f64 {
    Footprint::of_training([256; 2]).vertical_metres_per_unit(vertical, CROP_SCALE)
}

/// Share of the cube that a crop of the released network fills.
const CROP_SCALE: f64 = 0.8;

/// Resolves the plan.
pub fn resolve(options: &InferOptions, inputs: &Inputs<'_>) -> Plan {
    let mut steps = network_steps(options, inputs);
    steps.extend(effect_steps(options, inputs.light));
    steps.extend(height_steps(options));
    steps.extend(output_steps(options));
    steps.extend(options.outputs.views.steps());
    Plan {
        command: "infer".into(),
        tolerance_m: options.compute.tolerance_m,
        parameters: parameters(options, inputs),
        steps,
    }
}

fn network_steps(options: &InferOptions, inputs: &Inputs<'_>) -> Vec<Step> {
    let on = inputs.pictures;
    let why = |reason: &'static str| if on { reason } else { "the inputs are scenes already" };
    let side = inputs.side;
    let ground = match options.gsd_m {
        Some([across, down]) => format!("--gsd {across},{down} m per pixel"),
        None => "from name or georeference".into(),
    };
    let precision =
        precision_step(inputs.execution, &options.compute, usual_metres_per_unit(options.vertical));
    let how = precision.form.clone();
    vec![
        Step::exact(
            "decode",
            on,
            "RGB, 8 bits",
            [
                "one image in memory, while the one before is in the network",
                "the network takes RGB",
                why("alpha is dropped, 16 bits are scaled to 8"),
            ],
        ),
        Step {
            reason: format!(
                "checked per image: more than {} % beside {TRAINING_WIDTH_M} m is flagged, nothing is resampled",
                100.0 * GROUND_TOLERANCE
            ),
            ..Step::exact(
                "ground-size",
                true,
                ground,
                ["none", "the network knows no scale but that of its training", ""],
            )
        },
        Step::exact(
            "resize",
            on,
            format!("{side} x {side}, bicubic in fixed point"),
            [
                "two passes over the image",
                "the encoder takes one size",
                why("bit-equal to Pillow's, which the weights were trained with"),
            ],
        ),
        Step::exact(
            "network",
            on,
            how,
            [
                "165 GFLOP of the encoder and 981 of the decoder per image (released network)",
                "every output needs the field",
                why(
                    "in fp32 tokens within 1e-5 of the reference, planes within 3e-5, relative, by the parity tests",
                ),
            ],
        ),
        precision,
        Step::exact(
            "fold",
            true,
            "first layer of the point head into the texels",
            [
                "0.4 GFLOP per image; saves that layer at every point",
                "sampling and the layer are both linear",
                "exact up to the rounding of f32",
            ],
        ),
    ]
}

fn effect_steps(options: &InferOptions, light: Option<&Illumination>) -> Vec<Step> {
    let outputs = &options.outputs;
    let why = |on: bool, off: &'static str| if on { "an output needs it" } else { off };
    let (colour, sky, sharp) =
        (outputs.needs_colour(), outputs.needs_sky(), outputs.needs_super_resolution());
    vec![
        Step::exact(
            "colour",
            colour,
            "two linear maps folded into one",
            [
                "7.1 kFLOP per point, before folding",
                "outputs that show colours",
                why(colour, "heights need density alone; its layers are not evaluated"),
            ],
        ),
        Step::exact(
            "sky",
            sky,
            light
                .map_or_else(|| "mapping and sky decoder".to_owned(), |light| light.origin.clone()),
            [
                "117 GFLOP per illumination (released network)",
                "rays that leave the scene: street views",
                why(sky, "no ray of these outputs leaves the scene; its weights are not read"),
            ],
        ),
        Step::exact(
            "super-resolution",
            sharp,
            "2 x",
            [
                "44.5 GFLOP per panorama (released network)",
                "street views are rendered at half size",
                why(sharp, "no view is asked for; its weights are not read"),
            ],
        ),
    ]
}

fn height_steps(options: &InferOptions) -> Vec<Step> {
    let outputs = &options.outputs;
    let on = outputs.needs_heights();
    let views = !outputs.views.is_empty();
    let render = &options.render;
    let (coarse, fine) = (render.samples.coarse(), render.samples.fine());
    let rays = f64::from(options.size) * f64::from(options.size);
    let gflop = rays * (coarse + fine) as f64 * HEAD_FLOP / 1e9;
    let (name, rms, why) = match render.sampling {
        Sampling::Reference => {
            ("reference", RELEASED_RMS, "as released, so that published numbers follow")
        }
        Sampling::Stable => ("stable", STABLE_RMS, "--sampling stable"),
    };
    let measured = render.samples == SampleCounts::default();
    let unit_m = usual_metres_per_unit(options.vertical);
    let rms_m = if on && measured { rms * unit_m } else { 0.0 };
    let reason = match (on, measured) {
        (true, true) => format!(
            "{why}; measured, not proven: rms against the exact integral on closed-form fields, the worst of four, depth normalised"
        ),
        (true, false) => format!(
            "{why}; the error of so many samples was not measured, NOT counted in the bounds"
        ),
        (false, _) => why.to_owned(),
    };
    let (depth, depth_reason) = match render.depth_kind() {
        DepthKind::Raw => (
            "raw: sum of weight x distance",
            "as trained and scored; half-transparent pixels read too high, NOT counted in the bounds",
        ),
        DepthKind::Normalised => (
            "normalised: divided by opacity",
            "asked for, or implied by --sampling stable; no data under an opacity of 0.05",
        ),
    };
    let (scale, scale_reason) = match options.vertical {
        VerticalScale::Paper => (
            format!("paper: {TRAINING_WIDTH_M} m per 1.0"),
            "the published scoring; 0.8 of the true proportion of the released cube",
        ),
        VerticalScale::Isotropic => (
            "isotropic: from the image's ground, over the crop's share of the cube".to_owned(),
            "--vertical-scale isotropic: as many metres per cube unit up as across",
        ),
    };
    // Half a step of 32 bits under 1, and a whole one of the metres that a GeoTIFF holds.
    let storage_m = 0.75 * 2.0 * unit_m * f64::from(f32::EPSILON);
    vec![
        Step {
            bound: Bound::vertical(rms_m),
            cost: format!("{gflop:.0} GFLOP per DSM, before folding"),
            reason,
            ..Step::exact(
                "rays",
                on || views,
                format!("{name}, {coarse} + {fine} samples"),
                ["", "the surface is an integral along a ray", ""],
            )
        },
        Step::exact(
            "depth",
            on || outputs.views.depth,
            depth,
            ["none", "rays that the scene does not stop wholly", depth_reason],
        ),
        Step::exact(
            "vertical-scale",
            true,
            scale,
            ["none", "the cube has no height of its own: a convention, no error", scale_reason],
        ),
        Step {
            bound: Bound::vertical(if on { storage_m } else { 0.0 }),
            ..Step::exact(
                "storage",
                on,
                "f32",
                ["none", "numpy and GDAL read f32", "heights of the cube lie in [0, 1]"],
            )
        },
    ]
}

fn output_steps(options: &InferOptions) -> Vec<Step> {
    let outputs = &options.outputs;
    let asked = |on: bool| if on { "asked for" } else { "not asked for" };
    vec![
        Step::exact(
            "npz",
            outputs.dsm,
            format!("arr_0, {0} x {0}", options.size),
            ["3 arrays per image", "numpy and sat3d eval read it", asked(outputs.dsm)],
        ),
        Step::exact(
            "geotiff",
            outputs.geotiff,
            "COG on the image's footprint",
            ["one file per image", "GIS software reads it", asked(outputs.geotiff)],
        ),
        Step::exact(
            "scene",
            outputs.scene,
            "safetensors",
            [
                "26 MB per image (released network)",
                "rendering again without the network",
                asked(outputs.scene),
            ],
        ),
        Step::exact(
            "mesh",
            outputs.mesh.is_some(),
            outputs.mesh.as_ref().map_or_else(
                || "marching cubes".to_owned(),
                |mesh| {
                    let format = mesh.format.extension();
                    format!(
                        "marching cubes at {}, {}, {format}",
                        mesh.isovalue,
                        points(mesh.lattice)
                    )
                },
            ),
            [
                "174 GFLOP per image at 256 x 256 x 320 points, before folding",
                "a surface as triangles",
                asked(outputs.mesh.is_some()),
            ],
        ),
        Step::exact(
            "density",
            outputs.density.is_some(),
            outputs.density.as_ref().map_or_else(
                || "volume".to_owned(),
                |volume| format!("{:?}, {}", volume.format, points(volume.lattice)).to_lowercase(),
            ),
            [
                "as the mesh's; 84 MB per image at 256 x 256 x 320 points",
                "densities for other programs",
                asked(outputs.density.is_some()),
            ],
        ),
    ]
}

/// Where a mesh or a volume takes its densities.
fn points(lattice: MeshLattice) -> String {
    match lattice {
        MeshLattice::Pixels { size } => format!("{size} x {size} columns on the pixels"),
        MeshLattice::Reference { count } => {
            format!("the released grid of {count}, drift included")
        }
    }
}

fn parameters(options: &InferOptions, inputs: &Inputs<'_>) -> Map<String, Value> {
    let value = json!({
        "weights": inputs.identity,
        "network": inputs.execution.as_ref().map(kind),
        "outputs": options.outputs,
        "size": options.size,
        "render": options.render,
        "vertical_scale": options.vertical,
        "gsd_m": options.gsd_m,
        "illumination": inputs.light.map(|light| {
            let mut light = light.parameters();
            light["stored_skies_kept"] = options.illumination.is_none().into();
            light
        }),
        "format": 1,
    });
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
