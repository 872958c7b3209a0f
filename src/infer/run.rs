//! Preparing and running an inference batch.

use super::InferError;
use super::explain::{self, Inputs};
use super::item::{Workshop, other_ground};
use super::list::{self, Entry, Kind};
use super::manifest::{self, RunFacts};
use super::options::InferOptions;
use super::record::{GroundFrom, Record};
use crate::batch::{
    Batch, ExitCode, FolderLock, Header, Interrupt, Journal, Journals, Progress, Status,
    count_reasons, count_status, fingerprint, join, remove_leftovers,
};
use crate::footprint::TRAINING_WIDTH_M;
use crate::illumination::Illumination;
use crate::model::render::SampleCounts;
use crate::model::weights::PackedWeights;
use crate::model::{Checkpoint, Config, Model};
use crate::picture;
use crate::plan::Plan;
use crate::plan::network::at_scale;
use crate::weights::{self, Identity, Origin, Weights};
use serde::Serialize;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock};

/// Threads that work on images: one decodes the next and one encodes the last while one is computed.
const WORKERS: usize = 3;
/// Images whose headers are looked at before a run, at most, to warn of another size on the ground.
const LOOKED_AT: usize = 256;
/// Images named in a warning.
const EXAMPLES: usize = 3;

/// A run whose inputs are listed, whose weights are opened and whose plan is resolved; nothing is
/// written yet.
pub struct Prepared {
    options: InferOptions,
    entries: Vec<Entry>,
    checkpoint: Option<Checkpoint>,
    /// What led to the checkpoint.
    origin: Option<Origin>,
    identity: Option<Identity>,
    model: Option<Model>,
    /// The light of street views, where there are any.
    light: Option<Illumination>,
    /// The plan.
    pub plan: Plan,
    /// What the user should know before the run.
    pub warnings: Vec<String>,
}

/// Images that have something in common, with the first of them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counted {
    /// How many.
    pub images: usize,
    /// Names of the first three.
    pub examples: Vec<String>,
}

impl Counted {
    fn of<'a>(names: impl Iterator<Item = &'a str>) -> Self {
        let mut counted = Self::default();
        for name in names {
            counted.images += 1;
            if counted.examples.len() < EXAMPLES {
                counted.examples.push(name.to_owned());
            }
        }
        counted
    }
}

/// What a run did, for people and machines.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RunSummary {
    /// Images of this run (its shard).
    pub images: usize,
    /// Images with outputs, earlier runs included.
    pub done: usize,
    /// Of those, done by an earlier run and kept.
    pub kept: usize,
    /// Images left out for a stated reason.
    pub skipped: usize,
    /// Images with an error.
    pub failed: usize,
    /// Images not started because the run was interrupted or the disk was full.
    pub not_started: usize,
    /// Reasons with their number of images, most frequent first.
    pub reasons: Vec<(String, usize)>,
    /// Images of another size on the ground than the training's.
    pub other_ground: Counted,
    /// Images whose size on the ground nothing states.
    pub assumed_ground: Counted,
    /// Images with something to look at in `flags` of the manifest.
    pub flagged: usize,
    /// Whether the run was interrupted.
    pub interrupted: bool,
    /// Whether the disk filled up.
    pub disk_full: bool,
    /// Seconds of work, without opening.
    pub seconds: f64,
}

impl RunSummary {
    /// The process's exit code.
    #[must_use]
    pub fn exit_code(&self) -> ExitCode {
        if self.interrupted {
            ExitCode::Interrupted
        } else if self.failed > 0 || self.not_started > 0 {
            ExitCode::SomeFailed
        } else {
            ExitCode::Success
        }
    }
}

