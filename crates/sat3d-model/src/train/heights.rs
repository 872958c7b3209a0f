//! Direct supervision: the small network learns the true heights of simulated cities.
//!
//! The plane's first channel is the height of the surface and the line's first channel is z, so that one
//! hidden unit of the head, `softplus(k (surface - z))`, is a field with that surface: it starts as flat
//! ground and stays a height field, without floaters by construction. The loss looks at that channel on
//! every texel; nothing needs to be rendered. The other channels carry colour.

use super::error::TrainError;
use super::example::{Class, Example};
use super::learner::{Exported, Learner, NamedTensor, Outcome, Term};
use super::losses::height::{class_entropy, smooth_l1, symlog};
use super::mini::{self, MiniHead, MiniSettings};
use super::optimiser::{
    AdamW, AdamWSettings, Average, Named, ParameterGradients, named_parameters, values,
};
use crate::config::Config;
use crate::network::Device;
use crate::network::loader::Loader;
use crate::network::unet::{Mode, Statistics, UNet, absorb};
use crate::preprocess::satellite;
use crate::weights::TensorSource;
use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Bool, Int, Tensor, TensorData};
use serde::{Deserialize, Serialize};

/// Parts of a batch that are learnt from side by side. Each has its own batch norm statistics.
const PARTS: usize = 2;
/// Where the smooth L1 distance of logarithms turns from a parabola into a line.
const LOGARITHM_KNEE: f64 = 0.2;

/// Settings of [`HeightLearner`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HeightSettings {
    /// Steps of the whole run: the learning rate falls to nothing over them, as a cosine.
    pub steps: u64,
    /// Steps over which the learning rate rises at the start.
    pub warm_up: u64,
    /// The optimiser.
    pub optimiser: AdamWSettings,
    /// Weight of the smooth L1 distance of logarithms of heights over the ground: what stands on it can be
    /// seen from above, how the ground lies mostly not.
    pub logarithm: f64,
    /// Weight of the distance in metres, reached at half of the steps.
    pub metric: f64,
    /// Difference of heights in metres above which the metric distance grows linearly.
    pub metric_knee: f64,
    /// Weight of the cross-entropy of the surface's class.
    pub classes: f64,
    /// Weight of the distance in steepness: of differences between neighbouring pixels, metres.
    pub slope: f64,
    /// Weight of the distance in colour.
    pub colour: f64,
    /// Share of a batch in the running statistics of the norms.
    pub momentum: f64,
}

impl Default for HeightSettings {
    fn default() -> Self {
        Self {
            steps: 10_000,
            warm_up: 200,
            optimiser: AdamWSettings {
                learning_rate: 2e-3,
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-8,
                weight_decay: 0.01,
            },
            logarithm: 1.0,
            metric: 0.3,
            metric_knee: 4.0,
            classes: 0.2,
            slope: 0.05,
            colour: 0.5,
            momentum: 0.05,
        }
    }
}

/// Seed, device, weights and moments.
pub struct HeightLearner {
    settings: HeightSettings,
    mini: MiniSettings,
    config: Config,
    device: burn::tensor::Device,
    network: UNet,
    head: MiniHead,
    optimiser: AdamW,
    average: Average,
}

impl HeightLearner {
    /// A learner with fresh weights.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for sizes that make no network; [`TrainError::Model`] for a device that
    /// the program was built without.
    pub fn new(
        mini: MiniSettings,
        settings: HeightSettings,
        device: Device,
        seed: u64,
    ) -> Result<Self, TrainError> {
        if settings.steps == 0 {
            let why = "at least 1".into();
            return Err(TrainError::Setting { key: "steps", value: "0".into(), why });
        }
        let config = mini.config(Class::COUNT)?;
        let device = device.open()?.autodiff();
        let (network, head) = Self::load(&config, mini::fresh(&config, seed), &device)?;
        let optimiser = AdamW::new(settings.optimiser);
        Ok(Self {
            settings,
            mini,
            config,
            device,
            network,
            head,
            optimiser,
            average: Average::default(),
        })
    }

