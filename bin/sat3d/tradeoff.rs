//! `sat3d tradeoff`: what accuracy costs in time.

use crate::console;
use anyhow::Context as _;
use sat3d::batch::{ExitCode, Interrupt, write_atomic};
use sat3d::tradeoff::{Options, Stage, TradeoffError, csv, html, plan, run as measure, table};
use std::path::{Path, PathBuf};

/// Measure what accuracy costs in time: error against truth, and time, for every switch.
///
/// Each switch is measured on work of its own whose truth is known: simulated scenes, closed forms, slow exact
/// ways. All its settings run warm in one process, in turns. The result depends on this machine; what the
/// defaults were chosen by is in docs/accuracy.md.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d tradeoff --quick
  sat3d tradeoff --stage build,eval --out here
  sat3d tradeoff --explain

Writes tradeoff.json (everything), tradeoff.csv (a line for each setting) and tradeoff.html (charts with the
Pareto front and today's defaults), and prints the tables.")]
pub struct Args {
    /// Stages to measure.
    #[arg(
        long,
        value_name = "STAGE,...",
        value_delimiter = ',',
        default_value = "build,eval,infer,tile",
        value_parser = stage
    )]
    stage: Vec<Stage>,
    /// Fewer settings, smaller scenes, fewer rounds: less than a minute.
    #[arg(long)]
    quick: bool,
    /// Most rounds in which each setting is timed.
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u64).range(3..=1000))]
    rounds: u64,
    /// Checkpoint folder of the network whose fields are rendered and tiled (default: as for `sat3d infer`)
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// Worker threads (default: all processors).
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1024))]
    threads: Option<u64>,
    /// Folder for the three files.
    #[arg(short, long, value_name = "DIR", default_value = "tradeoff")]
    out: PathBuf,
    /// Print which switches would be measured, and why, and measure nothing.
    #[arg(long)]
    explain: bool,
    /// Print everything (with --explain: the plan) as one JSON object.
    #[arg(long)]
    json: bool,
}

fn stage(text: &str) -> Result<Stage, String> {
    Stage::ALL.into_iter().find(|stage| stage.name() == text.trim()).ok_or_else(|| {
        let names: Vec<&str> = Stage::ALL.iter().map(|stage| stage.name()).collect();
        format!("no stage; there are {}", names.join(", "))
    })
}

/// Measures (or explains) and writes.
///
/// # Errors
/// A study that cannot be run, or a file that cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let default = Options::default();
    let mut stages = args.stage.clone();
    stages.sort_unstable();
    stages.dedup();
    let options = Options {
        stages,
        quick: args.quick,
        rounds: args.rounds as usize,
        weights: args.weights.clone(),
        threads: args.threads.map_or(default.threads, |threads| threads as usize),
        quiet: console::quiet(),
    };
    if args.explain {
        let plan = plan(&options);
        let text = if args.json {
            format!("{:#}\n", serde_json::to_value(&plan)?)
        } else {
            plan.explain()
        };
        console::print(&text)?;
        return Ok(ExitCode::Success);
    }
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let report = match measure(&options, &Interrupt::on_signals()) {
        Err(TradeoffError::Interrupted) => {
            tracing::warn!("{}", TradeoffError::Interrupted);
            return Ok(ExitCode::Interrupted);
        }
        outcome => outcome?,
    };
    let json = format!("{:#}\n", serde_json::to_value(&report)?);
    write(&args.out, "tradeoff.json", json.as_bytes())?;
    write(&args.out, "tradeoff.csv", &csv(&report)?)?;
    write(&args.out, "tradeoff.html", html(&report).as_bytes())?;
    let text = if args.json {
        json
    } else {
        let files = ["tradeoff.html", "tradeoff.json", "tradeoff.csv"];
        let files = files.map(|file| args.out.join(file).display().to_string());
        format!("{}\nwrote {}\n", table(&report), files.join(", "))
    };
    console::print(&text)?;
    if let Some(first) = report.failed.first() {
        anyhow::bail!(
            "{} of the switches could not be measured, the first {}: {}",
            report.failed.len(),
            first.name,
            first.reason
        );
    }
    Ok(if report.interrupted { ExitCode::Interrupted } else { ExitCode::Success })
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
    write_atomic(&folder.join(name), bytes)
        .with_context(|| format!("cannot write {}", folder.join(name).display()))
}
