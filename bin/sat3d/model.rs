//! `sat3d model`: weights looked into, fetched, written anew, scored, and the network held against the reference.

mod compare;
mod export;
mod score;

use crate::compute::ComputeArgs;
use crate::console;
use clap::Subcommand;
use sat3d::batch::{ExitCode, Progress};
use sat3d::model::Config;
use sat3d::model::parity::{self, Comparison, Set};
use sat3d::model::weights::{Inspection, WEIGHTS_FILE, examine, inspect_with};
use sat3d::weights::{self, Origin, Weights};
use serde_json::json;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

/// Fetch, inspect, verify, score and export the network that turns a satellite image into a scene.
#[derive(clap::Args, Debug)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    Fetch(FetchArgs),
    Inspect(InspectArgs),
    Verify(VerifyArgs),
    Score(score::Args),
    Compare(compare::Args),
    Export(export::Args),
}

/// Download weights into the cache of the Hugging Face hub.
///
/// Shows the licence first; nothing is downloaded before it is accepted. Only what a checkpoint needs
/// is fetched, and checked against the hub's hashes. An interrupted download continues. Python's
/// `huggingface_hub` finds the files in the same cache, and sat3d finds those that Python fetched.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model fetch                                   asks whether the licence is accepted
  sat3d model fetch --accept-license --json           without a terminal
  sat3d model fetch --repository me/finetuned --revision v2 --cache /data/hub

Environment: HF_ENDPOINT (a mirror), HF_TOKEN (private repositories), HF_HUB_CACHE and HF_HOME (the
cache), HF_HUB_OFFLINE, HF_HUB_DISABLE_SYMLINKS, HTTPS_PROXY, SSL_CERT_FILE.")]
struct FetchArgs {
    /// Repository on the hub
    #[arg(long, value_name = "OWNER/NAME", default_value = weights::REPOSITORY)]
    repository: String,
    /// Branch, tag or commit
    #[arg(long, default_value = weights::REVISION)]
    revision: String,
    /// Folder of the checkpoint in the repository, where it holds several
    #[arg(long, value_name = "FOLDER")]
    subfolder: Option<String>,
    /// Cache folder (default: as huggingface_hub has it, ~/.cache/huggingface/hub)
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Accept the licence without being asked
    #[arg(long, alias = "accept-licence")]
    accept_license: bool,
    /// Print what was fetched as JSON
    #[arg(long)]
    json: bool,
}

/// Say what is in a checkpoint: class, config, modules, parameters, hashes.
///
/// Checks the list of tensors against the config, and reports everything that is wrong at once.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model inspect                    the weights that other commands would use
  sat3d model inspect checkpoint-90000/  of a training: vqmodel_ema in it, else vqmodel
  sat3d model inspect weights/ --json

Without DIR: the environment variable SAT3D_WEIGHTS, then the cache of the Hugging Face hub, then the small
model inside the program (built-in:mini).")]
struct InspectArgs {
    /// Checkpoint folder, or a folder that holds one
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Print the description as JSON
    #[arg(long)]
    json: bool,
}

/// Compare every stage of the network with the reference on this machine.
///
/// Runs small networks whose weights follow a rule, so no checkpoint is needed, and holds each stage
/// against numbers that the authors' own code computed. Ends with 1 where a stage is off.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d model verify
  sat3d model verify --full --goldens goldens/")]
struct VerifyArgs {
    /// Also the network of the release, 381 million parameters; needs --goldens
    #[arg(long)]
    full: bool,
    /// Folder of the published parity data, instead of the samples that are built in
    #[arg(long, value_name = "DIR")]
    goldens: Option<PathBuf>,
    #[command(flatten)]
    compute: ComputeArgs,
    /// Print every comparison as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sat3d model`.
///
/// # Errors
/// There are no weights, they are not whole, or they cannot be fetched.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Command::Fetch(args) => fetch(args),
        Command::Inspect(args) => inspect(args),
        Command::Verify(args) => verify(args),
        Command::Score(args) => score::run(args),
        Command::Compare(args) => compare::run(args),
        Command::Export(args) => export::run(args),
    }
}

