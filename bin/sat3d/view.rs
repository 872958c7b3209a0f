//! `sat3d view`: results in a browser.

use crate::console;
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::viewer::{Contents, ItemKind, Limits, Server};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Show 3D Tiles and meshes in a browser, from this machine alone and without a network.
///
/// Serves a folder on 127.0.0.1 together with a page that draws it: orbit, pan and zoom, heights and distances by
/// click, wireframe and shading, the level of detail, attribution and metadata. Nothing is written, and nothing is
/// loaded from the internet. Ctrl-C ends it.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  sat3d view city_tiles
  sat3d view predictions --open
  sat3d view house.glb --port 8080

The address is printed; other machines cannot reach it. From afar: ssh -L 8080:127.0.0.1:8080 HOST, there
`sat3d view DIR --port 8080`, and here http://127.0.0.1:8080/")]
pub struct Args {
    /// A 3D Tiles folder (with tileset.json), a .glb file, or a folder that holds such.
    #[arg(value_name = "DIR")]
    input: PathBuf,
    /// Port of 127.0.0.1; 0 takes a free one.
    #[arg(long, value_name = "N", default_value_t = 0)]
    port: u16,
    /// Open the page in the browser.
    #[arg(long)]
    open: bool,
    /// Print the address and what is served as one JSON object.
    #[arg(long)]
    json: bool,
}

/// Serves until Ctrl-C or SIGTERM, which are how it ends and no failure.
///
/// # Errors
/// There is nothing to show, or the port cannot be listened on.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let contents = Contents::find(&args.input)?;
    for warning in contents.warnings() {
        tracing::warn!("{warning}");
    }
    let text = |url: &str| -> anyhow::Result<String> {
        if args.json {
            let folder = contents.root().display().to_string();
            let value =
                serde_json::json!({ "url": url, "folder": folder, "items": contents.items() });
            return Ok(format!("{value:#}\n"));
        }
        Ok(for_people(&contents, url))
    };
    // Before the address is printed: whoever reads it may send the signal at once.
    let interrupt = Interrupt::on_signals();
    let server = Server::bind(contents.clone(), args.port, Limits::default())?;
    let url = server.url();
    console::print(&text(&url)?)?;
    if args.open && !open(&url) {
        tracing::warn!("no browser could be started; open {url} by hand");
    }
    let served = server.run(&interrupt);
    tracing::info!("answered {} requests", served.requests);
    Ok(ExitCode::Success)
}

/// How many items are named on the terminal.
const NAMED: usize = 10;

fn for_people(contents: &Contents, url: &str) -> String {
    let mut text = format!("{url}  shows {}\n", contents.root().display());
    for item in contents.items().iter().take(NAMED) {
        let kind = match item.kind {
            ItemKind::Tileset => "3D Tiles",
            ItemKind::Mesh => "mesh",
        };
        let _ = writeln!(text, "  {kind:<8}  {}", item.name);
    }
    if contents.items().len() > NAMED {
        let _ = writeln!(text, "  and {} more", contents.items().len() - NAMED);
    }
    text.push_str("Ctrl-C ends it\n");
    text
}

/// Starts the browser; whether there is one.
fn open(url: &str) -> bool {
    let program: &[&str] = if cfg!(target_os = "macos") {
        &["open"]
    } else if cfg!(windows) {
        &["cmd", "/C", "start", ""]
    } else {
        &["xdg-open"]
    };
    let mut command = Command::new(program[0]);
    command.args(&program[1..]).arg(url);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().is_ok()
}
