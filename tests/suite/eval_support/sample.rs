//! Evaluations made up for tests: no images behind them, but numbers that belong together.
//!
//! Whoever includes this file names the crate `library`, so that unit tests and integration tests
//! can both do so.

use super::library::batch::Status;
use super::library::eval::align::{AlignmentFlag, Coregistration, Residuals, Shift};
use super::library::eval::report::Panel;
use super::library::eval::summary::*;
use super::library::eval::{OffsetMethod, Protocol, Surface};
use std::collections::BTreeMap;

/// Numbers between 0 and 1 that look random; a linear congruential generator.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / (1_u64 << 31) as f64
    }

    /// About normal: mean 0, variance 1.
    fn bell(&mut self) -> f64 {
        (0..12).map(|_| self.next()).sum::<f64>() - 6.0
    }
}

/// Every model under every protocol on the same images, with the differences of the first model and
/// each other.
pub fn set(models: &[&str], protocols: &[Protocol], images: usize) -> EvaluationSet {
    let mut evaluations = Vec::new();
    for (m, model) in models.iter().enumerate() {
        for (p, protocol) in protocols.iter().enumerate() {
            let quality = 1.0 + 0.12 * m as f64 + 0.05 * p as f64;
            evaluations.push(evaluation(model, *protocol, images, quality));
        }
    }
    let mut differences = Vec::new();
    for (m, model) in models.iter().enumerate().skip(1) {
        for (p, protocol) in protocols.iter().enumerate() {
            let (a, b) = (&evaluations[p], &evaluations[m * protocols.len() + p]);
            differences.push(Difference {
                a: models[0].to_owned(),
                b: (*model).to_owned(),
                protocol: *protocol,
                images: a.images.evaluated,
                scores: a
                    .intervals
                    .scores
                    .iter()
                    .zip(&b.intervals.scores)
                    .map(|(a, b)| {
                        let difference = b.value - a.value;
                        let half = 0.2 * (a.high - a.low) + 1e-3;
                        ScoreDifference {
                            score: a.score.clone(),
                            a: a.value,
                            b: b.value,
                            difference,
                            low: difference - half,
                            high: difference + half,
                            p_value: if difference.abs() > half { 0.0004 } else { 0.31 },
                            significant: difference.abs() > half,
                        }
                    })
                    .collect(),
            });
        }
    }
    EvaluationSet { evaluations, differences, published: Vec::new() }
}

/// One evaluation in which nothing could be scored.
pub fn nothing() -> EvaluationSet {
    let none = f64::NAN;
    let mut set = set(&["empty"], &[Protocol::Paper], 9);
    let e = &mut set.evaluations[0];
    e.images = ImageCounts { found: 9, evaluated: 0, skipped: 4, failed: 5, unaligned: 0 };
    e.reasons = BTreeMap::from([
        ("no ground truth of this name".to_owned(), 4),
        ("no pixel has a height in both".to_owned(), 5),
    ]);
    e.per_image_mean = MeanScores {
        mae_m: none,
        rmse_m: none,
        lt_2_5_m_pct: none,
        lt_7_5_m_pct: none,
        bias_m: none,
        completeness_pct: none,
    };
    e.as_published =
        PublishedScores { mae_m: none, rmse_m: none, lt_2_5_m_pct: none, lt_7_5_m_pct: none };
    e.pooled = PooledScores {
        mae_m: none,
        rmse_m: none,
        bias_m: none,
        std_m: none,
        median_m: none,
        nmad_m: none,
        le68_m: none,
        le90_m: none,
        p95_m: none,
        max_m: none,
        lt_2_5_m_pct: none,
        lt_7_5_m_pct: none,
        thresholds: Vec::new(),
        pixels: 0,
        truth_pixels: 0,
        completeness_pct: none,
    };
    e.intervals.blocks = 0;
    for i in &mut e.intervals.scores {
        (i.value, i.low, i.high, i.naive_low, i.naive_high) = (none, none, none, none, none);
    }
    e.strata.clear();
    e.histogram.counts.fill(0);
    (e.histogram.below, e.histogram.above) = (0, 0);
    e.by_position.mae_m.fill(none);
    e.by_position.bias_m.fill(none);
    e.registration = None;
    for (i, image) in e.per_image.iter_mut().enumerate() {
        (image.status, image.reason) = if i < 4 {
            (Status::Skipped, "no ground truth of this name".to_owned())
        } else {
            (Status::Failed, "no pixel has a height in both".to_owned())
        };
        image.scores = None;
    }
    set
}

