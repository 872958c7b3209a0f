//! From images to totals: one tally per set of predictions and protocol.
//!
//! Floating-point sums are folded image by image into chunks of [`CHUNK`] images, and the chunks in
//! order at the end. Parts of a run begin and end at chunks, so that any number of threads and any
//! division into shards add the same numbers in the same order. Counts are whole numbers, whose
//! order does not matter.

use super::metrics::{CoarseCounts, ErrorSums, FineCounts, Histogram, ImageSample};
use super::registration::ImageRegistration;
use super::score::{Errors, Scored, StratumSums, bucket};
use super::strata::StratumSet;
use super::summary::{ImageScore, PositionMap};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Images per chunk.
pub const CHUNK: usize = 16;
/// Cells across and down of the map of errors by position.
const CELLS: usize = 32;
/// Steps per metre in the fixed-point sums of that map.
const STEPS: f64 = 1_048_576.0;
/// Errors count at most this much in that map, metres, so that sums fit 64 bits.
const MOST_M: f64 = 10_000.0;
/// Bins of the histogram of errors: 0.25 m from -50 m to 50 m.
const HISTOGRAM: (f64, f64, u32) = (-50.0, 0.25, 400);

/// Float sums of up to [`CHUNK`] images.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ChunkSums {
    /// Over all pixels.
    pub all: StratumSums,
    /// By group and class.
    pub strata: Vec<Vec<StratumSums>>,
}

impl ChunkSums {
    fn new(set: &StratumSet, thresholds: usize) -> Self {
        let empty = StratumSums { sums: ErrorSums::new(thresholds), truth_pixels: 0 };
        let groups = set.groups().iter();
        Self {
            strata: groups.map(|group| vec![empty.clone(); group.labels.len()]).collect(),
            all: empty,
        }
    }

    /// Adds what comes next in order.
    fn merge(&mut self, all: &StratumSums, strata: &[Vec<StratumSums>]) {
        let add = |to: &mut StratumSums, from: &StratumSums| {
            to.sums.merge(&from.sums);
            to.truth_pixels += from.truth_pixels;
        };
        add(&mut self.all, all);
        for (to, from) in self.strata.iter_mut().flatten().zip(strata.iter().flatten()) {
            add(to, from);
        }
    }
}

/// Errors by position in the image, in fixed point: the order of adding does not matter.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Positions {
    absolute: Vec<i64>,
    signed: Vec<i64>,
    pixels: Vec<u64>,
}

impl Positions {
    fn new() -> Self {
        let cells = CELLS * CELLS;
        Self { absolute: vec![0; cells], signed: vec![0; cells], pixels: vec![0; cells] }
    }

    fn add(&mut self, errors: &[f64], width: usize, height: usize) {
        for (y, line) in errors.chunks_exact(width).enumerate() {
            let row = y * CELLS / height * CELLS;
            for (x, &error) in line.iter().enumerate() {
                if error.is_nan() {
                    continue;
                }
                let cell = row + x * CELLS / width;
                let steps = (error.clamp(-MOST_M, MOST_M) * STEPS).round() as i64;
                self.signed[cell] += steps;
                self.absolute[cell] += steps.abs();
                self.pixels[cell] += 1;
            }
        }
    }

    fn merge(&mut self, other: &Self) {
        let sums = [(&mut self.absolute, &other.absolute), (&mut self.signed, &other.signed)];
        for (to, from) in sums {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
        self.pixels.iter_mut().zip(&other.pixels).for_each(|(to, from)| *to += from);
    }

    /// Means per cell; NaN where no pixel fell.
    pub fn map(&self) -> PositionMap {
        let mean = |sums: &[i64]| {
            let pairs = sums.iter().zip(&self.pixels);
            pairs.map(|(&sum, &count)| sum as f64 / STEPS / count as f64).collect()
        };
        PositionMap { cells: CELLS as u32, mae_m: mean(&self.absolute), bias_m: mean(&self.signed) }
    }
}

/// What one image adds to a tally.
pub struct Item {
    /// Its row.
    pub row: ImageScore,
    /// Its numbers, when it was scored.
    pub scored: Option<Scored>,
    /// Its estimate of the registration, where one was asked for and found.
    pub registration: Option<ImageRegistration>,
    /// Why it was not scored, or what is to be said of it, in words that many images share.
    pub reasons: Vec<String>,
}

/// Everything found so far about one set of predictions under one protocol.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Tally {
    /// One row per image, in order.
    pub rows: Vec<ImageScore>,
    /// One sample per scored image, in order.
    pub samples: Vec<ImageSample>,
    /// Sums per chunk, in order.
    pub chunks: Vec<ChunkSums>,
    /// First pass of the pooled quantiles.
    pub coarse: CoarseCounts,
    /// The same by group and class.
    pub coarse_strata: Vec<Vec<CoarseCounts>>,
    /// Distribution of the errors.
    pub histogram: Histogram,
    /// Errors by position.
    pub positions: Positions,
    /// Estimates of the registration, in order.
    pub registrations: Vec<ImageRegistration>,
    /// What befell images, and how many.
    pub reasons: BTreeMap<String, u64>,
}

