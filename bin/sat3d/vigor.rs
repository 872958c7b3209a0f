//! `sat3d vigor`: what is in a VIGOR folder.

use crate::console;
use anyhow::Context as _;
use clap::Subcommand;
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::table::check_geopackage;
use sat3d::vigor::{ImageSize, Ingest, IngestError, IngestOptions, Layout, Verify};
use std::io::Write as _;
use std::path::PathBuf;

/// Work with the VIGOR data set.
#[derive(clap::Args, Debug)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    Ingest(IngestArgs),
}

const EXAMPLES: &str = "\
Examples:
  sat3d vigor ingest VIGOR/                        all cities of a root folder
  sat3d vigor ingest VIGOR/ --city Seattle         one of them
  sat3d vigor ingest labels/ --city Seattle        label files alone, without images
  sat3d vigor ingest Seattle/ --verify full --gpkg seattle.gpkg";

/// Read VIGOR's folders, labels and images, and check them against each other.
///
/// Finds where each panorama really lies in its satellite images, how far its labels are off, and
/// what is wrong with any file, line or image. Writes manifest.parquet (GeoParquet), manifest.csv
/// and summary.json.
#[derive(clap::Args, Debug)]
#[command(after_help = EXAMPLES)]
struct IngestArgs {
    /// VIGOR's root folder, one city's folder, or a folder of label files.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// City of a folder whose name does not say it; in a root, the only city to read.
    #[arg(long)]
    city: Option<String>,
    /// A label, split or list file that lies elsewhere; may be repeated.
    #[arg(long, value_name = "FILE")]
    labels: Vec<PathBuf>,
    /// Folder for the manifests and the summary.
    #[arg(short, long, value_name = "FOLDER", default_value = "ingest")]
    out: PathBuf,
    /// How closely images are looked at.
    #[arg(long, value_enum, default_value_t = VerifyArg::Header)]
    verify: VerifyArg,
    /// Also write a GeoPackage for QGIS: panoramas as points, images as footprints.
    #[arg(long, value_name = "FILE")]
    gpkg: Option<PathBuf>,
    /// Web-Mercator zoom of the satellite images.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u8).range(0..=30))]
    zoom: u8,
    /// Width and height of the satellite images in pixels.
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    size: u32,
    /// Metres per pixel in the UTM formula, instead of the city's own.
    #[arg(long, value_name = "METRES", value_parser = resolution)]
    resolution: Option<f64>,
    /// Print summary.json instead of the summary for people.
    #[arg(long)]
    json: bool,
}

#[derive(clap::ValueEnum, Clone, Copy, Debug)]
enum VerifyArg {
    /// Only whether they exist.
    None,
    /// Format, size and colours.
    Header,
    /// Every pixel.
    Full,
}

fn resolution(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("expected a length in metres, for example 0.114".to_owned()),
    }
}

/// Runs `sat3d vigor`.
///
/// # Errors
/// The folder holds nothing of VIGOR, or an output cannot be written.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Command::Ingest(args) => ingest(args),
    }
}

fn ingest(args: &IngestArgs) -> anyhow::Result<ExitCode> {
    if let Some(path) = &args.gpkg {
        check_geopackage(path)?;
    }
    let layout = Layout::find(&args.folder, args.city.as_deref(), &args.labels)?;
    let options = IngestOptions {
        size: ImageSize { zoom: args.zoom, pixels: args.size },
        verify: match args.verify {
            VerifyArg::None => Verify::None,
            VerifyArg::Header => Verify::Header,
            VerifyArg::Full => Verify::Full,
        },
        resolution_m: args.resolution,
    };
    let ingest = match Ingest::run(&layout, &options, &Interrupt::on_signals(), console::quiet()) {
        Err(IngestError::Interrupted) => return Ok(ExitCode::Interrupted),
        other => other?,
    };
    ingest.write(&args.out)?;
    if let Some(path) = &args.gpkg {
        ingest.write_geopackage(path)?;
    }
    let mut out = std::io::stdout().lock();
    if args.json {
        write!(out, "{}", ingest.summary.to_json())
    } else {
        write!(out, "{}", ingest.summary).and_then(|()| {
            let written = args.out.join("manifest.{parquet,csv}");
            writeln!(out, "wrote {} and summary.json", written.display())?;
            args.gpkg.as_ref().map_or(Ok(()), |path| writeln!(out, "wrote {}", path.display()))
        })
    }
    .context("cannot write to standard output")?;
    Ok(ingest.exit_code())
}
