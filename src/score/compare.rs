//! Variants of a training held against each other, on the same scenes.
//!
//! **A score of a variant** is the mean of its trainings' scores. **Intervals** are bootstraps: each draw takes
//! scenes with replacement, the same for all variants and trainings, and trainings of each variant with
//! replacement. So a difference is paired by scene, and what one variant's trainings vary by is in it. With
//! three trainings or so that spread is itself badly known, and the draws make it too small by the root of
//! (n - 1) / n; the scores of the single trainings stand beside the interval for that reason. A variant with
//! one training has an interval that says nothing of other trainings.

use super::image::ImageScore;
use super::measures::{COUNT, Measure, Set};
use super::{Options, paper};
use crate::eval::metrics::{draw, ends};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Names the sequences of random numbers of this module.
const PURPOSE: u64 = 0x5343_434D;
/// Seed of the draws.
const SEED: u64 = 1;

/// One training of a variant, scored.
#[derive(Clone, Debug, PartialEq)]
pub struct Training {
    /// Where its report lies.
    pub path: PathBuf,
    /// SHA-256 of its weights.
    pub sha256: String,
    /// What was scored.
    pub options: Options,
    /// Every scene.
    pub images: Vec<ImageScore>,
}

/// The trainings of a variant.
#[derive(Clone, Debug, PartialEq)]
pub struct Variant {
    /// Its name.
    pub name: String,
    /// One or more.
    pub trainings: Vec<Training>,
}

/// A score of a variant, beside that of the variant it is held against.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// What was measured.
    pub measure: Measure,
    /// Mean over the trainings; NaN (`null` in JSON) where there is nothing to measure.
    pub value: f64,
    /// Lower end of its interval.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Of each training.
    pub trainings: Vec<f64>,
    /// The value less that of the other variant.
    pub difference: f64,
    /// Lower end of the interval of the difference.
    pub difference_low: f64,
    /// Upper end.
    pub difference_high: f64,
}

/// Whether the RMSE differs from that of the reference in the direction that the paper has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// It does, and the interval of the difference leaves 0 out.
    AsInThePaper,
    /// It differs in the other direction, likewise.
    TheOtherWay,
    /// The interval holds 0.
    Undecided,
}

/// A variant among others.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// SHA-256 of the weights of each training.
    pub sha256: Vec<String>,
    /// The scores, in the order of [`Measure::ALL`].
    pub scores: Vec<Compared>,
    /// RMSE of the variant of this name in the paper, metres.
    pub paper_rmse_m: Option<f64>,
    /// Of the variant's RMSE; where the paper has both it and the reference.
    pub order: Option<Order>,
}

impl Row {
    /// One of the scores.
    #[must_use]
    pub fn score(&self, measure: Measure) -> &Compared {
        &self.scores[measure as usize]
    }
}

/// Variants, compared.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Scenes that all were scored on.
    pub scenes: usize,
    /// The variant that the others are held against.
    pub against: String,
    /// Draws of the bootstrap.
    pub replicates: u32,
    /// Confidence level of the intervals, per cent.
    pub level_pct: f64,
    /// Variants, in the order in which they were given.
    pub variants: Vec<Row>,
}

/// Why variants cannot be compared.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompareError {
    /// A report or its folder cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A file that is no report.
    #[error("{} is no report of `sat3d model score`: {message}; write one with --out", path.display())]
    NoReport {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A folder without reports.
    #[error("{} holds no .json file; name a report of `sat3d model score`, or a folder of them", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// Reports of other scenes, or of scenes seen otherwise.
    #[error(
        "{} and {} were scored on other scenes; give `sat3d model score` the same --seeds and --scenes",
        first.display(), second.display()
    )]
    OtherScenes {
        /// A report.
        first: PathBuf,
        /// The one that differs.
        second: PathBuf,
    },
    /// The same weights twice in a variant: they would count double.
    #[error("{} and {} are reports of the same weights; take one of them away", first.display(), second.display())]
    SameWeights {
        /// A report.
        first: PathBuf,
        /// Another.
        second: PathBuf,
    },
    /// Two variants of one name.
    #[error(
        "two variants are called `{name}`; their names are those of their folders, or of their files"
    )]
    SameName {
        /// The name.
        name: String,
    },
    /// A reference that is not there.
    #[error("there is no variant `{name}` to compare with; there are: {known}")]
    NoReference {
        /// The name.
        name: String,
        /// Those that there are.
        known: String,
    },
}

