//! From options to a finished city: plan, windows, slabs, outputs.

use super::TileError;
use super::city::{Along, City};
use super::dsm::DsmGrid;
use super::engine::{Engine, Outcome};
use super::explain::{self, Inputs};
use super::finish::{self, CityFacts, CityOutput};
use super::frame::LocalFrame;
use super::ground::{self, ModelGround};
use super::job::Job;
use super::layout::{AxisWindows, WINDOW};
use super::network::NetworkWindows;
use super::options::{TileOptions, TileOutputs};
use super::record::SlabRecord;
use super::slabs::FOLDER;
use super::spool::{Spool, SpoolError};
use super::sums::Sums;
use super::tiles3d::Tiles3dError;
use super::volume::{self, VolumeSink};
use super::writer::{Setting, SlabWriter};
use crate::batch::{
    ExitCode, FolderLock, Header, Interrupt, Journal, Journals, Progress, Status, Verify,
    fingerprint, join,
};
use crate::model::weights::PackedWeights;
use crate::model::{Checkpoint, Config, Model};
use crate::picture::{self, Picture, ResampledPicture};
use crate::plan::network::at_scale;
use crate::plan::{Plan, runs};
use crate::weights::{self, Identity, Origin};
use serde::Serialize;
use serde_json::json;
use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Instant, UNIX_EPOCH};

/// The picture at model resolution, in the folder of slabs.
const SPOOL: &str = "picture.rgbm";

/// A run that is planned.
#[derive(Debug)]
pub struct Prepared {
    options: TileOptions,
    /// What outputs need.
    pub job: Job,
    windows: [AxisWindows; 2],
    picture: PathBuf,
    /// Name, size and time of the picture.
    inputs: String,
    checkpoint: Checkpoint,
    model: Model,
    identity: Identity,
    origin: Origin,
    open_bytes: u64,
    /// The plan.
    pub plan: Plan,
    /// Things that the user should know.
    pub warnings: Vec<String>,
}

/// What a run did.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TileSummary {
    /// Columns and rows of the city, model pixels.
    pub size: [u32; 2],
    /// Ground metres per model pixel, across and down.
    pub gsd_m: [f64; 2],
    /// Slabs of this run.
    pub slabs: usize,
    /// Slabs that are finished.
    pub done: usize,
    /// Of those, finished by an earlier run.
    pub kept: usize,
    /// Windows run now; those on the border of two parts count in both.
    pub windows_run: u64,
    /// Seconds of this run.
    pub seconds: f64,
    /// Seconds of those for windows.
    pub window_seconds: f64,
    /// Whether the run was stopped before its end.
    pub interrupted: bool,
    /// Whether this is a part, to be joined by `tile merge`.
    pub part: bool,
    /// Whether an earlier run had finished everything.
    pub unchanged: bool,
    /// The whole city; absent of a part.
    #[serde(flatten)]
    pub facts: Option<CityFacts>,
    /// What was written; empty of a part.
    pub outputs: Vec<CityOutput>,
}

