//! What to train, on what, and how: a TOML file with four tables.
//!
//! ```toml
//! [model]
//! kind = "mini"
//!
//! [objective]
//! kind = "heights"
//!
//! [data]
//! source = "simulated"
//! simulated = { seed = 7, scenes = 2000 }
//!
//! [run]
//! steps = 20000
//! batch = 16
//! ```
//!
//! Every key has a default. Relative paths belong to the folder of the file.

mod data;
mod identity;
mod objective;
mod overlay;

pub use data::{
    DataSettings, DataSource, LabelChoice, Position, SimulatedSettings, Symmetries, VigorSettings,
};
pub use identity::difference;
pub use objective::{Objective, ObjectiveKind, ObjectiveSettings, ObjectiveTerm, PaperForm};

use super::checkpoint::STATE;
use super::error::TrainingError;
use crate::model::Device;
use crate::model::train::mini::MiniSettings;
use crate::model::weights::{BuiltIn, locate};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The settings of a training.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The network.
    pub model: ModelSettings,
    /// What it learns.
    pub objective: ObjectiveSettings,
    /// What it learns from.
    pub data: DataSettings,
    /// How long and where.
    pub run: RunSettings,
    /// The file, for messages.
    #[serde(skip)]
    pub path: PathBuf,
}

/// Which network is trained.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelKind {
    /// The small convolutional network that ships with the program.
    #[default]
    Mini,
    /// The network of the release.
    Reference,
}

/// The network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelSettings {
    /// Which network.
    pub kind: ModelKind,
    /// A `config.json` instead of the one that is built in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub config: Option<PathBuf>,
    /// Checkpoint folder whose weights the training begins with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<PathBuf>,
    /// Sizes of `kind = "mini"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mini: Option<MiniSettings>,
}

/// How long, where, and what is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunSettings {
    /// Steps of optimisation.
    pub steps: u64,
    /// Examples in a step.
    pub batch: usize,
    /// Seed of everything random.
    pub seed: u64,
    /// `cpu`, `cuda`, `cuda:<number>`, `wgpu`.
    pub device: String,
    /// Steps from one checkpoint to the next.
    pub checkpoint_every: u64,
    /// Checkpoints that are kept; 0 keeps all.
    pub keep: usize,
    /// Steps that a line of the log is the mean of.
    pub log_every: u64,
    /// Steps from one look at held-out examples to the next; 0 never looks.
    pub preview_every: u64,
    /// Stops, with a checkpoint, after this many minutes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// Threads of the learner; 0 takes all cores.
    pub threads: usize,
    /// Batches in a row that may be skipped for values that are not finite.
    pub skipped_in_a_row: u64,
}

impl Default for RunSettings {
    fn default() -> Self {
        Self {
            steps: 20_000,
            batch: 16,
            seed: 0,
            device: "cpu".into(),
            checkpoint_every: 1000,
            keep: 3,
            log_every: 50,
            preview_every: 1000,
            minutes: None,
            threads: 0,
            skipped_in_a_row: 20,
        }
    }
}

impl Settings {
    /// Reads and checks a settings file. `changes` are `key=value`, as `--set` gives them: `run.seed=3`; they count
    /// over what the file says.
    ///
    /// # Errors
    /// [`TrainingError::Io`], [`TrainingError::Syntax`], [`TrainingError::Change`] or [`TrainingError::Setting`].
    pub fn read(path: &Path, changes: &[String]) -> Result<Self, TrainingError> {
        let text = std::fs::read_to_string(path).map_err(TrainingError::io(path))?;
        Self::parse(path, &text, changes)
    }

    /// The settings that a text says; its relative paths belong to the folder of `path`.
    ///
    /// # Errors
    /// As [`Settings::read`].
    pub fn parse(path: &Path, text: &str, changes: &[String]) -> Result<Self, TrainingError> {
        let mut settings: Self =
            toml::from_str(text).map_err(|error| syntax(path, text, &error))?;
        if !changes.is_empty() {
            let mut table: toml::Table =
                toml::from_str(text).map_err(|error| syntax(path, text, &error))?;
            for change in changes {
                apply(&mut table, change)?;
                // After each, so that a message is about this one.
                settings = table.clone().try_into().map_err(|error: toml::de::Error| {
                    let message = error.message().replace('\n', " ");
                    TrainingError::Change { change: change.clone(), why: message }
                })?;
            }
        }
        path.clone_into(&mut settings.path);
        let base = path.parent().unwrap_or(Path::new(""));
        for own in settings.paths() {
            if BuiltIn::at(own).is_none() {
                // `join` leaves an absolute path as it is.
                *own = base.join(&*own);
            }
        }
        settings.check()?;
        Ok(settings)
    }

    fn paths(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let vigor = self.data.vigor.as_mut();
        [&mut self.model.config, &mut self.model.start, &mut self.data.simulated.cache]
            .into_iter()
            .flatten()
            .chain(&mut self.objective.lpips)
            .chain(vigor.into_iter().flat_map(|vigor| {
                std::iter::once(&mut vigor.folder).chain(vigor.manifest.as_mut())
            }))
    }

    /// The device.
    ///
    /// # Errors
    /// [`TrainingError::Setting`] for a name that is none.
    pub fn device(&self) -> Result<Device, TrainingError> {
        self.run.device.parse().map_err(|_| {
            self.wrong("run.device", &self.run.device, "one of cpu, cuda, cuda:<number>, wgpu")
        })
    }

