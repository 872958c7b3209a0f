//! `log.html`: curves and sample pictures of a training, in one file that opens from disk without a network.
//!
//! It is made of what lies in the output folder, the log and the pictures, and holds no times: a training that was
//! interrupted ends with the same page.

pub mod chart;
pub mod picture;

use super::checkpoint::Description;
use super::held_out::{PICTURES, picture_name, steps};
use super::journal::{self, Line};
use crate::html::escape;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use chart::{Curve, chart, short};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;

/// Name of the page in the output folder.
pub const PAGE: &str = "log.html";
/// Examples that the page shows.
const SHOWN: usize = 6;
/// Steps that the first example is shown at.
const STEPS: usize = 8;

const STYLE: &str = include_str!("style.css");
/// Colours of the page by light and by dark; the style sheet names them.
const LIGHT: &str = "--bg:#fff;--soft:#f5f6f8;--text:#1a1f26;--muted:#57606a;--rule:#d5dae1;\
    --s0:#0a67b0;--s1:#c2500a;--s2:#0b7d5e;--s3:#a8447f;";
const DARK: &str = "--bg:#101418;--soft:#181d23;--text:#e7eaee;--muted:#a0aab5;--rule:#323a44;\
    --s0:#5fb0f0;--s1:#f0924e;--s2:#4cc79f;--s3:#e58cc0;";

/// The page of the training in a folder, as `description` says how far it is.
#[must_use]
pub fn page(out: &Path, description: &Description) -> String {
    let mut lines = journal::read(out);
    lines.retain(|line| line.step <= description.step);
    let total = description.settings.pointer("/run/steps").and_then(Value::as_u64).unwrap_or(1);
    let title = title(&description.settings);
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=en>\n<head>\n<meta charset=utf-8>\n\
         <meta http-equiv=Content-Security-Policy content=\"default-src 'none'; style-src 'unsafe-inline'; \
         img-src data:\">\n\
         <meta name=viewport content=\"width=device-width, initial-scale=1\">\n\
         <meta name=color-scheme content=\"light dark\">\n\
         <title>Training: {0}</title>\n<style>\n:root{{{LIGHT}}}\n\
         @media (prefers-color-scheme:dark){{:root{{{DARK}}}}}\n{STYLE}</style>\n</head>\n<body>\n\
         <header><p class=kicker>sat3d training</p><h1>{0}</h1>",
        escape(&title)
    );
    header(&mut page, description, &lines, total);
    page += "</header>\n<main>\n";
    let curves = curves(&lines, total);
    section(&mut page, "Losses", &curves);
    section(&mut page, "Held-out examples", &pictures(out, description.step));
    section(&mut page, "Skipped", &skipped(description, &lines));
    let settings = serde_json::to_string_pretty(&description.settings).unwrap_or_default();
    let settings = format!(
        "<details><summary>Everything that the weights depend on</summary><pre>{}</pre></details>",
        escape(&settings)
    );
    section(&mut page, "Settings", &settings);
    page += "</main>\n</body>\n</html>\n";
    page
}

fn section(page: &mut String, title: &str, content: &str) {
    if !content.is_empty() {
        let _ = writeln!(page, "<section><h2>{title}</h2>\n{content}</section>");
    }
}

/// A setting as text, `-` where there is none.
fn text(settings: &Value, pointer: &str) -> String {
    match settings.pointer(pointer) {
        None | Some(Value::Null) => "-".to_owned(),
        Some(Value::String(text)) => text.clone(),
        Some(other) => other.to_string(),
    }
}

fn title(settings: &Value) -> String {
    format!(
        "{} by {} on {} data",
        text(settings, "/model/kind"),
        text(settings, "/objective/kind"),
        text(settings, "/data/source")
    )
}

fn header(page: &mut String, description: &Description, lines: &[Line], total: u64) {
    let settings = &description.settings;
    let progress = &description.progress;
    *page += "<dl class=facts>";
    for (name, value) in [
        ("batch", text(settings, "/run/batch")),
        ("seed", text(settings, "/run/seed")),
        ("device", text(settings, "/run/device")),
        ("program", description.software.clone()),
        ("settings", description.settings_hash.chars().take(12).collect()),
    ] {
        let _ = write!(page, "<div><dt>{name}</dt><dd>{}</dd></div>", escape(&value));
    }
    *page += "</dl>";
    let share = 100.0 * description.step as f64 / total.max(1) as f64;
    let _ =
        write!(page, "<div class=bar><i style=\"width:{share:.2}%\"></i></div><dl class=tiles>");
    let mut tile = |name: &str, value: &str, below: &str| {
        let (value, below) = (escape(value), escape(below));
        let _ = write!(page, "<div><dt>{name}</dt><dd><b>{value}</b>{below}</dd></div>");
    };
    tile("Steps", &description.step.to_string(), &format!("of {total}"));
    tile("Examples", &progress.images.to_string(), "learnt from");
    if let Some((name, value)) = lines.iter().rev().find_map(|line| line.terms.iter().next()) {
        tile("Loss", &short(value.as_f64().unwrap_or(f64::NAN)), &format!("{name}, last mean"));
    }
    if let Some(scores) = lines.iter().rev().find_map(|line| line.held_out) {
        let flat = |value: f64| format!("flat ground {} m", short(value));
        tile("Held-out RMSE", &format!("{} m", short(scores.rmse_m)), &flat(scores.flat_rmse_m));
        tile("Held-out MAE", &format!("{} m", short(scores.mae_m)), &flat(scores.flat_mae_m));
    }
    let skipped = format!("and {} draws", progress.skipped_draws());
    tile("Skipped batches", &progress.skipped_batches.to_string(), &skipped);
    *page += "</dl>";
}

