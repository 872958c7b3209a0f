//! `sat3d model score`: a model on simulated scenes that no training saw.

use crate::compute::ComputeArgs;
use crate::console;
use crate::infer::ScaleArg;
use sat3d::batch::{ExitCode, Progress, write_atomic};
use sat3d::footprint::{Footprint, VerticalScale};
use sat3d::model::Model;
use sat3d::score::{Options, gates, score, table};
use sat3d::weights::{self, whole_hash};
use serde_json::json;
use std::path::PathBuf;

/// Score a model on simulated scenes that no training saw.
///
/// Draws scenes at random, whose heights are exact, and holds against them: the DSM beside flat ground, the height
/// of each building beside the best constant, the top of the mesh beside the DSM, and floaters. Intervals are
/// bootstraps over scenes. The scenes of a seed are others than those of a training with the same seed.
///
/// A model that was trained with a border around its image (model.mini.pad) by the paper's signals has heights
/// in the proportion of its views: --vertical-scale isotropic. Without a border both scales are the same.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model score                                       the weights that other commands would use
  sat3d model score --weights runs/mini/checkpoint-20000 --gates
  sat3d model score --seeds 7 --scenes 8                  a quick look
  sat3d model score --json --out score.json
  sat3d model score --weights runs/padded/checkpoint-400 --vertical-scale isotropic --out full/1.json --keep

`sat3d model compare` holds reports against each other.")]
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
    /// How heights become metres: 64.48 m per 1.0 (the published scoring), or as across
    #[arg(long, value_enum, default_value_t = ScaleArg::Paper)]
    vertical_scale: ScaleArg,
    /// Leave a report in --out alone that is of the same weights, scenes and scale
    #[arg(long, requires = "out", conflicts_with = "gates")]
    keep: bool,
    /// End with 1 where a gate of the small model fails
    #[arg(long)]
    gates: bool,
    #[command(flatten)]
    compute: ComputeArgs,
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
    let mut options =
        Options { seeds: args.seeds.clone(), scenes: args.scenes, ..Options::default() };
    if matches!(args.vertical_scale, ScaleArg::Isotropic) {
        let side = u32::try_from(options.side)?;
        options.metres_per_unit = Footprint::of_gsd([side; 2], [options.pixel_m; 2])
            .vertical_metres_per_unit(VerticalScale::Isotropic, checkpoint.config().scale);
    }
    if let (true, Some(path)) = (args.keep, &args.out)
        && let Ok(text) = std::fs::read_to_string(path)
        && is_report_of(&text, &sha256, &options)
    {
        let said = format!("{}: of these weights and scenes already\n", path.display());
        console::print(if args.json { &text } else { &said })?;
        return Ok(ExitCode::Success);
    }
    let execution = args.compute.wanted().choose(checkpoint.config())?;
    let model = Model::from_source(checkpoint.config().clone(), Box::new(checkpoint), &execution)?;
    let count = args.seeds.len() * usize::try_from(args.scenes)?;
    let progress = Progress::new("scoring", "scene", count, console::quiet());
    let report = score(&model, &options, &|| progress.add(1))?;
    progress.finish();
    let gates = gates(&report);
    let failed = gates.iter().any(|gate| !gate.passed);
    let value = json!({
        "weights": weights,
        "sha256": sha256,
        "device": execution.device.to_string(),
        "engine": execution.engine,
        "precision": execution.precision,
        "report": report,
        "gates": gates,
    });
    let text = serde_json::to_string_pretty(&value)? + "\n";
    if let Some(path) = &args.out {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|error| anyhow::Error::new(error).context(folder.display().to_string()))?;
        }
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

/// Whether a text is a report of these weights and options.
fn is_report_of(text: &str, sha256: &str, options: &Options) -> bool {
    let Ok(value) = serde_json::from_str::<serde_json::Value>(text) else { return false };
    let same_options = serde_json::from_value(value["report"]["options"].clone())
        .is_ok_and(|found: Options| found == *options);
    value["sha256"] == sha256 && same_options
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_is_kept_for_its_own_weights_and_options() {
        let options = Options::default();
        let text = json!({ "sha256": "ab", "report": { "options": options } }).to_string();
        assert!(is_report_of(&text, "ab", &options));
        assert!(!is_report_of(&text, "cd", &options));
        assert!(!is_report_of(&text, "ab", &Options { metres_per_unit: 40.32, ..options.clone() }));
        assert!(!is_report_of("{}", "ab", &options) && !is_report_of("", "ab", &options));
    }
}
