//! The loop: examples to the learner, its state to checkpoints, what happens to the log.

use super::checkpoint::{self, Description, STATE, Stored};
use super::data::{self, Loader, Source};
use super::error::TrainingError;
use super::held_out::{HeldOut, PICTURES};
use super::journal::{Journal, Line, Scores};
use super::live::Live;
use super::progress::Progress;
use super::report;
use super::settings::{Settings, difference};
use crate::batch::{ExitCode, FolderLock, Interrupt, Shard, remove_leftovers, write_atomic};
use crate::model::Device;
use crate::model::train::{Learner, Outcome, TrainError};
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

/// Makes a learner of settings, a device and a seed: [`super::learner`], or a test's own.
pub type MakeLearner =
    dyn Fn(&Settings, &Device, u64) -> Result<Box<dyn Learner>, TrainError> + Send + Sync;

/// A training that is ready to run: settings checked, data opened.
pub struct Prepared {
    /// The settings.
    pub settings: Settings,
    /// The data.
    pub source: Arc<dyn Source>,
    /// Where it runs.
    pub device: Device,
    /// Everything that the weights depend on.
    pub identity: Value,
}

/// Where a training goes, and how it speaks.
#[derive(Clone, Debug)]
pub struct Options {
    /// The output folder.
    pub out: PathBuf,
    /// Whether only errors are said.
    pub quiet: bool,
}

/// How a session of a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// All steps are done.
    Finished,
    /// All steps were done before.
    Unchanged,
    /// The time limit of the settings; another run goes on.
    Time,
    /// Ctrl-C; another run goes on.
    Interrupted,
}

/// What a session did.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// How it ended.
    pub ending: Ending,
    /// Steps that are done.
    pub step: u64,
    /// Steps of the whole training.
    pub steps: u64,
    /// The checkpoint that it went on from.
    pub resumed_from: Option<u64>,
    /// Seconds of this session.
    pub seconds: f64,
    /// Examples a second in this session.
    pub images_per_second: f64,
    /// The last means of the terms, weights included.
    pub terms: Map<String, Value>,
    /// The last errors on held-out examples.
    pub held_out: Option<Scores>,
    /// What was counted since the first step.
    pub progress: Progress,
    /// The newest checkpoint.
    pub checkpoint: PathBuf,
    /// The page with curves and pictures.
    pub page: PathBuf,
}

impl Summary {
    /// What the process ends with.
    #[must_use]
    pub const fn exit_code(&self) -> ExitCode {
        match self.ending {
            Ending::Interrupted => ExitCode::Interrupted,
            _ => ExitCode::Success,
        }
    }
}

/// Opens the data of checked settings.
///
/// # Errors
/// [`TrainingError`] where there is nothing to learn from, or a named file cannot be read.
pub fn prepare(settings: Settings) -> Result<Prepared, TrainingError> {
    let device = settings.device()?;
    let source = data::open(&settings)?;
    let identity = settings.identity(source.identity())?;
    Ok(Prepared { settings, source, device, identity })
}

/// Trains, from the newest checkpoint in the output folder if there is one.
///
/// # Errors
/// [`TrainingError`]; the newest whole checkpoint stays, and another run goes on from it.
pub fn run(
    prepared: &Prepared,
    options: &Options,
    interrupt: &Interrupt,
    make: &MakeLearner,
) -> Result<Summary, TrainingError> {
    let out = &options.out;
    std::fs::create_dir_all(out).map_err(TrainingError::io(out))?;
    let _lock = FolderLock::take(out, Shard::WHOLE)?;
    remove_leftovers(out, |target| {
        checkpoint::step_of(target).is_some()
            || [report::PAGE, RUN, PICTURES].contains(&target)
            || target.starts_with(&format!("{PICTURES}/"))
    });
    let stored = checkpoint::newest(out)?;
    if let Some(stored) = &stored
        && let Some((key, stored, now)) =
            difference(&stored.description.settings, &prepared.identity)
    {
        return Err(TrainingError::Differs { folder: out.clone(), key, stored, now });
    }
    let steps = prepared.settings.run.steps;
    if let Some(Stored { folder, description }) = &stored
        && description.step >= steps
    {
        let live = Live::new(steps, steps, true);
        write_page(out, description)?;
        return Ok(summary(
            out,
            description,
            &live,
            Ending::Unchanged,
            Some(steps),
            folder.clone(),
        ));
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(prepared.settings.run.threads)
        .build()
        .map_err(|error| {
        prepared.settings.wrong("run.threads", prepared.settings.run.threads, error.to_string())
    })?;
    pool.install(|| Session::open(prepared, options, stored, make)?.run(interrupt))
}

/// Name of the file with times and the machine.
const RUN: &str = "run.json";

/// One run of the program: from where an earlier one ended to where this one does.
struct Session<'a> {
    prepared: &'a Prepared,
    out: &'a Path,
    learner: Box<dyn Learner>,
    held_out: HeldOut,
    journal: Journal,
    live: Live,
    loader: Loader,
    progress: Progress,
    step: u64,
    resumed_from: Option<u64>,
    /// What earlier sessions left in `run.json`.
    earlier: Vec<Value>,
}

