//! Preparing and running a benchmark build.

use super::BenchError;
use super::images::ImageEntry;
use super::item::Workshop;
use super::manifest::{self, RunFacts};
use super::options::{BuildOptions, GridKind};
use super::plan::{self, Budget};
use super::record::Record;
use super::tiles::TileSet;
use crate::batch::{
    Batch, ExitCode, FolderLock, Header, Interrupt, Journal, Journals, Progress, Status,
    count_reasons, count_status, remove_leftovers,
};
use crate::grid::ImageGrid;
use crate::lidar::{FitErrors, PixelMap, PixelToCrs, TransformForm};
use crate::plan::Plan;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;

/// A build whose inputs are opened and whose plan is resolved; nothing is written yet.
pub struct Prepared {
    options: BuildOptions,
    dsm: TileSet,
    dtm: Option<TileSet>,
    images: Vec<ImageEntry>,
    budget: Budget,
    /// The plan.
    pub plan: Plan,
    /// What the user should know before the run.
    pub warnings: Vec<String>,
}

/// The worst measured bound of each transform form over the images of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TransformMeasure {
    /// Images that touch a tile.
    pub images: usize,
    /// 3 x 3 Chebyshev polynomial, metres.
    pub chebyshev_m: f64,
    /// Separable form, metres.
    pub separable_m: f64,
    /// Affine form, metres.
    pub affine_m: f64,
}

/// What a run did, for people and machines.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RunSummary {
    /// Images of this run (its shard).
    pub images: usize,
    /// Images with a DSM, earlier runs included.
    pub done: usize,
    /// Of those, done by an earlier run and kept.
    pub kept: usize,
    /// Images left out for a stated reason.
    pub skipped: usize,
    /// Images with an error.
    pub failed: usize,
    /// Images not started because the run was interrupted or the disk was full.
    pub not_started: usize,
    /// Skipped images that `--coverage mosaic` would give a DSM.
    pub rescued_by_mosaic: usize,
    /// Reasons with their number of images, most frequent first; numbers in reasons as `#`.
    pub reasons: Vec<(String, usize)>,
    /// Tiles that could not be used.
    pub bad_tiles: Vec<String>,
    /// Images whose heights look wrong.
    pub flagged: usize,
    /// Pixels whose validity could flip within the horizontal bound.
    pub uncertain_px: u64,
    /// What was noticed while reading, for example undeclared no-data values.
    pub warnings: Vec<String>,
    /// Whether the run was interrupted.
    pub interrupted: bool,
    /// Whether the disk filled up.
    pub disk_full: bool,
    /// Seconds of work, without opening.
    pub seconds: f64,
    /// Blocks decoded, of how many distinct ones.
    pub blocks_decoded: u64,
    /// See `blocks_decoded`.
    pub blocks_distinct: u64,
}

impl RunSummary {
    /// The process's exit code.
    #[must_use]
    pub fn exit_code(&self) -> ExitCode {
        if self.interrupted {
            ExitCode::Interrupted
        } else if self.failed > 0 || self.not_started > 0 || !self.bad_tiles.is_empty() {
            ExitCode::SomeFailed
        } else {
            ExitCode::Success
        }
    }
}

/// Opens the tiles, lists the images and resolves the plan.
///
/// # Errors
/// [`BenchError`]: anything that makes the whole run impossible.
pub fn prepare(options: BuildOptions) -> Result<Prepared, BenchError> {
    if options.grid == GridKind::Reference && options.geotiff {
        return Err(BenchError::Input(
            "--geotiff writes Web-Mercator grids, and --grid reference is none; leave one of them out".into(),
        ));
    }
    if options.tolerance_m.is_nan() || options.tolerance_m <= 0.0 {
        return Err(BenchError::Input(format!(
            "--tolerance {}: must be above 0 (metres)",
            options.tolerance_m
        )));
    }
    if !(0.0..=100.0).contains(&options.max_nan_pct) {
        return Err(BenchError::Input(format!(
            "--max-nan {}: must be 0 to 100 (per cent)",
            options.max_nan_pct
        )));
    }
    if let Some(q) = options.quantise
        && !(q.step_m > 0.0 && q.step_m < 10.0)
    {
        return Err(BenchError::Input(format!(
            "--quantise {}: must be above 0 and below 10 (metres)",
            q.step_m
        )));
    }
    let images = scheduled(options.images.list()?);
    // The phase step of 27 nm counts against the tolerance; a tighter one gets a finer step.
    let phase_bits = if options.tolerance_m < 1e-7 { 34 } else { crate::lidar::PHASE_BITS };
    let dsm = TileSet::open(&options.lidar, &options, phase_bits)?;
    let dtm = match options.dtm.as_slice() {
        [] => None,
        paths => Some(TileSet::open(paths, &options, phase_bits)?),
    };
    let (plan, budget) = plan::resolve(&options, &dsm);
    let mut warnings = dsm.warnings.clone();
    if let Some(dtm) = &dtm {
        warnings.extend(dtm.warnings.iter().cloned());
        if dtm.vertical_unit != dsm.vertical_unit {
            warnings.push(format!(
                "the bare-earth tiles are in {}, the surface tiles in {}; each is converted by its own",
                dtm.vertical_unit, dsm.vertical_unit
            ));
        }
    }
    if plan.horizontal_m() > options.tolerance_m * (1.0 + 1e-9) {
        warnings.push(format!(
            "the steps that cannot be left out are bounded by {:.1e} m, more than the tolerance of {:.1e} m",
            plan.horizontal_m(),
            options.tolerance_m
        ));
    }
    let mut seen = std::collections::HashSet::new();
    warnings.retain(|warning| seen.insert(warning.clone()));
    Ok(Prepared { options, dsm, dtm, images, budget, plan, warnings })
}

