//! Charts of errors: histogram, cumulative curve, images against each other.

use super::svg::{Plot, figure, nice_step, px};
use crate::eval::report::number::{fixed, plural};
use crate::eval::summary::{ErrorHistogram, Evaluation, ImageScores};
use crate::html::escape;

/// Most evaluations in one chart; there are as many colours.
pub(super) const SERIES: usize = 6;
/// Most images that are drawn one by one, with their names.
const NAMED: usize = 4000;

/// Share of all errors below a value, from the histogram, linear within a bin.
fn below(histogram: &ErrorHistogram, value: f64) -> f64 {
    let inside: u64 = histogram.counts.iter().sum();
    let all = (histogram.below + inside + histogram.above) as f64;
    let at =
        ((value - histogram.low_m) / histogram.bin_m).clamp(0.0, histogram.counts.len() as f64);
    let whole = at as usize;
    let mut pixels = histogram.below + histogram.counts[..whole].iter().sum::<u64>();
    let part = histogram.counts.get(whole).map_or(0.0, |n| (at - whole as f64) * *n as f64);
    if whole == histogram.counts.len() && value > histogram.low_m + at * histogram.bin_m {
        pixels += histogram.above;
    }
    (pixels as f64 + part) / all
}

fn total(histogram: &ErrorHistogram) -> u64 {
    histogram.below + histogram.counts.iter().sum::<u64>() + histogram.above
}

/// A round distance that all but one in a hundred errors of every evaluation keep, at least 10 m,
/// and within the histograms.
fn reach(evaluations: &[&Evaluation]) -> f64 {
    let within = |h: &ErrorHistogram, r: f64| below(h, r) - below(h, -r);
    let edge = evaluations
        .iter()
        .map(|e| {
            let h = &e.histogram;
            (h.low_m + h.bin_m * h.counts.len() as f64).abs().max(h.low_m.abs())
        })
        .fold(10.0, f64::max);
    let mut reach = 10.0;
    while reach < edge && evaluations.iter().any(|e| within(&e.histogram, reach) < 0.99) {
        reach += nice_step((edge / 200.0).max(5.0));
    }
    reach
}

fn with_pixels(evaluations: &[Evaluation]) -> Vec<(usize, &Evaluation)> {
    let drawable = |e: &Evaluation| {
        total(&e.histogram) > 0 && !e.histogram.counts.is_empty() && e.histogram.bin_m > 0.0
    };
    evaluations.iter().take(SERIES).enumerate().filter(|(_, e)| drawable(e)).collect()
}

/// Names of the series beside their lines.
pub(super) fn legend(labels: &[String]) -> String {
    if labels.len() < 2 {
        return String::new();
    }
    let mut list = String::from("<ul class=legend>");
    for (i, label) in labels.iter().take(SERIES).enumerate() {
        list += &format!(
            "<li><svg width=28 height=10 aria-hidden=true><path class=\"line s{i}\" d=\"M0 5H28\"/></svg>{}",
            escape(label)
        );
    }
    list += "</ul>";
    if labels.len() > SERIES {
        list += &format!("<p class=note>Charts show the first {SERIES} evaluations.</p>");
    }
    list
}

