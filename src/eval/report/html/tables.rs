//! The report's tables.

use super::svg::px;
use crate::batch::Status;
use crate::eval::report::data::flags;
use crate::eval::report::number::{count, fixed, p_value, plural, range, signed};
use crate::eval::report::score::{Average, both_ways, interval, published, robust, score};
use crate::eval::summary::{
    Difference, Estimate, Evaluation, EvaluationSet, ImageScore, ImageScores, Registration,
    StratumGroup,
};
use crate::html::escape;

/// Most images in the table of an evaluation: the best and the worst halves of it.
const MOST_IMAGES: usize = 2000;

/// A table that scrolls sideways in its own box when the window is narrow.
fn table(class: &str, caption: &str, head: &str, body: &str) -> String {
    format!(
        "<div class=scroll tabindex=0 role=region aria-label=\"{caption}\"><table class=\"{class}\">\
         <caption>{caption}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>\n"
    )
}

/// Heads of columns; those of columns that hold words stand at the left.
fn heads<const N: usize>(names: [&str; N]) -> String {
    let words = ["averaged", "status", "reason", "unit", "verdict", "flags and notes", "MAE, RMSE"];
    let class = |name: &str| if words.contains(&name) { " class=text" } else { "" };
    names.iter().map(|name| format!("<th scope=col{}>{name}</th>", class(name))).collect()
}

fn cells<const N: usize>(values: [String; N]) -> String {
    values.iter().map(|value| format!("<td>{value}</td>")).collect()
}

fn unit(value: &str, unit: &str) -> String {
    if unit.is_empty() { value.to_owned() } else { format!("{value}&nbsp;{unit}") }
}

/// The four numbers of the paper's table, large.
pub(super) fn tiles(e: &Evaluation) -> String {
    let mut out = String::from("<dl class=tiles>");
    for (path, value) in published(e) {
        let s = score(path);
        let [(low, high), _] = interval(e, path);
        let interval = if low.is_nan() || high.is_nan() {
            "no interval".to_owned()
        } else {
            format!("{} ({} %)", range(low, high, 2), fixed(e.intervals.level_pct, 0))
        };
        out += &format!(
            "<div><dt>{}</dt><dd><b>{}</b>&nbsp;{}</dd><dd>{}</dd><dd>{interval}</dd></div>",
            s.name,
            fixed(value, 2),
            s.unit,
            s.average.name()
        );
    }
    out + "</dl>\n"
}

/// One row per evaluation and published method.
pub(super) fn comparison(set: &EvaluationSet, labels: &[String]) -> String {
    let several = set.evaluations.len() > 1;
    let mut body = String::new();
    for (e, label) in set.evaluations.iter().zip(labels) {
        body += &format!(
            "<tr><th scope=row>{}</th><td>{} of {}</td>",
            escape(label),
            count(e.images.evaluated),
            count(e.images.found)
        );
        for (path, value) in published(e) {
            let s = score(path);
            let [(low, high), _] = interval(e, path);
            let interval = if low.is_nan() || high.is_nan() {
                String::new()
            } else {
                format!("<br><small>{}</small>", range(low, high, 2))
            };
            body += &format!("<td>{}{interval}</td>", fixed(value, s.digits()));
        }
        if several {
            let p = &e.pooled;
            body += &cells([signed(p.bias_m, 2), fixed(p.nmad_m, 2), fixed(p.le90_m, 2)]);
        }
        body += "</tr>";
    }
    for row in &set.published {
        let s = &row.scores;
        body += &format!(
            "<tr class=published><th scope=row>{} <span class=badge>published</span></th><td></td>",
            escape(row.method)
        );
        for value in [s.mae_m, s.rmse_m, s.lt_2_5_m_pct, s.lt_7_5_m_pct] {
            body += &format!("<td>{}</td>", fixed(value, 2));
        }
        body += if several { "<td></td><td></td><td></td></tr>" } else { "</tr>" };
    }
    let mut head = heads([
        "predictions",
        "images",
        "MAE, m<br><small>mean over images</small>",
        "RMSE, m<br><small>mean over images</small>",
        "under 2.5 m, %<br><small>over all pixels</small>",
        "under 7.5 m, %<br><small>over all pixels</small>",
    ]);
    if several {
        head += &heads([
            "bias, m<br><small>over all pixels</small>",
            "NMAD, m<br><small>over all pixels</small>",
            "LE90, m<br><small>over all pixels</small>",
        ]);
    }
    let mut out =
        table("numbers", "Averaged as published, with 95 % intervals by block", &head, &body);
    let mut sources: Vec<&str> = set.published.iter().map(|row| row.source).collect();
    sources.dedup();
    for source in sources {
        out += &format!(
            "<p class=note>Rows marked <span class=badge>published</span> are quoted from {}; nothing in them is computed here.</p>\n",
            escape(source)
        );
    }
    out
}