fn inspect(args: &InspectArgs) -> anyhow::Result<ExitCode> {
    const MEGABYTE: u64 = 1_000_000;
    let weights = weights::find(args.folder.as_deref())?;
    let checkpoint = match weights.origin {
        Origin::BuiltIn { .. } => weights.open()?,
        _ => examine(&weights.folder)?,
    };
    // Both the file and the modules in it are hashed.
    let total = 2 * checkpoint.file().bytes().len() as u64;
    // A small file is done before a bar could be read.
    let quiet = console::quiet() || total < 100 * MEGABYTE;
    let progress = Progress::new("hashing", "MB", (total / MEGABYTE) as usize, quiet);
    let hashed = AtomicU64::new(0);
    let inspection = inspect_with(&checkpoint, &|bytes| {
        let before = hashed.fetch_add(bytes, Ordering::Relaxed);
        progress.add((before + bytes) / MEGABYTE - before / MEGABYTE);
    });
    progress.finish();
    let config = checkpoint.config();
    if args.json {
        let value = json!({ "weights": weights, "config": config, "inspection": inspection });
        console::print(&(serde_json::to_string_pretty(&value)? + "\n"))?;
    } else {
        console::print(&described(&weights, config, &inspection)?)?;
    }
    Ok(ExitCode::Success)
}

/// A checkpoint for people.
fn described(weights: &Weights, config: &Config, found: &Inspection) -> anyhow::Result<String> {
    let origin = match &weights.origin {
        Origin::Argument => "named on the command line".to_owned(),
        Origin::Environment => format!("named by {}", weights::VARIABLE),
        Origin::Cache { repository, revision } => {
            format!("{repository} at {revision}, in the cache")
        }
        Origin::BuiltIn { .. } => {
            "part of the program (`sat3d model fetch` gets the released weights)".to_owned()
        }
        other => serde_json::to_string(other)?,
    };
    let backbone = &config.backbone;
    let padding = match config.pad_tokens() {
        0 => format!("none; the image covers {} of the cube's sides", config.scale),
        tokens => format!(
            "{tokens} tokens on each side; the image covers {} of the cube's sides",
            config.scale
        ),
    };
    let super_resolution = match config.super_resolution {
        1 => "none".to_owned(),
        factor => format!(
            "{factor} x, {} channels, border {}",
            config.super_resolution_channels,
            word(&config.super_resolution_border)?
        ),
    };
    let side = config.map_side();
    let rows = [
        ("checkpoint", found.folder.display().to_string()),
        ("found", origin),
        ("class", found.class_name.clone()),
        (
            "backbone",
            format!(
                "{}: {} layers of {} channels, {} heads, patches of {} px, {} registers",
                backbone.name,
                backbone.layers,
                backbone.hidden,
                backbone.heads,
                backbone.patch,
                backbone.registers
            ),
        ),
        ("image", format!("{0} x {0} px", config.image_side())),
        ("padding", padding),
        (
            "representation",
            format!(
                "{}, {} channels, {side} x {side}",
                word(&config.representation)?,
                config.plane_channels
            ),
        ),
        ("density", word(&config.activation)?),
        (
            "samples",
            format!(
                "{} coarse and {} fine along a ray",
                config.coarse_samples, config.fine_samples
            ),
        ),
        ("super-resolution", super_resolution),
    ];
    let mut out = String::new();
    for (name, value) in rows {
        writeln!(out, "{name:<18}{value}")?;
    }
    let width = found.modules.iter().map(|module| module.name.len()).max().unwrap_or(0).max(6);
    writeln!(
        out,
        "\n{:<width$}  {:>7}  {:>12}  {:>14}  {:<9} sha256",
        "module", "tensors", "parameters", "bytes", "type"
    )?;
    for module in &found.modules {
        writeln!(
            out,
            "{:<width$}  {:>7}  {:>12}  {:>14}  {:<9} {}",
            module.name,
            module.tensors,
            grouped(module.parameters),
            grouped(module.bytes),
            module.elements.join(" "),
            &module.sha256[..16]
        )?;
    }
    let tensors: usize = found.modules.iter().map(|module| module.tensors).sum();
    let bytes: u64 = found.modules.iter().map(|module| module.bytes).sum();
    let (parameters, bytes) = (grouped(found.parameters), grouped(bytes));
    writeln!(out, "{:<width$}  {tensors:>7}  {parameters:>12}  {bytes:>14}\n", "total")?;
    let list = |keys: &[String]| match keys {
        [] => "none".to_owned(),
        keys => keys.join(", "),
    };
    writeln!(out, "{:<18}{}", "buffers", list(&found.buffers))?;
    writeln!(out, "{:<18}{}", "absent", list(&found.absent))?;
    writeln!(out, "{:<18}{}", "left over", list(&found.left_over))?;
    writeln!(out, "{:<18}{WEIGHTS_FILE}, {} bytes", "file", grouped(found.bytes))?;
    writeln!(out, "{:<18}{}", "sha256", found.sha256)?;
    Ok(out)
}

