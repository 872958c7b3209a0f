//! Scores of arrays in which every number is known, and of a small network.

use super::columns::Columns;
use super::*;
use crate::model::weights::rule::{RuleWeights, tiny_overrides};
use crate::model::{Config, Device};
use crate::scene::random::Kind;
use std::cell::Cell;

const SIDE: usize = 32;
const AREA: usize = SIDE * SIDE;

/// A house of 8 x 10 pixels, `height` metres high, on ground at 100 m.
fn house(height: f32) -> (Vec<f32>, Vec<u8>) {
    let (mut surface, mut classes) = (vec![100.0; AREA], vec![0; AREA]);
    for row in 10..18 {
        for column in 8..18 {
            surface[row * SIDE + column] = 100.0 + height;
            classes[row * SIDE + column] = 1;
        }
    }
    (surface, classes)
}

/// The score of a scene whose house is `truth` m high, in the DSM `found` m and in the mesh `mesh` m.
pub(super) fn image(
    place: [u64; 2],
    truth: f32,
    found: f32,
    mesh: f32,
    floaters: u64,
) -> ImageScore {
    let (surface, classes) = house(truth);
    // Another datum: it is taken out.
    let dsm_m = house(found).0.into_iter().map(|height| height - 90.0).collect();
    let columns = Columns { top_m: house(mesh).0, holes: 0, floaters };
    let truth = Truth { side: SIDE, surface: &surface, classes: &classes };
    let prediction = Prediction { dsm_m, columns };
    ImageScore::new(place, Kind::Suburb, &prediction, &truth).expect("scores")
}

fn report(images: Vec<ImageScore>, seeds: &[u64]) -> Report {
    let scenes = (images.len() / seeds.len()) as u64;
    let options = Options {
        seeds: seeds.to_vec(),
        scenes,
        side: SIDE,
        replicates: 200,
        ..Options::default()
    };
    Report::new(options, images, Seconds { network: 0.0, dsm: 0.0 })
}

pub(super) fn close(found: f64, known: f64) {
    assert!((found - known).abs() < 1e-9 * known.abs().max(1.0), "{found} against {known}");
}

#[test]
fn one_house_off_by_two_metres() {
    let report = report(vec![image([7, 0], 10.0, 8.0, 7.0, 64)], &[7]);
    let value = |measure| report.all.score(measure).value;
    let share = 80.0 / AREA as f64;
    close(value(Measure::DsmMaeM), 2.0 * share);
    close(value(Measure::DsmRmseM), 2.0 * share.sqrt());
    close(value(Measure::DsmImageRmseM), 2.0 * share.sqrt());
    close(value(Measure::DsmWithinPct), 100.0);
    close(value(Measure::FlatMaeM), 10.0 * share);
    close(value(Measure::FlatRmseM), 10.0 * share.sqrt());
    close(value(Measure::FlatWithinPct), 100.0 * (1.0 - share));
    close(value(Measure::DsmOfFlat), 0.2);
    close(value(Measure::BuildingErrorM), 2.0);
    // One building: its own height is the best constant.
    close(value(Measure::BuildingConstantErrorM), 0.0);
    assert!(value(Measure::BuildingCorrelation).is_nan());
    close(value(Measure::MeshRmseM), 3.0 * share.sqrt());
    close(value(Measure::MeshOfDsm), 1.5);
    close(value(Measure::FloatersPct), 6.25);
    // No interval from one scene.
    assert!(report.all.score(Measure::DsmRmseM).low.is_nan());
}

