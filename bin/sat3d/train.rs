//! `sat3d train`: a network that learns, from a settings file to checkpoints.

use sat3d::batch::ExitCode;
use std::path::PathBuf;

/// Train a network: on simulated cities or on VIGOR, by true heights or by the paper's signals.
///
/// The settings file says what is learnt from what, and for how long; every setting has a default. Writes checkpoints
/// that `sat3d infer` takes as weights, a log (log.jsonl) and a page with its curves and sample pictures (log.html). A
/// training that was stopped or killed goes on where it was when the same command is given again, and ends with the
/// same bytes.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d train pipelines/train/mini.toml --out runs/mini
  sat3d train pipelines/train/mini.toml --explain
  sat3d train mini.toml --out runs/seed2 --set run.seed=2 --set run.device=cuda
  sat3d infer image.png --weights runs/mini/checkpoint-20000")]
pub struct Args {
    /// Settings file, TOML; docs/train.md lists its keys
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Output folder; one with a training in it goes on
    #[arg(short, long, value_name = "DIR", default_value = "training")]
    out: PathBuf,
    /// Change a setting; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print the plan (data, model, losses with their weights, steps) and stop
    #[arg(long)]
    explain: bool,
    /// Print the summary (or, with --explain, the plan) as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sat3d train`.
///
/// # Errors
/// Settings that are not served, data that hold nothing to learn from, a full disk, a learner that no longer learns.
#[cfg(feature = "train")]
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    use crate::console;
    use sat3d::batch::Interrupt;
    use sat3d::train::{self, Options, Settings};

    let interrupt = Interrupt::on_signals();
    let settings = Settings::read(&args.config, &args.set)?;
    let prepared = train::prepare(settings)?;
    if args.explain {
        let plan = train::plan(&prepared);
        let text =
            if args.json { serde_json::to_string_pretty(&plan)? + "\n" } else { plan.explain() };
        console::print(&text)?;
        return Ok(ExitCode::Success);
    }
    let options = Options { out: args.out.clone(), quiet: console::quiet() };
    let summary = train::run(&prepared, &options, &interrupt, &train::learner)?;
    if args.json {
        console::print(&(serde_json::to_string_pretty(&summary)? + "\n"))?;
    } else {
        console::print(&words(&summary))?;
    }
    Ok(summary.exit_code())
}

/// Runs `sat3d train`.
///
/// # Errors
/// Always: this program was built without it.
#[cfg(not(feature = "train"))]
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let Args { config, out: _, set: _, explain: _, json: _ } = args;
    anyhow::bail!(
        "{}: this program was built without `sat3d train`; build it with the feature `train`",
        config.display()
    )
}

/// The summary for people.
#[cfg(feature = "train")]
fn words(summary: &sat3d::train::Summary) -> String {
    use sat3d::train::{Ending, duration};
    use std::fmt::Write as _;

    let mut text = String::new();
    let how = match summary.ending {
        Ending::Finished => "finished",
        Ending::Unchanged => "nothing to do: all steps were done before",
        Ending::Time => "stopped at the time limit; the same command goes on",
        Ending::Interrupted => "interrupted; the same command goes on",
    };
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{} of {} steps, {how}", summary.step, summary.steps);
    if let Some(from) = summary.resumed_from
        && summary.ending != Ending::Unchanged
    {
        let _ = writeln!(text, "  went on from step {from}");
    }
    if summary.seconds > 0.5 {
        let _ = writeln!(
            text,
            "  {} in this session, {:.1} images/s",
            duration(summary.seconds),
            summary.images_per_second
        );
    }
    let terms: Vec<String> = summary
        .terms
        .iter()
        .filter_map(|(name, value)| Some(format!("{name} {:.4}", value.as_f64()?)))
        .collect();
    if !terms.is_empty() {
        let _ = writeln!(text, "  losses  {}", terms.join("  "));
    }
    if let Some(scores) = &summary.held_out {
        let _ = writeln!(
            text,
            "  {} held-out examples: RMSE {:.3} m, MAE {:.3} m (flat ground {:.3} m, {:.3} m)",
            scores.examples, scores.rmse_m, scores.mae_m, scores.flat_rmse_m, scores.flat_mae_m
        );
    }
    let progress = &summary.progress;
    if progress.skipped_batches > 0 {
        let _ = writeln!(
            text,
            "  {:>8}  batches skipped: values that are not finite",
            progress.skipped_batches
        );
    }
    for (kind, skipped) in &progress.skipped_items {
        let _ = writeln!(text, "  {:>8}  draws skipped: {kind}", skipped.draws);
    }
    if progress.without_depth > 0 {
        let _ = writeln!(text, "  {:>8}  examples without a depth label", progress.without_depth);
    }
    let _ = writeln!(text, "  weights  {}", summary.checkpoint.display());
    let _ = writeln!(text, "  log      {}", summary.page.display());
    text
}