/// The name that a switch has in JSON.
fn word(value: &impl serde::Serialize) -> anyhow::Result<String> {
    let value = serde_json::to_value(value)?;
    Ok(value.as_str().map_or_else(|| value.to_string(), str::to_owned))
}

/// A number with a comma between thousands.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

fn verify(args: &VerifyArgs) -> anyhow::Result<ExitCode> {
    let mut sets = vec![("tiny", Set::Tiny), ("tiny_triplane", Set::TinyTriplane)];
    if args.full {
        sets.push(("full", Set::Full));
    }
    let mut all = Vec::new();
    // Nothing lost, where nothing else is said.
    let mut wanted = args.compute.wanted();
    if wanted.precision.is_none() {
        wanted.tolerance_m = 0.0;
    }
    let execution = wanted.choose(&Config::released())?;
    for (name, set) in sets {
        let each = &mut |made: &Comparison| {
            tracing::info!(
                "{name} {}: relative L2 {:.2e}, largest {:.2e}",
                made.what,
                made.relative_l2,
                made.largest
            );
        };
        let made = parity::verify(set, &execution, args.goldens.as_deref(), each)?;
        all.extend(made.into_iter().map(|comparison| (name, comparison)));
    }
    let failed = all.iter().filter(|(_, comparison)| !comparison.passes()).count();
    if args.json {
        let list: Vec<serde_json::Value> =
            all.iter().map(|(set, made)| record(set, made)).collect();
        let value = json!({
            "device": execution.device.to_string(),
            "engine": execution.engine,
            "precision": execution.precision,
            "passed": failed == 0,
            "comparisons": list,
        });
        console::print(&(serde_json::to_string_pretty(&value)? + "\n"))?;
    } else {
        let mut out = table(&all)?;
        match failed {
            0 => writeln!(out, "\nall {} comparisons pass: {}", all.len(), execution)?,
            _ => {
                let count = all.len();
                writeln!(out, "\n{failed} of {count} comparisons fail: {execution}:")?;
                for (set, made) in all.iter().filter(|(_, made)| !made.passes()) {
                    writeln!(
                        out,
                        "  {set} {}: relative L2 {:.2e} (up to {:.1e}), largest {:.2e} (up to {:.1e})",
                        made.what,
                        made.relative_l2,
                        made.tolerance,
                        made.largest,
                        made.largest_allowed
                    )?;
                }
            }
        }
        console::print(&out)?;
    }
    Ok(if failed == 0 { ExitCode::Success } else { ExitCode::SomeFailed })
}

