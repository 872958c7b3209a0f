use super::*;
use crate::eval::metrics::{ErrorSums, Sketch, threshold_list};
use crate::random::{key, normal};

const SETTINGS: BootstrapSettings =
    BootstrapSettings { block_m: 500.0, replicates: 400, seed: 2, level_pct: 95.0 };

/// Images in blocks of three whose spread of errors is the block's (shared by all models) times the
/// model's; and all errors.
fn model(seed: u64, name: u64, blocks: u64, factor: f64) -> (Vec<ImageSample>, Vec<f64>) {
    let mut all = Vec::new();
    let images = (0..blocks * 3)
        .map(|number| {
            let hardness = 1.0 + 0.5 * normal(key(&[seed, 1, number / 3])).abs();
            let skill = factor * (1.0 + 0.1 * normal(key(&[seed, 2, name, number / 3])));
            let errors: Vec<f64> = (0..30)
                .map(|p| hardness * skill * normal(key(&[seed, 3, name, number, p])))
                .collect();
            let mut sums = ErrorSums::new(2);
            sums.add(&errors, &threshold_list(&[]));
            let sketch = Sketch::of(&errors);
            all.extend(errors);
            let block = ((number / 3) as i64, 0);
            ImageSample { name: format!("{number:05}"), block, sums, truth_pixels: 30, sketch }
        })
        .collect();
    (images, all)
}

fn set<'a>(model: &'a str, images: &'a [ImageSample], all: Option<&[f64]>) -> ComparedSet<'a> {
    let quantiles = all.map(|all| Quantiles::of(all, &mut Vec::new()));
    ComparedSet { model, protocol: Protocol::Paper, images, quantiles }
}

fn compare(sets: &[ComparedSet<'_>]) -> Vec<Difference> {
    differences(sets, &threshold_list(&[]), &SETTINGS)
}

fn score<'a>(difference: &'a Difference, name: &str) -> Option<&'a ScoreDifference> {
    difference.scores.iter().find(|score| score.score == name)
}

#[test]
fn identical_sets_do_not_differ() {
    let (images, all) = model(1, 1, 20, 1.0);
    let found = compare(&[set("a", &images, Some(&all)), set("b", &images, Some(&all))]);
    assert_eq!(found[0].images, 60);
    assert_eq!(found[0].scores.len(), 16);
    for score in &found[0].scores {
        assert_eq!((score.difference, score.low, score.high), (0.0, 0.0, 0.0), "{score:?}");
        assert_eq!((score.p_value, score.significant), (1.0, false), "{score:?}");
    }
}

#[test]
fn a_better_model_is_told_from_an_equal_one() {
    let (a, all_a) = model(2, 1, 60, 1.0);
    let (b, all_b) = model(2, 2, 60, 0.8);
    let (c, all_c) = model(2, 3, 60, 1.0);
    let found = compare(&[
        set("a", &a, Some(&all_a)),
        set("b", &b, Some(&all_b)),
        set("c", &c, Some(&all_c)),
    ]);
    let pairs: Vec<(&str, &str)> = found.iter().map(|d| (d.a.as_str(), d.b.as_str())).collect();
    assert_eq!(pairs, [("a", "b"), ("a", "c"), ("b", "c")]);
    for (name, sign) in [
        ("per_image_mean.mae_m", -1.0),
        ("pooled.rmse_m", -1.0),
        ("pooled.nmad_m", -1.0),
        ("pooled.le68_m", -1.0),
        ("pooled.le90_m", -1.0),
        ("pooled.lt_2_5_m_pct", 1.0),
    ] {
        for (at, clear) in [(0, true), (1, false), (2, true)] {
            let (Some(score), sign) = (score(&found[at], name), if at == 2 { -sign } else { sign })
            else {
                panic!("{name} is missing");
            };
            assert_eq!(score.difference, score.b - score.a);
            assert!(score.low < score.difference && score.difference < score.high, "{score:?}");
            assert_eq!(score.significant, clear, "{score:?}");
            if clear {
                assert!(score.low * sign > 0.0 && score.high * sign > 0.0, "{score:?}");
            }
        }
    }
    // Neither bias nor completeness differs.
    assert!(found[0].scores.iter().filter(|s| s.score.contains("bias")).all(|s| !s.significant));
    assert!(score(&found[0], "pooled.completeness_pct").is_some_and(|s| s.p_value == 1.0));
    // Pairing pays: the interval is narrower than the two sets' own spread would make it.
    let alone = super::super::intervals(&a, &Quantiles::NONE, &threshold_list(&[]), &SETTINGS);
    let (paired, alone) = (&found[1].scores[0], &alone.scores[0]);
    assert!(paired.high - paired.low < alone.high - alone.low);
}

