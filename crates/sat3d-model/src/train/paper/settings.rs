//! Settings of the paper's training: every weight and constant of MODEL_SPEC section 11.

use super::super::TrainError;
use super::super::losses::adversarial::Adversarial;
use super::super::losses::depth::Depth;
use super::super::losses::gravity::Gravity;
use super::super::losses::lpips::Lpips;
use super::super::losses::perceptual::{Perceptual, Substitute};
use super::super::losses::sky::{ORTHO_WEIGHT, Opacity};
use super::super::optimiser::AdamWSettings;
use super::super::rays::ViewSettings;
use crate::render::Composite;
use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Whose form of a term.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// As the released code trains.
    Release,
    /// As the paper says.
    Paper,
}

/// How a picture is held against the true one. A weight of 0 leaves its part out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Photometric {
    /// Weight of the whole.
    pub weight: f64,
    /// Of the mean absolute error.
    #[serde(default)]
    pub l1: f64,
    /// Of the mean squared error.
    #[serde(default)]
    pub l2: f64,
    /// Of the perceptual distance.
    #[serde(default)]
    pub perceptual: f64,
}

impl Photometric {
    /// Whether nothing of it counts.
    #[must_use]
    pub fn is_off(&self) -> bool {
        self.weight == 0.0 || [self.l1, self.l2, self.perceptual].iter().all(|part| *part == 0.0)
    }
}

/// By what a perceptual distance is measured. There is no measure by default: the release's needs weights
/// that do not come with the program, and the one that needs none is another measure
/// ([`super::super::losses::perceptual`]).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PerceptualMeasure {
    /// By none: weights of perceptual distances have to be 0.
    #[default]
    None,
    /// Structural similarity and edges, which need no weights.
    Substitute,
    /// LPIPS over VGG16, with its weights from these files.
    Lpips(Vec<PathBuf>),
}

impl PerceptualMeasure {
    /// Reads the weights.
    pub(crate) fn open(&self, device: &Device) -> Result<Option<Perceptual>, TrainError> {
        Ok(match self {
            Self::None => None,
            Self::Substitute => Some(Perceptual::Substitute(Substitute::default())),
            Self::Lpips(files) => {
                let files: Vec<&Path> = files.iter().map(PathBuf::as_path).collect();
                Some(Perceptual::Lpips(Box::new(Lpips::read(&files, device)?)))
            }
        })
    }
}

/// Weights of the adversarial term, by view; 0 leaves the discriminator out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdversarialWeights {
    /// Satellite view.
    pub satellite: f64,
    /// Panorama.
    pub panorama: f64,
    /// Perspective view.
    pub perspective: f64,
}

impl AdversarialWeights {
    /// The same for all views.
    #[must_use]
    pub fn all(weight: f64) -> Self {
        Self { satellite: weight, panorama: weight, perspective: weight }
    }

    pub(crate) fn list(&self) -> [f64; 3] {
        [self.satellite, self.panorama, self.perspective]
    }
}

/// Weights of the terms; a term of weight 0 is not computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TermWeights {
    /// Satellite view against the image.
    pub satellite: Photometric,
    /// Panorama (sharpened, where there is super-resolution) against the true one.
    pub panorama: Photometric,
    /// Perspective view likewise.
    pub perspective: Photometric,
    /// Street views before super-resolution against half the size of their sharpened ones; its weight is
    /// a share of that of the view.
    pub raw_view: Photometric,
    /// Opacity of the panorama against the sky mask.
    pub opacity: f64,
    /// Opacity of the satellite view against 1.
    pub ortho_opacity: f64,
    /// The sky's colours.
    pub sky_colour: f64,
    /// The mean sky colour outside the sky.
    pub mean_sky_colour: f64,
    /// Discriminators.
    pub adversarial: AdversarialWeights,
    /// Relative depth from above.
    pub depth: f64,
    /// Density must not grow upwards.
    pub gravity: f64,
    /// Of the gradient penalty, in the discriminators' loss.
    pub gradient_penalty: f64,
}

