//! `sat3d eval`: scores predicted DSMs against ground truth.

use crate::console;
use anyhow::Context;
use clap::{Subcommand, ValueEnum};
use sat3d::batch::{ExitCode, Interrupt, Shard, write_atomic};
use sat3d::eval::inputs::InputSettings;
use sat3d::eval::report::{self, Panel};
use sat3d::eval::summary::{Evaluation, EvaluationSet};
use sat3d::eval::{
    self, Baseline, EvalOptions, MaskOptions, OffsetMethod, Outputs, Prepared, Protocol, Resize,
    published,
};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// Score predicted DSMs against ground truth.
///
/// Pairs <stem>.npz, .npy or .tif with <stem>_dsm.npz or .tif, aligns each truth to its prediction by
/// the protocol, and prints errors with intervals. error = prediction - ground truth.
#[derive(clap::Args, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:
  sat3d eval --pred out/ --gt dsm/
  sat3d eval --pred out/ --gt dsm/ --protocol all --report report.html --csv images.csv
  sat3d eval --pred model_a/ --pred model_b/ --gt dsm/ --against paper
  sat3d eval --pred shifted.tif --gt reference.tif --protocol coregister
  sat3d eval --pred out/ --gt dsm/ --explain
  sat3d eval --pred out/ --gt dsm/ --shard 1/4 --parts parts/     (then: sat3d eval merge parts/)"
)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    score: ScoreArgs,
}

#[derive(Subcommand, Debug)]
enum Command {
    Merge(MergeArgs),
    Baseline(BaselineArgs),
}

#[derive(clap::Args, Debug)]
struct ScoreArgs {
    /// Predictions: a folder or a file; several for several models
    #[arg(long, required = true, value_name = "DIR|FILE")]
    pred: Vec<PathBuf>,
    /// Ground truth: a folder or a file
    #[arg(long, required = true, value_name = "DIR|FILE")]
    gt: Option<PathBuf>,
    /// Name of a model, in the order of --pred (default: its folder's)
    #[arg(long, value_name = "NAME")]
    name: Vec<String>,
    /// What is aligned before scoring
    #[arg(long, value_enum, default_value_t = ProtocolArg::Paper)]
    protocol: ProtocolArg,
    /// How the vertical offset is found (default: ransac for paper, median otherwise)
    #[arg(long, value_enum)]
    offset: Option<OffsetArg>,
    /// How a ground truth is brought to the prediction's size
    #[arg(long, value_enum, default_value_t = ResizeArg::Reference)]
    resize: ResizeArg,
    /// Metres of one unit of `arr_0`, over what files say (else 64.48)
    #[arg(long, value_name = "M")]
    metres_per_unit: Option<f64>,
    /// Zoom level of the images
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u8).range(0..=30))]
    zoom: u8,
    /// Pixels across and down of the images, for ground truths that are rasters
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(1..=8192))]
    size: u32,
    /// Ground sample distance of the ground truth where neither name nor georeference says it, metres
    #[arg(long, value_name = "M")]
    gsd: Option<f64>,
    /// Further thresholds beside 2.5 and 7.5, metres
    #[arg(long, value_name = "M,M", value_delimiter = ',', allow_negative_numbers = true)]
    thresholds: Vec<f64>,
    /// Side of the blocks that the bootstrap draws, metres
    #[arg(long, default_value_t = 500.0, value_name = "M", allow_negative_numbers = true)]
    block: f64,
    /// Draws of the bootstrap
    #[arg(long, default_value_t = 2000, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    replicates: u32,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Images that the registration estimate uses at most; 0 leaves it out
    #[arg(long, default_value_t = 256, value_name = "N")]
    registration: usize,
    /// Also write a raster of the errors per image into this folder
    #[arg(long, value_name = "DIR")]
    errors: Option<PathBuf>,
    /// Do part i of n; needs --parts
    #[arg(long, value_name = "i/n", default_value = "1/1", requires = "parts")]
    shard: Shard,
    /// Folder for the parts of a sharded run
    #[arg(long, value_name = "DIR", requires = "shard", conflicts_with_all = ["json", "csv", "parquet", "report", "against"])]
    parts: Option<PathBuf>,
    /// Print the plan (each step with its bound, cost and cause; as JSON with --json) and write nothing
    #[arg(long)]
    explain: bool,
    #[command(flatten)]
    common: CommonArgs,
}

/// Join the parts of a sharded evaluation.
#[derive(clap::Args, Debug)]
#[command(after_help = "Example:
  sat3d eval merge parts/ --report report.html")]
