//! Where, by what and how exactly the network is calculated.

use super::{BurnNetwork, Device, Precision, StagedNetwork};
use crate::config::Config;
use crate::error::ModelError;
use crate::weights::TensorSource;
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// What calculates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Engine {
    /// burn: every device, every machine, direct 32-bit floats.
    #[default]
    Burn,
    /// The processor's vector units through oneDNN, where the machine has that library.
    OneDnn,
}

impl Engine {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Burn, Self::OneDnn];

    /// Its name, as `--engine` takes it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Burn => "burn",
            Self::OneDnn => "onednn",
        }
    }
}

impl fmt::Display for Engine {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

impl FromStr for Engine {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        let found = Self::ALL.into_iter().find(|engine| engine.name() == name);
        found.ok_or_else(|| ModelError::Device {
            name: name.into(),
            why: "unknown engine; one of burn, onednn".into(),
        })
    }
}

/// Device, engine and precision that fit each other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Execution {
    /// Where.
    pub device: Device,
    /// By what.
    pub engine: Engine,
    /// How exactly.
    pub precision: Precision,
}

impl From<Device> for Execution {
    /// By burn in direct 32-bit floats, which every machine can.
    fn from(device: Device) -> Self {
        Self { device, ..Self::default() }
    }
}

/// What is asked for; [`Wanted::choose`] finds what serves it fastest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    /// Where.
    pub device: Device,
    /// By what; `None` takes the fastest there is.
    pub engine: Option<Engine>,
    /// How exactly; `None` takes the fastest whose bound on a DSM's error is within the tolerance.
    pub precision: Option<Precision>,
    /// Error of a DSM (95 % quantile, at 64.48 m per unit) that may be made, in metres.
    pub tolerance_m: f64,
}

impl Default for Wanted {
    /// The processor, the fastest that is within [`Wanted::TOLERANCE_M`].
    fn default() -> Self {
        Self { device: Device::Cpu, engine: None, precision: None, tolerance_m: Self::TOLERANCE_M }
    }
}

impl Wanted {
    /// What a DSM may lose where nothing else is said: a fiftieth of the 2.5 m within which the published scoring
    /// counts a height as right.
    pub const TOLERANCE_M: f64 = 0.05;

    /// The fastest that serves what is asked for on this machine, for this network.
    ///
    /// ```
    /// use sat3d_model::network::{Precision, Wanted};
    /// use sat3d_model::Config;
    ///
    /// // Nothing may be lost.
    /// let wanted = Wanted { tolerance_m: 0.0, ..Wanted::default() };
    /// assert_eq!(wanted.choose(&Config::released())?.precision, Precision::Fp32);
    /// # Ok::<(), sat3d_model::ModelError>(())
    /// ```
    ///
    /// # Errors
    /// [`ModelError::Device`] where what was named is not served here, with the reason.
    pub fn choose(&self, config: &Config) -> Result<Execution, ModelError> {
        let Self { device, engine, precision, tolerance_m } = *self;
        let burn = Execution::from(device);
        let of = |engine, precision| {
            let execution = Execution { device, engine, precision };
            match execution.refusal() {
                Some(why) => Err(ModelError::Device { name: execution.to_string(), why }),
                None => Ok(execution),
            }
        };
        if config.unet.is_some() {
            let (engine, precision) = (engine.unwrap_or_default(), precision.unwrap_or_default());
            let wanted = Execution { device, engine, precision };
            let why = "the small network is calculated in 32-bit floats by burn: leave --engine and --precision out";
            return if wanted == burn {
                Ok(burn)
            } else {
                Err(ModelError::Device { name: wanted.to_string(), why: why.into() })
            };
        }
        match (engine, precision) {
            (Some(engine), Some(precision)) => of(engine, precision),
            (Some(Engine::Burn), None) => Ok(burn),
            (None, Some(Precision::Fp32)) => {
                Ok(of(Engine::OneDnn, Precision::Fp32).unwrap_or(burn))
            }
            (None, Some(precision)) => of(Engine::OneDnn, precision),
            (engine, None) => {
                let exact = of(Engine::OneDnn, Precision::Fp32);
                if exact.is_err() && engine.is_none() {
                    return Ok(burn);
                }
                let within = |precision: &Precision| precision.bound().p95_m <= tolerance_m;
                let fitting = by_speed().into_iter().filter(within);
                let mut served = fitting.filter_map(|precision| of(Engine::OneDnn, precision).ok());
                served.next().map_or(exact, Ok)
            }
        }
    }
}

