//! `sat3d run`: a chain of subcommands from a recipe.

use crate::{Cli, console, dispatch};
use anyhow::Context as _;
use clap::{CommandFactory, Parser};
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::recipe::{Chain, Recipe, Step};
use serde_json::{Value, json};
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Instant;

/// Run a chain of subcommands that a recipe (a TOML file) describes.
///
/// Every step is checked before the first one runs. A step of which some items fail does not stop
/// the chain (the exit code is then 1); a step that cannot do its work, or Ctrl-C, does. Steps that
/// work in batches leave finished items alone, so the same command continues where it stopped.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d run pipelines/quickstart.toml
  sat3d run pipelines/vigor_ood.toml --set lidar=/data/king_county --set vigor=/data/VIGOR/Seattle
  sat3d run pipelines/vigor_ood.toml --explain")]
pub struct Args {
    /// The recipe.
    #[arg(value_name = "RECIPE.toml")]
    recipe: PathBuf,
    /// Replace a variable of the recipe's [paths] or [variables]; a path is relative to the
    /// current folder.
    #[arg(long, value_name = "NAME=VALUE")]
    set: Vec<String>,
    /// Print what each step would do, with its error budget, and run nothing.
    #[arg(long)]
    explain: bool,
    /// Check the recipe, print the command line of each step, and run nothing.
    #[arg(long, conflicts_with = "explain")]
    dry_run: bool,
    /// Print one JSON object with the report of every step.
    #[arg(long)]
    json: bool,
}

/// Runs (or explains) the chain.
///
/// # Errors
/// The recipe cannot be read or is wrong.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let recipe = Recipe::read(&args.recipe)?;
    let cwd = std::env::current_dir().context("the current folder is gone")?;
    let chain = recipe.resolve(&args.set, &cwd, &Cli::command())?;
    let extra = extra_flags(args);
    let parsed = chain
        .steps
        .iter()
        .map(|step| {
            Cli::try_parse_from(step.words(&extra(step))).map_err(|error| step.refused(&error))
        })
        .collect::<Result<Vec<_>, _>>()?;

    let mut outcomes = Vec::new();
    let code = if args.dry_run {
        for step in &chain.steps {
            if !args.json {
                println!("{}", step.command_line());
            }
            outcomes.push(Outcome::not_run(step));
        }
        ExitCode::Success
    } else if args.explain {
        explain(args, &recipe, &chain, &parsed, &mut outcomes)?
    } else {
        execute(args, &chain, &parsed, &mut outcomes)?
    };

    if args.json {
        let report = json!({
            "recipe": args.recipe.display().to_string(),
            "exit_code": code as i32,
            "steps": outcomes.iter().map(Outcome::json).collect::<Vec<_>>(),
        });
        println!("{report:#}");
    } else if !args.explain && !args.dry_run {
        summary(args, &chain, &outcomes, code);
    }
    Ok(code)
}

/// Flags that a step gets beside its own arguments.
fn extra_flags(args: &Args) -> impl Fn(&Step) -> Vec<&'static str> {
    let (explain, json) = (args.explain, args.json);
    move |step| {
        let mut flags = Vec::new();
        flags.extend((explain && step.explains).then_some("--explain"));
        flags.extend((json && step.json).then_some("--json"));
        flags
    }
}

/// How a step ended.
struct Outcome<'a> {
    step: &'a Step,
    /// `None` when it did not run.
    code: Option<ExitCode>,
    seconds: f64,
    /// What it printed, where that was collected.
    report: Value,
    error: Option<String>,
}

impl<'a> Outcome<'a> {
    fn not_run(step: &'a Step) -> Self {
        Self { step, code: None, seconds: 0.0, report: Value::Null, error: None }
    }

    const fn status(&self) -> &'static str {
        match self.code {
            None => "not run",
            Some(ExitCode::Success) => "done",
            Some(ExitCode::SomeFailed) => "some failed",
            Some(ExitCode::Usage) => "failed",
            Some(ExitCode::Interrupted) => "interrupted",
        }
    }

    fn json(&self) -> Value {
        let mut object = json!({
            "step": self.step.number,
            "command": self.step.command.join(" "),
            "arguments": self.step.arguments,
            "status": self.status(),
        });
        if let Some(code) = self.code {
            object["exit_code"] = (code as i32).into();
        }
        if !self.report.is_null() {
            object["report"] = self.report.clone();
        }
        if let Some(error) = &self.error {
            object["error"] = error.as_str().into();
        }
        object
    }
}

