//! Simulated scenes: a pool of large ones, from which crops are cut.
//!
//! A scene is made when a crop is first cut from it, on whichever thread cuts; a crop, its turn and its
//! colours depend on the seed and the draw alone.

use super::augment::{Colours, Crop};
use super::scenes::{Make, Rendered, Scenes, Series, StreetView, random_city};
use super::{Order, Skip, SkipReason, Source};
use crate::model::train::mini::METRES_PER_UNIT;
use crate::model::train::{Class, Example, Street, Truth};
use crate::model::{Grid, Image8};
use crate::random::Draw;
use crate::train::settings::SimulatedSettings;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::sync::{Arc, Mutex, PoisonError};

/// Purpose of the crops' random numbers.
const PURPOSE: u64 = 0xC20F;

/// Height of the release's street camera in the cube, before scaling.
const CAMERA_Z: f64 = -0.85;

/// A place of the pool: the scene that it holds, by number.
type Slot = Mutex<Option<(u64, Arc<Rendered>)>>;

/// Crops of simulated scenes.
pub struct Simulated {
    settings: SimulatedSettings,
    seed: u64,
    order: Order,
    scenes: Scenes,
    held_out: Scenes,
    /// As many as memory allows; scenes beyond them are made for each crop.
    slots: Vec<Slot>,
}

impl Simulated {
    /// Of checked settings; `seed` is the training's. `street` says whether panoramas are wanted.
    #[must_use]
    pub fn new(settings: &SimulatedSettings, seed: u64, street: bool) -> Self {
        let views = if street { settings.views } else { 0 };
        Self::of(&SimulatedSettings { views, ..settings.clone() }, seed, || Box::new(random_city))
    }

    /// As [`Simulated::new`], with another maker of scenes.
    fn of(settings: &SimulatedSettings, seed: u64, make: impl Fn() -> Box<Make>) -> Self {
        let series = |seed| Series {
            seed,
            side: settings.scene_side,
            pixel_m: settings.pixel_m,
            views: settings.views,
            panorama: settings.panorama_width,
        };
        let cache = settings.cache.as_deref();
        let room = (settings.memory_mib << 20) / Rendered::bytes(&series(0));
        Self {
            seed,
            order: Order::new(seed, settings.scenes),
            scenes: Scenes::new(series(settings.seed), make(), cache),
            held_out: Scenes::new(
                // Looked at from above alone.
                Series { views: 0, ..series(settings.held_out_seed) },
                make(),
                cache,
            ),
            slots: (0..room.min(settings.scenes)).map(|_| Slot::default()).collect(),
            settings: settings.clone(),
        }
    }

    /// The scene in a place of the pool, as it is in a pass.
    fn scene(&self, pass: u64, place: usize) -> Result<Arc<Rendered>, Skip> {
        let pool = pass.checked_div(self.settings.passes).unwrap_or(0);
        let index = pool * self.settings.scenes as u64 + place as u64;
        let make = || {
            self.scenes.get(index).map(Arc::new).map_err(|cause| Skip {
                item: format!("scene {index}"),
                reason: SkipReason::Scene { index, cause },
            })
        };
        let Some(slot) = self.slots.get(place) else { return make() };
        // Held while the scene is made: whoever else wants it waits instead of making it twice.
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        match slot.as_ref() {
            Some((known, scene)) if *known == index => Ok(Arc::clone(scene)),
            // A thread that lags behind, in the pool before: the newer scene stays.
            Some((known, _)) if *known > index => make(),
            _ => {
                let scene = make()?;
                *slot = Some((index, Arc::clone(&scene)));
                Ok(scene)
            }
        }
    }
}

impl Source for Simulated {
    fn len(&self) -> usize {
        self.settings.scenes
    }