/// Density of the signed errors of every evaluation.
pub(super) fn distribution(evaluations: &[Evaluation]) -> String {
    let drawn = with_pixels(evaluations);
    let only: Vec<&Evaluation> = drawn.iter().map(|(_, e)| *e).collect();
    if drawn.is_empty() {
        return String::new();
    }
    let reach = reach(&only);
    // Steps that the eye can tell apart, and no finer than the histogram's own.
    let finest = only.iter().map(|e| e.histogram.bin_m).fold(0.0, f64::max);
    let step = nice_step((2.0 * reach / 120.0).max(finest));
    let steps = (2.0 * reach / step).round() as usize;
    let edge = |i: usize| -reach + 2.0 * reach * i as f64 / steps as f64;
    let density = |e: &Evaluation, i: usize| {
        100.0 * (below(&e.histogram, edge(i + 1)) - below(&e.histogram, edge(i)))
            / (edge(i + 1) - edge(i))
    };
    let most = only.iter().flat_map(|e| (0..steps).map(|i| density(e, i))).fold(0.0, f64::max);
    let top = (most / nice_step(most / 5.0)).ceil() * nice_step(most / 5.0);
    let described = format!(
        "Share of pixels per metre of error, from {} to {reach} metres; highest {} per cent per metre.",
        -reach,
        fixed(most, 1)
    );
    let mut plot = Plot::new(
        "Distribution of the errors",
        &described,
        ([-reach, reach], "error = prediction \u{2212} truth, m"),
        ([0.0, top.max(1e-9)], "pixels, % per m"),
    );
    for threshold in [-7.5, -2.5, 2.5, 7.5] {
        plot.mark_x(threshold, &fixed(threshold, 1), "threshold");
    }
    plot.mark_x(0.0, "", "zero");
    for (series, e) in &drawn {
        let stairs =
            (0..steps).flat_map(|i| [(edge(i), density(e, i)), (edge(i + 1), density(e, i))]);
        let line = plot.path(stairs);
        if drawn.len() == 1 {
            let (left, right, bottom) =
                (px(plot.x.at(-reach)), px(plot.x.at(reach)), px(plot.y.at(0.0)));
            plot.svg += &format!(
                "<path class=\"area s{series}\" d=\"{line}L{right} {bottom}L{left} {bottom}Z\"/>"
            );
        }
        plot.svg += &format!("<path class=\"line s{series}\" d=\"{line}\"/>");
    }
    let outside = only
        .iter()
        .map(|e| 100.0 * (1.0 - below(&e.histogram, reach) + below(&e.histogram, -reach)))
        .fold(0.0, f64::max);
    let beyond = format!(
        "How errors are distributed, over all pixels. Dashed: \u{b1}2.5 m and \u{b1}7.5 m. {}{} % of \
         pixels lie beyond \u{b1}{reach} m.",
        if only.len() > 1 { "At most " } else { "" },
        fixed(outside, 2)
    );
    figure(&plot.end(), &beyond)
}

/// The limits of the paper and the shares under them, where those are known.
fn limits(e: &Evaluation) -> impl Iterator<Item = (f64, f64)> {
    [(2.5, e.pooled.lt_2_5_m_pct), (7.5, e.pooled.lt_7_5_m_pct)]
        .into_iter()
        .filter(|(_, share)| share.is_finite())
}

