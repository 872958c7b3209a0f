//! What was found, as text: for people, and as CSV.

use super::{Quantity, Report, Switch};
use std::fmt::Write as _;

/// A number with three digits, short.
pub(super) fn short(value: f64) -> String {
    match value {
        0.0 => "0".into(),
        v if v.is_nan() => "-".into(),
        v if (1e-2..1e5).contains(&v.abs()) => {
            let digits = 2 - libm::floor(libm::log10(v.abs())) as i32;
            format!("{v:.*}", digits.clamp(0, 4) as usize)
        }
        v => format!("{v:.1e}"),
    }
}

/// Seconds in the unit in which they are easily read.
pub(super) fn time(seconds: f64) -> String {
    let (value, unit) = match seconds {
        s if s >= 120.0 => (s / 60.0, "min"),
        s if s >= 1.0 => (s, "s"),
        s if s >= 1e-3 => (s * 1e3, "ms"),
        s => (s * 1e6, "us"),
    };
    format!("{} {unit}", short(value))
}

/// A quantity with its unit, as an axis or a column is headed.
pub(super) fn headed(quantity: &Quantity) -> String {
    if quantity.unit.is_empty() {
        quantity.name.clone()
    } else {
        format!("{}, {}", quantity.name, quantity.unit)
    }
}

/// What a switch's table says of its default: whether it is on the front, and what beats it.
fn verdict(switch: &Switch) -> String {
    match (switch.default_setting(), switch.beats_default()) {
        (None, _) => "the default is none of these".into(),
        (Some(default), Some(better)) => format!(
            "{} is as exact as the default, {}, and takes {} of its time",
            better.name,
            default.name,
            short(better.seconds.median / default.seconds.median)
        ),
        (Some(default), None) if default.pareto => {
            format!("the default, {}, is on the front", default.name)
        }
        (Some(default), None) => {
            format!(
                "nothing as exact as the default, {}, is faster beyond the spread",
                default.name
            )
        }
    }
}

fn rows(switch: &Switch) -> Vec<Vec<String>> {
    let mut head = vec!["".into(), "setting".into(), headed(&switch.error)];
    let bounds = switch.settings.iter().any(|s| s.bound.is_some());
    if bounds {
        head.push("bound".into());
    }
    head.extend(["time".into(), "spread".into()]);
    let further = switch.settings.first().map_or(&[][..], |s| &s.also);
    head.extend(further.iter().map(|also| headed(&also.quantity)));
    let mut rows = vec![head];
    for setting in &switch.settings {
        let mark = match (setting.default, setting.pareto) {
            (true, true) => "*d",
            (true, false) => " d",
            (false, true) => "* ",
            (false, false) => "  ",
        };
        let mut row = vec![mark.into(), setting.name.clone(), short(setting.error)];
        if bounds {
            row.push(setting.bound.map_or_else(String::new, short));
        }
        let seconds = &setting.seconds;
        row.push(time(seconds.median));
        row.push(format!("{}..{}", time(seconds.lower_quartile), time(seconds.upper_quartile)));
        row.extend(setting.also.iter().map(|also| short(also.value)));
        rows.push(row);
    }
    rows
}

/// The tables that are printed.
#[must_use]
pub fn table(report: &Report) -> String {
    let machine = &report.machine;
    let mut text = format!(
        "{}: {} switches in {:.0} s on {} ({} threads of {}, vectors {})\n\
         * = on the Pareto front, d = the default; times are medians, spreads quartiles\n",
        report.software,
        report.switches.len(),
        report.seconds,
        if machine.processor.is_empty() { &machine.system } else { &machine.processor },
        machine.threads,
        machine.processors,
        machine.vectors,
    );
    for failed in &report.failed {
        let _ = writeln!(text, "could not be measured: {}: {}", failed.name, failed.reason);
    }
    if report.interrupted {
        text += "interrupted: the other switches of the plan were not measured\n";
    }
    if machine.debug {
        text += "this program was built without optimisation: its times are no guide\n";
    }
    for switch in &report.switches {
        let _ = writeln!(
            text,
            "\n{}/{}: {}\n  truth: {}\n  time of: {}",
            switch.stage.name(),
            switch.switch,
            switch.cause,
            switch.truth,
            switch.work
        );
        let rows = rows(switch);
        let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            let cells = rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..columns).map(width).collect();
        for row in &rows {
            let cells = row.iter().zip(&widths).enumerate().map(|(k, (cell, &width))| {
                if k < 2 { format!("{cell:<width$}") } else { format!("{cell:>width$}") }
            });
            let _ = writeln!(text, "  {}", cells.collect::<Vec<_>>().join("  ").trim_end());
        }
        for skipped in &switch.skipped {
            let _ = writeln!(text, "  not measured: {}: {}", skipped.name, skipped.reason);
        }
        let _ = writeln!(text, "  {}", verdict(switch));
    }
    text
}

/// All settings, a line each; the further numbers are in the JSON.
///
/// # Errors
/// None in practice: the writer is memory.
pub fn csv(report: &Report) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record([
        "stage",
        "switch",
        "setting",
        "default",
        "pareto",
        "error",
        "error_name",
        "error_unit",
        "bound",
        "seconds_median",
        "seconds_lower_quartile",
        "seconds_upper_quartile",
        "rounds",
        "work",
        "truth",
    ])?;
    for switch in &report.switches {
        for setting in &switch.settings {
            let seconds = &setting.seconds;
            writer.write_record([
                switch.stage.name(),
                &switch.switch,
                &setting.name,
                &setting.default.to_string(),
                &setting.pareto.to_string(),
                &setting.error.to_string(),
                &switch.error.name,
                &switch.error.unit,
                &setting.bound.map_or_else(String::new, |bound| bound.to_string()),
                &seconds.median.to_string(),
                &seconds.lower_quartile.to_string(),
                &seconds.upper_quartile.to_string(),
                &seconds.rounds.to_string(),
                &switch.work,
                &switch.truth,
            ])?;
        }
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}