/// Every score that can be averaged in two ways, in both; then those over pixels only.
pub(super) fn scores(e: &Evaluation) -> String {
    let mut body = String::new();
    for pair in both_ways(e) {
        body += &format!("<tr><th scope=row>{}</th>", score(pair[0].0).name);
        for (path, value) in pair {
            let s = score(path);
            let [block, naive] = interval(e, path);
            let mark = if s.published { " <span class=badge>as published</span>" } else { "" };
            body += &format!("<td>{}{mark}</td>", unit(&fixed(value, s.digits()), s.unit));
            body +=
                &cells([range(block.0, block.1, s.digits()), range(naive.0, naive.1, s.digits())]);
        }
        body += "</tr>";
    }
    for t in &e.pooled.thresholds {
        body += &format!(
            "<tr><th scope=row>under {} m</th><td>{}</td><td></td><td></td><td>{}</td><td></td><td></td></tr>",
            t.threshold_m,
            unit(&fixed(t.per_image_mean_pct, 2), "%"),
            unit(&fixed(t.pooled_pct, 2), "%")
        );
    }
    let head = format!(
        "<th scope=col>score</th>{}",
        heads([
            Average::Images.name(),
            "95 % by block",
            "<i>naive, by image</i>",
            Average::Pixels.name(),
            "95 % by block",
            "<i>naive, by image</i>",
        ])
    );
    let mut out = table("numbers both", "Both averages of each score", &head, &body);

    let (mut head, mut values, mut intervals) =
        (String::from("<td></td>"), String::new(), String::new());
    for (path, value) in robust(e) {
        let s = score(path);
        let sign = matches!(path, "pooled.bias_m" | "pooled.median_m");
        let text = if sign { signed(value, 3) } else { fixed(value, 3) };
        head += &format!("<th scope=col>{}, m</th>", s.name);
        values += &format!("<td>{text}</td>");
        let (low, high) = interval(e, path)[0];
        let text = if low.is_nan() || high.is_nan() { String::new() } else { range(low, high, 2) };
        intervals += &format!("<td><small>{text}</small></td>");
    }
    let body = format!(
        "<tr><th scope=row>over all pixels</th>{values}</tr><tr><th scope=row><small>95 % by block</small></th>{intervals}</tr>"
    );
    out += &table("numbers", "Distribution of the errors", &head, &body);
    let i = &e.intervals;
    out += &format!(
        "<p class=note>{} compared, {} % of {} with a ground truth. ",
        plural(e.pooled.pixels, "pixel", "pixels"),
        fixed(e.pooled.completeness_pct, 2),
        count(e.pooled.truth_pixels)
    );
    out += &if i.blocks < 2 {
        format!(
            "No intervals by block: it takes two blocks of {} m with images.",
            fixed(i.block_m, 0)
        )
    } else {
        format!(
            "Intervals: {} bootstrap draws of {} blocks of {} m. Naive intervals draw single images as if \
             they were independent; images overlap, so these are too narrow.",
            count(u64::from(i.replicates)),
            count(i.blocks),
            fixed(i.block_m, 0)
        )
    };
    out + "</p>\n"
}

