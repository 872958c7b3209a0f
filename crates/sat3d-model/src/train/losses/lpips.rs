//! Learned perceptual image patch similarity over VGG16 (Zhang et al., "The unreasonable effectiveness of deep
//! features as a perceptual metric", 2018), as the package `lpips` 0.1.4 computes it with `net="vgg"`.
//!
//! No weights are shipped. They are two files that the user has, or one, in safetensors, of 32 or 16 bit floats:
//!
//! * VGG16 with the keys of torchvision's state dictionary: `features.N.weight` and `features.N.bias` for `N` of 0,
//!   2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28 (the classifier's tensors may be there and are not read);
//! * the five linear layers with the keys of the package's `weights/v0.1/vgg.pth`: `lin0.model.1.weight` to
//!   `lin4.model.1.weight`, each `1 x channels x 1 x 1`.
//!
//! `docs/losses.md` has the six lines of Python that write them.

use super::safe::root;
use crate::error::{Mismatch, ModelError};
use crate::weights::MappedFile;
use burn::tensor::ops::{ConvOptions, MaxPoolOptions};
use burn::tensor::{Device, Tensor, TensorData, activation, module};
use std::path::Path;

/// Place of each convolution in VGG16's `features`, in the five groups whose outputs are compared.
const GROUPS: [&[usize]; 5] = [&[0, 2], &[5, 7], &[10, 12, 14], &[17, 19, 21], &[24, 26, 28]];

/// Red, green and blue of a picture in [-1, 1] become `(value - shift) / scale`, the range that VGG16 was
/// trained with.
const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];
/// See [`SHIFT`].
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];

/// Added to the length of a feature vector that is divided by.
const EPSILON: f64 = 1e-10;

/// The measure with its weights, which are constants.
#[derive(Clone, Debug)]
pub struct Lpips {
    groups: Vec<Group>,
}

#[derive(Clone, Debug)]
struct Group {
    /// Weights and biases of 3 x 3 convolutions.
    convolutions: Vec<(Tensor<4>, Tensor<1>)>,
    /// `1 x channels x 1 x 1`.
    linear: Tensor<4>,
}

impl Lpips {
    /// Reads the weights from one file or several; a key is taken from the first file that has it. The numbers of
    /// channels are those of the file (64 to 512 in VGG16).
    ///
    /// # Errors
    /// Of a file that cannot be read, [`ModelError::Io`] and [`ModelError::Damaged`]; [`ModelError::Tensors`] lists every
    /// key that is missing or does not fit (under the first file's name, if it is in none).
    pub fn read(files: &[&Path], device: &Device) -> Result<Self, ModelError> {
        let open = |path: &&Path| MappedFile::open(path);
        let files = files.iter().map(open).collect::<Result<Vec<_>, _>>()?;
        let reader = Reader { files, device };
        let mut missing = Mismatch::default();
        for (index, group) in (0..).zip(GROUPS) {
            let keys = group.iter().flat_map(|n| ["weight", "bias"].map(|part| feature(*n, part)));
            let absent = keys.chain([linear(index)]).filter(|key| reader.holder(key).is_none());
            missing.missing.extend(absent);
        }
        reader.complain(missing)?;
        let mut channels = 3;
        let mut groups = Vec::with_capacity(GROUPS.len());
        for (index, places) in (0..).zip(GROUPS) {
            let mut convolutions = Vec::with_capacity(places.len());
            for place in places {
                let key = feature(*place, "weight");
                let outputs = reader.shape(&key).first().copied().unwrap_or(0);
                let weight = reader.read(&key, [outputs, channels, 3, 3])?;
                let bias = reader.read(&feature(*place, "bias"), [outputs])?;
                convolutions.push((weight, bias));
                channels = outputs;
            }
            let linear = reader.read(&linear(index), [1, channels, 1, 1])?;
            groups.push(Group { convolutions, linear });
        }
        Ok(Self { groups })
    }

    /// As [`Lpips::read`], on the device of a learner.
    ///
    /// # Errors
    /// Those of [`Lpips::read`]; [`ModelError::Device`] for a device that the program was built without.
    pub fn for_learner(files: &[&Path], device: crate::Device) -> Result<Self, ModelError> {
        Self::read(files, &device.open()?.autodiff())
    }

