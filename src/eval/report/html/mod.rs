//! The report: one HTML file that opens from disk without a network.
//!
//! The page carries its style and its few lines of script, its charts as SVG and its pictures as
//! `data:` URIs; a content security policy forbids everything else. It reads without the script,
//! which only sorts tables and switches between light and dark.

mod charts;
mod maps;
mod panels;
mod svg;
mod tables;

use super::labels;
use super::number::{count, plural};
use super::score::alignment;
use crate::eval::Surface;
use crate::eval::summary::{Evaluation, EvaluationSet};
use crate::html::escape;
use crate::raster::colour;

const STYLE: &str = include_str!("style.css");
const SCRIPT: &str = include_str!("script.js");
/// Colours of the page by light and by dark; the style sheet names them.
const LIGHT: &str = "--bg:#fff;--soft:#f5f6f8;--text:#1a1f26;--muted:#57606a;--rule:#d5dae1;\
    --accent:#0a5ea8;--s0:#0a67b0;--s1:#c2500a;--s2:#0b7d5e;--s3:#a8447f;--s4:#7a6a00;--s5:#5b4bb8;";
const DARK: &str = "--bg:#101418;--soft:#181d23;--text:#e7eaee;--muted:#a0aab5;--rule:#323a44;\
    --accent:#74b9f5;--s0:#5fb0f0;--s1:#f0924e;--s2:#4cc79f;--s3:#e58cc0;--s4:#d8c650;--s5:#a99cf5;";

/// One image of the report.
#[derive(Clone, Debug, PartialEq)]
pub struct Panel {
    /// What it stands for: `Best`, `Median`, `Worst`.
    pub caption: String,
    /// Name of the image.
    pub name: String,
    /// Predicted heights, metres.
    pub prediction: Surface,
    /// Aligned ground truth on the same pixels minus the vertical offset, metres.
    pub truth: Surface,
    /// Mean absolute error of the image, metres.
    pub mae_m: f64,
}

/// An evaluation as one self-contained HTML page.
#[must_use]
pub fn html(set: &EvaluationSet, panels: &[Panel]) -> String {
    crate::plan::runs("report");
    let labels = labels(set);
    let title = title(set);
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=en>\n<head>\n<meta charset=utf-8>\n\
         <meta http-equiv=Content-Security-Policy content=\"default-src 'none'; style-src 'unsafe-inline'; \
         script-src 'unsafe-inline'; img-src data:\">\n\
         <meta name=viewport content=\"width=device-width, initial-scale=1\">\n\
         <meta name=color-scheme content=\"light dark\">\n\
         <title>DSM evaluation: {}</title>\n<style>\n{}</style>\n</head>\n<body>\n",
        escape(&title),
        style()
    );
    header(&mut page, set, &title);
    page += "<main>\n";
    if let [e] = &set.evaluations[..] {
        section(&mut page, "scores", "Scores", &single(set, e, &labels));
        if e.images.evaluated > 0 {
            let charts = grid(&[
                charts::distribution(&set.evaluations),
                charts::cumulative(&set.evaluations),
                charts::scatter(e, 0),
            ]);
            section(&mut page, "errors", "Errors", &charts);
            section(&mut page, "places", "Where the errors are", &places(e));
        }
    } else if !set.evaluations.is_empty() {
        let mut scores = tables::comparison(set, &labels);
        scores += &tables::differences(&set.differences);
        section(&mut page, "scores", "Scores", &scores);
        let charts =
            grid(&[charts::distribution(&set.evaluations), charts::cumulative(&set.evaluations)]);
        section(&mut page, "errors", "Errors", &(charts::legend(&labels) + &charts));
    }
    section(&mut page, "images", "Single images", &panels::panels(panels));
    if let [e] = &set.evaluations[..] {
        section(&mut page, "registration", "Registration", &registration(e));
        section(&mut page, "missing", "Images without scores", &tables::missing(e));
        section(&mut page, "per-image", "All images", &tables::images(e));
    } else {
        for (i, (e, label)) in set.evaluations.iter().zip(&labels).enumerate() {
            let open = if i == 0 { " open" } else { "" };
            page += &format!(
                "<section id=e{i}><details class=evaluation{open}><summary><h2>{}</h2> {}</summary>\n",
                escape(label),
                evaluated(e)
            );
            if e.images.evaluated > 0 {
                page += &tables::tiles(e);
                page += &tables::scores(e);
                let scatter = charts::scatter(e, i.min(charts::SERIES - 1));
                page += &grid(&[scatter, maps::geographic(e)]);
                page += &grid(&[maps::by_position(&e.by_position)]);
                page += &tables::strata(&e.strata);
                page += &registration(e);
            }
            page += &tables::missing(e);
            page += &tables::images(e);
            page += "</details></section>\n";
        }
    }
    reading(&mut page, set);
    page += &format!("</main>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n");
    page
}

