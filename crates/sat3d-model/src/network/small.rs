//! The small network behind the family's interface.

use super::burned::{check, check_length, download};
use super::loader::Loader;
use super::unet::{Mode, UNet};
use super::{Device, Network};
use crate::config::{Config, HISTOGRAM, SKY_SEED, UNetConfig};
use crate::error::ModelError;
use crate::tensor::Grid;
use crate::weights::TensorSource;
use burn::tensor::{Tensor, TensorData};
use std::sync::{Mutex, OnceLock, PoisonError};

/// The small network on one device. Its weights are read when they are first needed.
pub struct SmallNetwork {
    config: Config,
    unet: UNetConfig,
    source: Box<dyn TensorSource>,
    device: burn::tensor::Device,
    loaded: OnceLock<UNet>,
    loading: Mutex<()>,
}

impl std::fmt::Debug for SmallNetwork {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("SmallNetwork").field("config", &self.unet).finish_non_exhaustive()
    }
}

impl SmallNetwork {
    /// A network whose weights are still at their source.
    ///
    /// # Errors
    /// [`ModelError::Device`] where the device was left out of this program.
    pub(crate) fn new(
        config: Config,
        unet: UNetConfig,
        source: Box<dyn TensorSource>,
        device: Device,
    ) -> Result<Self, ModelError> {
        let device = device.open()?;
        Ok(Self { config, unet, source, device, loaded: OnceLock::new(), loading: Mutex::new(()) })
    }

    fn network(&self) -> Result<&UNet, ModelError> {
        if let Some(network) = self.loaded.get() {
            return Ok(network);
        }
        // The lock guards no data: a panic elsewhere has left nothing half done.
        let _loading = self.loading.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(network) = self.loaded.get() {
            return Ok(network);
        }
        let place = Loader::new(self.source.as_ref(), &self.device).child("unet");
        let (channels, pad) = (self.config.plane_channels, self.config.pad_tokens());
        let network = UNet::load(&place, &self.unet, channels, pad, false)?;
        Ok(self.loaded.get_or_init(|| network))
    }
}

impl Network for SmallNetwork {
    fn map(&self, image: &Grid) -> Result<Grid, ModelError> {
        let side = self.config.image_side();
        check("image", image, [3, side, side])?;
        let data = TensorData::new(image.data.clone(), [1, 3, side, side]);
        let network = self.network()?;
        let planes = network.planes(Tensor::from_data(data, &self.device), Mode::Evaluate);
        let [_, _, rows, columns] = planes.dims();
        let channels = self.config.plane_channels;
        let planes = planes.narrow(1, 0, channels);
        // The reader takes the mean over rows, so the line stands in every one.
        let line: Tensor<4> = network.line().reshape([1, channels, 1, columns]);
        let line = line.expand([1, channels, rows, columns]);
        download("small network", Tensor::cat(vec![planes, line], 1))
    }

    /// The mean colour of the sky, [0, 1].
    fn style(&self, histogram: &[f32]) -> Result<Vec<f32>, ModelError> {
        check_length("illumination histogram", histogram, HISTOGRAM)?;
        let bins = HISTOGRAM / 3;
        Ok(histogram
            .chunks_exact(bins)
            .map(|shares| {
                // The histogram leaves out the lowest tenth of 100 bins.
                let value = |bin: usize| (bin as f64 + 10.5) / 100.0;
                let sum: f64 = shares.iter().map(|share| f64::from(*share)).sum();
                let mean: f64 = shares
                    .iter()
                    .enumerate()
                    .map(|(bin, share)| value(bin) * f64::from(*share))
                    .sum();
                if sum > 0.0 { (mean / sum) as f32 } else { 0.0 }
            })
            .collect())
    }

    /// That colour everywhere above the horizon (and 10 degrees below).
    fn sky(&self, style: &[f32]) -> Result<Grid, ModelError> {
        check_length("style code", style, self.config.style)?;
        let (side, width) = (SKY_SEED, self.config.sky_width());
        let row =
            |color: f32| (0..width).map(move |column| if column < side { color } else { 0.0 });
        let data = style.iter().flat_map(|color| (0..side).flat_map(move |_| row(*color)));
        Ok(Grid::new(style.len(), side, width, data.collect()))
    }

    fn super_resolve(&self, _features: &Grid) -> Result<Grid, ModelError> {
        let why = "the small model has none".into();
        Err(ModelError::Absent { part: "super-resolution", why })
    }
}
