//! Exit codes of every subcommand.

/// What the process tells its caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitCode {
    /// Everything was done (skipped items are no failure).
    Success = 0,
    /// Some items failed; the others are done and stay done.
    SomeFailed = 1,
    /// Bad usage, unusable input, or nothing to do.
    Usage = 2,
    /// Interrupted (Ctrl-C or SIGTERM); a second run continues.
    Interrupted = 130,
}

impl From<ExitCode> for std::process::ExitCode {
    fn from(code: ExitCode) -> Self {
        Self::from(code as u8)
    }
}
