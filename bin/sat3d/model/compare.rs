//! `sat3d model compare`: reports of `sat3d model score` against each other.

use crate::console;
use sat3d::batch::{ExitCode, write_atomic};
use sat3d::score::compare::{Variant, compare};
use sat3d::score::{Options, markdown};
use std::path::PathBuf;

/// Compare models, or variants of a training, by their reports of `sat3d model score`.
///
/// Prints a table in Markdown: errors with intervals, and how much larger each variant's RMSE is than that of the
/// reference. A folder is a variant of several trainings, one in each .json file of it; a file is a variant of
/// one. Intervals are bootstraps: scenes are drawn, the same for all variants, and trainings. Where variants have the
/// names of the paper's ablation, the paper's numbers stand beside them.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model compare small.json large.json
  sat3d model compare scores/canonical scores/without-depth scores/full --against full --out table.md
  sat3d model compare scores/* --json

Names of the paper's ablation: canonical, without-depth, without-gravity, without-tokens, without-perspective, full.")]
pub struct Args {
    /// Reports, or folders of reports; the name of each is that of the variant
    #[arg(value_name = "REPORT", required = true, num_args = 1..)]
    report: Vec<PathBuf>,
    /// Variant that the others are held against (default: the last)
    #[arg(long, value_name = "NAME")]
    against: Option<String>,
    /// Write the table to a file too (with --json: the JSON)
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print all scores of all variants as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sat3d model compare`.
///
/// # Errors
/// A report cannot be read or is of other scenes, or the table cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let variants =
        args.report.iter().map(|path| Variant::read(path)).collect::<Result<Vec<_>, _>>()?;
    let last = variants.last().map(|variant| variant.name.clone()).unwrap_or_default();
    let against = args.against.as_ref().unwrap_or(&last);
    let Options { replicates, level_pct, .. } = Options::default();
    let found = compare(&variants, against, replicates, level_pct)?;
    let text =
        if args.json { serde_json::to_string_pretty(&found)? + "\n" } else { markdown(&found) };
    if let Some(path) = &args.out {
        write_atomic(path, text.as_bytes())
            .map_err(|error| anyhow::Error::new(error).context(path.display().to_string()))?;
    }
    console::print(&text)?;
    Ok(ExitCode::Success)
}