/// What was scored, in a line.
fn title(set: &EvaluationSet) -> String {
    if let [e] = &set.evaluations[..] {
        return format!("{}, protocol {}", e.model, e.protocol.name());
    }
    let mut models: Vec<&str> = set.evaluations.iter().map(|e| e.model.as_str()).collect();
    models.dedup();
    let several = plural(set.evaluations.len() as u64, "evaluation", "evaluations");
    if models.is_empty() || models.len() > 3 {
        several
    } else {
        format!("{}: {several}", models.join(", "))
    }
}

/// A section with a heading, unless there is nothing in it.
fn section(page: &mut String, id: &str, heading: &str, content: &str) {
    if !content.is_empty() {
        *page += &format!("<section id={id}><h2>{heading}</h2>\n{content}</section>\n");
    }
}

/// Charts beside each other where there is room.
fn grid(figures: &[String]) -> String {
    let figures = figures.concat();
    if figures.is_empty() { figures } else { format!("<div class=charts>{figures}</div>\n") }
}

fn evaluated(e: &Evaluation) -> String {
    let c = &e.images;
    let mut text =
        format!("evaluated {} of {}", count(c.evaluated), plural(c.found, "image", "images"));
    for (number, what) in
        [(c.skipped, "skipped"), (c.failed, "failed"), (c.unaligned, "left unaligned")]
    {
        if number > 0 {
            text += &format!(" \u{b7} {} {what}", count(number));
        }
    }
    text
}

fn header(page: &mut String, set: &EvaluationSet, title: &str) {
    *page += &format!(
        "<header><p class=kicker>DSM evaluation</p><h1>{}</h1>\
         <button id=theme type=button hidden>Light or dark</button>\n",
        escape(title)
    );
    if let [e] = &set.evaluations[..] {
        *page += &format!("<p class=lead>{}</p>\n", evaluated(e));
    }
    let distinct = |of: &dyn Fn(&Evaluation) -> String| {
        let mut values: Vec<String> = Vec::new();
        for e in &set.evaluations {
            let value = of(e);
            if !values.contains(&value) {
                values.push(value);
            }
        }
        escape(&values.join(" \u{b7} "))
    };
    *page += "<dl class=facts>";
    let facts: [(&str, String); 5] = [
        ("Predictions", distinct(&|e| e.model.clone())),
        ("Protocol", distinct(&|e| e.protocol.name().to_owned())),
        ("Aligned", distinct(&alignment)),
        ("Seed", distinct(&|e| e.seed.to_string())),
        ("Schema", distinct(&|e| e.schema.clone())),
    ];
    for (name, value) in facts {
        if !value.is_empty() {
            *page += &format!("<div><dt>{name}</dt><dd>{value}</dd></div>");
        }
    }
    *page += "</dl></header>\n";
}

fn single(set: &EvaluationSet, e: &Evaluation, labels: &[String]) -> String {
    if e.images.evaluated == 0 {
        return "<p class=empty>Nothing could be scored. The reasons are below.</p>\n".to_owned();
    }
    let mut out = tables::tiles(e);
    if !set.published.is_empty() {
        out += &tables::comparison(set, labels);
    }
    out + &tables::scores(e)
}

fn places(e: &Evaluation) -> String {
    grid(&[maps::geographic(e), maps::by_position(&e.by_position)]) + &tables::strata(&e.strata)
}

fn registration(e: &Evaluation) -> String {
    e.registration.as_ref().map_or_else(String::new, tables::registration)
}