impl<'a> Session<'a> {
    fn open(
        prepared: &'a Prepared,
        options: &'a Options,
        stored: Option<Stored>,
        make: &MakeLearner,
    ) -> Result<Self, TrainingError> {
        let settings = &prepared.settings;
        let out = options.out.as_path();
        let mut learner = make(settings, &prepared.device, settings.run.seed)?;
        let (mut step, mut log_bytes, mut progress) = (0, 0, Progress::default());
        let resumed_from = stored.as_ref().map(|stored| stored.description.step);
        if let Some(Stored { folder, description }) = stored {
            learner.restore(&checkpoint::read_tensors(&folder.join(STATE))?)?;
            (step, log_bytes, progress) =
                (description.step, description.log_bytes, description.progress);
        }
        let live = Live::new(step, settings.run.steps, options.quiet);
        if let Some(step) = resumed_from {
            tracing::info!("going on from step {step}");
        }
        let looked_at = if settings.run.preview_every > 0 { settings.data.held_out } else { 0 };
        let examples = prepared.source.held_out(looked_at);
        let held_out = HeldOut::new(examples, out, step, prepared.device)?;
        let journal = Journal::open(out, log_bytes)?;
        let loader = Loader::start(
            Arc::clone(&prepared.source),
            step,
            settings.run.steps,
            settings.run.batch,
            settings.data.threads(),
            settings.data.ahead,
        )?;
        let earlier = earlier_sessions(out);
        Ok(Self {
            prepared,
            out,
            learner,
            held_out,
            journal,
            live,
            loader,
            progress,
            step,
            resumed_from,
            earlier,
        })
    }

    fn run(mut self, interrupt: &Interrupt) -> Result<Summary, TrainingError> {
        let run = &self.prepared.settings.run;
        let limit = run.minutes.map(|minutes| minutes * 60.0);
        // However short the limit, each session gets on by a step.
        let first = self.step;
        let result = loop {
            let ending = if interrupt.requested() {
                Some(Ending::Interrupted)
            } else if self.step > first && limit.is_some_and(|limit| self.live.seconds() >= limit) {
                Some(Ending::Time)
            } else {
                None
            };
            if let Some(ending) = ending {
                break self.finish(ending);
            }
            match self.one_step() {
                Ok(()) if self.step == run.steps => break self.finish(Ending::Finished),
                Ok(()) => {}
                Err(error) => break Err(error),
            }
        };
        self.live.finish();
        result
    }

    /// One step with everything that is due after it but the last checkpoint.
    fn one_step(&mut self) -> Result<(), TrainingError> {
        let run = &self.prepared.settings.run;
        let batch = self.loader.take()?;
        for new in self.progress.items(&batch) {
            self.live.line(&format!("skipped: {new} (more of the kind are counted, not named)"));
        }
        let step = self.step;
        let failed = |source| TrainingError::Learner { step, source };
        match self.learner.step(step, &batch.examples).map_err(failed)? {
            Outcome::Stepped(terms) => {
                self.progress.stepped(&batch, &terms);
                let loss = terms.first().map(|term| term.value);
                self.live.step(step + 1, batch.examples.len(), loss);
            }
            Outcome::Skipped(why) => {
                self.progress.skipped();
                let count = self.progress.skipped_in_a_row;
                self.live.line(&format!("step {step}: batch skipped: {why}"));
                self.journal.add(&Line { skipped: Some(why.clone()), ..Line::at(step + 1) })?;
                if count >= run.skipped_in_a_row {
                    return Err(TrainingError::NotFinite { count, step, why });
                }
            }
        }
        self.step += 1;
        let due =
            |every: u64| every > 0 && (self.step.is_multiple_of(every) || self.step == run.steps);
        let (log, look) = (due(run.log_every), due(run.preview_every));
        let store = self.step.is_multiple_of(run.checkpoint_every) && self.step < run.steps;
        if log {
            self.log()?;
        }
        if look && !self.held_out.is_empty() {
            self.look()?;
        }
        if store {
            self.store()?;
        }
        Ok(())
    }

