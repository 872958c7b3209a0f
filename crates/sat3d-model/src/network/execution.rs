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

/// What is asked for; [`Execution::choose`] finds what serves it fastest.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Where.
    pub device: Device,
    /// By what; `None` takes the fastest there is.
    pub engine: Option<Engine>,
    /// How exactly; `None` takes the fastest whose bound on a DSM's error is within the tolerance.
    pub precision: Option<Precision>,
    /// Error of a DSM (95 % quantile) that may be made, in metres.
    pub tolerance_m: f64,
    /// Height of one cube unit in metres.
    pub metres_per_unit: f64,
}

impl Execution {
    /// The fastest that serves what is asked for on this machine.
    ///
    /// ```
    /// use sat3d_model::network::{Execution, Precision, Wanted};
    /// use sat3d_model::Device;
    ///
    /// let wanted = Wanted {
    ///     device: Device::Cpu,
    ///     engine: None,
    ///     precision: None,
    ///     tolerance_m: 0.0,
    ///     metres_per_unit: 32.24,
    /// };
    /// // Nothing may be lost.
    /// assert_eq!(Execution::choose(&wanted)?.precision, Precision::Fp32);
    /// # Ok::<(), sat3d_model::ModelError>(())
    /// ```
    ///
    /// # Errors
    /// [`ModelError::Device`] where what was named is not served here, with the reason.
    pub fn choose(wanted: &Wanted) -> Result<Self, ModelError> {
        let Wanted { device, engine, precision, .. } = *wanted;
        let burn = Self::from(device);
        let refused = |engine: Engine, precision: Precision| {
            Self { device, engine, precision }.refusal().map(|why| ModelError::Device {
                name: format!("{engine}, {precision} on {device}"),
                why,
            })
        };
        match (engine, precision) {
            (Some(engine), Some(precision)) => match refused(engine, precision) {
                Some(error) => Err(error),
                None => Ok(Self { device, engine, precision }),
            },
            (None, Some(precision)) => match refused(Engine::OneDnn, precision) {
                None => Ok(Self { device, engine: Engine::OneDnn, precision }),
                Some(_) if precision == Precision::Fp32 => Ok(burn),
                Some(error) => Err(error),
            },
            (Some(Engine::Burn), None) => Ok(burn),
            (engine, None) => {
                let engine_there = refused(Engine::OneDnn, Precision::Fp32);
                if let Some(error) = engine_there {
                    return if engine.is_some() { Err(error) } else { Ok(burn) };
                }
                let within = |precision: &Precision| {
                    let error = precision.bound().p95 * wanted.metres_per_unit;
                    error <= wanted.tolerance_m && refused(Engine::OneDnn, *precision).is_none()
                };
                let precision = by_speed().into_iter().find(within).unwrap_or_default();
                Ok(Self { device, engine: Engine::OneDnn, precision })
            }
        }
    }

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
        Wanted {
            device: Device::Cpu,
            engine: None,
            precision: None,
            tolerance_m,
            metres_per_unit: 64.48,
        }
    }

    #[test]
    fn the_bound_of_what_is_chosen_is_within_the_tolerance() {
        for tolerance_m in [0.0, 1e-4, 1e-3, 0.01, 0.1, 1.0, 2.0] {
            let chosen =
                Execution::choose(&wanted(tolerance_m)).expect("something is always there");
            assert!(chosen.precision.bound().p95 * 64.48 <= tolerance_m, "{chosen}");
            assert_eq!(chosen.refusal(), None);
        }
    }

    #[test]
    fn what_is_named_is_taken_or_refused_with_the_reason() {
        let burn = Wanted { engine: Some(Engine::Burn), ..wanted(10.0) };
        assert_eq!(Execution::choose(&burn).expect("always there"), Device::Cpu.into());
        let halves = Wanted { precision: Some(Precision::Bf16), ..burn };
        let error = Execution::choose(&halves).expect_err("burn has none").to_string();
        assert!(error.contains("burn, bf16 on cpu") && error.contains("oneDNN serves"), "{error}");
        let card =
            Wanted { device: Device::Cuda(0), precision: Some(Precision::Bf16), ..wanted(0.0) };
        let error = Execution::choose(&card).expect_err("oneDNN has no card").to_string();
        assert!(error.contains("--device cpu"), "{error}");
        // A card is burn's, whatever the tolerance.
        let card = Wanted { device: Device::Cuda(0), ..wanted(10.0) };
        assert_eq!(Execution::choose(&card).expect("burn"), Device::Cuda(0).into());
        let exact = Wanted { precision: Some(Precision::Fp32), ..wanted(10.0) };
        assert_eq!(Execution::choose(&exact).expect("always there").precision, Precision::Fp32);
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