/// Paired differences.
pub(super) fn differences(differences: &[Difference]) -> String {
    let mut out = String::new();
    for d in differences {
        // Metres and per cents cannot share a scale.
        let most = |unit: &str| {
            let same = d.scores.iter().filter(|s| score(&s.score).unit == unit);
            let ends = same.flat_map(|s| [s.low.abs(), s.high.abs()]);
            ends.filter(|v| v.is_finite()).fold(0.0, f64::max)
        };
        let mut body = String::new();
        for s in &d.scores {
            let named = score(&s.score);
            let digits = named.digits();
            body += &format!(
                "<tr{}><th scope=row>{}, {}</th><td class=text>{}</td>",
                if s.significant { " class=signal" } else { "" },
                escape(&named.name),
                named.unit,
                named.average.name()
            );
            body += &cells([
                fixed(s.a, digits),
                fixed(s.b, digits),
                signed(s.difference, digits),
                range(s.low, s.high, digits),
                p_value(s.p_value).replace('<', "&lt;"),
            ]);
            body += &format!(
                "<td class=text>{}</td><td>{}</td></tr>",
                if s.significant { "more than noise" } else { "within noise" },
                whisker(s.difference, s.low, s.high, most(named.unit))
            );
        }
        let (a, b) = (escape(&d.a), escape(&d.b));
        let head = format!(
            "<td></td>{}",
            heads(["averaged", &a, &b, "difference", "95 % by block", "p", "verdict", ""])
        );
        let caption = format!(
            "{b} \u{2212} {a}, protocol {}, on the {} that both have",
            d.protocol.name(),
            plural(d.images, "image", "images")
        );
        let whole = table("numbers", &caption, &head, &body);
        if differences.len() == 1 {
            out += &whole;
            continue;
        }
        // Many pairs are told in a line each; the table opens.
        let published = ["per_image_mean.mae_m", "per_image_mean.rmse_m"];
        let told = d.scores.iter().filter(|s| published.contains(&s.score.as_str())).map(|s| {
            let verdict = if s.significant { "more than noise" } else { "within noise" };
            let named = score(&s.score);
            let difference = signed(s.difference, named.digits());
            format!("{} {difference} {} ({verdict})", escape(&named.name), named.unit)
        });
        let told: Vec<String> = told.collect();
        out += &format!(
            "<details><summary><b>{b} \u{2212} {a}</b> ({}): {}</summary>{whole}</details>\n",
            d.protocol.name(),
            told.join(", ")
        );
    }
    if !out.is_empty() {
        out += "<p class=note>Errors: less is better; shares: more is better. \u{201c}More than noise\u{201d}: \
                the difference is beyond chance at 5 %, after Holm's correction over all pairs, score by score. \
                The whiskers of a table share one scale for metres and one for per cents.</p>\n";
    }
    out
}

/// An interval about zero as a small drawing.
fn whisker(value: f64, low: f64, high: f64, most: f64) -> String {
    if !(value.is_finite() && low.is_finite() && high.is_finite() && most > 0.0) {
        return String::new();
    }
    let at = |v: f64| px(60.0 + 56.0 * (v / most).clamp(-1.0, 1.0));
    format!(
        "<svg class=whisker width=120 height=14 aria-hidden=true><path class=grid d=\"M60 0V14\"/>\
         <path class=\"line s0\" d=\"M{} 7H{}\"/><circle class=\"dot s0\" cx={} cy=7 r=3.2 /></svg>",
        at(low),
        at(high),
        at(value)
    )
}