    fn log(&mut self) -> Result<(), TrainingError> {
        let terms: Map<String, Value> =
            self.progress.means().into_iter().map(|(name, mean)| (name, mean.into())).collect();
        let images = Some(self.progress.images);
        self.journal.add(&Line { images, terms, ..Line::at(self.step) })
    }

    fn look(&mut self) -> Result<(), TrainingError> {
        let scores = self.held_out.look(self.step, &self.learner.export()?)?;
        if let Some(scores) = scores {
            tracing::info!(
                "step {}: held out: RMSE {:.3} m (flat ground {:.3} m), MAE {:.3} m",
                self.step,
                scores.rmse_m,
                scores.flat_rmse_m,
                scores.mae_m
            );
            self.journal.add(&Line { held_out: Some(scores), ..Line::at(self.step) })?;
        }
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, TrainingError> {
        Ok(Description {
            format: 0,
            software: format!("sat3d {}", env!("CARGO_PKG_VERSION")),
            step: self.step,
            seed: self.prepared.settings.run.seed,
            settings_hash: checkpoint::settings_hash(&self.prepared.identity),
            settings: self.prepared.identity.clone(),
            log_bytes: self.journal.sync()?,
            progress: self.progress.clone(),
            files: Vec::new(),
        })
    }

    /// Writes a checkpoint, removes old ones, and makes the page anew.
    fn store(&mut self) -> Result<(Description, PathBuf), TrainingError> {
        let description = self.describe()?;
        let exported = self.learner.export()?;
        let state = self.learner.state()?;
        let folder = checkpoint::write(self.out, description.clone(), &exported, &state)?;
        checkpoint::prune(self.out, self.prepared.settings.run.keep);
        write_page(self.out, &description)?;
        self.write_run()?;
        Ok((description, folder))
    }

    fn finish(&mut self, ending: Ending) -> Result<Summary, TrainingError> {
        let (description, folder) = match self.resumed_from {
            // Nothing was done since: the checkpoint is there.
            Some(from) if from == self.step => {
                (self.describe()?, self.out.join(checkpoint::name(from)))
            }
            _ => self.store()?,
        };
        Ok(summary(self.out, &description, &self.live, ending, self.resumed_from, folder))
    }

    /// Times, and the machine: what no other file holds.
    fn write_run(&self) -> Result<(), TrainingError> {
        let now = std::time::SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |since| since.as_secs());
        let settings = &self.prepared.settings;
        let mut sessions = self.earlier.clone();
        sessions.push(json!({
            "from_step": self.resumed_from.unwrap_or(0),
            "to_step": self.step,
            "seconds": self.live.seconds(),
            "images_per_second": self.live.images_per_second(),
            "finished_unix_s": now,
            "device": self.prepared.device.to_string(),
            "threads": rayon::current_num_threads(),
            "data_threads": settings.data.threads(),
            "machine": { "os": std::env::consts::OS, "architecture": std::env::consts::ARCH },
        }));
        let run = json!({
            "software": format!("sat3d {}", env!("CARGO_PKG_VERSION")),
            "settings_file": settings.path,
            "sessions": sessions,
        });
        let path = self.out.join(RUN);
        let text = serde_json::to_string_pretty(&run).unwrap_or_default() + "\n";
        write_atomic(&path, text.as_bytes()).map_err(TrainingError::io(&path))
    }
}

fn earlier_sessions(out: &Path) -> Vec<Value> {
    let text = std::fs::read(out.join(RUN)).unwrap_or_default();
    let run: Value = serde_json::from_slice(&text).unwrap_or_default();
    run["sessions"].as_array().cloned().unwrap_or_default()
}

fn write_page(out: &Path, description: &Description) -> Result<(), TrainingError> {
    let path = out.join(report::PAGE);
    write_atomic(&path, report::page(out, description).as_bytes()).map_err(TrainingError::io(&path))
}

fn summary(
    out: &Path,
    description: &Description,
    live: &Live,
    ending: Ending,
    resumed_from: Option<u64>,
    checkpoint: PathBuf,
) -> Summary {
    let lines = super::journal::read(out);
    let newest = || lines.iter().rev();
    Summary {
        ending,
        step: description.step,
        steps: description.settings.pointer("/run/steps").and_then(Value::as_u64).unwrap_or(0),
        resumed_from,
        seconds: live.seconds(),
        images_per_second: live.images_per_second(),
        terms: newest()
            .find(|line| !line.terms.is_empty())
            .map_or_else(Map::new, |l| l.terms.clone()),
        held_out: newest().find_map(|line| line.held_out),
        progress: description.progress.clone(),
        checkpoint,
        page: out.join(report::PAGE),
    }
}
