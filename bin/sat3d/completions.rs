//! `sat3d completions`: what a shell needs to complete subcommands and flags.

use clap::CommandFactory;
use sat3d::batch::ExitCode;
use std::io::Write;

/// Print a completion script for a shell.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d completions bash > ~/.local/share/bash-completion/completions/sat3d
  sat3d completions zsh > ~/.zfunc/_sat3d
  sat3d completions fish > ~/.config/fish/completions/sat3d.fish")]
pub struct Args {
    /// The shell that will read the script.
    shell: clap_complete::Shell,
}

/// Prints the script to standard output.
///
/// # Errors
/// Standard output cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // Into memory first: the generator panics when its writer fails, and a closed pipe is no bug.
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut crate::Cli::command(), "sat3d", &mut script);
    std::io::stdout().lock().write_all(&script)?;
    Ok(ExitCode::Success)
}
