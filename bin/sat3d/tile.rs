//! `sat3d tile`: a city from one big picture.

use crate::batch_args::{BatchArgs, parse_gsd};
use crate::compute::{ComputeArgs, PackedArgs, warn_of};
use crate::console;
use clap::{Subcommand, ValueEnum};
use sat3d::batch::{ExitCode, Interrupt};
use sat3d::footprint::VerticalScale;
use sat3d::mesh_file::MeshFormat;
use sat3d::tile::layout::{Blend, WindowOptions};
use sat3d::tile::{
    self, CityMeshColour, CityMeshRequest, DsmRequest, TILES3D_ERROR_M, TileLattice, TileOptions,
    TileOutputs, TileSummary, Tiles3dRequest,
};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A city from one big picture: one seamless DSM, mesh and density volume.
///
/// Windows slide over the picture, the network makes each a density field, and the fields are averaged where
/// they overlap. Memory grows with the picture's shorter side alone. Where no output is named, the DSM and the
/// mesh are written as <stem>_dsm.tif and <stem>.glb. A second run continues where the first ended.
#[derive(clap::Args, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:
  sat3d tile big.png --stride 128
  sat3d tile city.tif --out city/ --dsm city.tif --t_srs EPSG:32610 --mesh city.glb --error 0.3
  sat3d tile city.tif --out city/ --tiles3d tiles --base-height 20
  sat3d tile photo.jpg --gsd 0.5 --density volume.zarr --stride 64 --blend hann
  sat3d tile city.tif --out part1/ --shard 1/2
  sat3d tile big.png --trim 32 --stride 64 --isovalue 4.5 --lattice reference
  sat3d tile city.tif --explain"
)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    tile: TileArgs,
}

#[derive(Subcommand, Debug)]
enum Command {
    Merge(MergeArgs),
}

#[derive(clap::Args, Debug)]
struct TileArgs {
    /// Picture of any size: PNG, JPEG, GeoTIFF; with GDAL also VRT and whatever it reads
    #[arg(value_name = "PICTURE", required = true)]
    input: Option<PathBuf>,
    /// Checkpoint folder: config.json and diffusion_pytorch_model.safetensors (default: SAT3D_WEIGHTS, then
    /// what `sat3d model fetch` has fetched, then `built-in:mini`, the small model inside the program)
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// Output folder
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    #[command(flatten)]
    compute: ComputeArgs,
    #[command(flatten)]
    packed: PackedArgs,
    /// Memory for the sums of open lines, MiB; what does not fit is kept in a file
    #[arg(long, default_value_t = 4096, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1_048_576))]
    memory: u64,
    /// Insist on continuing an earlier run (a second run continues in any case)
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    batch: BatchArgs,
    #[command(flatten, next_help_heading = "Windows")]
    windows: WindowArgs,
    #[command(flatten, next_help_heading = "Outputs")]
    outputs: OutputArgs,
}

#[derive(clap::Args, Debug)]
struct WindowArgs {
    /// Model pixels from one window of 256 to the next; smaller is smoother and slower
    #[arg(long, value_name = "PX", default_value_t = 128)]
    stride: u32,
    /// Weights where windows overlap
    #[arg(long, value_enum, default_value_t = BlendArg::Mean)]
    blend: BlendArg,
    /// Model pixels that are dropped along the sides of windows inside the picture
    #[arg(long, value_name = "PX", default_value_t = 0)]
    trim: u32,
    /// Ground metres per pixel of the picture, over what its name and georeference say
    #[arg(long, value_name = "M[,M]", allow_negative_numbers = true, value_parser = parse_gsd)]
    gsd: Option<[f64; 2]>,
    /// Ground metres per model pixel (default: pixels of Web Mercator at zoom 20 times 2.5, as in training;
    /// otherwise 0.28)
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    window_gsd: Option<f64>,
    /// Where densities are taken: at the pixels' centres, or on the released grid, whose columns drift by up
    /// to one voxel
    #[arg(long, value_enum, default_value_t = LatticeArg::Pixels)]
    lattice: LatticeArg,
    /// How heights become metres: 32.24 m per cube unit (the published scoring), or as across
    #[arg(long, value_enum, default_value_t = ScaleArg::Paper)]
    vertical_scale: ScaleArg,
}

