//! `sat3d model export`: a checkpoint, or the mean of several, with 32-bit or 16-bit floats.

use super::grouped;
use crate::console;
use sat3d::batch::ExitCode;
use sat3d::model::weights::{Precision, Rounding, WEIGHTS_FILE};
use sat3d::weights::{self, Weights, export::export};
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Write a checkpoint with 32-bit or 16-bit floats.
///
/// Takes the averaged weights out of a training checkpoint, or makes any checkpoint half as large. The folder
/// (config.json and diffusion_pytorch_model.safetensors) appears whole or not at all, and its bytes depend on the
/// weights alone. Values that a 16-bit float cannot hold are refused. Of several checkpoints each value's mean is
/// written, which may be better than any of them where their trainings began from the same weights.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model export --weights runs/mini/checkpoint-20000 --out mini --half
  sat3d model export --weights half-precision/ --out single-precision/
  sat3d model export --weights runs/one --weights runs/two --out mean --half")]
pub struct Args {
    /// Checkpoint folder, or a folder that holds one (default: as for `sat3d infer`); repeat for the mean of several
    #[arg(long, value_name = "DIR")]
    weights: Vec<PathBuf>,
    /// Folder to write; an older checkpoint there is replaced
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// 16-bit floats, rounded to the nearest, instead of 32-bit ones
    #[arg(long)]
    half: bool,
    /// Print what was done as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sat3d model export`.
///
/// # Errors
/// There are no weights, a value does not fit, or the folder cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let mut sources = vec![weights::find(args.weights.first().map(PathBuf::as_path))?];
    for place in args.weights.iter().skip(1) {
        sources.push(weights::find(Some(place))?);
    }
    let checkpoint = sources[0].open()?;
    let others = sources[1..].iter().map(Weights::open).collect::<Result<Vec<_>, _>>()?;
    let precision = if args.half { Precision::Half } else { Precision::Single };
    let rounding = export(&checkpoint, &others, &args.out, precision)?;
    let bytes = args.out.join(WEIGHTS_FILE).metadata()?.len();
    if args.json {
        let value = json!({
            "weights": sources[0],
            "mean_with": sources[1..],
            "out": args.out,
            "precision": precision,
            "bytes": bytes,
            "rounding": rounding,
        });
        console::print(&(serde_json::to_string_pretty(&value)? + "\n"))?;
    } else {
        console::print(&words(&args.out, sources.len(), precision, bytes, &rounding))?;
    }
    Ok(ExitCode::Success)
}

/// What was done, for people.
fn words(
    out: &Path,
    sources: usize,
    precision: Precision,
    bytes: u64,
    rounding: &Rounding,
) -> String {
    let Rounding { tensors, values, .. } = rounding;
    let bits = if precision == Precision::Half { 16 } else { 32 };
    let (values, bytes) = (grouped(*values), grouped(bytes));
    let out = out.display();
    let mut text = format!("{out}: {tensors} tensors, {values} {bits}-bit floats, {bytes} bytes\n");
    // Writing to a String cannot fail.
    if sources > 1 {
        let _ = writeln!(text, "each value the mean of {sources} checkpoints'");
    }
    let _ = match &rounding.largest_in {
        Some(tensor) => {
            writeln!(text, "largest relative change {:.2e}, in {tensor}", rounding.largest_relative)
        }
        None => writeln!(text, "no value of at least 2^-14 changed"),
    };
    if precision == Precision::Half && rounding.small > 0 {
        let _ = writeln!(
            text,
            "{} values under 2^-14 changed by up to {:.1e}; {} of them became 0",
            grouped(rounding.small),
            rounding.largest_of_small,
            grouped(rounding.vanished)
        );
    }
    text
}
