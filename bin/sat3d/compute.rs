//! Where, by what and how exactly the network is calculated: options that several commands share.

use sat3d::model::Device;
use sat3d::model::network::{Engine, Precision, Wanted};
use sat3d::model::weights::PackedWeights;
use std::path::PathBuf;
use std::str::FromStr;

/// The options.
#[derive(clap::Args, Debug)]
pub struct ComputeArgs {
    /// Where the network runs: cpu, cuda, cuda:<number>, wgpu
    #[arg(long, value_name = "DEVICE", default_value_t = Device::Cpu)]
    device: Device,
    /// What calculates it: auto, burn, onednn (where libdnnl 2.6 is installed)
    #[arg(long, value_name = "ENGINE", default_value = "auto")]
    engine: Choice<Engine>,
    /// Precision of the network: auto, fp32, fp32-winograd, bf16. Auto takes the fastest within --tolerance
    #[arg(long, value_name = "PRECISION", default_value = "auto")]
    precision: Choice<Precision>,
    /// Error of the heights that auto may make, metres (95 % quantile, at 64.48 m per unit)
    #[arg(long, value_name = "M", default_value_t = Wanted::TOLERANCE_M, value_parser = metres, allow_negative_numbers = true)]
    tolerance: f64,
}

impl ComputeArgs {
    /// What is asked for.
    pub fn wanted(&self) -> Wanted {
        Wanted {
            device: self.device,
            engine: self.engine.0,
            precision: self.precision.0,
            tolerance_m: self.tolerance,
        }
    }
}

/// Where weights are kept as the network wants them.
#[derive(clap::Args, Debug)]
pub struct PackedArgs {
    /// Keep the weights here as fp32-winograd packs them, so that later runs begin a second sooner (full network: 1.1 GB)
    #[arg(long, value_name = "DIR")]
    pub packed_weights: Option<PathBuf>,
}

/// Says after a run why packed weights could not be kept.
pub fn warn_of(packed: Option<&PackedWeights>) {
    if let Some(why) = packed.and_then(PackedWeights::failure) {
        tracing::warn!("packed weights were not kept, and the next run packs them again: {why}");
    }
}

/// A value, or `auto`.
#[derive(Clone, Copy, Debug)]
struct Choice<T>(Option<T>);

impl<T: FromStr> FromStr for Choice<T> {
    type Err = T::Err;

    fn from_str(text: &str) -> Result<Self, T::Err> {
        match text {
            "auto" => Ok(Self(None)),
            named => named.parse().map(|value| Self(Some(value))),
        }
    }
}

fn metres(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(metres) if metres.is_finite() && metres >= 0.0 => Ok(metres),
        _ => Err("a number of metres, 0 or more".into()),
    }
}
