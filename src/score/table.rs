//! A report for people.

use super::compare::{Comparison, Order};
use super::measures::Measure as M;
use super::{Gate, Report};
use std::fmt::Write as _;

/// A score: which, its name for people, digits after the point.
type Row = (M, &'static str, usize);

/// Rows in groups: what it is, and decimals.
const GROUPS: [(&str, &[Row]); 5] = [
    (
        "DSM, all pixels",
        &[
            (M::DsmMaeM, "mean absolute error, m", 3),
            (M::DsmRmseM, "RMSE, m", 3),
            (M::DsmWithinPct, "off by less than 2.5 m, %", 2),
            (M::DsmOfFlat, "RMSE / flat ground", 3),
        ],
    ),
    (
        "DSM, mean of the images",
        &[(M::DsmImageMaeM, "mean absolute error, m", 3), (M::DsmImageRmseM, "RMSE, m", 3)],
    ),
    (
        "flat ground",
        &[
            (M::FlatMaeM, "mean absolute error, m", 3),
            (M::FlatRmseM, "RMSE, m", 3),
            (M::FlatWithinPct, "off by less than 2.5 m, %", 2),
            (M::FlatImageMaeM, "mean absolute error, images, m", 3),
            (M::FlatImageRmseM, "RMSE, images, m", 3),
        ],
    ),
    (
        "heights of buildings",
        &[
            (M::BuildingErrorM, "mean absolute error, m", 3),
            (M::BuildingConstantErrorM, "best constant, m", 3),
            (M::BuildingOfConstant, "error / best constant", 3),
            (M::BuildingCorrelation, "correlation", 3),
        ],
    ),
    (
        "mesh",
        &[
            (M::MeshRmseM, "RMSE of its top, m", 3),
            (M::MeshOfDsm, "RMSE / DSM", 3),
            (M::HolesPct, "columns with a hole, %", 3),
            (M::FloatersPct, "columns with a floater, %", 3),
        ],
    ),
];

/// Characters of the first column.
const LABEL: usize = 34;

/// The report with its gates as text, at most 34 + 29 + 10 characters a seed wide.
#[must_use]
pub fn table(report: &Report, gates: &[Gate]) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = write(&mut out, report, gates);
    out
}

fn write(out: &mut String, report: &Report, gates: &[Gate]) -> std::fmt::Result {
    let options = &report.options;
    let metres = options.side as f64 * options.pixel_m;
    writeln!(
        out,
        "{} simulated scenes of {} px ({metres:.1} m), {} buildings ({} more without ground around them)\n",
        report.all.images, options.side, report.all.buildings, report.all.buildings_without_ground
    )?;
    let level = format!("{} % interval", options.level_pct);
    write!(out, "{:<LABEL$}{:>9}{level:>20}", "", "all")?;
    for set in &report.seeds {
        let name = set.seed.map_or_else(String::new, |seed| format!("seed {seed}"));
        write!(out, "{name:>10}")?;
    }
    writeln!(out)?;
    for (group, rows) in GROUPS {
        writeln!(out, "{group}")?;
        for (measure, label, decimals) in rows {
            let score = report.all.score(*measure);
            let number = |value: f64| {
                if value.is_finite() { format!("{value:.decimals$}") } else { "-".into() }
            };
            let interval = format!("{} to {}", number(score.low), number(score.high));
            write!(
                out,
                "  {label:<width$}{:>9}{interval:>20}",
                number(score.value),
                width = LABEL - 2
            )?;
            for set in &report.seeds {
                write!(out, "{:>10}", number(set.score(*measure).value))?;
            }
            writeln!(out)?;
        }
    }
    let seconds = report.seconds;
    writeln!(
        out,
        "\nper image: network {:.3} s, DSM {:.3} s (medians)\n",
        seconds.network, seconds.dsm
    )?;
    for Gate { name, value, limit, passed } in gates {
        let word = if *passed { "pass" } else { "FAIL" };
        writeln!(out, "{word}  {name}: {value:.3}, to be under {limit}")?;
    }
    Ok(())
}

/// Variants as a table in Markdown, with the paper's numbers beside those whose names it has.
#[must_use]
pub fn markdown(found: &Comparison) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = write_markdown(&mut out, found);
    out
}

fn write_markdown(out: &mut String, found: &Comparison) -> std::fmt::Result {
    let Comparison { scenes, against, replicates, level_pct, variants } = found;
    let paper = variants.iter().any(|row| row.paper_rmse_m.is_some());
    let mut heads = vec![
        "variant".to_owned(),
        "RMSE, m".into(),
        "each training".into(),
        "MAE, m".into(),
        "buildings, m".into(),
        "floaters, %".into(),
        format!("RMSE less `{against}`'s, m"),
        "place".into(),
    ];
    if paper {
        heads.extend(["paper: RMSE, m".into(), "place".into(), "order".into()]);
    }
    writeln!(out, "| {} |", heads.join(" | "))?;
    writeln!(out, "|---|{}", "--:|".repeat(heads.len() - 1))?;
    let here: Vec<Option<f64>> =
        variants.iter().map(|row| Some(row.score(M::DsmRmseM).value)).collect();
    let there: Vec<Option<f64>> = variants.iter().map(|row| row.paper_rmse_m).collect();
    for (at, row) in variants.iter().enumerate() {
        let with_interval = |measure| {
            let score = row.score(measure);
            format!("{} ({} to {})", two(score.value), two(score.low), two(score.high))
        };
        let rmse = row.score(M::DsmRmseM);
        let each: Vec<String> = rmse.trainings.iter().map(|value| two(*value)).collect();
        let difference = if row.name == *against {
            "-".to_owned()
        } else {
            let [value, low, high] =
                [rmse.difference, rmse.difference_low, rmse.difference_high].map(signed);
            format!("{value} ({low} to {high})")
        };
        let mut cells = vec![
            row.name.clone(),
            with_interval(M::DsmRmseM),
            each.join(" "),
            with_interval(M::DsmMaeM),
            with_interval(M::BuildingErrorM),
            with_interval(M::FloatersPct),
            difference,
            place(&here, at),
        ];
        if paper {
            let order = row.order.map_or("-", |order| match order {
                Order::AsInThePaper => "as in the paper",
                Order::TheOtherWay => "the other way",
                Order::Undecided => "undecided",
            });
            let rmse = row.paper_rmse_m.map_or_else(|| "-".into(), two);
            cells.extend([rmse, place(&there, at), order.into()]);
        }
        writeln!(out, "| {} |", cells.join(" | "))?;
    }
    let words = "Means over the trainings of a variant";
    writeln!(
        out,
        "\n{words}, on {scenes} scenes; {level_pct} % intervals of {replicates} draws of scenes (the same for \
         all) and of trainings."
    )
}

fn two(value: f64) -> String {
    if value.is_finite() { format!("{value:.2}") } else { "-".into() }
}

fn signed(value: f64) -> String {
    if value.is_finite() { format!("{value:+.2}") } else { "-".into() }
}

/// Place of one among values, from the least, which is 1; equals share a place.
fn place(values: &[Option<f64>], at: usize) -> String {
    let Some(own) = values[at].filter(|value| value.is_finite()) else { return "-".into() };
    (1 + values.iter().flatten().filter(|value| **value < own).count()).to_string()
}