/// Images in an order in which neighbours follow each other (a Hilbert curve over the globe), so
/// that each block is decoded about once; names break ties.
fn scheduled(mut images: Vec<ImageEntry>) -> Vec<ImageEntry> {
    images.sort_by_cached_key(|entry| {
        let key = entry.name.as_ref().map_or(u64::MAX, |name| {
            let c = name.center();
            let cell = |v: f64, span: f64| {
                (((v / span + 0.5) * f64::from(1 << 30)) as u32).min((1 << 30) - 1)
            };
            hilbert(cell(c.lon_deg, 360.0), cell(c.lat_deg, 180.0))
        });
        (key, entry.stem.clone())
    });
    images
}

/// Position on a Hilbert curve of order 30 (x and y below 2^30).
fn hilbert(mut x: u32, mut y: u32) -> u64 {
    let mut d = 0_u64;
    let mut s = 1_u32 << 29;
    while s > 0 {
        let (rx, ry) = (u32::from(x & s > 0), u32::from(y & s > 0));
        d += u64::from(s) * u64::from(s) * u64::from((3 * rx) ^ ry);
        if ry == 0 {
            if rx == 1 {
                x = (s - 1).wrapping_sub(x) & ((1 << 30) - 1);
                y = (s - 1).wrapping_sub(y) & ((1 << 30) - 1);
            }
            std::mem::swap(&mut x, &mut y);
        }
        s >>= 1;
    }
    d
}

impl Prepared {
    /// The images, in the order of work.
    #[must_use]
    pub fn images(&self) -> &[ImageEntry] {
        &self.images
    }

    /// The surface tiles.
    #[must_use]
    pub fn tiles(&self) -> &TileSet {
        &self.dsm
    }

    /// Fits every transform form to every image and its first candidate tile, and says how far the
    /// worst is off; `None` when no image touches a tile.
    #[must_use]
    pub fn measure_transforms(&self) -> Option<TransformMeasure> {
        let size = self.options.size;
        let measured: Vec<FitErrors> = self
            .images
            .par_iter()
            .filter_map(|entry| {
                let center = entry.name.as_ref().ok()?.center();
                let grid = ImageGrid::new(center, self.options.zoom, size, size).ok()?;
                let tile = *self.dsm.candidates(&grid).first()?;
                let crs = self.dsm.crs_of(tile);
                let exact = PixelToCrs::WebMercator { grid, projection: crs.projection.clone() };
                let lattice = self.dsm.tiles()[tile].lattice;
                let errors = PixelMap::fit(exact, lattice, TransformForm::Chebyshev).ok()?.errors();
                let metres = |v: f64| v * crs.metres_per_unit;
                Some(FitErrors {
                    chebyshev: metres(errors.chebyshev),
                    separable: metres(errors.separable),
                    affine: metres(errors.affine),
                })
            })
            .collect();
        let worst = measured.iter().copied().reduce(FitErrors::worst)?;
        Some(TransformMeasure {
            images: measured.len(),
            chebyshev_m: worst.chebyshev,
            separable_m: worst.separable,
            affine_m: worst.affine,
        })
    }