struct MergeArgs {
    /// Parts, or folders that hold them
    #[arg(required = true)]
    parts: Vec<PathBuf>,
    #[command(flatten)]
    common: CommonArgs,
}

/// Write baseline predictions, made from the ground truth: what a model's scores are held against.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  sat3d eval baseline flat --gt dsm/ --out baselines/flat
  sat3d eval baseline blurred --sigma 2 --gt dsm/ --out baselines/blurred
  sat3d eval baseline shifted --east 6 --south -4 --gt dsm/ --out baselines/shifted")]
struct BaselineArgs {
    /// What is predicted
    #[arg(value_enum)]
    kind: BaselineKind,
    /// Ground truth: a folder of <stem>_dsm.npz or .tif
    #[arg(long, value_name = "DIR")]
    gt: PathBuf,
    /// Folder for the predictions
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Standard deviation of the blur, metres on the ground
    #[arg(long, default_value_t = 2.0, value_name = "M")]
    sigma: f64,
    /// Pixels by which the truth is displaced to the east
    #[arg(long, default_value_t = 0, value_name = "PX", allow_negative_numbers = true)]
    east: i32,
    /// Pixels by which the truth is displaced to the south
    #[arg(long, default_value_t = 0, value_name = "PX", allow_negative_numbers = true)]
    south: i32,
    /// Pixels across and down of the predictions
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=8192))]
    size: u32,
    /// Zoom level of the images
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u8).range(0..=30))]
    zoom: u8,
    /// Ground sample distance of the ground truth where its name does not say it, metres
    #[arg(long, value_name = "M")]
    gsd: Option<f64>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum BaselineKind {
    /// One height everywhere: the truth's median
    Flat,
    /// The bare earth (`dtm`) of the truth
    Ground,
    /// The truth after a Gaussian blur (--sigma)
    Blurred,
    /// The truth displaced by whole pixels (--east, --south)
    Shifted,
}

#[derive(clap::Args, Debug)]
struct CommonArgs {
    /// Classes of places: a raster of classes, or GeoJSON polygons, in any CRS
    #[arg(long, value_name = "FILE")]
    mask: Option<PathBuf>,
    /// Property of the GeoJSON's polygons that names their class
    #[arg(long, value_name = "FIELD", requires = "mask")]
    mask_class: Option<String>,
    /// CRS of the mask, over what it says: EPSG:2927, WKT
    #[arg(long, value_name = "CRS", requires = "mask")]
    mask_crs: Option<String>,
    /// Published rows to stand beside
    #[arg(long, value_name = "WHAT", value_parser = ["paper"])]
    against: Option<String>,
    /// Scores as JSON, on standard output or into a file
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
    /// One row per image as CSV
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// One row per image as GeoParquet
    #[arg(long, value_name = "FILE")]
    parquet: Option<PathBuf>,
    /// Report with charts, maps and pictures, one self-contained HTML file
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Worker threads (default: all cores); the output does not depend on it
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Memory for errors kept between the two passes, MiB
    #[arg(long, default_value_t = 1024, value_name = "MIB", value_parser = clap::value_parser!(u64).range(0..=1_048_576))]
    memory: u64,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ProtocolArg {
    /// Shift, rotation and vertical offset, as published
    Paper,
    /// A vertical offset only
    Vertical,
    /// Nothing
    Plain,
    /// Sub-pixel shift and vertical offset (Nuth and Kaab)
    Coregister,
    /// All four side by side
    All,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum OffsetArg {
    Ransac,
    Median,
    Mean,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ResizeArg {
    /// Bilinear without antialiasing, as the reference
    Reference,
    /// Mean over the area of a pixel
    Area,
}

/// Runs `sat3d eval`.
///
/// # Errors
/// Whatever keeps the whole evaluation from its work.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(Command::Merge(args)) => {
            args.common.make_folders()?;
            let options = args.common.apply(EvalOptions::new(Vec::new(), PathBuf::new()))?;
            let merged = eval::merge(&args.parts, options, &Interrupt::on_signals());
            let Some((prepared, set)) = unless_interrupted(merged)? else {
                return Ok(ExitCode::Interrupted);
            };
            finish(&args.common, &prepared, set)
        }
        Some(Command::Baseline(args)) => baseline(args),
        None => score(&args.score),
    }
}