fn mean(of: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = of.collect();
    values.iter().sum::<f64>() / values.len() as f64
}

/// One evaluation; errors grow with `quality`.
pub fn evaluation(model: &str, protocol: Protocol, images: usize, quality: f64) -> Evaluation {
    let mut noise = Noise(7);
    let per_image: Vec<ImageScore> =
        (0..images).map(|i| image(i, protocol, quality, &mut noise)).collect();
    let scored: Vec<&ImageScores> = per_image.iter().filter_map(|i| i.scores.as_ref()).collect();
    let mut reasons = BTreeMap::new();
    for image in &per_image {
        if !image.reason.is_empty() {
            *reasons.entry(image.reason.clone()).or_insert(0) += 1;
        }
    }
    let with = |status| per_image.iter().filter(|i| i.status == status).count() as u64;
    let unaligned = scored.iter().filter(|s| !s.flags.is_empty()).count() as u64;
    let per_image_mean = MeanScores {
        mae_m: mean(scored.iter().map(|s| s.mae_m)),
        rmse_m: mean(scored.iter().map(|s| s.rmse_m)),
        lt_2_5_m_pct: mean(scored.iter().map(|s| s.lt_2_5_m_pct)),
        lt_7_5_m_pct: mean(scored.iter().map(|s| s.lt_7_5_m_pct)),
        bias_m: mean(scored.iter().map(|s| s.bias_m)),
        completeness_pct: mean(scored.iter().map(|s| s.completeness_pct)),
    };
    let pixels: u64 = scored.iter().map(|s| s.pixels).sum();
    let (mae_m, rmse_m) = (per_image_mean.mae_m * 1.004, per_image_mean.rmse_m * 1.06);
    let pooled = PooledScores {
        mae_m,
        rmse_m,
        bias_m: 0.213,
        std_m: rmse_m * 0.999,
        median_m: -0.117,
        nmad_m: 0.62 * mae_m,
        le68_m: 0.95 * mae_m,
        le90_m: 2.303 * mae_m,
        p95_m: 3.2 * mae_m,
        max_m: 58.301,
        lt_2_5_m_pct: 100.0 * (1.0 - libm::exp(-2.5 / mae_m)),
        lt_7_5_m_pct: 100.0 * (1.0 - libm::exp(-7.5 / mae_m)),
        thresholds: vec![ThresholdShare {
            threshold_m: 1.0,
            pooled_pct: 31.2,
            per_image_mean_pct: 30.9,
        }],
        pixels,
        truth_pixels: pixels + 12_345,
        completeness_pct: 100.0 * pixels as f64 / (pixels + 12_345) as f64,
    };
    let as_published = PublishedScores {
        mae_m: per_image_mean.mae_m,
        rmse_m: per_image_mean.rmse_m,
        lt_2_5_m_pct: pooled.lt_2_5_m_pct,
        lt_7_5_m_pct: pooled.lt_7_5_m_pct,
    };
    let interval = |score: &str, value: f64, half: f64| Interval {
        score: score.to_owned(),
        value,
        low: value - half,
        high: value + 1.1 * half,
        naive_low: value - half / 1.8,
        naive_high: value + half / 1.8,
    };
    let scores = vec![
        interval("per_image_mean.mae_m", per_image_mean.mae_m, 0.162),
        interval("per_image_mean.rmse_m", per_image_mean.rmse_m, 0.231),
        interval("per_image_mean.lt_2_5_m_pct", per_image_mean.lt_2_5_m_pct, 1.31),
        interval("per_image_mean.lt_7_5_m_pct", per_image_mean.lt_7_5_m_pct, 0.92),
        interval("pooled.mae_m", mae_m, 0.171),
        interval("pooled.rmse_m", rmse_m, 0.244),
        interval("pooled.bias_m", pooled.bias_m, 0.1),
        interval("pooled.median_m", pooled.median_m, 0.09),
        interval("pooled.nmad_m", pooled.nmad_m, 0.08),
        interval("pooled.le90_m", pooled.le90_m, 0.4),
        interval("pooled.lt_2_5_m_pct", pooled.lt_2_5_m_pct, 1.25),
        interval("pooled.lt_7_5_m_pct", pooled.lt_7_5_m_pct, 0.87),
    ];
    let convention = |name: &str, text: &str| (name.to_owned(), text.to_owned());
    Evaluation {
        schema: "sat3d-eval-1".to_owned(),
        model: model.to_owned(),
        protocol,
        offset: OffsetMethod::Ransac,
        seed: 1,
        conventions: BTreeMap::from([
            convention("error", "prediction - ground truth, metres"),
            convention(
                "shift",
                "applied to the ground truth; +x east, +y south, prediction pixels",
            ),
            convention("vertical_offset", "subtracted from the ground truth"),
        ]),
        images: ImageCounts {
            found: images as u64,
            evaluated: with(Status::Done),
            skipped: with(Status::Skipped),
            failed: with(Status::Failed),
            unaligned,
        },
        reasons,
        per_image_mean,
        strata: strata(&pooled),
        histogram: histogram(mae_m, pixels),
        by_position: by_position(mae_m),
        pooled,
        as_published,
        intervals: Intervals {
            block_m: 500.0,
            blocks: 24,
            replicates: 1000,
            level_pct: 95.0,
            scores,
        },
        registration: Some(Registration {
            images: with(Status::Done),
            east_m: Estimate { value: 0.412, standard_error: 0.051, spread: 0.63 },
            north_m: Estimate { value: -1.204, standard_error: 0.048, spread: 0.59 },
            vertical_m: Estimate { value: 11.82, standard_error: 0.31, spread: 3.4 },
            lean_east: Some(Estimate { value: 0.031, standard_error: 0.004, spread: 0.05 }),
            lean_north: None,
        }),
        per_image,
    }
}

