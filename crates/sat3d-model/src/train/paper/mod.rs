//! The paper's training: no true heights, but street views, relative depth, gravity and discriminators
//! (MODEL_SPEC section 11).
//!
//! The generator and its discriminators take turns: the generator on even steps. A discriminators' step
//! sees what the generator's step before it rendered, beside true panoramas and perspective views of its
//! own batch and true satellite crops of the batch before, as in the release.

mod objective;
mod settings;
mod state;

pub use settings::{
    AdversarialWeights, Form, PaperSettings, PerceptualMeasure, Photometric, TermWeights,
};

use super::TrainError;
use super::discriminator::{Discriminator, gradient_penalty};
use super::example::Example;
use super::generator::{Generator, MapNetwork, MiniMap, ReleasedMap, Shape};
use super::learner::{Exported, Learner, NamedTensor, Outcome, Term};
use super::mini::{self, MiniSettings};
use super::optimiser::{AdamW, Average, Named, finite};
use super::rays::{Look, Purpose, draw, random_window};
use super::targets::{Sizes, StreetTargets, Targets, batch};
use crate::config::Config;
use crate::network::Device;
use crate::weights::{Need, TensorSource, expected};
use burn::tensor::Tensor;
use objective::{Judged, Objective, Pictures, crop, scalar};

/// A distance of pictures (`batch x 3 x height x width`, in [-1, 1]): predicted, true; one value.
pub(crate) type Distance = dyn Fn(Tensor<4>, Tensor<4>) -> Tensor<1> + Send + Sync;

/// Discriminators of the satellite view, the panorama and the perspective view, where there are any.
#[derive(Clone, Debug)]
pub(crate) struct Critics {
    pub views: [Option<Discriminator>; 3],
}

impl Critics {
    const NAMES: [&str; 3] = ["satellite", "panorama", "perspective"];

    /// Those whose views have a weight.
    fn new(settings: &PaperSettings, enlarged: usize, device: &burn::tensor::Device) -> Self {
        let views = &settings.views;
        // Built for the height of a square picture; a panorama is as wide as four of its own heights.
        let sides = [
            views.ortho_window,
            2 * views.panorama_height * enlarged,
            views.perspective * enlarged,
        ];
        let weights = settings.weights.adversarial.list();
        Self {
            views: [0, 1, 2].map(|view| {
                let seed = [settings.seed, 0x6372_6974_6963, view as u64];
                (weights[view] > 0.0).then(|| {
                    Discriminator::new(sides[view], settings.discriminator_channels, &seed, device)
                })
            }),
        }
    }

    fn any(&self) -> bool {
        self.views.iter().any(Option::is_some)
    }
}

/// Learns a map network, the point head, the sky and super-resolution from the paper's supervision.
pub struct PaperLearner<M: MapNetwork = ReleasedMap> {
    settings: PaperSettings,
    shape: Shape,
    /// Text of `config.json`.
    config: String,
    /// What a checkpoint holds beside the parameters that are trained.
    beside: Vec<NamedTensor>,
    perceptual: Option<Box<Distance>>,
    device: burn::tensor::Device,
    generator: Generator<M>,
    average: Average,
    optimiser: AdamW,
    critics: Critics,
    critics_optimiser: AdamW,
    /// What the last step of the generator rendered.
    fakes: Pictures,
    /// True satellite crops of that step's batch.
    crops: Option<Tensor<4>>,
}

impl<M: MapNetwork> std::fmt::Debug for PaperLearner<M> {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut shown = formatter.debug_struct("PaperLearner");
        shown.field("settings", &self.settings).field("shape", &self.shape).finish_non_exhaustive()
    }
}

