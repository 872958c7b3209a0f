//! The plan of a run: each step with its bound, cost and cause.

use super::city::City;
use super::dsm::{DsmGrid, TRANSFORM_BUDGET_M};
use super::finish::parse_srs;
use super::layout::{AxisWindows, Blend, WINDOW};
use super::network::TileLattice;
use super::options::{TileOptions, TileOutputs};
use super::surface::output::CityMeshColour;
use crate::model::network::Execution;
use crate::plan::network::{kind, precision_step};
use crate::plan::{Bound, Plan, Step};
use crate::weights::Identity;
use serde_json::{Map, Value, json};

/// Error of the column integral's fixed cells beside `sat3d infer --sampling stable` on the box city, cube units:
/// mean absolute difference, measured (`tests/tile_engine.rs` holds it).
pub const COLUMN_MEAN: f64 = 1.0e-3;

/// What the plan depends on beside the options.
pub struct Inputs<'a> {
    /// The lattice.
    pub city: &'a City,
    /// Windows along x and y.
    pub windows: &'a [AxisWindows; 2],
    /// Which way the size on the ground was found.
    pub ground: &'a str,
    /// Columns and rows of the picture as it was given.
    pub picture: [u32; 2],
    /// Bytes of the picture's file.
    pub picture_bytes: u64,
    /// Whether some of its pixels may hold no data.
    pub masked: bool,
    /// The weights.
    pub identity: &'a Identity,
    /// How the network is calculated.
    pub execution: Execution,
    /// What is written.
    pub outputs: &'a TileOutputs,
    /// Bytes of the sums of open lines.
    pub open_bytes: u64,
}

/// Resolves the plan.
pub fn resolve(options: &TileOptions, inputs: &Inputs<'_>) -> Plan {
    let mut steps = picture_steps(inputs);
    steps.extend(window_steps(options, inputs));
    steps.push(precision_step(Some(inputs.execution), &options.compute, inputs.city.vertical_m));
    steps.extend(height_steps(options, inputs));
    steps.extend(surface_steps(options, inputs));
    Plan {
        command: "tile".into(),
        tolerance_m: options.compute.tolerance_m,
        parameters: parameters(options, inputs),
        steps,
    }
}

fn picture_steps(inputs: &Inputs<'_>) -> Vec<Step> {
    let [columns, rows] = inputs.city.size;
    let same = inputs.city.size == inputs.picture;
    let [across, down] = inputs.city.gsd_m();
    vec![
        Step::exact(
            "ground-size",
            true,
            inputs.ground,
            [
                "none",
                "the network knows no scale but that of its training",
                if inputs.city.assumed {
                    "neither a georeference nor --gsd says how large a pixel is: assumed"
                } else {
                    "metres per pixel from the georeference, the name, or --gsd"
                },
            ],
        ),
        Step::exact(
            "resample",
            !same,
            format!("{columns} x {rows} model pixels, bicubic in fixed point"),
            [
                "two passes over the picture, once for all windows",
                "pixels of another size than the network's",
                if same {
                    "the picture has the model's pixels already"
                } else {
                    "bit-equal to Pillow's"
                },
            ],
        ),
        Step::exact(
            "spool",
            true,
            "model pixels on disk",
            ["4 bytes per model pixel", "windows overlap", "the picture is read and decoded once"],
        ),
        Step {
            reason: format!(
                "one ground sample distance for the whole picture, {across:.4} x {down:.4} m, that of its centre"
            ),
            ..Step::exact(
                "scale",
                true,
                "at the centre",
                ["none", "Mercator's scale grows with latitude", ""],
            )
        },
        Step::exact(
            "no-data",
            inputs.masked,
            "windows without data left out, their columns empty",
            [
                "one byte per pixel",
                "alpha, a no-data value or a mask",
                if inputs.masked { "the picture has some" } else { "the picture has none" },
            ],
        ),
    ]
}

