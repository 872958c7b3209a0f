//! Comparisons of reports in which every number is known.

use super::super::tests::{close, image};
use super::super::{Report, Seconds, markdown};
use super::*;

/// What an error of 1 m of the house in every scene is as an RMSE: 80 of 1024 pixels.
fn share() -> f64 {
    (80.0 / 1024.0_f64).sqrt()
}

/// A training whose house is too low by these metres, scene by scene.
fn training(name: &str, errors: &[f32]) -> Training {
    let images = errors
        .iter()
        .enumerate()
        .map(|(at, error)| image([1, at as u64], 20.0, 20.0 - error, 20.0, 0))
        .collect();
    let options = Options { seeds: vec![1], scenes: errors.len() as u64, ..Options::default() };
    Training { path: name.into(), sha256: name.to_owned(), options, images }
}

/// A variant whose trainings have the same error in all of 12 scenes.
fn variant(name: &str, errors: &[f32]) -> Variant {
    let trainings = errors
        .iter()
        .enumerate()
        .map(|(at, error)| training(&format!("{name}/{at}.json"), &[*error; 12]))
        .collect();
    Variant { name: name.to_owned(), trainings }
}

fn ablation() -> Vec<Variant> {
    vec![
        variant("canonical", &[0.5, 3.0]),
        variant("without-depth", &[3.0, 5.0]),
        variant("without-gravity", &[0.5, 0.25]),
        variant("wider", &[2.0]),
        variant("full", &[1.0, 1.0]),
    ]
}

#[test]
fn trainings_are_averaged_and_drawn() {
    let found = compare(&ablation(), "full", 400, 95.0).expect("compares");
    let rmse = |at: usize| found.variants[at].score(Measure::DsmRmseM);
    let depth = rmse(1);
    close(depth.value, 4.0 * share());
    close(depth.trainings[0], 3.0 * share());
    close(depth.trainings[1], 5.0 * share());
    // Scenes are alike, so all that varies is which of the two trainings are drawn.
    close(depth.low, 3.0 * share());
    close(depth.high, 5.0 * share());
    close(depth.difference, 3.0 * share());
    close(depth.difference_low, 2.0 * share());
    close(depth.difference_high, 4.0 * share());
    let full = rmse(4);
    close(full.high - full.low, 0.0);
    assert_eq!((full.difference, full.difference_low, full.difference_high), (0.0, 0.0, 0.0));
    let orders: Vec<Option<Order>> = found.variants.iter().map(|row| row.order).collect();
    let [undecided, as_paper, other] =
        [Order::Undecided, Order::AsInThePaper, Order::TheOtherWay].map(Some);
    assert_eq!(orders, [undecided, as_paper, other, None, None]);
    assert_eq!(found.variants[1].paper_rmse_m, Some(5.75));
    // The same numbers each time; as texts, in which NaN equals NaN.
    let again = compare(&ablation(), "full", 400, 95.0).expect("compares");
    assert_eq!(format!("{found:?}"), format!("{again:?}"));
}

#[test]
fn differences_are_paired_by_scene() {
    let errors: Vec<f32> = (0..24).map(|at| 1.0 + (at % 7) as f32).collect();
    let more: Vec<f32> = errors.iter().map(|error| error + 2.0).collect();
    let variants = [("a", &errors), ("b", &more)].map(|(name, errors)| Variant {
        name: name.into(),
        trainings: vec![training(name, errors)],
    });
    let found = compare(&variants, "a", 400, 95.0).expect("compares");
    let error = found.variants[1].score(Measure::BuildingErrorM);
    assert!(error.high - error.low > 1.0, "{error:?}");
    close(error.difference, 2.0);
    // 2 m in whatever scenes are drawn; f32 heights are off by some 1e-6 m.
    assert!((error.difference_low - 2.0).abs() < 1e-5, "{error:?}");
    assert!((error.difference_high - 2.0).abs() < 1e-5, "{error:?}");
}