impl PaperLearner<ReleasedMap> {
    /// Learns the network that `config` (the text of a `config.json`) describes, from the weights of
    /// `source` on; the encoder stays as it is.
    ///
    /// # Errors
    /// [`TrainError::Setting`]; those of the config, the source and the device.
    pub fn new(
        config: &str,
        source: &dyn TensorSource,
        device: Device,
        settings: PaperSettings,
    ) -> Result<Self, TrainError> {
        settings.check()?;
        let parsed = Config::from_json(config)?;
        let opened = device.open()?.autodiff();
        let parts = [settings.sky, settings.super_resolution];
        let generator = Generator::load(&parsed, source, &opened, settings.encoder_rescale, parts)?;
        let mut learner = Self::with_generator(
            generator,
            Shape::of(&parsed),
            config.to_owned(),
            &opened,
            settings,
        )?;
        learner.beside.extend(rest(&parsed, source, &learner)?);
        Ok(learner)
    }
}

impl PaperLearner<MiniMap> {
    /// Learns the small network, from fresh weights that the settings' seed names. It has neither a sky
    /// network nor super-resolution.
    ///
    /// # Errors
    /// As [`PaperLearner::new`].
    pub fn mini(
        mini: &MiniSettings,
        device: Device,
        settings: PaperSettings,
    ) -> Result<Self, TrainError> {
        let config = mini.config(0)?;
        let device = device.open()?.autodiff();
        let mut start = mini::fresh(&config, settings.seed);
        soften(&mut start, config.point_features(), config.scale);
        let source = Named::new(start);
        let generator = Generator::mini(&config, &source, &device)?;
        let shape = Shape::of(&config);
        Self::with_generator(generator, shape, mini.json(0), &device, settings)
    }
}

/// Spreads the surface that the small network starts with over about the distance of two samples: rays
/// see where a sharp one lies no better than to a sample, and nothing of how to move it. The crop covers
/// `[-scale, scale]`, and its cameras are as much nearer to the cube's middle as they are without a border;
/// so is the ground that they stand over.
fn soften(start: &mut [NamedTensor], inputs: usize, scale: f64) {
    /// Of the surface's hidden unit in z.
    const SHARPNESS: f32 = 0.1;
    /// Of that unit in the density: opaque half a sample below the surface.
    const OPAQUENESS: f32 = 0.35;
    for tensor in start {
        let (count, factor) = match tensor.name.as_str() {
            "mlp.net0.weight" => (inputs, SHARPNESS),
            "mlp.net0.bias" => (1, SHARPNESS * scale as f32),
            "mlp.net1_density.weight" => (1, OPAQUENESS),
            _ => continue,
        };
        tensor.values[..count].iter_mut().for_each(|value| *value *= factor);
    }
}

/// Tensors of a whole checkpoint that are neither trained nor the encoder's: parts that were left out, the
/// encoder's unused token, buffers.
fn rest(
    config: &Config,
    source: &dyn TensorSource,
    learner: &PaperLearner<ReleasedMap>,
) -> Result<Vec<NamedTensor>, TrainError> {
    let trained = learner.generator.parameters();
    let known: std::collections::BTreeSet<&str> =
        trained.iter().chain(&learner.beside).map(|tensor| tensor.name.as_str()).collect();
    let mut list = Vec::new();
    for spec in expected(config) {
        if known.contains(spec.key.as_str()) {
            continue;
        }
        let values = match (source.read(&spec.key, &spec.shape), spec.need) {
            (Ok(values), _) => values,
            (Err(error), Need::Required) => return Err(error.into()),
            // The reference creates it and wants it back.
            (Err(_), Need::Optional) if spec.key.ends_with(".mask_token") => {
                vec![0.0; spec.values()]
            }
            (Err(_), _) => continue,
        };
        list.push(NamedTensor { name: spec.key, shape: spec.shape, values });
    }
    Ok(list)
}