fn image(i: usize, protocol: Protocol, quality: f64, noise: &mut Noise) -> ImageScore {
    let (row, column) = (i / 10, i % 10);
    let lat = 47.6001 + 0.0011 * row as f64 + 0.0001 * noise.next();
    let lon = -122.3501 + 0.0016 * column as f64 + 0.0001 * noise.next();
    let down_town = libm::exp(-((column as f64 - 6.0) * (column as f64 - 6.0) + row as f64) / 9.0);
    let mae = quality * (1.3 + 0.45 * libm::fabs(noise.bell()) + 6.5 * down_town + noise.next());
    let rmse = mae * (1.25 + 0.35 * noise.next());
    let [bias, angle, shift_x, shift_y] = [noise.bell(), noise.next(), noise.next(), noise.next()];
    let status = match i % 25 {
        17 => Status::Skipped,
        23 => Status::Failed,
        _ => Status::Done,
    };
    let flags = if i % 13 == 5 { vec![AlignmentFlag::ShiftBeyondLimit] } else { Vec::new() };
    let residuals = |std_m: f64| Residuals {
        pixels: 64_000,
        mean_m: 0.01,
        median_m: 0.0,
        std_m,
        nmad_m: 0.7 * std_m,
    };
    let shift_px = Shift {
        x: (shift_x * 40.0).round() / 10.0 - 2.0,
        y: (shift_y * 40.0).round() / 10.0 - 2.0,
    };
    ImageScore {
        name: format!("satellite_{lat:.7}_{lon:.7}"),
        status,
        reason: match status {
            Status::Done => String::new(),
            Status::Skipped => "no ground truth of this name".to_owned(),
            Status::Failed => "the prediction is 3 x 3 x 7, not one layer".to_owned(),
        },
        lat_deg: Some(lat),
        lon_deg: Some(lon),
        scores: (status == Status::Done).then(|| ImageScores {
            mae_m: mae,
            rmse_m: rmse,
            lt_2_5_m_pct: 100.0 * (1.0 - libm::exp(-2.5 / mae)),
            lt_7_5_m_pct: 100.0 * (1.0 - libm::exp(-7.5 / mae)),
            bias_m: 0.3 * bias,
            median_m: 0.1 * bias,
            nmad_m: 0.6 * mae,
            le68_m: 0.9 * mae,
            le90_m: 2.4 * mae,
            p95_m: 3.1 * mae,
            max_m: 9.0 * mae,
            pixels: 65_536 - 40 * (i as u64 % 30),
            truth_pixels: 65_536,
            completeness_pct: 100.0 * (65_536 - 40 * (i % 30)) as f64 / 65_536.0,
            shift_px,
            shift_m: Some(Shift { x: 0.252 * shift_px.x, y: 0.252 * shift_px.y }),
            rotation_deg: (angle * 8.0).round() / 2.0 - 2.0,
            vertical_offset_m: 11.8 + bias,
            correlation: Some(0.71),
            inliers: Some(41),
            coregistration: (protocol == Protocol::Coregister).then(|| Coregistration {
                iterations: 6,
                before: residuals(rmse * 1.2),
                after: residuals(rmse),
                shift_error_px: Shift { x: 0.02, y: 0.03 },
            }),
            flags,
            notes: if i == 3 {
                vec!["2 infinite heights taken as no data".to_owned()]
            } else {
                Vec::new()
            },
        }),
    }
}