#[derive(clap::Args, Debug)]
struct OutputArgs {
    /// Write the DSM under this name: a Cloud Optimized GeoTIFF in metres
    #[arg(long, value_name = "NAME.tif", value_parser = dsm_name)]
    dsm: Option<String>,
    /// Also write a hillshaded picture of the DSM, <stem>_dsm_preview.png
    #[arg(long)]
    preview: bool,
    /// Warp the DSM to this CRS (default: the picture's own)
    #[arg(long = "t_srs", alias = "t-srs", value_name = "EPSG:CODE")]
    t_srs: Option<String>,
    /// Write the mesh under this name: city.glb, city.ply or city.obj
    #[arg(long, value_name = "NAME", value_parser = mesh_name)]
    mesh: Option<MeshName>,
    /// What colours the mesh: the picture at its vertices, the picture as a texture, or nothing
    #[arg(long, value_enum, default_value_t = ColorArg::Vertex)]
    mesh_color: ColorArg,
    /// Density of the surface of mesh and 3D Tiles, per unit of the cube
    #[arg(long, value_name = "DENSITY", default_value_t = tile::ISOVALUE, allow_negative_numbers = true)]
    isovalue: f32,
    /// Simplify the mesh, and the finest level of 3D Tiles, as long as the error stays within this, metres
    #[arg(long, value_name = "M", value_parser = metres)]
    error: Option<f64>,
    /// Simplify the mesh to at most this many triangles
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(4..))]
    max_triangles: Option<u64>,
    /// Write the density volume as this Zarr folder
    #[arg(long, value_name = "NAME.zarr", value_parser = zarr_name)]
    density: Option<String>,
    /// Write 3D Tiles into this folder; `sat3d view` shows them
    #[arg(long, value_name = "DIR")]
    tiles3d: Option<String>,
    /// Height of the scene's bottom above the ellipsoid for 3D Tiles, metres
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_negative_numbers = true)]
    base_height: f64,
}

/// Join the parts of a city, and make its outputs.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  sat3d tile merge --out city/                  (parts that worked in one folder)
  sat3d tile merge --out city/ part1/ part2/    (parts of other folders, copied)")]
struct MergeArgs {
    /// Folder of the whole city
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    /// Folders of parts
    parts: Vec<PathBuf>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum BlendArg {
    Mean,
    Hann,
    Gaussian,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LatticeArg {
    Pixels,
    Reference,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ScaleArg {
    Paper,
    Isotropic,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ColorArg {
    Vertex,
    Texture,
    None,
}

#[derive(Clone, Debug)]
struct MeshName {
    file: String,
    format: MeshFormat,
}

fn plain(text: &str) -> Result<&str, String> {
    if text.is_empty() || text.contains(['/', '\\']) {
        return Err("outputs are written into the output folder: give a name without folders, and the folder with --out".to_owned());
    }
    Ok(text)
}

fn ends(text: &str, endings: &[&str]) -> bool {
    text.rsplit_once('.').is_some_and(|(stem, end)| {
        !stem.is_empty() && endings.iter().any(|known| end.eq_ignore_ascii_case(known))
    })
}

fn dsm_name(text: &str) -> Result<String, String> {
    match ends(plain(text)?, &["tif", "tiff"]) {
        true => Ok(text.to_owned()),
        false => Err("the DSM is a GeoTIFF: give a name that ends with .tif".to_owned()),
    }
}

fn zarr_name(text: &str) -> Result<String, String> {
    match ends(plain(text)?, &["zarr"]) {
        true => Ok(text.to_owned()),
        false => Err("the volume is a Zarr folder: give a name that ends with .zarr".to_owned()),
    }
}

fn mesh_name(text: &str) -> Result<MeshName, String> {
    let end = plain(text)?.rsplit_once('.').filter(|(stem, _)| !stem.is_empty());
    let Some((_, end)) = end else {
        return Err("give a file name that ends with .glb, .ply or .obj".to_owned());
    };
    Ok(MeshName { file: text.to_owned(), format: end.parse()? })
}

fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|value: &f64| value.is_finite() && *value > 0.0);
    value.ok_or_else(|| "not a number of metres above 0".to_owned())
}

/// Runs `sat3d tile`.
///
/// # Errors
/// Whatever keeps the run from its work.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(Command::Merge(args)) = &args.command {
        let summary =
            tile::merge(&args.out, &args.parts, console::quiet(), &Interrupt::on_signals())?;
        report(&summary, &args.out, args.json)?;
        return Ok(summary.exit_code());
    }
    let args = &args.tile;
    let prepared = tile::prepare(args.options()?)?;
    for warning in &prepared.warnings {
        tracing::warn!("{warning}");
    }
    if args.batch.explain {
        if args.batch.json {
            console::print(&(serde_json::to_string_pretty(&prepared.plan)? + "\n"))?;
        } else {
            console::print(&prepared.plan.explain())?;
        }
        return Ok(ExitCode::Success);
    }
    let summary = prepared.run(&Interrupt::on_signals())?;
    warn_of(prepared.packed());
    report(&summary, &args.out, args.batch.json)?;
    Ok(summary.exit_code())
}

