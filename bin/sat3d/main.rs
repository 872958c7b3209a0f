//! The command line: arguments -> plan -> run -> print, one file per subcommand.

use clap::{Parser, Subcommand};
use sat3d::batch::ExitCode;

/// Metric street-level 3-D from one satellite image, and the lidar benchmark that proves it.
#[derive(Parser, Debug)]
#[command(name = "sat3d", version, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {}

fn main() -> std::process::ExitCode {
    let cli = Cli::parse();
    let result: anyhow::Result<ExitCode> = match cli.command {};
    match result {
        Ok(code) => code.into(),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::Usage.into()
        }
    }
}
