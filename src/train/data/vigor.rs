//! The VIGOR data set, as the reference's loader reads it (MODEL_SPEC sections 2, 9.3 and 11).
//!
//! Beside VIGOR's own folders there are, for each city, `pano_sky_mask/<panorama>.png` and
//! `sat_depth/<satellite image>_depth.png`.

use super::image_file::{grey, open, pillow_grey, rgb};
use super::vigor_list::{Item, Pairs};
use super::{Order, Skip, SkipReason, Source};
use crate::model::preprocess::resize_bicubic;
use crate::model::train::{Example, Street};
use crate::model::{Grid, Image8};
use crate::train::error::TrainingError;
use crate::train::settings::VigorSettings;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// Pairs of a panorama and a satellite image.
pub struct Vigor {
    settings: VigorSettings,
    items: Vec<Item>,
    held_out: Vec<Item>,
    order: Order,
    /// Items that are known to be no good: each is looked at once.
    bad: Mutex<HashMap<usize, SkipReason>>,
}

impl Vigor {
    /// Opens the folder of checked settings; `seed` is the training's.
    ///
    /// # Errors
    /// [`TrainingError::Layout`], [`TrainingError::Syntax`] for a manifest that is none, and
    /// [`TrainingError::NothingLeft`] where the part asked for has no pairs.
    pub fn open(settings: &VigorSettings, seed: u64) -> Result<Self, TrainingError> {
        let pairs = Pairs::read(settings)?;
        let items = pairs.items(&settings.split, settings);
        if items.is_empty() {
            let cities = match &settings.cities[..] {
                [] => String::new(),
                some => format!(" of {}", some.join(", ")),
            };
            return Err(TrainingError::NothingLeft {
                what: settings.folder.display().to_string(),
                why: format!(
                    "no label names a panorama{cities} for the split `{}`; `sat3d vigor ingest` says what there is",
                    settings.split
                ),
            });
        }
        let held_out = match settings.held_out_split == settings.split {
            true => Vec::new(),
            false => pairs.items(&settings.held_out_split, settings),
        };
        let order = Order::new(seed, items.len());
        Ok(Self {
            settings: settings.clone(),
            items,
            held_out,
            order,
            bad: Mutex::new(HashMap::new()),
        })
    }

    fn load(&self, item: &Item) -> Result<Example, SkipReason> {
        let [down, right] = item.position;
        if !(down.abs() <= 1.0 && right.abs() <= 1.0) {
            let [x, y] = [right, down].map(|value| format!("{value:.3}"));
            return Err(SkipReason::Outside { x, y });
        }
        let street = match self.settings.street {
            true => Some(self.street(item)?),
            false => None,
        };
        let side = self.settings.side;
        let satellite = rgb(open(&item.satellite, "satellite image")?);
        let depth = match &item.depth {
            Some(path) => depth_label(path, side)?,
            None => None,
        };
        Ok(Example {
            name: item.name.clone(),
            satellite: resize_bicubic(&satellite, side, side),
            truth: None,
            street,
            depth,
        })
    }

    fn street(&self, item: &Item) -> Result<Street, SkipReason> {
        // The cheap questions first: a data set without masks is told apart quickly.
        for (what, path) in [("panorama", &item.panorama), ("sky mask", &item.sky_mask)] {
            if !path.exists() {
                return Err(SkipReason::Missing { what, path: path.clone() });
            }
        }
        let panorama = rgb(open(&item.panorama, "panorama")?);
        let size = |image: &Image8| format!("{} x {}", image.width, image.height);
        if panorama.width != 2 * panorama.height {
            return Err(SkipReason::Size {
                what: "panorama",
                path: item.panorama.clone(),
                found: size(&panorama),
                expected: "twice as wide as high".to_owned(),
            });
        }
        let sky = grey(open(&item.sky_mask, "sky mask")?);
        if (sky.width, sky.height) != (panorama.width, panorama.height) {
            return Err(SkipReason::Size {
                what: "sky mask",
                path: item.sky_mask.clone(),
                found: size(&sky),
                expected: format!("the panorama's {}", size(&panorama)),
            });
        }
        let [down, right] = item.position.map(|value| value as f32);
        Ok(Street { panorama, sky, position: [down, right, self.settings.camera_z] })
    }
}

/// Relative depth from above: resized as a colour image, then grey, as the reference has it. `None` where there
/// is no label.
fn depth_label(path: &Path, side: usize) -> Result<Option<Grid>, SkipReason> {
    let image = match open(path, "depth label") {
        Ok(image) => rgb(image),
        Err(SkipReason::Missing { .. }) => return Ok(None),
        Err(other) => return Err(other),
    };
    let small = pillow_grey(&resize_bicubic(&image, side, side).data);
    let values = small.into_iter().map(|value| f32::from(value) / 255.0).collect();
    Ok(Some(Grid::new(1, side, side, values)))
}

impl Source for Vigor {
    fn len(&self) -> usize {
        self.items.len()
    }

    fn example(&self, draw: u64, attempt: usize) -> Result<Example, Skip> {
        let (_, first) = self.order.at(draw);
        let index = (first + attempt) % self.items.len();
        let item = &self.items[index];
        let bad = || self.bad.lock().unwrap_or_else(PoisonError::into_inner);
        let known = bad().get(&index).cloned();
        known.map_or_else(|| self.load(item), Err).map_err(|reason| {
            bad().insert(index, reason.clone());
            Skip { item: item.name.clone(), reason }
        })
    }

    fn held_out(&self, count: usize) -> Vec<Example> {
        let items = self.held_out.len();
        let count = count.min(items);
        // Spread over the list, which is sorted by city and file.
        (0..count)
            .filter_map(|i| {
                let item = &self.held_out[i * items / count];
                let example = self.load(item);
                if let Err(reason) = &example {
                    tracing::warn!("held-out example {}: {reason}", item.name);
                }
                example.ok()
            })
            .collect()
    }

    fn identity(&self) -> Value {
        let mut hash = Sha256::new();
        for item in &self.items {
            let [down, right] = item.position;
            hash.update(format!("{} {down} {right}\n", item.name));
        }
        let s = &self.settings;
        json!({
            "items": self.items.len(), "list": crate::plan::hex(&hash.finalize()), "street": s.street,
            "depth": s.depth, "sky_masks": s.sky_masks, "camera_z": s.camera_z, "side": s.side,
        })
    }

    fn describe(&self) -> String {
        format!(
            "{} panoramas of {} ({})",
            self.items.len(),
            self.settings.folder.display(),
            self.settings.split
        )
    }
}

#[cfg(test)]
#[path = "vigor_tests.rs"]
mod tests;
