//! Benchmark build, from files to files: coverage, rounding, compression.

use super::clock::{Findings, Judged, Subject, Way};
use super::report::Quantity;
use super::truth::{Place, SIDE, ZOOM, rms, spec};
use super::{Setup, TradeoffError};
use crate::batch::Interrupt;
use crate::dsm_bench::{BuildOptions, Coverage, ImageSource, Quantisation, prepare};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::scene::{Options, Scene, simulate};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

pub(super) const COVERAGE: &str = "images reach over the edge of a tile";
pub(super) const QUANTISE: &str = "lidar heights carry less than f32 can hold";
pub(super) const COMPRESSION: &str = "files take space";

/// What a build does unless told otherwise.
pub(super) fn defaults() -> BuildOptions {
    BuildOptions::new(Vec::new(), ImageSource::List(PathBuf::new()), PathBuf::new())
}

/// A simulated delivery on disk: four tiles that meet without overlap in the middle of the city.
struct Delivery {
    folder: TempDir,
}

/// What a build wrote.
struct Built {
    out: PathBuf,
    bytes: u64,
}

impl Delivery {
    fn new(quick: bool) -> Result<Self, TradeoffError> {
        let folder = tempfile::tempdir().map_err(TradeoffError::io("make a folder for a scene"))?;
        let mut spec = spec(if quick { 140.0 } else { 230.0 });
        (spec.tiles.columns, spec.tiles.rows) = (2, 2);
        spec.tiles.overlap_pixels = 0;
        let scene = Scene::new(spec, &Options::default())?;
        simulate(&scene, &folder.path().join("scene"), true, &Interrupt::default())?;
        Ok(Self { folder })
    }

    fn scene(&self) -> PathBuf {
        self.folder.path().join("scene")
    }

    /// Image names with a truth.
    fn names(&self) -> Result<Vec<String>, TradeoffError> {
        let mut names = Vec::new();
        let truth = self.scene().join("truth");
        let read = || TradeoffError::io("list the truth of a scene");
        for entry in std::fs::read_dir(truth).map_err(read())? {
            names.push(entry.map_err(read())?.file_name().to_string_lossy().into_owned());
        }
        names.sort_unstable();
        Ok(names)
    }

    /// Builds all images into a folder of their own.
    fn build(
        &self,
        name: &str,
        threads: usize,
        change: impl Fn(&mut BuildOptions),
    ) -> Result<Built, TradeoffError> {
        let out = self.folder.path().join(name);
        let mut options = BuildOptions::new(
            vec![self.scene().join("lidar")],
            ImageSource::Folder(self.scene().join("vigor").join("Seattle")),
            out.clone(),
        );
        options.threads = threads;
        options.overwrite = true;
        options.quiet = true;
        options.max_nan_pct = 100.0;
        change(&mut options);
        prepare(options)?.run(&Interrupt::default())?;
        let bytes = self.names()?.iter().map(|name| size(&out.join(name))).sum();
        Ok(Built { out, bytes })
    }

    /// All heights of a build, or of the truth, in the order of the names; an image without a DSM has none.
    fn heights(&self, folder: &Path) -> Result<Vec<f32>, TradeoffError> {
        let mut all = Vec::new();
        for name in self.names()? {
            let path = folder.join(&name);
            if path.exists() {
                all.extend(npz::read_one(&path, "dsm")?.into_f32());
            } else {
                all.resize(all.len() + (SIDE * SIDE) as usize, f32::NAN);
            }
        }
        Ok(all)
    }
}

fn size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |metadata| metadata.len())
}