/// Lists the images, opens the weights and resolves the plan.
///
/// # Errors
/// [`InferError`]: anything that makes the whole run impossible.
pub fn prepare(mut options: InferOptions) -> Result<Prepared, InferError> {
    if !options.outputs.any() {
        return Err(InferError::Input(
            "--no-dsm leaves nothing to make; ask for another output".into(),
        ));
    }
    if !(1..=4096).contains(&options.size) {
        return Err(InferError::Input(format!(
            "--dsm-size {}: must be 1 to 4096 (pixels)",
            options.size
        )));
    }
    if let Some(gsd) = options.gsd_m.into_iter().flatten().find(|gsd| !(1e-3..=1e4).contains(gsd)) {
        return Err(InferError::Input(format!(
            "--gsd {gsd}: must be 0.001 to 10000 (metres per pixel)"
        )));
    }
    let entries = list::list(&options.input, options.root.as_deref())?;
    let pictures = entries.iter().filter(|entry| entry.kind == Kind::Picture).count();
    check_names(&options, &entries, pictures)?;
    check_collisions(&options, &entries)?;
    let pictures = pictures > 0;
    let mut warnings = Vec::new();
    let weights = find_weights(&options, pictures, &mut warnings)?;
    let checkpoint =
        weights.as_ref().map(|weights| weights.open_keeping(options.packed_weights.as_deref()));
    let checkpoint = checkpoint.transpose()?;
    let identity = checkpoint.as_ref().map(Identity::of);
    let model = checkpoint
        .as_ref()
        .map(|checkpoint| {
            let metres_per_unit = explain::usual_metres_per_unit(options.vertical);
            let execution =
                at_scale(&options.compute, metres_per_unit).choose(checkpoint.config())?;
            Model::of_checkpoint(checkpoint, &execution)
        })
        .transpose()?;
    let side = model.as_ref().map_or(256, |model| model.config.image_side());
    options.render.samples = match (options.samples, &model) {
        (Some(samples), _) => samples,
        (None, Some(Model { config, .. })) => {
            SampleCounts::new(config.coarse_samples, config.fine_samples)
                .map_err(|error| InferError::Input(format!("{error}; say --samples")))?
        }
        (None, None) => SampleCounts::default(),
    };
    options.outputs.views.options = options.render;
    options.outputs.views.super_resolution =
        model.as_ref().is_some_and(|model| model.config.super_resolution == 2);
    options.outputs.views.check().map_err(|error| InferError::Input(error.to_string()))?;
    let light = match (&options.illumination, options.outputs.needs_sky()) {
        (_, false) => None,
        (Some(light), true) => Some(light.clone()),
        (None, true) => Some(Illumination::parse(None, None)?),
    };
    let execution = model.as_ref().filter(|_| pictures).map(|model| model.execution);
    let inputs =
        Inputs { pictures, identity: identity.as_ref(), side, light: light.as_ref(), execution };
    let plan = explain::resolve(&options, &inputs);
    warnings.extend(options.outputs.views.notes());
    warnings.extend(ground_warnings(&options, &entries));
    let origin = weights.map(|found| found.origin);
    Ok(Prepared { options, entries, checkpoint, origin, identity, model, light, plan, warnings })
}

/// The weights that a run needs: always for pictures; for scenes where street views want a sky or the
/// super-resolution and weights can be found.
fn find_weights(
    options: &InferOptions,
    pictures: bool,
    warnings: &mut Vec<String>,
) -> Result<Option<Weights>, InferError> {
    let argument = options.weights.as_deref();
    if pictures {
        let found = weights::find(argument)?;
        warnings.extend(found.note());
        return Ok(Some(found));
    }
    if !options.outputs.needs_sky() {
        return Ok(None);
    }
    // The built-in model has nothing to give to the scenes of others.
    match weights::find_given(argument) {
        Ok(found) => Ok(Some(found)),
        Err(weights::WeightsError::None { .. }) => {
            warnings.push(
                "no weights were found: scenes without a sky have no street views, and pictures are not sharpened, panoramas 256 x 64 (--weights)".into(),
            );
            Ok(None)
        }
        Err(error) => Err(error.into()),
    }
}

/// A mesh that has a name of its own is of one image; a texture is the image's.
fn check_names(
    options: &InferOptions,
    entries: &[Entry],
    pictures: usize,
) -> Result<(), InferError> {
    let Some(mesh) = &options.outputs.mesh else { return Ok(()) };
    if let Some(file) = &mesh.file
        && entries.len() > 1
    {
        return Err(InferError::Input(format!(
            "--mesh {file}: the name of one mesh, and there are {} images; --mesh {} names each by its image",
            entries.len(),
            mesh.format.extension()
        )));
    }
    if options.outputs.needs_image() && pictures < entries.len() {
        return Err(InferError::Input(
            "--mesh-color texture: a scene file holds no image; use --mesh-color field, or give the image".into(),
        ));
    }
    Ok(())
}

