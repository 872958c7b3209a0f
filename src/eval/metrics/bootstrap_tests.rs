#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::super::samples::mean_scores;
use super::*;
use crate::eval::metrics::{ErrorSums, Sketch, threshold_list};
use crate::random::{key, normal};
use proptest::prelude::*;

const SETTINGS: BootstrapSettings =
    BootstrapSettings { block_m: 500.0, replicates: 200, seed: 11, level_pct: 95.0 };

fn sample(number: usize, block: i64, errors: &[f64]) -> ImageSample {
    let thresholds = threshold_list(&[1.0]);
    let mut sums = ErrorSums::new(3);
    sums.add(errors, &thresholds);
    ImageSample {
        name: format!("image{number:05}"),
        block: (block, 0),
        sums,
        truth_pixels: errors.len() as u64 + number as u64 % 3,
        sketch: Sketch::of(errors),
    }
}

/// Images whose errors have a part in common with their neighbours, and all of their errors. Every
/// pixel's error is normal with a variance of `1 + within`.
fn overlapping(
    seed: u64,
    blocks: usize,
    per_block: usize,
    within: f64,
) -> (Vec<ImageSample>, Vec<f64>) {
    let (mut images, mut all) = (Vec::new(), Vec::new());
    for number in 0..blocks * per_block {
        let field: f64 = (0..6).map(|near| normal(key(&[seed, 1, (number + near) as u64]))).sum();
        let errors: Vec<f64> = (0..6)
            .map(|pixel| {
                let noise = normal(key(&[seed, 2, number as u64, pixel]));
                field / 6f64.sqrt() + within.sqrt() * noise
            })
            .collect();
        images.push(sample(number, (number / per_block) as i64, &errors));
        all.extend(errors);
    }
    (images, all)
}

fn found(images: &[ImageSample], all: &[f64], settings: &BootstrapSettings) -> Intervals {
    let exact = Quantiles::of(all, &mut Vec::new());
    intervals(images, &exact, &threshold_list(&[1.0]), settings)
}

fn score<'a>(intervals: &'a Intervals, name: &str) -> &'a Interval {
    intervals.scores.iter().find(|interval| interval.score == name).unwrap()
}

#[test]
fn blocks_cover_the_truth_where_single_images_do_not() {
    let (sets, within) = (100, 0.5_f64);
    let spread = (1.0 + within).sqrt();
    let truths = [
        ("pooled.bias_m", 0.0),
        ("per_image_mean.bias_m", 0.0),
        ("pooled.mae_m", spread * (2.0 / std::f64::consts::PI).sqrt()),
        ("pooled.rmse_m", spread),
        ("pooled.median_m", 0.0),
        ("pooled.nmad_m", spread),
        ("pooled.le90_m", 1.644_854 * spread),
    ];
    let mut covered = [(0, 0); 7];
    for seed in 0..sets {
        let (images, all) = overlapping(seed, 40, 10, within);
        let intervals = found(&images, &all, &BootstrapSettings { seed, ..SETTINGS });
        for ((name, truth), (by_block, naive)) in truths.iter().zip(&mut covered) {
            let interval = score(&intervals, name);
            *by_block += u32::from(interval.low <= *truth && *truth <= interval.high);
            *naive += u32::from(interval.naive_low <= *truth && *truth <= interval.naive_high);
        }
    }
    // The standard error of these shares is 2 to 3 %.
    for ((name, _), (by_block, naive)) in truths.iter().zip(covered) {
        let share = |count: u32| f64::from(count) / sets as f64;
        eprintln!("{name}: blocks {:.3}, single images {:.3}", share(by_block), share(naive));
        assert!((0.86..=1.0).contains(&share(by_block)), "{name}: {}", share(by_block));
        assert!(share(naive) < share(by_block) - 0.1, "{name}: {}", share(naive));
    }
}

#[test]
fn the_same_bytes_for_any_number_of_threads_and_any_order() {
    let (mut images, all) = overlapping(5, 12, 4, 1.0);
    let reference = found(&images, &all, &SETTINGS);
    assert_eq!(reference.blocks, 12);
    images.reverse();
    images.rotate_left(7);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let again = pool.install(|| found(&images, &all, &SETTINGS));
        assert_eq!(
            serde_json::to_string(&again).unwrap(),
            serde_json::to_string(&reference).unwrap()
        );
    }
    let other = found(&images, &all, &BootstrapSettings { seed: 12, ..SETTINGS });
    assert_ne!(other.scores[0].low, reference.scores[0].low);
    assert_eq!(other.scores[0].value, reference.scores[0].value);
}

