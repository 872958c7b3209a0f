//! What a resumed run needs, as a list of named tensors.

use super::super::TrainError;
use super::super::generator::MapNetwork;
use super::super::learner::NamedTensor;
use super::super::optimiser::{AdamW, Average, named_parameters, values};
use super::super::parameters::{Stored, below, with_parameters};
use super::objective::Pictures;
use super::{Critics, PaperLearner};
use burn::tensor::{Tensor, TensorData};

const WEIGHTS: &str = "weights/";
const AVERAGE: &str = "average/";
const UPDATES: &str = "average-updates";
const MOMENTS: &str = "optimiser/";
const CRITICS: &str = "discriminators/";
const ITERATIONS: &str = "power-iterations/";
const CRITICS_MOMENTS: &str = "discriminators-optimiser/";
const FAKES: &str = "rendered/";
const CROPS: &str = "true-crops";

impl<M: MapNetwork> PaperLearner<M> {
    pub(super) fn stored(&self) -> Vec<NamedTensor> {
        let mut list: Vec<NamedTensor> = below(WEIGHTS, self.generator.parameters()).collect();
        list.extend(below(AVERAGE, self.average.parameters()));
        // Two halves of 20 bits each are exact in f32.
        let updates = self.average.updates();
        list.push(NamedTensor {
            name: UPDATES.into(),
            shape: vec![2],
            values: vec![(updates >> 20) as f32, (updates & 0xF_FFFF) as f32],
        });
        list.extend(below(MOMENTS, self.optimiser.state()));
        for (name, critic) in Critics::NAMES.into_iter().zip(&self.critics.views) {
            let Some(critic) = critic else { continue };
            list.extend(below(CRITICS, named_parameters(name, critic)));
            list.extend(below(ITERATIONS, critic.buffers(name)));
        }
        list.extend(below(CRITICS_MOMENTS, self.critics_optimiser.state()));
        for (name, picture) in Critics::NAMES.into_iter().zip(&self.fakes.views) {
            list.extend(picture.as_ref().map(|picture| named(format!("{FAKES}{name}"), picture)));
        }
        list.extend(self.crops.as_ref().map(|crops| named(CROPS.into(), crops)));
        list
    }

    pub(super) fn put_back(&mut self, state: &[NamedTensor]) -> Result<(), TrainError> {
        let mut stored = Stored::new(state)?;
        let weights = stored.take_below(WEIGHTS);
        let mut weights = Stored::new(&weights)?;
        let generator = self.generator.clone().with(&mut weights)?;
        weights.done()?;

        let mut average = Average::default();
        let updates = match stored.take(UPDATES)?.values[..] {
            [high, low] => ((high as u64) << 20) + low as u64,
            _ => return Err(TrainError::State(format!("`{UPDATES}` needs two values"))),
        };
        let averages = stored.take_below(AVERAGE);
        same(&averages, &generator.parameters(), updates > 0)?;
        average.restore(updates, &averages, &self.device);
        let mut optimiser = AdamW::new(self.settings.generator);
        optimiser.restore(&stored.take_below(MOMENTS), &self.device)?;

        let mut critics = self.critics.clone();
        for (name, place) in Critics::NAMES.into_iter().zip(&mut critics.views) {
            let Some(critic) = place.take() else { continue };
            let parameters = stored.take_below(&format!("{CRITICS}{name}."));
            let parameters: Vec<NamedTensor> = below(&format!("{name}."), parameters).collect();
            let mut parameters = Stored::new(&parameters)?;
            let mut critic = with_parameters(name, critic, &mut parameters)?;
            parameters.done()?;
            let buffers = critic.buffers(name);
            let mut found = Vec::with_capacity(buffers.len());
            for buffer in buffers {
                let one = stored.take(&format!("{ITERATIONS}{}", buffer.name))?;
                if one.shape != buffer.shape {
                    let (shape, wanted) = (&one.shape, &buffer.shape);
                    let why = format!("`{}` is {shape:?}, the model's {wanted:?}", one.name);
                    return Err(TrainError::State(why));
                }
                found.push(one.clone());
            }
            critic.set_buffers(&found);
            *place = Some(critic);
        }
        let mut critics_optimiser = AdamW::new(self.settings.discriminator);
        critics_optimiser.restore(&stored.take_below(CRITICS_MOMENTS), &self.device)?;
        let mut fakes = Pictures::default();
        for (name, place) in Critics::NAMES.into_iter().zip(&mut fakes.views) {
            let found = stored.take_if_there(&format!("{FAKES}{name}"));
            *place = found.map(|tensor| self.picture(tensor)).transpose()?;
        }
        let crops = stored.take_if_there(CROPS).map(|tensor| self.picture(tensor)).transpose()?;
        stored.done()?;
        (self.generator, self.average, self.optimiser) = (generator, average, optimiser);
        (self.critics, self.critics_optimiser) = (critics, critics_optimiser);
        (self.fakes, self.crops) = (fakes, crops);
        Ok(())
    }

    fn picture(&self, tensor: &NamedTensor) -> Result<Tensor<4>, TrainError> {
        let Ok(shape) = <[usize; 4]>::try_from(tensor.shape.clone()) else {
            let why = format!("`{}` has the shape {:?}, not four axes", tensor.name, tensor.shape);
            return Err(TrainError::State(why));
        };
        Ok(Tensor::from_data(TensorData::new(tensor.values.clone(), shape), &self.device))
    }
}

fn named(name: String, tensor: &Tensor<4>) -> NamedTensor {
    let plain = tensor.clone().without_autodiff();
    NamedTensor { name, shape: plain.dims().to_vec(), values: values(&plain) }
}

/// That averages are those of these weights, or absent where nothing was averaged.
fn same(
    averages: &[NamedTensor],
    weights: &[NamedTensor],
    averaged: bool,
) -> Result<(), TrainError> {
    let mut found: Vec<(&str, &[usize])> =
        averages.iter().map(|tensor| (tensor.name.as_str(), &tensor.shape[..])).collect();
    let mut wanted: Vec<(&str, &[usize])> =
        weights.iter().map(|tensor| (tensor.name.as_str(), &tensor.shape[..])).collect();
    if !averaged {
        wanted.clear();
    }
    found.sort_unstable();
    wanted.sort_unstable();
    if found == wanted {
        return Ok(());
    }
    let odd = found.iter().find(|one| !wanted.contains(one));
    let odd = odd.or_else(|| wanted.iter().find(|one| !found.contains(one)));
    let name = odd.map_or("", |(name, _)| name);
    Err(TrainError::State(format!("the averages are not those of the weights, as of `{name}`")))
}
