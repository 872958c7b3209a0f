//! Scores of a set of scenes, with intervals.
//!
//! Intervals are drawn as those of `sat3d eval`: scenes with replacement, percentiles moved outwards for small
//! sets. Scenes do not overlap, so each is a block of its own. Every score is computed anew from each draw,
//! ratios and the best constant among them.

use super::Options;
use super::image::{Errors, ImageScore};
use crate::eval::metrics::{draw, ends};
use rayon::prelude::*;
use serde::Serialize;

/// Names the sequences of random numbers of this module.
const PURPOSE: u64 = 0x5343_494E;
/// Seed of the draws.
const SEED: u64 = 1;

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Mean absolute error of the DSM over all pixels, metres.
    DsmMaeM,
    /// Root mean square error of the DSM over all pixels, metres.
    DsmRmseM,
    /// Pixels of the DSM that are off by less than 2.5 m, per cent.
    DsmWithinPct,
    /// Mean of the images' mean absolute errors, metres.
    DsmImageMaeM,
    /// Mean of the images' root mean square errors, metres.
    DsmImageRmseM,
    /// [`Self::DsmMaeM`] of flat ground.
    FlatMaeM,
    /// [`Self::DsmRmseM`] of flat ground.
    FlatRmseM,
    /// [`Self::DsmWithinPct`] of flat ground.
    FlatWithinPct,
    /// [`Self::DsmImageMaeM`] of flat ground.
    FlatImageMaeM,
    /// [`Self::DsmImageRmseM`] of flat ground.
    FlatImageRmseM,
    /// [`Self::DsmRmseM`] by [`Self::FlatRmseM`].
    DsmOfFlat,
    /// Mean absolute error of the heights of buildings, metres.
    BuildingErrorM,
    /// The same of the best constant: the median of the true heights.
    BuildingConstantErrorM,
    /// The first by the second.
    BuildingOfConstant,
    /// Pearson's correlation of predicted and true heights of buildings.
    BuildingCorrelation,
    /// Root mean square error of the mesh's top over all pixels, metres; holes count as the cube's bottom.
    MeshRmseM,
    /// [`Self::MeshRmseM`] by [`Self::DsmRmseM`].
    MeshOfDsm,
    /// Columns in which nothing stands, per cent.
    HolesPct,
    /// Columns in which something stands over an empty cell, per cent.
    FloatersPct,
}

impl Measure {
    /// All of them, in the order of their declaration.
    pub const ALL: [Self; 19] = [
        Self::DsmMaeM,
        Self::DsmRmseM,
        Self::DsmWithinPct,
        Self::DsmImageMaeM,
        Self::DsmImageRmseM,
        Self::FlatMaeM,
        Self::FlatRmseM,
        Self::FlatWithinPct,
        Self::FlatImageMaeM,
        Self::FlatImageRmseM,
        Self::DsmOfFlat,
        Self::BuildingErrorM,
        Self::BuildingConstantErrorM,
        Self::BuildingOfConstant,
        Self::BuildingCorrelation,
        Self::MeshRmseM,
        Self::MeshOfDsm,
        Self::HolesPct,
        Self::FloatersPct,
    ];
}

/// A score with its interval; NaN where there is nothing to measure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// What was measured.
    pub measure: Measure,
    /// The score.
    pub value: f64,
    /// Lower end of its interval.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The scores of a set of scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ScoreSet {
    /// Seed of the scenes; none for those of all seeds.
    pub seed: Option<u64>,
    /// Scenes.
    pub images: usize,
    /// Buildings that are scored.
    pub buildings: usize,
    /// Buildings without ground around them, which are not.
    pub buildings_without_ground: u64,
    /// The scores, in the order of [`Measure::ALL`].
    pub scores: Vec<Score>,
}

impl ScoreSet {
    /// Of scenes, with as many draws and the level that the options say.
    #[must_use]
    pub fn new(seed: Option<u64>, images: &[&ImageScore], options: &Options) -> Self {
        let set = Set::new(images);
        let values = set.measures(&vec![1; images.len()]);
        let drawn: Vec<[f64; COUNT]> = (0..options.replicates)
            .into_par_iter()
            .map(|replicate| {
                let mut weights = vec![0; images.len()];
                draw(&[SEED, PURPOSE, u64::from(replicate)], &mut weights);
                set.measures(&weights)
            })
            .collect();
        let scores = Measure::ALL.iter().zip(values).enumerate().map(|(at, (measure, value))| {
            let mut column = drawn.iter().map(|values| values[at]).collect();
            let (low, high) = ends(&mut column, images.len(), options.level_pct);
            Score { measure: *measure, value, low, high }
        });
        Self {
            seed,
            images: images.len(),
            buildings: set.buildings.len(),
            buildings_without_ground: images.iter().map(|image| image.without_ground).sum(),
            scores: scores.collect(),
        }
    }

