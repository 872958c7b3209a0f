//! The table on a terminal: plain text, aligned, no colour codes.

use super::labels;
use super::number::{count, fixed, p_value, plural, range, signed};
use super::score::{alignment, both_ways, interval, published, robust, score};
use crate::eval::summary::{Estimate, Evaluation, EvaluationSet, StratumGroup};

/// Scores of the paper's table, by their paths.
const PUBLISHED: [&str; 4] =
    ["per_image_mean.mae_m", "per_image_mean.rmse_m", "pooled.lt_2_5_m_pct", "pooled.lt_7_5_m_pct"];

/// Narrowest table, characters.
const NARROWEST: usize = 60;
/// Most evaluations whose strata stand side by side.
const SIDE_BY_SIDE: usize = 5;

/// An evaluation as text for a terminal of `width` characters (at least 60 are used).
///
/// One evaluation is told in full; several are compared, one row each. Names are shortened to fit,
/// and control characters in them are shown as `?`, so that no file name can steer the terminal.
#[must_use]
pub fn terminal(set: &EvaluationSet, width: usize) -> String {
    let mut page = Page { text: String::new(), width: width.max(NARROWEST) };
    let labels: Vec<String> = labels(set).iter().map(|label| clean(label)).collect();
    if let [evaluation] = &set.evaluations[..] {
        page.counts(evaluation, None);
        if evaluation.images.evaluated == 0 {
            page.line("nothing could be scored");
            return page.text;
        }
        page.published_scores(evaluation);
        page.averages(evaluation);
        page.intervals_note(evaluation, true);
        page.robust(set, &["all pixels".to_owned()]);
        if !set.published.is_empty() {
            page.comparison(set, &labels);
        }
        for group in &evaluation.strata {
            page.stratum(group);
        }
        page.registration(evaluation, None);
    } else {
        let told = |e: &Evaluation| (e.images, e.reasons.clone());
        match set.evaluations.first() {
            Some(first) if set.evaluations.iter().all(|e| told(e) == told(first)) => {
                page.counts(first, Some(""));
            }
            _ => {
                for (evaluation, label) in set.evaluations.iter().zip(&labels) {
                    page.counts(evaluation, Some(label));
                }
            }
        }
        page.comparison(set, &labels);
        if let Some(evaluation) = set.evaluations.first() {
            page.intervals_note(evaluation, false);
        }
        page.robust(set, &labels);
        page.differences(set);
        page.strata_side_by_side(set, &labels);
        let mut before = None;
        for (evaluation, label) in set.evaluations.iter().zip(&labels) {
            // It does not depend on the protocol, so it is told once for several.
            if before != Some(&evaluation.registration) {
                page.registration(evaluation, Some(label));
            }
            before = Some(&evaluation.registration);
        }
    }
    page.text
}

struct Page {
    text: String,
    width: usize,
}

impl Page {
    fn line(&mut self, line: &str) {
        self.text.push_str(shorten(line, self.width).trim_end());
        self.text.push('\n');
    }

    /// A sentence, broken between words.
    fn sentence(&mut self, text: &str) {
        let mut line = String::from(" ");
        for word in text.split(' ') {
            if line.chars().count() + 1 + word.chars().count() > self.width {
                self.line(&line);
                line = String::from(" ");
            }
            line.push(' ');
            line.push_str(word);
        }
        self.line(&line);
    }

    fn table(&mut self, rows: &[Vec<String>], left: usize) {
        self.text.push('\n');
        for line in align(rows, left, self.width) {
            self.line(&line);
        }
    }

    /// How many images were scored, and why the others were not. The label is empty where this is
    /// the same for every evaluation, and absent where there is only one.
    fn counts(&mut self, e: &Evaluation, label: Option<&str>) {
        let c = &e.images;
        let why: Vec<String> =
            [(c.skipped, "skipped"), (c.failed, "failed"), (c.unaligned, "unaligned")]
                .iter()
                .filter(|(number, _)| *number > 0)
                .map(|(number, what)| format!("{} {what}", count(*number)))
                .collect();
        let why = if why.is_empty() { String::new() } else { format!(" ({})", why.join(", ")) };
        let images = plural(c.found, "image", "images");
        let who = match label {
            None => String::new(),
            Some("") => " in each evaluation".to_owned(),
            Some(label) => format!(" of {label}"),
        };
        self.line(&format!("evaluated {} of {images}{who}{why}", count(c.evaluated)));
        let digits = e.reasons.values().map(|n| count(*n).len()).max().unwrap_or(0);
        for (reason, number) in &e.reasons {
            self.line(&format!("  {:>digits$}  {}", count(*number), clean(reason)));
        }
        if label.is_none() {
            let (model, protocol) = (clean(&e.model), e.protocol.name());
            self.line(&format!("{model}, protocol {protocol}, seed {}", e.seed));
            self.line(&format!("aligned: {}", alignment(e)));
        }
    }