impl<M: MapNetwork> PaperLearner<M> {
    /// Learns a generator made elsewhere, on an autodiff device; `config` is what [`Learner::export`] hands
    /// out.
    ///
    /// # Errors
    /// [`TrainError::Setting`].
    pub(crate) fn with_generator(
        generator: Generator<M>,
        shape: Shape,
        config: String,
        device: &burn::tensor::Device,
        settings: PaperSettings,
    ) -> Result<Self, TrainError> {
        settings.check()?;
        let enlarged = if generator.sharp.is_some() { shape.enlarged } else { 1 };
        let perceptual = settings.perceptual.open(device)?.map(|measure| -> Box<Distance> {
            Box::new(move |predicted, truth| measure.distance(predicted, truth).mean())
        });
        Ok(Self {
            beside: generator.map.frozen(),
            critics: Critics::new(&settings, enlarged, device),
            optimiser: AdamW::new(settings.generator),
            critics_optimiser: AdamW::new(settings.discriminator),
            average: Average::default(),
            fakes: Pictures::default(),
            crops: None,
            device: device.clone(),
            settings,
            shape,
            config,
            perceptual,
            generator,
        })
    }

    /// The settings.
    #[must_use]
    pub fn settings(&self) -> &PaperSettings {
        &self.settings
    }

    fn targets(&self, step: u64, batch: &[Example]) -> Result<Vec<Targets>, TrainError> {
        let enlarged = if self.generator.sharp.is_some() { self.shape.enlarged } else { 1 };
        let views = &self.settings.views;
        let sizes = Sizes { views, input: self.shape.image_side, enlarged };
        let target = |(image, example): (usize, &Example)| {
            let place = draw(self.settings.seed, step, Purpose::Camera, &[image as u64]);
            Targets::new(example, sizes, Look::random(views, place))
        };
        batch.iter().enumerate().map(target).collect()
    }

    fn generator_step(&mut self, step: u64, targets: &[Targets]) -> Result<Outcome, TrainError> {
        let seed = self.settings.seed;
        self.generator.map.name_step(draw(seed, step, Purpose::Positions, &[]).bits());
        let Judged { terms, rendered, statistics } = Objective {
            settings: &self.settings,
            shape: &self.shape,
            generator: &self.generator,
            critics: &self.critics,
            perceptual: self.perceptual.as_deref(),
            device: &self.device,
            step,
        }
        .judge(targets);
        let (total, logged) = match sum(terms)? {
            Ok(sums) => sums,
            Err(why) => return Ok(Outcome::Skipped(why)),
        };
        let gradients = total.backward();
        if !self.generator.finite(&gradients) {
            return Ok(Outcome::Skipped("a gradient of the generator is not finite".into()));
        }
        self.generator = self.generator.clone().step(&mut self.optimiser, &gradients, 1.0);
        self.generator.map = self.generator.map.clone().absorb(&statistics);
        self.generator.average(&mut self.average);
        if self.critics.any() {
            let window =
                random_window(&self.settings.views, draw(seed, step, Purpose::RealWindow, &[]));
            let crops = batch(targets.iter().map(|target| &target.satellite), &self.device);
            self.crops = Some(crop(crops, window, self.settings.views.ortho_window));
            self.fakes = rendered;
        }
        Ok(Outcome::Stepped(logged))
    }