#[test]
fn values_are_the_scores_and_lie_within_their_intervals() {
    let (images, all) = overlapping(6, 20, 5, 1.0);
    let exact = Quantiles::of(&all, &mut Vec::new());
    let mut sums = ErrorSums::new(3);
    sums.add(&all, &threshold_list(&[1.0]));
    let intervals = found(&images, &all, &SETTINGS);
    let (means, below) = mean_scores(&images, 3);
    let by_hand =
        |of: &dyn Fn(&ImageSample) -> f64| images.iter().map(of).sum::<f64>() / images.len() as f64;
    assert!((means.mae_m - by_hand(&|image| image.sums.mae())).abs() < 1e-12);
    let completeness = by_hand(&|image| 100.0 * 6.0 / image.truth_pixels as f64);
    assert!((means.completeness_pct - completeness).abs() < 1e-10);
    let truth: u64 = images.iter().map(|image| image.truth_pixels).sum();
    for (name, value) in [
        ("per_image_mean.mae_m", means.mae_m),
        ("per_image_mean.rmse_m", means.rmse_m),
        ("per_image_mean.lt_2_5_m_pct", means.lt_2_5_m_pct),
        ("per_image_mean.lt_7_5_m_pct", means.lt_7_5_m_pct),
        ("per_image_mean.bias_m", means.bias_m),
        ("per_image_mean.completeness_pct", means.completeness_pct),
        ("pooled.mae_m", sums.mae()),
        ("pooled.rmse_m", sums.rmse()),
        ("pooled.bias_m", sums.bias()),
        ("pooled.lt_2_5_m_pct", sums.below_pct(0)),
        ("pooled.lt_7_5_m_pct", sums.below_pct(1)),
        ("pooled.completeness_pct", 100.0 * all.len() as f64 / truth as f64),
        ("pooled.thresholds[0].pooled_pct", sums.below_pct(2)),
        ("pooled.thresholds[0].per_image_mean_pct", below[2]),
        ("pooled.median_m", exact.median),
        ("pooled.nmad_m", exact.nmad),
        ("pooled.le68_m", exact.le68),
        ("pooled.le90_m", exact.le90),
    ] {
        let interval = score(&intervals, name);
        assert!((interval.value - value).abs() <= 1e-14 * value.abs(), "{name}");
        assert!(interval.low <= value && value <= interval.high, "{interval:?}");
        assert!(interval.naive_low <= value && value <= interval.naive_high, "{interval:?}");
    }
    assert_eq!(intervals.scores.len(), 18);
}

#[test]
fn equal_images_have_intervals_without_width() {
    let images: Vec<ImageSample> = (0..30)
        .map(|number| ImageSample {
            truth_pixels: 7,
            ..sample(number, number as i64 / 3, &[0.1, -3.3, 0.7])
        })
        .collect();
    let all = [0.1, -3.3, 0.7].repeat(30);
    for interval in &found(&images, &all, &SETTINGS).scores {
        let width = interval.high - interval.low;
        assert!((0.0..=1e-12).contains(&width), "{interval:?}");
        if interval.score.starts_with("per_image_mean") {
            assert_eq!((interval.low, interval.high), (interval.value, interval.value));
        }
    }
}

#[test]
fn one_block_or_no_image_has_no_interval() {
    let (images, all) = overlapping(7, 1, 5, 1.0);
    let intervals = found(&images, &all, &SETTINGS);
    assert_eq!(intervals.blocks, 1);
    for interval in &intervals.scores {
        assert!(interval.low.is_nan() && interval.high.is_nan() && interval.value.is_finite());
        assert!(interval.naive_low <= interval.naive_high);
    }
    for intervals in [
        found(&[], &[], &SETTINGS),
        found(&images, &all, &BootstrapSettings { replicates: 0, ..SETTINGS }),
    ] {
        assert_eq!(intervals.scores.len(), 18);
        assert!(intervals.scores.iter().all(|i| i.low.is_nan() && i.naive_high.is_nan()));
    }
}

#[test]
fn images_without_a_pixel_only_count_for_completeness() {
    let (mut images, all) = overlapping(8, 10, 3, 1.0);
    let before = found(&images, &all, &SETTINGS);
    for number in 100..105 {
        let mut empty = sample(number, number as i64 % 10, &[]);
        empty.truth_pixels = if number == 104 { 0 } else { 50 };
        images.push(empty);
    }
    let after = found(&images, &all, &SETTINGS);
    assert_eq!(
        score(&after, "per_image_mean.mae_m").value,
        score(&before, "per_image_mean.mae_m").value
    );
    assert_eq!(
        score(&after, "pooled.rmse_m"),
        &Interval {
            naive_low: score(&after, "pooled.rmse_m").naive_low,
            naive_high: score(&after, "pooled.rmse_m").naive_high,
            ..score(&before, "pooled.rmse_m").clone()
        }
    );
    let completeness = |of: &Intervals| score(of, "per_image_mean.completeness_pct").value;
    assert!((completeness(&after) - completeness(&before) * 30.0 / 34.0).abs() < 1e-10);
    assert!(after.scores.iter().all(|interval| interval.low <= interval.high));
}

