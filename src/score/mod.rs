//! How good a model is on simulated scenes that no training saw: heights, buildings, mesh, floaters.
//!
//! | module | what happens there |
//! |---|---|
//! | [`image`](ImageScore) | one scene: DSM, flat ground and mesh against the exact heights |
//! | [`buildings`] | how high each building is over the ground around it |
//! | [`columns`] | the mesh's top and its floaters, from densities on the pixel lattice |
//! | [`measures`](Measure) | the scores of a set of scenes, with bootstrap intervals |
//! | [`compare`] | variants of a training against each other, with the order that the paper has |
//! | [`gates()`] | what a model has to reach before it is part of the program |
//!
//! **Scenes**: squares of 64.5 m on 256 px ([`Options`]) about the centres of
//! [`RandomScenes`]. Their seeds are hashes of the seeds asked for, so that seed 1 here
//! shows no scene of a training with seed 1.
//!
//! **Vertical offset**: every surface is compared as `sat3d eval --protocol vertical` does: the median of the
//! differences is taken out, of the constant prediction ("flat ground") and of the mesh, too.

pub mod buildings;
pub mod columns;
pub mod compare;
mod gates;
#[cfg(test)]
mod hard_cases;
mod image;
mod measures;
pub mod paper;
mod table;

pub use gates::{Gate, gates};
pub use image::{Errors, ImageScore, Prediction, Truth};
pub use measures::{Measure, Score, ScoreSet};
pub use table::{markdown, table};

use crate::eval::align::AlignError;
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::mesh::MeshOptions;
use crate::model::render::RenderOptions;
use crate::model::{Image8, Model, ModelError};
use crate::random::key;
use crate::scene::SceneError;
use crate::scene::random::{RandomScenes, Sample};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Purpose of the seeds of scored scenes.
const PURPOSE: u64 = 0x5343_4F52;
/// Scenes that are made ahead, at once.
const AHEAD: usize = 8;

/// What is scored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Options {
    /// One set of scenes for each.
    pub seeds: Vec<u64>,
    /// Scenes of a set.
    pub scenes: u64,
    /// Pixels along a side of an image.
    pub side: usize,
    /// Ground size of a pixel, metres.
    pub pixel_m: f64,
    /// Metres of height of one cube unit.
    pub metres_per_unit: f64,
    /// Density of the mesh's surface, per cube unit.
    pub isovalue: f32,
    /// Draws of the bootstrap.
    pub replicates: u32,
    /// Confidence level of the intervals, per cent.
    pub level_pct: f64,
}

impl Default for Options {
    /// Three seeds of 96 scenes at the scale of the training, with the mesh's own isovalue.
    fn default() -> Self {
        Self {
            seeds: vec![1, 2, 3],
            scenes: 96,
            side: 256,
            pixel_m: 0.252,
            metres_per_unit: TRAINING_WIDTH_M / 2.0,
            isovalue: MeshOptions::default().isovalue,
            replicates: 2000,
            level_pct: 95.0,
        }
    }
}

/// Why there is no score.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScoreError {
    /// Nothing to score, or a seed that comes twice: its scenes would count double.
    #[error("{what}; give at least one scene, and each seed once")]
    Nothing {
        /// What is wrong.
        what: String,
    },
    /// A scene cannot be laid out.
    #[error("scene {index} of seed {seed}: {source}")]
    Scene {
        /// Seed of the set.
        seed: u64,
        /// Number of the scene.
        index: u64,
        /// Why not.
        source: SceneError,
    },
    /// The model cannot run on a scene.
    #[error("scene {index} of seed {seed}: {source}")]
    Model {
        /// Seed of the set.
        seed: u64,
        /// Number of the scene.
        index: u64,
        /// Why not.
        source: ModelError,
    },
    /// A prediction without heights.
    #[error("scene {index} of seed {seed}: {source}")]
    Heights {
        /// Seed of the set.
        seed: u64,
        /// Number of the scene.
        index: u64,
        /// Why not.
        source: AlignError,
    },
}

/// Seconds for one image: the median over all of them but the first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Seconds {
    /// From the picture to the feature map.
    pub network: f64,
    /// From the feature map to the DSM.
    pub dsm: f64,
}

/// What [`score`] finds. All but `seconds` depends on the model and the options alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// What was scored.
    pub options: Options,
    /// All scenes.
    pub all: ScoreSet,
    /// The scenes of each seed, in the order of the options.
    pub seeds: Vec<ScoreSet>,
    /// How long it took.
    pub seconds: Seconds,
    /// Every scene.
    pub images: Vec<ImageScore>,
}

