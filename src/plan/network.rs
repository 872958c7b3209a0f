//! The step that says how the network is calculated.

use super::{Bound, Step};
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::Device;
use crate::model::network::{Engine, Execution, Precision, Wanted};

/// How much larger an error of height comes out, in metres, than at the published scale, at which
/// the model crate states it.
fn stretch(metres_per_unit: f64) -> f64 {
    metres_per_unit / (TRAINING_WIDTH_M / 2.0)
}

/// What to ask of the model crate so that the tolerance holds at so many metres per cube unit.
pub(crate) fn at_scale(wanted: &Wanted, metres_per_unit: f64) -> Wanted {
    Wanted { tolerance_m: wanted.tolerance_m / stretch(metres_per_unit), ..*wanted }
}

/// The step of a network that runs so, or (`None`) of inputs that need none, for heights of so many
/// metres per cube unit.
pub(crate) fn precision_step(
    execution: Option<Execution>,
    wanted: &Wanted,
    metres_per_unit: f64,
) -> Step {
    let form = execution.map_or_else(|| "no network".to_owned(), |execution| kind(&execution));
    let Execution { engine, precision, .. } = execution.unwrap_or_default();
    let named = wanted.engine.is_some() || wanted.precision.is_some();
    let reason = match (execution, engine) {
        (None, _) => "the inputs are scenes already".to_owned(),
        _ if named => "as --engine and --precision say".to_owned(),
        (_, Engine::OneDnn) => format!(
            "the fastest here whose bound is within --tolerance {} m (at {:.2} m per unit)",
            wanted.tolerance_m,
            2.0 * metres_per_unit
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
        bound: Bound::vertical(precision.bound().p95_m * stretch(metres_per_unit)),
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