    /// The four numbers of the paper's table with their intervals.
    fn published_scores(&mut self, e: &Evaluation) {
        let blocks = format!("{} % by block", fixed(e.intervals.level_pct, 0));
        let mut rows = vec![row(["AS PUBLISHED", "averaged", "value", &blocks, "naive, by image"])];
        for (path, value) in published(e) {
            let s = score(path);
            let [block, naive] = interval(e, path);
            rows.push(vec![
                s.name.clone(),
                s.average.name().to_owned(),
                format!("{} {}", fixed(value, s.digits()), s.unit),
                range(block.0, block.1, s.digits()),
                range(naive.0, naive.1, s.digits()),
            ]);
        }
        self.table(&rows, 2);
    }

    /// Every score that can be averaged both ways, both ways, with the intervals by block.
    fn averages(&mut self, e: &Evaluation) {
        let mut rows = vec![row([
            "BOTH AVERAGES",
            "mean over images",
            "interval",
            "over all pixels",
            "interval",
        ])];
        for pair in both_ways(e) {
            let mut cells = vec![score(pair[0].0).name];
            for (path, value) in pair {
                let s = score(path);
                let mark = if s.published { '*' } else { ' ' };
                let (low, high) = interval(e, path)[0];
                cells.push(format!("{} {:1}{mark}", fixed(value, s.digits()), s.unit));
                cells.push(range(low, high, s.digits()));
            }
            rows.push(cells);
        }
        for t in &e.pooled.thresholds {
            rows.push(vec![
                format!("under {} m", t.threshold_m),
                format!("{} % ", fixed(t.per_image_mean_pct, 2)),
                String::new(),
                format!("{} % ", fixed(t.pooled_pct, 2)),
                String::new(),
            ]);
        }
        self.table(&rows, 1);
        self.line("  * as published");
    }

    fn intervals_note(&mut self, e: &Evaluation, naive: bool) {
        let i = &e.intervals;
        if i.blocks < 2 {
            self.sentence(&format!(
                "No interval by block: it takes two blocks of {} m that hold images, and there {}.",
                fixed(i.block_m, 0),
                if i.blocks == 1 { "is one" } else { "is none" },
            ));
        } else {
            self.sentence(&format!(
                "{} % bootstrap intervals: {} draws of {} blocks of {} m, since images overlap.{}",
                fixed(i.level_pct, 0),
                count(u64::from(i.replicates)),
                count(i.blocks),
                fixed(i.block_m, 0),
                if naive { " The naive ones draw single images and are too narrow." } else { "" },
            ));
        }
    }

    /// One row per evaluation, published rows last.
    fn comparison(&mut self, set: &EvaluationSet, labels: &[String]) {
        if set.evaluations.is_empty() && set.published.is_empty() {
            return;
        }
        let mut rows =
            vec![row(["AS PUBLISHED", "images", "MAE m", "RMSE m", "<2.5 m %", "<7.5 m %"])];
        for (e, label) in set.evaluations.iter().zip(labels) {
            let mut values = vec![label.clone(), count(e.images.evaluated)];
            let level = fixed(e.intervals.level_pct, 0);
            let mut intervals = vec![format!("  {level} % interval"), String::new()];
            for (path, value) in published(e) {
                let digits = score(path).digits();
                let (low, high) = interval(e, path)[0];
                values.push(fixed(value, digits));
                intervals.push(if low.is_nan() || high.is_nan() {
                    String::new()
                } else {
                    format!("{}\u{2013}{}", fixed(low, digits - 1), fixed(high, digits - 1))
                });
            }
            rows.push(values);
            if set.evaluations.len() > 1 && intervals[2..].iter().any(|cell| !cell.is_empty()) {
                rows.push(intervals);
            }
        }
        if !set.published.is_empty() {
            rows.push(row(["PUBLISHED, not computed here"]));
        }
        for published in &set.published {
            let s = &published.scores;
            let mut cells = vec![clean(published.method), String::new()];
            cells.extend(
                [s.mae_m, s.rmse_m, s.lt_2_5_m_pct, s.lt_7_5_m_pct].map(|value| fixed(value, 2)),
            );
            rows.push(cells);
        }
        self.table(&rows, 1);
        self.sentence("MAE and RMSE: mean over images. Shares: over all pixels.");
        let mut sources: Vec<&str> = set.published.iter().map(|row| row.source).collect();
        sources.dedup();
        for source in sources {
            self.sentence(&format!("Published rows: {}.", clean(source)));
        }
    }