impl TermWeights {
    /// Those of the release.
    #[must_use]
    pub fn release() -> Self {
        let street = Photometric { weight: 3.0, l1: 0.0, l2: 0.0, perceptual: 1.0 };
        Self {
            satellite: Photometric { weight: 2.0, l1: 1.0, l2: 0.0, perceptual: 0.1 },
            panorama: street,
            perspective: Photometric { weight: 1.5, ..street },
            raw_view: Photometric { weight: 0.1, l1: 0.618, l2: 0.0, perceptual: 0.382 },
            opacity: 30.0,
            ortho_opacity: 30.0 * ORTHO_WEIGHT,
            sky_colour: 1.0,
            mean_sky_colour: 0.1,
            adversarial: AdversarialWeights::all(0.2),
            depth: 0.1,
            gravity: 3.5,
            gradient_penalty: 10.0,
        }
    }

    /// The paper's terms: squared error and perceptual distance for all views, no term of its own for
    /// raw views or for the mean sky. The paper gives no weights; those of the release stand in.
    #[must_use]
    pub fn paper() -> Self {
        let release = Self::release();
        let both = |of: Photometric| Photometric { l1: 0.0, l2: 1.0, perceptual: 1.0, ..of };
        Self {
            satellite: both(release.satellite),
            panorama: both(release.panorama),
            perspective: both(release.perspective),
            raw_view: Photometric { weight: 0.0, ..release.raw_view },
            ortho_opacity: 0.0,
            mean_sky_colour: 0.0,
            ..release
        }
    }
}

/// All settings of [`super::PaperLearner`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperSettings {
    /// Names all random numbers.
    pub seed: u64,
    /// Optimiser of the generator.
    pub generator: AdamWSettings,
    /// Optimiser of the discriminators.
    pub discriminator: AdamWSettings,
    /// Most channels of a discriminator (512).
    pub discriminator_channels: usize,
    /// Views and samples.
    pub views: ViewSettings,
    /// Weights of the terms.
    pub weights: TermWeights,
    /// By what pictures' perceptual distance is measured.
    #[serde(default)]
    pub perceptual: PerceptualMeasure,
    /// How the scene is laid over the sky.
    pub composite: Composite,
    /// Form of the depth term.
    pub depth_form: Form,
    /// Form of the adversarial term: softplus or hinge.
    pub adversarial_form: Form,
    /// Form of the opacity term: opacity as a logit, or as a probability.
    pub opacity_form: Form,
    /// What the sky's colour term looks at: the sky map, or the rendered panorama.
    pub sky_form: Form,
    /// Pairs of points of the gravity term, for each image.
    pub gravity_points: usize,
    /// Greatest distance of a pair, cube units.
    pub gravity_reach: f64,
    /// How much denser the upper point may be.
    pub gravity_margin: f64,
    /// Largest factor of the frozen encoder's coordinates in training (2); 1 for none.
    pub encoder_rescale: f64,
    /// Whether the sky's modules are part of the network. Otherwise the sky of an image is one plain
    /// colour, the mean of its true sky.
    pub sky: bool,
    /// Whether street views pass through super-resolution, where the network has it.
    pub super_resolution: bool,
}

impl PaperSettings {
    /// As the released code trains.
    #[must_use]
    pub fn release() -> Self {
        let gravity = Gravity::release();
        Self {
            seed: 0,
            generator: AdamWSettings::default(),
            discriminator: AdamWSettings::default(),
            discriminator_channels: 512,
            views: ViewSettings::release(),
            weights: TermWeights::release(),
            perceptual: PerceptualMeasure::None,
            composite: Composite::Squared,
            depth_form: Form::Release,
            adversarial_form: Form::Release,
            opacity_form: Form::Release,
            sky_form: Form::Release,
            gravity_points: gravity.points,
            gravity_reach: gravity.reach,
            gravity_margin: gravity.margin,
            encoder_rescale: 2.0,
            sky: true,
            super_resolution: true,
        }
    }

    /// As the paper says, where it differs from the released code (MODEL_SPEC section 12).
    #[must_use]
    pub fn paper() -> Self {
        Self {
            views: ViewSettings::paper(),
            weights: TermWeights::paper(),
            composite: Composite::Once,
            depth_form: Form::Paper,
            adversarial_form: Form::Paper,
            opacity_form: Form::Paper,
            sky_form: Form::Paper,
            encoder_rescale: 1.0,
            ..Self::release()
        }
    }

