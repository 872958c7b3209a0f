//! The report as one HTML file that opens from disk without a network.

use super::chart::chart;
use super::table::{headed, short, time};
use super::{Report, Setting, Stage, Switch};
use crate::html::escape;
use std::fmt::Write as _;

const STYLE: &str = "\
:root{color-scheme:light dark;--bg:#fff;--text:#1a1f26;--muted:#57606a;--rule:#d5dae1;--front:#0a5ea8;--soft:#f5f6f8;\
--chosen:#c2500a}
@media(prefers-color-scheme:dark){:root{--bg:#101418;--text:#e7eaee;--muted:#a0aab5;--rule:#323a44;--front:#74b9f5;\
--soft:#181d23;--chosen:#f0924e}}
body{margin:0 auto;padding:1.5rem clamp(1rem,3vw,2.5rem) 4rem;max-width:88rem;background:var(--bg);color:var(--text);\
font:15px/1.5 system-ui,sans-serif;font-variant-numeric:tabular-nums}
h1{margin:0;font-size:1.6rem}h2{margin:2.4rem 0 .4rem;border-top:1px solid var(--rule);padding-top:1.2rem}
h3{margin:1.6rem 0 .1rem}p{margin:.15rem 0;max-width:80ch}.muted{color:var(--muted);font-size:.88rem}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,30rem),1fr));gap:.6rem 1.4rem;align-items:start}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.86rem}
th,td{padding:.22rem .5rem;text-align:right;white-space:nowrap;border-bottom:1px solid var(--rule)}
th:first-child,td:first-child{text-align:left}thead th{color:var(--muted);font-weight:600;vertical-align:bottom}
tr.pareto td:first-child{color:var(--front);font-weight:600}tr.default{background:var(--soft)}
tr.default td:first-child::after{content:\" (default)\";color:var(--chosen);font-weight:400}
svg{width:100%;height:auto;display:block}svg text{font:12px system-ui,sans-serif;fill:var(--muted)}
svg .label{fill:var(--text)}svg .chosen{fill:var(--chosen);font-weight:600}
.grid{stroke:var(--rule);stroke-width:.7;fill:none}.axis{stroke:var(--muted);fill:none}
.cut{stroke:var(--muted);stroke-dasharray:3 3;fill:none}.front{stroke:var(--front);stroke-width:1.6;fill:none;opacity:.7}
.spread{stroke:var(--muted);stroke-width:1.4}.on{fill:var(--front)}.off{fill:var(--muted);opacity:.75}
.default{fill:none;stroke:var(--chosen);stroke-width:2}
";

/// The page.
#[must_use]
pub fn html(report: &Report) -> String {
    let machine = &report.machine;
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=en>\n<head>\n<meta charset=utf-8>\n\
         <meta http-equiv=Content-Security-Policy content=\"default-src 'none'; style-src 'unsafe-inline'\">\n\
         <meta name=viewport content=\"width=device-width, initial-scale=1\">\n\
         <title>sat3d: what accuracy costs in time</title>\n<style>{STYLE}</style>\n</head>\n<body>\n\
         <h1>What accuracy costs in time</h1>\n<p class=muted>{}; {}, {} of {} processors, {}; vectors {}; \
         features {}; {:.0} s; plan {}</p>\n",
        escape(&report.software),
        escape(if machine.processor.is_empty() { "unknown processor" } else { &machine.processor }),
        machine.threads,
        machine.processors,
        escape(&machine.system),
        escape(&machine.vectors),
        escape(&machine.features.join(", ")),
        report.seconds,
        &report.plan_sha256[..12],
    );
    if machine.debug {
        page += "<p><b>Built without optimisation: these times are no guide.</b></p>\n";
    }
    page += "<p>Each point is a setting: left is faster, low is more exact. The line is the Pareto front: no setting \
             lies to the left of it and below it. The ring is what the program does unless told otherwise. Bars are \
             the quartiles of the time.</p>\n";
    for stage in Stage::ALL {
        let switches: Vec<&Switch> =
            report.switches.iter().filter(|switch| switch.stage == stage).collect();
        if !switches.is_empty() {
            let _ = writeln!(page, "<h2>{}</h2>", title(stage));
        }
        for switch in switches {
            section(&mut page, switch);
        }
    }
    for failed in &report.failed {
        let (name, reason) = (escape(&failed.name), escape(&failed.reason));
        let _ = writeln!(page, "<p>Could not be measured: {name}: {reason}</p>");
    }
    page += "</body>\n</html>\n";
    page
}

const fn title(stage: Stage) -> &'static str {
    match stage {
        Stage::Build => "sat3d dsm-bench build",
        Stage::Eval => "sat3d eval",
        Stage::Infer => "sat3d infer",
        Stage::Tile => "sat3d tile",
    }
}

fn section(page: &mut String, switch: &Switch) {
    let _ = write!(
        page,
        "<h3>{}</h3>\n<p>Why it matters: {}.</p>\n<p class=muted>Truth: {}. Time of: {}.</p>\n<div class=pair>{}\
         <div class=scroll><table><thead><tr><th>setting<th>{}",
        escape(&switch.switch),
        escape(&switch.cause),
        escape(&switch.truth),
        escape(&switch.work),
        chart(switch),
        escape(&headed(&switch.error)),
    );
    let bounds = switch.settings.iter().any(|s| s.bound.is_some());
    if bounds {
        *page += "<th>bound";
    }
    *page += "<th>time<th>quartiles";
    for also in switch.settings.first().map_or(&[][..], |s| &s.also) {
        let _ = write!(page, "<th>{}", escape(&headed(&also.quantity)));
    }
    *page += "</tr></thead><tbody>";
    for setting in &switch.settings {
        row(page, setting, bounds);
    }
    *page += "</tbody></table></div></div>\n";
    for skipped in &switch.skipped {
        let _ = writeln!(
            page,
            "<p class=muted>Not measured: {}: {}</p>",
            escape(&skipped.name),
            escape(&skipped.reason)
        );
    }
}

fn row(page: &mut String, setting: &Setting, bounds: bool) {
    let mut classes = Vec::new();
    if setting.pareto {
        classes.push("pareto");
    }
    if setting.default {
        classes.push("default");
    }
    let seconds = &setting.seconds;
    let _ = write!(
        page,
        "<tr class=\"{}\"><td>{}<td>{}",
        classes.join(" "),
        escape(&setting.name),
        short(setting.error)
    );
    if bounds {
        let _ = write!(page, "<td>{}", setting.bound.map_or_else(String::new, short));
    }
    let _ = write!(
        page,
        "<td>{}<td>{} to {}",
        time(seconds.median),
        time(seconds.lower_quartile),
        time(seconds.upper_quartile)
    );
    for also in &setting.also {
        let _ = write!(page, "<td>{}", short(also.value));
    }
    *page += "</tr>";
}
