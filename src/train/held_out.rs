//! Looks at held-out examples with the model as it would be used: pictures for the log, and errors where the
//! truth is known.

use super::error::TrainingError;
use super::journal::Scores;
use super::report::picture;
use crate::batch::write_atomic;
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::render::RenderOptions;
use crate::model::train::optimiser::Named;
use crate::model::train::{Example, Exported};
use crate::model::{Config, Device, Model};
use std::path::{Path, PathBuf};

/// Folder of the pictures in the output folder.
pub const PICTURES: &str = "pictures";

/// Held-out examples and where their pictures go.
#[derive(Debug)]
pub struct HeldOut {
    examples: Vec<Example>,
    folder: PathBuf,
    device: Device,
    /// Metres that one unit of the cube is high: the published scoring.
    unit_m: f64,
}

/// Name of a picture: `kind` is `satellite`, `truth` or `dsm-<step>`.
#[must_use]
pub fn picture_name(index: usize, kind: &str) -> String {
    format!("{index}-{kind}.png")
}

impl HeldOut {
    /// Writes the pictures that do not change, and removes those of steps after `step`, which come again.
    ///
    /// # Errors
    /// [`TrainingError::Io`].
    pub fn new(
        examples: Vec<Example>,
        out: &Path,
        step: u64,
        device: Device,
    ) -> Result<Self, TrainingError> {
        let folder = out.join(PICTURES);
        let unit_m = TRAINING_WIDTH_M / 2.0;
        let held_out = Self { examples, folder, device, unit_m };
        if held_out.examples.is_empty() {
            return Ok(held_out);
        }
        let io = TrainingError::io(&held_out.folder);
        std::fs::create_dir_all(&held_out.folder).map_err(io)?;
        for (later, name) in steps(&held_out.folder).into_iter().filter(|(of, _)| *of > step) {
            tracing::debug!("the picture {name} of step {later} comes again");
            let path = held_out.folder.join(name);
            std::fs::remove_file(&path).map_err(TrainingError::io(&path))?;
        }
        for (index, example) in held_out.examples.iter().enumerate() {
            held_out.write(index, "satellite", &picture::rgb(&example.satellite))?;
            if let Some(truth) = &example.truth {
                let range = picture::range(&truth.surface.data);
                held_out.write(index, "truth", &picture::heights(&truth.surface.data, range))?;
            } else if let Some(depth) = &example.depth {
                held_out.write(index, "truth", &picture::heights(&depth.data, [0.0, 1.0]))?;
            }
        }
        Ok(held_out)
    }

    /// Whether there is nothing to look at.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.examples.is_empty()
    }

    fn write(&self, index: usize, kind: &str, bytes: &[u8]) -> Result<(), TrainingError> {
        let path = self.folder.join(picture_name(index, kind));
        write_atomic(&path, bytes).map_err(TrainingError::io(&path))
    }

    /// Predicts every example with the averaged weights, writes the pictures of a step, and scores it. `None` where
    /// no truth is known.
    ///
    /// # Errors
    /// [`TrainingError::Model`] where the exported model is not one that the program runs; [`TrainingError::Io`].
    pub fn look(&self, step: u64, exported: &Exported) -> Result<Option<Scores>, TrainingError> {
        let config = Config::from_json(&exported.config)?;
        let source = Box::new(Named::new(exported.average.clone()));
        let model = Model::from_source(config, source, &self.device.into())?;
        let mut sums = Sums::default();
        for (index, example) in self.examples.iter().enumerate() {
            let side = example.satellite.width;
            let scene = model.scene(&example.satellite, None, self.unit_m)?;
            let metres = (2.0 * self.unit_m) as f32;
            let dsm = scene.dsm(side, &RenderOptions::default()).height;
            let mut heights: Vec<f32> = dsm.into_iter().map(|height| height * metres).collect();
            let mut range = picture::range(&heights);
            if let Some(truth) = &example.truth {
                let truth = &truth.surface.data;
                let offset = sums.add(&heights, truth);
                heights.iter_mut().for_each(|height| *height -= offset);
                range = picture::range(truth);
            }
            self.write(index, &format!("dsm-{step}"), &picture::heights(&heights, range))?;
        }
        Ok(sums.scores())
    }
}