impl Tally {
    /// Nothing yet.
    pub fn new(set: &StratumSet) -> Self {
        let (low, bin, bins) = HISTOGRAM;
        let counts = |labels: usize| (0..labels).map(|_| CoarseCounts::new()).collect();
        Self {
            rows: Vec::new(),
            samples: Vec::new(),
            chunks: Vec::new(),
            coarse: CoarseCounts::new(),
            coarse_strata: set.groups().iter().map(|group| counts(group.labels.len())).collect(),
            histogram: Histogram::new(low, bin, bins),
            positions: Positions::new(),
            registrations: Vec::new(),
            reasons: BTreeMap::new(),
        }
    }

    /// Adds the images of one chunk, in order. Returns their errors for the second pass.
    pub fn add_chunk(
        &mut self,
        items: Vec<Item>,
        set: &StratumSet,
        thresholds: usize,
    ) -> Vec<Option<Errors>> {
        let mut sums = ChunkSums::new(set, thresholds);
        let mut errors = Vec::with_capacity(items.len());
        for item in items {
            self.rows.push(item.row);
            self.registrations.extend(item.registration);
            for reason in item.reasons {
                *self.reasons.entry(reason).or_default() += 1;
            }
            let Some(scored) = item.scored else {
                errors.push(None);
                continue;
            };
            let all = StratumSums {
                sums: scored.sample.sums.clone(),
                truth_pixels: scored.sample.truth_pixels,
            };
            sums.merge(&all, &scored.strata);
            self.samples.push(scored.sample);
            self.histogram.add(&scored.errors.values);
            let (width, height) = scored.compared.truth.size();
            self.positions.add(&scored.compared.errors, width, height);
            errors.push(Some(scored.errors));
        }
        self.chunks.push(sums);
        let of = || errors.iter().flatten();
        rayon::join(
            || of().for_each(|e| self.coarse.add(&e.values)),
            || {
                self.coarse_strata.par_iter_mut().enumerate().for_each(|(group, counts)| {
                    let mut buckets = vec![Vec::new(); counts.len()];
                    for errors in of() {
                        bucket(errors, group, &mut buckets);
                        counts.iter_mut().zip(&buckets).for_each(|(c, values)| c.add(values));
                    }
                });
            },
        );
        errors
    }

    /// Appends the tally of the images that follow.
    pub fn append(&mut self, next: Self) {
        self.rows.extend(next.rows);
        self.samples.extend(next.samples);
        self.chunks.extend(next.chunks);
        self.registrations.extend(next.registrations);
        self.coarse.merge(&next.coarse);
        let counts = self.coarse_strata.iter_mut().flatten();
        counts.zip(next.coarse_strata.iter().flatten()).for_each(|(to, from)| to.merge(from));
        for (reason, images) in next.reasons {
            *self.reasons.entry(reason).or_default() += images;
        }
        self.histogram.merge(&next.histogram);
        self.positions.merge(&next.positions);
    }

    /// The chunks folded in order.
    pub fn totals(&self, set: &StratumSet, thresholds: usize) -> ChunkSums {
        let mut totals = ChunkSums::new(set, thresholds);
        for chunk in &self.chunks {
            totals.merge(&chunk.all, &chunk.strata);
        }
        totals
    }
}

/// Second pass of the pooled quantiles of a tally.
pub struct Fine {
    /// Over all pixels.
    pub all: FineCounts,
    /// By group and class.
    pub strata: Vec<Vec<FineCounts>>,
}

impl Fine {
    /// The counters that a tally's first pass asks for.
    pub fn new(tally: &Tally) -> Self {
        let fine = |coarse: &CoarseCounts| FineCounts::new(&coarse.refinement());
        let groups = tally.coarse_strata.iter();
        Self {
            all: fine(&tally.coarse),
            strata: groups.map(|group| group.iter().map(fine).collect()).collect(),
        }
    }

    /// Counts the errors of some images; the order does not matter.
    pub fn add(&mut self, images: &[&Errors]) {
        let (all, strata) = (&mut self.all, &mut self.strata);
        rayon::join(
            || images.iter().for_each(|errors| all.add(&errors.values)),
            || {
                strata.par_iter_mut().enumerate().for_each(|(group, counts)| {
                    let mut buckets = vec![Vec::new(); counts.len()];
                    for errors in images {
                        bucket(errors, group, &mut buckets);
                        counts.iter_mut().zip(&buckets).for_each(|(c, values)| c.add(values));
                    }
                });
            },
        );
    }
}
