//! What accuracy costs in time: error against truth and time, for every switch of the program.
//!
//! | module | what happens there |
//! |---|---|
//! | [`studies`](Stage) | which switches there are, stage by stage |
//! | `warp`, `bench` | benchmark build: transforms, kernels, coverage, storage |
//! | `scoring` | evaluation: protocols, offsets, resizing, bootstrap |
//! | `rays`, `stopping`, `network` | inference: quadrature, DSM size, early stop, engine and precision |
//! | `city` | tiling: stride, blend, trim, lattice |
//! | `clock` | interleaved, warm measurements of time |
//! | [`Report`] | what was found; as a table, CSV, JSON, HTML |
//!
//! Every switch has a truth of its own: a simulated scene, a closed form, or a slow exact way. All ways of one
//! switch do the same work in the same process, in turns.
//!
//! This module stands beside `recipe`: it calls what subcommands call, and none of them knows it.

mod bench;
mod chart;
mod city;
mod clock;
mod machine;
mod network;
mod page;
mod rays;
mod report;
mod scoring;
mod stopping;
mod table;
mod truth;
mod warp;

pub use machine::Machine;
pub use page::html;
pub use report::{Also, Quantity, Report, Seconds, Setting, Skipped, Switch};
pub use table::{csv, table};

use crate::batch::{Interrupt, Progress};
use crate::crs::CrsError;
use crate::dsm_bench::BenchError;
use crate::eval::align::AlignError;
use crate::lidar::WarpError;
use crate::model::ModelError;
use crate::model::field::FieldError;
use crate::plan::{Bound, Plan, Step};
use crate::raster::RasterError;
use crate::raster::npz::NpzError;
use crate::scene::SceneError;
use crate::tile::TileError;
use crate::weights::WeightsError;
use clock::{Clock, Findings};
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::path::PathBuf;
use std::time::Instant;

/// A part of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// `sat3d dsm-bench build`.
    Build,
    /// `sat3d eval`.
    Eval,
    /// `sat3d infer`.
    Infer,
    /// `sat3d tile`.
    Tile,
}

impl Stage {
    /// All of them, in the order of the work.
    pub const ALL: [Self; 4] = [Self::Build, Self::Eval, Self::Infer, Self::Tile];

    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Build => "build",
            Self::Eval => "eval",
            Self::Infer => "infer",
            Self::Tile => "tile",
        }
    }
}

