//! Three scenes that call for different effects: what `docs/effects.md` says of them holds.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use sat3d::grid::{ImageGrid, LonLat};
use sat3d::plan::Step;
use sat3d::scene::lidar::{Layer, Survey};
use sat3d::scene::pixels::PixelPositions;
use sat3d::scene::{Effect, Options, Scene, SceneSpec};
use std::collections::BTreeSet;
use std::path::Path;

const SCENES: [&str; 3] = ["flat_noon", "hilly_waterfront", "towers_off_nadir"];
/// Pixels of the picture across and down, 0.8 m each.
const SIDE: u32 = 64;
const ZOOM: u8 = 17;

fn file(path: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn scene(name: &str, options: &Options) -> Scene {
    let spec = SceneSpec::read(&file(&format!("pipelines/scenes/{name}.toml"))).unwrap();
    Scene::new(spec, options).unwrap()
}

fn called_for(scene: &Scene) -> BTreeSet<Effect> {
    let on = |effect: &Effect| scene.plan.step(effect.id()).unwrap().on;
    Effect::ALL.into_iter().filter(on).collect()
}

/// What is compared: rows of lidar cells through the whole scene, and a picture of its middle.
struct Sample {
    heights: Vec<Option<f64>>,
    picture: Vec<u8>,
    pixel_m: f64,
}

impl Sample {
    fn of(scene: &Scene) -> Self {
        let survey = Survey::new(scene);
        let lines = (-300..300).step_by(25);
        let heights = lines
            .flat_map(|row| (-320..320).step_by(2).map(move |column| (column, row)))
            .map(|(column, row)| survey.height(Layer::Dsm, column, row))
            .collect();
        let place = &scene.spec.place;
        let center = LonLat { lon_deg: place.longitude_degrees, lat_deg: place.latitude_degrees };
        let grid = ImageGrid::new(center, ZOOM, SIDE, SIDE).unwrap();
        let pixels = PixelPositions::new(&grid, &scene.frame, 0).unwrap();
        let pixel_m = grid.ground_sample_distance();
        Self { heights, picture: scene.render(&pixels, 1), pixel_m }
    }

    /// Largest difference of heights; infinite where one has a height and the other has none.
    fn heights_from(&self, other: &Self) -> f64 {
        let pairs = self.heights.iter().zip(&other.heights);
        pairs
            .map(|pair| match pair {
                (Some(a), Some(b)) => (a - b).abs(),
                (None, None) => 0.0,
                _ => f64::INFINITY,
            })
            .fold(0.0, f64::max)
    }

    fn pixels_from(&self, other: &Self) -> usize {
        let (a, b) = (self.picture.as_chunks::<3>().0, other.picture.as_chunks::<3>().0);
        a.iter().zip(b).filter(|(a, b)| a != b).count()
    }
}

#[test]
fn the_documented_effects_are_the_ones_called_for() {
    let page = std::fs::read_to_string(file("docs/effects.md")).unwrap();
    for name in SCENES {
        let title = format!("### `{name}.toml`");
        let (_, section) = page.split_once(&title).unwrap_or_else(|| panic!("no {title}"));
        let section = section.split("\n##").next().unwrap();
        let plan = scene(name, &Options::default());
        let on = called_for(&plan);
        for effect in Effect::ALL {
            let start = format!("| `{effect}` | ");
            let row = section.lines().find_map(|line| line.strip_prefix(&start));
            let row = row.unwrap_or_else(|| panic!("{title} does not list {effect}"));
            let said = row.starts_with("yes |");
            assert_eq!(said, on.contains(&effect), "{name}: {effect}: {row}");
            let cause = &plan.plan.step(effect.id()).unwrap().cause;
            assert!(
                row.contains(&**cause),
                "{name}: {effect}: the cause is {cause}, not as in {row}"
            );
        }
    }
}

#[test]
fn what_is_left_out_changes_no_more_than_the_plan_states() {
    for name in SCENES {
        let plain = scene(name, &Options::default());
        let everything = Options { force: Effect::ALL.into(), ..Options::default() };
        let forced = scene(name, &everything);
        let left_out = |step: &&Step| !step.on && Effect::ALL.iter().any(|e| e.id() == step.id);
        let bounds: Vec<_> = plain.plan.steps.iter().filter(left_out).map(|s| s.bound).collect();
        let horizontal_m: f64 = bounds.iter().map(|bound| bound.horizontal_m).sum();
        let vertical_m: f64 = bounds.iter().map(|bound| bound.vertical_m).sum();
        assert!(horizontal_m.max(vertical_m) <= plain.plan.tolerance_m * bounds.len() as f64);
        let (a, b) = (Sample::of(&plain), Sample::of(&forced));
        // The survey's own bounds: light and lean change no height.
        assert!(a.heights_from(&b) <= vertical_m, "{name}: {} m", a.heights_from(&b));
        // As if an edge ran through every pixel: so many change their side of it.
        let most = (horizontal_m / a.pixel_m * f64::from(SIDE * SIDE)).ceil();
        let changed = a.pixels_from(&b);
        assert!(changed as f64 <= most, "{name}: {changed} pixels of at most {most}");
    }
}

#[test]
fn what_is_called_for_is_seen_in_the_result() {
    // The others move edges by centimetres.
    let fine = [Effect::GridScale, Effect::Curvature];
    for name in SCENES {
        let plain = scene(name, &Options::default());
        let whole = Sample::of(&plain);
        for effect in called_for(&plain).into_iter().filter(|effect| !fine.contains(effect)) {
            let without = Options { without: [effect].into(), ..Options::default() };
            let other = Sample::of(&scene(name, &without));
            let seen = whole.heights_from(&other) > 0.0 || whole.pixels_from(&other) > 0;
            assert!(seen, "{name}: without {effect} nothing changes");
        }
    }
}
