//! A whole evaluation: pairs in, tallies out, in two passes.
//!
//! The first pass reads, aligns and scores every image and counts errors coarsely; the second counts
//! them finely where the pooled quantiles lie. Between the passes errors are kept as long as
//! [`EvalOptions::memory`] lasts; the others are computed again from the alignment found.

use super::align::{Aligner, apply};
use super::error_raster;
use super::finish;
use super::inputs::{InputError, Pair, Truth, demands, pair, read_prediction, read_truth};
use super::metrics::{ImageSample, block_of, lone_block};
use super::options::{EvalOptions, Settings};
use super::plan;
use super::protocol::Protocol;
use super::registration;
use super::resize::{resize, resize_nearest};
use super::score::{
    Errors, Layers, Scored, align_settings, alignment_of, compare, errors_of, is_unaligned, score,
};
use super::strata::{Mask, MaskError, StrataSettings, StratumSet};
use super::summary::{Evaluation, EvaluationSet, ImageScore, ImageScores};
use super::surface::Surface;
use super::tally::{CHUNK, Fine, Item, Tally};
use crate::batch::{Interrupt, Progress, Status};
use crate::plan::{Plan, runs};
use rayon::prelude::*;
use std::path::PathBuf;

/// Images whose results are held at once, over all sets and protocols.
const IN_FLIGHT: usize = 128;

