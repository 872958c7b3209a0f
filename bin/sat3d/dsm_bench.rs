//! `sat3d dsm-bench build|merge|compare`: ground-truth DSMs from lidar tiles.

use crate::batch_args::BatchArgs;
use crate::console;
use anyhow::Context;
use clap::{Subcommand, ValueEnum};
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::dsm_bench::{
    self, BuildOptions, Coverage, GridKind, ImageSource, Quantisation, RunSummary, TransformChoice,
};
use sat3d::lidar::{EdgeRule, Resampling, TransformForm};
use sat3d::raster::NodataRule;
use sat3d::units::LinearUnit;
use std::path::PathBuf;

/// Ground-truth DSMs for satellite images, out of lidar tiles.
#[derive(clap::Args, Debug)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    Build(Box<BuildArgs>),
    Merge(MergeArgs),
    Compare(CompareArgs),
}

/// Build one DSM per satellite image, on the image's own pixel grid, in metres.
///
/// Each tile that an image touches is warped onto the image's exact Web-Mercator grid, the one with
/// the best coverage is kept (or all are joined), heights become metres, and images with too many
/// empty pixels are skipped. A second run continues where the first ended.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  sat3d dsm-bench build --lidar tiles/ --vigor seattle/
  sat3d dsm-bench build --lidar tiles/ --images names.txt --out dsm/ --geotiff --preview
  sat3d dsm-bench build --lidar tiles/ --vigor seattle/ --explain")]
struct BuildArgs {
    /// Lidar DSM tiles: folders, GeoTIFF files, or a VRT
    #[arg(long, required = true, num_args = 1.., value_name = "DIR|FILE")]
    lidar: Vec<PathBuf>,
    /// VIGOR city folder, or a folder of satellite_<lat>_<lon>.png
    #[arg(long, value_name = "DIR", required_unless_present = "images", conflicts_with = "images")]
    vigor: Option<PathBuf>,
    /// Text file with image names, one a line; the images themselves are not needed
    #[arg(long, value_name = "LIST")]
    images: Option<PathBuf>,
    /// Output folder
    #[arg(long, value_name = "DIR", default_value = "dsm")]
    out: PathBuf,
    /// Bare-earth tiles: adds the key `dtm` on the same grid
    #[arg(long, num_args = 1.., value_name = "DIR|FILE")]
    dtm: Vec<PathBuf>,
    /// Zoom level of the images
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u8).range(0..=30))]
    zoom: u8,
    /// Pixels across and down
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(1..=8192))]
    size: u32,
    /// Skip images with more than this share of pixels without data, per cent
    #[arg(long, default_value_t = 5.0, value_name = "PCT")]
    max_nan: f64,
    /// Pixel grid: the exact one, or the reference implementation's approximation
    #[arg(long, value_enum, default_value_t = Grid::WebMercator)]
    grid: Grid,
    /// How pixels are taken to the tiles' coordinate system
    #[arg(long, value_enum, default_value_t = Transform::Auto)]
    transform: Transform,
    /// Horizontal error budget, metres
    #[arg(long, default_value_t = 1e-6, value_name = "M")]
    tolerance: f64,
    /// Pin the coordinate operation: an EPSG code or a PROJ pipeline
    #[arg(long, value_name = "CODE|PIPELINE")]
    operation: Option<String>,
    /// Let PROJ fetch grids over the network
    #[arg(long)]
    proj_network: bool,
    /// Coordinate system of the tiles, over what they say: EPSG:2927, EPSG:2927+5703, WKT
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// Resampling kernel, with GDAL's rules
    #[arg(long, short = 'r', value_enum, default_value_t = Kernel::Bilinear)]
    resampling: Kernel,
    /// At the border of valid data: renormalise over valid taps, or want all of them
    #[arg(long, value_enum, default_value_t = Edge::Renormalise)]
    edge: Edge,
    /// No-data value of the tiles, over what they say; `none`: every finite sample is valid
    #[arg(long, value_name = "V|none", allow_hyphen_values = true, value_parser = parse_nodata)]
    nodata: Option<NodataRule>,
    /// Unit of the tiles' heights, over what they say
    #[arg(long, value_name = "UNIT", value_parser = ["us-survey-foot", "foot", "metre"])]
    vertical_unit: Option<String>,
    /// How several tiles make one DSM
    #[arg(long, value_enum, default_value_t = CoverageArg::BestTile)]
    coverage: CoverageArg,
    /// Also write which tile each pixel came from (key `source_tile`, numbers as in benchmark.json)
    #[arg(long)]
    source_tile: bool,
    /// Round heights to multiples of this, metres
    #[arg(long, value_name = "M")]
    quantise: Option<f64>,
    /// Also write a Cloud Optimized GeoTIFF per image
    #[arg(long)]
    geotiff: bool,
    /// EPSG code of the heights' vertical CRS (5703: NAVD88 height), for the GeoTIFF
    #[arg(long, value_name = "CODE")]
    vertical_crs: Option<u32>,
    /// Also write a hillshaded picture per image
    #[arg(long)]
    preview: bool,
    /// Also write a STAC collection
    #[arg(long)]
    stac: bool,
    /// Memory for cached lidar blocks, MiB
    #[arg(long, default_value_t = 256, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1_048_576))]
    memory: u64,
    #[command(flatten)]
    batch: BatchArgs,
}