impl TileArgs {
    fn options(&self) -> anyhow::Result<TileOptions> {
        let Some(input) = self.input.clone() else { anyhow::bail!("give a PICTURE") };
        let mut options = TileOptions::new(input, self.weights.clone(), self.out.clone());
        options.compute = self.compute.wanted();
        options.packed_weights = self.packed.packed_weights.clone();
        options.windows = WindowOptions {
            stride: self.windows.stride,
            trim: self.windows.trim,
            blend: match self.windows.blend {
                BlendArg::Mean => Blend::Mean,
                BlendArg::Hann => Blend::Hann,
                BlendArg::Gaussian => Blend::Gaussian,
            },
        };
        options.gsd_m = self.windows.gsd;
        options.window_gsd_m = self.windows.window_gsd;
        options.lattice = match self.windows.lattice {
            LatticeArg::Pixels => TileLattice::Pixels,
            LatticeArg::Reference => TileLattice::Reference,
        };
        options.vertical = match self.windows.vertical_scale {
            ScaleArg::Paper => VerticalScale::Paper,
            ScaleArg::Isotropic => VerticalScale::Isotropic,
        };
        options.isovalue = self.outputs.isovalue;
        let stem = options.input.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        options.outputs = self.outputs.requests(&stem)?;
        options.memory = self.memory << 20;
        options.threads = self.batch.threads();
        options.shard = self.batch.shard;
        options.verify = self.batch.verify();
        options.overwrite = self.batch.overwrite;
        options.resume = self.resume;
        options.quiet = console::quiet();
        Ok(options)
    }
}

impl OutputArgs {
    fn requests(&self, stem: &str) -> anyhow::Result<TileOutputs> {
        let asked = self.dsm.is_some()
            || self.mesh.is_some()
            || self.density.is_some()
            || self.tiles3d.is_some();
        let mut outputs = if asked { TileOutputs::default() } else { TileOutputs::of_stem(stem) };
        if let Some(file) = &self.dsm {
            outputs.dsm = Some(DsmRequest { file: file.clone(), preview: false, t_srs: None });
        }
        match &mut outputs.dsm {
            Some(dsm) => {
                dsm.t_srs.clone_from(&self.t_srs);
                dsm.preview = self.preview;
            }
            None => anyhow::ensure!(
                self.t_srs.is_none() && !self.preview,
                "--t_srs and --preview are of the DSM; add --dsm NAME.tif"
            ),
        }
        if let Some(MeshName { file, format }) = &self.mesh {
            outputs.mesh = Some(CityMeshRequest::new(file.clone(), *format));
        }
        if let Some(mesh) = &mut outputs.mesh {
            mesh.color = match self.mesh_color {
                ColorArg::Vertex => CityMeshColour::Vertices,
                ColorArg::Texture => CityMeshColour::Texture,
                ColorArg::None => CityMeshColour::None,
            };
            mesh.error_m = self.error;
            mesh.max_triangles = self.max_triangles;
        } else {
            anyhow::ensure!(
                self.max_triangles.is_none(),
                "--max-triangles belongs to the mesh; add --mesh NAME.glb"
            );
            anyhow::ensure!(
                self.error.is_none() || self.tiles3d.is_some(),
                "--error belongs to mesh and 3D Tiles; add --mesh NAME.glb or --tiles3d DIR"
            );
        }
        outputs.density.clone_from(&self.density);
        outputs.tiles3d = self.tiles3d.as_ref().map(|folder| Tiles3dRequest {
            folder: folder.trim_end_matches('/').to_owned(),
            error_m: self.error.unwrap_or(TILES3D_ERROR_M),
            base_height_m: self.base_height,
        });
        Ok(outputs)
    }
}