/// What is read of a report.
#[derive(Deserialize)]
struct File {
    sha256: String,
    report: Scored,
}

#[derive(Deserialize)]
struct Scored {
    options: Options,
    images: Vec<ImageScore>,
}

impl Variant {
    /// A variant from the reports of `sat3d model score`: a file is one training, a folder has one in each of
    /// its `.json` files. The name is that of the folder, or of the file without its ending.
    ///
    /// # Errors
    /// [`CompareError`]: nothing there, not readable, or no report.
    pub fn read(path: &Path) -> Result<Self, CompareError> {
        let unreadable = |source| CompareError::Read { path: path.to_owned(), source };
        let is_folder = std::fs::metadata(path).map_err(unreadable)?.is_dir();
        let mut files = vec![path.to_owned()];
        if is_folder {
            files = std::fs::read_dir(path)
                .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
                .map_err(unreadable)?;
            files.retain(|file| file.extension().is_some_and(|end| end == "json"));
            files.sort();
        }
        if files.is_empty() {
            return Err(CompareError::Empty { path: path.to_owned() });
        }
        // `.` and `..` have names only where they lead.
        let whole = std::fs::canonicalize(path).map_err(unreadable)?;
        let name = if is_folder { whole.file_name() } else { path.file_stem() };
        let trainings = files.iter().map(|file| Training::read(file)).collect::<Result<_, _>>()?;
        Ok(Self { name: name.unwrap_or_default().to_string_lossy().into_owned(), trainings })
    }
}

impl Training {
    fn read(path: &Path) -> Result<Self, CompareError> {
        let bytes = std::fs::read(path)
            .map_err(|source| CompareError::Read { path: path.to_owned(), source })?;
        let no_report = |message: String| CompareError::NoReport { path: path.to_owned(), message };
        let File { sha256, report: Scored { options, images } } =
            serde_json::from_slice(&bytes).map_err(|error| no_report(error.to_string()))?;
        if images.is_empty() {
            return Err(no_report("it has no scenes".into()));
        }
        Ok(Self { path: path.to_owned(), sha256, options, images })
    }

    /// Whether both were scored on the same scenes. How heights become metres is the model's business.
    fn sees_the_scenes_of(&self, other: &Self) -> bool {
        let places = |training: &Self| -> Vec<[u64; 2]> {
            training.images.iter().map(|image| [image.seed, image.index]).collect()
        };
        let scale = |options: &Options| (options.side, options.pixel_m, options.isovalue);
        scale(&self.options) == scale(&other.options) && places(self) == places(other)
    }
}

