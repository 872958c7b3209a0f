//! How the program speaks: log lines, errors with help, quiet ends of pipes, and bugs.
//!
//! Results go to standard output; everything else (progress, warnings, errors) to standard error.

use sat3d::batch::ExitCode;
use sat3d::recipe;
use std::fmt;
use std::io::{self, IsTerminal, Write};
use std::panic::PanicHookInfo;
use std::sync::atomic::{AtomicBool, Ordering};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::FmtContext;
use tracing_subscriber::fmt::format::{FormatEvent, FormatFields, Writer};
use tracing_subscriber::registry::LookupSpan;

/// Footer of `sat3d --help`.
pub const EXIT_CODES: &str = "\
Exit codes:
  0    everything was done (an item skipped for a stated reason is no failure)
  1    some items failed; the others are done and stay done
  2    bad usage, unusable input, or nothing to do
  130  interrupted by Ctrl-C or SIGTERM; run the same command again to continue
  101  a bug in sat3d

Results are written to standard output; progress, warnings and errors to standard error.";

/// How much is said while a command runs.
#[derive(clap::Args, Debug)]
#[command(next_help_heading = "Messages")]
pub struct Args {
    /// Say more: -v what is done, -vv how, -vvv everything.
    #[arg(short, long, action = clap::ArgAction::Count, global = true, conflicts_with = "quiet")]
    verbose: u8,
    /// Say only errors; no progress.
    #[arg(short, long, global = true)]
    quiet: bool,
    /// Log filter in the syntax of the `tracing` crate, for example `sat3d::lidar=debug`.
    #[arg(long, value_name = "FILTER", env = "SAT3D_LOG", hide_env_values = true, global = true)]
    log: Option<String>,
}

static QUIET: AtomicBool = AtomicBool::new(false);

/// Whether `--quiet` was given: subcommands then show no progress.
pub fn quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

impl Args {
    /// Sends log lines to standard error from here on.
    ///
    /// # Errors
    /// `--log` is no filter.
    pub fn install(&self) -> anyhow::Result<()> {
        QUIET.store(self.quiet, Ordering::Relaxed);
        let filter = match &self.log {
            Some(text) => EnvFilter::try_new(text).map_err(|error| {
                anyhow::anyhow!(
                    "--log `{text}` is no filter: {error}; write a level (`debug`) or module=level \
                     (`sat3d::lidar=trace`), separated by commas"
                )
            })?,
            None => EnvFilter::new(match (self.quiet, self.verbose) {
                (true, _) => "error",
                (_, 0) => "warn",
                (_, 1) => "sat3d=info,warn",
                (_, 2) => "sat3d=debug,info",
                _ => "trace",
            }),
        };
        let lines = Lines { sources: self.verbose > 1 || self.log.is_some() };
        tracing_subscriber::fmt()
            .with_env_filter(filter)
            .with_writer(io::stderr)
            .with_ansi(colour())
            .event_format(lines)
            .init();
        Ok(())
    }
}

/// Whether standard error takes colours: a terminal, and neither `NO_COLOR` nor `TERM=dumb` is set.
fn colour() -> bool {
    let set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    io::stderr().is_terminal()
        && !set("NO_COLOR")
        && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// `text` in bold and an ANSI colour (31 red, 33 yellow, 36 cyan) where colours are wanted.
fn paint(text: &str, code: u8, on: bool) -> String {
    if on { format!("\x1b[1;{code}m{text}\x1b[0m") } else { text.to_owned() }
}

/// Log lines in the form of the program's other messages: `warning: tile 87 has no unit`.
struct Lines {
    /// Whether the module is named.
    sources: bool,
}

impl<S, N> FormatEvent<S, N> for Lines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let meta = event.metadata();
        let (label, code) = match *meta.level() {
            Level::ERROR => ("error:", 31),
            Level::WARN => ("warning:", 33),
            Level::INFO => ("info:", 36),
            Level::DEBUG => ("debug:", 36),
            Level::TRACE => ("trace:", 36),
        };
        let colour = writer.has_ansi_escapes();
        write!(writer, "{} ", paint(label, code, colour))?;
        if self.sources {
            write!(writer, "[{}] ", meta.target())?;
        }
        context.field_format().format_fields(writer.by_ref(), event)?;
        writeln!(writer)
    }
}

/// Columns of the terminal that standard output is, if it is one.
pub fn terminal_width() -> Option<usize> {
    let (width, _) = terminal_size::terminal_size_of(io::stdout())?;
    Some(usize::from(width.0))
}

/// Writes a result to standard output.
///
/// # Errors
/// Standard output cannot be written; [`report`] ends quietly when its reader is gone.
pub fn print(text: &str) -> anyhow::Result<()> {
    Ok(io::stdout().lock().write_all(text.as_bytes())?)
}

/// Prints an error with its causes, and help where there is some; the exit code to end with.
pub fn report(error: &anyhow::Error) -> ExitCode {
    if error.chain().any(is_broken_pipe) {
        // Whoever read our output has seen enough.
        return ExitCode::Success;
    }
    let colour = colour();
    let mut text = format!("{} {}\n", paint("error:", 31, colour), message(error));
    if let Some(help) = error.chain().find_map(help) {
        text.push_str(&format!("  {} {help}\n", paint("help:", 36, colour)));
    }
    // A closed standard error leaves only the exit code to say it.
    let _ = io::stderr().write_all(text.as_bytes());
    ExitCode::Usage
}

/// The error and its causes in one line, leaving out causes that the text before already quotes.
fn message(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text.push_str(": ");
            text.push_str(&cause);
        }
    }
    text
}

/// What the user can do about an error of a kind that says too little by itself.
fn help(error: &(dyn std::error::Error + 'static)) -> Option<String> {
    if let Some(error) = error.downcast_ref::<recipe::Error>() {
        return error.help();
    }
    let error = error.downcast_ref::<io::Error>()?;
    let help = match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "free some space and run the same command again: what is finished stays finished"
        }
        io::ErrorKind::PermissionDenied => {
            "check who owns the path and its folder, or write elsewhere (most commands take --out)"
        }
        io::ErrorKind::ReadOnlyFilesystem => "write elsewhere (most commands take --out)",
        _ => return None,
    };
    Some(help.to_owned())
}

fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|e| e.kind() == io::ErrorKind::BrokenPipe)
}

/// A panic is a bug: one line says so and where, instead of a stack trace (which `RUST_BACKTRACE=1`
/// still shows). A panic of `println!` because the reader is gone (`| head`) ends quietly.
pub fn install_panic_hook() {
    let standard = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        let what = payload(info);
        if what.starts_with("failed printing to std") && what.contains("Broken pipe") {
            std::process::exit(ExitCode::Success as i32);
        }
        let place = info.location().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(
            io::stderr(),
            "this is a bug in sat3d {}: {what} (at {place}); please report it with the command \
             line and this line",
            env!("CARGO_PKG_VERSION")
        );
        if std::env::var_os("RUST_BACKTRACE").is_some_and(|value| value != "0") {
            standard(info);
        }
    }));
}

fn payload(info: &PanicHookInfo<'_>) -> String {
    let payload = info.payload();
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("unknown cause").replace('\n', " ")
}