/// What the numbers mean.
fn reading(page: &mut String, set: &EvaluationSet) {
    let mut list = String::new();
    let mut told: Vec<(&str, &str)> = vec![
        (
            "mean over images",
            "a score per image first, then the mean: every image counts the same. The paper averages \
             MAE and RMSE so.",
        ),
        (
            "over all pixels",
            "one score over the pixels of all images: every pixel counts the same. The paper averages \
             the shares under 2.5 m and 7.5 m so.",
        ),
        (
            "intervals",
            "95 % bootstrap intervals that draw blocks of ground, because neighbouring images show the \
             same ground and are no independent samples.",
        ),
        ("NMAD", "1.4826 times the median distance of the errors from their median."),
        ("LE68, LE90, p95", "the 68th, 90th and 95th percentile of |error|."),
        ("completeness", "share of the ground truth's pixels that have a prediction."),
    ];
    let conventions: Vec<(String, String)> = set
        .evaluations
        .first()
        .map(|e| e.conventions.iter().map(|(k, v)| (k.replace('_', " "), v.clone())).collect())
        .unwrap_or_default();
    if !conventions.iter().any(|(name, _)| name == "error") {
        told.insert(
            0,
            ("error", "prediction \u{2212} (aligned truth \u{2212} vertical offset), metres."),
        );
    }
    let conventions = conventions.iter().map(|(name, text)| (name.as_str(), text.as_str()));
    for (name, text) in conventions.chain(told) {
        list += &format!("<div><dt>{}</dt><dd>{}</dd></div>", escape(name), escape(text));
    }
    section(page, "reading", "How to read this", &format!("<dl class=reading>{list}</dl>\n"));
}

/// The style sheet with the colours of both themes.
fn style() -> String {
    let steps = |map: &[[u8; 3]], prefix: char, backwards: bool| -> String {
        let mut table = colour::table::<16>(map);
        if backwards {
            table.reverse();
        }
        let name =
            |(i, [r, g, b]): (usize, [u8; 3])| format!("--{prefix}{i}:#{r:02x}{g:02x}{b:02x};");
        table.into_iter().enumerate().map(name).collect()
    };
    let diverging = steps(&colour::DIVERGING, 'd', false);
    let light = format!("{LIGHT}{}{diverging}", steps(&colour::MAGNITUDE, 'q', false));
    let dark = format!("{DARK}{}{diverging}", steps(&colour::MAGNITUDE, 'q', true));
    let mut style = format!(
        ":root{{color-scheme:light dark;{light}}}\n\
         @media (prefers-color-scheme:dark){{:root:not([data-theme=light]){{{dark}}}}}\n\
         :root[data-theme=light]{{color-scheme:light}}\n\
         :root[data-theme=dark]{{color-scheme:dark;{dark}}}\n\
         @media print{{:root,:root[data-theme=dark],:root:not([data-theme=light]){{color-scheme:light;{light}}}}}\n"
    );
    for i in 0..16 {
        style += &format!(".q{i}{{--c:var(--q{i})}}.d{i}{{--c:var(--d{i})}}");
    }
    for i in 0..charts::SERIES {
        style += &format!(".s{i}{{--c:var(--s{i})}}");
    }
    style + "\n" + STYLE
}

#[cfg(test)]
mod tests {
    use super::super::sample;
    use super::*;
    use crate::eval::{Protocol, published};

    fn pages() -> Vec<(&'static str, String)> {
        let mut one = sample::set(&["out"], &[Protocol::Paper], 60);
        one.published = published::paper_rows();
        let two = sample::set(&["out", "<baseline>"], &[Protocol::Paper, Protocol::Plain], 60);
        let none = EvaluationSet { evaluations: vec![], differences: vec![], published: vec![] };
        vec![
            ("one", html(&one, &sample::panels())),
            ("two", html(&two, &sample::panels())),
            ("nothing", html(&sample::nothing(), &[])),
            ("none", html(&none, &[])),
        ]
    }

    #[test]
    fn every_page_is_whole_and_asks_for_nothing() {
        for (name, page) in pages() {
            // Neither the script nor the letters of base64 count.
            let page: String = page
                .replace(SCRIPT, "")
                .split("data:image/png;base64,")
                .map(|part| {
                    part.trim_start_matches(|c: char| c.is_alphanumeric() || "+/=".contains(c))
                })
                .collect();
            for word in ["NaN", "http://", "https://", "//cdn", "@import", "url(", "<link", "inf "]
            {
                assert!(!page.contains(word), "{name} holds {word}");
            }
            for tag in ["table", "section", "figure", "svg", "details", "dl", "main", "div", "tr"] {
                let open = page.matches(&format!("<{tag} ")).count()
                    + page.matches(&format!("<{tag}>")).count();
                assert_eq!(open, page.matches(&format!("</{tag}>")).count(), "{name}: {tag}");
            }
            assert!(!page.contains("<baseline>"), "{name}");
            assert!(page.contains("How to read this"), "{name}");
        }
    }