fn baseline(args: &BaselineArgs) -> anyhow::Result<ExitCode> {
    let usable = args.sigma.is_finite() && args.sigma >= 0.0;
    anyhow::ensure!(usable, "--sigma {}: a blur is zero or more metres", args.sigma);
    let baseline = match args.kind {
        BaselineKind::Flat => Baseline::Flat,
        BaselineKind::Ground => Baseline::Ground,
        BaselineKind::Blurred => Baseline::Blurred { sigma_m: args.sigma },
        BaselineKind::Shifted => Baseline::Shifted { east_px: args.east, south_px: args.south },
    };
    let settings = InputSettings { zoom: args.zoom, gsd_m: args.gsd, ..InputSettings::default() };
    let size = args.size as usize;
    let summary = eval::write_baselines(&args.gt, &args.out, baseline, size, &settings)?;
    if args.json {
        console::print(&(serde_json::to_string_pretty(&summary)? + "\n"))?;
    } else {
        let mut text = format!("{}: {} predictions\n", args.out.display(), summary.written);
        for reason in summary.failed.iter().take(10) {
            text += &format!("  failed: {reason}\n");
        }
        if summary.failed.len() > 10 {
            text += &format!("  ... and {} more\n", summary.failed.len() - 10);
        }
        console::print(&text)?;
    }
    Ok(if summary.failed.is_empty() { ExitCode::Success } else { ExitCode::SomeFailed })
}

fn unless_interrupted<T>(result: Result<T, eval::EvalError>) -> anyhow::Result<Option<T>> {
    match result {
        Ok(value) => Ok(Some(value)),
        Err(eval::EvalError::Interrupted) => {
            tracing::warn!("interrupted; no scores were written, run the same command again");
            Ok(None)
        }
        Err(error) => Err(error.into()),
    }
}

fn explain(prepared: &Prepared, json: bool) -> anyhow::Result<ExitCode> {
    if json {
        console::print(&format!("{:#}\n", serde_json::to_value(&prepared.plan)?))?;
    } else {
        console::print(&prepared.plan.explain())?;
    }
    Ok(ExitCode::Success)
}

fn score(args: &ScoreArgs) -> anyhow::Result<ExitCode> {
    let prepared = eval::prepare(args.options()?)?;
    if args.explain {
        return explain(&prepared, args.common.json.is_some());
    }
    args.common.make_folders()?;
    let interrupt = Interrupt::on_signals();
    if let Some(folder) = &args.parts {
        let Some((path, images)) = unless_interrupted(prepared.run_part(folder, &interrupt))?
        else {
            return Ok(ExitCode::Interrupted);
        };
        console::print(&format!(
            "{}: part {} with {images} of {} images; join all parts with `sat3d eval merge {}`\n",
            path.display(),
            args.shard,
            prepared.pairs.len(),
            folder.display()
        ))?;
        return Ok(ExitCode::Success);
    }
    match unless_interrupted(prepared.run(&interrupt))? {
        Some(set) => finish(&args.common, &prepared, set),
        None => Ok(ExitCode::Interrupted),
    }
}

impl ScoreArgs {
    fn options(&self) -> anyhow::Result<EvalOptions> {
        let truth = self.gt.clone().context("--gt is missing")?;
        let mut options = EvalOptions::new(self.pred.clone(), truth);
        options.names.clone_from(&self.name);
        options.protocols = match self.protocol {
            ProtocolArg::Paper => vec![Protocol::Paper],
            ProtocolArg::Vertical => vec![Protocol::Vertical],
            ProtocolArg::Plain => vec![Protocol::Plain],
            ProtocolArg::Coregister => vec![Protocol::Coregister],
            ProtocolArg::All => Protocol::ALL.to_vec(),
        };
        options.offset = self.offset.map(|offset| match offset {
            OffsetArg::Ransac => OffsetMethod::Ransac,
            OffsetArg::Median => OffsetMethod::Median,
            OffsetArg::Mean => OffsetMethod::Mean,
        });
        options.resize = match self.resize {
            ResizeArg::Reference => Resize::Reference,
            ResizeArg::Area => Resize::Area,
        };
        options.inputs = InputSettings {
            metres_per_unit: self.metres_per_unit,
            zoom: self.zoom,
            size: self.size,
            gsd_m: self.gsd,
        };
        options.thresholds.clone_from(&self.thresholds);
        options.block_m = self.block;
        options.replicates = self.replicates;
        options.seed = self.seed;
        options.registration_images = self.registration;
        options.errors.clone_from(&self.errors);
        options.shard = self.shard;
        self.common.apply(options)
    }
}

impl CommonArgs {
    /// Makes the folders of all outputs, so that a typing mistake is found before the work and not
    /// after it.
    fn make_folders(&self) -> anyhow::Result<()> {
        let json = self.json.as_deref().filter(|path| path.as_os_str() != "-");
        let files = [json, self.csv.as_deref(), self.parquet.as_deref(), self.report.as_deref()];
        for file in files.into_iter().flatten() {
            anyhow::ensure!(!file.is_dir(), "{} is a folder; name a file", file.display());
            if let Some(folder) = file.parent().filter(|folder| !folder.as_os_str().is_empty()) {
                std::fs::create_dir_all(folder)
                    .with_context(|| format!("cannot make the folder {}", folder.display()))?;
            }
        }
        Ok(())
    }

