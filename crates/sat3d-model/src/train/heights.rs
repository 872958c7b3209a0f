//! Direct supervision: the small network learns the true heights of simulated cities.
//!
//! The plane's first channel is the height of the surface and the line's first channel is z, so that one
//! hidden unit of the head, `softplus(k (surface - z))`, is a field with that surface: it starts as flat
//! ground and stays a height field, without floaters by construction. The loss looks at that channel on
//! every texel; nothing needs to be rendered. The other channels carry colour.

use super::error::TrainError;
use super::example::{Class, Example};
use super::learner::{Exported, Learner, NamedTensor, Outcome, Term};
use super::mini::{self, MiniHead, MiniSettings};
use super::optimiser::{AdamW, AdamWSettings, Average, Named, finite, named_parameters, values};
use crate::config::Config;
use crate::network::Device;
use crate::network::loader::Loader;
use crate::network::unet::{Mode, Statistics, UNet, absorb};
use crate::preprocess::satellite;
use burn::tensor::{Bool, Int, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};

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
        let fresh = Named::new(mini::fresh(&config, seed));
        let (network, head) = Self::load(&config, &fresh, &device)?;
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

    fn load(
        config: &Config,
        source: &Named,
        device: &burn::tensor::Device,
    ) -> Result<(UNet, MiniHead), TrainError> {
        let loader = Loader::new(source, device);
        let Some(unet) = &config.unet else {
            return Err(TrainError::State("not a small network".into()));
        };
        let (channels, pad) = (config.plane_channels, config.pad_tokens());
        let network = UNet::load(&loader.child("unet"), unet, channels, pad, true)?;
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

    fn losses(
        &self,
        step: u64,
        batch: &Batch,
        statistics: &mut Statistics,
    ) -> Vec<(&'static str, Tensor<1>)> {
        let settings = &self.settings;
        let channels = self.config.plane_channels;
        let planes = self.network.planes(batch.images.clone(), Mode::Train(statistics));
        let planes = crop(planes, self.config.pad_tokens());
        let [count, _, rows, columns] = planes.dims();
        let mut terms = Vec::new();

        let height = double(planes.clone().narrow(1, 0, 1)) * mini::HEIGHT_UNIT_M;
        let truth = batch.heights.clone();
        let known = batch.unknown.clone();
        let total = batch.count_known;
        let mean = |values: Tensor<4>| values.mask_fill(known.clone(), 0.0).sum() / total;
        let difference = height.clone() - truth.clone();
        if settings.logarithm > 0.0 {
            let distance = symlog(height.clone()) - symlog(batch.objects.clone());
            terms.push(("logarithm", mean(smooth_l1(distance, 0.2)) * settings.logarithm));
        }
        if settings.metric > 0.0 {
            let ramp = (2.0 * step as f64 / settings.steps as f64).min(1.0);
            let weight = settings.metric * (0.1 + 0.9 * ramp);
            terms.push((
                "metric",
                mean(smooth_l1(difference.clone(), settings.metric_knee)) * weight,
            ));
        }
        if settings.slope > 0.0 {
            let of = |axis: usize, values: Tensor<4>| {
                let length = values.dims()[axis];
                let next = values.clone().narrow(axis, 1, length - 1);
                next - values.narrow(axis, 0, length - 1)
            };
            let masked = difference.mask_fill(known.clone(), 0.0);
            let steep = [2, 3].map(|axis| of(axis, masked.clone()).abs().sum() / total);
            let [down, across] = steep;
            terms.push(("slope", (down + across) * settings.slope));
        }
        if settings.classes > 0.0 {
            let logits = planes.clone().narrow(1, channels, Class::COUNT);
            let likelihood = activation::log_softmax(logits, 1);
            let chosen = likelihood.gather(1, batch.classes.clone());
            let mean = chosen.sum() / (count * rows * columns) as f64;
            terms.push(("classes", -mean * settings.classes));
        }
        if settings.colour > 0.0 {
            // One texel of sixteen, another one in each step: the head at all of them would take
            // longer than the network. Colour has no say in the heights.
            let some = |map: Tensor<4>| one_of_sixteen(map, step);
            let features = some(planes.narrow(1, 0, channels));
            let surface = features.clone().narrow(1, 0, 1).detach();
            let others = features.narrow(1, 1, channels - 1);
            let features = Tensor::cat(vec![surface, others], 1);
            let line = self.network.line().detach();
            let colour = self.head.colour(features, line, some(batch.surface.clone()));
            let distance = (colour - some(batch.colours.clone())).abs().mean();
            terms.push(("colour", distance * settings.colour));
        }
        terms
    }
}

