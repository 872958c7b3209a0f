//! The plan of a benchmark build: each step with its bound, cost and cause.

use super::Coverage;
use super::options::{BuildOptions, GridKind, TransformChoice};
use super::tiles::{TileSet, datum_bound_m, moves_points};
use crate::lidar::{PHASE_BITS, Resampling, TransformForm};
use crate::plan::{Bound, Plan, Step};
use crate::units::LinearUnit;
use serde_json::{Map, Value, json};

/// What the plan says about horizontal bounds, in the form that the run needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Most that an image's transform may err under `auto`, metres.
    pub transform_m: f64,
    /// Sum of the horizontal bounds of all other steps under the program's control, metres.
    pub other_m: f64,
    /// Sum of the vertical bounds, metres.
    pub vertical_m: f64,
}

/// Rounding of the closed-form projection against PROJ, metres: 5e-8 with a datum step, 1e-8
/// without; held by the tests of `crs`.
const PROJECTION_BOUND_M: f64 = 5e-8;
/// Highest absolute height for which the storage bound is stated, metres.
pub const STATED_HEIGHT_M: f64 = 1024.0;

/// What rounding a height to 32 bits can move it, metres.
pub fn rounding_m(height_m: f64) -> f64 {
    height_m * f64::from(f32::EPSILON) / 2.0
}

/// Resolves the plan from what was asked for and what the tiles are.
pub fn resolve(options: &BuildOptions, tiles: &TileSet) -> (Plan, Budget) {
    let mut steps = Vec::new();
    operation_steps(options, tiles, &mut steps);
    let lattice_m = tiles
        .tiles()
        .iter()
        .map(|tile| tile.lattice.bound(tile.window) * tiles.crs[tile.crs].metres_per_unit)
        .fold(0.0, f64::max);
    let bits = tiles.tiles().first().map_or(PHASE_BITS, |tile| tile.lattice.phase_bits());
    steps.push(Step {
        id: "lattice".into(),
        on: true,
        form: format!("phase to 2^-{bits} pixel"),
        bound: Bound::horizontal(lattice_m),
        cost: "none per pixel".into(),
        cause: "corners of tiles cut from one raster differ by rounding".into(),
        reason: "tiles on one lattice get the same coordinates to the last bit".into(),
    });
    let before: f64 =
        steps.iter().filter(|s| s.id != Plan::OPERATION).map(|s| s.bound.horizontal_m).sum();
    let transform_m = (options.tolerance_m - before).max(0.0);
    steps.push(transform_step(options, transform_m));
    steps.push(coverage_step(options));
    steps.push(unit_step(tiles));
    steps.push(kernel_step(options));
    steps.push(vertical_step(tiles));
    steps.push(quantise_step(options));
    steps.push(Step {
        id: "storage".into(),
        on: true,
        form: "f32".into(),
        bound: Bound::vertical(rounding_m(STATED_HEIGHT_M)),
        cost: "none".into(),
        cause: "numpy and GDAL read f32".into(),
        reason: format!(
            "interpolation is f64, rounded once (bound for heights under {STATED_HEIGHT_M} m)"
        ),
    });
    steps.extend(output_steps(options));
    let plan = Plan {
        command: "dsm-bench build".into(),
        tolerance_m: options.tolerance_m,
        parameters: parameters(options, tiles),
        steps,
    };
    let budget = Budget { transform_m, other_m: before, vertical_m: plan.vertical_m() };
    (plan, budget)
}

