//! In what precision the network calculates, and what that costs in accuracy.

use crate::error::ModelError;
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// How convolutions and dense layers are calculated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// 32-bit floats, as it is written.
    #[default]
    Fp32,
    /// 32-bit floats, 3 x 3 convolutions by Winograd's algorithm: fewer multiplications, a little less exact.
    Fp32Winograd,
    /// 16-bit floats (8 bits of fraction) multiplied, 32-bit floats added; maps stay in 32 bits.
    Bf16,
}

/// Bounds of a precision's error against direct 32-bit floats. Those of tokens and planes are held to the published parity
/// data; those of a DSM also hold for weights with outliers
/// ([`crate::weights::rule::RuleWeights::with_outliers`]), on which 16-bit floats lose three times as much.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PrecisionBound {
    /// Relative L2 error of the tokens.
    pub tokens: f64,
    /// Relative L2 error of the planes.
    pub planes: f64,
    /// Mean error of a DSM in metres, at 64.48 m per unit of its heights (VIGOR's crops by the published scoring).
    pub mean_m: f64,
    /// Its 95 % quantile.
    pub p95_m: f64,
}

impl Precision {
    /// All of them, the most exact first.
    pub const ALL: [Self; 3] = [Self::Fp32, Self::Fp32Winograd, Self::Bf16];

    /// Its name, as `--precision` takes it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp32Winograd => "fp32-winograd",
            Self::Bf16 => "bf16",
        }
    }

    /// What it may cost.
    #[must_use]
    pub const fn bound(self) -> PrecisionBound {
        match self {
            Self::Fp32 => PrecisionBound { tokens: 1e-5, planes: 3e-5, mean_m: 0.0, p95_m: 0.0 },
            Self::Fp32Winograd => {
                PrecisionBound { tokens: 1e-5, planes: 1e-4, mean_m: 0.001, p95_m: 0.005 }
            }
            Self::Bf16 => PrecisionBound { tokens: 1e-2, planes: 3e-2, mean_m: 0.6, p95_m: 2.5 },
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        let found = Self::ALL.into_iter().find(|precision| precision.name() == name);
        found.ok_or_else(|| ModelError::Device {
            name: name.into(),
            why: "unknown precision; one of fp32, fp32-winograd, bf16".into(),
        })
    }
}