impl Execution {
    /// Why this machine, or this program, does not serve it; `None` where it does.
    #[must_use]
    pub fn refusal(&self) -> Option<String> {
        let Self { device, engine, precision } = *self;
        match engine {
            Engine::Burn if precision != Precision::Fp32 => {
                Some("burn calculates in direct 32-bit floats; oneDNN serves the others".into())
            }
            Engine::Burn => None,
            Engine::OneDnn if device != Device::Cpu => {
                Some("oneDNN calculates on the processor: --device cpu".into())
            }
            #[cfg(feature = "onednn")]
            Engine::OneDnn => super::onednn::refusal(precision),
            #[cfg(not(feature = "onednn"))]
            Engine::OneDnn => {
                Some("this program was built without it; build it with `--features onednn`".into())
            }
        }
    }

    /// The large network, whose weights are still at their source.
    ///
    /// # Errors
    /// [`ModelError::Device`] for what is not served here.
    pub fn network(
        &self,
        config: Config,
        source: Box<dyn TensorSource>,
    ) -> Result<Box<dyn StagedNetwork>, ModelError> {
        if let Some(why) = self.refusal() {
            return Err(ModelError::Device { name: self.to_string(), why });
        }
        Ok(match self.engine {
            #[cfg(feature = "onednn")]
            Engine::OneDnn => Box::new(super::OneDnnNetwork::new(config, source, self.precision)?),
            _ => Box::new(BurnNetwork::new(config, source, self.device)?),
        })
    }
}

impl fmt::Display for Execution {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} by {} on {}", self.precision, self.engine, self.device)
    }
}

/// The fastest first: 16-bit floats only where the processor multiplies tiles of them.
fn by_speed() -> Vec<Precision> {
    #[cfg(feature = "onednn")]
    if super::onednn::has_tiles() {
        return vec![Precision::Bf16, Precision::Fp32Winograd, Precision::Fp32];
    }
    vec![Precision::Fp32Winograd, Precision::Fp32]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(tolerance_m: f64) -> Wanted {
        Wanted { tolerance_m, ..Wanted::default() }
    }

    fn choose(wanted: Wanted) -> Result<Execution, ModelError> {
        wanted.choose(&Config::released())
    }

    #[test]
    fn the_bound_of_what_is_chosen_is_within_the_tolerance() {
        for tolerance_m in [0.0, 1e-4, 1e-3, 0.01, 0.1, 1.0, 2.0] {
            let chosen = choose(wanted(tolerance_m)).expect("something is always there");
            assert!(chosen.precision.bound().p95_m <= tolerance_m, "{chosen}");
            assert_eq!(chosen.refusal(), None);
        }
    }

    #[test]
    fn what_is_named_is_taken_or_refused_with_the_reason() {
        let burn = Wanted { engine: Some(Engine::Burn), ..wanted(10.0) };
        assert_eq!(choose(burn).expect("always there"), Device::Cpu.into());
        let halves = Wanted { precision: Some(Precision::Bf16), ..burn };
        let error = choose(halves).expect_err("burn has none").to_string();
        assert!(
            error.contains("bf16 by burn on cpu") && error.contains("oneDNN serves"),
            "{error}"
        );
        let halves = Some(Precision::Bf16);
        let card = Wanted { device: Device::Cuda(0), precision: halves, ..wanted(0.0) };
        let error = choose(card).expect_err("oneDNN has no card").to_string();
        assert!(error.contains("--device cpu"), "{error}");
        // A card is burn's, whatever the tolerance.
        let card = Wanted { device: Device::Cuda(0), ..wanted(10.0) };
        assert_eq!(choose(card).expect("burn"), Device::Cuda(0).into());
        let exact = Wanted { precision: Some(Precision::Fp32), ..wanted(10.0) };
        assert_eq!(choose(exact).expect("always there").precision, Precision::Fp32);
    }

    #[test]
    fn the_small_network_has_one_way() {
        let small = Config::from_json(crate::weights::MINI.config).expect("a config");
        for engine in [None, Some(Engine::Burn)] {
            let wanted = Wanted { engine, ..wanted(10.0) };
            assert_eq!(wanted.choose(&small).expect("burn"), Device::Cpu.into());
        }
        let wanted = Wanted { precision: Some(Precision::Bf16), ..wanted(10.0) };
        let error = wanted.choose(&small).expect_err("not served").to_string();
        assert!(error.contains("small network"), "{error}");
    }

    #[test]
    fn names_are_read_back() {
        for engine in Engine::ALL {
            assert_eq!(engine.to_string().parse::<Engine>().expect("a name"), engine);
        }
        for precision in Precision::ALL {
            assert_eq!(precision.to_string().parse::<Precision>().expect("a name"), precision);
        }
        assert!("mkl".parse::<Engine>().is_err() && "fp64".parse::<Precision>().is_err());
    }
}