fn report(summary: &TileSummary, out: &Path, json: bool) -> anyhow::Result<()> {
    if json {
        return console::print(&(serde_json::to_string_pretty(summary)? + "\n"));
    }
    console::print(&words(summary, out))
}

fn words(summary: &TileSummary, out: &Path) -> String {
    let mut text = String::new();
    let [columns, rows] = summary.size;
    let [across, down] = summary.gsd_m;
    let _ = writeln!(
        text,
        "{}: {columns} x {rows} model pixels of {across:.3} x {down:.3} m, {} of {} slabs done{}",
        out.display(),
        summary.done,
        summary.slabs,
        match summary.kept {
            0 => String::new(),
            kept => format!(" ({kept} by an earlier run)"),
        }
    );
    if summary.unchanged {
        text.push_str("  nothing to do: an earlier run made all of it with the same plan\n");
    }
    if summary.windows_run > 0 {
        let each = summary.window_seconds / summary.windows_run as f64;
        let _ = writeln!(
            text,
            "  {} windows in {:.1} s ({each:.2} s each)",
            summary.windows_run, summary.window_seconds
        );
    }
    if let Some(facts) = &summary.facts {
        if facts.empty_windows > 0 {
            let _ =
                writeln!(text, "  {:>8}  windows skipped: no data in them", facts.empty_windows);
        }
        if facts.no_data > 0 {
            let share = 100.0 * facts.no_data as f64 / facts.columns as f64;
            let _ = writeln!(text, "  {share:>7.2}%  of the pixels skipped: no data");
        }
        let nothing = facts.columns - facts.no_data - facts.heights;
        if nothing > 0 {
            let share = 100.0 * nothing as f64 / facts.columns as f64;
            let _ = writeln!(
                text,
                "  {share:>7.2}%  of the pixels without a height: no surface was met"
            );
        }
        if let (Some(low), Some(mean), Some(high)) = (facts.min_m, facts.mean_m, facts.max_m) {
            let _ = writeln!(
                text,
                "  heights {low:.2} to {high:.2} m, mean {mean:.2} m, above the scene's bottom"
            );
        }
        if let Some(seams) = facts.seams.as_ref().filter(|seams| seams.across_border.count > 0) {
            let _ = writeln!(
                text,
                "  seams: heights jump by {:.3} m across window borders and by {:.3} m elsewhere ({:.2} times)",
                seams.across_border.mean_m.unwrap_or(f64::NAN),
                seams.inside.mean_m.unwrap_or(f64::NAN),
                seams.ratio.unwrap_or(f64::NAN)
            );
        }
        if summary.seconds > 0.0 && !summary.unchanged && summary.kept == 0 {
            let _ = writeln!(
                text,
                "  {:.4} km2 in {:.1} s ({:.0} s per km2)",
                facts.area_km2,
                summary.seconds,
                summary.seconds / facts.area_km2
            );
        }
    }
    for output in &summary.outputs {
        let files =
            if output.files > 1 { format!(", {} files", output.files) } else { String::new() };
        let _ = writeln!(
            text,
            "  {}  {:.1} MB{files}",
            out.join(&output.name).display(),
            output.bytes as f64 / 1e6
        );
    }
    if summary.interrupted {
        text.push_str(
            "  interrupted: finished slabs are kept; run the same command again to continue\n",
        );
    } else if summary.part {
        let _ = writeln!(
            text,
            "next: sat3d tile merge --out {} (when all parts are done; folders of other parts behind it)",
            out.display()
        );
    } else if summary
        .outputs
        .iter()
        .any(|output| output.name.ends_with('/') && !output.name.ends_with(".zarr/"))
    {
        let _ = writeln!(text, "next: sat3d view {}", out.display());
    }
    text
}