/// Resolves options to a plan; reads headers, not pixels.
///
/// # Errors
/// [`TileError`]: anything that makes the run impossible.
pub fn prepare(mut options: TileOptions) -> Result<Prepared, TileError> {
    options.windows.check()?;
    check_numbers(&options)?;
    let picture = picture::open(&options.input)?;
    let mut warnings = picture.warnings().to_vec();
    let ground =
        ground::model_size(picture.size(), picture.place(), options.gsd_m, options.window_gsd_m)
            .map_err(|source| TileError::Ground { path: options.input.clone(), source })?;
    runs("ground-size");
    warnings.extend(ground.warnings.iter().cloned());
    if !options.outputs.any() {
        options.outputs = TileOutputs::of_stem(&stem_of(&options.input));
    }
    check_names(&options)?;
    let found = weights::find(options.weights.as_deref())?;
    warnings.extend(found.note());
    let checkpoint = found.open_keeping(options.packed_weights.as_deref())?;
    let identity = Identity::of(&checkpoint);
    let job = job(&options, &ground, checkpoint.config(), &identity)?;
    // The tolerance is of heights: what a precision may cost is stated per cube unit.
    let execution = at_scale(&options.compute, job.city.vertical_m).choose(checkpoint.config())?;
    let model = Model::of_checkpoint(&checkpoint, &execution)?;
    let windows = job.axis_windows()?;
    let city = &job.city;
    check_place(city, &options.outputs)?;
    let [lines, across] = city.lines_across();
    let line_bytes = Sums::line_bytes(across, city.levels.z.len());
    let open_bytes = line_bytes * u64::from(WINDOW.min(lines));
    let plan = explain::resolve(
        &options,
        &Inputs {
            city,
            execution,
            windows: &windows,
            ground: &ground.rule.words(),
            picture: picture.size(),
            picture_bytes: std::fs::metadata(&options.input).map_or(0, |file| file.len()),
            masked: picture.has_mask(),
            identity: &identity,
            outputs: &options.outputs,
            open_bytes,
        },
    );
    Ok(Prepared {
        picture: options.input.clone(),
        inputs: fingerprint(&options.input),
        options,
        windows,
        checkpoint,
        model,
        identity,
        origin: found.origin,
        open_bytes,
        plan,
        warnings,
        job,
    })
}

fn job(
    options: &TileOptions,
    ground: &ModelGround,
    config: &Config,
    identity: &Identity,
) -> Result<Job, TileError> {
    let scale = config.scale;
    runs("scale");
    let levels = options.lattice.levels(scale).map_err(TileError::Input)?;
    let [columns, rows] = ground.size;
    let mut city = City {
        size: ground.size,
        footprint: ground.footprint.clone(),
        assumed: ground.assumed,
        levels,
        vertical_m: 0.0,
        along: if columns > rows { Along::X } else { Along::Y },
    };
    // A window is a cube of its own: the crop fills `[-scale, scale]`.
    let across = city.gsd_m().map(|gsd| gsd * f64::from(WINDOW) / (2.0 * scale));
    city.vertical_m = match options.vertical {
        crate::footprint::VerticalScale::Paper => crate::footprint::TRAINING_WIDTH_M / 2.0,
        crate::footprint::VerticalScale::Isotropic => (across[0] * across[1]).sqrt(),
    };
    Ok(Job {
        metres_per_unit: [across[0], across[1], city.vertical_m],
        city,
        outputs: options.outputs.clone(),
        windows: options.windows,
        isovalue: options.isovalue,
        weights_sampled_sha256: identity.sampled_sha256.clone(),
    })
}

fn check_numbers(options: &TileOptions) -> Result<(), TileError> {
    let wrong = |text: String| Err(TileError::Input(text));
    if !(options.isovalue > 0.0 && options.isovalue.is_finite()) {
        return wrong(format!("--isovalue {}: must be a density above 0", options.isovalue));
    }
    if let Some(gsd) = options.window_gsd_m.filter(|gsd| !(1e-3..=1e4).contains(gsd)) {
        return wrong(format!(
            "--window-gsd {gsd}: must be 0.001 to 10000 (metres per model pixel)"
        ));
    }
    if let Some(gsd) = options.gsd_m.into_iter().flatten().find(|gsd| !(1e-3..=1e4).contains(gsd)) {
        return wrong(format!("--gsd {gsd}: must be 0.001 to 10000 (metres per pixel)"));
    }
    if let Some(srs) = options.outputs.dsm.as_ref().and_then(|dsm| dsm.t_srs.as_deref()) {
        finish::parse_srs(srs)?;
    }
    Ok(())
}