/// Runs the steps until one stops the chain; the code to end with.
fn execute<'a>(
    args: &Args,
    chain: &'a Chain,
    parsed: &[Cli],
    outcomes: &mut Vec<Outcome<'a>>,
) -> anyhow::Result<ExitCode> {
    // Between steps the chain looks at the flag itself, should a step have had no use for it.
    let interrupt = Interrupt::on_signals();
    let mut worst = ExitCode::Success;
    for (step, cli) in chain.steps.iter().zip(parsed) {
        if worst == ExitCode::Usage || worst == ExitCode::Interrupted {
            outcomes.push(Outcome::not_run(step));
            continue;
        }
        if interrupt.requested() {
            worst = ExitCode::Interrupted;
            outcomes.push(Outcome::not_run(step));
            continue;
        }
        announce(&format!("[{}/{}] {}", step.number, chain.steps.len(), step.command_line()));
        let outcome = one(args, step, cli)?;
        worst = match (worst, outcome.code) {
            (before, None | Some(ExitCode::Success)) => before,
            (_, Some(code)) => code,
        };
        outcomes.push(outcome);
    }
    Ok(worst)
}

/// Runs one step.
fn one<'a>(args: &Args, step: &'a Step, cli: &Cli) -> io::Result<Outcome<'a>> {
    let started = Instant::now();
    let (result, report) = if args.json {
        let (result, printed) = collect(|| dispatch(&cli.command))?;
        (result, serde_json::from_str(&printed).unwrap_or(Value::String(printed)))
    } else {
        (dispatch(&cli.command), Value::Null)
    };
    let (code, error) = match result {
        Ok(code) => (code, None),
        Err(error) => (console::report(&error), Some(format!("{error:#}"))),
    };
    let seconds = started.elapsed().as_secs_f64();
    Ok(Outcome { step, code: Some(code), seconds, report, error })
}

/// Prints the plan of every step that has one; a step whose input an earlier step makes is named.
fn explain<'a>(
    args: &Args,
    recipe: &Recipe,
    chain: &'a Chain,
    parsed: &[Cli],
    outcomes: &mut Vec<Outcome<'a>>,
) -> anyhow::Result<ExitCode> {
    let say = |text: &str| {
        if !args.json {
            println!("{text}");
        }
    };
    if let Some(description) = recipe.description() {
        say(&format!("{description}\n"));
    }
    let mut worst = ExitCode::Success;
    for (index, (step, cli)) in chain.steps.iter().zip(parsed).enumerate() {
        say(&format!("step {} of {}: {}", step.number, chain.steps.len(), step.command_line()));
        let mut outcome = Outcome::not_run(step);
        if !step.explains {
            outcome.report = "this command has no plan to explain".into();
        } else if let Some((path, maker)) = step.waits_for(&chain.steps[..index]) {
            outcome.report = format!(
                "its plan depends on {}, which step {} makes; explain again after that",
                path.display(),
                maker.number
            )
            .into();
        } else {
            outcome = one(args, step, cli)?;
            worst = outcome.code.filter(|code| *code != ExitCode::Success).unwrap_or(worst);
        }
        if let (None, Some(text)) = (outcome.code, outcome.report.as_str()) {
            say(&format!("  ({text})"));
        }
        say("");
        outcomes.push(outcome);
    }
    Ok(worst)
}

/// Runs `work` and collects what it prints to standard output.
#[cfg(unix)]
fn collect<T>(work: impl FnOnce() -> T) -> io::Result<(T, String)> {
    use std::io::{Read, Seek};
    use std::os::fd::AsFd;
    let mut file = tempfile::tempfile()?;
    let mut stdout = io::stdout();
    stdout.flush()?;
    let original = stdout.as_fd().try_clone_to_owned()?;
    rustix::stdio::dup2_stdout(&file)?;
    let result = work();
    let flushed = stdout.flush();
    rustix::stdio::dup2_stdout(&original)?;
    flushed?;
    let mut printed = Vec::new();
    file.rewind()?;
    file.read_to_end(&mut printed)?;
    Ok((result, String::from_utf8_lossy(&printed).trim_end().to_owned()))
}

/// Standard output can be collected on Unix only.
#[cfg(not(unix))]
fn collect<T>(_: impl FnOnce() -> T) -> io::Result<(T, String)> {
    Err(io::Error::new(
        io::ErrorKind::Unsupported,
        "`sat3d run --json` needs a Unix system; without --json the chain runs here too",
    ))
}

/// A line about the chain itself, on standard error.
fn announce(line: &str) {
    if !console::quiet() {
        // A closed standard error must not end the work.
        let _ = writeln!(io::stderr(), "{line}");
    }
}

fn summary(args: &Args, chain: &Chain, outcomes: &[Outcome<'_>], code: ExitCode) {
    println!("\n{}", args.recipe.display());
    let width = outcomes.iter().map(|o| o.step.command.join(" ").len()).max().unwrap_or(0);
    for outcome in outcomes {
        let (number, command) = (outcome.step.number, outcome.step.command.join(" "));
        let status = outcome.status();
        println!("  {number:2}  {command:width$}  {status:11}  {:8.1} s", outcome.seconds);
    }
    if let (ExitCode::Success | ExitCode::SomeFailed, Some(closing)) = (code, &chain.closing) {
        println!("\n{closing}");
    }
}