    /// Robust scores and outliers over all pixels, one row per evaluation.
    fn robust(&mut self, set: &EvaluationSet, labels: &[String]) {
        let mut rows = Vec::new();
        for (e, label) in set.evaluations.iter().zip(labels) {
            if rows.is_empty() {
                let mut header = row(["OVER ALL PIXELS, m"]);
                header.extend(robust(e).map(|(path, _)| score(path).name));
                rows.push(header);
            }
            let mut cells = vec![label.clone()];
            cells.extend(robust(e).map(|(path, value)| match path {
                "pooled.bias_m" | "pooled.median_m" => signed(value, 2),
                "pooled.max_m" => fixed(value, 1),
                _ => fixed(value, 2),
            }));
            rows.push(cells);
        }
        if rows.is_empty() {
            return;
        }
        self.table(&rows, 1);
        if let [e] = &set.evaluations[..] {
            self.sentence(&format!(
                "{} compared, {} % of {} with a ground truth.",
                plural(e.pooled.pixels, "pixel", "pixels"),
                fixed(e.pooled.completeness_pct, 2),
                count(e.pooled.truth_pixels),
            ));
        }
    }

    fn differences(&mut self, set: &EvaluationSet) {
        // Many pairs would fill the screen; then the scores that the paper's table has must do.
        let all = set.differences.len() == 1;
        for d in &set.differences {
            let (a, b) = (clean(&d.a), clean(&d.b));
            let title = format!("{b} - {a}, {}", d.protocol.name());
            let mut rows = vec![row([
                "DIFFERENCE",
                "averaged",
                "first",
                "second",
                "diff.",
                "interval",
                "p",
                "",
            ])];
            for s in &d.scores {
                if !all && !PUBLISHED.contains(&s.score.as_str()) {
                    continue;
                }
                let named = score(&s.score);
                let digits = named.digits();
                rows.push(vec![
                    format!("{} {}", named.name, named.unit),
                    named.average.name().trim_start_matches("mean ").to_owned(),
                    fixed(s.a, digits),
                    fixed(s.b, digits),
                    signed(s.difference, digits),
                    range(s.low, s.high, digits.min(2)),
                    p_value(s.p_value),
                    if s.significant { "*" } else { " " }.to_owned(),
                ]);
            }
            self.table(&rows, 2);
            self.sentence(&format!(
                "{title}, on the {} that both have; * more than noise at 5\u{a0}% (Holm).",
                plural(d.images, "image", "images"),
            ));
        }
        if set.differences.len() > 1 {
            self.sentence("The differences of all other scores are in the JSON and in the report.");
        }
    }

    fn stratum(&mut self, group: &StratumGroup) {
        let mut rows = vec![row([
            &title(group),
            "pixels",
            "%",
            "MAE",
            "RMSE",
            "bias",
            "NMAD",
            "LE90",
            "<2.5m",
            "<7.5m",
        ])];
        for r in &group.rows {
            rows.push(vec![
                clean(&r.label),
                count(r.pixels),
                fixed(r.share_pct, 1),
                fixed(r.mae_m, 2),
                fixed(r.rmse_m, 2),
                signed(r.bias_m, 2),
                fixed(r.nmad_m, 2),
                fixed(r.le90_m, 2),
                fixed(r.lt_2_5_m_pct, 1),
                fixed(r.lt_7_5_m_pct, 1),
            ]);
        }
        self.table(&rows, 1);
    }

