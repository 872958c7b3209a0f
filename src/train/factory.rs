//! The learner that the settings name: the one place that knows all of them.

use super::checkpoint::{STATE, read_tensors};
use super::settings::{ModelKind, Objective, Settings};
use crate::model::config::RELEASED;
use crate::model::train::mini::MiniSettings;
use crate::model::train::{
    Class, HeightLearner, Learner, PaperLearner, PaperSettings, PerceptualMeasure, TrainError,
};
use crate::model::weights::{Checkpoint, expected};
use crate::model::{Config, Device, ModelError};

/// Makes the learner. `seed` is that of the training: of the first weights and of every random number in a step.
///
/// # Errors
/// [`TrainError::Setting`] for a combination of model and objective that is not served; those of the device and of
/// the weights to start from.
pub fn learner(
    settings: &Settings,
    device: &Device,
    seed: u64,
) -> Result<Box<dyn Learner>, TrainError> {
    let refused = |key, why: &str| TrainError::Setting {
        key,
        value: format!("{:?}", settings.model.kind).to_lowercase(),
        why: why.to_owned(),
    };
    let objective = settings.objective().map_err(|error| TrainError::Setting {
        key: "objective",
        value: String::new(),
        why: error.to_string(),
    })?;
    match (settings.model.kind, objective) {
        (ModelKind::Mini, Objective::Heights(heights)) => {
            let mut learner = HeightLearner::new(mini(settings), heights, *device, seed)?;
            if let Some(start) = &settings.model.start {
                let wrong = |why: String| TrainError::Setting {
                    key: "model.start",
                    value: start.display().to_string(),
                    why,
                };
                let wrong = |error: &dyn std::fmt::Display| wrong(error.to_string());
                let state = start.join(STATE);
                if state.is_file() {
                    let state = read_tensors(&state).map_err(|error| wrong(&error))?;
                    learner.begin_with(&state).map_err(|error| wrong(&error))?;
                } else {
                    let model = Checkpoint::at(start).map_err(|error| wrong(&error))?;
                    learner
                        .begin_with_model(model.config(), &model)
                        .map_err(|error| wrong(&error))?;
                }
            }
            Ok(Box::new(learner))
        }
        (ModelKind::Reference, Objective::Paper(paper)) => reference(settings, *device, *paper),
        (ModelKind::Reference, Objective::Heights(_)) => Err(refused(
            "model.kind",
            "true heights are learnt by the small model; give kind = \"mini\", or objective.kind = \"paper\"",
        )),
        (ModelKind::Mini, Objective::Paper(paper)) => {
            let paper = with_measure(settings, *paper);
            Ok(Box::new(PaperLearner::mini(&mini(settings), *device, paper)?))
        }
    }
}

/// By what pictures are held against each other: LPIPS with the user's weights where `objective.lpips` names
/// them, what the paper's settings say, or the substitute, which `--explain` and the log name.
fn with_measure(settings: &Settings, mut paper: PaperSettings) -> PaperSettings {
    let files = &settings.objective.lpips;
    if !files.is_empty() {
        paper.perceptual = PerceptualMeasure::Lpips(files.clone());
    } else if paper.perceptual == PerceptualMeasure::default() {
        paper.perceptual = PerceptualMeasure::Substitute;
    }
    paper
}

fn mini(settings: &Settings) -> MiniSettings {
    settings.model.mini.clone().unwrap_or_default()
}

fn reference(
    settings: &Settings,
    device: Device,
    paper: PaperSettings,
) -> Result<Box<dyn Learner>, TrainError> {
    let Some(start) = &settings.model.start else {
        return Err(TrainError::Setting {
            key: "model.start",
            value: "none".to_owned(),
            why: "the encoder is frozen: name a checkpoint folder that holds its weights"
                .to_owned(),
        });
    };
    let source = Checkpoint::open(start)?;
    let paper = with_measure(settings, paper);
    let config = match &settings.model.config {
        Some(path) => std::fs::read_to_string(path)
            .map_err(|source| ModelError::Io { path: path.clone(), source })?,
        None => RELEASED.to_owned(),
    };
    Ok(Box::new(PaperLearner::new(&config, &source, device, paper)?))
}

/// Parameters of the network, where they can be told without making it.
#[must_use]
pub fn parameters(settings: &Settings) -> Option<usize> {
    let config = match (settings.model.kind, &settings.model.config) {
        (ModelKind::Mini, _) => mini(settings).config(Class::COUNT).ok()?,
        (ModelKind::Reference, Some(path)) => {
            Config::from_json(&std::fs::read_to_string(path).ok()?).ok()?
        }
        (ModelKind::Reference, None) => Config::released(),
    };
    Some(expected(&config).iter().map(crate::model::weights::TensorSpec::values).sum())
}