fn operation_steps(options: &BuildOptions, tiles: &TileSet, steps: &mut Vec<Step>) {
    for crs in &tiles.crs {
        let operation = &crs.operation;
        let accuracy = operation.accuracy_m.unwrap_or(0.0);
        steps.push(Step {
            id: Plan::OPERATION.into(),
            on: true,
            form: operation.provider.clone(),
            bound: Bound::horizontal(accuracy),
            cost: "none".into(),
            cause: format!("how well {} is tied to WGS 84", crs.spec.name),
            reason: match operation.accuracy_m {
                Some(_) => format!(
                    "stated by the authority for \"{}\"; no program can do better",
                    operation.name
                ),
                None => format!("\"{}\" states no accuracy", operation.name),
            },
        });
        let shift = operation.datum_shift_m;
        let on = moves_points(operation, options);
        let left_out = shift > 0.0 && !on;
        steps.push(Step {
            id: "datum".into(),
            on,
            form: if shift > 0.0 { operation.name.clone() } else { "null shift".into() },
            bound: Bound::horizontal(if left_out { datum_bound_m(shift) } else { 0.0 }),
            cost: "3 x 3 rotation per projected point".into(),
            cause: format!("{} is not WGS 84: {shift:.3} m here", crs.spec.name),
            reason: if left_out {
                "its shift is under the tolerance".into()
            } else if shift > 0.0 {
                "its shift is above the tolerance".into()
            } else {
                "the operation does not move points".into()
            },
        });
    }
    steps.push(Step {
        id: "projection".into(),
        on: true,
        form: tiles.crs.first().map_or_else(String::new, |crs| crs.operation.provider.clone()),
        bound: Bound::horizontal(PROJECTION_BOUND_M),
        cost: "about 0.3 us per projected point".into(),
        cause: "images are in Web Mercator, tiles in another projection".into(),
        reason: "agreement with PROJ, held by tests".into(),
    });
}

fn transform_step(options: &BuildOptions, transform_m: f64) -> Step {
    let (form, bound, cost, reason) = match (options.grid, options.transform) {
        (GridKind::Reference, _) => (
            "axis-aligned box".to_owned(),
            0.0,
            "2 projections per image",
            "--grid reference: the published procedure's own grid, 0.7 m (7 px) off on average, 2.1 m at two corners, NOT counted in the bounds".to_owned(),
        ),
        (_, TransformChoice::Auto) => (
            "auto: affine, separable, chebyshev 3 x 3, exact".to_owned(),
            transform_m,
            "13 projections per image; exact: one per pixel",
            "per image, the first form whose measured bound is within what the tolerance leaves".to_owned(),
        ),
        (_, TransformChoice::Forced(TransformForm::Exact)) => {
            ("exact".to_owned(), 0.0, "one projection per pixel", "--transform exact".to_owned())
        }
        (_, TransformChoice::Forced(form)) => (
            form.name().to_owned(),
            0.0,
            "13 projections per image",
            format!("--transform {}: its measured bound is recorded per image, whatever the tolerance", form.name()),
        ),
    };
    Step {
        id: "transform".into(),
        on: true,
        form,
        bound: Bound::horizontal(bound),
        cost: cost.into(),
        cause: "the projection bends within an image (0.17 mm in Seattle)".into(),
        reason,
    }
}

fn unit_step(tiles: &TileSet) -> Step {
    let feet = tiles.crs.iter().any(|crs| crs.metres_per_unit != 1.0);
    let names: Vec<String> = tiles
        .crs
        .iter()
        .map(|crs| {
            crs.spec.linear_unit.map_or_else(|| "unknown unit".to_owned(), |u| u.name().to_owned())
        })
        .collect();
    Step {
        id: "horizontal-unit".into(),
        on: feet,
        form: names.join(", "),
        bound: Bound::EXACT,
        cost: "none".into(),
        cause: "coordinates of the tiles in feet".into(),
        reason: if feet {
            "pixel coordinates in the tiles' own unit".into()
        } else {
            "already metres".into()
        },
    }
}

fn kernel_step(options: &BuildOptions) -> Step {
    let cost = match options.resampling {
        Resampling::Nearest => "1 tap per pixel",
        Resampling::Bilinear => "4 taps per pixel",
        Resampling::Cubic => "16 taps per pixel",
        Resampling::Average => "all cells under a pixel",
    };
    Step {
        id: "kernel".into(),
        on: true,
        form: options.resampling.name().into(),
        bound: Bound::EXACT,
        cost: cost.into(),
        cause: "image pixels do not coincide with lidar cells".into(),
        reason: "GDAL's rule; widened by the ratio where the image is coarser than the tiles"
            .into(),
    }
}

