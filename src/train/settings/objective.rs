//! What is learnt: the losses and the optimiser.

use super::overlay::{Fault, overlay};
use super::{DataSource, Settings};
use crate::model::train::{HeightSettings, PaperSettings};
use crate::train::error::TrainingError;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::PathBuf;

/// Which losses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ObjectiveKind {
    /// Heights are told to the network: direct supervision by simulated scenes.
    #[default]
    Heights,
    /// The paper's signals: images from above and from the street, relative depth, gravity.
    Paper,
}

impl ObjectiveKind {
    /// As the settings name it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Heights => "heights",
            Self::Paper => "paper",
        }
    }
}

/// Whose form of the paper's objective is the default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PaperForm {
    /// As the released code trains.
    #[default]
    Release,
    /// As the paper says.
    Paper,
}

/// What is learnt. The tables hold what differs from the defaults.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObjectiveSettings {
    /// Which losses.
    pub kind: ObjectiveKind,
    /// Defaults of `kind = "paper"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub form: Option<PaperForm>,
    /// Changes to [`HeightSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heights: Option<toml::Table>,
    /// Changes to [`PaperSettings`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paper: Option<toml::Table>,
    /// Files with the weights of LPIPS, for `kind = "paper"`; without them the perceptual distance is a substitute
    /// without learned weights, which `--explain` names.
    pub lpips: Vec<PathBuf>,
}

/// The numbers of an objective, whole.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Objective {
    /// Direct supervision.
    Heights(HeightSettings),
    /// The paper's signals.
    Paper(Box<PaperSettings>),
}

/// One term of an objective.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectiveTerm {
    /// Its key in the settings.
    pub name: String,
    /// Its weight; 0 is off.
    pub weight: f64,
    /// Why it cannot be learnt from the data, if it cannot.
    pub lacks: Option<&'static str>,
}

/// What the settings of the run decide, and the tables of an objective do not.
const OF_THE_RUN: [(&str, &str); 2] = [("steps", "run.steps"), ("seed", "run.seed")];

impl Objective {
    /// Terms with their weights, as the settings name them. `street` and `depth` say what the data hold.
    #[must_use]
    pub fn terms(&self, street: bool, depth: bool) -> Vec<ObjectiveTerm> {
        let term =
            |name: &str, weight: f64, lacks| ObjectiveTerm { name: name.to_owned(), weight, lacks };
        match self {
            Self::Heights(heights) => [
                ("logarithm", heights.logarithm),
                ("metric", heights.metric),
                ("classes", heights.classes),
                ("slope", heights.slope),
                ("colour", heights.colour),
            ]
            .map(|(name, weight)| term(name, weight, None))
            .into(),
            Self::Paper(paper) => {
                let of_street = (!street).then_some("the data have no panoramas");
                let of_depth = (!depth).then_some("the data have no depth labels");
                let weights = &paper.weights;
                let game = &weights.adversarial;
                let view = |view: &crate::model::train::Photometric| {
                    if view.is_off() { 0.0 } else { view.weight }
                };
                vec![
                    term("weights.satellite", view(&weights.satellite), None),
                    term("weights.panorama", view(&weights.panorama), of_street),
                    term("weights.perspective", view(&weights.perspective), of_street),
                    term("weights.raw_view", view(&weights.raw_view), of_street),
                    term("weights.opacity", weights.opacity, of_street),
                    term("weights.ortho_opacity", weights.ortho_opacity, None),
                    term("weights.sky_colour", weights.sky_colour, of_street),
                    term("weights.mean_sky_colour", weights.mean_sky_colour, of_street),
                    term("weights.adversarial.satellite", game.satellite, None),
                    term("weights.adversarial.panorama", game.panorama, of_street),
                    term("weights.adversarial.perspective", game.perspective, of_street),
                    term("weights.depth", weights.depth, of_depth),
                    term("weights.gravity", weights.gravity, None),
                    term("weights.gradient_penalty", weights.gradient_penalty, None),
                ]
            }
        }
    }