fn strata(pooled: &PooledScores) -> Vec<StratumGroup> {
    let group =
        |name: &str, unit: &str, description: &str, bins: &[(&str, f64, f64)]| StratumGroup {
            name: name.to_owned(),
            unit: unit.to_owned(),
            description: description.to_owned(),
            rows: bins
                .iter()
                .map(|(label, share, factor)| {
                    let pixels = (pooled.pixels as f64 * share) as u64;
                    let of = |value: f64| if pixels == 0 { f64::NAN } else { value };
                    StratumRow {
                        label: (*label).to_owned(),
                        pixels,
                        share_pct: 100.0 * share,
                        truth_pixels: pixels,
                        completeness_pct: of(99.8),
                        mae_m: of(pooled.mae_m * factor),
                        rmse_m: of(pooled.rmse_m * factor),
                        bias_m: of(0.4 - 0.5 * factor),
                        median_m: of(0.1),
                        nmad_m: of(pooled.nmad_m * factor),
                        le90_m: of(pooled.le90_m * factor),
                        lt_2_5_m_pct: of(100.0 * (1.0 - libm::exp(-2.5 / (pooled.mae_m * factor)))),
                        lt_7_5_m_pct: of(100.0 * (1.0 - libm::exp(-7.5 / (pooled.mae_m * factor)))),
                    }
                })
                .collect(),
        };
    vec![
        group(
            "slope",
            "degrees",
            "Slope of the ground truth.",
            &[
                ("0 to 5", 0.42, 0.55),
                ("5 to 15", 0.21, 0.8),
                ("15 to 30", 0.15, 1.2),
                ("30 to 60", 0.12, 1.7),
                ("60 to 90", 0.1, 2.4),
            ],
        ),
        group(
            "edge_distance",
            "metres",
            "Distance to the nearest height edge of the ground truth.",
            &[
                ("0 to 1", 0.2, 1.9),
                ("1 to 2", 0.15, 1.3),
                ("2 to 5", 0.25, 0.9),
                ("over 5", 0.4, 0.5),
            ],
        ),
        group(
            "class",
            "",
            "Class of the mask.",
            &[
                ("building", 0.31, 1.6),
                ("tree & <shrub>", 0.22, 1.2),
                ("ground", 0.47, 0.5),
                ("water", 0.0, 1.0),
            ],
        ),
    ]
}

