//! `--shard i/n` and `eval merge`: an evaluation done in parts.
//!
//! A part holds the tallies of its images and nothing that depends on the machine. Merging appends
//! them in order and then does what a whole run does after its first pass, so that the result has
//! the same bytes. The second pass reads the files of images again, at the places that the parts
//! name.

use super::options::{EvalOptions, Settings};
use super::run::{EvalError, FirstPass, Prepared};
use super::summary::EvaluationSet;
use super::tally::{CHUNK, Tally};
use crate::batch::{Interrupt, Shard, write_atomic};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// What a part file is, so that another JSON file is not taken for one.
const SCHEMA: &str = "sat3d-eval-part-1";

/// A finished part.
#[derive(Debug, Serialize, Deserialize)]
struct Part {
    schema: String,
    shard: Shard,
    settings: Settings,
    /// SHA-256 over the names of all pairs and which of their files exist.
    pairs: String,
    /// Where the sets of predictions and the ground truth were.
    predictions: Vec<PathBuf>,
    truth: PathBuf,
    tallies: Vec<Tally>,
}

impl Prepared {
    /// Scores the images of [`EvalOptions::shard`] and writes `eval-part-<i>-of-<n>.json` into a
    /// folder. Returns its path and the number of images in it.
    ///
    /// # Errors
    /// [`EvalError`], as for a whole run.
    pub fn run_part(
        &self,
        folder: &Path,
        interrupt: &Interrupt,
    ) -> Result<(PathBuf, usize), EvalError> {
        let shard = self.options.shard;
        let chunks = shard.range(self.pairs.len().div_ceil(CHUNK));
        let last = (chunks.end * CHUNK).min(self.pairs.len());
        let range = (chunks.start * CHUNK).min(last)..last;
        let images = range.len();
        let pass = self.with_threads(|| self.first_pass(range, interrupt))??;
        let absolute = |path: &PathBuf| path.canonicalize().unwrap_or_else(|_| path.clone());
        let part = Part {
            schema: SCHEMA.into(),
            shard,
            settings: self.settings.clone(),
            pairs: self.fingerprint(),
            predictions: self.options.predictions.iter().map(absolute).collect(),
            truth: absolute(&self.options.truth),
            tallies: pass.tallies,
        };
        let path = folder.join(format!("eval-part-{}-of-{}.json", shard.index, shard.count));
        let unwritten = |source| EvalError::Write { path: path.clone(), source };
        let bytes = serde_json::to_vec(&part).map_err(|error| unwritten(error.into()))?;
        std::fs::create_dir_all(folder).map_err(unwritten)?;
        write_atomic(&path, &bytes).map_err(unwritten)?;
        Ok((path, images))
    }

    fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        for pair in &self.pairs {
            hash.update(pair.name.as_bytes());
            hash.update([0, u8::from(pair.truth.is_some())]);
            for prediction in &pair.predictions {
                hash.update([u8::from(prediction.is_some())]);
            }
        }
        crate::plan::hex(&hash.finalize())
    }
}

