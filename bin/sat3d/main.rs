//! The command line: arguments -> plan -> run -> print, one file per subcommand.

mod batch_args;
mod completions;
mod compute;
mod console;
mod dsm_bench;
mod eval;
mod infer;
mod mesh_args;
mod model;
mod run;
mod simulate;
mod tile;
mod tradeoff;
mod train;
mod view;
mod view_args;
mod vigor;

use clap::{Parser, Subcommand};
use sat3d::batch::ExitCode;

/// Metric street-level 3-D from one satellite image, and the lidar benchmark that proves it.
#[derive(Parser, Debug)]
#[command(
    name = "sat3d",
    version,
    propagate_version = true,
    arg_required_else_help = true,
    after_help = console::EXIT_CODES
)]
pub(crate) struct Cli {
    #[command(flatten)]
    console: console::Args,
    #[command(subcommand)]
    command: Command,
}

/// Every subcommand; the doc comment of each `Args` is its help.
#[derive(Subcommand, Debug)]
pub(crate) enum Command {
    DsmBench(dsm_bench::Args),
    Eval(Box<eval::Args>),
    Model(model::Args),
    Infer(Box<infer::Args>),
    Tile(Box<tile::Args>),
    Tradeoff(tradeoff::Args),
    Train(train::Args),
    Run(run::Args),
    Simulate(simulate::Args),
    View(view::Args),
    Completions(completions::Args),
    Vigor(vigor::Args),
}

/// Runs one subcommand. Recipes call this once per step, `main` once.
///
/// # Errors
/// Whatever keeps the subcommand from doing its work at all; what befalls single items of a batch
/// is in the exit code.
pub(crate) fn dispatch(command: &Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::DsmBench(args) => dsm_bench::run(args),
        Command::Eval(args) => eval::run(args),
        Command::Model(args) => model::run(args),
        Command::Infer(args) => infer::run(args),
        Command::Tile(args) => tile::run(args),
        Command::Tradeoff(args) => tradeoff::run(args),
        Command::Train(args) => train::run(args),
        Command::Run(args) => run::run(args),
        Command::Simulate(args) => simulate::run(args),
        Command::View(args) => view::run(args),
        Command::Completions(args) => completions::run(args),
        Command::Vigor(args) => vigor::run(args),
    }
}

/// oneDNN's threads are OpenMP's, which spin for a while after each of its operations, where ours want to work: the
/// encoder took a third longer. Nothing but this variable tells them to sleep.
#[cfg(feature = "onednn")]
#[allow(
    unsafe_code,
    reason = "OpenMP reads the environment when oneDNN is loaded, and has no other way"
)]
fn let_openmp_sleep() {
    const POLICY: &str = "OMP_WAIT_POLICY";
    if std::env::var_os(POLICY).is_none() {
        // SAFETY: called first of all in `main`, when there is no other thread.
        unsafe { std::env::set_var(POLICY, "passive") };
    }
}

fn main() -> std::process::ExitCode {
    #[cfg(feature = "onednn")]
    let_openmp_sleep();
    console::install_panic_hook();
    let cli = Cli::parse();
    if let Err(error) = cli.console.install() {
        return console::report(&error).into();
    }
    dispatch(&cli.command).unwrap_or_else(|error| console::report(&error)).into()
}