#[test]
fn buildings_beside_the_best_constant() {
    // True heights 4, 6, 14; found 5, 6, 11.
    let images = vec![
        image([1, 0], 4.0, 5.0, 5.0, 0),
        image([1, 1], 6.0, 6.0, 6.0, 0),
        image([1, 2], 14.0, 11.0, 11.0, 0),
    ];
    let report = report(images, &[1]);
    let score = |measure| report.all.score(measure);
    close(score(Measure::BuildingErrorM).value, 4.0 / 3.0);
    close(score(Measure::BuildingConstantErrorM).value, 10.0 / 3.0);
    close(score(Measure::BuildingOfConstant).value, 0.4);
    // Deviations -4, -2, 6 and -7/3, -4/3, 11/3.
    let correlation = (28.0 + 8.0 + 66.0) / 3.0 / (56.0 * (49.0 + 16.0 + 121.0) / 9.0_f64).sqrt();
    close(score(Measure::BuildingCorrelation).value, correlation);
    let rmse = |error: f64| error * (80.0 / AREA as f64).sqrt();
    close(score(Measure::DsmImageRmseM).value, (rmse(1.0) + rmse(3.0)) / 3.0);
    close(score(Measure::DsmRmseM).value, rmse((10.0_f64 / 3.0).sqrt()));
    let interval = score(Measure::DsmRmseM);
    assert!(interval.low <= interval.value && interval.value <= interval.high, "{interval:?}");
    assert!(interval.low >= 0.0 && interval.high <= rmse(3.0) + 1e-9);
    assert_eq!((report.all.buildings, report.all.images), (3, 3));
}

#[test]
fn intervals_are_as_wide_as_those_of_a_mean() {
    // Errors of 1 and 3 m in equal parts: the mean of 64 has a standard error of 1/8 m.
    let images = (0..64)
        .map(|index| image([1, index], 10.0, if index % 2 == 0 { 9.0 } else { 7.0 }, 9.0, 0))
        .collect();
    let options = Options { seeds: vec![1], replicates: 4000, ..Options::default() };
    let report = Report::new(options, images, Seconds { network: 0.0, dsm: 0.0 });
    let score = report.all.score(Measure::BuildingErrorM);
    close(score.value, 2.0);
    assert!((score.high - score.low - 2.0 * 1.96 * 0.125).abs() < 0.06, "{score:?}");
    // Every scene has as many: what does not vary has no width.
    let floaters = report.all.score(Measure::FlatRmseM);
    close(floaters.low, floaters.high);
}

#[test]
fn seeds_apart_and_together() {
    let images = vec![
        image([1, 0], 10.0, 9.0, 9.0, 0),
        image([1, 1], 10.0, 9.0, 9.0, 0),
        image([2, 0], 10.0, 7.0, 7.0, 32),
        image([2, 1], 10.0, 7.0, 7.0, 0),
    ];
    let report = report(images, &[1, 2]);
    let of = |set: usize| report.seeds[set].score(Measure::BuildingErrorM).value;
    close(of(0), 1.0);
    close(of(1), 3.0);
    close(report.all.score(Measure::BuildingErrorM).value, 2.0);
    assert_eq!((report.seeds[0].seed, report.all.seed), (Some(1), None));
    assert_eq!(report.all.images, 4);
    let text = table(&report, &gates(&report));
    assert!(text.contains("4 simulated scenes") && text.contains("seed 2"), "{text}");
    assert!(text.lines().all(|line| line.len() <= 100), "{text}");
}

#[test]
fn gates_pass_and_fail_one_by_one() {
    // Heights 5 and 15 by turns; errors as given.
    let made = |error: f32, mesh: f32, floaters: u64| {
        let images = (0..20).map(|index| {
            let truth = if index % 2 == 0 { 5.0 } else { 15.0 };
            image([1, index], truth, truth - error, truth - mesh, floaters)
        });
        gates(&report(images.collect(), &[1]))
    };
    let failed = |gates: Vec<Gate>| -> Vec<usize> {
        (0..gates.len()).filter(|at| !gates[*at].passed).collect()
    };
    assert!(failed(made(1.0, 1.0, 20)).is_empty());
    assert_eq!(failed(made(1.0, 1.2, 20)), [3]);
    assert_eq!(failed(made(1.0, 1.0, 21)), [4]);
    // 80 of 1024 pixels off by 7 m: an RMSE of 1.96 m, where flat ground has 3.1 m; 5 m is as good as a constant.
    assert_eq!(failed(made(7.0, 7.0, 0)), [0, 1, 2]);
    assert_eq!(failed(made(5.0, 5.0, 0)).first(), Some(&2));
    // What cannot be measured has not passed: a perfect DSM has no ratio.
    let perfect = made(0.0, 0.0, 0);
    assert!(perfect[3].value.is_nan() && !perfect[3].passed);
}