    /// Begins with the weights of another training's state, norms and all, and with nothing else of it.
    ///
    /// # Errors
    /// [`TrainError::State`] where the state holds no weights, those of the model where they are of another size.
    pub fn begin_with(&mut self, state: &[NamedTensor]) -> Result<(), TrainError> {
        let weights = below(state, "weights/");
        if weights.is_empty() {
            return Err(TrainError::State("no weights of a small network".into()));
        }
        (self.network, self.head) = Self::load(&self.config, weights, &self.device)?;
        Ok(())
    }

    /// Begins with a finished model. Its norms are folded into its convolutions and stay there; the channels that
    /// only training looks at begin anew.
    ///
    /// # Errors
    /// [`TrainError::State`] for another network, [`TrainError::Model`] where the source has not the tensors of
    /// this one.
    pub fn begin_with_model(
        &mut self,
        config: &Config,
        source: &dyn TensorSource,
    ) -> Result<(), TrainError> {
        let wanted = self.mini.config(0)?;
        if *config != wanted {
            let sizes = |config: &Config| match &config.unet {
                Some(unet) => format!(
                    "{unet:?}, {} channels, a head of {}",
                    config.plane_channels, config.head_hidden
                ),
                None => "not a small network".to_owned(),
            };
            let (found, wanted) = (sizes(config), sizes(&wanted));
            return Err(TrainError::State(format!("{found}, where the settings say {wanted}")));
        }
        let weights = mini::unfinished(&wanted, &self.config, source, &self.weights())?;
        (self.network, self.head) = Self::load(&self.config, weights, &self.device)?;
        Ok(())
    }

    /// A network with norms where the weights have them.
    fn load(
        config: &Config,
        weights: Vec<NamedTensor>,
        device: &burn::tensor::Device,
    ) -> Result<(UNet, MiniHead), TrainError> {
        let normed = weights.iter().any(|tensor| tensor.name.contains(".norm."));
        let source = &Named::new(weights);
        let loader = Loader::new(source, device);
        let Some(unet) = &config.unet else {
            return Err(TrainError::State("not a small network".into()));
        };
        let (channels, pad) = (config.plane_channels, config.pad_tokens());
        let network = UNet::load(&loader.child("unet"), unet, channels, pad, normed)?;
        Ok((network, MiniHead::load(&loader.child("mlp"), config)?))
    }

    /// Rises linearly, then falls as a cosine.
    fn rate(&self, step: u64) -> f64 {
        let (step, steps) = (step as f64, self.settings.steps as f64);
        let warm = self.settings.warm_up as f64;
        let rise = if warm > 0.0 { ((step + 1.0) / warm).min(1.0) } else { 1.0 };
        let share = (step / steps).min(1.0);
        rise * 0.5 * (1.0 + libm::cos(std::f64::consts::PI * share))
    }

    /// Weighted terms of one part of a batch.
    fn losses(
        &self,
        (network, head): (&UNet, &MiniHead),
        step: u64,
        batch: &Batch,
        statistics: &mut Statistics,
    ) -> Vec<(&'static str, Tensor<1>)> {
        let settings = &self.settings;
        let channels = self.config.plane_channels;
        let planes = network.planes(batch.images.clone(), Mode::Train(statistics));
        let planes = crop(planes, self.config.pad_tokens());
        let mut terms = Vec::new();

        let height = planes.clone().narrow(1, 0, 1) * mini::HEIGHT_UNIT_M;
        let known = batch.unknown.clone();
        let mean = |values: Tensor<4>| values.mask_fill(known.clone(), 0.0).sum() / batch.known;
        let difference = height.clone() - batch.heights.clone();
        if settings.logarithm > 0.0 {
            let distance = symlog(height) - symlog(batch.objects.clone());
            let distance = smooth_l1(distance, LOGARITHM_KNEE);
            terms.push(("logarithm", mean(distance) * settings.logarithm));
        }
        if settings.metric > 0.0 {
            let ramp = (2.0 * step as f64 / settings.steps as f64).min(1.0);
            let weight = settings.metric * (0.1 + 0.9 * ramp);
            let distance = smooth_l1(difference.clone(), settings.metric_knee);
            terms.push(("metric", mean(distance) * weight));
        }
        if settings.slope > 0.0 {
            let masked = difference.mask_fill(known.clone(), 0.0);
            let steep = |axis: usize| {
                let length = masked.dims()[axis];
                let next = masked.clone().narrow(axis, 1, length - 1);
                (next - masked.clone().narrow(axis, 0, length - 1)).abs().sum() / batch.known
            };
            terms.push(("slope", (steep(2) + steep(3)) * settings.slope));
        }
        if settings.classes > 0.0 {
            let logits = planes.clone().narrow(1, channels, Class::COUNT);
            let entropy = class_entropy(logits, batch.classes.clone(), &[]);
            terms.push(("classes", entropy * settings.classes));
        }
        if settings.colour > 0.0 {
            // One texel of sixteen, another one in each step: the head at all of them would take
            // longer than the network. Colour has no say in the heights.
            let some = |map: Tensor<4>| one_of_sixteen(map, step);
            let features = some(planes.narrow(1, 0, channels));
            let surface = features.clone().narrow(1, 0, 1).detach();
            let others = features.narrow(1, 1, channels - 1);
            let features = Tensor::cat(vec![surface, others], 1);
            let line = network.line().detach();
            let colour = head.colour(features, line, some(batch.surface.clone()));
            let distance = (colour - some(batch.colours.clone())).abs().mean();
            terms.push(("colour", distance * settings.colour));
        }
        terms
    }