/// Join the shards of a benchmark into one.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  sat3d dsm-bench merge --out dsm/                  (shards that worked in one folder)
  sat3d dsm-bench merge --out dsm/ part1/ part2/    (shards of other folders, copied)")]
struct MergeArgs {
    /// Folder of the whole benchmark
    #[arg(long, value_name = "DIR", default_value = "dsm")]
    out: PathBuf,
    /// Folders of shards
    parts: Vec<PathBuf>,
    /// Also write a STAC collection
    #[arg(long)]
    stac: bool,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Compare a benchmark with the exact heights of a simulated scene.
#[derive(clap::Args, Debug)]
#[command(after_help = "Example:
  sat3d dsm-bench compare --dsm dsm/ --truth city/truth/ --max-rmse 0.03")]
struct CompareArgs {
    /// Folder of the benchmark
    #[arg(long, value_name = "DIR")]
    dsm: PathBuf,
    /// Folder with the truth (keys `dsm` and `smooth`), as `sat3d simulate` writes it
    #[arg(long, value_name = "DIR")]
    truth: PathBuf,
    /// Fail (exit code 1) when the RMSE over smooth surroundings exceeds this, metres
    #[arg(long, value_name = "M")]
    max_rmse: Option<f64>,
    /// Print the comparison as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Grid {
    WebMercator,
    Reference,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Transform {
    Auto,
    Chebyshev,
    Separable,
    Affine,
    Exact,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Kernel {
    Nearest,
    Bilinear,
    Cubic,
    Average,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Edge {
    Renormalise,
    Strict,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum CoverageArg {
    BestTile,
    Mosaic,
}

fn parse_nodata(text: &str) -> Result<NodataRule, String> {
    if text.eq_ignore_ascii_case("none") {
        return Ok(NodataRule::None);
    }
    text.parse()
        .map(NodataRule::Value)
        .map_err(|_| format!("`{text}` is neither a number nor `none`"))
}

/// Runs `sat3d dsm-bench`.
///
/// # Errors
/// Whatever keeps the whole run from its work.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Command::Build(args) => build(args),
        Command::Merge(args) => {
            let summary = dsm_bench::merge(&args.out, &args.parts, args.stac)?;
            report(&summary, &args.out, args.json)?;
            Ok(summary.exit_code())
        }
        Command::Compare(args) => compare(args),
    }
}

impl BuildArgs {
    fn options(&self) -> anyhow::Result<BuildOptions> {
        let images = match (&self.images, &self.vigor) {
            (Some(list), _) => ImageSource::List(list.clone()),
            (None, Some(folder)) => ImageSource::Folder(folder.clone()),
            (None, None) => anyhow::bail!("give --vigor or --images"),
        };
        let mut options = BuildOptions::new(self.lidar.clone(), images, self.out.clone());
        options.dtm = self.dtm.clone();
        options.zoom = self.zoom;
        options.size = self.size;
        options.max_nan_pct = self.max_nan;
        options.grid = match self.grid {
            Grid::WebMercator => GridKind::WebMercator,
            Grid::Reference => GridKind::Reference,
        };
        options.transform = match self.transform {
            Transform::Auto => TransformChoice::Auto,
            Transform::Chebyshev => TransformChoice::Forced(TransformForm::Chebyshev),
            Transform::Separable => TransformChoice::Forced(TransformForm::Separable),
            Transform::Affine => TransformChoice::Forced(TransformForm::Affine),
            Transform::Exact => TransformChoice::Forced(TransformForm::Exact),
        };
        options.tolerance_m = self.tolerance;
        options.operation = self.operation.clone();
        options.proj_network = self.proj_network;
        options.crs = self.crs.clone();
        options.resampling = match self.resampling {
            Kernel::Nearest => Resampling::Nearest,
            Kernel::Bilinear => Resampling::Bilinear,
            Kernel::Cubic => Resampling::Cubic,
            Kernel::Average => Resampling::Average,
        };
        options.edge = match self.edge {
            Edge::Renormalise => EdgeRule::Renormalise,
            Edge::Strict => EdgeRule::Strict,
        };
        options.nodata = self.nodata.unwrap_or_default();
        options.vertical_unit = self
            .vertical_unit
            .as_deref()
            .map(str::parse::<LinearUnit>)
            .transpose()
            .map_err(anyhow::Error::msg)?;
        options.coverage = match self.coverage {
            CoverageArg::BestTile => Coverage::BestTile,
            CoverageArg::Mosaic => Coverage::Mosaic,
        };
        options.source_tile = self.source_tile;
        options.quantise = self.quantise.map(|step_m| Quantisation { step_m });
        options.geotiff = self.geotiff;
        options.vertical_crs = self.vertical_crs;
        options.preview = self.preview;
        options.stac = self.stac;
        options.memory =
            usize::try_from(self.memory << 20).context("--memory is too large for this machine")?;
        options.threads = self.batch.threads();
        options.shard = self.batch.shard;
        options.verify = self.batch.verify();
        options.overwrite = self.batch.overwrite;
        options.quiet = console::quiet();
        Ok(options)
    }
}

fn build(args: &BuildArgs) -> anyhow::Result<ExitCode> {
    let prepared = dsm_bench::prepare(args.options()?)?;
    for warning in &prepared.warnings {
        tracing::warn!("{warning}");
    }
    for bad in &prepared.tiles().bad {
        tracing::warn!("tile left out: {}", bad.reason);
    }
    if args.batch.explain {
        if args.batch.json {
            console::print(&(serde_json::to_string_pretty(&prepared.plan)? + "\n"))?;
        } else {
            console::print(&prepared.plan.explain())?;
            console::print(&measured(&prepared)?)?;
        }
        return Ok(ExitCode::Success);
    }
    let summary = prepared.run(&Interrupt::on_signals())?;
    for warning in &summary.warnings {
        tracing::warn!("{warning}");
    }
    report(&summary, &args.out, args.batch.json)?;
    Ok(summary.exit_code())
}

/// What the transform forms would err on these very images.
fn measured(prepared: &dsm_bench::Prepared) -> anyhow::Result<String> {
    let Some(worst) = prepared.measure_transforms() else {
        return Ok("  no image of this list touches a tile\n".into());
    };
    Ok(format!(
        "  measured over {} images: chebyshev within {:.1e} m, separable {:.1e} m, affine {:.1e} m\n",
        worst.images, worst.chebyshev_m, worst.separable_m, worst.affine_m
    ))
}

fn report(summary: &RunSummary, out: &std::path::Path, json: bool) -> anyhow::Result<()> {
    if json {
        return console::print(&(serde_json::to_string_pretty(summary)? + "\n"));
    }
    let mut text =
        format!("{}: {} of {} images have a DSM", out.display(), summary.done, summary.images);
    if summary.kept > 0 && summary.kept < summary.done {
        text += &format!(" ({} from an earlier run)", summary.kept);
    }
    let built = summary.done.saturating_sub(summary.kept);
    if built > 0 && summary.seconds > 0.0 {
        text += &format!(
            ", {built} built in {:.1} s ({:.0}/s)",
            summary.seconds,
            built as f64 / summary.seconds
        );
    }
    text.push('\n');
    for (reason, count) in &summary.reasons {
        text += &format!("  {count:>6}  {reason}\n");
    }
    if summary.rescued_by_mosaic > 0 {
        text += &format!(
            "  --coverage mosaic would rescue {} of the skipped images\n",
            summary.rescued_by_mosaic
        );
    }
    if summary.flagged > 0 {
        text += &format!(
            "  {} images have heights that look wrong; see `flags` in manifest.csv\n",
            summary.flagged
        );
    }
    for bad in &summary.bad_tiles {
        text += &format!("  tile not used: {bad}\n");
    }
    if summary.disk_full {
        text += &format!(
            "  the disk is full: {} images not started; free space and run the same command again\n",
            summary.not_started
        );
    } else if summary.interrupted {
        text += &format!(
            "  interrupted: {} images not started; run the same command again to continue\n",
            summary.not_started
        );
    }
    console::print(&text)
}

fn compare(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let comparison = dsm_bench::compare(&args.dsm, &args.truth)?;
    if args.json {
        console::print(&(serde_json::to_string_pretty(&comparison)? + "\n"))?;
    } else {
        let mut text = format!(
            "{} images against the truth of the scene (error = DSM - truth)\n",
            comparison.images
        );
        text += "                 pixels      mean m      RMSE m       MAE m       max m\n";
        for (name, e) in [("smooth", comparison.smooth), ("all", comparison.all)] {
            text += &format!(
                "  {name:8} {:>12} {:>11.4} {:>11.4} {:>11.4} {:>11.4}\n",
                e.pixels, e.mean_m, e.rmse_m, e.mae_m, e.max_m
            );
        }
        if !comparison.missing.is_empty() {
            text += &format!("  {} images of the scene have no DSM\n", comparison.missing.len());
        }
        console::print(&text)?;
    }
    match args.max_rmse {
        Some(limit) if comparison.smooth.rmse_m > limit => {
            tracing::error!(
                "RMSE over smooth surroundings is {:.4} m, above --max-rmse {limit}",
                comparison.smooth.rmse_m
            );
            Ok(ExitCode::SomeFailed)
        }
        _ => Ok(ExitCode::Success),
    }
}