/// One tile an image, or all of them.
pub(super) fn coverage(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let delivery = Delivery::new(setup.quick)?;
    let truth = delivery.heights(&delivery.scene().join("truth"))?;
    let images = delivery.names()?.len() as f64;
    let default = defaults();
    let ways = [("best-tile", Coverage::BestTile), ("mosaic", Coverage::Mosaic)]
        .into_iter()
        .map(|(name, coverage)| {
            let delivery = &delivery;
            Way::new(name, coverage == default.coverage, move || {
                delivery.build(name, setup.threads, |options| options.coverage = coverage)
            })
        })
        .collect();
    let subject = Subject {
        truth: "true heights of a simulated city; four tiles meet in its middle",
        error: Quantity::new("pixels without a height", "%"),
        work: "one image of a benchmark, from files to files".into(),
        units: images,
    };
    setup.clock.measure(subject, ways, |built: &Built| {
        let heights = delivery.heights(&built.out)?;
        let missing = heights.iter().filter(|height| height.is_nan()).count();
        let share = 100.0 * missing as f64 / heights.len() as f64;
        Ok(Judged::new(share).also("RMS height error", "m", rms(&heights, &truth)))
    })
}

/// Heights rounded to multiples of a step.
pub(super) fn quantise(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let delivery = Delivery::new(setup.quick)?;
    let images = delivery.names()?.len() as f64;
    let exact = delivery.build("exact", setup.threads, |_| {})?;
    let truth = delivery.heights(&exact.out)?;
    let usual = defaults().quantise.map(|quantisation| quantisation.step_m);
    let steps = [None, Some(0.01), Some(0.1), Some(0.001), Some(0.05)];
    let ways = steps[..setup.either(3, 5)]
        .iter()
        .enumerate()
        .map(|(k, &step)| {
            let delivery = &delivery;
            let name = step.map_or_else(|| "none".to_owned(), |step: f64| format!("{step} m"));
            Way::new(name, step == usual, move || {
                let built = delivery.build(&format!("step-{k}"), setup.threads, |options| {
                    options.quantise = step.map(|step_m| Quantisation { step_m });
                })?;
                Ok((step, built))
            })
        })
        .collect();
    let subject = Subject {
        truth: "the same benchmark without rounding",
        error: Quantity::new("largest height error", "m"),
        work: "one image of a benchmark, from files to files".into(),
        units: images,
    };
    setup.clock.measure(subject, ways, |(step, built): &(Option<f64>, Built)| {
        let heights = delivery.heights(&built.out)?;
        let most = super::truth::quantile(&heights, &truth, 1.0);
        let judged = Judged::new(most).also("size", "kB", built.bytes as f64 / images / 1e3);
        // Beside the step, the rounding of the stored float.
        Ok(judged.bounded(step.map_or(0.0, |step| step / 2.0 + STORAGE_M)))
    })
}

/// Half a last digit of an `f32` under 1024 m, as the plan of a build states it.
const STORAGE_M: f64 = 1024.0 * f32::EPSILON as f64 / 2.0;

/// Levels of compression.
pub(super) fn compression(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let heights = place.heights(&place.image(ZOOM, SIDE)?)?;
    let heights = &heights;
    let ways = [
        ("stored", Compression::Stored),
        ("fast", Compression::Fast),
        ("small", Compression::Small),
    ]
    .into_iter()
    .map(|(name, level)| {
        Way::new(name, level == Compression::default(), move || {
            let shape = [SIDE as usize, SIDE as usize];
            let data = NpyData::F32(heights);
            Ok(npz::encode(&[NpyArray { name: "dsm", shape: &shape, data }], level))
        })
    })
    .collect();
    let subject = Subject {
        truth: "the heights themselves: every level gives them back bit for bit",
        error: Quantity::new("size", "kB"),
        work: "encoding one DSM of 640 x 640 px".into(),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |bytes: &Vec<u8>| {
        let back = npz::parse(bytes, Path::new("dsm.npz"))?;
        let same = back.iter().any(|(_, array)| {
            let back = array.to_f32();
            back.iter().map(|v| v.to_bits()).eq(heights.iter().map(|v| v.to_bits()))
        });
        let lost = if same { 0.0 } else { f64::NAN };
        Ok(Judged::new(bytes.len() as f64 / 1e3).also("height error", "m", lost))
    })
}