fn window_steps(options: &TileOptions, inputs: &Inputs<'_>) -> Vec<Step> {
    let [x, y] = inputs.windows.each_ref().map(|axis| axis.all().len());
    let count = x * y;
    let windows = &options.windows;
    let overlap = count > 1;
    let points = u64::from(WINDOW) * u64::from(WINDOW) * inputs.city.levels.z.len() as u64;
    vec![
        Step {
            cost: format!("1146 GFLOP per window (released network), {count} windows"),
            ..Step::exact(
                "network",
                true,
                format!("{count} windows of {WINDOW}, every {} pixels", windows.stride),
                ["", "the network takes one window", "as in sat3d infer, bit for bit"],
            )
        },
        Step {
            cost: format!("{points} densities per window"),
            bound: match options.lattice {
                TileLattice::Pixels => Bound::EXACT,
                // Up to one voxel of the released grid along both axes; 319 of them span what 320 pixels
                // of a window would.
                TileLattice::Reference => {
                    let [across, down] = inputs.city.gsd_m();
                    Bound::horizontal(320.0 / 319.0 * libm::hypot(across, down))
                }
            },
            ..Step::exact(
                "densities",
                true,
                options.lattice.name(),
                [
                    "",
                    "windows are joined where their columns are the same",
                    match options.lattice {
                        TileLattice::Pixels => {
                            "columns at the pixels' centres, equal in all windows"
                        }
                        TileLattice::Reference => {
                            "the released grid, whose columns drift by up to one voxel"
                        }
                    },
                ],
            )
        },
        Step::exact(
            "blend",
            overlap,
            match windows.blend {
                Blend::Mean => "mean of densities".to_owned(),
                other => format!("{} weights, density", other.name()),
            },
            [
                "one multiplication and addition per density",
                "windows overlap and do not agree",
                if overlap { "weights sum to one everywhere" } else { "a single window" },
            ],
        ),
        Step::exact(
            "trim",
            windows.trim > 0,
            format!("{} pixels of interior sides", windows.trim),
            [
                "more windows for the same ground",
                "the network sees least at a window's border",
                if windows.trim > 0 { "--trim" } else { "the paper drops none" },
            ],
        ),
        Step::exact(
            "spill",
            true,
            "sums of open lines, in a file beyond --memory",
            [
                &format!(
                    "{:.2} GB for {} open lines",
                    inputs.open_bytes as f64 / 1e9,
                    WINDOW.min(inputs.city.lines_across()[0])
                ),
                "memory grows with the shorter side",
                // Where they are kept changes no byte, so it is no part of the plan.
                "the same numbers in both places",
            ],
        ),
    ]
}

fn height_steps(options: &TileOptions, inputs: &Inputs<'_>) -> Vec<Step> {
    let unit_m = inputs.city.vertical_m;
    let dsm = inputs.outputs.dsm.as_ref();
    let t_srs = dsm.and_then(|dsm| dsm.t_srs.as_deref());
    // Checked before; the picture's own CRS needs no warp.
    let crs = t_srs.and_then(|srs| parse_srs(srs).ok());
    let warp =
        t_srs.filter(|_| DsmGrid::new(inputs.city, crs.as_ref()).is_ok_and(|grid| !grid.is_own()));
    vec![
        Step {
            bound: Bound::vertical(COLUMN_MEAN * unit_m),
            ..Step::exact(
                "column-integral",
                true,
                format!("{} cells, exact in each", inputs.city.levels.z.len()),
                [
                    "one integral per column",
                    "a height is where light from above ends",
                    "measured, not proven: mean difference to the stable rule of infer on a city of boxes",
                ],
            )
        },
        Step::exact(
            "vertical-scale",
            true,
            format!("{unit_m:.4} m per cube unit"),
            [
                "none",
                "the cube has no height of its own: a convention, no error",
                match options.vertical {
                    crate::footprint::VerticalScale::Paper => "the published scoring",
                    crate::footprint::VerticalScale::Isotropic => "--vertical-scale isotropic",
                },
            ],
        ),
        Step {
            bound: if warp.is_some() {
                Bound::horizontal(TRANSFORM_BUDGET_M)
            } else {
                Bound::EXACT
            },
            ..Step::exact(
                "warp",
                warp.is_some(),
                warp.map_or_else(|| "bilinear".to_owned(), |to| format!("bilinear to {to}")),
                [
                    "one projection and four heights per pixel",
                    "a CRS other than the picture's",
                    if warp.is_some() { "--t_srs" } else { "the DSM has the picture's own pixels" },
                ],
            )
        },
        Step::exact(
            "dsm",
            dsm.is_some(),
            if dsm.is_some_and(|dsm| dsm.preview) { "COG, hillshade as PNG" } else { "COG" },
            [
                "one file, in bands of rows; jumps at the borders of windows are measured",
                "a height per model pixel",
                if dsm.is_some() { "asked for" } else { "not asked for" },
            ],
        ),
        Step {
            bound: Bound::vertical(2.0 * unit_m * f64::from(f32::EPSILON) / 2.0),
            ..Step::exact(
                "storage",
                dsm.is_some(),
                "f32",
                ["none", "numpy and GDAL read f32", "metres above the cube's bottom"],
            )
        },
    ]
}