/// What is measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Stages, in this order.
    pub stages: Vec<Stage>,
    /// Fewer settings, smaller scenes and fewer rounds: under a minute.
    pub quick: bool,
    /// Most rounds of measurements of a switch.
    pub rounds: usize,
    /// Checkpoint folder of the network whose fields are rendered and tiled; else as
    /// [`crate::weights::find`] has it.
    pub weights: Option<PathBuf>,
    /// Worker threads.
    pub threads: usize,
    /// No progress.
    pub quiet: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            stages: Stage::ALL.to_vec(),
            quick: false,
            rounds: 9,
            weights: None,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            quiet: false,
        }
    }
}

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TradeoffError {
    /// Options that leave nothing to do; the text says what to do.
    #[error("{0}")]
    Input(String),
    /// Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// The operating system refused.
    #[error("cannot {action}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// A scene cannot be laid out.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A coordinate system cannot be served.
    #[error(transparent)]
    Crs(#[from] CrsError),
    /// A warp failed.
    #[error(transparent)]
    Warp(#[from] WarpError),
    /// A raster cannot be read.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// An array cannot be read.
    #[error(transparent)]
    Npz(#[from] NpzError),
    /// A build failed.
    #[error(transparent)]
    Bench(#[from] BenchError),
    /// Surfaces cannot be compared.
    #[error(transparent)]
    Align(#[from] AlignError),
    /// The network cannot run.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A field cannot be made.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// No weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A city cannot be made.
    #[error(transparent)]
    Tile(#[from] TileError),
}

impl TradeoffError {
    /// Whether a stage said that it cannot do what was asked of it with this input, and that nothing is wrong otherwise.
    const fn is_refusal(&self) -> bool {
        matches!(self, Self::Tile(TileError::Input(_)))
    }

    fn io(action: &'static str) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source }
    }
}

/// What a study is run with.
struct Setup<'a> {
    clock: Clock<'a>,
    quick: bool,
    weights: Option<PathBuf>,
    threads: usize,
}

impl Setup<'_> {
    /// The first where the run is quick, else the second.
    const fn either<T: Copy>(&self, quick: T, full: T) -> T {
        if self.quick { quick } else { full }
    }
}

/// A switch that can be measured: what its plan says of it, and how.
struct Study {
    stage: Stage,
    switch: &'static str,
    /// What in a scene makes the switch matter.
    cause: &'static str,
    cost: &'static str,
    /// Whether `--quick` has time for it.
    quick: bool,
    measure: fn(&Setup<'_>) -> Result<Findings, TradeoffError>,
}

/// All switches, in the order of the work.
fn studies() -> Vec<Study> {
    let study = |stage, switch, cause, cost, quick, measure| Study {
        stage,
        switch,
        cause,
        cost,
        quick,
        measure,
    };
    use Stage::{Build, Eval, Infer, Tile};
    vec![
        study(Build, "transform", warp::TRANSFORM, "5 warps of one image", true, warp::transform),
        study(Build, "resampling", warp::FINE, "5 warps of one image", true, warp::resampling),
        study(
            Build,
            "resampling-coarse",
            warp::COARSE,
            "5 warps of one image",
            true,
            warp::resampling_coarse,
        ),
        study(Build, "coverage", bench::COVERAGE, "2 small benchmarks", true, bench::coverage),
        study(Build, "quantise", bench::QUANTISE, "5 small benchmarks", true, bench::quantise),
        study(
            Build,
            "compression",
            bench::COMPRESSION,
            "3 encodings of one DSM",
            true,
            bench::compression,
        ),
        study(
            Eval,
            "protocol",
            scoring::PROTOCOL,
            "4 alignments of some pairs",
            true,
            scoring::protocol,
        ),
        study(Eval, "offset", scoring::OFFSET, "3 offsets of some pairs", true, scoring::offset),
        study(Eval, "resize", scoring::RESIZE, "2 resizings of one DSM", true, scoring::resizing),
        study(Eval, "bootstrap", scoring::BOOTSTRAP, "7 bootstraps", true, scoring::bootstrap),
        study(
            Infer,
            "samples",
            rays::SAMPLES,
            "16 DSMs of a trained field",
            true,
            rays::samples_of_network,
        ),
        study(
            Infer,
            "samples-walls",
            rays::WALLS,
            "16 DSMs of a city of boxes",
            true,
            rays::samples_of_boxes,
        ),
        study(Infer, "importance", rays::IMPORTANCE, "10 DSMs", true, rays::importance),
        study(Infer, "early-stop", stopping::CAUSE, "5 DSMs", true, stopping::early_stop),
        study(Infer, "dsm-size", rays::SIZE, "4 DSMs", true, rays::size),
        study(
            Infer,
            "precision",
            network::CAUSE,
            "the released network's size, made-up weights, several times; 6 GB of memory",
            false,
            network::precision,
        ),
        study(Tile, "stride", city::STRIDE, "a small city, 4 or 5 times", true, city::stride),
        study(Tile, "blend", city::BLEND, "a small city, 3 times", false, city::blend),
        study(Tile, "trim", city::TRIM, "a small city, 4 times", false, city::trim),
        study(Tile, "lattice", city::LATTICE, "a small city, twice", false, city::lattice),
    ]
}

/// The plan of a run: which switches are measured, and why not the others.
#[must_use]
pub fn plan(options: &Options) -> Plan {
    let steps = studies()
        .into_iter()
        .map(|study| {
            let asked = options.stages.contains(&study.stage);
            let on = asked && (study.quick || !options.quick);
            let reason = match (asked, on) {
                (false, _) => "--stage names others",
                (true, false) => "--quick has no time for it",
                (true, true) => "measured against its own truth",
            };
            Step {
                id: format!("{}/{}", study.stage.name(), study.switch),
                on,
                form: if options.quick { "quick" } else { "full" }.into(),
                bound: Bound::EXACT,
                cost: study.cost.into(),
                cause: study.cause.into(),
                reason: reason.into(),
            }
        })
        .collect();
    let parameters = json!({
        "stages": options.stages,
        "quick": options.quick,
        "rounds": options.rounds,
    });
    Plan {
        command: "tradeoff".into(),
        tolerance_m: 0.0,
        parameters: parameters.as_object().cloned().unwrap_or_default(),
        steps,
    }
}

/// Measures what the plan says.
///
/// # Errors
/// [`TradeoffError`] before anything has been measured: of the first study, or an interrupt. Later ones lose nothing: after
/// an interrupt the report holds what was measured, and a switch that fails is listed in it, with the reason. A setting
/// that this machine, build or model does not have is no failure; it is listed with the reason too.
pub fn run(options: &Options, stop: &Interrupt) -> Result<Report, TradeoffError> {
    if options.rounds == 0 || options.threads == 0 || options.stages.is_empty() {
        return Err(TradeoffError::Input(
            "nothing to measure: give at least one stage, round and thread".into(),
        ));
    }
    let started = Instant::now();
    let plan = plan(options);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads)
        .build()
        .map_err(|error| TradeoffError::Input(format!("--threads {}: {error}", options.threads)))?;
    let chosen: Vec<Study> = studies()
        .into_iter()
        .zip(&plan.steps)
        .filter(|(_, step)| step.on)
        .map(|(s, _)| s)
        .collect();
    let progress = Progress::new("tradeoff", "switches", chosen.len(), options.quiet);
    let setup = Setup {
        clock: Clock::new(options.rounds, options.quick, stop),
        quick: options.quick,
        weights: options.weights.clone(),
        threads: options.threads,
    };
    let mut switches = Vec::with_capacity(chosen.len());
    let mut failed = Vec::new();
    let mut interrupted = false;
    for study in chosen {
        tracing::info!("measuring {} of {}", study.switch, study.stage.name());
        let findings = match pool.install(|| (study.measure)(&setup)) {
            // What is measured stays measured.
            Err(TradeoffError::Interrupted) if !switches.is_empty() => {
                interrupted = true;
                break;
            }
            Err(error) if !switches.is_empty() => {
                let name = format!("{}/{}", study.stage.name(), study.switch);
                failed.push(Skipped { name, reason: error.to_string() });
                progress.add(1);
                continue;
            }
            outcome => outcome?,
        };
        let Findings { truth, error, work, settings, skipped } = findings;
        let mut switch = Switch {
            stage: study.stage,
            switch: study.switch.into(),
            cause: study.cause.into(),
            truth: truth.into(),
            error,
            work,
            settings,
            skipped,
        };
        switch.mark_pareto();
        switches.push(switch);
        progress.add(1);
    }
    progress.finish();
    Ok(Report {
        software: format!("sat3d {}", env!("CARGO_PKG_VERSION")),
        machine: Machine::here(options.threads),
        plan_sha256: plan.hash(),
        plan,
        switches,
        failed,
        interrupted,
        seconds: started.elapsed().as_secs_f64(),
    })
}

#[cfg(test)]
mod tests;