    pub(crate) fn depth(&self) -> Depth {
        match self.depth_form {
            Form::Release => Depth::release(),
            Form::Paper => Depth::paper(),
        }
    }

    pub(crate) fn game(&self) -> Adversarial {
        match self.adversarial_form {
            Form::Release => Adversarial::release(),
            Form::Paper => Adversarial::paper(),
        }
    }

    pub(crate) fn opacity(&self) -> Opacity {
        match self.opacity_form {
            Form::Release => Opacity::release(),
            Form::Paper => Opacity::paper(),
        }
    }

    pub(crate) fn gravity(&self) -> Gravity {
        Gravity {
            points: self.gravity_points,
            reach: self.gravity_reach,
            margin: self.gravity_margin,
        }
    }

    /// That every setting makes sense.
    pub(crate) fn check(&self) -> Result<(), TrainError> {
        let fault = |key, value: String, why: &str| {
            Err(TrainError::Setting { key, value, why: why.into() })
        };
        if let Some((key, value, why)) = self.views.fault() {
            return fault(key, value, why);
        }
        let weights = &self.weights;
        let views = [
            ("weights.satellite", weights.satellite),
            ("weights.panorama", weights.panorama),
            ("weights.perspective", weights.perspective),
            ("weights.raw_view", weights.raw_view),
        ];
        for (key, view) in views {
            if ![view.weight, view.l1, view.l2, view.perceptual].iter().all(usable) {
                return fault(key, format!("{view:?}"), "weights that are finite and not below 0");
            }
            let measured = self.perceptual != PerceptualMeasure::None;
            if !view.is_off() && view.perceptual > 0.0 && !measured {
                let why = "a `perceptual` distance to measure by (files of weights for \"lpips\", or \
                           \"substitute\", which needs none), or the weight 0 for it";
                return fault(key, format!("{view:?}"), why);
            }
        }
        let ViewSettings { ortho_window, panorama_height, perspective, .. } = self.views;
        let least = ortho_window.min(panorama_height).min(perspective);
        if matches!(self.perceptual, PerceptualMeasure::Lpips(_)) && least < LPIPS_SIDE {
            let why = "16 or more along every side of a view, of which LPIPS sees something";
            return fault("views", least.to_string(), why);
        }
        let single = [
            ("weights.opacity", weights.opacity),
            ("weights.ortho_opacity", weights.ortho_opacity),
            ("weights.sky_colour", weights.sky_colour),
            ("weights.mean_sky_colour", weights.mean_sky_colour),
            ("weights.depth", weights.depth),
            ("weights.gravity", weights.gravity),
            ("weights.gradient_penalty", weights.gradient_penalty),
            ("gravity_reach", self.gravity_reach),
            ("gravity_margin", self.gravity_margin),
        ];
        let adversarial = weights.adversarial.list().map(|weight| ("weights.adversarial", weight));
        for (key, weight) in single.into_iter().chain(adversarial) {
            if !usable(&weight) {
                return fault(key, weight.to_string(), "finite and not below 0");
            }
        }
        if !(1..=1 << 20).contains(&self.gravity_points) {
            return fault("gravity_points", self.gravity_points.to_string(), "1 to 1048576");
        }
        if !(1.0..=16.0).contains(&self.encoder_rescale) {
            return fault("encoder_rescale", self.encoder_rescale.to_string(), "1 to 16");
        }
        if !(8..=4096).contains(&self.discriminator_channels) {
            let value = self.discriminator_channels.to_string();
            return fault("discriminator_channels", value, "8 to 4096");
        }
        for (key, rate) in [
            ("generator.learning_rate", self.generator.learning_rate),
            ("discriminator.learning_rate", self.discriminator.learning_rate),
        ] {
            if !usable(&rate) {
                return fault(key, rate.to_string(), "finite and not below 0");
            }
        }
        Ok(())
    }
}

/// Least side of a picture that LPIPS can measure.
const LPIPS_SIDE: usize = 16;

fn usable(weight: &f64) -> bool {
    weight.is_finite() && *weight >= 0.0
}