    fn example(&self, draw: u64, attempt: usize) -> Result<Example, Skip> {
        let (pass, place) = self.order.at(draw);
        let place = (place + attempt) % self.settings.scenes;
        let scene = self.scene(pass, place)?;
        let mut random = Draw::new(&[self.seed, PURPOSE, draw]);
        let settings = &self.settings;
        let (whole, side, symmetries) = (scene.side, settings.side, settings.symmetries);
        let view = scene.views.get(random.index(scene.views.len()));
        let crop = match view {
            Some(view) => Crop::around(view.at, whole, side, symmetries, &mut random),
            None => Crop::draw(whole, side, symmetries, &mut random),
        };
        let colours = Colours::draw(settings.colour, &mut random);
        Ok(cut(&scene, crop, view, &colours, format!("scene {place}, draw {draw}")))
    }

    fn held_out(&self, count: usize) -> Vec<Example> {
        let same = Colours::draw(0.0, &mut Draw::new(&[0]));
        (0..count as u64)
            .into_par_iter()
            .filter_map(|index| {
                let scene = self.held_out.get(index).ok()?;
                let crop = Crop::centre(scene.side, self.settings.side);
                Some(cut(&scene, crop, None, &same, format!("held-out scene {index}")))
            })
            .collect()
    }

    fn identity(&self) -> Value {
        let s = &self.settings;
        json!({
            "seed": s.seed, "scenes": s.scenes, "passes": s.passes, "scene_side": s.scene_side,
            "side": s.side, "pixel_m": s.pixel_m, "symmetries": s.symmetries, "colour": s.colour,
            "held_out_seed": s.held_out_seed, "views": s.views,
            "panorama_width": (s.views > 0).then_some(s.panorama_width),
        })
    }

    fn describe(&self) -> String {
        let s = &self.settings;
        let street = match s.views {
            0 => String::new(),
            views => format!(", {views} panoramas of {} px each", s.panorama_width),
        };
        format!(
            "{} simulated scenes of {} px ({} m a pixel){street}, crops of {} px",
            s.scenes, s.scene_side, s.pixel_m, s.side
        )
    }
}

/// The example that a window of a scene makes.
fn cut(
    scene: &Rendered,
    crop: Crop,
    view: Option<&StreetView>,
    colours: &Colours,
    name: String,
) -> Example {
    let (side, area) = (crop.side, crop.side * crop.side);
    let mut rgb = Vec::with_capacity(3 * area);
    let mut surface = Vec::with_capacity(area);
    let mut classes = Vec::with_capacity(area);
    let mut ground = Vec::with_capacity(area);
    for index in crop.indices() {
        let pixel = [0, 1, 2].map(|channel| scene.rgb[3 * index + channel]);
        rgb.extend(colours.of(pixel));
        surface.push(f64::from(scene.surface[index]));
        ground.push(f64::from(scene.ground[index]));
        classes.push(class(scene.classes[index]));
    }
    // Heights count from the mean bare earth of what the network sees.
    let mean = ground.iter().sum::<f64>() / area as f64;
    let over_mean =
        |heights: Vec<f64>| heights.into_iter().map(|h| (h - mean) as f32).collect::<Vec<f32>>();
    let (surface, ground) = (over_mean(surface), over_mean(ground));
    let depth = relative(&surface);
    let grid = |heights| Grid::new(1, side, side, heights);
    Example {
        name,
        satellite: Image8 { width: side, height: side, channels: 3, data: rgb },
        depth: Some(grid(depth)),
        truth: Some(Truth { surface: grid(surface), ground: grid(ground), classes }),
        street: view.map(|view| street(scene, crop, view, mean, colours)),
    }
}

/// A panorama turned as its crop is; `ground` is the height that the crop's heights count from.
fn street(
    scene: &Rendered,
    crop: Crop,
    view: &StreetView,
    ground: f64,
    colours: &Colours,
) -> Street {
    let height = (view.sky.len() / 2).isqrt();
    let width = 2 * height;
    let columns: Vec<usize> =
        (0..width).map(|column| crop.symmetry.panorama_column(column, width)).collect();
    let mut rgb = Vec::with_capacity(3 * width * height);
    let mut sky = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in &columns {
            let from = row * width + column;
            rgb.extend(colours.of([0, 1, 2].map(|channel| view.rgb[3 * from + channel])));
            sky.push(view.sky[from]);
        }
    }
    let [column, row] = view.at;
    let [right, down] = crop.place([column as f64 + 0.5, row as f64 + 0.5]);
    // The camera of the release stands 2.5 m over the mean bare earth; this one over its own.
    let rise = f64::from(scene.ground[row * scene.side + column]) - ground;
    let z = CAMERA_Z + rise / f64::from(METRES_PER_UNIT);
    let image = |channels, data| Image8 { width, height, channels, data };
    Street {
        panorama: image(3, rgb),
        sky: image(1, sky),
        position: [down as f32, right as f32, z as f32],
    }
}