impl Learner for HeightLearner {
    fn step(&mut self, step: u64, batch: &[Example]) -> Result<Outcome, TrainError> {
        let batch = Batch::new(batch, &self.config, &self.device)?;
        let mut statistics = Statistics::new();
        let terms = self.losses(step, &batch, &mut statistics);
        let mut logged = Vec::with_capacity(terms.len() + 1);
        let mut total: Option<Tensor<1>> = None;
        for (name, term) in terms {
            let value = values(&term.clone().without_autodiff());
            logged.push(Term { name, value: value.first().copied().unwrap_or(f32::NAN) });
            total = Some(match total {
                Some(total) => total + term,
                None => term,
            });
        }
        let Some(total) = total else {
            return Ok(Outcome::Skipped("every loss is switched off".into()));
        };
        let sum = logged.iter().map(|term| term.value).sum();
        logged.insert(0, Term { name: "total", value: sum });
        if !sum.is_finite() {
            return Ok(Outcome::Skipped(format!("a loss of {sum}")));
        }
        let gradients = total.backward();
        if !finite(&self.network, &gradients) || !finite(&self.head, &gradients) {
            return Ok(Outcome::Skipped("a gradient that is not finite".into()));
        }
        let rate = self.rate(step);
        let network = self.optimiser.step("unet", self.network.clone(), &gradients, rate);
        self.network = absorb(network, &statistics, self.settings.momentum);
        self.head = self.optimiser.step("mlp", self.head.clone(), &gradients, rate);
        self.average.update("unet", &self.network);
        self.average.update("mlp", &self.head);
        self.average.advance();
        Ok(Outcome::Stepped(logged))
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
        let below = |root: &str| -> Vec<NamedTensor> {
            let prefix = format!("{root}/");
            state
                .iter()
                .filter_map(|tensor| {
                    let name = tensor.name.strip_prefix(&prefix)?;
                    Some(NamedTensor { name: name.to_owned(), ..tensor.clone() })
                })
                .collect()
        };
        let updates = state
            .iter()
            .find(|tensor| tensor.name == "average_updates" && tensor.values.len() == 2)
            .ok_or_else(|| TrainError::State("`average_updates` is missing".into()))?;
        let updates = ((updates.values[0] as u64) << 20) + updates.values[1] as u64;
        let weights = Named::new(below("weights"));
        let (network, head) = Self::load(&self.config, &weights, &self.device)?;
        self.optimiser.restore(&below("moments"), &self.device)?;
        (self.network, self.head) = (network, head);
        self.average.restore(updates, &below("average"), &self.device);
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

/// A batch as tensors.
struct Batch {
    /// `B x 3 x S x S`, normalised.
    images: Tensor<4>,
    /// `B x 1 x S x S`, metres, 0 where unknown.
    heights: Tensor<4>,
    /// The same over the ground.
    objects: Tensor<4>,
    /// Where the height is *not* known.
    unknown: Tensor<4, Bool>,
    count_known: f64,
    /// `B x 1 x S/2 x S/2`: class of each texel.
    classes: Tensor<4, Int>,
    /// `B x 1 x S/2 x S/2`: z of the surface in the cube.
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
        let mut heights = Vec::with_capacity(area * count);
        let mut objects = Vec::with_capacity(area * count);
        let mut unknown = Vec::with_capacity(area * count);
        let mut classes = Vec::with_capacity(half * half * count);
        let mut surface = Vec::with_capacity(half * half * count);
        let mut colours = Vec::with_capacity(3 * half * half * count);
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
            let metres = &truth.surface.data;
            heights.extend(metres.iter().map(|h| if h.is_finite() { *h } else { 0.0 }));
            let over =
                metres.iter().zip(&truth.ground.data).map(|(surface, ground)| surface - ground);
            objects.extend(over.map(|h| if h.is_finite() { h } else { 0.0 }));
            unknown.extend(metres.iter().map(|h| !h.is_finite()));
            for row in 0..half {
                for column in 0..half {
                    let places = [0, 1, side, side + 1].map(|d| 2 * row * side + 2 * column + d);
                    // Of four pixels the one that differs least from both extremes is none; the first will do.
                    classes.push(truth.classes[places[0]] as i32);
                    let mean =
                        places.iter().map(|p| metres[*p]).filter(|h| h.is_finite()).sum::<f32>()
                            / 4.0;
                    surface.push(mini::z_of(mean));
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
        let count_known = unknown.iter().filter(|unknown| !**unknown).count().max(1) as f64;
        let grid = |values: Vec<f32>, channels: usize, side: usize| {
            Tensor::from_data(TensorData::new(values, [count, channels, side, side]), device)
        };
        Ok(Self {
            images: grid(images, 3, side),
            heights: grid(heights, 1, side),
            objects: grid(objects, 1, side),
            unknown: Tensor::from_data(TensorData::new(unknown, [count, 1, side, side]), device),
            count_known,
            classes: Tensor::from_data(TensorData::new(classes, [count, 1, half, half]), device),
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

/// Twice the size, bilinearly (pixels are areas), zeros around: as the field reads its plane.
fn double(map: Tensor<4>) -> Tensor<4> {
    let along = |map: Tensor<4>, axis: usize| {
        let dims = map.dims();
        let length = dims[axis];
        let edge = map.zeros_like().narrow(axis, 0, 1);
        let before = Tensor::cat(vec![edge.clone(), map.clone().narrow(axis, 0, length - 1)], axis);
        let after = Tensor::cat(vec![map.clone().narrow(axis, 1, length - 1), edge], axis);
        let even = map.clone() * 0.75 + before * 0.25;
        let odd = map * 0.75 + after * 0.25;
        let mut doubled = dims;
        doubled[axis] *= 2;
        // Interleaved: a new axis of two behind this one.
        let pairs: Tensor<5> = Tensor::stack(vec![even, odd], axis + 1);
        pairs.reshape(doubled)
    };
    along(along(map, 2), 3)
}

/// `sign(h) log(1 + |h|)`.
fn symlog(height: Tensor<4>) -> Tensor<4> {
    height.clone().sign() * height.abs().log1p()
}

/// `d^2 / 2 knee` below the knee, `|d| - knee / 2` above.
fn smooth_l1(difference: Tensor<4>, knee: f64) -> Tensor<4> {
    let size = difference.abs();
    let inside = size.clone().clamp_max(knee);
    inside.clone() * inside.clone() / (2.0 * knee) + (size - inside)
}