fn surface_steps(options: &TileOptions, inputs: &Inputs<'_>) -> Vec<Step> {
    let outputs = inputs.outputs;
    let (mesh, tiles) = (outputs.mesh.as_ref(), outputs.tiles3d.as_ref());
    let asked = |on: bool| if on { "asked for" } else { "not asked for" };
    let simplify = mesh.and_then(|mesh| match (mesh.error_m, mesh.max_triangles) {
        (Some(error), Some(most)) => Some(format!("to {error} m, at most {most} triangles")),
        (Some(error), None) => Some(format!("to {error} m")),
        (None, Some(most)) => Some(format!("to {most} triangles")),
        (None, None) => None,
    });
    let horizontal = mesh.and_then(|mesh| mesh.error_m).unwrap_or(0.0);
    vec![
        Step::exact(
            "surface",
            outputs.needs_surface(),
            format!("marching cubes at {}, slab by slab", options.isovalue),
            [
                "48 bytes on disk per vertex until the mesh is written",
                "a surface as triangles",
                asked(outputs.needs_surface()),
            ],
        ),
        Step {
            bound: Bound { horizontal_m: horizontal, vertical_m: horizontal },
            ..Step::exact(
                "simplify",
                simplify.is_some(),
                simplify.unwrap_or_else(|| "quadrics".to_owned()),
                [
                    "about a second per million triangles",
                    "flat ground needs few triangles",
                    if mesh.is_some_and(|m| m.error_m.is_some() || m.max_triangles.is_some()) {
                        "asked for"
                    } else {
                        "not asked for; 3D Tiles have their own"
                    },
                ],
            )
        },
        Step::exact(
            "colour",
            tiles.is_some() || mesh.is_some_and(|mesh| mesh.color != CityMeshColour::None),
            match mesh.map(|mesh| mesh.color) {
                Some(CityMeshColour::Texture) => "the picture as a texture",
                Some(CityMeshColour::Vertices) => "the picture at each vertex",
                _ => "the picture",
            },
            [
                "three bytes per pixel",
                "a mesh that shows the ground",
                "the picture from above, on walls too",
            ],
        ),
        Step::exact(
            "mesh",
            mesh.is_some(),
            mesh.map_or("one file", |mesh| mesh.format.extension()),
            [
                "vertices in 32 bits about the city's centre",
                "one surface to open elsewhere",
                asked(mesh.is_some()),
            ],
        ),
        Step {
            bound: Bound {
                horizontal_m: tiles.map_or(0.0, |tiles| tiles.error_m),
                vertical_m: tiles.map_or(0.0, |tiles| tiles.error_m),
            },
            ..Step::exact(
                "tiles3d",
                tiles.is_some(),
                tiles.map_or_else(
                    || "levels of detail".to_owned(),
                    |tiles| format!("finest level within {} m", tiles.error_m),
                ),
                [
                    "a tree of simplified tiles",
                    "browsers draw what they see",
                    asked(tiles.is_some()),
                ],
            )
        },
        Step::exact(
            "volume",
            outputs.density.is_some(),
            "Zarr v3, chunks of 64 x 64 x 64",
            [
                "84 MB per 256 x 256 pixels, compressed to about half",
                "densities for other programs",
                asked(outputs.density.is_some()),
            ],
        ),
    ]
}

fn parameters(options: &TileOptions, inputs: &Inputs<'_>) -> Map<String, Value> {
    let value = json!({
        "weights": inputs.identity,
        "network": kind(&inputs.execution),
        "picture": { "size_px": inputs.picture, "bytes": inputs.picture_bytes },
        "city": inputs.city,
        "outputs": inputs.outputs,
        "windows": options.windows,
        "lattice": options.lattice,
        "isovalue": options.isovalue,
        "vertical_scale": options.vertical,
        "format": 1,
    });
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