fn record(set: &str, made: &Comparison) -> serde_json::Value {
    json!({
        "set": set,
        "stage": made.stage,
        "what": made.what,
        "relative_l2": made.relative_l2,
        "tolerance": made.tolerance,
        "largest": made.largest,
        "largest_allowed": made.largest_allowed,
        "passes": made.passes(),
    })
}

/// One row per set and stage: the comparison that comes closest to its limit, or passes it furthest.
fn table(all: &[(&str, Comparison)]) -> anyhow::Result<String> {
    let mut stages: Vec<(&str, &str)> = Vec::new();
    for (set, made) in all {
        if !stages.contains(&(*set, made.stage)) {
            stages.push((*set, made.stage));
        }
    }
    let width = stages.iter().map(|(_, stage)| stage.len()).max().unwrap_or(0).max(5);
    let mut out = format!(
        "{:<13}  {:<width$}  {:>8}  {:>17}  {:>9}  {:>15}\n",
        "set", "stage", "compared", "worst relative L2", "tolerance", "largest / limit"
    );
    for (set, stage) in stages {
        let of_stage: Vec<&Comparison> = all
            .iter()
            .filter(|(of, made)| *of == set && made.stage == stage)
            .map(|(_, made)| made)
            .collect();
        // A limit of 0 is met by 0 alone; NaN is worse than anything.
        let part = |error: f64, limit: f64| match (error, limit) {
            (error, _) if error.is_nan() => f64::INFINITY,
            (0.0, _) => 0.0,
            (error, limit) => error / limit,
        };
        let by_norm = |made: &&&Comparison| part(made.relative_l2, made.tolerance);
        let Some(worst) = of_stage.iter().max_by(|a, b| by_norm(a).total_cmp(&by_norm(b))) else {
            continue;
        };
        let largest = of_stage
            .iter()
            .map(|made| part(made.largest, made.largest_allowed))
            .fold(0.0, f64::max);
        let passes = of_stage.iter().all(|made| made.passes());
        writeln!(
            out,
            "{set:<13}  {stage:<width$}  {:>8}  {:>17.2e}  {:>9.1e}  {largest:>15.2}  {}",
            of_stage.len(),
            worst.relative_l2,
            worst.tolerance,
            if passes { "pass" } else { "FAIL" }
        )?;
    }
    Ok(out)
}

#[cfg(not(feature = "fetch"))]
fn fetch(_: &FetchArgs) -> anyhow::Result<ExitCode> {
    anyhow::bail!(
        "this sat3d was built without `fetch`: build it with `--features fetch`, or get {} another \
         way (`hf download {}`, a browser) and name the folder with --weights or {}",
        weights::REPOSITORY,
        weights::REPOSITORY,
        weights::VARIABLE
    )
}

#[cfg(feature = "fetch")]
use download::fetch;

#[cfg(feature = "fetch")]
mod download {
    use super::{FetchArgs, grouped};
    use crate::console;
    use sat3d::batch::{ExitCode, Interrupt};
    use sat3d::weights::cache::Cache;
    use sat3d::weights::fetch::{FetchError, Fetched, Hub, Licence, Plan, Wanted};
    use sat3d::weights::{self, VARIABLE};
    use serde_json::json;
    use std::fmt::Write as _;
    use std::io::{self, IsTerminal, Write as _};

    /// Lines of a licence that are shown before it is asked for.
    const LINES: usize = 400;