/// Why a whole evaluation cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// A folder cannot be read, or holds nothing.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The mask cannot be used.
    #[error(transparent)]
    Mask(#[from] MaskError),
    /// An option has no meaning.
    #[error("{0}")]
    Option(String),
    /// No image could be scored.
    #[error("nothing to score in {}: {reason}", path.display())]
    Nothing {
        /// The ground truth.
        path: PathBuf,
        /// What was found instead.
        reason: String,
    },
    /// Something cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Parts of a run cannot be merged.
    #[error("{}: {reason}", path.display())]
    Part {
        /// The part, or the folder of parts.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// Interrupted by the user.
    #[error("interrupted; nothing was written")]
    Interrupted,
}

/// An evaluation that is ready to run: everything is resolved, no pixel is read.
#[derive(Debug)]
pub struct Prepared {
    /// What was asked for.
    pub options: EvalOptions,
    /// What decides the numbers.
    pub settings: Settings,
    /// The plan.
    pub plan: Plan,
    /// The pairs, sorted by name.
    pub pairs: Vec<Pair>,
    pub(super) set: StratumSet,
    mask: Option<Mask>,
}

/// Resolves what is asked for.
///
/// # Errors
/// [`EvalError`] for options without meaning, folders that cannot be read, an unusable mask.
pub fn prepare(options: EvalOptions) -> Result<Prepared, EvalError> {
    let wrong = |what: String| Err(EvalError::Option(what));
    if let Some(threshold) = options.thresholds.iter().find(|t| !(t.is_finite() && **t > 0.0)) {
        return wrong(format!(
            "--thresholds {threshold}: a threshold is a positive number of metres"
        ));
    }
    if !(options.block_m.is_finite() && options.block_m > 0.0) {
        return wrong(format!(
            "--block {}: a block is a positive number of metres",
            options.block_m
        ));
    }
    if options.names.len() > options.predictions.len() {
        return wrong("there are more --name than --pred".into());
    }
    let scale = options.inputs.metres_per_unit.unwrap_or(1.0);
    if !(scale.is_finite() && scale > 0.0) {
        return wrong(format!("--metres-per-unit {scale}: a scale is a positive number"));
    }
    let gsd = options.inputs.gsd_m.unwrap_or(1.0);
    if !(gsd.is_finite() && gsd > 0.0) {
        return wrong(format!(
            "--gsd {gsd}: a ground sample distance is a positive number of metres"
        ));
    }
    let pairs = pair(&options.predictions, &options.truth)?;
    let mask =
        options.mask.as_ref().map(|(path, settings)| Mask::open(path, settings)).transpose()?;
    // Whether truths have bare earth is seen when they are read; groups without pixels are left out.
    let set = StratumSet::new(true, mask.as_ref(), &StrataSettings::default());
    let labels = mask.as_ref().map_or_else(Vec::new, |mask| mask.labels().to_vec());
    let settings = options.settings(labels);
    let plan = plan::resolve(&options, &settings, &demands(&pairs, &options.inputs));
    Ok(Prepared { options, settings, plan, pairs, set, mask })
}

/// Why one image was not scored: for the count of reasons, and in full.
#[derive(Clone)]
struct NotScored {
    status: Status,
    kind: String,
    reason: String,
}

impl NotScored {
    fn skipped(reason: &str) -> Self {
        Self { status: Status::Skipped, kind: reason.to_owned(), reason: reason.to_owned() }
    }

    fn failed(error: &InputError) -> Self {
        Self { status: Status::Failed, kind: error.kind(), reason: error.to_string() }
    }
}

/// A prediction with the layers of its truth at its own size.
struct Loaded {
    prediction: Surface,
    layers: Layers,
    notes: Vec<String>,
}

impl Prepared {
    /// Sets of predictions times protocols, sets slowest.
    pub(super) fn evaluations(&self) -> Vec<(usize, Protocol)> {
        let sets = 0..self.options.predictions.len();
        sets.flat_map(|set| self.options.protocols.iter().map(move |&p| (set, p))).collect()
    }

    /// Runs a task on the number of threads asked for.
    ///
    /// # Errors
    /// [`EvalError::Option`] when they cannot be started.
    pub(super) fn with_threads<T: Send>(
        &self,
        task: impl FnOnce() -> T + Send,
    ) -> Result<T, EvalError> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(self.options.threads);
        let pool = pool
            .build()
            .map_err(|error| EvalError::Option(format!("cannot start threads: {error}")))?;
        Ok(pool.install(task))
    }

    /// Scores all images.
    ///
    /// # Errors
    /// [`EvalError::Interrupted`], [`EvalError::Nothing`] when no image has both sides, and what
    /// keeps outputs from being written.
    pub fn run(&self, interrupt: &Interrupt) -> Result<EvaluationSet, EvalError> {
        self.check_partners()?;
        self.with_threads(|| {
            let first = self.first_pass(0..self.pairs.len(), interrupt)?;
            self.second_pass(first, interrupt)
        })?
    }

    fn check_partners(&self) -> Result<(), EvalError> {
        let paired =
            |pair: &Pair| pair.truth.is_some() && pair.predictions.iter().any(Option::is_some);
        if self.pairs.iter().any(paired) {
            return Ok(());
        }
        let truths = self.pairs.iter().filter(|pair| pair.truth.is_some()).count();
        let first = |truth: bool| {
            let found = self.pairs.iter().find(|pair| pair.truth.is_some() == truth);
            found.map_or_else(String::new, |pair| pair.name.clone())
        };
        Err(EvalError::Nothing {
            path: self.options.truth.clone(),
            reason: format!(
                "{truths} ground truths (such as `{}_dsm`) and {} predictions (such as `{}`) have no name in common; <stem>.npz is scored with <stem>_dsm.npz",
                first(true),
                self.pairs.len() - truths,
                first(false),
            ),
        })
    }

    /// First pass over a range of pairs that begins at a chunk. One tally and the errors kept per
    /// evaluation.
    pub(super) fn first_pass(
        &self,
        range: std::ops::Range<usize>,
        interrupt: &Interrupt,
    ) -> Result<FirstPass, EvalError> {
        let evaluations = self.evaluations();
        let mut pass = FirstPass {
            tallies: evaluations.iter().map(|_| Tally::new(&self.set)).collect(),
            kept: vec![Vec::new(); evaluations.len()],
        };
        let progress = Progress::new("scoring", "images", range.len(), self.options.quiet);
        let mut budget = self.options.memory;
        let batch = (IN_FLIGHT / evaluations.len()).div_ceil(CHUNK).max(1) * CHUNK;
        let mut next = range.start;
        while next < range.end {
            if interrupt.requested() {
                return Err(EvalError::Interrupted);
            }
            let end = (next + batch).min(range.end);
            let mut results: Vec<Vec<Item>> = (next..end)
                .into_par_iter()
                .map_init(Aligner::new, |aligner, index| {
                    let items = self.image(index, aligner);
                    progress.add(1);
                    items
                })
                .collect::<Result<_, _>>()?;
            for from in (0..results.len()).step_by(CHUNK) {
                let to = (from + CHUNK).min(results.len());
                for e in (0..evaluations.len()).rev() {
                    let items =
                        results[from..to].iter_mut().filter_map(Vec::pop).collect::<Vec<_>>();
                    let errors =
                        pass.tallies[e].add_chunk(items, &self.set, self.settings.thresholds.len());
                    for errors in errors {
                        let errors = errors.map(Kept::of);
                        let size = errors.as_ref().map_or(0, Kept::bytes);
                        let fits = size <= budget;
                        budget -= if fits { size } else { 0 };
                        pass.kept[e].push(errors.filter(|_| fits));
                    }
                }
            }
            next = end;
        }
        progress.finish();
        Ok(pass)
    }

    /// Second pass and everything that follows from the tallies.
    pub(super) fn second_pass(
        &self,
        pass: FirstPass,
        interrupt: &Interrupt,
    ) -> Result<EvaluationSet, EvalError> {
        let mut evaluations = Vec::new();
        let mut samples: Vec<Vec<ImageSample>> = Vec::new();
        let each = self.evaluations().into_iter().zip(pass.tallies).zip(pass.kept);
        for (((set, protocol), tally), kept) in each {
            runs("quantiles");
            let mut fine = Fine::new(&tally);
            for from in (0..tally.rows.len()).step_by(IN_FLIGHT) {
                if interrupt.requested() {
                    return Err(EvalError::Interrupted);
                }
                let to = (from + IN_FLIGHT).min(tally.rows.len());
                let errors: Vec<Option<Errors>> = (from..to)
                    .into_par_iter()
                    .map(|k| match kept.get(k) {
                        Some(Some(kept)) => Ok(Some(kept.errors())),
                        _ => self.errors_again(set, k, &tally.rows[k]),
                    })
                    .collect::<Result<_, _>>()?;
                fine.add(&errors.iter().flatten().collect::<Vec<_>>());
            }
            let model = &self.settings.models[set];
            let offset = self.options.offset_for(protocol);
            evaluations.push(finish::evaluation(self, model, protocol, offset, &tally, &fine));
            samples.push(tally.samples);
        }
        Ok(finish::set(self, evaluations, &samples))
    }

    /// One item per evaluation for an image. Only what cannot be written is an error.
    fn image(&self, index: usize, aligner: &mut Aligner) -> Result<Vec<Item>, EvalError> {
        let pair = &self.pairs[index];
        let truth = match &pair.truth {
            None => Err(NotScored::skipped("no ground truth")),
            Some(path) => read_truth(&pair.name, path, &self.options.inputs)
                .map_err(|error| NotScored::failed(&error)),
        };
        let mut items = Vec::new();
        for set in 0..self.options.predictions.len() {
            let loaded = match &truth {
                Err(not) => Err(not.clone()),
                Ok(truth) => self.load(pair, set, truth),
            };
            let truth = truth.as_ref().ok();
            let estimate = match &loaded {
                Ok(loaded) if self.registers(index) => loaded.layers.pixel_m.and_then(|pixel_m| {
                    runs("registration");
                    let Layers { truth, ground, .. } = &loaded.layers;
                    registration::of_image(&loaded.prediction, truth, ground.as_ref(), pixel_m)
                }),
                _ => None,
            };
            for &protocol in &self.options.protocols {
                let scored = match &loaded {
                    Err(not) => Err(not.clone()),
                    Ok(loaded) => self.score(pair, protocol, loaded, aligner),
                };
                if let (Ok(scored), Some(truth), Some(folder)) =
                    (&scored, truth, &self.options.errors)
                {
                    runs("error-rasters");
                    let folder = self.errors_folder(folder, set, protocol);
                    error_raster::write(&folder, &pair.name, &scored.compared, &truth.place)?;
                }
                items.push(self.item(pair, truth, scored, estimate, index));
            }
        }
        Ok(items)
    }

    /// Whether an image is one of those that the registration is estimated from.
    fn registers(&self, index: usize) -> bool {
        let most = self.options.registration_images;
        most > 0 && index.is_multiple_of(self.pairs.len().div_ceil(most))
    }

    fn errors_folder(&self, folder: &std::path::Path, set: usize, protocol: Protocol) -> PathBuf {
        if self.evaluations().len() == 1 {
            return folder.to_owned();
        }
        folder.join(format!("{}-{}", self.settings.models[set], protocol.name()))
    }

    fn load(&self, pair: &Pair, set: usize, truth: &Truth) -> Result<Loaded, NotScored> {
        let Some(path) = &pair.predictions[set] else {
            return Err(NotScored::skipped("no prediction"));
        };
        let failed = |error: InputError| NotScored::failed(&error);
        let prediction = read_prediction(path, truth, &self.options.inputs).map_err(failed)?;
        let (width, height) = prediction.surface.size();
        let (truth_width, truth_height) = truth.surface.size();
        let how = self.options.resize;
        let differs = (width, height) != (truth_width, truth_height);
        if differs && !self.plan.runs("resize") {
            return Err(NotScored {
                status: Status::Failed,
                kind: "its size changed since the plan was made".into(),
                reason: format!(
                    "{}: {width} x {height} pixels, and {truth_width} x {truth_height} of ground truth; run again",
                    path.display()
                ),
            });
        }
        let classes = match (&self.mask, &truth.place.grid) {
            (Some(mask), Some(grid)) => {
                let classes = mask.classes(grid).map_err(|error| NotScored {
                    status: Status::Failed,
                    kind: "the mask cannot be brought onto the image".into(),
                    reason: error.to_string(),
                })?;
                Some(resize_nearest(&classes, (truth_width, truth_height), width, height))
            }
            _ => None,
        };
        let pixel_m = truth.place.pixel_m.map(|(east, south)| {
            (east * truth_width as f64 / width as f64, south * truth_height as f64 / height as f64)
        });
        let layers = Layers {
            truth: resize(&truth.surface, width, height, how),
            ground: truth.ground.as_ref().map(|ground| resize(ground, width, height, how)),
            classes,
            pixel_m,
        };
        let notes = truth.notes.iter().map(|note| format!("ground truth: {note}"));
        let notes = prediction.notes.into_iter().chain(notes).collect();
        Ok(Loaded { prediction: prediction.surface, layers, notes })
    }

    fn score(
        &self,
        pair: &Pair,
        protocol: Protocol,
        loaded: &Loaded,
        aligner: &mut Aligner,
    ) -> Result<Scored, NotScored> {
        let Loaded { prediction, layers, notes } = loaded;
        let settings = align_settings(&self.options, protocol, &pair.name, layers.pixel_m);
        let thresholds = &self.settings.thresholds;
        let mut scored = score(aligner, prediction, layers, &settings, &self.set, thresholds)
            .map_err(|reason| NotScored {
                status: Status::Failed,
                kind: "too few pixels have both heights".into(),
                reason: format!("{}: {reason}", pair.name),
            })?;
        scored.scores.notes.clone_from(notes);
        Ok(scored)
    }

    fn item(
        &self,
        pair: &Pair,
        truth: Option<&Truth>,
        scored: Result<Scored, NotScored>,
        registration: Option<registration::ImageRegistration>,
        index: usize,
    ) -> Item {
        let center = truth.and_then(|truth| truth.place.center);
        let mut row = ImageScore {
            name: pair.name.clone(),
            status: Status::Done,
            reason: String::new(),
            lat_deg: center.map(|at| at.lat_deg),
            lon_deg: center.map(|at| at.lon_deg),
            scores: None,
        };
        match scored {
            Ok(mut scored) => {
                // An image without a position is a block of its own.
                scored.sample.block = center.map_or_else(
                    || lone_block(index as u64),
                    |at| block_of((at.lon_deg, at.lat_deg), self.options.block_m),
                );
                scored.sample.name.clone_from(&pair.name);
                let reasons = if is_unaligned(&scored.scores.flags) {
                    vec!["left unaligned (see flags)".to_owned()]
                } else {
                    Vec::new()
                };
                row.scores = Some(scored.scores.clone());
                Item { row, scored: Some(scored), registration, reasons }
            }
            Err(NotScored { status, kind, reason }) => {
                row.status = status;
                row.reason = reason;
                Item { row, scored: None, registration: None, reasons: vec![kind] }
            }
        }
    }

    /// The errors of an image that was scored before, from the alignment that was found.
    fn errors_again(
        &self,
        set: usize,
        index: usize,
        row: &ImageScore,
    ) -> Result<Option<Errors>, EvalError> {
        let Some(scores) = &row.scores else { return Ok(None) };
        let (loaded, aligned) = self.load_again(set, index, scores)?;
        let Loaded { prediction, layers, .. } = &loaded;
        let alignment = alignment_of(scores);
        let (_, _, errors) = errors_of(prediction, layers, &alignment, aligned, &self.set);
        Ok(Some(errors))
    }

    /// An image that was scored before: its files again, and its truth moved as it was.
    fn load_again(
        &self,
        set: usize,
        index: usize,
        scores: &ImageScores,
    ) -> Result<(Loaded, Surface), EvalError> {
        let pair = &self.pairs[index];
        let changed = |what: String| EvalError::Part {
            path: pair.truth.clone().unwrap_or_default(),
            reason: format!("the files of {} changed while they were scored: {what}", pair.name),
        };
        let path = pair.truth.as_ref().ok_or_else(|| changed("no ground truth".into()))?;
        let truth = read_truth(&pair.name, path, &self.options.inputs)?;
        let loaded = self.load(pair, set, &truth).map_err(|not| changed(not.reason))?;
        let aligned = apply(&alignment_of(scores), &loaded.layers.truth);
        if aligned.valid() != scores.truth_pixels {
            return Err(changed(format!(
                "{} pixels of the ground truth then, {} now",
                scores.truth_pixels,
                aligned.valid()
            )));
        }
        Ok((loaded, aligned))
    }

    /// Prediction and aligned truth of an image that was scored, for pictures.
    ///
    /// # Errors
    /// [`EvalError`] when its files cannot be read any more.
    pub fn look_at(
        &self,
        evaluation: &Evaluation,
        name: &str,
    ) -> Result<Option<(Surface, Surface)>, EvalError> {
        let set = self.settings.models.iter().position(|model| *model == evaluation.model);
        let index = self.pairs.iter().position(|pair| pair.name == name);
        let scores = evaluation.per_image.iter().find(|row| row.name == name);
        let (Some(set), Some(index), Some(scores)) =
            (set, index, scores.and_then(|row| row.scores.as_ref()))
        else {
            return Ok(None);
        };
        let (loaded, aligned) = self.load_again(set, index, scores)?;
        let compared = compare(&loaded.prediction, aligned, &alignment_of(scores));
        Ok(Some((loaded.prediction, compared.truth)))
    }
}

/// What the first pass leaves for the second.
pub(super) struct FirstPass {
    /// One per evaluation.
    pub tallies: Vec<Tally>,
    /// Per evaluation and image, the errors, where there was room for them.
    pub kept: Vec<Vec<Option<Kept>>>,
}

/// Errors at half the size: pooled quantiles are those of errors rounded to `f32`.
#[derive(Clone)]
pub(super) struct Kept {
    values: Vec<f32>,
    classes: Vec<Vec<u8>>,
}

impl Kept {
    fn of(errors: Errors) -> Self {
        let values = errors.values.iter().map(|&error| error as f32).collect();
        Self { values, classes: errors.classes }
    }

    fn errors(&self) -> Errors {
        Errors {
            values: self.values.iter().map(|&error| f64::from(error)).collect(),
            classes: self.classes.clone(),
        }
    }

    fn bytes(&self) -> usize {
        4 * self.values.len() + self.classes.iter().map(Vec::len).sum::<usize>()
    }
}