    /// The mean absolute error of each bin, one column per evaluation.
    fn strata_side_by_side(&mut self, set: &EvaluationSet, labels: &[String]) {
        let Some(first) = set.evaluations.first() else { return };
        if set.evaluations.len() > SIDE_BY_SIDE {
            return;
        }
        for group in &first.strata {
            let room = (self.width / 2 / set.evaluations.len()).max(8);
            let mut header = vec![format!("{}: MAE, m", title(group)), "%".to_owned()];
            header.extend(labels.iter().map(|label| shorten(label, room)));
            let mut rows = vec![header];
            for bin in &group.rows {
                let mut cells = vec![clean(&bin.label), fixed(bin.share_pct, 1)];
                for e in &set.evaluations {
                    let same = e.strata.iter().find(|g| g.name == group.name);
                    let same = same.and_then(|g| g.rows.iter().find(|r| r.label == bin.label));
                    cells.push(fixed(same.map_or(f64::NAN, |r| r.mae_m), 2));
                }
                rows.push(cells);
            }
            self.table(&rows, 1);
        }
    }

    fn registration(&mut self, e: &Evaluation, label: Option<&str>) {
        let Some(r) = &e.registration else { return };
        let images = plural(r.images, "image", "images");
        let who = label.map_or_else(String::new, |label| format!(" of {label}"));
        let mut rows = vec![row(["REGISTRATION", "estimate", "std error", "spread", "unit"])];
        let mut estimate = |name: &str, e: &Estimate, digits: usize, unit: &str| {
            rows.push(vec![
                name.to_owned(),
                signed(e.value, digits),
                fixed(e.standard_error, digits),
                fixed(e.spread, digits),
                unit.to_owned(),
            ]);
        };
        estimate("east", &r.east_m, 2, "m");
        estimate("north", &r.north_m, 2, "m");
        estimate("truth - prediction", &r.vertical_m, 2, "m");
        let lean = [("lean east", &r.lean_east), ("lean north", &r.lean_north)];
        for (name, lean) in lean {
            if let Some(lean) = lean {
                estimate(name, lean, 4, "m per m");
            }
        }
        self.table(&rows, 1);
        self.sentence(&format!("Estimated from {images}{who}; not applied to any score."));
    }
}

fn row<const N: usize>(cells: [&str; N]) -> Vec<String> {
    cells.map(str::to_owned).into()
}

fn title(group: &StratumGroup) -> String {
    let name = clean(&group.name).replace('_', " ").to_uppercase();
    if group.unit.is_empty() { name } else { format!("{name}, {}", clean(&group.unit)) }
}

/// Text from outside on one line, without control characters.
fn clean(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}

/// At most `width` characters, with an ellipsis where something is left out.
fn shorten(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    let mut short: String = text.chars().take(width.saturating_sub(1)).collect();
    short.push('\u{2026}');
    short
}