    /// Terms and gradients of one part of a batch, which is `share` of it.
    fn part(&self, step: u64, examples: &[Example], share: f64) -> Result<Part, TrainError> {
        let batch = Batch::new(examples, &self.config, &self.device)?;
        // Parameters of its own: graphs that share one also share a lock, and two threads would wait for
        // each other.
        let (network, head) = (own(self.network.clone()), own(self.head.clone()));
        let mut statistics = Statistics::new();
        let mut terms = Vec::new();
        let mut total: Option<Tensor<1>> = None;
        for (name, term) in self.losses((&network, &head), step, &batch, &mut statistics) {
            let term = term * share;
            let value = values(&term.clone().without_autodiff());
            terms.push(Term { name, value: value.first().copied().unwrap_or(f32::NAN) });
            total = Some(match total {
                Some(total) => total + term,
                None => term,
            });
        }
        let gradients = total.map_or_else(ParameterGradients::default, |total| {
            let gradients = total.backward();
            let network = ParameterGradients::of("unet", &network, &gradients);
            network.plus(ParameterGradients::of("mlp", &head, &gradients))
        });
        Ok(Part { terms, gradients, statistics: vec![statistics] })
    }
}

/// The module with parameters of its own. Not [`Module::fork`]: that leaves an entry with every parameter it copies
/// for as long as the original lives, and those that no loss reaches live for the whole training.
fn own<M: Module>(module: M) -> M {
    struct Own;
    impl ModuleMapper for Own {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            param.map(|value| {
                let learns = value.is_require_grad();
                value.detach().set_require_grad(learns)
            })
        }
    }
    module.map(&mut Own)
}

/// The tensors whose names begin so; the beginning is cut off.
fn below(state: &[NamedTensor], root: &str) -> Vec<NamedTensor> {
    let under = |tensor: &NamedTensor| {
        let name = tensor.name.strip_prefix(root)?.to_owned();
        Some(NamedTensor { name, ..tensor.clone() })
    };
    state.iter().filter_map(under).collect()
}

/// What a part of a batch says.
struct Part {
    terms: Vec<Term>,
    gradients: ParameterGradients,
    statistics: Vec<Statistics>,
}