    /// One of the scores.
    #[must_use]
    pub fn score(&self, measure: Measure) -> Score {
        self.scores[measure as usize]
    }
}

pub(super) const COUNT: usize = Measure::ALL.len();

/// Scenes, and their buildings from the lowest to the highest with the number of their scene.
pub(super) struct Set<'a> {
    images: &'a [&'a ImageScore],
    buildings: Vec<(f64, f64, usize)>,
}

impl<'a> Set<'a> {
    pub(super) fn new(images: &'a [&'a ImageScore]) -> Self {
        let mut buildings: Vec<(f64, f64, usize)> = images
            .iter()
            .enumerate()
            .flat_map(|(at, image)| {
                image.buildings.iter().map(move |one| (one.truth_m, one.prediction_m, at))
            })
            .collect();
        buildings.sort_by(|a, b| a.0.total_cmp(&b.0));
        Self { images, buildings }
    }

    /// All measures, with each scene as often as its weight says.
    pub(super) fn measures(&self, weights: &[u32]) -> [f64; COUNT] {
        let sum = |of: &dyn Fn(&ImageScore) -> f64| -> f64 {
            let weighted = self.images.iter().zip(weights);
            weighted.map(|(image, weight)| f64::from(*weight) * of(image)).sum()
        };
        let images = sum(&|_| 1.0);
        let mean = |of: &dyn Fn(&ImageScore) -> f64| sum(of) / images;
        let pooled = |which: fn(&ImageScore) -> &Errors| {
            let pixels = sum(&|image| which(image).pixels as f64);
            let over = |of: &dyn Fn(&Errors) -> f64| sum(&|image| of(which(image))) / pixels;
            let mae = over(&|e| e.pixels as f64 * e.mae_m);
            let rmse = over(&|e| e.pixels as f64 * (e.rmse_m * e.rmse_m)).sqrt();
            [mae, rmse, over(&|e| 100.0 * e.within as f64)]
        };
        let [dsm_mae, dsm_rmse, dsm_within] = pooled(|image| &image.dsm);
        let [flat_mae, flat_rmse, flat_within] = pooled(|image| &image.flat);
        let [_, mesh_rmse, _] = pooled(|image| &image.mesh);
        let columns = sum(&|image| image.columns as f64);
        let [error, constant, correlation] = self.heights(weights);
        [
            dsm_mae,
            dsm_rmse,
            dsm_within,
            mean(&|image| image.dsm.mae_m),
            mean(&|image| image.dsm.rmse_m),
            flat_mae,
            flat_rmse,
            flat_within,
            mean(&|image| image.flat.mae_m),
            mean(&|image| image.flat.rmse_m),
            dsm_rmse / flat_rmse,
            error,
            constant,
            error / constant,
            correlation,
            mesh_rmse,
            mesh_rmse / dsm_rmse,
            100.0 * sum(&|image| image.holes as f64) / columns,
            100.0 * sum(&|image| image.floaters as f64) / columns,
        ]
    }

    /// Of the heights of buildings: the mean absolute error, that of the best constant, and the correlation.
    fn heights(&self, weights: &[u32]) -> [f64; 3] {
        let weighted = || self.buildings.iter().map(|(t, p, at)| (*t, *p, f64::from(weights[*at])));
        let count: f64 = weighted().map(|(_, _, weight)| weight).sum();
        let mean = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
            weighted().map(|(truth, found, weight)| weight * of(truth, found)).sum::<f64>() / count
        };
        // No constant has a smaller mean absolute error than a median.
        let mut below = 0.0;
        let middle = weighted().find(|(_, _, weight)| {
            below += weight;
            2.0 * below >= count && count > 0.0
        });
        let constant = middle.map_or(f64::NAN, |(truth, _, _)| truth);
        // About one of them: the mean of equal heights is that height then, and not its rounding, which would correlate.
        let first = weighted().find(|(_, _, weight)| *weight > 0.0).unwrap_or_default();
        let truths = first.0 + mean(&|truth, _| truth - first.0);
        let founds = first.1 + mean(&|_, found| found - first.1);
        let both = mean(&|truth, found| (truth - truths) * (found - founds));
        let spread = mean(&|truth, _| (truth - truths) * (truth - truths)).sqrt()
            * mean(&|_, found| (found - founds) * (found - founds)).sqrt();
        [
            mean(&|truth, found| (found - truth).abs()),
            mean(&|truth, _| (constant - truth).abs()),
            both / spread,
        ]
    }
}