#[test]
fn only_images_that_both_have_are_compared() {
    let (a, all) = model(3, 1, 20, 1.0);
    let (b, all_b) = model(3, 2, 20, 1.0);
    let shared = &b[6..];
    let found = compare(&[set("a", &a, Some(&all)), set("b", shared, Some(&all_b[180..]))]);
    assert_eq!(found[0].images, 54);
    // Quantiles of a part of `a` are not known exactly.
    assert_eq!(found[0].scores.len(), 12);
    let part = compare(&[set("a", &a[6..], None), set("b", shared, None)]);
    assert_eq!(found, part);
    // In another order, with other blocks in `b`: the blocks of `a` count.
    let mut moved = shared.to_vec();
    moved.reverse();
    for image in &mut moved {
        image.block.0 += 100;
    }
    assert_eq!(compare(&[set("a", &a, None), set("b", &moved, None)]), part);
    let none = compare(&[set("a", &a[..6], None), set("b", shared, None)]);
    assert_eq!(none[0].images, 0);
    assert!(none[0].scores.iter().all(|s| s.p_value.is_nan() && !s.significant));
}

#[test]
fn protocols_are_not_mixed() {
    let (a, _) = model(4, 1, 4, 1.0);
    let plain = |model| ComparedSet { protocol: Protocol::Plain, ..set(model, &a, None) };
    let found = compare(&[set("a", &a, None), plain("a"), set("b", &a, None), plain("b")]);
    let pairs: Vec<_> = found.iter().map(|d| (d.a.as_str(), d.b.as_str(), d.protocol)).collect();
    assert_eq!(pairs, [("a", "b", Protocol::Paper), ("a", "b", Protocol::Plain)]);
}

#[test]
fn few_blocks_prove_nothing() {
    for blocks in [1, 2, 3] {
        let (a, _) = model(5, 1, blocks, 1.0);
        let (b, _) = model(5, 2, blocks, 0.3);
        for score in &compare(&[set("a", &a, None), set("b", &b, None)])[0].scores {
            assert!(!score.significant, "{score:?}");
            assert_eq!(score.p_value.is_nan(), blocks == 1);
            assert_eq!(score.low.is_nan(), blocks == 1);
        }
    }
}

#[test]
fn equal_models_are_rarely_found_to_differ() {
    let sets = 200;
    let (mut below, mut significant) = (0, 0);
    for seed in 0..sets {
        let (a, _) = model(100 + seed, 1, 15, 1.0);
        let (b, _) = model(100 + seed, 2, 15, 1.0);
        let (c, _) = model(100 + seed, 3, 15, 1.0);
        let settings = BootstrapSettings { seed, ..SETTINGS };
        let sets = [set("a", &a, None), set("b", &b, None), set("c", &c, None)];
        let found = differences(&sets, &threshold_list(&[]), &settings);
        below += u32::from(found[0].scores[6].p_value < 0.05);
        // Of the three pairs, in one score: what Holm's correction promises to keep at 5 %.
        significant += u32::from(found.iter().any(|pair| pair.scores[6].significant));
    }
    let share = |count: u32| f64::from(count) / sets as f64;
    eprintln!("p < 0.05: {}, any significant: {}", share(below), share(significant));
    assert!((0.01..=0.1).contains(&share(below)), "{}", share(below));
    assert!(share(significant) <= 0.08, "{}", share(significant));
}

#[test]
fn the_same_bytes_for_any_number_of_threads() {
    let (a, all_a) = model(6, 1, 15, 1.0);
    let (b, all_b) = model(6, 2, 15, 0.9);
    let sets = [set("a", &a, Some(&all_a)), set("b", &b, Some(&all_b))];
    let reference = compare(&sets);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        assert!(pool.is_ok_and(|pool| pool.install(|| compare(&sets)) == reference));
    }
}

#[test]
fn holm_stops_at_the_first_that_fails() {
    let with = |p_values: &[f64]| {
        let score = |p_value: &f64| ScoreDifference {
            score: String::new(),
            a: 0.0,
            b: 1.0,
            difference: 1.0,
            low: 0.0,
            high: 0.0,
            p_value: *p_value,
            significant: false,
        };
        let pair = |p_value: &f64| Difference {
            a: "a".into(),
            b: "b".into(),
            protocol: Protocol::Paper,
            images: 1,
            scores: vec![score(p_value)],
        };
        let mut found: Vec<Difference> = p_values.iter().map(pair).collect();
        holm(&mut found);
        found.iter().map(|pair| pair.scores[0].significant).collect::<Vec<_>>()
    };
    // statsmodels.stats.multitest.multipletests([0.04, 0.01, 0.02, 0.013], method="holm")
    assert_eq!(with(&[0.04, 0.01, 0.02, 0.013]), [true, true, true, true]);
    // The second smallest fails, and with it all larger ones.
    assert_eq!(with(&[0.04, 0.01, 0.03, 0.02]), [false, true, false, false]);
    assert_eq!(with(&[0.013]), [true]);
    assert_eq!(with(&[0.013, f64::NAN, 0.9]), [true, false, false]);
}

#[test]
fn p_values_count_both_sides() {
    let mut replicates: Vec<f64> = (0..1000).map(f64::from).map(|i| i - 10.0).collect();
    // 11 at or below 0: twice 12 in 1001, and hardly more with so many blocks.
    let p = p_value(&replicates, 100_000);
    assert!((p - 24.0 / 1001.0).abs() < 1e-4, "{p}");
    for value in &mut replicates {
        *value = -*value;
    }
    assert_eq!(p_value(&replicates, 100_000), p);
    assert!(p_value(&replicates, 5) > 2.0 * p);
    assert!(p_value(&replicates, 1).is_nan() && p_value(&[], 9).is_nan());
}