/// No output may replace an input or another image's output, nor be taken for an input by the next run.
fn check_collisions(options: &InferOptions, entries: &[Entry]) -> Result<(), InferError> {
    let mut makers: HashMap<String, &str> = HashMap::new();
    for entry in entries {
        for file in options.outputs.files_of(&entry.stem) {
            if let Some(other) = makers.insert(file.clone(), &entry.stem) {
                return Err(InferError::Input(format!(
                    "{other} and {}: both would write {file}; rename one of them",
                    entry.stem
                )));
            }
        }
    }
    let Ok(out) = options.out.canonicalize() else { return Ok(()) };
    for entry in entries {
        let name = entry.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let folder = entry.path.parent().and_then(|folder| folder.canonicalize().ok());
        if makers.contains_key(&name) && folder.is_some_and(|folder| folder == out) {
            return Err(InferError::Input(format!(
                "{}: this input would be replaced by an output; use another --out",
                entry.path.display()
            )));
        }
    }
    let same = options.input.canonicalize().is_ok_and(|input| input == out);
    if let Some(picture) = makers.keys().filter(|file| list::is_picture(file)).min()
        && same
    {
        return Err(InferError::Input(format!(
            "--out {}: the next run would take {picture} for an input; use another --out",
            options.out.display()
        )));
    }
    Ok(())
}

/// Looks at some headers, spread evenly, so that a wrong size on the ground is said before hours of
/// work and not after them.
fn ground_warnings(options: &InferOptions, entries: &[Entry]) -> Vec<String> {
    let pictures: Vec<&Entry> = entries.iter().filter(|e| e.kind == Kind::Picture).collect();
    let looked = pictures.len().min(LOOKED_AT);
    let mut found = Vec::new();
    for k in 0..looked {
        let entry = pictures[k * pictures.len() / looked];
        if let Ok(picture) = picture::open(&entry.path)
            && let Ok(footprint) = picture.footprint(options.gsd_m)
            && let Some(text) = other_ground(&footprint)
        {
            found.push((entry.stem.as_str(), text));
        }
    }
    let Some((name, text)) = found.first() else { return Vec::new() };
    vec![format!(
        "{} of {looked} images looked at have another size on the ground than those of the training, for example {name}: {text}. Shapes and heights will be off: cut images to windows of {TRAINING_WIDTH_M} m (sat3d tile), or correct a size that is stated wrongly with --gsd",
        found.len()
    )]
}

impl Prepared {
    /// Where packed weights are kept.
    #[must_use]
    pub fn packed(&self) -> Option<&PackedWeights> {
        self.checkpoint.as_ref()?.packed()
    }

    /// The images, in the order of work.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Of those, the ones of this shard.
    #[must_use]
    pub fn entries_of_shard(&self) -> &[Entry] {
        &self.entries[self.options.shard.range(self.entries.len())]
    }

    /// The network's description, where the network runs.
    #[must_use]
    pub fn config(&self) -> Option<&Config> {
        self.model.as_ref().map(|model| &model.config)
    }

    /// Runs the plan on this shard's images that are not done yet, and (for a whole batch) writes the
    /// manifest.
    ///
    /// # Errors
    /// The output folder cannot be used. Errors of images are in the summary and the manifest.
    pub fn run(&self, stop: &Interrupt) -> Result<RunSummary, InferError> {
        let options = &self.options;
        let out = &options.out;
        let threads = options.threads.max(1);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|error| InferError::Input(format!("--threads {threads}: {error}")))?;
        std::fs::create_dir_all(out).map_err(InferError::io("make the folder", out))?;
        let _lock = FolderLock::take(out, options.shard)?;
        let header = Header {
            plan_hash: self.plan.hash(),
            description: manifest::description(&self.plan, self.identity.as_ref(), self.config()),
        };
        // What is made anew leaves nothing of what was there (frames of a longer film).
        let stale = match options.overwrite {
            true => Journals::<Record>::read(out).map(|all| all.records).unwrap_or_default(),
            false => HashMap::new(),
        };
        let (mut journal, earlier) = Journal::open(out, options.shard, &header, options.overwrite)?;
        if options.shard.is_whole() {
            let mut ours: HashSet<String> =
                self.entries.iter().flat_map(|e| options.outputs.files_of(&e.stem)).collect();
            let folders: Vec<String> =
                ours.iter().filter_map(|file| Some(file.rsplit_once('/')?.0.to_owned())).collect();
            ours.extend(folders);
            remove_leftovers(out, |name| ours.contains(name));
            remove_stale(out, &stale, &ours);
        }
        let mine = self.entries_of_shard();
        let (mut records, todo) = self.sort_out(mine, earlier.records);
        let kept = count_status(&records, Status::Done);
        let disk_full = Interrupt::default();
        let workshop = Workshop {
            options,
            model: self.model.as_ref(),
            identity: self.identity.as_ref(),
            pool: &pool,
            stop,
            turn: &Mutex::new(()),
            disk_full: &disk_full,
            light: self.light.as_ref(),
            sky: &OnceLock::new(),
        };
        let progress = Progress::new("inferring", "images", todo.len(), options.quiet);
        let workers = threads.min(WORKERS);
        let batch =
            Batch { out, threads: workers, progress: &progress, stop, disk_full: &disk_full };
        let build = |entry: &&Entry| workshop.build(entry);
        let result = batch.run(&todo, build, &mut journal, |record| records.push(record));
        let seconds = progress.finish();
        result?;
        let mut summary = summarise(&mut records, mine.len());
        summary.kept = kept;
        summary.interrupted = stop.requested() && summary.not_started > 0;
        summary.disk_full = disk_full.requested();
        summary.seconds = seconds;
        if summary.not_started == 0 {
            journal.complete(options.shard, self.entries.len() as u64)?;
            if options.shard.is_whole() {
                let checkpoint = self.checkpoint.as_ref();
                let origin = self.origin.as_ref();
                let execution = self.model.as_ref().map(|model| model.execution);
                let facts = RunFacts { summary: &summary, options, checkpoint, origin, execution };
                manifest::write(out, &header, records, Some(&facts))?;
            }
        }
        Ok(summary)
    }

    /// Splits this shard's images into those that an earlier run finished and those to do.
    fn sort_out<'a>(
        &self,
        mine: &'a [Entry],
        mut known: HashMap<String, Record>,
    ) -> (Vec<Record>, Vec<&'a Entry>) {
        let (mut kept, mut todo) = (Vec::new(), Vec::new());
        let options = &self.options;
        for entry in mine {
            match known.remove(&entry.stem) {
                Some(record)
                    if record.status != Status::Failed
                        && record.inputs == fingerprint(&entry.path)
                        && record.outputs.iter().all(|o| o.holds(&options.out, options.verify)) =>
                {
                    kept.push(record);
                }
                _ => todo.push(entry),
            }
        }
        (kept, todo)
    }
}