/// Heights moved and scaled to [0, 1]: what a perfect estimator of relative depth would say. A flat scene is 0.
fn relative(heights: &[f32]) -> Vec<f32> {
    let known = || heights.iter().copied().filter(|height| height.is_finite());
    let low = known().fold(f32::INFINITY, f32::min);
    let high = known().fold(f32::NEG_INFINITY, f32::max);
    let scale = if high > low { 1.0 / (high - low) } else { 0.0 };
    let value = |height: f32| if height.is_finite() { (height - low) * scale } else { 0.0 };
    heights.iter().map(|height| value(*height)).collect()
}

const fn class(number: u8) -> Class {
    match number {
        1 => Class::Building,
        2 => Class::Tree,
        3 => Class::Water,
        _ => Class::Ground,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::settings::Symmetries;

    fn settings() -> SimulatedSettings {
        SimulatedSettings {
            symmetries: Symmetries::Square,
            scenes: 4,
            passes: 2,
            scene_side: 40,
            side: 32,
            memory_mib: 1,
            views: 0,
            ..SimulatedSettings::default()
        }
    }

    /// A slope to the east on a slope to the south; every scene higher than the one before.
    fn slopes(series: &Series, index: u64) -> Result<Rendered, String> {
        let side = series.side;
        let at = |i: usize| ((i % side) as f32, (i / side) as f32);
        let area = side * side;
        Ok(Rendered {
            side,
            rgb: (0..3 * area).map(|i| (i % 251) as u8).collect(),
            ground: (0..area).map(|i| at(i).1 * 0.5 + index as f32).collect(),
            surface: (0..area).map(|i| at(i).1 * 0.5 + at(i).0 + index as f32).collect(),
            classes: (0..area).map(|i| (i % 4) as u8).collect(),
            views: Vec::new(),
        })
    }

    fn source(settings: &SimulatedSettings) -> Simulated {
        Simulated::of(settings, 9, || Box::new(slopes))
    }

    #[test]
    fn a_draw_decides_its_example_whatever_came_before_and_however_much_is_held() {
        let (all, few) =
            (source(&settings()), source(&SimulatedSettings { memory_mib: 0, ..settings() }));
        assert_eq!((all.slots.len(), few.slots.len()), (4, 0));
        let draws = [0, 1, 7, 8, 30, 2, 9];
        let first: Vec<Example> = draws.iter().map(|d| all.example(*d, 0).expect("is")).collect();
        for (draw, example) in draws.iter().zip(&first).rev() {
            assert_eq!(&few.example(*draw, 0).expect("is"), example);
            assert_eq!(&all.example(*draw, 0).expect("is"), example);
        }
        assert_ne!(first[0], first[1]);
    }

    #[test]
    fn the_pool_is_replaced_after_its_passes() {
        let source = source(&settings());
        let pools: Vec<u64> = (0..4)
            .map(|pass| {
                source.scene(pass, 1).expect("is made");
                source.slots[1].lock().expect("locks").as_ref().expect("held").0
            })
            .collect();
        assert_eq!(pools, [1, 1, 5, 5]);
        // A thread that lags behind gets its old scene and does not put it back.
        let old = source.scene(0, 1).expect("is made");
        assert_eq!(old.ground[0], 1.0);
        assert_eq!(source.slots[1].lock().expect("locks").as_ref().expect("held").0, 5);
    }

    #[test]
    fn heights_count_from_the_mean_bare_earth_of_the_crop() {
        let settings =
            SimulatedSettings { symmetries: Symmetries::None, colour: 0.0, ..settings() };
        let source = source(&settings);
        for draw in 0..8 {
            let example = source.example(draw, 0).expect("is");
            let truth = example.truth.expect("has heights");
            // surface - mean ground = x + 0.5 (y - mean y), whichever scene and window.
            let mean_y = 15.5;
            let first = truth.surface.data[0];
            for (i, height) in truth.surface.data.iter().enumerate() {
                let (x, y) = ((i % 32) as f32, (i / 32) as f32);
                assert!((height - first - x - 0.5 * y).abs() < 1e-4);
            }
            let offset = first + 0.5 * mean_y;
            assert!((offset - offset.round()).abs() < 1e-4 && (0.0..=8.0).contains(&offset));
            let depth = example.depth.expect("has depth");
            assert_eq!((depth.data[0], depth.data[1023]), (0.0, 1.0));
        }
    }

    #[test]
    fn picture_heights_and_classes_are_turned_alike() {
        let make = |_: &Series, _: u64| {
            let area = 40 * 40;
            Ok(Rendered {
                side: 40,
                rgb: (0..area).flat_map(|i| [(i % 200) as u8; 3]).collect(),
                surface: (0..area).map(|i| (i % 200) as f32).collect(),
                ground: vec![0.0; area],
                classes: (0..area).map(|i| (i % 200 % 4) as u8).collect(),
                views: Vec::new(),
            })
        };
        let settings = SimulatedSettings { colour: 0.0, ..settings() };
        let source = Simulated::of(&settings, 1, || Box::new(make));
        for draw in 0..16 {
            let example = source.example(draw, 0).expect("is");
            let truth = example.truth.expect("has heights");
            for (i, height) in truth.surface.data.iter().enumerate() {
                assert_eq!(f32::from(example.satellite.data[3 * i]), *height);
                assert_eq!(truth.classes[i], class((*height as u8) % 4));
            }
        }
    }

    #[test]
    fn held_out_scenes_are_others() {
        let source =
            Simulated::new(&SimulatedSettings { scene_side: 64, side: 64, ..settings() }, 0, false);
        let held_out = source.held_out(3);
        assert_eq!(held_out.len(), 3);
        assert_eq!(source.held_out(3), held_out);
        let learnt: Vec<Example> = (0..8).map(|d| source.example(d, 0).expect("is")).collect();
        assert!(held_out.iter().all(|h| learnt.iter().all(|l| l.truth != h.truth)));
    }

    #[test]
    fn panoramas_of_a_real_scene_see_its_sky_and_stand_in_its_streets() {
        let settings = SimulatedSettings {
            scenes: 2,
            scene_side: 96,
            side: 64,
            pixel_m: 0.6,
            views: 2,
            panorama_width: 32,
            ..SimulatedSettings::default()
        };
        let source = Simulated::new(&settings, 3, true);
        let mut streets = 0;
        for draw in 0..6 {
            let example = source.example(draw, 0).expect("is");
            let Some(street) = example.street else { continue };
            streets += 1;
            assert_eq!((street.panorama.width, street.panorama.height), (32, 16));
            assert_eq!(street.sky.data.len(), 32 * 16);
            // The zenith is sky and the nadir is not, but under a crown.
            assert_eq!(street.sky.data[31 * 16], 0);
            let [down, right, z] = street.position;
            assert!(
                down.abs() < 1.0 && right.abs() < 1.0 && (z + 0.85).abs() < 0.5,
                "{down} {right} {z}"
            );
        }
        assert!(streets > 0);
        assert!(Simulated::new(&settings, 3, false).example(0, 0).expect("is").street.is_none());
    }

    #[test]
    fn a_scene_that_cannot_be_made_is_skipped_with_its_reason() {
        let make = |series: &Series, index: u64| match index {
            2 => Err("no room for its streets".to_owned()),
            _ => slopes(series, index),
        };
        let source = Simulated::of(&settings(), 9, || Box::new(make));
        let skips: Vec<Skip> = (0..4).filter_map(|draw| source.example(draw, 0).err()).collect();
        assert_eq!(skips.len(), 1);
        assert!(skips[0].reason.to_string().contains("no room"), "{}", skips[0].reason);
        assert!((0..4).all(|draw| (0..2).any(|k| source.example(draw, k).is_ok())));
    }
}