#[test]
fn holes_are_errors_of_the_mesh() {
    let (surface, classes) = house(10.0);
    let mut top_m = surface.clone();
    top_m[..256].fill(0.0);
    let columns = Columns { top_m, holes: 256, floaters: 0 };
    let truth = Truth { side: SIDE, surface: &surface, classes: &classes };
    let prediction = Prediction { dsm_m: surface.clone(), columns };
    let image = ImageScore::new([1, 0], Kind::Park, &prediction, &truth).expect("scores");
    close(image.mesh.rmse_m, 100.0 / 2.0);
    assert_eq!((image.dsm.rmse_m, image.dsm.within), (0.0, AREA as u64));
    close(report(vec![image], &[1]).all.score(Measure::HolesPct).value, 25.0);
}

#[test]
fn a_prediction_without_heights_is_an_error() {
    let (surface, classes) = house(10.0);
    let truth = Truth { side: SIDE, surface: &surface, classes: &classes };
    let columns = Columns { top_m: vec![0.0; AREA], holes: AREA as u64, floaters: 0 };
    let prediction = Prediction { dsm_m: vec![f32::NAN; AREA], columns };
    assert!(ImageScore::new([1, 0], Kind::Park, &prediction, &truth).is_err());
}

#[test]
fn a_network_is_scored_the_same_every_time_on_scenes_of_its_own() {
    let config = include_str!("../../crates/sat3d-model/fixtures/tiny/model/config.json");
    let config = Config::from_json(config).expect("a config");
    let weights = RuleWeights::new(&config, tiny_overrides());
    let model =
        Model::from_source(config, Box::new(weights), &Device::Cpu.into()).expect("a model");
    let options = Options {
        seeds: vec![4, 5],
        scenes: 2,
        side: 48,
        pixel_m: 1.0,
        replicates: 50,
        ..Options::default()
    };
    let done = Cell::new(0);
    let first = score(&model, &options, &|| done.set(done.get() + 1)).expect("scores");
    assert_eq!((done.get(), first.images.len()), (4, 4));
    let again = score(&model, &options, &|| ()).expect("scores");
    let same = |report: &Report| {
        let mut value = serde_json::to_value(report).expect("is JSON");
        value["seconds"] = serde_json::Value::Null;
        value
    };
    assert_eq!(same(&first), same(&again));
    let places: Vec<[u64; 2]> = first.images.iter().map(|i| [i.seed, i.index]).collect();
    assert_eq!(places, [[4, 0], [4, 1], [5, 0], [5, 1]]);
    // The DSM that is scored is the one that the model makes.
    let sample = sample(4, 1, &options).expect("a scene");
    let image = Image8::new(48, 48, 3, sample.rgb.clone()).expect("an image");
    let scene = model.scene(&image, None, options.metres_per_unit).expect("a scene");
    let dsm = scene.dsm(48, &RenderOptions::default());
    let metres = (2.0 * options.metres_per_unit) as f32;
    let surface = |values| crate::eval::Surface::new(48, 48, values);
    let heights = surface(dsm.height.iter().map(|height| height * metres).collect());
    let errors = Errors::between(&heights, &surface(sample.surface)).expect("has heights");
    assert_eq!(first.images[1].dsm, errors);
    // Scenes of a seed here are not those of a training with that seed.
    let trained = RandomScenes { seed: 4 }.sample(1, 48, 48.0).expect("a scene");
    assert_ne!(trained.rgb, sample.rgb);
}

#[test]
fn options_without_scenes_are_refused() {
    let with =
        |seeds: &[u64], scenes| Options { seeds: seeds.to_vec(), scenes, ..Options::default() };
    assert!(check(&with(&[1, 2], 1)).is_ok());
    for options in [with(&[], 4), with(&[1], 0), with(&[3, 1, 3], 2)] {
        assert!(matches!(check(&options), Err(ScoreError::Nothing { .. })), "{options:?}");
    }
    let error = check(&with(&[3, 1, 3], 2)).expect_err("twice");
    assert!(error.to_string().contains("seed 3"), "{error}");
}
