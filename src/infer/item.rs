//! The work on one image: decode, network, field, heights, encoded files.

use super::GROUND_TOLERANCE;
use super::list::{Entry, Kind};
use super::options::InferOptions;
use super::outputs::{Heights, NOTE_FOOTPRINT, NOTE_LIGHT, NOTE_SAMPLES, NOTE_WEIGHTS, NamedBytes};
use super::record::{GroundFrom, Record};
use super::renders::Subject;
use crate::batch::{Interrupt, OutputFile, Product, Record as _, fingerprint};
use crate::footprint::{Footprint, Place, TRAINING_WIDTH_M};
use crate::illumination::{self, Illumination};
use crate::model::render::{DepthKind, Dsm, LEAST_OPACITY, exact_scale};
use crate::model::scene::{SceneParts, SkyParts};
use crate::model::{Image8, Model, Scene};
use crate::picture;
use crate::plan::runs;
use crate::weights::Identity;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::{Mutex, OnceLock, PoisonError};

/// What a worker needs to know of the run.
pub struct Workshop<'a> {
    pub options: &'a InferOptions,
    /// Absent where all inputs are scene files and no output needs the network.
    pub model: Option<&'a Model>,
    /// Which weights the model has.
    pub identity: Option<&'a Identity>,
    /// Threads of the network and the renderer.
    pub pool: &'a rayon::ThreadPool,
    /// Images that wait for their turn give up when this is set.
    pub stop: &'a Interrupt,
    /// Held by the image whose turn it is: each takes all threads, and the memory of one is enough.
    pub turn: &'a Mutex<()>,
    /// Set where the disk is full, which ends the run.
    pub disk_full: &'a Interrupt,
    /// The light of street views, where there are any.
    pub light: Option<&'a Illumination>,
    /// The sky in that light, computed once for all images.
    pub sky: &'a OnceLock<Result<SkyParts, String>>,
}

/// What became of an image whose turn came.
enum Computed {
    /// The run was stopped before.
    Stopped,
    /// With its heights, where they are wanted.
    Done(Option<Dsm>),
}

/// A decoded input.
enum Source {
    Image(Image8),
    Scene(Box<Scene>),
}