fn curves(lines: &[Line], total: u64) -> String {
    let mut names: Vec<&String> = Vec::new();
    for name in lines.iter().flat_map(|line| line.terms.keys()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let curve = |name: &str| Curve {
        name: name.to_owned(),
        points: lines
            .iter()
            .filter_map(|line| Some((line.step as f64, line.terms.get(name)?.as_f64()?)))
            .collect(),
    };
    let score = |name: &str, of: fn(&journal::Scores) -> f64| Curve {
        name: name.to_owned(),
        points: lines
            .iter()
            .filter_map(|line| Some((line.step as f64, of(line.held_out.as_ref()?))))
            .collect(),
    };
    let mut wide = String::new();
    let mut small = String::new();
    for (i, name) in names.into_iter().enumerate() {
        let into = if i == 0 { &mut wide } else { &mut small };
        *into += &chart(name, &[curve(name)], total);
    }
    wide += &chart(
        "held-out error, m",
        &[
            score("RMSE", |scores| scores.rmse_m),
            score("flat ground", |scores| scores.flat_rmse_m),
            score("MAE", |scores| scores.mae_m),
        ],
        total,
    );
    let grid = |class: &str, content: String| match content.is_empty() {
        true => String::new(),
        false => format!("<div class=\"{class}\">\n{content}</div>\n"),
    };
    grid("charts wide", wide) + &grid("charts", small)
}

/// A picture of the folder as an image of the page.
fn image(folder: &Path, index: usize, kind: &str, caption: &str) -> String {
    let Ok(bytes) = std::fs::read(folder.join(picture_name(index, kind))) else {
        return String::new();
    };
    format!(
        "<figure><img alt=\"{0}\" src=\"data:image/png;base64,{1}\"><figcaption>{0}</figcaption></figure>",
        escape(caption),
        STANDARD.encode(bytes)
    )
}

fn pictures(out: &Path, until: u64) -> String {
    let folder = out.join(PICTURES);
    let mut known: Vec<u64> = steps(&folder).into_iter().map(|(step, _)| step).collect();
    known.retain(|step| *step <= until);
    known.dedup();
    let Some(last) = known.last() else { return String::new() };
    let mut html = String::from(
        "<p class=note>Predicted by the averaged weights, whose vertical offset is taken out where the truth is known. \
         Colours are the same in prediction and truth of one example, from the 2nd to the 98th percentile of the \
         truth.</p>\n<div class=examples>\n",
    );
    for index in 0..SHOWN {
        let row = image(&folder, index, "satellite", "satellite")
            + &image(&folder, index, &format!("dsm-{last}"), &format!("predicted, step {last}"))
            + &image(&folder, index, "truth", "truth");
        if !row.is_empty() {
            let _ = writeln!(html, "<div class=trio>{row}</div>");
        }
    }
    html += "</div>\n";
    if known.len() > 1 {
        let picked = (0..STEPS.min(known.len()))
            .map(|i| known[i * (known.len() - 1) / (STEPS.min(known.len()) - 1)]);
        let row: String = picked
            .map(|step| image(&folder, 0, &format!("dsm-{step}"), &format!("step {step}")))
            .collect();
        let _ =
            writeln!(html, "<p class=note>The first example in the course of the training.</p>");
        let _ = writeln!(html, "<div class=row>{row}</div>");
    }
    html
}

fn skipped(description: &Description, lines: &[Line]) -> String {
    let mut rows = String::new();
    let mut row = |count: u64, what: &str, example: &str| {
        let (what, example) = (escape(what), escape(example));
        let _ =
            writeln!(rows, "<tr><td>{count}</td><td>{what}</td><td class=name>{example}</td></tr>");
    };
    if description.progress.skipped_batches > 0 {
        let last = lines.iter().rev().find_map(|line| Some((line.step, line.skipped.as_ref()?)));
        let example = last.map_or_else(String::new, |(step, why)| format!("step {step}: {why}"));
        row(description.progress.skipped_batches, "batches that were not finite", &example);
    }
    for (kind, skipped) in &description.progress.skipped_items {
        let first = skipped.items.first().map_or("", String::as_str);
        row(skipped.draws, &format!("draws: {kind}"), first);
    }
    if rows.is_empty() {
        return String::new();
    }
    format!(
        "<div class=scroll><table><thead><tr><th>times</th><th>what</th><th>for example</th></tr></thead>\
         <tbody>\n{rows}</tbody></table></div>\n"
    )
}
