//! What is learnt: the losses and the optimiser.

use super::{DataSource, Settings};
use crate::train::error::TrainingError;
use serde::{Deserialize, Serialize};
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

/// What is learnt.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObjectiveSettings {
    /// Which losses.
    pub kind: ObjectiveKind,
    /// Numbers of `kind = "heights"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heights: Option<HeightsSettings>,
    /// Numbers of `kind = "paper"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paper: Option<PaperSettings>,
}

/// Numbers of direct supervision.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HeightsSettings {
    /// Highest learning rate of AdamW; it falls to zero along a cosine.
    pub learning_rate: f64,
    /// Steps in which the learning rate rises.
    pub warm_up: u64,
    /// AdamW's weight decay.
    pub weight_decay: f64,
    /// Points along a ray.
    pub samples: usize,
    /// Weight of the rendered height, logarithmic and metric.
    pub height: f64,
    /// Weight of the plane's own height channel, on all texels.
    pub plane: f64,
    /// Weight of the four classes' cross-entropy.
    pub classes: f64,
    /// Weight of the density that grows upwards.
    pub gravity: f64,
    /// Weight of opacity: matter below the surface, none above.
    pub occupancy: f64,
    /// Decay of the moving average of the weights.
    pub average: f64,
}

impl Default for HeightsSettings {
    fn default() -> Self {
        Self {
            learning_rate: 1e-3,
            warm_up: 200,
            weight_decay: 0.01,
            samples: 24,
            height: 1.0,
            plane: 0.5,
            classes: 0.1,
            gravity: 0.1,
            occupancy: 0.1,
            average: 0.999,
        }
    }
}

/// Numbers of the paper's objective, with the release's as defaults (MODEL_SPEC section 11).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PaperSettings {
    /// Learning rate of AdamW, for the network and the discriminators.
    pub learning_rate: f64,
    /// AdamW's weight decay.
    pub weight_decay: f64,
    /// Safetensors file with the weights of LPIPS; without it a substitute is used and named.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<PathBuf>,
    /// Weight of the satellite view.
    pub satellite: f64,
    /// Weight of the panorama.
    pub panorama: f64,
    /// Weight of the perspective view.
    pub perspective: f64,
    /// Weight of the sky's opacity.
    pub opacity: f64,
    /// Weight of the sky's colour.
    pub sky: f64,
    /// Weight of the sky's mean colour.
    pub sky_mean: f64,
    /// Weight of the discriminators.
    pub adversarial: f64,
    /// Weight of the relative depth.
    pub depth: f64,
    /// Weight of the density that grows upwards.
    pub gravity: f64,
}

impl Default for PaperSettings {
    fn default() -> Self {
        Self {
            learning_rate: 1e-4,
            weight_decay: 0.01,
            lpips: None,
            satellite: 2.0,
            panorama: 3.0,
            perspective: 1.5,
            opacity: 30.0,
            sky: 1.0,
            sky_mean: 0.1,
            adversarial: 0.2,
            depth: 0.1,
            gravity: 3.5,
        }
    }
}

impl HeightsSettings {
    /// Terms with their weights.
    #[must_use]
    pub fn terms(&self) -> Vec<(&'static str, f64)> {
        vec![
            ("height", self.height),
            ("plane", self.plane),
            ("classes", self.classes),
            ("gravity", self.gravity),
            ("occupancy", self.occupancy),
        ]
    }
}

impl PaperSettings {
    /// Terms with their weights.
    #[must_use]
    pub fn terms(&self) -> Vec<(&'static str, f64)> {
        vec![
            ("satellite", self.satellite),
            ("panorama", self.panorama),
            ("perspective", self.perspective),
            ("opacity", self.opacity),
            ("sky", self.sky),
            ("sky_mean", self.sky_mean),
            ("adversarial", self.adversarial),
            ("depth", self.depth),
            ("gravity", self.gravity),
        ]
    }
}