/// Scores by kind of place, with bars.
pub(super) fn strata(groups: &[StratumGroup]) -> String {
    let mut out = String::new();
    for group in groups {
        let most =
            group.rows.iter().map(|r| r.rmse_m).filter(|v| v.is_finite()).fold(0.0, f64::max);
        let mut body = String::new();
        for r in &group.rows {
            body += &format!(
                "<tr><th scope=row>{}</th><td>{}</td>",
                escape(&r.label),
                bar(r.mae_m, r.rmse_m, most)
            );
            body += &cells([
                fixed(r.mae_m, 2),
                fixed(r.rmse_m, 2),
                signed(r.bias_m, 2),
                signed(r.median_m, 2),
                fixed(r.nmad_m, 2),
                fixed(r.le90_m, 2),
                fixed(r.lt_2_5_m_pct, 1),
                fixed(r.lt_7_5_m_pct, 1),
                count(r.pixels),
                fixed(r.share_pct, 1),
                fixed(r.completeness_pct, 1),
            ]);
            body += "</tr>";
        }
        let name = escape(&group.name.replace('_', " "));
        let unit = if group.unit.is_empty() {
            String::new()
        } else {
            format!(", {}", escape(&group.unit))
        };
        let head = format!(
            "<th scope=col>{name}{unit}</th>{}",
            heads([
                "MAE, RMSE",
                "MAE",
                "RMSE",
                "bias",
                "median",
                "NMAD",
                "LE90",
                "&lt; 2.5 m, %",
                "&lt; 7.5 m, %",
                "pixels",
                "share, %",
                "complete, %",
            ])
        );
        out +=
            &table("numbers", &format!("By {name} (errors in metres, over pixels)"), &head, &body);
        out += &format!("<p class=note>{}</p>\n", escape(&group.description));
    }
    if !out.is_empty() {
        out += "<p class=note>Bar: MAE; tick: RMSE, on one scale per table.</p>\n";
    }
    out
}

fn bar(mae: f64, rmse: f64, most: f64) -> String {
    if !(mae.is_finite() && rmse.is_finite() && most > 0.0) {
        return String::new();
    }
    format!(
        "<svg class=bar width=100 height=14 aria-hidden=true><rect class=\"fill s0\" y=2 width={} height=10 />\
         <path class=tickmark d=\"M{} 0V14\"/></svg>",
        px(97.0 * (mae / most).clamp(0.0, 1.0)),
        px(97.0 * (rmse / most).clamp(0.0, 1.0) + 0.5)
    )
}

/// The offset between images and ground truth.
pub(super) fn registration(r: &Registration) -> String {
    let mut body = String::new();
    let mut line = |name: &str, e: &Estimate, digits: usize, unit: &str| {
        body += &format!("<tr><th scope=row>{name}</th>");
        body += &cells([
            signed(e.value, digits),
            fixed(e.standard_error, digits),
            fixed(e.spread, digits),
        ]);
        body += &format!("<td class=text>{unit}</td></tr>");
    };
    line("truth onto prediction, east", &r.east_m, 2, "m");
    line("truth onto prediction, north", &r.north_m, 2, "m");
    line("truth \u{2212} prediction, vertical", &r.vertical_m, 2, "m");
    for (name, lean) in [("lean, east", &r.lean_east), ("lean, north", &r.lean_north)] {
        if let Some(lean) = lean {
            line(name, lean, 4, "m per m of height");
        }
    }
    let head =
        format!("<td></td>{}", heads(["estimate", "standard error", "spread (NMAD)", "unit"]));
    table(
        "numbers narrow",
        &format!(
            "Registration of images and ground truth, from {}: estimated, not applied",
            plural(r.images, "image", "images")
        ),
        &head,
        &body,
    )
}

/// Images without scores, with the reasons.
pub(super) fn missing(e: &Evaluation) -> String {
    let mut out = String::new();
    if !e.reasons.is_empty() {
        let body: String = e
            .reasons
            .iter()
            .map(|(reason, n)| {
                format!("<tr><th scope=row>{}</th><td>{}</td></tr>", escape(reason), count(*n))
            })
            .collect();
        out += &table("numbers narrow", "Reasons", &heads(["reason", "images"]), &body);
    }
    let missing: Vec<&ImageScore> =
        e.per_image.iter().filter(|i| i.status != Status::Done).collect();
    if missing.is_empty() {
        return out;
    }
    let body: String = missing
        .iter()
        .take(MOST_IMAGES)
        .map(|i| {
            format!(
                "<tr><th scope=row>{}</th><td class=text>{}</td><td class=text>{}</td></tr>",
                escape(&i.name),
                i.status.name(),
                escape(&i.reason)
            )
        })
        .collect();
    let title = format!("{} without scores", plural(missing.len() as u64, "image", "images"));
    out += &format!(
        "<details{}><summary>Which, and why</summary>",
        if missing.len() <= 20 { " open" } else { "" }
    );
    out += &table("numbers", &title, &heads(["image", "status", "reason"]), &body);
    if missing.len() > MOST_IMAGES {
        out += &format!(
            "<p class=note>The first {} of {}; all are in the CSV, Parquet and JSON output.</p>",
            count(MOST_IMAGES as u64),
            count(missing.len() as u64)
        );
    }
    out + "</details>\n"
}