/// Columns of equal width, the first `left` of them flush left, the others flush right. The first
/// column gives way when the lines would be longer than `width`.
fn align(rows: &[Vec<String>], left: usize, width: usize) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let mut widths: Vec<usize> = (0..columns)
        .map(|c| rows.iter().filter_map(|r| r.get(c)).map(|t| t.chars().count()).max().unwrap_or(0))
        .collect();
    let used = |gap: usize, widths: &[usize]| widths.iter().sum::<usize>() + gap * (columns - 1);
    let gap = if columns == 0 || used(2, &widths) <= width { 2 } else { 1 };
    if columns > 0 {
        let excess = used(gap, &widths).saturating_sub(width);
        widths[0] = widths[0].saturating_sub(excess).max(widths[0].min(8));
    }
    rows.iter()
        .map(|cells| {
            let mut line = String::new();
            for (c, (cell, width)) in cells.iter().zip(&widths).enumerate() {
                let cell = shorten(cell, *width);
                if c > 0 {
                    line.extend(std::iter::repeat_n(' ', gap));
                }
                let pad = std::iter::repeat_n(' ', width - cell.chars().count());
                if c < left {
                    line.push_str(&cell);
                    line.extend(pad);
                } else {
                    line.extend(pad);
                    line.push_str(&cell);
                }
            }
            line
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::sample;
    use super::*;
    use crate::eval::{Protocol, published};

    fn widest(text: &str) -> usize {
        text.lines().map(|line| line.chars().count()).max().unwrap_or(0)
    }

    #[test]
    fn the_first_line_says_how_many_images_were_evaluated() {
        let text = terminal(&sample::set(&["out"], &[Protocol::Paper], 100), 80);
        let first = text.lines().next().expect("a line");
        assert_eq!(first, "evaluated 92 of 100 images (4 skipped, 4 failed, 8 unaligned)");
        assert!(text.contains("\n  4  no ground truth of this name\n"), "{text}");
        let text = terminal(&sample::nothing(), 80);
        assert!(text.starts_with("evaluated 0 of 9 images (4 skipped, 5 failed)\n"), "{text}");
        assert!(!text.contains("NaN"), "{text}");
    }

    #[test]
    fn everything_fits_the_width() {
        let long = "a".repeat(300);
        for width in [0, 60, 80, 120] {
            for models in [&["out"][..], &["out", "baseline"], &["out", &long, "third"]] {
                for protocols in [&[Protocol::Paper][..], &Protocol::ALL] {
                    let mut set = sample::set(models, protocols, 50);
                    set.published = published::paper_rows();
                    set.evaluations[0].pooled.max_m = 1.5e30;
                    let text = terminal(&set, width);
                    assert!(widest(&text) <= width.max(NARROWEST), "{width}\n{text}");
                    if width >= 80 && models.len() < 3 {
                        assert!(!text.contains('\u{2026}'), "nothing is cut at {width}\n{text}");
                    }
                }
            }
        }
    }

    #[test]
    fn averages_cannot_be_mixed_up() {
        let set = sample::set(&["out"], &[Protocol::Paper], 100);
        let text = terminal(&set, 80);
        let e = &set.evaluations[0];
        let find = |start: &str, with: &str| {
            let found = text.lines().find(|l| l.starts_with(start) && l.contains(with));
            found.unwrap_or_else(|| panic!("{start} {with}\n{text}")).to_owned()
        };
        assert!(find("MAE", "mean over images").contains(&fixed(e.as_published.mae_m, 3)));
        assert!(
            find("under 2.5 m", "over all pixels").contains(&fixed(e.as_published.lt_2_5_m_pct, 2))
        );
        let both = find("RMSE", "*");
        let of_images = both.find(&fixed(e.per_image_mean.rmse_m, 3)).expect("over images");
        let of_pixels = both.find(&fixed(e.pooled.rmse_m, 3)).expect("over pixels");
        let mark = both.find('*').expect("a mark");
        assert!(of_images < mark && mark < of_pixels, "{both}");
    }

    #[test]
    fn differences_and_published_rows_are_marked() {
        let mut set = sample::set(&["a", "b"], &[Protocol::Paper], 50);
        set.published = published::paper_rows();
        let text = terminal(&set, 80);
        let differs = text.lines().find(|l| l.starts_with("MAE m") && l.contains("over images"));
        assert!(
            differs.is_some_and(|l| l.ends_with("< 0.001  *") || l.ends_with("< 0.001 *")),
            "{text}"
        );
        let row = text.lines().find(|l| l.starts_with("Sat3DGen  ") && l.contains("3.47"));
        assert!(row.is_some(), "{text}");
        let (title, row) = (text.find("PUBLISHED, not"), text.find("Sat2Density++"));
        assert!(title.is_some() && title < row, "{text}");
        assert!(text.contains("Sat3DGen, ICLR 2026, VIGOR-OOD"));
    }

    #[test]
    fn names_cannot_steer_the_terminal() {
        let mut set = sample::set(&["a\u{1b}[31m\nb"], &[Protocol::Paper], 20);
        set.evaluations[0].reasons.insert("\u{7}bell\r".to_owned(), 3);
        let text = terminal(&set, 80);
        assert!(!text.chars().any(|c| c.is_control() && c != '\n'), "{text:?}");
        assert!(text.contains("a?[31m?b"));
    }

    #[test]
    fn no_evaluation_gives_no_line() {
        let set = EvaluationSet { evaluations: vec![], differences: vec![], published: vec![] };
        assert_eq!(terminal(&set, 80), "");
    }
}