/// Steps of which a folder holds predicted pictures, with the names of the files.
#[must_use]
pub fn steps(folder: &Path) -> Vec<(u64, String)> {
    let Ok(items) = std::fs::read_dir(folder) else { return Vec::new() };
    let names = items.filter_map(Result::ok).filter_map(|item| item.file_name().into_string().ok());
    let mut steps: Vec<(u64, String)> = names
        .filter_map(|name| {
            let (_, step) = name.strip_suffix(".png")?.split_once("-dsm-")?;
            Some((step.parse().ok()?, name))
        })
        .collect();
    steps.sort();
    steps
}

/// Sums of errors over all pixels.
#[derive(Debug, Default)]
struct Sums {
    examples: usize,
    pixels: u64,
    absolute: f64,
    square: f64,
    flat_absolute: f64,
    flat_square: f64,
}

impl Sums {
    /// Adds one example; the vertical offset that was taken out of the prediction.
    fn add(&mut self, prediction: &[f32], truth: &[f32]) -> f32 {
        let pairs: Vec<(f32, f32)> = prediction
            .iter()
            .zip(truth)
            .filter(|(p, t)| p.is_finite() && t.is_finite())
            .map(|(p, t)| (p - t, *t))
            .collect();
        if pairs.is_empty() {
            return 0.0;
        }
        let offset = median(pairs.iter().map(|(error, _)| *error).collect());
        let level = median(pairs.iter().map(|(_, truth)| *truth).collect());
        self.examples += 1;
        self.pixels += pairs.len() as u64;
        for (error, truth) in pairs {
            let (error, flat) = (f64::from(error - offset), f64::from(truth - level));
            self.absolute += error.abs();
            self.square += error * error;
            self.flat_absolute += flat.abs();
            self.flat_square += flat * flat;
        }
        offset
    }

    fn scores(&self) -> Option<Scores> {
        let pixels = self.pixels as f64;
        (self.pixels > 0).then(|| Scores {
            examples: self.examples,
            mae_m: self.absolute / pixels,
            rmse_m: (self.square / pixels).sqrt(),
            flat_rmse_m: (self.flat_square / pixels).sqrt(),
            flat_mae_m: self.flat_absolute / pixels,
        })
    }
}

/// The lower median of a list that is not empty.
fn median(mut values: Vec<f32>) -> f32 {
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_leave_the_vertical_offset_out() {
        let truth = [0.0, 0.0, 0.0, 10.0, f32::NAN];
        let mut sums = Sums::default();
        // Two metres too high everywhere, and the building half as high.
        assert_eq!(sums.add(&[2.0, 2.0, 2.0, 7.0, 3.0], &truth), 2.0);
        let scores = sums.scores().expect("has pixels");
        assert_eq!((scores.examples, scores.mae_m, scores.rmse_m), (1, 5.0 / 4.0, 2.5));
        assert_eq!((scores.flat_mae_m, scores.flat_rmse_m), (2.5, 5.0));
        assert_eq!(Sums::default().scores(), None);
        assert_eq!(Sums::default().add(&[f32::NAN], &[1.0]), 0.0);
    }

    #[test]
    fn steps_are_told_by_the_names_of_pictures() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["0-dsm-20.png", "1-dsm-5.png", "0-satellite.png", "0-dsm-x.png", "0-dsm-7.jpg"]
        {
            std::fs::write(folder.path().join(name), "").expect("writes");
        }
        assert_eq!(steps(folder.path()), [(5, "1-dsm-5.png".into()), (20, "0-dsm-20.png".into())]);
    }
}