    fn critics_step(&mut self, targets: &[Targets]) -> Result<Outcome, TrainError> {
        const NAMES: [&str; 3] =
            ["discriminator.satellite", "discriminator.panorama", "discriminator.perspective"];
        let streets: Vec<&StreetTargets> =
            targets.iter().filter_map(|target| target.street.as_ref()).collect();
        let street = |part: fn(&StreetTargets) -> &crate::tensor::Grid| {
            (!streets.is_empty())
                .then(|| batch(streets.iter().map(|street| part(street)), &self.device))
        };
        let reals = [
            self.crops.clone(),
            street(|street| &street.panorama),
            street(|street| &street.perspective),
        ];
        let game = self.settings.game();
        let penalty = self.settings.weights.gradient_penalty;
        // The power iteration moves even where the step is then skipped.
        let mut critics = self.critics.clone();
        let mut terms = Vec::new();
        for (view, real) in reals.into_iter().enumerate() {
            let (Some(critic), Some(fake), Some(real)) =
                (&mut critics.views[view], &self.fakes.views[view], real)
            else {
                continue;
            };
            let pass = critic.pass(true);
            let (of_real, slope) = if penalty > 0.0 {
                let (scores, slope) = pass.score_and_slope(real);
                (scores, Some(slope))
            } else {
                (pass.score(real), None)
            };
            let of_fake = critic.pass(true).score(fake.clone());
            let mut term = game.discriminator(of_real, of_fake);
            if let Some(slope) = slope {
                term = term + gradient_penalty(slope) * penalty;
            }
            terms.push((NAMES[view], term));
        }
        let (total, logged) = match sum(terms)? {
            Ok(sums) => sums,
            Err(why) => return Ok(Outcome::Skipped(why)),
        };
        let gradients = total.backward();
        if !critics.views.iter().flatten().all(|critic| finite(critic, &gradients)) {
            return Ok(Outcome::Skipped("a gradient of a discriminator is not finite".into()));
        }
        let mut views = Critics::NAMES.into_iter();
        self.critics.views = critics.views.map(|critic| {
            let name = views.next().unwrap_or_default();
            critic.map(|critic| self.critics_optimiser.step(name, critic, &gradients, 1.0))
        });
        self.generator.average(&mut self.average);
        Ok(Outcome::Stepped(logged))
    }
}

/// The sum of all terms, and their values; or why there is no such sum.
type Sum = Result<(Tensor<1>, Vec<Term>), String>;

fn sum(terms: Vec<(&'static str, Tensor<1>)>) -> Result<Sum, TrainError> {
    let mut logged = Vec::with_capacity(terms.len() + 1);
    let mut tensors = Vec::with_capacity(terms.len());
    for (name, tensor) in terms {
        let value = scalar(&tensor)?;
        if !value.is_finite() {
            return Ok(Err(format!("`{name}` is {value}")));
        }
        logged.push(Term { name, value });
        tensors.push(tensor);
    }
    if tensors.is_empty() {
        return Ok(Err("no term applies to this batch".into()));
    }
    let total = Tensor::cat(tensors, 0).sum();
    if !total.is_tracked() {
        return Ok(Err("no term of this batch depends on a weight".into()));
    }
    let value = scalar(&total)?;
    if !value.is_finite() {
        return Ok(Err(format!("the sum of the terms is {value}")));
    }
    logged.insert(0, Term { name: "total", value });
    Ok(Ok((total, logged)))
}

impl<M: MapNetwork> Learner for PaperLearner<M> {
    fn step(&mut self, step: u64, batch: &[Example]) -> Result<Outcome, TrainError> {
        if batch.is_empty() {
            return Ok(Outcome::Skipped("an empty batch".into()));
        }
        let targets = self.targets(step, batch)?;
        if step.is_multiple_of(2) || !self.critics.any() {
            self.generator_step(step, &targets)
        } else {
            self.critics_step(&targets)
        }
    }

    fn state(&self) -> Result<Vec<NamedTensor>, TrainError> {
        Ok(self.stored())
    }

    fn restore(&mut self, state: &[NamedTensor]) -> Result<(), TrainError> {
        self.put_back(state)
    }

    fn export(&self) -> Result<Exported, TrainError> {
        let whole = |tensors: Vec<NamedTensor>| {
            let mut tensors = self.generator.map.finished(tensors)?;
            tensors.extend(self.beside.iter().cloned());
            Ok::<_, TrainError>(tensors)
        };
        let model = whole(self.generator.parameters())?;
        // Before the first step there is nothing to average yet.
        let average = match self.average.updates() {
            0 => model.clone(),
            _ => whole(self.average.parameters())?,
        };
        Ok(Exported { config: self.config.clone(), model, average })
    }
}

#[cfg(test)]
mod tests;