#[test]
fn a_draw_takes_as_many_units_as_there_are_and_all_alike() {
    let mut totals = vec![0_u64; 20];
    let mut weights = vec![9; 20];
    for replicate in 0..5000 {
        draw(&[3, replicate], &mut weights);
        assert_eq!(weights.iter().sum::<u32>(), 20);
        for (total, weight) in totals.iter_mut().zip(&weights) {
            *total += u64::from(*weight);
        }
    }
    // 5000 on average, with a standard deviation of 69.
    assert!(totals.iter().all(|total| total.abs_diff(5000) < 350), "{totals:?}");
}

#[test]
fn blocks_are_as_large_as_asked_for_everywhere() {
    for lat in [-89.0_f64, -47.6, -0.001, 0.0, 30.0, 47.6062, 71.3] {
        let at = (-122.332, lat);
        let metre_north = 1.0 / METRES_PER_DEGREE;
        let metre_east = metre_north / libm::cos(lat.to_radians());
        // Walk 10 km each way in steps of 5 m: 20 blocks, 100 steps each, but for the ends.
        for (east, north) in [(5.0 * metre_east, 0.0), (0.0, 5.0 * metre_north)] {
            let mut lengths = vec![0_u32];
            let mut last = block_of(at, 500.0);
            for step in 0..2000 {
                let block =
                    block_of((at.0 + east * f64::from(step), lat + north * f64::from(step)), 500.0);
                let crossed = if north > 0.0 { block.0 != last.0 } else { block != last };
                if crossed {
                    lengths.push(0);
                }
                last = block;
                *lengths.last_mut().unwrap() += 1;
            }
            for length in &lengths[1..lengths.len() - 1] {
                // Near the pole a row is visibly shorter at its end.
                let slack = if lat.abs() > 80.0 { 3 } else { 1 };
                assert!(length.abs_diff(100) <= slack, "{lat}: {lengths:?}");
            }
        }
    }
    assert_eq!(block_of((180.0, 10.0), 500.0), block_of((-180.0, 10.0), 500.0));
    assert_eq!(block_of((237.668, 47.6), 500.0), block_of((-122.332, 47.6), 500.0));
    assert_eq!(block_of((12.0, 90.0), 500.0).1, 0);
    assert_ne!(lone_block(0), lone_block(1));
    assert_ne!(lone_block(0).0, block_of((0.0, 90.0), 1e-6).0);
}

proptest! {
    #[test]
    fn replicates_are_the_scores_of_the_images_drawn(
        spread in proptest::collection::vec((0.1..20.0_f64, 0..5_i64), 2..8),
        weights in proptest::collection::vec(0..4_u32, 8),
    ) {
        let errors = |number: usize| -> Vec<f64> {
            let count = 30 + 7 * number as u64;
            (0..count).map(|p| 1.0 + spread[number].0 * normal(key(&[number as u64, p]))).collect()
        };
        let images: Vec<ImageSample> =
            (0..spread.len()).map(|n| sample(n, spread[n].1, &errors(n))).collect();
        let images: Vec<&ImageSample> = images.iter().collect();
        let mut blocks: Vec<i64> = spread.iter().map(|s| s.1).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let units = Units::blocks(&images, 3);
        prop_assert_eq!(units.len(), blocks.len());
        let (mut drawn, mut all) = (Vec::new(), Vec::new());
        for (image, number) in images.iter().zip(0..) {
            let block = blocks.binary_search(&image.block.0).unwrap();
            for _ in 0..weights[block] {
                drawn.push(*image);
                all.extend(errors(number));
            }
        }
        let mut found = Vec::new();
        units.scores(&weights[..blocks.len()], &mut Workspace::default(), &mut found);
        let expected = exact_scores(&drawn, 3, None);
        prop_assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            let same = found.is_nan() && expected.is_nan()
                || (found - expected).abs() <= 1e-11 * expected.abs().max(1.0);
            prop_assert!(same, "{} {}", found, expected);
        }
        let lists = [vec![1; blocks.len()], weights[..blocks.len()].to_vec()];
        let sketched = units.quantiles(&lists, &mut Workspace::default())[1];
        if all.is_empty() {
            prop_assert!(sketched.le68.is_nan());
        } else {
            let exact = Quantiles::of(&all, &mut Vec::new());
            prop_assert!((sketched.le68 / exact.le68 - 1.0).abs() < 0.2);
        }
    }
}