    /// Runs the plan on this shard's images that are not done yet, and (for a whole batch) writes
    /// the manifest.
    ///
    /// # Errors
    /// The output folder cannot be used. Errors of images are in the summary and the manifest.
    pub fn run(&self, stop: &Interrupt) -> Result<RunSummary, BenchError> {
        let out = &self.options.out;
        std::fs::create_dir_all(out).map_err(BenchError::io("make the folder", out))?;
        let _lock = FolderLock::take(out, self.options.shard)?;
        let header = Header {
            plan_hash: self.plan.hash(),
            description: manifest::benchmark_json(&self.plan, &self.dsm, self.dtm.as_ref()),
        };
        let (mut journal, earlier) =
            Journal::open(out, self.options.shard, &header, self.options.overwrite)?;
        if self.options.shard.is_whole() {
            remove_leftovers(out, |name| name.starts_with("satellite_"));
        }
        let workshop = Workshop {
            options: &self.options,
            budget: self.budget,
            dsm: &self.dsm,
            dtm: self.dtm.as_ref(),
        };
        let mine = &self.images[self.options.shard.range(self.images.len())];
        let (kept, todo) = self.sort_out(mine, earlier, &workshop);
        let progress = Progress::new("building", "images", todo.len(), self.options.quiet);
        let mut records = kept;
        let kept_count = records.iter().filter(|r| r.status == Status::Done).count();
        let disk_full = Interrupt::default();
        let batch = Batch {
            out,
            threads: self.options.threads,
            progress: &progress,
            stop,
            disk_full: &disk_full,
        };
        let build = |entry: &&ImageEntry| Some(workshop.build(entry));
        let result = batch.run(&todo, build, &mut journal, |record| records.push(record));
        let seconds = progress.finish();
        result?;
        let mut summary = summarise(&records, mine.len());
        summary.kept = kept_count;
        summary.interrupted = stop.requested() && summary.not_started > 0;
        summary.disk_full = disk_full.requested();
        summary.seconds = seconds;
        summary.bad_tiles = self
            .dsm
            .bad
            .iter()
            .chain(self.dtm.iter().flat_map(|dtm| &dtm.bad))
            .map(|bad| bad.reason.clone())
            .collect();
        summary.warnings = self.dsm.undeclared_nodata();
        summary.warnings.extend(self.dtm.iter().flat_map(TileSet::undeclared_nodata));
        let cache = self.dsm.store().statistics();
        (summary.blocks_decoded, summary.blocks_distinct) =
            (cache.blocks_decoded, cache.blocks_distinct);
        if summary.not_started == 0 {
            journal.complete(self.options.shard, self.images.len() as u64)?;
            if self.options.shard.is_whole() {
                let facts = RunFacts { summary: &summary, threads: self.options.threads, cache };
                manifest::write(out, &header, records, Some(&facts), self.options.stac)?;
            }
        }
        Ok(summary)
    }

    /// Splits this shard's images into those that an earlier run finished and those to do.
    fn sort_out<'a>(
        &'a self,
        mine: &'a [ImageEntry],
        earlier: Journals<Record>,
        workshop: &Workshop<'_>,
    ) -> (Vec<Record>, Vec<&'a ImageEntry>) {
        let mut known: HashMap<String, Record> = earlier.records;
        let (mut kept, mut todo) = (Vec::new(), Vec::new());
        for entry in mine {
            match known.remove(&entry.stem) {
                Some(record) if self.still_holds(&record, entry, workshop) => kept.push(record),
                _ => todo.push(entry),
            }
        }
        (kept, todo)
    }

    /// Whether an earlier result is of the same inputs and its files are there.
    fn still_holds(&self, record: &Record, entry: &ImageEntry, workshop: &Workshop<'_>) -> bool {
        record.status != Status::Failed
            && record.inputs == workshop.fingerprint(entry)
            && record
                .outputs
                .iter()
                .all(|output| output.holds(&self.options.out, self.options.verify))
    }
}

fn summarise(records: &[Record], images: usize) -> RunSummary {
    let count = |status| count_status(records, status);
    RunSummary {
        images,
        done: count(Status::Done),
        skipped: count(Status::Skipped),
        failed: count(Status::Failed),
        not_started: images - records.len(),
        rescued_by_mosaic: records
            .iter()
            .filter(|r| r.reason.contains("--coverage mosaic would leave"))
            .count(),
        reasons: count_reasons(records, generic),
        flagged: records.iter().filter(|r| !r.flags.is_empty()).count(),
        uncertain_px: records.iter().filter_map(|r| r.uncertain_px).sum(),
        ..RunSummary::default()
    }
}

/// A reason without what differs from image to image, so that equal causes are counted together.
fn generic(reason: &str) -> String {
    let head = reason.split("; --coverage").next().unwrap_or(reason);
    if let Some((_, limit)) = head.split_once("no data, more than ") {
        return format!("more than {limit} of the pixels have no data");
    }
    let mut text = String::new();
    for word in head.split_inclusive(' ') {
        if word.contains("satellite_") {
            text.push_str("<image> ");
        } else {
            text.push_str(word);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hilbert_curve_visits_every_cell_once_by_single_steps() {
        let mut cells: Vec<(u64, u32, u32)> =
            (0..16).flat_map(|x| (0..16).map(move |y| (hilbert(x, y), x, y))).collect();
        cells.sort_unstable();
        for (k, pair) in cells.windows(2).enumerate() {
            assert_eq!(cells[k].0, k as u64);
            let step = pair[0].1.abs_diff(pair[1].1) + pair[0].2.abs_diff(pair[1].2);
            assert_eq!(step, 1, "{pair:?}");
        }
    }

    #[test]
    fn reasons_of_one_cause_are_counted_together() {
        let reason = |pct: f64| {
            format!(
                "{pct:.2} % of the pixels have no data, more than 5 %; --coverage mosaic would leave 1.00 %"
            )
        };
        let record = |pct| Record::without_output("x", Status::Skipped, reason(pct));
        let summary = summarise(&[record(7.0), record(9.5)], 3);
        assert_eq!(summary.reasons.len(), 1);
        assert_eq!(
            summary.reasons[0],
            ("skipped: more than 5 % of the pixels have no data".into(), 2)
        );
        assert_eq!((summary.skipped, summary.not_started, summary.rescued_by_mosaic), (2, 1, 2));
    }
}