/// Share of pixels under each absolute error.
pub(super) fn cumulative(evaluations: &[Evaluation]) -> String {
    let drawn = with_pixels(evaluations);
    let only: Vec<&Evaluation> = drawn.iter().map(|(_, e)| *e).collect();
    if drawn.is_empty() {
        return String::new();
    }
    let reach = reach(&only);
    let described = only
        .iter()
        .map(|e| {
            format!(
                "{} per cent of pixels under 2.5 metres, {} under 7.5 metres, 90 per cent under {} metres.",
                fixed(e.pooled.lt_2_5_m_pct, 2),
                fixed(e.pooled.lt_7_5_m_pct, 2),
                fixed(e.pooled.le90_m, 2)
            )
        })
        .collect::<Vec<_>>()
        .join(" ");
    let mut plot = Plot::new(
        "Cumulative distribution of the absolute errors",
        &described,
        ([0.0, reach], "|error|, m"),
        ([0.0, 100.0], "pixels under it, %"),
    );
    for threshold in [2.5, 7.5] {
        plot.mark_x(threshold, &format!("{threshold:.1}"), "threshold");
    }
    for (series, e) in &drawn {
        let h = &e.histogram;
        let points = (0..=200).map(|i| {
            let t = reach * f64::from(i) / 200.0;
            (t, 100.0 * (below(h, t) - below(h, -t)))
        });
        let line = plot.path(points);
        plot.svg += &format!("<path class=\"line s{series}\" d=\"{line}\"/>");
        for (t, share) in limits(e) {
            plot.svg += &format!(
                "<circle class=\"dot s{series}\" cx={} cy={} r=3.5><title>{} % under {t} m</title></circle>",
                px(plot.x.at(t)),
                px(plot.y.at(share)),
                fixed(share, 2)
            );
        }
        let le90 = e.pooled.le90_m;
        if le90 <= reach {
            let (x, y) = (plot.x.at(le90), plot.y.at(90.0));
            let single = drawn.len() == 1;
            plot.svg += &format!(
                "<path class=\"mark le90 s{series}\" d=\"{}\"/>\
                 <path class=\"dot s{series}\" d=\"M{} {}l4.5 4.5-4.5 4.5-4.5-4.5z\"><title>LE90 {} m</title></path>",
                plot.path([(0.0, 90.0), (le90, 90.0), (le90, 0.0)].into_iter()),
                px(x),
                px(y - 4.5),
                fixed(le90, 2)
            );
            if single {
                plot.svg += &format!(
                    "<text class=value x={} y={}>LE90 = {} m</text>",
                    px((x + 7.0).min(super::svg::WIDTH - 120.0)),
                    px(plot.y.at(0.0) - 10.0),
                    fixed(le90, 2)
                );
            }
        }
    }
    if let [(_, e)] = &drawn[..] {
        for (t, share) in limits(e) {
            plot.svg += &format!(
                "<text class=value x={} y={}>{} %</text>",
                px(plot.x.at(t) + 7.0),
                px(plot.y.at(share) + 16.0),
                fixed(share, 1)
            );
        }
    }
    figure(
        &plot.end(),
        "Share of pixels whose error is under a limit. Dots: the shares under 2.5 m and 7.5 m; diamond: \
         LE90, the error that 90 % of pixels keep.",
    )
}

/// The images that were scored, with their names.
pub(super) fn scored(evaluation: &Evaluation) -> Vec<(&str, &ImageScores)> {
    let scored = evaluation.per_image.iter();
    scored.filter_map(|i| i.scores.as_ref().map(|s| (i.name.as_str(), s))).collect()
}

/// The value that a share of the values do not exceed; NaN without values.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.retain(|v| !v.is_nan());
    values.sort_by(f64::total_cmp);
    let rank = share * values.len().saturating_sub(1) as f64;
    values.get(rank.round() as usize).copied().unwrap_or(f64::NAN)
}

/// RMSE against MAE, one dot per image.
pub(super) fn scatter(evaluation: &Evaluation, series: usize) -> String {
    let images = scored(evaluation);
    let images: Vec<_> =
        images.into_iter().filter(|(_, s)| s.mae_m.is_finite() && s.rmse_m.is_finite()).collect();
    if images.is_empty() {
        return String::new();
    }
    // A few wild images shall not press all others into a corner.
    let end = |of: fn(&ImageScores) -> f64| {
        let values: Vec<f64> = images.iter().map(|(_, s)| of(s)).collect();
        let (most, usual) = (quantile(values.clone(), 1.0), quantile(values, 0.95));
        let end = if most > 3.0 * usual { 1.5 * usual } else { most };
        let step = nice_step(end / 5.0);
        (end / step * (1.0 - 1e-9)).ceil().max(1.0) * step
    };
    let (right, top) = (end(|s| s.mae_m), end(|s| s.rmse_m));
    let beyond = images.iter().filter(|(_, s)| s.mae_m > right || s.rmse_m > top).count();
    let mut plot = Plot::new(
        "RMSE against MAE of each image",
        &format!("One dot for each of {}.", plural(images.len() as u64, "image", "images")),
        ([0.0, right], "MAE of the image, m"),
        ([0.0, top], "RMSE of the image, m"),
    );
    let same = right.min(top);
    let line = plot.path([(0.0, 0.0), (same, same)].into_iter());
    plot.svg += &format!("<path class=\"mark zero\" d=\"{line}\"/>");
    let (mae, rmse) = (evaluation.per_image_mean.mae_m, evaluation.per_image_mean.rmse_m);
    plot.svg += &dots(
        images.iter().map(|(name, s)| {
            let told =
                format!("{name}: MAE {} m, RMSE {} m", fixed(s.mae_m, 2), fixed(s.rmse_m, 2));
            (plot.x.at(s.mae_m), plot.y.at(s.rmse_m), format!("s{series}"), told)
        }),
        images.len(),
    );
    if mae.is_finite() && rmse.is_finite() {
        plot.svg += &format!(
            "<path class=mean d=\"M{} {}h14m-7-7v14\"><title>mean over images</title></path>",
            px(plot.x.at(mae) - 7.0),
            px(plot.y.at(rmse))
        );
    }
    let mut caption = String::from(
        "Each image: many small errors move right, few large ones up. Cross: mean over images. \
         Dashed: RMSE = MAE, its least.",
    );
    if images.len() <= NAMED {
        caption += " Point at a dot for its name.";
    }
    if beyond > 0 {
        caption += &format!(
            " {} beyond the axes {} drawn at the edge.",
            plural(beyond as u64, "image", "images"),
            if beyond == 1 { "is" } else { "are" }
        );
    }
    figure(&plot.end(), &caption)
}