/// Compares variants with the one called `against`, with `replicates` draws and intervals that hold
/// `level_pct` per cent of them.
///
/// # Errors
/// [`CompareError`]: other scenes, weights or names that come twice, no such reference.
pub fn compare(
    variants: &[Variant],
    against: &str,
    replicates: u32,
    level_pct: f64,
) -> Result<Comparison, CompareError> {
    let reference = check(variants, against)?;
    let scenes = variants[reference].trainings[0].images.len();
    let images: Vec<Vec<Vec<&ImageScore>>> = variants
        .iter()
        .map(|variant| variant.trainings.iter().map(|one| one.images.iter().collect()).collect())
        .collect();
    let sets: Vec<Vec<Set<'_>>> = images
        .iter()
        .map(|trainings| trainings.iter().map(|images| Set::new(images)).collect())
        .collect();
    let once = vec![1; scenes];
    let single: Vec<Vec<[f64; COUNT]>> = sets
        .iter()
        .map(|trainings| trainings.iter().map(|set| set.measures(&once)).collect())
        .collect();
    // For each draw, the scores of all variants.
    let drawn: Vec<Vec<[f64; COUNT]>> = (0..replicates)
        .into_par_iter()
        .map(|replicate| {
            let sequence = |what: usize| [SEED, PURPOSE, u64::from(replicate), what as u64];
            let mut of_scenes = vec![0; scenes];
            draw(&sequence(0), &mut of_scenes);
            let score = |(variant, trainings): (usize, &Vec<Set<'_>>)| {
                let mut times = vec![0; trainings.len()];
                draw(&sequence(1 + variant), &mut times);
                let taken = times.iter().zip(trainings).filter(|(times, _)| **times > 0);
                let scores: Vec<(u32, [f64; COUNT])> =
                    taken.map(|(times, set)| (*times, set.measures(&of_scenes))).collect();
                mean(&scores)
            };
            sets.iter().enumerate().map(score).collect()
        })
        .collect();
    let all: Vec<[f64; COUNT]> = single
        .iter()
        .map(|scores| mean(&scores.iter().map(|scores| (1, *scores)).collect::<Vec<_>>()))
        .collect();
    let row = |(at, variant): (usize, &Variant)| {
        let scores = Measure::ALL.iter().enumerate().map(|(m, measure)| {
            let interval = |of: &dyn Fn(&Vec<[f64; COUNT]>) -> f64| {
                ends(&mut drawn.iter().map(of).collect(), scenes, level_pct)
            };
            let (low, high) = interval(&|draw| draw[at][m]);
            let (difference_low, difference_high) =
                interval(&|draw| draw[at][m] - draw[reference][m]);
            Compared {
                measure: *measure,
                value: all[at][m],
                low,
                high,
                trainings: single[at].iter().map(|scores| scores[m]).collect(),
                difference: all[at][m] - all[reference][m],
                difference_low,
                difference_high,
            }
        });
        let scores: Vec<Compared> = scores.collect();
        let paper_rmse_m = paper::rmse_m(&variant.name);
        let order = match (paper_rmse_m, paper::rmse_m(against)) {
            (Some(own), Some(other)) if at != reference => {
                Some(order(&scores[Measure::DsmRmseM as usize], own - other))
            }
            _ => None,
        };
        let sha256 = variant.trainings.iter().map(|one| one.sha256.clone()).collect();
        Row { name: variant.name.clone(), sha256, scores, paper_rmse_m, order }
    };
    let variants = variants.iter().enumerate().map(row).collect();
    Ok(Comparison { scenes, against: against.to_owned(), replicates, level_pct, variants })
}

/// Place of the reference among variants that can be compared.
fn check(variants: &[Variant], against: &str) -> Result<usize, CompareError> {
    let names: Vec<&str> = variants.iter().map(|variant| variant.name.as_str()).collect();
    if let Some(at) = (0..names.len()).find(|at| names[..*at].contains(&names[*at])) {
        return Err(CompareError::SameName { name: names[at].to_owned() });
    }
    let Some(reference) = names.iter().position(|name| *name == against) else {
        return Err(CompareError::NoReference {
            name: against.to_owned(),
            known: names.join(", "),
        });
    };
    let mut first: Option<&Training> = None;
    for variant in variants {
        let trainings = &variant.trainings;
        if trainings.is_empty() {
            return Err(CompareError::Empty { path: PathBuf::from(&variant.name) });
        }
        for (at, training) in trainings.iter().enumerate() {
            let first = first.get_or_insert(training);
            let (one, second) = (first.path.clone(), training.path.clone());
            if !training.sees_the_scenes_of(first) {
                return Err(CompareError::OtherScenes { first: one, second });
            }
            if let Some(same) = trainings[..at].iter().find(|one| one.sha256 == training.sha256) {
                return Err(CompareError::SameWeights { first: same.path.clone(), second });
            }
        }
    }
    Ok(reference)
}

/// Mean of scores, each as often as its number says.
fn mean(scores: &[(u32, [f64; COUNT])]) -> [f64; COUNT] {
    let count: f64 = scores.iter().map(|(times, _)| f64::from(*times)).sum();
    std::array::from_fn(|m| {
        scores.iter().map(|(times, scores)| f64::from(*times) * scores[m]).sum::<f64>() / count
    })
}

/// How a difference of errors agrees with the paper's, which is not 0.
fn order(score: &Compared, paper: f64) -> Order {
    let (low, high) = (score.difference_low, score.difference_high);
    // NaN decides nothing.
    match (low > 0.0, high < 0.0) {
        (true, _) if paper > 0.0 => Order::AsInThePaper,
        (_, true) if paper < 0.0 => Order::AsInThePaper,
        (false, false) => Order::Undecided,
        _ => Order::TheOtherWay,
    }
}

#[cfg(test)]
#[path = "compare_tests.rs"]
mod tests;