/// What a thread returned; its panic is ours.
fn join<T>(thread: std::thread::ScopedJoinHandle<'_, T>) -> T {
    thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

impl Learner for HeightLearner {
    fn step(&mut self, step: u64, batch: &[Example]) -> Result<Outcome, TrainError> {
        // Most of `burn`'s operations run on one core: two parts of the batch keep two cores busy. Always as many
        // parts, so that the result does not depend on the machine.
        let learner = &*self;
        let share = |part: &[Example]| part.len() as f64 / batch.len() as f64;
        let parts: Vec<Result<Part, TrainError>> = std::thread::scope(|scope| {
            let learn = |part| move || learner.part(step, part, share(part));
            let threads: Vec<_> = batch
                .chunks(batch.len().div_ceil(PARTS).max(1))
                .map(|part| scope.spawn(learn(part)))
                .collect();
            threads.into_iter().map(join).collect()
        });
        let mut sum = Part {
            terms: Vec::new(),
            gradients: ParameterGradients::default(),
            statistics: Vec::new(),
        };
        for part in parts {
            let Part { terms, gradients, statistics } = part?;
            if sum.terms.is_empty() {
                sum.terms = terms;
            } else {
                for (sum, term) in sum.terms.iter_mut().zip(terms) {
                    sum.value += term.value;
                }
            }
            sum.gradients = sum.gradients.plus(gradients);
            sum.statistics.extend(statistics);
        }
        if sum.terms.is_empty() {
            return Ok(Outcome::Skipped("every loss is switched off".into()));
        }
        let total = sum.terms.iter().map(|term| term.value).sum();
        sum.terms.insert(0, Term { name: "total", value: total });
        if !total.is_finite() {
            return Ok(Outcome::Skipped(format!("a loss of {total}")));
        }
        if !sum.gradients.finite() {
            return Ok(Outcome::Skipped("a gradient that is not finite".into()));
        }
        let rate = self.rate(step);
        let network = self.optimiser.apply("unet", self.network.clone(), &sum.gradients, rate);
        let momentum = self.settings.momentum / sum.statistics.len().max(1) as f64;
        self.network = sum
            .statistics
            .iter()
            .fold(network, |network, statistics| absorb(network, statistics, momentum));
        self.head = self.optimiser.apply("mlp", self.head.clone(), &sum.gradients, rate);
        self.average.update("unet", &self.network);
        self.average.update("mlp", &self.head);
        self.average.advance();
        Ok(Outcome::Stepped(sum.terms))
    }

    fn state(&self) -> Result<Vec<NamedTensor>, TrainError> {
        let under = |root: &str, list: Vec<NamedTensor>| {
            let root = root.to_owned();
            list.into_iter().map(move |mut tensor| {
                tensor.name = format!("{root}/{}", tensor.name);
                tensor
            })
        };
        let mut state: Vec<NamedTensor> = under("weights", self.weights()).collect();
        state.extend(under("moments", self.optimiser.state()));
        state.extend(under("average", self.average.parameters()));
        state.push(NamedTensor {
            name: "average_updates".into(),
            shape: vec![2],
            values: [self.average.updates() >> 20, self.average.updates() & 0xF_FFFF]
                .map(|half| half as f32)
                .to_vec(),
        });
        Ok(state)
    }

    fn restore(&mut self, state: &[NamedTensor]) -> Result<(), TrainError> {
        let updates = state
            .iter()
            .find(|tensor| tensor.name == "average_updates" && tensor.values.len() == 2)
            .ok_or_else(|| TrainError::State("`average_updates` is missing".into()))?;
        let updates = ((updates.values[0] as u64) << 20) + updates.values[1] as u64;
        let weights = below(state, "weights/");
        let (network, head) = Self::load(&self.config, weights, &self.device)?;
        self.optimiser.restore(&below(state, "moments/"), &self.device)?;
        (self.network, self.head) = (network, head);
        self.average.restore(updates, &below(state, "average/"), &self.device);
        Ok(())
    }

    fn export(&self) -> Result<Exported, TrainError> {
        let average = match self.average.updates() {
            0 => self.weights(),
            _ => self.average.parameters(),
        };
        Ok(Exported {
            config: self.mini.json(0),
            model: mini::finished(&self.config, self.weights())?,
            average: mini::finished(&self.config, average)?,
        })
    }
}

impl HeightLearner {
    fn weights(&self) -> Vec<NamedTensor> {
        let mut list = named_parameters("unet", &self.network);
        list.extend(named_parameters("mlp", &self.head));
        list
    }
}

/// A batch as tensors, `S/2` texels to a side under an image of `S` pixels.
struct Batch {
    /// `B x 3 x S x S`, normalised.
    images: Tensor<4>,
    /// `B x 1 x S/2 x S/2`, metres, 0 where unknown.
    heights: Tensor<4>,
    /// The same over the ground.
    objects: Tensor<4>,
    /// Where the height is *not* known.
    unknown: Tensor<4, Bool>,
    /// Number of texels where it is, at least 1.
    known: f64,
    /// Class of each texel.
    classes: Tensor<4, Int>,
    /// z of the surface in the cube.
    surface: Tensor<4>,
    /// `B x 3 x S/2 x S/2`, [0, 1].
    colours: Tensor<4>,
}

impl Batch {
    fn new(
        examples: &[Example],
        config: &Config,
        device: &burn::tensor::Device,
    ) -> Result<Self, TrainError> {
        let side = config.image_side();
        let half = side / 2;
        let area = side * side;
        let count = examples.len();
        let mut images = Vec::with_capacity(3 * area * count);
        let texels = half * half * count;
        let mut heights = Vec::with_capacity(texels);
        let mut objects = Vec::with_capacity(texels);
        let mut unknown = Vec::with_capacity(texels);
        let mut classes = Vec::with_capacity(texels);
        let mut surface = Vec::with_capacity(texels);
        let mut colours = Vec::with_capacity(3 * texels);
        for example in examples {
            let fails = |what: String| TrainError::Example { example: example.name.clone(), what };
            let Some(truth) = &example.truth else {
                return Err(fails("direct supervision needs true heights, and it has none".into()));
            };
            let found = [
                truth.surface.width,
                truth.surface.height,
                example.satellite.width,
                example.satellite.height,
            ];
            if found != [side; 4] || truth.classes.len() != area || truth.ground.data.len() != area
            {
                return Err(fails(format!(
                    "heights of {} x {}, image of {} x {}, {} classes, where all have to be {side} x {side}",
                    found[0],
                    found[1],
                    found[2],
                    found[3],
                    truth.classes.len()
                )));
            }
            images.extend(satellite(&example.satellite, side)?.data);
            let four = |values: &[f32], first: usize| {
                0.25 * (values[first]
                    + values[first + 1]
                    + values[first + side]
                    + values[first + side + 1])
            };
            for row in 0..half {
                for column in 0..half {
                    let first = 2 * (row * side + column);
                    // Not finite where one of the four pixels is not.
                    let metres = four(&truth.surface.data, first);
                    let over = metres - four(&truth.ground.data, first);
                    let known = metres.is_finite() && over.is_finite();
                    heights.push(if known { metres } else { 0.0 });
                    objects.push(if known { over } else { 0.0 });
                    unknown.push(!known);
                    classes.push(truth.classes[first] as i32);
                    surface.push(mini::z_of(if known { metres } else { 0.0 }));
                }
            }
            for channel in 0..3 {
                for row in 0..half {
                    for column in 0..half {
                        let at = |d: usize| {
                            f32::from(
                                example.satellite.data
                                    [3 * (2 * row * side + 2 * column + d) + channel],
                            )
                        };
                        colours.push((at(0) + at(1) + at(side) + at(side + 1)) / (4.0 * 255.0));
                    }
                }
            }
        }
        let known = unknown.iter().filter(|unknown| !**unknown).count().max(1) as f64;
        let grid = |values: Vec<f32>, channels: usize, side: usize| {
            Tensor::from_data(TensorData::new(values, [count, channels, side, side]), device)
        };
        let shape = [count, 1, half, half];
        Ok(Self {
            images: grid(images, 3, side),
            heights: grid(heights, 1, half),
            objects: grid(objects, 1, half),
            unknown: Tensor::from_data(TensorData::new(unknown, shape), device),
            known,
            classes: Tensor::from_data(TensorData::new(classes, shape), device),
            surface: grid(surface, 1, half),
            colours: grid(colours, 3, half),
        })
    }
}

/// The texels under the image: those of the padding are cut off.
fn crop(planes: Tensor<4>, pad_tokens: usize) -> Tensor<4> {
    let margin = pad_tokens * crate::network::UNET_STEM * crate::network::UNET_TEXELS;
    let [_, _, rows, columns] = planes.dims();
    planes.narrow(2, margin, rows - 2 * margin).narrow(3, margin, columns - 2 * margin)
}

/// Every fourth row and column, beginning where the step says.
fn one_of_sixteen(map: Tensor<4>, step: u64) -> Tensor<4> {
    let [batch, channels, rows, columns] = map.dims();
    let (row, column) = ((step % 4) as usize, (step / 4 % 4) as usize);
    let map: Tensor<6> = map.reshape([batch, channels, rows / 4, 4, columns / 4, 4]);
    map.narrow(3, row, 1).narrow(5, column, 1).reshape([batch, channels, rows / 4, columns / 4])
}

#[cfg(test)]
mod tests;