impl Workshop<'_> {
    /// Works on one image. Never fails as a whole, not even by a panic: the record says what happened.
    /// `None` where the run was stopped before the image's turn.
    pub fn build(&self, entry: &Entry) -> Option<Product<Record>> {
        let image = entry.path.file_name().unwrap_or_default().to_string_lossy();
        let mut record = Record::new(&entry.stem, &image, fingerprint(&entry.path));
        let mut files = Vec::new();
        let outcome = catch_unwind(AssertUnwindSafe(|| self.fill(entry, &mut record, &mut files)));
        let outcome = outcome.unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<&str>().copied();
            let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
            Err(format!("the computation broke off: {}", text.unwrap_or("unknown cause")))
        });
        match outcome {
            Ok(true) => {}
            Ok(false) => return None,
            Err(reason) => {
                // A volume is written before the other files are made.
                self.remove_volume(&entry.stem);
                // Where the image lies on this machine is nobody else's business.
                record.fail(reason.replace(&*entry.path.to_string_lossy(), &image));
                files.clear();
            }
        }
        let of_files = files.iter().map(|(file, bytes)| OutputFile::of(file, bytes));
        record.outputs.extend(of_files);
        Some(Product { record, files })
    }

    /// Whether the image was worked on.
    fn fill(
        &self,
        entry: &Entry,
        record: &mut Record,
        files: &mut Vec<NamedBytes>,
    ) -> Result<bool, String> {
        let (source, footprint, scale) = match entry.kind {
            Kind::Picture => self.picture(&entry.path, record)?,
            Kind::Scene => self.scene_file(&entry.path, record)?,
        };
        let unit_m = footprint.vertical_metres_per_unit(self.options.vertical, scale);
        let computed = self.compute(source, &footprint, unit_m, &entry.stem, record, files)?;
        let Computed::Done(dsm) = computed else { return Ok(false) };
        // Encoding leaves the threads to the next image.
        if let Some(dsm) = &dsm {
            let heights = Heights { dsm, metres_per_unit: 2.0 * unit_m };
            self.describe(record, &heights);
            runs("storage");
            if self.options.outputs.dsm {
                runs("npz");
                files.extend(self.npz(&heights, &entry.stem));
            }
            if self.options.outputs.geotiff {
                runs("geotiff");
                files.extend(self.geotiff(&heights, &footprint, &entry.stem, &mut record.flags));
            }
        }
        Ok(true)
    }

    /// All that takes the network or the renderer, one image at a time.
    fn compute(
        &self,
        source: Source,
        footprint: &Footprint,
        unit_m: f64,
        stem: &str,
        record: &mut Record,
        files: &mut Vec<NamedBytes>,
    ) -> Result<Computed, String> {
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        if self.stop.requested() {
            return Ok(Computed::Stopped);
        }
        self.pool.install(|| {
            let (scene, image) = match source {
                Source::Scene(scene) => (self.relit(*scene, unit_m, record)?, None),
                Source::Image(image) => {
                    let model = self.model.ok_or("a picture needs --weights")?;
                    let sky = self.options.outputs.needs_sky().then(|| self.sky()).transpose()?;
                    record.light = self.light.map(|light| light.origin.clone());
                    for id in ["resize", "network", "precision"] {
                        runs(id);
                    }
                    let scene = model.scene(&image, sky, unit_m).map_err(|e| e.to_string())?;
                    (scene, Some(image))
                }
            };
            // The field of every scene is folded when the scene is made.
            runs("fold");
            runs("vertical-scale");
            let size = self.options.size as usize;
            let heights = self.options.outputs.needs_heights();
            let dsm = heights.then(|| {
                runs("rays");
                runs("depth");
                scene.dsm(size, &self.options.render)
            });
            let subject = Subject { scene: &scene, image: image.as_ref(), footprint, unit_m, stem };
            self.renders(&subject, record, files)?;
            Ok(Computed::Done(dsm))
        })
    }

    /// The sky of this run.
    fn sky(&self) -> Result<SkyParts, String> {
        let compute = || {
            runs("sky");
            let (Some(model), Some(light)) = (self.model, self.light) else {
                return Err("street views of this scene need its sky: say --weights".to_owned());
            };
            illumination::sky(model.network.as_ref(), light).map_err(|error| error.to_string())
        };
        self.sky.get_or_init(compute).clone()
    }

    /// A stored scene with the heights and the light of this run. Its own sky stays where no other was
    /// named; `record` comes with that sky's name.
    fn relit(&self, scene: Scene, unit_m: f64, record: &mut Record) -> Result<Scene, String> {
        let stored = scene.parts().sky.is_some() && self.options.illumination.is_none();
        let needed = self.options.outputs.needs_sky();
        let new_sky = needed && !stored;
        if needed {
            // The scene's own, or one that is computed.
            runs("sky");
        }
        if !needed {
            record.light = None;
        } else if new_sky {
            record.light = self.light.map(|light| light.origin.clone());
        }
        if scene.parts().metres_per_unit == unit_m && !new_sky {
            return Ok(scene);
        }
        let mut parts = SceneParts { metres_per_unit: unit_m, ..scene.parts().clone() };
        if new_sky {
            parts.sky = Some(self.sky()?);
        }
        Scene::new(parts).map_err(|error| error.to_string())
    }

    fn picture(
        &self,
        path: &Path,
        record: &mut Record,
    ) -> Result<(Source, Footprint, f64), String> {
        let mut picture = picture::open(path).map_err(|error| error.to_string())?;
        let gsd_m = self.options.gsd_m;
        let footprint = picture.footprint(gsd_m).map_err(|error| error.to_string())?;
        let placed = picture.place().is_some();
        record.flags.extend(picture.warnings().iter().cloned());
        self.describe_ground(record, &footprint, placed)?;
        runs("decode");
        let image = picture.read().map_err(|error| error.to_string())?;
        let scale = self.model.map_or(1.0, |model| model.config.scale);
        Ok((Source::Image(image), footprint, scale))
    }

    fn scene_file(
        &self,
        path: &Path,
        record: &mut Record,
    ) -> Result<(Source, Footprint, f64), String> {
        let (scene, notes) = Scene::load_with_notes(path).map_err(|error| error.to_string())?;
        let unnamed = || "the sky that the scene was saved with".to_owned();
        let light = notes.get(NOTE_LIGHT).cloned().unwrap_or_else(unnamed);
        record.light = scene.parts().sky.is_some().then_some(light);
        if let (Some(made), Some(here)) = (notes.get(NOTE_WEIGHTS), self.identity)
            && *made != here.sampled_sha256
        {
            record.flags.push(
                "the scene was made with other weights than those that sharpen or light its views"
                    .into(),
            );
        }
        let samples = self.options.render.samples;
        let taken = format!("{},{}", samples.coarse(), samples.fine());
        if let Some(noted) = notes.get(NOTE_SAMPLES).filter(|noted| **noted != taken)
            && self.options.samples.is_none()
        {
            record.flags.push(format!(
                "rendered with {taken} samples a ray, and first with {noted} (--samples {noted})"
            ));
        }
        let noted = notes.get(NOTE_FOOTPRINT);
        let noted: Option<Footprint> = noted.and_then(|json| serde_json::from_str(json).ok());
        // A scene whose size was assumed when it was saved is no better known now.
        let known =
            noted.as_ref().is_some_and(|noted| *noted != Footprint::of_training(noted.size_px));
        // A scene by itself has no pixels; any number stands for the training's ground.
        let mut footprint = noted.unwrap_or_else(|| Footprint::of_training([self.options.size; 2]));
        if let Some(gsd_m) = self.options.gsd_m {
            footprint.gsd_m = gsd_m;
        }
        self.describe_ground(record, &footprint, known)?;
        let scale = exact_scale(scene.field().scale());
        Ok((Source::Scene(Box::new(scene)), footprint, scale))
    }

    fn describe_ground(
        &self,
        record: &mut Record,
        footprint: &Footprint,
        placed: bool,
    ) -> Result<(), String> {
        runs("ground-size");
        let from = match (self.options.gsd_m, placed) {
            (Some(_), _) => GroundFrom::Option,
            (None, true) => GroundFrom::Place,
            (None, false) => GroundFrom::Assumed,
        };
        record.size_px = Some(footprint.size_px);
        record.ground_m = Some(footprint.ground_m());
        record.ground_from = Some(from);
        if let Some(on_earth) = footprint.georeference().map_err(|error| error.to_string())? {
            let center = on_earth.center().map_err(|error| error.to_string())?;
            (record.lat_deg, record.lon_deg) = (Some(center.lat_deg), Some(center.lon_deg));
            record.flags.extend(on_earth.warnings().iter().cloned());
        }
        if let Some(Place::WebMercator(grid)) = &footprint.place {
            let stated = grid.ground_sample_distance();
            let [across, _] = footprint.gsd_m;
            if (across / stated - 1.0).abs() > 0.01 {
                record.flags.push(format!(
                    "--gsd says {across:.4} m per pixel and the place {stated:.4}; a GeoTIFF lies where the place says"
                ));
            }
        }
        if from == GroundFrom::Assumed {
            record.flags.push(format!(
                "nothing says how large the image is on the ground: taken to be {TRAINING_WIDTH_M} m wide, as those of the training (--gsd says otherwise)"
            ));
        }
        if let Some(text) = other_ground(footprint) {
            record.other_ground = true;
            record.flags.push(text);
        }
        Ok(())
    }

    fn describe(&self, record: &mut Record, heights: &Heights<'_>) {
        record.metres_per_unit = Some(heights.metres_per_unit);
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        let (mut sum, mut count) = (0.0_f64, 0_u64);
        for height in heights.metres().into_iter().filter(|height| !height.is_nan()) {
            (low, high) = (low.min(height), high.max(height));
            sum += f64::from(height);
            count += 1;
        }
        if count > 0 {
            record.min_m = Some(f64::from(low));
            record.max_m = Some(f64::from(high));
            record.mean_m = Some(sum / count as f64);
        }
        let opacity = &heights.dsm.opacity;
        let total: f64 = opacity.iter().map(|&value| f64::from(value)).sum();
        record.opacity = Some(total / opacity.len() as f64);
        let empty = opacity.iter().filter(|&&value| f64::from(value) < LEAST_OPACITY).count();
        record.no_surface_px = Some(empty as u64);
        if empty > 0 && self.options.render.depth_kind() == DepthKind::Raw {
            record.flags.push(format!(
                "{empty} pixels met no surface; raw depth shows them near the top of the cube (--depth normalised leaves them empty)"
            ));
        }
    }
}

