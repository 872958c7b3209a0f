//! `sat3d simulate`: a city with exact truth.

use crate::console;
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::scene::effects::DEFAULT_TOLERANCE;
use sat3d::scene::random::{RandomScenes, RandomSummary, RandomSurvey};
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
///
/// With --random, in place of a scene file, many small scenes are drawn: suburbs, downtown, industry, car
/// parks, forest, shores and parks at distinct places of the city, under a sun, season and camera of their own.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d simulate pipelines/scenes/quickstart.toml
  sat3d simulate pipelines/scenes/towers_off_nadir.toml --out towers --explain
  sat3d simulate city.toml --out noiseless --without noise
  sat3d simulate pipelines/scenes/city_3km.toml --out city
  sat3d simulate --random 1000 --seed 7 --out scenes

Writes lidar/ (surface), lidar_dtm/ (bare earth), vigor/ (images and labels), truth/ (exact heights
on each image's pixels: key `dsm` in metres, `dtm`, `smooth`, `class`) and scene.json; with a table
[picture] in the scene file also picture.tif, one picture of the whole city, and picture_dsm.tif,
the exact heights on its pixels.

With --random: vigor/ (images, a panorama and a sky mask each, split files), truth/ (the heights that a
survey would find: `dsm`, `dtm` in metres, `class`) and scenes.json.")]
pub struct Args {
    /// The scene file.
    #[arg(value_name = "SCENE.toml", conflicts_with = "random")]
    scene: Option<PathBuf>,
    /// Draw so many scenes at random, each one satellite image of 64 m, in place of a scene file.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    random: Option<u64>,
    /// Side of the satellite images of random scenes, pixels.
    #[arg(
        long,
        value_name = "PIXELS",
        default_value_t = 256,
        requires = "random",
        value_parser = clap::value_parser!(u32).range(16..=4096)
    )]
    size: u32,
    /// Folder for everything that is written.
    #[arg(short, long, value_name = "DIR", default_value = "simulated")]
    out: PathBuf,
    /// The smallest effects are left out whose bounds together are not above this, metres
    #[arg(
        long,
        value_name = "METRES",
        default_value_t = DEFAULT_TOLERANCE.0,
        value_parser = tolerance,
        conflicts_with = "random"
    )]
    tolerance: f64,
    /// Simulate an effect whatever its bound and cause; may be repeated.
    #[arg(long, value_name = "EFFECT", conflicts_with = "random")]
    force: Vec<Effect>,
    /// Leave an effect out whatever its bound and cause; may be repeated.
    #[arg(long, value_name = "EFFECT", conflicts_with = "random")]
    without: Vec<Effect>,
    /// Another seed than the scene file's: another city of the same kind; of random scenes (1 if not
    /// given): other scenes.
    #[arg(long)]
    seed: Option<u64>,
    /// Print the plan (of random scenes: what is drawn) and write nothing.
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
    if let Some(count) = args.random {
        return run_random(args, count);
    }
    let Some(path) = &args.scene else {
        anyhow::bail!(
            "neither a scene file nor --random N is given; see `sat3d simulate --help` for examples of both"
        );
    };
    let started = Instant::now();
    let mut spec = SceneSpec::read(path)?;
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

/// Writes (or explains) scenes drawn at random.
fn run_random(args: &Args, count: u64) -> anyhow::Result<ExitCode> {
    let started = Instant::now();
    let scenes = RandomScenes { seed: args.seed.unwrap_or(1) };
    if args.explain {
        let survey = scenes.survey(count);
        let text = if args.json {
            format!("{:#}\n", serde_json::to_value(&survey)?)
        } else {
            survey_for_people(&survey)
        };
        console::print(&text)?;
        return Ok(ExitCode::Success);
    }
    let interrupt = Interrupt::on_signals();
    let summary = match scenes.write(count, args.size, &args.out, console::quiet(), &interrupt) {
        Err(SceneError::Interrupted) => {
            tracing::warn!("{}", SceneError::Interrupted);
            return Ok(ExitCode::Interrupted);
        }
        outcome => outcome?,
    };
    let text = if args.json {
        format!("{:#}\n", serde_json::to_value(&summary)?)
    } else {
        random_for_people(&summary, started.elapsed().as_secs_f64())
    };
    console::print(&text)?;
    Ok(ExitCode::Success)
}

fn random_for_people(summary: &RandomSummary, seconds: f64) -> String {
    let kinds: Vec<String> = summary.kinds.iter().map(|(k, n)| format!("{n} {k}")).collect();
    let mut text = String::new();
    let _ = writeln!(
        text,
        "simulated {} scenes of seed {} in {seconds:.1} s ({:.1}/s): {} panoramas",
        summary.scenes,
        summary.seed,
        summary.scenes as f64 / seconds.max(1e-9),
        summary.panoramas
    );
    let _ = writeln!(text, "  kinds  {}", kinds.join(", "));
    for (name, what) in [
        ("vigor", "satellite images, panoramas, sky masks, split files"),
        ("truth", "exact heights on each image's pixels, metres"),
        ("scenes.json", "kind, place, season, sun and view of each scene"),
    ] {
        let _ = writeln!(text, "  {}  {what}", summary.out.join(name).display());
    }
    text
}

fn survey_for_people(survey: &RandomSurvey) -> String {
    let list = |counts: Vec<String>| counts.join(", ");
    let mut text = String::new();
    let _ = writeln!(text, "{} random scenes of seed {}", survey.scenes, survey.seed);
    let kinds = survey.kinds.iter().map(|(k, n)| format!("{n} {k}")).collect();
    let _ = writeln!(text, "  kinds    {}", list(kinds));
    let seasons = survey.seasons.iter().map(|(k, n)| format!("{n} {k}")).collect();
    let _ = writeln!(text, "  seasons  {}", list(seasons));
    let _ = writeln!(text, "  {:<32} {:>7} {:>9} {:>9}  cause", "drawn", "scenes", "least", "most");
    for drawn in &survey.drawn {
        let [least, most] =
            drawn.range.map_or(["-".to_owned(), "-".to_owned()], |r| r.map(|v| format!("{v:.2}")));
        let _ = writeln!(
            text,
            "  {:<32} {:>7} {least:>9} {most:>9}  {}",
            drawn.what, drawn.scenes, drawn.cause
        );
    }
    text
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