/// Outputs have names of their own, and replace neither the picture nor what describes the run.
fn check_names(options: &TileOptions) -> Result<(), TileError> {
    let names = options.outputs.names();
    let wrong = |text: String| Err(TileError::Input(text));
    for (index, name) in names.iter().enumerate() {
        if name.is_empty() || name.contains(['/', '\\']) || *name == "." || *name == ".." {
            return wrong(format!(
                "`{name}`: outputs are written into the output folder; give a name without folders, and the folder with --out"
            ));
        }
        let ours = [FOLDER, finish::DESCRIPTION, "run.json", crate::batch::STATE_FOLDER];
        if names[..index].contains(name) || ours.contains(name) {
            return wrong(format!("`{name}`: the name of two outputs of this run; choose another"));
        }
        let path = options.out.join(name);
        let same = |a: &Path, b: &Path| matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if same(&path, &options.input) {
            return wrong(format!(
                "{}: the picture would be replaced by an output; use another --out",
                path.display()
            ));
        }
    }
    Ok(())
}

/// What outputs need of the place is looked at before hours of work and not after them.
fn check_place(city: &City, outputs: &TileOutputs) -> Result<(), TileError> {
    if let Some(dsm) = &outputs.dsm {
        let t_srs = dsm.t_srs.as_deref().map(finish::parse_srs).transpose()?;
        DsmGrid::new(city, t_srs.as_ref())?;
    }
    if outputs.needs_surface() {
        LocalFrame::new(city, 0.0)?;
    }
    Ok(())
}

fn stem_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

impl Prepared {
    /// Where packed weights are kept.
    #[must_use]
    pub fn packed(&self) -> Option<&PackedWeights> {
        self.checkpoint.packed()
    }

    fn description(&self) -> serde_json::Value {
        json!({
            "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
            "plan_sha256": self.plan.hash(),
            "plan": self.plan,
            "seeds": {},
            "weights": self.identity,
            "job": self.job.value(),
            "conventions": {
                "heights": "metres above the bottom of the scene cube, an arbitrary zero, in no vertical datum; NaN = no surface or no data",
                "row 0": "north", "column 0": "west",
            },
        })
    }