impl ObjectiveSettings {
    /// The numbers of direct supervision.
    #[must_use]
    pub fn heights(&self) -> HeightsSettings {
        self.heights.clone().unwrap_or_default()
    }

    /// The numbers of the paper's objective.
    #[must_use]
    pub fn paper(&self) -> PaperSettings {
        self.paper.clone().unwrap_or_default()
    }

    /// Terms of the objective with their weights.
    #[must_use]
    pub fn terms(&self) -> Vec<(&'static str, f64)> {
        match self.kind {
            ObjectiveKind::Heights => self.heights().terms(),
            ObjectiveKind::Paper => self.paper().terms(),
        }
    }

    pub(super) fn paths(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        self.paper.iter_mut().filter_map(|paper| paper.lpips.as_mut())
    }

    /// Why a term cannot be learnt from these data, if it cannot.
    #[must_use]
    pub fn lacks(&self, term: &str, settings: &Settings) -> Option<&'static str> {
        let street = match (settings.data.source, &settings.data.vigor) {
            (DataSource::Vigor, Some(vigor)) => vigor.street,
            _ => false,
        };
        let depth = match (settings.data.source, &settings.data.vigor) {
            (DataSource::Vigor, Some(vigor)) => !vigor.depth.is_empty(),
            _ => true,
        };
        match (self.kind, term) {
            (ObjectiveKind::Paper, "panorama" | "perspective" | "opacity" | "sky" | "sky_mean")
                if !street =>
            {
                Some("the data have no panoramas")
            }
            (ObjectiveKind::Paper, "depth") if !depth => Some("the data have no depth labels"),
            _ => None,
        }
    }

    pub(super) fn check(&self, settings: &Settings) -> Result<(), TrainingError> {
        let other = match self.kind {
            ObjectiveKind::Heights => self.paper.as_ref().map(|_| "paper"),
            ObjectiveKind::Paper => self.heights.as_ref().map(|_| "heights"),
        };
        if let Some(other) = other {
            return Err(settings.wrong(
                "objective.kind",
                self.kind,
                format!("there is a table [objective.{other}]; give kind = \"{other}\", or take the table out"),
            ));
        }
        let name = match self.kind {
            ObjectiveKind::Heights => "heights",
            ObjectiveKind::Paper => "paper",
        };
        let at = |key: &str| format!("objective.{name}.{key}");
        for (term, weight) in self.terms() {
            if !(weight.is_finite() && weight >= 0.0) {
                let why = "a weight is a number from 0, which switches the term off";
                return Err(settings.wrong(&at(term), weight, why));
            }
        }
        if self.terms().iter().all(|(_, weight)| *weight == 0.0) {
            return Err(settings.wrong("objective.kind", self.kind, "every term has the weight 0"));
        }
        let (rate, decay) = match self.kind {
            ObjectiveKind::Heights => (self.heights().learning_rate, self.heights().weight_decay),
            ObjectiveKind::Paper => (self.paper().learning_rate, self.paper().weight_decay),
        };
        if !(rate > 0.0 && rate < 1.0) {
            return Err(settings.wrong(&at("learning_rate"), rate, "between 0 and 1"));
        }
        if !(0.0..1.0).contains(&decay) {
            return Err(settings.wrong(&at("weight_decay"), decay, "from 0 to below 1"));
        }
        if self.kind == ObjectiveKind::Heights {
            let heights = self.heights();
            if !(2..=1024).contains(&heights.samples) {
                return Err(settings.wrong(&at("samples"), heights.samples, "from 2 to 1024"));
            }
            if !(0.0..1.0).contains(&heights.average) {
                return Err(settings.wrong(&at("average"), heights.average, "from 0 to below 1"));
            }
        }
        if let Some(lpips) = self.paper().lpips
            && !lpips.is_file()
        {
            return Err(settings.wrong(&at("lpips"), lpips, "is no file"));
        }
        Ok(())
    }
}
