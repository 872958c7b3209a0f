//! Inference: engine and precision of the large network.

use super::clock::{Findings, Judged, Subject, Way};
use super::rays::downtown;
use super::report::{Quantity, Skipped};
use super::truth::{quantile, rms};
use super::{Setup, TradeoffError};
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::field::{Field, FieldInputs};
use crate::model::network::{Engine, Execution, Precision};
use crate::model::render::{RenderOptions, dsm};
use crate::model::weights::point_head;
use crate::model::weights::rule::{RuleWeights, full_overrides};
use crate::model::{Config, Device, Grid, preprocess};

pub(super) const CAUSE: &str = "products and sums are rounded";

/// Every engine with every precision that this machine serves.
pub(super) fn precision(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let config = Config::released();
    let side = config.image_side();
    let image = preprocess::satellite(&downtown(side)?, side)?;
    let head = point_head(&config, &RuleWeights::new(&config, full_overrides()))?;
    let heights = |map: &Grid| -> Result<Vec<f32>, TradeoffError> {
        let inputs = FieldInputs {
            map: map.clone(),
            representation: config.representation,
            activation: config.activation,
            scale: config.scale as f32,
        };
        let surface = dsm(&Field::new(&inputs, &head, None)?, 256, &RenderOptions::default());
        Ok(surface.height.iter().map(|h| (f64::from(*h) * TRAINING_WIDTH_M) as f32).collect())
    };
    let burn = Execution { device: Device::Cpu, engine: Engine::Burn, precision: Precision::Fp32 };
    let mut executions = vec![burn];
    executions.extend(Precision::ALL.map(|precision| Execution {
        device: Device::Cpu,
        engine: Engine::OneDnn,
        precision,
    }));
    let mut skipped = Vec::new();
    let mut ways = Vec::new();
    let default = crate::model::network::Wanted::default().choose(&config)?;
    for execution in executions {
        if let Some(reason) = execution.refusal() {
            skipped.push(Skipped { name: execution.to_string(), reason });
            continue;
        }
        let weights = RuleWeights::new(&config, full_overrides());
        let network = execution.network(config.clone(), Box::new(weights))?;
        let image = &image;
        ways.push(Way::new(execution.to_string(), execution == default, move || {
            Ok((execution.precision, network.map(image)?))
        }));
    }
    let subject = Subject {
        truth: "32-bit floats by burn, the first setting; the weights are made up by rule",
        error: Quantity::new("95 % quantile of the height error", "m"),
        work: "encoder and decoder for one image of 256 x 256 px".into(),
        units: 1.0,
    };
    let mut truth: Option<Vec<f32>> = None;
    let mut switch = setup.clock.measure(subject, ways, |(precision, map)| {
        let heights = heights(map)?;
        let truth = truth.get_or_insert_with(|| heights.clone());
        let judged = Judged::new(quantile(&heights, truth, 0.95)).also(
            "RMS height error",
            "m",
            rms(&heights, truth),
        );
        Ok(match precision {
            Precision::Fp32 => judged,
            lower => judged.bounded(lower.bound().p95_m),
        })
    })?;
    switch.skipped.extend(skipped);
    Ok(switch)
}
