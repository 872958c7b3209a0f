//! What the weights depend on, and what may differ when a training goes on.

use super::{ObjectiveKind, Settings};
use crate::batch::OutputFile;
use crate::model::weights::{BuiltIn, WEIGHTS_FILE, locate};
use crate::plan::hex;
use crate::train::checkpoint::STATE;
use crate::train::error::TrainingError;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use std::path::Path;

impl Settings {
    /// Everything that the weights depend on. Files count by their content, so that they may move; how often is
    /// logged, previewed and stored, threads, memory and the time limit do not count.
    ///
    /// # Errors
    /// [`TrainingError`] where a named file cannot be read.
    pub fn identity(&self, data: Value) -> Result<Value, TrainingError> {
        let Value::Object(mut objective) =
            serde_json::to_value(self.objective()?).unwrap_or_default()
        else {
            return Err(self.wrong("objective", self.objective.kind, "cannot be written down"));
        };
        objective.insert("kind".into(), self.objective.kind.name().into());
        if self.objective.kind == ObjectiveKind::Paper {
            let files = self.objective.lpips.iter().map(|file| hash(file));
            objective.insert("lpips".into(), json!(files.collect::<Result<Vec<_>, _>>()?));
        }
        let config = self.model.config.as_deref().map(hash).transpose()?;
        let start = match &self.model.start {
            Some(place) => Some(match BuiltIn::at(place) {
                Some(model) => hex(&Sha256::digest(model.weights)),
                None if place.join(STATE).is_file() => hash(&place.join(STATE))?,
                None => hash(&locate(place)?.join(WEIGHTS_FILE))?,
            }),
            None => None,
        };
        // Another kind of device rounds otherwise.
        let device = self.run.device.split(':').next().unwrap_or_default();
        let run = &self.run;
        Ok(json!({
            "model": {
                "kind": self.model.kind, "config": config, "start": start,
                "mini": self.model.mini.clone().unwrap_or_default(),
            },
            "objective": objective,
            "data": { "source": self.data.source, "settings": data },
            "run": { "steps": run.steps, "batch": run.batch, "seed": run.seed, "device": device },
        }))
    }
}

fn hash(path: &Path) -> Result<String, TrainingError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(OutputFile::measure(folder, &file).map_err(TrainingError::io(path))?.sha256)
}

/// The first setting that two identities do not share: its key, and its value in each.
#[must_use]
pub fn difference(stored: &Value, now: &Value) -> Option<(String, String, String)> {
    let empty = Map::new();
    match (stored, now) {
        (Value::Object(_), _) | (_, Value::Object(_)) => {
            let (a, b) = (stored.as_object().unwrap_or(&empty), now.as_object().unwrap_or(&empty));
            let new = b.keys().filter(|key| !a.contains_key(*key));
            a.keys().chain(new).find_map(|key| {
                let value = |map: &Map<String, Value>| map.get(key).cloned().unwrap_or_default();
                let (below, stored, now) = difference(&value(a), &value(b))?;
                let join = if below.is_empty() { "" } else { "." };
                Some((format!("{key}{join}{below}"), stored, now))
            })
        }
        _ => (stored != now).then(|| (String::new(), stored.to_string(), now.to_string())),
    }
}