    /// A [`TrainingError::Setting`] of this file.
    pub fn wrong(&self, key: &str, value: impl Serialize, why: impl Into<String>) -> TrainingError {
        TrainingError::Setting {
            path: self.path.clone(),
            key: key.to_owned(),
            value: serde_json::to_string(&value).unwrap_or_default(),
            why: why.into(),
        }
    }

    /// Checks values against their ranges and against each other.
    ///
    /// # Errors
    /// [`TrainingError::Setting`] for the first that is wrong.
    pub fn check(&self) -> Result<(), TrainingError> {
        let run = &self.run;
        let whole = [
            ("run.steps", run.steps, 1),
            ("run.batch", run.batch as u64, 1),
            ("run.checkpoint_every", run.checkpoint_every, 1),
            ("run.log_every", run.log_every, 1),
            ("run.skipped_in_a_row", run.skipped_in_a_row, 1),
        ];
        for (key, value, least) in whole {
            if value < least {
                return Err(self.wrong(key, value, format!("at least {least}")));
            }
        }
        if run.batch > 4096 {
            return Err(self.wrong("run.batch", run.batch, "at most 4096"));
        }
        if let Some(minutes) = run.minutes
            && !(minutes.is_finite() && minutes > 0.0)
        {
            return Err(self.wrong("run.minutes", minutes, "a positive number of minutes"));
        }
        self.device()?;
        for (key, file) in
            [("model.config", &self.model.config), ("model.start", &self.model.start)]
        {
            if let Some(file) = file
                && BuiltIn::at(file).is_none()
                && !file.exists()
            {
                return Err(self.wrong(key, file, "does not exist"));
            }
        }
        let model = &self.model;
        let paper = self.objective.kind == ObjectiveKind::Paper;
        let trained = |start: &PathBuf| {
            BuiltIn::at(start).is_some() || start.join(STATE).is_file() || locate(start).is_ok()
        };
        // A setting that would change nothing is a mistake.
        let idle = match model.kind {
            ModelKind::Mini => [
                (
                    "model.config",
                    model.config.is_some(),
                    "is of kind = \"reference\"; sizes of the small network are in model.mini",
                ),
                (
                    "model.start",
                    model.start.as_ref().is_some_and(|start| paper || !trained(start)),
                    "the small network goes on from a checkpoint folder that `sat3d train` wrote for objective.kind = \"heights\", which is the objective it needs, from an exported model, or from built-in:mini",
                ),
            ],
            ModelKind::Reference => [
                ("model.mini", model.mini.is_some(), "is of kind = \"mini\""),
                (
                    "model.start",
                    model.start.is_none(),
                    "the encoder does not learn: name a checkpoint folder that holds its weights",
                ),
            ],
        };
        if let Some((key, _, why)) = idle.into_iter().find(|(_, wrong, _)| *wrong) {
            let value = serde_json::to_value(model).unwrap_or_default();
            let value = value.get(&key["model.".len()..]).cloned().unwrap_or_default();
            return Err(self.wrong(key, value, why));
        }
        if model.kind == ModelKind::Reference && self.objective.kind == ObjectiveKind::Heights {
            let why = "true heights are learnt by the small network; give kind = \"mini\", or objective.kind = \"paper\"";
            return Err(self.wrong("model.kind", model.kind, why));
        }
        self.objective.check(self)?;
        self.data.check(self)
    }
}

/// Sets the value of a dotted key. A value that is no TOML is a text: `run.device=cuda` needs no quotes.
fn apply(table: &mut toml::Table, change: &str) -> Result<(), TrainingError> {
    let wrong =
        |why: &str| TrainingError::Change { change: change.to_owned(), why: why.to_owned() };
    let (key, value) =
        change.split_once('=').ok_or_else(|| wrong("write key=value, as run.seed=3"))?;
    let value = value.trim();
    let value = toml::from_str::<toml::Table>(&format!("value = {value}"))
        .ok()
        .and_then(|mut parsed| parsed.remove("value"))
        .unwrap_or_else(|| toml::Value::String(value.to_owned()));
    let mut parts: Vec<&str> = key.trim().split('.').collect();
    let last =
        parts.pop().filter(|last| !last.is_empty()).ok_or_else(|| wrong("there is no key"))?;
    let mut at = table;
    for part in parts {
        let next = at.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        at = next.as_table_mut().ok_or_else(|| wrong(&format!("`{part}` is no table")))?;
    }
    at.insert(last.to_owned(), value);
    Ok(())
}

fn syntax(path: &Path, text: &str, error: &toml::de::Error) -> TrainingError {
    let start = error.span().map_or(0, |span| span.start.min(text.len()));
    let line = text.as_bytes()[..start].iter().filter(|byte| **byte == b'\n').count() + 1;
    let mut message = error.message().replace('\n', " ");
    // A wrong type does not say its key; the line does.
    if let Some(written) = text.lines().nth(line - 1).map(str::trim)
        && !written.is_empty()
    {
        message += &format!(" (in `{written}`)");
    }
    TrainingError::Syntax { path: path.to_owned(), line, message }
}

#[cfg(test)]
mod tests;
