//! `sat3d infer`: DSMs, meshes and views from satellite images by the network, one image or a city.

use crate::batch_args::{BatchArgs, parse_gsd};
use crate::compute::{ComputeArgs, PackedArgs, warn_of};
use crate::console;
use crate::mesh_args::MeshArgs;
use crate::view_args::ViewArgs;
use clap::{Subcommand, ValueEnum};
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::footprint::VerticalScale;
use sat3d::infer::{self, InferOptions, Outputs, RunSummary};
use sat3d::model::render::{DepthKind, SampleCounts, Sampling};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// DSMs, meshes and street views from satellite images by the network, one image or a city.
///
/// Each image is resized, encoded and decoded to a radiance field, whose heights are written as
/// <stem>.npz for `sat3d eval`; meshes, density volumes and views are written where asked for. What no
/// output needs is neither loaded nor computed. A second run continues where the first ended; one bad
/// image never stops a batch.
#[derive(clap::Args, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:
  sat3d infer satellite_47.6_-122.33.png --weights Sat3DGen/
  sat3d infer satellite_47.6_-122.33.png --mesh glb --panorama --position px:320,400
  sat3d infer seattle/ --weights Sat3DGen/ --out out/ --geotiff
  sat3d infer ingest/manifest.csv --root VIGOR/ --weights Sat3DGen/ --shard 1/4
  sat3d infer photo.png --gsd 0.25 --weights Sat3DGen/ --vertical-scale isotropic
  sat3d infer out/image.scene.safetensors --sampling stable --out again/
  sat3d infer seattle/ --weights Sat3DGen/ --explain"
)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    infer: InferArgs,
}

#[derive(Subcommand, Debug)]
enum Command {
    Merge(MergeArgs),
}

#[derive(clap::Args, Debug)]
struct InferArgs {
    /// Image (PNG, JPEG, GeoTIFF), folder of images, VIGOR city folder, list or manifest of names (text, CSV,
    /// JSON, Parquet), or a scene that --scene saved
    #[arg(value_name = "INPUT", required = true)]
    input: Option<PathBuf>,
    /// Checkpoint folder: config.json and diffusion_pytorch_model.safetensors (default: SAT3D_WEIGHTS, then
    /// what `sat3d model fetch` has fetched, then `built-in:mini`, the small model inside the program)
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// Output folder
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    /// Folder that the names of a list are relative to (default: the list's own)
    #[arg(long, value_name = "DIR")]
    root: Option<PathBuf>,
    #[command(flatten)]
    compute: ComputeArgs,
    #[command(flatten)]
    packed: PackedArgs,
    /// Leave out <stem>.npz
    #[arg(long)]
    no_dsm: bool,
    /// Also write the heights as <stem>.tif: a Cloud Optimized GeoTIFF in metres
    #[arg(long)]
    geotiff: bool,
    /// Also write <stem>.scene.safetensors, to render again without the network
    #[arg(long)]
    scene: bool,
    /// Pixels of the DSM across and down
    #[arg(long, value_name = "PX", default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=4096))]
    dsm_size: u32,
    /// Quadrature along rays: as released, or with the error made small
    #[arg(long, value_enum, default_value_t = SamplingArg::Reference)]
    sampling: SamplingArg,
    /// Depth as trained, or divided by opacity (always so with --sampling stable)
    #[arg(long, value_enum, default_value_t = DepthArg::Raw)]
    depth: DepthArg,
    /// Samples along a ray, each 8 to 512 (default: the checkpoint's, 48,48 as released)
    #[arg(long, value_name = "COARSE,FINE", value_parser = parse_samples)]
    samples: Option<SampleCounts>,
    /// How heights become metres: 64.48 m per 1.0 (the published scoring), or as across
    #[arg(long, value_enum, default_value_t = ScaleArg::Paper)]
    vertical_scale: ScaleArg,
    /// Ground metres per pixel, over what names and georeferences say
    #[arg(long, value_name = "M[,M]", allow_negative_numbers = true, value_parser = parse_gsd)]
    gsd: Option<[f64; 2]>,
    #[command(flatten)]
    batch: BatchArgs,
    #[command(flatten)]
    mesh: MeshArgs,
    #[command(flatten)]
    views: ViewArgs,
}

/// Join the shards of a run into one.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  sat3d infer merge --out out/                  (shards that worked in one folder)
  sat3d infer merge --out out/ part1/ part2/    (shards of other folders, copied)")]