impl Report {
    /// From the scores of single scenes, in the order of the seeds.
    #[must_use]
    pub fn new(options: Options, images: Vec<ImageScore>, seconds: Seconds) -> Self {
        let of_seed = |seed: &u64| {
            let own: Vec<&ImageScore> = images.iter().filter(|image| image.seed == *seed).collect();
            ScoreSet::new(Some(*seed), &own, &options)
        };
        let seeds = options.seeds.iter().map(of_seed).collect();
        let all = ScoreSet::new(None, &images.iter().collect::<Vec<_>>(), &options);
        Self { options, all, seeds, seconds, images }
    }
}

/// Seed of the [`RandomScenes`] that a seed of the options stands for.
#[must_use]
pub fn scene_seed(seed: u64) -> u64 {
    key(&[seed, PURPOSE])
}

/// Scores a model; `done` is called after each scene.
///
/// # Errors
/// [`ScoreError`]: nothing to score, a scene that cannot be made, a model that does not run.
pub fn score(model: &Model, options: &Options, done: &dyn Fn()) -> Result<Report, ScoreError> {
    check(options)?;
    let mut images = Vec::new();
    let (mut network, mut dsm) = (Vec::new(), Vec::new());
    let indices: Vec<u64> = (0..options.scenes).collect();
    for seed in &options.seeds {
        for indices in indices.chunks(AHEAD) {
            let samples: Vec<(u64, Sample)> = indices
                .par_iter()
                .map(|index| sample(*seed, *index, options).map(|sample| (*index, sample)))
                .collect::<Result<_, _>>()?;
            for (index, sample) in samples {
                let (prediction, seconds) = predict(model, &sample, options)
                    .map_err(|source| ScoreError::Model { seed: *seed, index, source })?;
                network.push(seconds.network);
                dsm.push(seconds.dsm);
                let truth =
                    Truth { side: sample.side, surface: &sample.surface, classes: &sample.classes };
                let image = ImageScore::new([*seed, index], sample.kind, &prediction, &truth)
                    .map_err(|source| ScoreError::Heights { seed: *seed, index, source })?;
                images.push(image);
                done();
            }
        }
    }
    let seconds = Seconds { network: typical(&network), dsm: typical(&dsm) };
    Ok(Report::new(options.clone(), images, seconds))
}

fn check(options: &Options) -> Result<(), ScoreError> {
    let wrong = |what: String| Err(ScoreError::Nothing { what });
    if options.seeds.is_empty() || options.scenes == 0 || options.side == 0 {
        let Options { seeds, scenes, side, .. } = options;
        return wrong(format!("{} seeds, {scenes} scenes of {side} px", seeds.len()));
    }
    let twice = |at: usize| options.seeds[..at].contains(&options.seeds[at]);
    match (0..options.seeds.len()).find(|at| twice(*at)) {
        Some(at) => wrong(format!("seed {} comes twice", options.seeds[at])),
        None => Ok(()),
    }
}

fn sample(seed: u64, index: u64, options: &Options) -> Result<Sample, ScoreError> {
    let metres = options.side as f64 * options.pixel_m;
    RandomScenes { seed: scene_seed(seed) }
        .sample(index, options.side, metres)
        .map_err(|source| ScoreError::Scene { seed, index, source })
}

/// What the model makes of a picture, and how long that took.
fn predict(
    model: &Model,
    sample: &Sample,
    options: &Options,
) -> Result<(Prediction, Seconds), ModelError> {
    let image = Image8::new(sample.side, sample.side, 3, sample.rgb.clone())?;
    let begin = Instant::now();
    let scene = model.scene(&image, None, options.metres_per_unit)?;
    let network = begin.elapsed().as_secs_f64();
    let begin = Instant::now();
    let dsm = scene.dsm(sample.side, &RenderOptions::default());
    let seconds = Seconds { network, dsm: begin.elapsed().as_secs_f64() };
    let metres = (2.0 * options.metres_per_unit) as f32;
    let dsm_m = dsm.height.iter().map(|height| height * metres).collect();
    let columns = columns::of_scene(&scene, sample.side, options.isovalue, options.metres_per_unit);
    Ok((Prediction { dsm_m, columns }, seconds))
}

/// The median of all but the first, which loads the weights.
fn typical(seconds: &[f64]) -> f64 {
    let later = if seconds.len() > 1 { &seconds[1..] } else { seconds };
    crate::eval::align::median(&mut later.to_vec())
}

#[cfg(test)]
mod tests;
