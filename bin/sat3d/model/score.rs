//! `sat3d model score`: a model on simulated scenes that no training saw.

use crate::console;
use sat3d::batch::{ExitCode, Progress, write_atomic};
use sat3d::model::{Device, Model};
use sat3d::score::{Options, gates, score, table};
use sat3d::weights::{self, whole_hash};
use serde_json::json;
use std::path::PathBuf;

/// Score a model on simulated scenes that no training saw.
///
/// Draws scenes at random, whose heights are exact, and holds against them: the DSM beside flat ground, the height
/// of each building beside the best constant, the top of the mesh beside the DSM, and floaters. Intervals are
/// bootstraps over scenes. The scenes of a seed are others than those of a training with the same seed.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model score                                       the weights that other commands would use
  sat3d model score --weights runs/mini/checkpoint-20000 --gates
  sat3d model score --seeds 7 --scenes 8                  a quick look
  sat3d model score --json --out score.json")]
pub struct Args {
    /// Checkpoint folder (default: as for `sat3d infer`)
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// Seeds of the sets of scenes
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,2,3")]
    seeds: Vec<u64>,
    /// Scenes of each set
    #[arg(long, value_name = "COUNT", default_value_t = 96)]
    scenes: u64,
    /// End with 1 where a gate of the small model fails
    #[arg(long)]
    gates: bool,
    /// Where the network runs: cpu, cuda, cuda:1, wgpu
    #[arg(long, default_value_t = Device::Cpu)]
    device: Device,
    /// Write the report, with every scene, to a file too
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sat3d model score`.
///
/// # Errors
/// There are no weights, the model does not run, or the report cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let weights = weights::find(args.weights.as_deref())?;
    let checkpoint = weights.open()?;
    let sha256 = whole_hash(&checkpoint);
    let model =
        Model::from_source(checkpoint.config().clone(), Box::new(checkpoint), &args.device)?;
    let options = Options { seeds: args.seeds.clone(), scenes: args.scenes, ..Options::default() };
    let count = args.seeds.len() * usize::try_from(args.scenes)?;
    let progress = Progress::new("scoring", "scene", count, console::quiet());
    let report = score(&model, &options, &|| progress.add(1))?;
    progress.finish();
    let gates = gates(&report);
    let failed = gates.iter().any(|gate| !gate.passed);
    let value = json!({
        "weights": weights,
        "sha256": sha256,
        "device": args.device.to_string(),
        "report": report,
        "gates": gates,
    });
    let text = serde_json::to_string_pretty(&value)? + "\n";
    if let Some(path) = &args.out {
        write_atomic(path, text.as_bytes())
            .map_err(|error| anyhow::Error::new(error).context(path.display().to_string()))?;
    }
    if args.json {
        console::print(&text)?;
    } else {
        let heading = format!("{} (sha256 {})\n", weights.folder.display(), &sha256[..16]);
        console::print(&(heading + &table(&report, &gates)))?;
    }
    Ok(if args.gates && failed { ExitCode::SomeFailed } else { ExitCode::Success })
}