fn coverage_step(options: &BuildOptions) -> Step {
    let (form, cost, reason) = match options.coverage {
        Coverage::BestTile => (
            "best tile",
            "candidates that could win are warped whole; of an image that is refused, a mosaic too",
            "as published: one survey flight per image, no joints",
        ),
        Coverage::Mosaic => (
            "mosaic",
            "layers are warped until no pixel is left empty",
            "--coverage mosaic: what the first tile leaves empty comes from the next",
        ),
    };
    Step::exact("coverage", true, form, [cost, "images that several tiles touch", reason])
}

fn output_steps(options: &BuildOptions) -> [Step; 5] {
    let output = |id: &str, on: bool, form: &str, cost: &str, cause: &str| {
        Step::exact(id, on, form, [cost, cause, if on { "asked for" } else { "not asked for" }])
    };
    [
        output(
            "bare-earth",
            !options.dtm.is_empty(),
            "key dtm, warped as the surface",
            "one warp more per image",
            "--dtm: heights above ground",
        ),
        output(
            "source-tile",
            options.source_tile,
            "key source_tile",
            "2 bytes per pixel",
            "--source-tile: which tile a pixel came from",
        ),
        output(
            "geotiff",
            options.geotiff,
            "COG",
            "one file per image",
            "--geotiff: GIS software reads it",
        ),
        output(
            "preview",
            options.preview,
            "hillshade as PNG",
            "one file per image",
            "--preview: to look at",
        ),
        output(
            "stac",
            options.stac,
            "a collection, an item per image",
            "one small file per image",
            "--stac: catalogues find it",
        ),
    ]
}

fn vertical_step(tiles: &TileSet) -> Step {
    let on = tiles.vertical_unit != LinearUnit::Metre;
    Step {
        id: "vertical-unit".into(),
        on,
        form: format!("{} -> metre", tiles.vertical_unit),
        bound: Bound::EXACT,
        cost: "1 multiplication per pixel".into(),
        cause: "heights of the tiles not in metres".into(),
        reason: format!("unit found in: {}", tiles.vertical_evidence),
    }
}

fn quantise_step(options: &BuildOptions) -> Step {
    let (on, form, bound, reason) = match options.quantise {
        Some(q) => (true, format!("multiples of {} m", q.step_m), q.step_m / 2.0, "--quantise"),
        None => (false, "none".to_owned(), 0.0, "not asked for"),
    };
    Step {
        id: "quantise".into(),
        on,
        form,
        bound: Bound::vertical(bound),
        cost: "1 rounding per pixel; saves space and encoding time".into(),
        cause: "lidar heights carry less than f32 can hold".into(),
        reason: reason.into(),
    }
}

fn parameters(options: &BuildOptions, tiles: &TileSet) -> Map<String, Value> {
    let operations: Vec<Value> = tiles
        .crs
        .iter()
        .map(|crs| {
            json!({
                "crs": crs.spec.epsg.map_or_else(|| crs.spec.name.clone(), |code| format!("EPSG:{code}")),
                "operation": crs.operation.definition,
            })
        })
        .collect();
    let value = json!({
        "zoom": options.zoom,
        "size": options.size,
        "max_nan_pct": options.max_nan_pct,
        "grid": options.grid,
        "transform": options.transform.name(),
        "resampling": options.resampling,
        "edge": options.edge,
        "nodata": options.nodata,
        "coverage": options.coverage,
        "source_tile": options.source_tile,
        "quantise_m": options.quantise.map(|q| q.step_m),
        "vertical_unit": tiles.vertical_unit,
        "dtm": !options.dtm.is_empty(),
        "geotiff": options.geotiff,
        "vertical_crs": options.vertical_crs,
        "preview": options.preview,
        "operations": operations,
        "format": 1,
    });
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