fn histogram(mae: f64, pixels: u64) -> ErrorHistogram {
    // A Laplace distribution of this mean absolute error, and a share that leans to one side.
    let (low_m, bin_m) = (-50.0, 0.25);
    let mut counts = Vec::new();
    for bin in 0..400 {
        let middle = low_m + (f64::from(bin) + 0.5) * bin_m;
        let density = libm::exp(-middle.abs() / mae) / (2.0 * mae)
            + if middle > 0.0 { 0.1 * libm::exp(-middle / (2.0 * mae)) / (2.0 * mae) } else { 0.0 };
        counts.push((density * bin_m * pixels as f64 * 0.9) as u64);
    }
    ErrorHistogram { low_m, bin_m, counts, below: pixels / 2000, above: pixels / 900 }
}

fn by_position(mae: f64) -> PositionMap {
    let cells = 16_u32;
    let place = |i: u32| {
        let (y, x) = (f64::from(i / cells) - 7.5, f64::from(i % cells) - 7.5);
        (x, y, libm::sqrt(x * x + y * y) / 10.6)
    };
    PositionMap {
        cells,
        mae_m: (0..cells * cells).map(|i| mae * (0.8 + 0.5 * place(i).2)).collect(),
        bias_m: (0..cells * cells).map(|i| 0.05 * place(i).0 + 0.02 * place(i).1).collect(),
    }
}

/// Best, median and worst image of a made-up town: blocks on a slope, the prediction blurred.
pub fn panels() -> Vec<Panel> {
    [("Best", 1_u64, 2_usize), ("Median", 2, 5), ("Worst", 3, 11)]
        .map(|(caption, seed, blur)| {
            let mut noise = Noise(seed);
            let size = 128_usize;
            let mut truth: Vec<f32> = (0..size * size)
                .map(|i| (i % size) as f32 * 0.03 + (i / size) as f32 * 0.01)
                .collect();
            for _ in 0..40 {
                let mut within = |most: usize| (noise.next() * most as f64) as usize;
                let (x, y, w, h) =
                    (within(size - 20), within(size - 20), 5 + within(15), 5 + within(15));
                let tall = 4.0 + within(22 * blur) as f32 * 0.3;
                for j in y..y + h {
                    for i in x..x + w {
                        truth[j * size + i] = tall + i as f32 * 0.03;
                    }
                }
            }
            let mut prediction = vec![0.0; size * size];
            for y in 0..size {
                for x in 0..size {
                    let (mut sum, mut n) = (0.0, 0.0);
                    for j in y.saturating_sub(blur)..(y + blur + 1).min(size) {
                        for i in x.saturating_sub(blur)..(x + blur + 1).min(size) {
                            sum += truth[j * size + i];
                            n += 1.0;
                        }
                    }
                    prediction[y * size + x] = sum / n;
                }
            }
            for y in 100..128 {
                truth[y * size..y * size + 30].fill(f32::NAN);
            }
            let (mut sum, mut n) = (0.0, 0.0);
            for (p, t) in prediction.iter().zip(&truth) {
                if !t.is_nan() {
                    sum += f64::from((p - t).abs());
                    n += 1.0;
                }
            }
            Panel {
                caption: caption.to_owned(),
                name: format!("satellite_47.60{seed}_-122.35"),
                prediction: Surface::new(size, size, prediction),
                truth: Surface::new(size, size, truth),
                mae_m: sum / n,
            }
        })
        .into()
}
