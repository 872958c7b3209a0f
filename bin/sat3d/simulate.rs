//! `sat3d simulate`: a city with exact truth.

use crate::console;
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::scene::effects::DEFAULT_TOLERANCE;
use sat3d::scene::whole::{PICTURE_FILE, TRUTH_FILE};
use sat3d::scene::{Effect, Options, Scene, SceneError, SceneSpec, Summary, simulate};
use sat3d::units::Metres;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Instant;

/// Simulate a city with exact truth: lidar tiles, satellite images, labels, and the true heights.
///
/// The scene file (TOML) says what the city is like; every key has a default. Lidar is written as
/// King County delivers it (EPSG:2927, US survey feet), images and labels as VIGOR lays them out.
/// Shadows, leaning roofs, noise, gaps, seasons and change are simulated only if the scene calls
/// for them and leaving them out would be noticed; --explain lists each with its bound.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d simulate pipelines/scenes/quickstart.toml
  sat3d simulate pipelines/scenes/towers_off_nadir.toml --out towers --explain
  sat3d simulate city.toml --out noiseless --without noise
  sat3d simulate pipelines/scenes/city_3km.toml --out city

Writes lidar/ (surface), lidar_dtm/ (bare earth), vigor/ (images and labels), truth/ (exact heights
on each image's pixels: key `dsm` in metres, `dtm`, `smooth`, `class`) and scene.json; with a table
[picture] in the scene file also picture.tif, one picture of the whole city, and picture_dsm.tif,
the exact heights on its pixels.")]
pub struct Args {
    /// The scene file.
    #[arg(value_name = "SCENE.toml")]
    scene: PathBuf,
    /// Folder for everything that is written.
    #[arg(short, long, value_name = "DIR", default_value = "simulated")]
    out: PathBuf,
    /// Effects whose bound is not above this are left out, metres.
    #[arg(long, value_name = "METRES", default_value_t = DEFAULT_TOLERANCE.0, value_parser = tolerance)]
    tolerance: f64,
    /// Simulate an effect whatever its bound and cause; may be repeated.
    #[arg(long, value_name = "EFFECT")]
    force: Vec<Effect>,
    /// Leave an effect out whatever its bound and cause; may be repeated.
    #[arg(long, value_name = "EFFECT")]
    without: Vec<Effect>,
    /// Another seed than the scene file's: another city of the same kind.
    #[arg(long)]
    seed: Option<u64>,
    /// Print the plan and write nothing.
    #[arg(long)]
    explain: bool,
    /// Print the report (with --explain: the plan) as one JSON object.
    #[arg(long)]
    json: bool,
}

fn tolerance(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|metres: &f64| metres.is_finite() && *metres >= 0.0)
        .ok_or_else(|| "not a length in metres of 0 or more".to_owned())
}

/// Lays out the scene and writes (or explains) it.
///
/// # Errors
/// The scene file is wrong, or a file cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let started = Instant::now();
    let mut spec = SceneSpec::read(&args.scene)?;
    spec.seed = args.seed.unwrap_or(spec.seed);
    let options = Options {
        tolerance: Metres(args.tolerance),
        force: args.force.iter().copied().collect(),
        without: args.without.iter().copied().collect(),
    };
    let scene = Scene::new(spec, &options)?;
    if args.explain {
        if args.json {
            console::print(&format!("{:#}\n", serde_json::to_value(&scene.plan)?))?;
        } else {
            console::print(&scene.plan.explain())?;
        }
        return Ok(ExitCode::Success);
    }
    let summary = match simulate(&scene, &args.out, console::quiet(), &Interrupt::on_signals()) {
        Err(SceneError::Interrupted) => {
            tracing::warn!("{}", SceneError::Interrupted);
            return Ok(ExitCode::Interrupted);
        }
        outcome => outcome?,
    };
    for warning in &summary.warnings {
        tracing::warn!("{warning}");
    }
    let text = if args.json {
        format!("{:#}\n", serde_json::to_value(&summary)?)
    } else {
        for_people(&scene, &summary, started.elapsed().as_secs_f64())
    };
    console::print(&text)?;
    Ok(ExitCode::Success)
}

fn for_people(scene: &Scene, summary: &Summary, seconds: f64) -> String {
    let effects: Vec<&str> = summary.effects.iter().map(|e| e.id()).collect();
    let mut text = String::new();
    let _ = writeln!(
        text,
        "simulated `{}` in {seconds:.1} s: {} objects, {} tiles, {} images, {} panoramas",
        scene.spec.name, summary.objects, summary.tiles, summary.images, summary.panoramas
    );
    let _ = writeln!(text, "  effects  {}", effects.join(", "));
    let picture = summary.picture.map(|[width, height]| {
        let size = format!("the whole city, {width} x {height} pixels, EPSG:3857");
        [(PICTURE_FILE, size), (TRUTH_FILE, "its exact heights, metres".to_owned())]
    });
    for (folder, what) in [
        ("lidar", "surface, EPSG:2927, US survey feet"),
        ("lidar_dtm", "bare earth"),
        ("vigor", "satellite images and labels"),
        ("truth", "exact heights on each image's pixels, metres"),
        ("scene.json", "everything that was resolved"),
    ]
    .map(|(folder, what)| (folder, what.to_owned()))
    .into_iter()
    .chain(picture.into_iter().flatten())
    {
        let _ = writeln!(text, "  {}  {what}", summary.out.join(folder).display());
    }
    text
}
