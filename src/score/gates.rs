//! What a small model has to reach before it is part of the program.

use super::Report;
use super::measures::{Measure, ScoreSet};
use serde::Serialize;

/// One condition.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gate {
    /// What is held against the limit.
    pub name: &'static str,
    /// What it came to; NaN (`null` in JSON) where nothing was measured.
    pub value: f64,
    /// What it has to stay under.
    pub limit: f64,
    /// Whether it does.
    pub passed: bool,
}

/// The conditions: RMSE under 1.8 m and under half of flat ground, mesh within 10 % of the DSM, floaters under
/// 2 % of the columns, all four for the worst seed; and heights of buildings clearly better than the best
/// constant: the upper end of the ratio's interval over all scenes is under 1.
#[must_use]
pub fn gates(report: &Report) -> Vec<Gate> {
    let worst = |measure| {
        let values = report.seeds.iter().map(|set: &ScoreSet| set.score(measure).value);
        // NaN is the worst of all, and none at all is NaN.
        values.fold(
            f64::NEG_INFINITY,
            |a, b| if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) },
        )
    };
    let gate = |name, value: f64, limit| Gate { name, value, limit, passed: value < limit };
    vec![
        gate("DSM: RMSE, m (worst seed)", worst(Measure::DsmRmseM), 1.8),
        gate("DSM: RMSE / flat ground (worst seed)", worst(Measure::DsmOfFlat), 0.5),
        gate(
            "buildings: error / best constant (upper end of the interval)",
            report.all.score(Measure::BuildingOfConstant).high,
            1.0,
        ),
        gate("mesh: RMSE / DSM (worst seed)", worst(Measure::MeshOfDsm), 1.1),
        gate("floaters: % of the columns (worst seed)", worst(Measure::FloatersPct), 2.0),
    ]
}