    /// Distance of each pair of pictures in [-1, 1], `batch x 3 x height x width`, to `[batch]`: the features of
    /// each group's last layer, brought to length 1 at every place, their squared difference weighted by the
    /// linear layer and averaged over the places; summed over the five groups.
    ///
    /// # Panics
    /// On pictures smaller than 16 x 16, of which the last group sees nothing.
    #[must_use]
    pub fn distance(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<1> {
        let batch = first.dims()[0];
        let [mut a, mut b] = [first, second].map(normalised);
        let mut total: Option<Tensor<4>> = None;
        for (index, group) in self.groups.iter().enumerate() {
            [a, b] = [a, b].map(|features| group.forward(features, index > 0));
            let difference = unit(a.clone()) - unit(b.clone());
            let weighted = difference.clone() * difference * group.linear.clone();
            let part = weighted.sum_dim(1).mean_dims(&[2, 3]);
            total = Some(match total {
                Some(sum) => sum + part,
                None => part,
            });
        }
        match total {
            Some(total) => total.reshape([batch]),
            None => a.sum_dims(&[1, 2, 3]).reshape([batch]) * 0.0,
        }
    }

    /// The same weights in another number format, for tests in `f64`.
    #[cfg(test)]
    fn cast(self, dtype: burn::tensor::FloatDType) -> Self {
        let groups = self.groups.into_iter().map(|group| Group {
            convolutions: group
                .convolutions
                .into_iter()
                .map(|(weight, bias)| (weight.cast(dtype), bias.cast(dtype)))
                .collect(),
            linear: group.linear.cast(dtype),
        });
        Self { groups: groups.collect() }
    }
}

impl Group {
    fn forward(&self, mut features: Tensor<4>, pool: bool) -> Tensor<4> {
        if pool {
            let halves = MaxPoolOptions::new([2, 2]).with_stride([2, 2]);
            features = module::max_pool2d(features, halves);
        }
        for (weight, bias) in &self.convolutions {
            let same = ConvOptions::new([1, 1], [1, 1], [1, 1], 1);
            let bias = Some(bias.clone());
            features = activation::relu(module::conv2d(features, weight.clone(), bias, same));
        }
        features
    }
}

fn feature(place: usize, part: &str) -> String {
    format!("features.{place}.{part}")
}

fn linear(group: usize) -> String {
    format!("lin{group}.model.1.weight")
}

fn normalised(picture: Tensor<4>) -> Tensor<4> {
    let constants = |values: [f64; 3]| {
        let options = (&picture.device(), picture.dtype());
        Tensor::<4>::from_data(TensorData::new(values.to_vec(), [1, 3, 1, 1]), options)
    };
    (picture.clone() - constants(SHIFT)) / constants(SCALE)
}

/// Each place's feature vector at length 1; one of length 0 stays, and gets no gradient through its length.
fn unit(features: Tensor<4>) -> Tensor<4> {
    let length = root((features.clone() * features.clone()).sum_dim(1));
    features / (length + EPSILON)
}

/// Files beside each other.
struct Reader<'a> {
    files: Vec<MappedFile>,
    device: &'a Device,
}

impl Reader<'_> {
    fn holder(&self, key: &str) -> Option<&MappedFile> {
        self.files.iter().find(|file| file.shape(key).is_some())
    }

    fn shape(&self, key: &str) -> &[usize] {
        self.holder(key).and_then(|file| file.shape(key)).unwrap_or_default()
    }

    fn complain(&self, mismatch: Mismatch) -> Result<(), ModelError> {
        if mismatch.is_empty() {
            return Ok(());
        }
        let path = self.files.first().map(|file| file.path().to_path_buf()).unwrap_or_default();
        Err(ModelError::Tensors { path, mismatch: Box::new(mismatch) })
    }

    fn read<const D: usize>(&self, key: &str, shape: [usize; D]) -> Result<Tensor<D>, ModelError> {
        let Some(file) = self.holder(key) else {
            let missing = vec![key.to_owned()];
            self.complain(Mismatch { missing, ..Mismatch::default() })?;
            return Ok(Tensor::zeros(shape, self.device));
        };
        let values = file.read(key, &shape)?;
        Ok(Tensor::from_data(TensorData::new(values, shape), self.device))
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(super) use tests::narrow_weights;