    pub fn fetch(args: &FetchArgs) -> anyhow::Result<ExitCode> {
        let cache = match &args.cache {
            Some(folder) => Cache::new(folder),
            None => Cache::from_environment().ok_or_else(|| {
                anyhow::anyhow!(
                    "no home folder is known; name a cache with --cache or HF_HUB_CACHE"
                )
            })?,
        };
        let wanted = Wanted {
            repository: args.repository.clone(),
            revision: args.revision.clone(),
            subfolder: args.subfolder.clone(),
        };
        let hub = Hub::from_environment()?;
        let plan = hub.plan(&cache, &wanted)?;
        let missing = plan.missing();
        if missing > 0 && !accepted(&plan, missing, args.accept_license)? {
            anyhow::bail!("the licence was not accepted; nothing was fetched");
        }
        let fetched = match plan.fetch(&hub, &Interrupt::on_signals(), console::quiet()) {
            Err(error @ FetchError::Interrupted) => {
                // A closed standard error leaves only the exit code to say it.
                let _ = writeln!(io::stderr(), "{error}");
                return Ok(ExitCode::Interrupted);
            }
            other => other?,
        };
        let text = if args.json {
            let value = json!({
                "repository": wanted.repository,
                "revision": wanted.revision,
                "commit": plan.commit,
                "endpoint": hub.endpoint(),
                "licence": plan.licence,
                "folder": fetched.folder,
                "files": fetched.files,
            });
            serde_json::to_string_pretty(&value)? + "\n"
        } else {
            reported(&plan, &fetched)?
        };
        console::print(&text)?;
        Ok(ExitCode::Success)
    }

    /// Shows the licence, and asks where nobody answered already.
    fn accepted(plan: &Plan, missing: u64, already: bool) -> anyhow::Result<bool> {
        let mut screen = io::stderr();
        let mut text = format!(
            "{} at {}: {} bytes to fetch\nlicence: {}\n",
            plan.wanted.repository,
            plan.commit,
            grouped(missing),
            plan.licence.line()
        );
        if already {
            if !console::quiet() {
                screen.write_all(text.as_bytes())?;
            }
            return Ok(true);
        }
        text.push_str(&texts(&plan.licence));
        screen.write_all(text.as_bytes())?;
        if !(io::stdin().is_terminal() && screen.is_terminal()) {
            anyhow::bail!(
                "the licence above has to be accepted before anything is fetched; run the same \
                 command with --accept-license if you do"
            );
        }
        write!(screen, "\nDo you accept this licence? [y/N] ")?;
        screen.flush()?;
        let mut answer = String::new();
        io::stdin().read_line(&mut answer)?;
        Ok(matches!(answer.trim().to_ascii_lowercase().as_str(), "y" | "yes"))
    }

    fn texts(licence: &Licence) -> String {
        let mut out = String::new();
        for file in &licence.files {
            out.push_str(&format!("\n---- {} ----\n", file.path));
            // What a server sends must not move the cursor.
            let clean = |line: &str| line.replace(|c: char| c.is_control() && c != '\t', "?");
            for line in file.text.lines().take(LINES) {
                out.push_str(&clean(line));
                out.push('\n');
            }
            let left = file.text.lines().count().saturating_sub(LINES);
            if left > 0 {
                out.push_str(&format!("[{left} more lines, in the repository]\n"));
            }
        }
        out
    }

    fn reported(plan: &Plan, fetched: &Fetched) -> anyhow::Result<String> {
        let mut out = String::new();
        let width = fetched.files.iter().map(|file| file.path.len()).max().unwrap_or(0);
        for file in &fetched.files {
            let how = match file.received {
                0 => "was there",
                received if received < file.size => "continued",
                _ => "fetched",
            };
            let size = grouped(file.size);
            let hash = &file.sha256[..16];
            writeln!(out, "{:<width$}  {size:>14} bytes  sha256 {hash}  {how}", file.path)?;
        }
        writeln!(out, "{} at {}", plan.wanted.repository, plan.commit)?;
        writeln!(out, "licence: {}", plan.licence.line())?;
        writeln!(out, "checkpoint: {}", fetched.folder.display())?;
        let default = std::env::var_os(VARIABLE).is_none_or(|value| value.is_empty())
            && weights::find(None).is_ok_and(|found| found.folder == fetched.folder);
        if default {
            writeln!(out, "other commands find it by themselves")?;
        } else {
            writeln!(out, "other commands take it as --weights, or from {VARIABLE}")?;
        }
        Ok(out)
    }
}