/// What is wrong with the size on the ground, in words; `None` where it is the training's.
pub fn other_ground(footprint: &Footprint) -> Option<String> {
    let [across, down] = footprint.ground_m();
    let off = |metres: f64| (metres / TRAINING_WIDTH_M - 1.0).abs() > GROUND_TOLERANCE;
    (off(across) || off(down)).then(|| {
        format!(
            "{across:.1} x {down:.1} m on the ground, {:.2} x {:.2} times the {TRAINING_WIDTH_M} m that the network was trained on",
            across / TRAINING_WIDTH_M,
            down / TRAINING_WIDTH_M,
        )
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;
    use crate::batch::Status;
    use crate::infer::Outputs;
    use crate::model::weights::TensorSource;
    use crate::model::weights::rule::{RuleWeights, tiny_overrides};
    use crate::model::{Config, Device, ModelError};
    use std::sync::Arc;

    /// Made-up weights that keep a list of what was read, and fail or panic at a key.
    struct Watched {
        weights: RuleWeights,
        read: Arc<Mutex<Vec<String>>>,
        panics_at: Option<&'static str>,
    }

    impl TensorSource for Watched {
        fn read(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
            assert!(self.panics_at.is_none_or(|part| !key.contains(part)), "at {key}");
            self.read.lock().unwrap().push(key.to_owned());
            self.weights.read(key, shape)
        }
    }

    fn build(panics_at: Option<&'static str>) -> (Product<Record>, Vec<String>) {
        let config = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("crates/sat3d-model/fixtures/tiny/model/config.json");
        let config = Config::from_json(&std::fs::read_to_string(config).unwrap()).unwrap();
        let read = Arc::new(Mutex::new(Vec::new()));
        let weights = RuleWeights::new(&config, tiny_overrides());
        let source = Watched { weights, read: Arc::clone(&read), panics_at };
        let model = Model::from_source(config, Box::new(source), &Device::Cpu.into()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.png");
        image::RgbImage::from_fn(30, 20, |x, y| image::Rgb([x as u8, y as u8, 7]))
            .save(&path)
            .unwrap();
        let mut options = InferOptions::new(path.clone(), None, folder.path().to_owned());
        options.outputs = Outputs { geotiff: true, scene: true, ..Outputs::default() };
        options.size = 8;
        let workshop = Workshop {
            options: &options,
            model: Some(&model),
            identity: None,
            pool: &rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap(),
            stop: &Interrupt::default(),
            turn: &Mutex::new(()),
            disk_full: &Interrupt::default(),
            light: None,
            sky: &OnceLock::new(),
        };
        let entry = Entry { stem: "image".into(), path, kind: Kind::Picture };
        let product = workshop.build(&entry).unwrap();
        drop(model);
        let read = std::mem::take(&mut *read.lock().unwrap());
        (product, read)
    }

    #[test]
    fn heights_read_no_weights_of_the_sky_nor_of_the_super_resolution() {
        let (product, read) = build(None);
        assert_eq!(product.record.reason, "");
        let files: Vec<&str> = product.files.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(files, ["image.scene.safetensors", "image.npz", "image.tif"]);
        let mut recorded: Vec<&str> =
            product.record.outputs.iter().map(|output| output.file.as_str()).collect();
        recorded.sort_unstable();
        assert_eq!(recorded, ["image.npz", "image.scene.safetensors", "image.tif"]);
        let of = |part: &str| read.iter().filter(|key| key.starts_with(part)).count();
        assert!(
            of("unet_model.dino_model.") > 10 && of("unet_model.decoder.") > 10 && of("mlp.") > 5
        );
        assert_eq!((of("sky_"), of("sr_module.")), (0, 0), "{read:?}");
    }

    #[test]
    fn a_panic_of_the_network_is_a_failed_item() {
        let (product, _) = build(Some("decoder.conv_in"));
        assert_eq!(product.record.status, Status::Failed);
        assert!(
            product.record.reason.contains("the computation broke off: at"),
            "{}",
            product.record.reason
        );
        assert!(product.files.is_empty() && product.record.outputs.is_empty());
    }
}