    fn apply(&self, mut options: EvalOptions) -> anyhow::Result<EvalOptions> {
        options.mask = self.mask.clone().map(|path| {
            let settings = MaskOptions {
                class_field: self.mask_class.clone(),
                crs: self.mask_crs.clone(),
                ..MaskOptions::default()
            };
            (path, settings)
        });
        options.outputs = Outputs {
            table: self.csv.is_some() || self.parquet.is_some(),
            report: self.report.is_some(),
            published: self.against.is_some(),
        };
        options.threads = self.threads.unwrap_or(options.threads).max(1);
        options.memory =
            usize::try_from(self.memory << 20).context("--memory is too large for this machine")?;
        options.quiet = console::quiet();
        Ok(options)
    }
}

/// Prints and writes what was asked for; the exit code.
fn finish(
    args: &CommonArgs,
    prepared: &Prepared,
    mut set: EvaluationSet,
) -> anyhow::Result<ExitCode> {
    if args.against.is_some() {
        set.published = published::paper_rows();
    }
    let write = |path: &Path, bytes: &[u8]| {
        write_atomic(path, bytes).with_context(|| format!("cannot write {}", path.display()))
    };
    if args.csv.is_some() || args.parquet.is_some() {
        let table = report::per_image_table(&set)?;
        if let Some(path) = &args.csv {
            write(path, &table.to_csv())?;
        }
        if let Some(path) = &args.parquet {
            write(path, &table.to_parquet()?)?;
        }
    }
    if let Some(path) = &args.report {
        let panels = panels(prepared, &set)?;
        write(path, report::html(&set, &panels).as_bytes())?;
    }
    let json = || serde_json::to_string_pretty(&report::json(&set)).map(|text| text + "\n");
    match &args.json {
        Some(path) if path.as_os_str() == "-" => console::print(&json()?)?,
        Some(path) => {
            write(path, json()?.as_bytes())?;
            console::print(&report::terminal(&set, width()))?;
        }
        None => console::print(&report::terminal(&set, width()))?,
    }
    let failed = set.evaluations.iter().any(|e| e.images.failed > 0);
    Ok(if failed { ExitCode::SomeFailed } else { ExitCode::Success })
}

/// Columns of the terminal; 100 where there is none.
fn width() -> usize {
    if !std::io::stdout().is_terminal() {
        return 100;
    }
    let stated = std::env::var("COLUMNS").ok().and_then(|text| text.parse().ok());
    stated.unwrap_or_else(|| console::terminal_width().unwrap_or(100)).clamp(60, 160)
}

/// Best, median and worst image: three of each for one evaluation, one of each for several.
fn panels(prepared: &Prepared, set: &EvaluationSet) -> anyhow::Result<Vec<Panel>> {
    let each = if set.evaluations.len() == 1 { 3 } else { 1 };
    let mut panels = Vec::new();
    for evaluation in set.evaluations.iter().take(8) {
        for (place, name, mae_m) in noteworthy(evaluation, each) {
            let Some((prediction, truth)) = prepared.look_at(evaluation, &name)? else { continue };
            let caption = if set.evaluations.len() == 1 {
                place.to_owned()
            } else {
                format!("{place}, {} ({})", evaluation.model, evaluation.protocol.name())
            };
            panels.push(Panel { caption, name, prediction, truth, mae_m });
        }
    }
    Ok(panels)
}

/// Names and errors of the best, the median and the worst images; none twice.
fn noteworthy(evaluation: &Evaluation, each: usize) -> Vec<(&'static str, String, f64)> {
    let mut images: Vec<(f64, &str)> = evaluation
        .per_image
        .iter()
        .filter_map(|row| row.scores.as_ref().map(|scores| (scores.mae_m, row.name.as_str())))
        .collect();
    images.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(b.1)));
    let n = images.len();
    let each = each.min(n.div_ceil(3));
    let middle = (n / 2).saturating_sub(each / 2);
    let ranges = [
        ("best", 0..each),
        ("median", middle..middle + each),
        ("worst", n.saturating_sub(each)..n),
    ];
    let mut taken = vec![false; n];
    let mut chosen = Vec::new();
    for (place, range) in ranges {
        for k in range {
            if k < n && !std::mem::replace(&mut taken[k], true) {
                chosen.push((place, images[k].1.to_owned(), images[k].0));
            }
        }
    }
    chosen
}