struct MergeArgs {
    /// Folder of the whole run
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    /// Folders of shards
    parts: Vec<PathBuf>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum SamplingArg {
    Reference,
    Stable,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum DepthArg {
    Raw,
    Normalised,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum ScaleArg {
    Paper,
    Isotropic,
}

fn parse_samples(text: &str) -> Result<SampleCounts, String> {
    let form = || format!("`{text}` is not COARSE,FINE, for example 48,48");
    let (coarse, fine) = text.split_once(',').ok_or_else(form)?;
    let number = |text: &str| text.trim().parse::<usize>().map_err(|_| form());
    SampleCounts::new(number(coarse)?, number(fine)?).map_err(|error| error.to_string())
}

/// Runs `sat3d infer`.
///
/// # Errors
/// Whatever keeps the whole run from its work.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(Command::Merge(args)) = &args.command {
        let summary = infer::merge(&args.out, &args.parts)?;
        report(&summary, &args.out, false, args.json)?;
        return Ok(summary.exit_code());
    }
    let args = &args.infer;
    let prepared = infer::prepare(args.options()?)?;
    for warning in &prepared.warnings {
        tracing::warn!("{warning}");
    }
    if args.batch.explain {
        return explain(&prepared, args.batch.json);
    }
    let summary = prepared.run(&Interrupt::on_signals())?;
    warn_of(prepared.packed());
    report(&summary, &args.out, !args.no_dsm, args.batch.json)?;
    Ok(summary.exit_code())
}

impl InferArgs {
    fn options(&self) -> anyhow::Result<InferOptions> {
        let Some(input) = self.input.clone() else { anyhow::bail!("give an INPUT") };
        let mut options = InferOptions::new(input, self.weights.clone(), self.out.clone());
        options.root = self.root.clone();
        options.compute = self.compute.wanted();
        options.packed_weights = self.packed.packed_weights.clone();
        options.size = self.dsm_size;
        options.render.sampling = match self.sampling {
            SamplingArg::Reference => Sampling::Reference,
            SamplingArg::Stable => Sampling::Stable,
        };
        options.render.depth = match self.depth {
            DepthArg::Raw => DepthKind::Raw,
            DepthArg::Normalised => DepthKind::Normalised,
        };
        options.samples = self.samples;
        self.mesh.check()?;
        // Whether pictures are enlarged is known when the weights are open.
        let views = self.views.requests(options.render, true)?;
        options.render = views.options;
        options.illumination = self.views.illumination(&views)?;
        options.outputs = Outputs {
            dsm: !self.no_dsm,
            geotiff: self.geotiff,
            scene: self.scene,
            mesh: self.mesh.mesh(),
            density: self.mesh.density(),
            views,
        };
        options.vertical = match self.vertical_scale {
            ScaleArg::Paper => VerticalScale::Paper,
            ScaleArg::Isotropic => VerticalScale::Isotropic,
        };
        options.gsd_m = self.gsd;
        options.threads = self.batch.threads();
        options.shard = self.batch.shard;
        options.verify = self.batch.verify();
        options.overwrite = self.batch.overwrite;
        options.quiet = console::quiet();
        Ok(options)
    }
}

fn explain(prepared: &infer::Prepared, json: bool) -> anyhow::Result<ExitCode> {
    if json {
        console::print(&(serde_json::to_string_pretty(&prepared.plan)? + "\n"))?;
    } else {
        let images = prepared.entries_of_shard().len();
        console::print(&prepared.plan.explain())?;
        console::print(&format!(
            "  {images} image{} of this run\n",
            if images == 1 { "" } else { "s" }
        ))?;
    }
    Ok(ExitCode::Success)
}

fn report(summary: &RunSummary, out: &Path, heights: bool, json: bool) -> anyhow::Result<()> {
    if json {
        return console::print(&(serde_json::to_string_pretty(summary)? + "\n"));
    }
    let mut text = format!("{}: {} of {} images done", out.display(), summary.done, summary.images);
    if summary.kept > 0 && summary.kept < summary.done {
        let _ = write!(text, " ({} by an earlier run)", summary.kept);
    }
    let made = summary.done.saturating_sub(summary.kept);
    if made > 0 && summary.seconds > 0.0 {
        let each = summary.seconds / made as f64;
        let _ = write!(text, ", {made} in {:.1} s ({each:.2} s each)", summary.seconds);
    }
    text.push('\n');
    for (reason, count) in &summary.reasons {
        let _ = writeln!(text, "  {count:>6}  {reason}");
    }
    if summary.assumed_ground.images > 0 {
        let _ = writeln!(
            text,
            "  {} of them state no size on the ground and were taken to be as wide as those of the training; --gsd states it ({})",
            summary.assumed_ground.images,
            examples(&summary.assumed_ground)
        );
    }
    if summary.other_ground.images > 0 {
        let _ = writeln!(
            text,
            "  {} have another size on the ground than the training's, so that their heights will be off ({}); see `flags` in manifest.csv",
            summary.other_ground.images,
            examples(&summary.other_ground)
        );
    }
    if summary.not_started > 0 {
        let why = if summary.disk_full { "the disk is full" } else { "interrupted" };
        let what = if summary.disk_full { "free space and run" } else { "run" };
        let _ = writeln!(
            text,
            "  {why}: {} images not started; {what} the same command again to continue",
            summary.not_started
        );
    }
    if heights && summary.done > 0 && summary.not_started == 0 {
        let _ = writeln!(text, "next: sat3d eval --pred {} --gt DSM_FOLDER", out.display());
    }
    console::print(&text)
}

fn examples(counted: &infer::Counted) -> String {
    let dots = if counted.images > counted.examples.len() { ", ..." } else { "" };
    counted.examples.join(", ") + dots
}