    #[test]
    fn text_and_lines_stand_out_from_the_ground() {
        // Contrast of WCAG 2: 4.5 for text, 3 for what is drawn.
        let luminance = |colour: &str| {
            let full = match colour.len() {
                3 => colour.chars().flat_map(|c| [c, c]).collect(),
                _ => colour.to_owned(),
            };
            let channel = |i: usize| {
                let value = u8::from_str_radix(&full[2 * i..2 * i + 2], 16).expect("a colour");
                let value = f64::from(value) / 255.0;
                if value <= 0.04045 {
                    value / 12.92
                } else {
                    libm::pow((value + 0.055) / 1.055, 2.4)
                }
            };
            0.2126 * channel(0) + 0.7152 * channel(1) + 0.0722 * channel(2)
        };
        for theme in [LIGHT, DARK] {
            let colour = |name: &str| {
                let rest = theme.split_once(&format!("--{name}:#")).expect("named").1;
                luminance(rest.split_once(';').expect("ended").0)
            };
            for (name, least) in [("text", 7.0), ("muted", 4.5), ("accent", 4.5)]
                .into_iter()
                .chain(["s0", "s1", "s2", "s3", "s4", "s5"].map(|name| (name, 3.0)))
            {
                for ground in ["bg", "soft"] {
                    let [a, b] = [colour(name), colour(ground)].map(|l| l + 0.05);
                    assert!(
                        a.max(b) / a.min(b) >= least,
                        "{name} on {ground}: {}",
                        a.max(b) / a.min(b)
                    );
                }
            }
        }
    }

    #[test]
    fn wild_numbers_are_drawn_or_left_out() {
        let wild = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e308, 1e-310, -1e30, 0.0];
        for (i, value) in wild.into_iter().enumerate() {
            let mut set = sample::set(&["a", "b"], &[Protocol::Paper], 40);
            let e = &mut set.evaluations[0];
            let other = wild[(i + 1) % wild.len()];
            for (k, image) in e.per_image.iter_mut().enumerate() {
                let Some(scores) = &mut image.scores else { continue };
                if k % 3 > 0 {
                    (scores.mae_m, scores.rmse_m) = (value, other);
                }
                (scores.bias_m, scores.vertical_offset_m, scores.shift_px.x) =
                    (value, other, value);
                (image.lat_deg, image.lon_deg) = (Some(47.0 + k as f64), Some(value));
            }
            e.per_image_mean.mae_m = value;
            (e.pooled.le90_m, e.pooled.lt_2_5_m_pct, e.pooled.max_m) = (value, value, value);
            e.by_position.mae_m[3] = value;
            e.by_position.bias_m[4] = other;
            (e.strata[0].rows[0].mae_m, e.strata[0].rows[1].rmse_m) = (value, other);
            for interval in &mut e.intervals.scores {
                (interval.low, interval.high) = (value, other);
            }
            for score in &mut set.differences[0].scores {
                (score.difference, score.low, score.p_value) = (value, other, value);
            }
            set.evaluations[1].histogram.counts.clear();
            let panel = |of: f32| Panel {
                caption: "x".to_owned(),
                name: "y".to_owned(),
                prediction: Surface::new(2, 1, vec![of, 1.0]),
                truth: Surface::new(2, 1, vec![1.0, -of]),
                mae_m: value,
            };
            let two = html(&set, &[panel(value as f32)]);
            set.evaluations.truncate(1);
            for page in [two, html(&set, &[])] {
                let page = page.replace(SCRIPT, "");
                // A dash or an infinity is for people, not for a place in a drawing.
                for attribute in page.split('<').filter(|tag| tag.contains("=")) {
                    let tag = attribute.split_once('>').map_or("", |(tag, _)| tag);
                    let drawn = ["circle ", "path ", "rect ", "svg ", "text "];
                    if drawn.iter().any(|name| tag.starts_with(name)) {
                        for bad in ["NaN", "inf", "\u{2013}", "\u{221e}"] {
                            assert!(!tag.contains(bad), "{value}: {tag}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_same_set_gives_the_same_bytes() {
        assert_eq!(pages(), pages());
    }

    #[test]
    fn averages_are_named_beside_every_published_number() {
        let pages = pages();
        let page = &pages[0].1;
        let tiles = page.split_once("<dl class=tiles>").expect("tiles").1;
        let tiles = tiles.split_once("</dl>").expect("an end").0;
        assert_eq!(tiles.matches("mean over images").count(), 2);
        assert_eq!(tiles.matches("over all pixels").count(), 2);
        assert_eq!(page.matches("as published</span>").count(), 4);
        // Seven rows and the note under them.
        assert_eq!(page.matches("<span class=badge>published</span>").count(), 8);
    }

    #[test]
    fn nothing_scored_lists_the_reasons() {
        let page = &pages()[2].1;
        assert!(page.contains("evaluated 0 of 9 images"));
        assert!(page.contains("Nothing could be scored"));
        assert!(page.contains("no pixel has a height in both"));
    }
}
