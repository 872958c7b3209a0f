//! From finished slabs to outputs, and the files that describe them.

use super::TileError;
use super::dsm::{DsmOptions, write_dsm};
use super::frame::LocalFrame;
use super::job::Job;
use super::record::SlabRecord;
use super::seams::{SeamMeasure, Windows};
use super::slabs::{FOLDER, Slabs};
use super::surface::output::{CityMeshOptions, write_mesh};
use super::surface::simplify::Target;
use super::tiles3d::{Tiles3dOptions, Tiles3dSummary, finest_tiles, write_tiles3d};
use super::volume;
use crate::batch::{Header, Interrupt, OutputFile, Progress, write_atomic};
use crate::crs::CrsSpec;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

/// Name of the file that describes a finished city.
pub const DESCRIPTION: &str = "city.json";

/// A file or folder that was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CityOutput {
    /// Its name in the output folder; a folder ends with a slash.
    pub name: String,
    /// Number of files.
    pub files: u64,
    /// Bytes of all of them.
    pub bytes: u64,
    /// SHA-256 of a single file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
}

impl CityOutput {
    /// Measures what stands there.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn of(out: &Path, name: &str) -> std::io::Result<Self> {
        let path = out.join(name);
        if path.is_dir() {
            let (mut files, mut bytes) = (0, 0);
            measure(&path, &mut files, &mut bytes)?;
            return Ok(Self { name: format!("{name}/"), files, bytes, sha256: None });
        }
        OutputFile::measure(out, name).map(Self::from)
    }

    /// Whether it is still there as it was written; hashes are compared where `hashes` is set.
    #[must_use]
    pub fn holds(&self, out: &Path, hashes: bool) -> bool {
        let name = self.name.trim_end_matches('/');
        if !hashes && self.files == 1 && self.sha256.is_some() {
            let metadata = std::fs::metadata(out.join(name));
            return metadata.is_ok_and(|metadata| metadata.len() == self.bytes);
        }
        Self::of(out, name).is_ok_and(|found| found == *self)
    }
}

impl From<OutputFile> for CityOutput {
    fn from(OutputFile { file, bytes, sha256 }: OutputFile) -> Self {
        Self { name: file, files: 1, bytes, sha256: Some(sha256) }
    }
}

fn measure(folder: &Path, files: &mut u64, bytes: &mut u64) -> std::io::Result<()> {
    for item in std::fs::read_dir(folder)? {
        let item = item?;
        let metadata = item.metadata()?;
        if metadata.is_dir() {
            measure(&item.path(), files, bytes)?;
        } else {
            *files += 1;
            *bytes += metadata.len();
        }
    }
    Ok(())
}

/// What a whole city turned out to be.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CityFacts {
    /// Windows run.
    pub windows: u64,
    /// Windows without data, left out.
    pub empty_windows: u64,
    /// Columns of density, one per model pixel.
    pub columns: u64,
    /// Columns with a height.
    pub heights: u64,
    /// Columns over pixels without data.
    pub no_data: u64,
    /// Mean height, metres above the bottom of the cube.
    pub mean_m: Option<f64>,
    /// Lowest height, metres.
    pub min_m: Option<f64>,
    /// Greatest height, metres.
    pub max_m: Option<f64>,
    /// Triangles of the surface before simplification.
    pub surface_triangles: u64,
    /// Triangles of the mesh as written.
    pub mesh_triangles: Option<u64>,
    /// Largest distance of the mesh to the surface before simplification, metres.
    pub mesh_error_m: Option<f64>,
    /// Levels of the 3D Tiles.
    pub tiles3d: Option<Tiles3dSummary>,
    /// Height jumps across window borders beside those inside windows.
    pub seams: Option<SeamMeasure>,
    /// Square kilometres on the ground.
    pub area_km2: f64,
}

impl CityFacts {
    /// Adds slabs up, in their order.
    #[must_use]
    pub fn of(job: &Job, records: &[SlabRecord]) -> Self {
        let mut records: Vec<&SlabRecord> = records.iter().collect();
        records.sort_by(|a, b| a.name.cmp(&b.name));
        let [across, down] = job.city.footprint.ground_m();
        let mut facts = Self { area_km2: across * down / 1e6, ..Self::default() };
        let mut sum = 0.0;
        for record in records {
            facts.windows += record.windows;
            facts.empty_windows += record.empty_windows;
            facts.columns += record.columns;
            facts.heights += record.heights;
            facts.no_data += record.no_data;
            facts.surface_triangles += record.triangles;
            sum += record.sum_m;
            let least = |a: Option<f64>, b: Option<f64>| match (a, b) {
                (Some(a), Some(b)) => Some(a.min(b)),
                (a, b) => a.or(b),
            };
            facts.min_m = least(facts.min_m, record.min_m);
            facts.max_m = least(facts.max_m.map(|v| -v), record.max_m.map(|v| -v)).map(|v| -v);
        }
        facts.mean_m = (facts.heights > 0).then(|| sum / facts.heights as f64);
        facts
    }
}