    /// Runs the plan: windows that are not done yet, then (of a whole city) all outputs.
    ///
    /// # Errors
    /// [`TileError`]; slabs that are finished stay finished.
    pub fn run(&self, stop: &Interrupt) -> Result<TileSummary, TileError> {
        let started = Instant::now();
        let options = &self.options;
        let out = &options.out;
        let threads = options.threads.max(1);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|error| TileError::Input(format!("--threads {threads}: {error}")))?;
        std::fs::create_dir_all(out).map_err(TileError::io("make the folder", out))?;
        let _lock = FolderLock::take(out, options.shard)?;
        let hash = self.plan.hash();
        let hashes = options.verify == Verify::Hashes;
        let mut summary = self.summary();
        if let Some((facts, outputs)) = finish::finished(out, &hash, hashes)
            && !options.overwrite
        {
            return Ok(TileSummary {
                facts: Some(facts),
                outputs,
                unchanged: true,
                done: summary.slabs,
                kept: summary.slabs,
                ..summary
            });
        }
        let header = Header { plan_hash: hash, description: self.description() };
        if options.resume && Journals::<SlabRecord>::read(out)?.header.is_none() {
            return Err(TileError::Input(format!(
                "--resume: {} holds no run that could be continued; leave --resume out to begin one",
                out.display()
            )));
        }
        let (mut journal, earlier) = Journal::open(out, options.shard, &header, options.overwrite)?;
        let slabs = out.join(FOLDER);
        if options.overwrite && options.shard.is_whole() && slabs.exists() {
            std::fs::remove_dir_all(&slabs).map_err(TileError::io("remove", &slabs))?;
        }
        std::fs::create_dir_all(&slabs).map_err(TileError::io("make the folder", &slabs))?;
        let (mut records, todo) = self.sort_out(earlier.records);
        summary.kept = records.len();
        let outcome =
            pool.install(|| self.make(&todo, &mut journal, &mut records, &mut summary, stop))?;
        summary.done = records.len();
        summary.interrupted = outcome == Outcome::Stopped;
        if !summary.interrupted {
            journal.complete(options.shard, u64::from(self.job.city.slabs()))?;
            if options.shard.is_whole() {
                let made = pool.install(|| {
                    finish::finish(out, &header, &self.job, &records, options.quiet, stop)
                });
                match made {
                    // The slabs are there: the next run makes the outputs.
                    Err(TileError::Tiles3d(Tiles3dError::Interrupted)) => {
                        summary.interrupted = true;
                    }
                    made => {
                        let (facts, outputs) = made?;
                        summary.facts = Some(facts);
                        summary.outputs = outputs;
                        summary.seconds = started.elapsed().as_secs_f64();
                        finish::write_json(&out.join("run.json"), &self.run_json(&summary))?;
                    }
                }
            }
        }
        summary.seconds = started.elapsed().as_secs_f64();
        Ok(summary)
    }

    fn summary(&self) -> TileSummary {
        let city = &self.job.city;
        let slabs = self.options.shard.range(city.slabs() as usize).len();
        TileSummary {
            size: city.size,
            gsd_m: city.gsd_m(),
            slabs,
            part: !self.options.shard.is_whole(),
            ..TileSummary::default()
        }
    }

    /// Splits this shard's slabs into those that an earlier run finished and those to do.
    fn sort_out(&self, mut known: HashMap<String, SlabRecord>) -> (Vec<SlabRecord>, Vec<u32>) {
        let (mut kept, mut todo) = (Vec::new(), Vec::new());
        let options = &self.options;
        for slab in options.shard.range(self.job.city.slabs() as usize) {
            let slab = slab as u32;
            match known.remove(&SlabRecord::name_of(slab)) {
                Some(record)
                    if record.status == Status::Done
                        && record.inputs == self.inputs
                        && record.outputs.iter().all(|o| o.holds(&options.out, options.verify)) =>
                {
                    kept.push(record);
                }
                _ => todo.push(slab),
            }
        }
        (kept, todo)
    }

    /// Makes slabs, in runs of neighbours.
    fn make(
        &self,
        todo: &[u32],
        journal: &mut Journal<SlabRecord>,
        records: &mut Vec<SlabRecord>,
        summary: &mut TileSummary,
        stop: &Interrupt,
    ) -> Result<Outcome, TileError> {
        if todo.is_empty() {
            return Ok(Outcome::Complete);
        }
        let options = &self.options;
        let (out, city) = (&options.out, &self.job.city);
        let spool = self.spool(stop)?;
        let Some(spool) = spool else { return Ok(Outcome::Stopped) };
        let network = NetworkWindows { model: &self.model, lattice: options.lattice };
        let folder = out.join(FOLDER);
        let runs: Vec<&[u32]> = todo.chunk_by(|a, b| a + 1 == *b).collect();
        let lines = |run: &[u32]| {
            let (first, last) = (run[0], run[run.len() - 1]);
            // The line before joins the surface to the slab before.
            city.lines(first).start.saturating_sub(1)..city.lines(last).end
        };
        let engine = |progress| Engine {
            city,
            windows: &self.windows,
            source: &spool,
            model: &network,
            spill: (self.open_bytes > options.memory).then_some(&*folder),
            stop,
            progress,
        };
        let nothing = || {};
        let count = runs.iter().map(|run| engine(&nothing).count(&lines(run))).sum();
        let progress = Progress::new("tiling", "windows", count, options.quiet);
        let step = || progress.add(1);
        let engine = engine(&step);
        let setting = Setting {
            city,
            out,
            spool: &spool,
            isovalue: self.job.outputs.needs_surface().then_some(f64::from(self.job.isovalue)),
            inputs: &self.inputs,
        };
        let started = Instant::now();
        let mut outcome = Outcome::Complete;
        for run in runs {
            let mut writer = SlabWriter::new(&setting, run[0], journal);
            if let Some(name) = &self.job.outputs.density {
                let part = volume::folder_name(options.shard);
                let description = self.volume_description()?;
                let sink = VolumeSink::new(city, &out.join(name), &out.join(&part), description);
                writer.volume = Some(sink?);
                writer.listed_volume = (!options.shard.is_whole()).then_some(part);
            }
            let result = engine.run(lines(run), &mut writer);
            summary.windows_run += writer.windows_run;
            records.append(&mut writer.finished);
            outcome = result?;
            if outcome == Outcome::Stopped {
                break;
            }
        }
        progress.finish();
        summary.window_seconds = started.elapsed().as_secs_f64();
        Ok(outcome)
    }

    fn volume_description(&self) -> Result<crate::volume::VolumeDescription, TileError> {
        let weights = Some(self.identity.sampled_sha256.as_str());
        volume::describe(&self.job.city, self.job.metres_per_unit, weights)
            .map_err(TileError::Input)
    }

    /// The picture at model resolution; `None` where a stop was asked for.
    fn spool(&self, stop: &Interrupt) -> Result<Option<Spool>, TileError> {
        let options = &self.options;
        let path = options.out.join(FOLDER).join(SPOOL);
        let fingerprint = format!("{} {:?}", self.inputs, self.job.city.size);
        if let Some(spool) = Spool::open(&path, &fingerprint) {
            return Ok(Some(spool));
        }
        let picture: Picture = picture::open(&self.picture)?;
        let size = self.job.city.size;
        runs("spool");
        if picture.size() != size {
            runs("resample");
        }
        if picture.has_mask() {
            runs("no-data");
        }
        let progress = Progress::new("resampling", "rows", size[1] as usize, options.quiet);
        let resampled = ResampledPicture::new(picture, size);
        let mut done = 0;
        let spool = Spool::create(resampled, &path, &fingerprint, |rows| {
            progress.add(u64::from(rows - done));
            done = rows;
            if stop.requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        progress.finish();
        match spool {
            Ok(spool) => Ok(Some(spool)),
            Err(SpoolError::Stopped) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    fn run_json(&self, summary: &TileSummary) -> serde_json::Value {
        let now = std::time::SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |since| since.as_secs());
        let options = &self.options;
        json!({
            "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
            "finished_unix_s": now,
            "seconds": summary.seconds,
            "window_seconds": summary.window_seconds,
            "windows_run": summary.windows_run,
            "threads": options.threads,
            "network": self.model.execution.to_string(),
            "input": options.input,
            "weights": { "folder": self.checkpoint.folder(), "origin": self.origin },
            "machine": { "os": std::env::consts::OS, "architecture": std::env::consts::ARCH },
        })
    }
}

/// Joins the parts of a city into `out` and makes all outputs: the same bytes as one run's.
///
/// # Errors
/// Missing or unfinished parts, different plans, a file that is not what its journal says.
pub fn merge(
    out: &Path,
    parts: &[PathBuf],
    quiet: bool,
    stop: &Interrupt,
) -> Result<TileSummary, TileError> {
    let started = Instant::now();
    let joined = join::<SlabRecord>(out, parts)?;
    let job = Job::of(&joined.header.description)?;
    let (facts, outputs) = finish::finish(out, &joined.header, &job, &joined.records, quiet, stop)?;
    let slabs = joined.records.len();
    Ok(TileSummary {
        size: job.city.size,
        gsd_m: job.city.gsd_m(),
        slabs,
        done: slabs,
        kept: slabs,
        seconds: started.elapsed().as_secs_f64(),
        facts: Some(facts),
        outputs,
        ..TileSummary::default()
    })
}

impl TileSummary {
    /// What the process ends with.
    #[must_use]
    pub const fn exit_code(&self) -> ExitCode {
        if self.interrupted { ExitCode::Interrupted } else { ExitCode::Success }
    }
}
