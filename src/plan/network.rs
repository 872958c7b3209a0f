//! The step that says how the network is calculated.

use super::{Bound, Step};
use crate::model::Device;
use crate::model::network::{Engine, Execution, Precision, Wanted};

/// The step of a network that runs so, or (`None`) of inputs that need none.
pub(crate) fn precision_step(execution: Option<Execution>, wanted: &Wanted) -> Step {
    let form = execution.map_or_else(|| "no network".to_owned(), |execution| kind(&execution));
    let Execution { engine, precision, .. } = execution.unwrap_or_default();
    let named = wanted.engine.is_some() || wanted.precision.is_some();
    let reason = match (execution, engine) {
        (None, _) => "the inputs are scenes already".to_owned(),
        _ if named => "as --engine and --precision say".to_owned(),
        (_, Engine::OneDnn) => format!(
            "the fastest here whose bound is within --tolerance {} m (at 64.48 m per unit)",
            wanted.tolerance_m
        ),
        (_, Engine::Burn) => "what every machine and every network can".to_owned(),
    };
    let cost = match precision {
        Precision::Fp32 => "every product in 32 bits",
        Precision::Fp32Winograd => {
            "a quarter of the products of a 3 x 3 convolution, and sums around them"
        }
        Precision::Bf16 => "products of 16-bit floats, sums in 32 bits",
    };
    Step {
        id: "precision".into(),
        on: execution.is_some(),
        form,
        // Measured on made-up weights, harder ones among them.
        bound: Bound::vertical(precision.bound().p95_m),
        cost: cost.into(),
        cause: "products and sums are rounded".into(),
        reason,
    }
}

/// What bytes depend on: not on a device's number.
pub(crate) fn kind(execution: &Execution) -> String {
    let device = device_kind(execution.device);
    format!("{} by {} on {device}", execution.precision, execution.engine)
}

/// A device without its number.
pub(crate) const fn device_kind(device: Device) -> &'static str {
    match device {
        Device::Cpu => "cpu",
        Device::Cuda(_) => "cuda",
        Device::Wgpu => "wgpu",
    }
}