/// Every image that was scored, or the best and the worst of very many.
pub(super) fn images(e: &Evaluation) -> String {
    let mut images: Vec<(&ImageScore, &ImageScores)> =
        e.per_image.iter().filter_map(|i| i.scores.as_ref().map(|s| (i, s))).collect();
    if images.is_empty() {
        return String::new();
    }
    let all = images.len();
    images.sort_by(|a, b| b.1.mae_m.total_cmp(&a.1.mae_m));
    if all > MOST_IMAGES {
        images.drain(MOST_IMAGES / 2..all - MOST_IMAGES / 2);
    }
    let mut body = String::new();
    for (i, s) in &images {
        body += &format!("<tr><th scope=row>{}</th>", escape(&i.name));
        body += &cells([
            fixed(s.mae_m, 2),
            fixed(s.rmse_m, 2),
            fixed(s.lt_2_5_m_pct, 1),
            fixed(s.lt_7_5_m_pct, 1),
            signed(s.bias_m, 2),
            fixed(s.nmad_m, 2),
            fixed(s.le90_m, 2),
            fixed(s.max_m, 1),
            count(s.pixels),
            fixed(s.completeness_pct, 1),
            signed(s.shift_px.x, 1),
            signed(s.shift_px.y, 1),
            signed(s.rotation_deg, 1),
            signed(s.vertical_offset_m, 2),
        ]);
        let told: Vec<String> =
            [flags(s), s.notes.join("; ")].into_iter().filter(|t| !t.is_empty()).collect();
        body += &format!("<td class=text>{}</td></tr>", escape(&told.join("; ")));
    }
    let head = heads([
        "image",
        "MAE, m",
        "RMSE, m",
        "&lt; 2.5 m, %",
        "&lt; 7.5 m, %",
        "bias, m",
        "NMAD, m",
        "LE90, m",
        "max, m",
        "pixels",
        "complete, %",
        "shift x, px",
        "shift y, px",
        "rotation, \u{b0}",
        "offset, m",
        "flags and notes",
    ]);
    let mut out = table("numbers images", "Images, worst first", &head, &body);
    if all > MOST_IMAGES {
        out += &format!(
            "<p class=note>The worst and the best {} of {} images by MAE; all are in the CSV, Parquet and JSON output.</p>\n",
            count(MOST_IMAGES as u64 / 2),
            count(all as u64)
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::super::sample;
    use super::*;
    use crate::eval::Protocol;

    #[test]
    fn very_many_images_are_cut_to_the_worst_and_the_best() {
        let mut e = sample::evaluation("m", Protocol::Paper, 2600, 1.0);
        assert!(images(&e).contains("The worst and the best 1,000 of"));
        assert_eq!(images(&e).matches("<tr><th scope=row>").count(), MOST_IMAGES);
        let mut maes: Vec<f64> =
            e.per_image.iter().filter_map(|i| i.scores.as_ref()).map(|s| s.mae_m).collect();
        maes.sort_by(f64::total_cmp);
        e.per_image.truncate(2000);
        assert!(!images(&e).contains("The worst and the best"));
    }

    #[test]
    fn names_and_reasons_are_escaped() {
        let mut e = sample::evaluation("m", Protocol::Paper, 50, 1.0);
        for i in &mut e.per_image {
            i.name = "<img src=x onerror=alert(1)>".to_owned();
            i.reason = i.reason.replace("no", "<b>");
        }
        e.reasons.insert("</table><script>".to_owned(), 1);
        e.strata[0].rows[0].label = "<i>".to_owned();
        let all = images(&e) + &missing(&e) + &strata(&e.strata) + &scores(&e);
        for bad in ["<img", "<b>ground", "</table><script>", "<th scope=row><i>"] {
            assert!(!all.contains(bad), "{bad}");
        }
        assert!(all.contains("&lt;img src=x onerror=alert(1)&gt;"));
    }
}