/// Joins all parts of a run.
///
/// `options` gives threads, memory and whether to show progress, and the mask again where one was
/// used; everything that decides the numbers comes from the parts.
///
/// # Errors
/// [`EvalError::Part`] for parts that are missing, doubled, damaged, or of different runs.
pub fn merge(
    paths: &[PathBuf],
    mut options: EvalOptions,
    interrupt: &Interrupt,
) -> Result<(Prepared, EvaluationSet), EvalError> {
    let mut parts = Vec::new();
    for path in part_files(paths)? {
        let wrong = |reason: String| EvalError::Part { path: path.clone(), reason };
        let bytes = std::fs::read(&path).map_err(|error| wrong(error.to_string()))?;
        let part: Part = serde_json::from_slice(&bytes)
            .map_err(|error| wrong(format!("no part of an evaluation: {error}")))?;
        if part.schema != SCHEMA {
            return Err(wrong(format!("its schema is `{}`, not `{SCHEMA}`", part.schema)));
        }
        parts.push((path, part));
    }
    parts.sort_by_key(|(_, part)| part.shard.index);
    check_complete(&parts)?;
    let (path, first) = &parts[0];
    let Settings { protocols, offset, resize, thresholds, .. } = first.settings.clone();
    options.predictions.clone_from(&first.predictions);
    options.names.clone_from(&first.settings.models);
    options.truth.clone_from(&first.truth);
    options.protocols = protocols;
    options.offset = offset;
    options.resize = resize;
    options.thresholds = thresholds;
    options.inputs.metres_per_unit = first.settings.metres_per_unit;
    options.inputs.zoom = first.settings.zoom;
    options.inputs.size = first.settings.size;
    options.inputs.gsd_m = first.settings.gsd_m;
    options.block_m = first.settings.block_m;
    options.replicates = first.settings.replicates;
    options.seed = first.settings.seed;
    options.registration_images = first.settings.registration_images;
    let prepared = super::run::prepare(options)?;
    let wrong = |reason: &str| EvalError::Part { path: path.clone(), reason: reason.to_owned() };
    if prepared.settings.classes != first.settings.classes {
        return Err(wrong("the parts were scored with another --mask; give the same to merge"));
    }
    if prepared.fingerprint() != first.pairs {
        return Err(wrong(
            "the folders of predictions and ground truth hold other images than when it was scored",
        ));
    }
    let evaluations = prepared.evaluations().len();
    let mut tallies: Vec<Tally> = Vec::new();
    for (path, part) in parts {
        if part.tallies.len() != evaluations {
            return Err(EvalError::Part { path, reason: "it is damaged".into() });
        }
        if tallies.is_empty() {
            tallies = part.tallies;
        } else {
            tallies.iter_mut().zip(part.tallies).for_each(|(all, next)| all.append(next));
        }
    }
    let kept = vec![Vec::new(); evaluations];
    let pass = FirstPass { tallies, kept };
    let set = prepared.with_threads(|| prepared.second_pass(pass, interrupt))??;
    Ok((prepared, set))
}

/// Part files as given, and those in folders given.
fn part_files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, EvalError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let wrong = |reason: String| EvalError::Part { path: path.clone(), reason };
        let entries = std::fs::read_dir(path).map_err(|error| wrong(error.to_string()))?;
        let before = files.len();
        for entry in entries {
            let file = entry.map_err(|error| wrong(error.to_string()))?.path();
            let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if name.starts_with("eval-part-") && name.ends_with(".json") {
                files.push(file);
            }
        }
        if files.len() == before {
            return Err(wrong("no eval-part-<i>-of-<n>.json in it".into()));
        }
    }
    Ok(files)
}

fn check_complete(parts: &[(PathBuf, Part)]) -> Result<(), EvalError> {
    let Some((path, first)) = parts.first() else {
        return Err(EvalError::Option("give the parts, or a folder that holds them".into()));
    };
    let wrong = |path: &Path, reason: String| EvalError::Part { path: path.to_owned(), reason };
    for (other, part) in parts {
        if part.settings != first.settings || part.shard.count != first.shard.count {
            return Err(wrong(
                other,
                format!("its options are not those of {}; score all parts alike", path.display()),
            ));
        }
        if part.pairs != first.pairs {
            return Err(wrong(other, format!("it saw other images than {}", path.display())));
        }
    }
    let found: Vec<u32> = parts.iter().map(|(_, part)| part.shard.index).collect();
    if let Some(double) = found.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(wrong(path, format!("part {} is there twice", double[0])));
    }
    let missing: Vec<String> = (1..=first.shard.count)
        .filter(|index| !found.contains(index))
        .map(|index| format!("{index}/{}", first.shard.count))
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    Err(wrong(
        path.parent().unwrap_or(path),
        format!("missing parts: {}; run `sat3d eval --shard` for them first", missing.join(", ")),
    ))
}