/// Makes all outputs, describes them, and removes the slabs.
///
/// # Errors
/// An output cannot be made; the slabs stay, and the next run makes it again.
pub fn finish(
    out: &Path,
    header: &Header,
    job: &Job,
    records: &[SlabRecord],
    quiet: bool,
    stop: &Interrupt,
) -> Result<(CityFacts, Vec<CityOutput>), TileError> {
    let mut facts = CityFacts::of(job, records);
    let city = &job.city;
    let slabs = Slabs { city, out };
    let note = |name: &str| {
        if !quiet {
            tracing::info!("writing {name}");
        }
    };
    let (mut names, mut outputs) = (Vec::new(), Vec::<CityOutput>::new());
    let windows = job.axis_windows()?;
    if let Some(request) = &job.outputs.dsm {
        note(&request.file);
        let t_srs = request.t_srs.as_deref().map(parse_srs).transpose()?;
        let [x, y] = windows
            .each_ref()
            .map(|axis| axis.all().iter().map(|window| window.pixels.clone()).collect());
        let options = DsmOptions {
            name: request.file.clone(),
            t_srs,
            preview: request.preview,
            windows: Some(Windows { x, y }),
            metadata: metadata(job),
        };
        let written = write_dsm(&slabs, &options, &mut |_, _| {})?;
        facts.seams = written.seams;
        for warning in &written.warnings {
            tracing::warn!("{warning}");
        }
        outputs.push(written.dsm.into());
        outputs.extend(written.preview.map(CityOutput::from));
    }
    if let Some(request) = &job.outputs.mesh {
        note(&request.file);
        let frame = LocalFrame::new(city, 0.0)?;
        let [x, y, z] = job.metres_per_unit;
        let options = CityMeshOptions {
            colour: request.color,
            target: Target {
                error_m: request.error_m,
                triangles: request.max_triangles.map(|most| most as usize),
            },
            isovalue: f64::from(job.isovalue),
            vertical_exaggeration: z / (x * y).sqrt(),
            ..CityMeshOptions::default()
        };
        let written = write_mesh(&slabs, &frame, &options, &out.join(&request.file), &|_| {})?;
        facts.mesh_triangles = Some(written.triangles);
        facts.mesh_error_m = Some(written.error_m);
        names.extend(written.files.into_iter().map(|file| file.name));
    }
    if let Some(request) = &job.outputs.tiles3d {
        note(&request.folder);
        let frame = LocalFrame::new(city, request.base_height_m)?;
        let options = Tiles3dOptions { error_m: request.error_m };
        let folder = out.join(&request.folder);
        let progress = Progress::new("3D Tiles", "tiles", finest_tiles(&slabs)?, quiet);
        let written = write_tiles3d(&slabs, &frame, &options, &folder, &progress, stop);
        progress.finish();
        facts.tiles3d = Some(written?);
        names.push(request.folder.clone());
    }
    if let Some(name) = &job.outputs.density {
        note(name);
        let weights = Some(job.weights_sampled_sha256.as_str());
        let description =
            volume::describe(city, job.metres_per_unit, weights).map_err(TileError::Input)?;
        volume::finish(city, out, &out.join(name), description)?;
        names.push(name.clone());
    }
    for name in &names {
        outputs.push(CityOutput::of(out, name).map_err(TileError::io("read", out.join(name)))?);
    }
    let mut description = header.description.clone();
    description["facts"] = json!(facts);
    description["outputs"] = json!(outputs);
    write_json(&out.join(DESCRIPTION), &description)?;
    let folder = out.join(FOLDER);
    if let Err(error) = std::fs::remove_dir_all(&folder) {
        tracing::warn!("cannot remove {}: {error}", folder.display());
    }
    Ok((facts, outputs))
}

/// What an earlier run has finished in a folder, if it had this plan and all is still there.
#[must_use]
pub fn finished(out: &Path, plan_hash: &str, hashes: bool) -> Option<(CityFacts, Vec<CityOutput>)> {
    let text = std::fs::read(out.join(DESCRIPTION)).ok()?;
    let value: Value = serde_json::from_slice(&text).ok()?;
    if value["plan_sha256"] != plan_hash {
        return None;
    }
    let outputs: Vec<CityOutput> = serde_json::from_value(value["outputs"].clone()).ok()?;
    let facts: CityFacts = serde_json::from_value(value["facts"].clone()).ok()?;
    outputs.iter().all(|output| output.holds(out, hashes)).then_some((facts, outputs))
}

pub(super) fn write_json(path: &Path, value: &Value) -> Result<(), TileError> {
    let mut bytes = serde_json::to_vec_pretty(value)
        .map_err(|error| TileError::io("write", path)(error.into()))?;
    bytes.push(b'\n');
    write_atomic(path, &bytes).map_err(TileError::io("write", path))
}

fn metadata(job: &Job) -> Vec<(String, String)> {
    let windows = &job.windows;
    vec![
        (
            "WINDOWS".into(),
            format!("stride {}, trim {}, {}", windows.stride, windows.trim, windows.blend.name()),
        ),
        ("WEIGHTS_SAMPLED_SHA256".into(), job.weights_sampled_sha256.clone()),
    ]
}

/// A CRS by its code.
pub(super) fn parse_srs(text: &str) -> Result<CrsSpec, TileError> {
    let code = text.trim();
    let number = code.rsplit_once(':').map_or(code, |(_, number)| number);
    let known = code.len() == number.len() || code.to_ascii_uppercase().starts_with("EPSG:");
    match number.parse() {
        Ok(number) if known => Ok(CrsSpec::from_epsg(number)),
        _ => Err(TileError::Input(format!(
            "--t_srs {text}: give an EPSG code, for example EPSG:32610"
        ))),
    }
}
