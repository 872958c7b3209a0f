//! A report for people.

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