    /// The optimiser in a few words.
    #[must_use]
    pub fn optimiser(&self) -> String {
        match self {
            Self::Heights(heights) => format!(
                "AdamW, learning rate {} falling as a cosine",
                heights.optimiser.learning_rate
            ),
            Self::Paper(paper) => {
                format!("AdamW, learning rate {}", paper.generator.learning_rate)
            }
        }
    }
}

impl Settings {
    /// The numbers of the objective: the defaults, what the file changes, the steps and the seed of the run.
    ///
    /// # Errors
    /// [`TrainingError::Setting`] for a key or a value that is not served.
    pub fn objective(&self) -> Result<Objective, TrainingError> {
        let objective = &self.objective;
        let name = objective.kind.name();
        let empty = toml::Table::new();
        let wrong = |fault: Fault| {
            let dot = if fault.key.is_empty() { "" } else { "." };
            self.wrong(&format!("objective.{name}{dot}{}", fault.key), fault.value, fault.why)
        };
        let own = |table: &toml::Table| {
            let taken = OF_THE_RUN.into_iter().find(|(key, _)| table.contains_key(*key));
            taken.map_or(Ok(()), |(key, instead)| {
                let value = serde_json::to_value(&table[key]).unwrap_or(Value::Null);
                Err(self.wrong(
                    &format!("objective.{name}.{key}"),
                    value,
                    format!("is `{instead}`"),
                ))
            })
        };
        match objective.kind {
            ObjectiveKind::Heights => {
                let table = objective.heights.as_ref().unwrap_or(&empty);
                own(table)?;
                let base = HeightSettings { steps: self.run.steps, ..HeightSettings::default() };
                Ok(Objective::Heights(overlay(&base, table).map_err(wrong)?))
            }
            ObjectiveKind::Paper => {
                let table = objective.paper.as_ref().unwrap_or(&empty);
                own(table)?;
                let base = match objective.form.unwrap_or_default() {
                    PaperForm::Release => PaperSettings::release(),
                    PaperForm::Paper => PaperSettings::paper(),
                };
                let base = PaperSettings { seed: self.run.seed, ..base };
                Ok(Objective::Paper(Box::new(overlay(&base, table).map_err(wrong)?)))
            }
        }
    }

    /// Terms of the objective, with what the data hold for them.
    ///
    /// # Errors
    /// As [`Settings::objective`].
    pub fn terms(&self) -> Result<Vec<ObjectiveTerm>, TrainingError> {
        let (street, depth) = match (self.data.source, &self.data.vigor) {
            (DataSource::Vigor, Some(vigor)) => (vigor.street, !vigor.depth.is_empty()),
            // Relative depth follows from the true heights.
            _ => (self.data.simulated.views > 0, true),
        };
        Ok(self.objective()?.terms(street, depth))
    }
}

impl ObjectiveSettings {
    pub(super) fn check(&self, settings: &Settings) -> Result<(), TrainingError> {
        let other = match self.kind {
            ObjectiveKind::Heights => self.paper.as_ref().map(|_| "paper"),
            ObjectiveKind::Paper => self.heights.as_ref().map(|_| "heights"),
        };
        if let Some(other) = other {
            let why = format!(
                "there is a table [objective.{other}]; give kind = \"{other}\", or take the table out"
            );
            return Err(settings.wrong("objective.kind", self.kind, why));
        }
        if let (ObjectiveKind::Heights, Some(form)) = (self.kind, self.form) {
            let why = "belongs to kind = \"paper\"";
            return Err(settings.wrong("objective.form", form, why));
        }
        if let Some(missing) = self.lpips.iter().find(|file| !file.is_file()) {
            return Err(settings.wrong("objective.lpips", missing, "is no file"));
        }
        let terms = settings.terms()?;
        for term in &terms {
            if !(term.weight.is_finite() && term.weight >= 0.0) {
                let key = format!("objective.{}.{}", self.kind.name(), term.name);
                let why = "a weight is a number from 0, which switches the term off";
                return Err(settings.wrong(&key, term.weight, why));
            }
        }
        if terms.iter().all(|term| term.weight == 0.0 || term.lacks.is_some()) {
            let why = "no term has a weight and data to learn it from";
            return Err(settings.wrong("objective.kind", self.kind, why));
        }
        Ok(())
    }
}