#[test]
fn the_table_has_places_and_the_papers_order() {
    let text = markdown(&compare(&ablation(), "full", 400, 95.0).expect("compares"));
    let lines: Vec<&str> = text.lines().collect();
    let cells = |at: usize| -> Vec<&str> { lines[at].split('|').map(str::trim).collect() };
    assert!((0..7).all(|at| lines[at].matches('|').count() == 12), "{text}");
    assert_eq!(cells(3)[2..4], ["1.12 (0.84 to 1.40)", "0.84 1.40"]);
    assert_eq!(cells(3)[7..12], ["+0.84 (+0.56 to +1.12)", "5", "5.75", "3", "as in the paper"]);
    // Without a number of the paper.
    assert_eq!(cells(5)[1..2], ["wider"]);
    assert_eq!(cells(5)[8..12], ["4", "-", "-", "-"]);
    assert_eq!(cells(6)[7..12], ["-", "2", "5.20", "1", "-"]);
    // Names that the paper does not have: no columns of the paper.
    let plain = [variant("a", &[1.0]), variant("b", &[2.0])];
    let text = markdown(&compare(&plain, "b", 50, 95.0).expect("compares"));
    assert!(
        !text.contains("paper") && text.contains("`b`") && text.contains("12 scenes"),
        "{text}"
    );
}

#[test]
fn what_cannot_be_compared_is_refused_with_its_files() {
    let told = |variants: &[Variant], against: &str| {
        compare(variants, against, 10, 95.0).expect_err("is refused").to_string()
    };
    let short = Variant { name: "b".into(), trainings: vec![training("b.json", &[1.0; 11])] };
    let of_others = told(&[variant("a", &[1.0]), short], "a");
    assert!(
        of_others.contains("a/0.json and b.json") && of_others.contains("--seeds"),
        "{of_others}"
    );
    let mut scaled = variant("c", &[1.0]);
    scaled.trainings[0].options.pixel_m = 0.5;
    assert!(told(&[variant("a", &[1.0]), scaled], "a").contains("other scenes"));
    // The scale of heights is the model's.
    let mut padded = variant("c", &[1.0]);
    padded.trainings[0].options.metres_per_unit = 40.32;
    assert!(compare(&[variant("a", &[1.0]), padded], "a", 10, 95.0).is_ok());
    let mut twice = variant("a", &[1.0, 2.0]);
    let same = twice.trainings[0].sha256.clone();
    twice.trainings[1].sha256 = same;
    assert!(told(&[twice], "a").contains("a/0.json and a/1.json are reports of the same weights"));
    assert!(told(&[variant("a", &[1.0]), variant("a", &[2.0])], "a").contains("called `a`"));
    assert!(told(&[variant("a", &[1.0])], "z").contains("`z` to compare with; there are: a"));
}

#[test]
fn reports_are_read_as_they_are_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let full = folder.path().join("full");
    std::fs::create_dir(&full).expect("a folder");
    let empty = Variant::read(&full).expect_err("is empty").to_string();
    assert!(empty.contains("full holds no .json file"), "{empty}");
    let write = |path: &Path, training: &Training| {
        let seconds = Seconds { network: 0.0, dsm: 0.0 };
        let report = Report::new(training.options.clone(), training.images.clone(), seconds);
        let value = serde_json::json!({ "sha256": training.sha256, "report": report, "gates": [] });
        std::fs::write(path, value.to_string()).expect("writes");
    };
    let known = variant("full", &[1.0, 3.0]);
    for (training, name) in known.trainings.iter().zip(["b.json", "a.json"]) {
        write(&full.join(name), training);
    }
    std::fs::write(full.join("notes.txt"), "not a report").expect("writes");
    let read = Variant::read(&full).expect("reads");
    assert_eq!((read.name.as_str(), read.trainings.len()), ("full", 2));
    // In the order of the files' names.
    assert_eq!(read.trainings[0].images, known.trainings[1].images);
    assert_eq!(read.trainings[1].options, known.trainings[0].options);
    let one = Variant::read(&full.join("a.json")).expect("reads");
    assert_eq!((one.name.as_str(), one.trainings.len()), ("a", 1));
    std::fs::write(full.join("c.json"), "{}").expect("writes");
    let told = Variant::read(&full).expect_err("no report").to_string();
    assert!(told.contains("c.json is no report of `sat3d model score`: missing field"), "{told}");
    assert!(matches!(Variant::read(&full.join("d.json")), Err(CompareError::Read { .. })));
}