/// Dots at places with a class and a name each. Very many are drawn as one path per class without
/// names, so that the file stays small.
pub(super) fn dots(
    places: impl Iterator<Item = (f64, f64, String, String)>,
    number: usize,
) -> String {
    let radius = if number > 1000 {
        2.2
    } else if number > 200 {
        3.2
    } else {
        4.2
    };
    let mut svg = String::from("<g class=dots>");
    if number <= NAMED {
        for (x, y, class, name) in places {
            svg += &format!(
                "<circle class={class} cx={} cy={} r={radius}><title>{}</title></circle>",
                px(x),
                px(y),
                escape(&name)
            );
        }
    } else {
        let mut paths = std::collections::BTreeMap::<String, String>::new();
        for (x, y, class, _) in places {
            *paths.entry(class).or_default() += &format!("M{} {}h0", px(x), px(y));
        }
        for (class, path) in paths {
            svg += &format!("<path class=\"many {class}\" d=\"{path}\"/>");
        }
    }
    svg + "</g>"
}

#[cfg(test)]
mod tests {
    use super::*;

    fn histogram() -> ErrorHistogram {
        ErrorHistogram { low_m: -2.0, bin_m: 1.0, counts: vec![1, 2, 3, 2], below: 1, above: 1 }
    }

    #[test]
    fn shares_below_are_linear_within_a_bin() {
        let h = histogram();
        for (value, share) in [
            (-9.0, 0.1),
            (-2.0, 0.1),
            (-1.5, 0.15),
            (0.0, 0.4),
            (0.5, 0.55),
            (2.0, 0.9),
            (9.0, 1.0),
        ] {
            assert!((below(&h, value) - share).abs() < 1e-12, "{value}: {}", below(&h, value));
        }
    }

    #[test]
    fn quantiles_leave_nan_out() {
        assert_eq!(quantile(vec![3.0, f64::NAN, 1.0, 2.0], 0.5), 2.0);
        assert_eq!(quantile(vec![3.0, 1.0], 1.0), 3.0);
        assert!(quantile(vec![f64::NAN], 0.5).is_nan());
    }

    #[test]
    fn many_dots_lose_their_names_and_few_keep_them() {
        let place = |i: usize| (i as f64, 1.0, "q1".to_owned(), format!("<{i}>"));
        assert!(dots((0..3).map(place), 3).contains("<title>&lt;2&gt;</title>"));
        let many = dots((0..5000).map(place), 5000);
        assert_eq!(many.matches("<path").count(), 1);
        assert_eq!(many.matches("h0").count(), 5000);
    }
}