fn summarise(records: &mut [Record], images: usize) -> RunSummary {
    records.sort_by(|a, b| a.name.cmp(&b.name));
    let named = |wanted: &dyn Fn(&Record) -> bool| {
        let done = records.iter().filter(|r| r.status == Status::Done);
        Counted::of(done.filter(|r| wanted(r)).map(|r| r.name.as_str()))
    };
    RunSummary {
        images,
        done: count_status(records, Status::Done),
        skipped: count_status(records, Status::Skipped),
        failed: count_status(records, Status::Failed),
        not_started: images - records.len(),
        reasons: count_reasons(records, generic),
        other_ground: named(&|r| r.other_ground),
        assumed_ground: named(&|r| r.ground_from == Some(GroundFrom::Assumed)),
        flagged: records.iter().filter(|r| !r.flags.is_empty()).count(),
        ..RunSummary::default()
    }
}

/// Removes files that earlier runs have recorded and this one does not write.
fn remove_stale(out: &Path, records: &HashMap<String, Record>, ours: &HashSet<String>) {
    let files = records.values().flat_map(|record| &record.outputs).map(|output| &output.file);
    // A volume is one target, whatever its files are called.
    let kept = |file: &str| {
        ours.contains(file) || file.split('/').next().is_some_and(|top| ours.contains(top))
    };
    for file in files.filter(|file| file.contains('/') && !ours.contains(*file)) {
        let volume = file.split_once('/').is_some_and(|(top, _)| top.ends_with(".zarr"));
        if volume && kept(file) {
            continue;
        }
        if let Err(error) = std::fs::remove_file(out.join(file))
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!("cannot remove {file} of an earlier run: {error}");
        }
    }
}

/// A reason without the path that it begins with, so that equal causes are counted together.
fn generic(reason: &str) -> String {
    let rest = reason.split_once(": ").filter(|(path, _)| path.contains(['/', '\\', '.']));
    rest.map_or(reason, |(_, rest)| rest).to_owned()
}

/// Joins shards into `out`: those that worked in `out` itself, and those of the folders `parts`, whose
/// files are copied after their hash is checked. Writes the manifest that one run over all images would
/// have written, byte for byte.
///
/// # Errors
/// Missing or unfinished shards, different plans, a file that is not what its journal says.
pub fn merge(out: &Path, parts: &[PathBuf]) -> Result<RunSummary, InferError> {
    let mut joined = join::<Record>(out, parts)?;
    let mut records = std::mem::take(&mut joined.records);
    let images = records.len();
    let mut summary = summarise(&mut records, images);
    summary.kept = summary.done;
    manifest::write(out, &joined.header, records, None)?;
    Ok(summary)
}
