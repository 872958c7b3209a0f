//! The scores' names: what a path such as `pooled.lt_2_5_m_pct` is called, and how it is averaged.

use crate::eval::summary::Evaluation;
use crate::eval::{OffsetMethod, Protocol};

/// How a score is averaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Average {
    /// Per image first, then the mean over images: every image counts the same.
    Images,
    /// Over all pixels of all images: every pixel counts the same.
    Pixels,
    /// Not known here.
    Other,
}

impl Average {
    /// As a heading says it.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Images => "mean over images",
            Self::Pixels => "over all pixels",
            Self::Other => "",
        }
    }
}

/// A score as people call it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Score {
    /// `MAE`, `under 2.5 m`.
    pub(super) name: String,
    /// How it is averaged.
    pub(super) average: Average,
    /// `m` or `%`.
    pub(super) unit: &'static str,
    /// Whether the paper's table has it, averaged in this way.
    pub(super) published: bool,
}

impl Score {
    /// Decimals to print: three of metres, two of per cents.
    pub(super) const fn digits(&self) -> usize {
        if self.unit.len() == 1 && self.unit.as_bytes()[0] == b'm' { 3 } else { 2 }
    }
}

/// The score at a path. An unknown one is called by its path.
pub(super) fn score(path: &str) -> Score {
    let (group, field) = path.split_once('.').unwrap_or(("", path));
    let (name, unit) = match field {
        "mae_m" => ("MAE".to_owned(), "m"),
        "rmse_m" => ("RMSE".to_owned(), "m"),
        "bias_m" => ("bias".to_owned(), "m"),
        "std_m" => ("std".to_owned(), "m"),
        "median_m" => ("median".to_owned(), "m"),
        "nmad_m" => ("NMAD".to_owned(), "m"),
        "le68_m" => ("LE68".to_owned(), "m"),
        "le90_m" => ("LE90".to_owned(), "m"),
        "p95_m" => ("p95".to_owned(), "m"),
        "max_m" => ("max".to_owned(), "m"),
        "completeness_pct" => ("completeness".to_owned(), "%"),
        _ => match field.strip_prefix("lt_").and_then(|f| f.strip_suffix("_m_pct")) {
            Some(threshold) => (format!("under {} m", threshold.replace('_', ".")), "%"),
            None => (path.to_owned(), ""),
        },
    };
    let share = matches!(field, "lt_2_5_m_pct" | "lt_7_5_m_pct");
    let error = matches!(field, "mae_m" | "rmse_m");
    let average = match group {
        "per_image_mean" => Average::Images,
        "pooled" => Average::Pixels,
        "as_published" if error => Average::Images,
        "as_published" if share => Average::Pixels,
        _ => Average::Other,
    };
    let published = error && average == Average::Images || share && average == Average::Pixels;
    Score { name, average, unit, published }
}

/// Ends of the intervals of a score, by blocks and by single images; NaN where there are none.
pub(super) fn interval(evaluation: &Evaluation, path: &str) -> [(f64, f64); 2] {
    let found = evaluation.intervals.scores.iter().find(|i| i.score == path);
    found.map_or([(f64::NAN, f64::NAN); 2], |i| [(i.low, i.high), (i.naive_low, i.naive_high)])
}

/// What is aligned, in a few words.
pub(super) fn alignment(evaluation: &Evaluation) -> String {
    let offset = match evaluation.offset {
        OffsetMethod::Ransac => "RANSAC",
        OffsetMethod::Median => "median",
        OffsetMethod::Mean => "mean",
    };
    match evaluation.protocol {
        Protocol::Paper => format!("shift, rotation, vertical offset ({offset})"),
        Protocol::Vertical => format!("vertical offset ({offset})"),
        Protocol::Plain => "nothing".to_owned(),
        Protocol::Coregister => "sub-pixel shift and vertical offset (Nuth and Kaab)".to_owned(),
    }
}

/// The four scores of the paper's table: path, value.
pub(super) fn published(evaluation: &Evaluation) -> [(&'static str, f64); 4] {
    let s = &evaluation.as_published;
    [
        ("per_image_mean.mae_m", s.mae_m),
        ("per_image_mean.rmse_m", s.rmse_m),
        ("pooled.lt_2_5_m_pct", s.lt_2_5_m_pct),
        ("pooled.lt_7_5_m_pct", s.lt_7_5_m_pct),
    ]
}

/// Scores that are averaged both ways: name's path over images, value, path over pixels, value.
pub(super) fn both_ways(evaluation: &Evaluation) -> Vec<[(&'static str, f64); 2]> {
    let (i, p) = (&evaluation.per_image_mean, &evaluation.pooled);
    vec![
        [("per_image_mean.mae_m", i.mae_m), ("pooled.mae_m", p.mae_m)],
        [("per_image_mean.rmse_m", i.rmse_m), ("pooled.rmse_m", p.rmse_m)],
        [("per_image_mean.lt_2_5_m_pct", i.lt_2_5_m_pct), ("pooled.lt_2_5_m_pct", p.lt_2_5_m_pct)],
        [("per_image_mean.lt_7_5_m_pct", i.lt_7_5_m_pct), ("pooled.lt_7_5_m_pct", p.lt_7_5_m_pct)],
        [("per_image_mean.bias_m", i.bias_m), ("pooled.bias_m", p.bias_m)],
        [
            ("per_image_mean.completeness_pct", i.completeness_pct),
            ("pooled.completeness_pct", p.completeness_pct),
        ],
    ]
}

/// Scores over all pixels that outliers hardly move, and the outliers: path, value.
pub(super) fn robust(evaluation: &Evaluation) -> [(&'static str, f64); 8] {
    let p = &evaluation.pooled;
    [
        ("pooled.bias_m", p.bias_m),
        ("pooled.std_m", p.std_m),
        ("pooled.median_m", p.median_m),
        ("pooled.nmad_m", p.nmad_m),
        ("pooled.le68_m", p.le68_m),
        ("pooled.le90_m", p.le90_m),
        ("pooled.p95_m", p.p95_m),
        ("pooled.max_m", p.max_m),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_papers_averages_are_called_published() {
        let of = |path: &str| {
            let s = score(path);
            (s.name.clone(), s.average, s.unit, s.published)
        };
        let name = |s: &str| s.to_owned();
        assert_eq!(of("per_image_mean.mae_m"), (name("MAE"), Average::Images, "m", true));
        assert_eq!(of("pooled.mae_m"), (name("MAE"), Average::Pixels, "m", false));
        assert_eq!(of("pooled.lt_2_5_m_pct"), (name("under 2.5 m"), Average::Pixels, "%", true));
        assert_eq!(
            of("per_image_mean.lt_7_5_m_pct"),
            (name("under 7.5 m"), Average::Images, "%", false)
        );
        assert_eq!(of("as_published.rmse_m"), (name("RMSE"), Average::Images, "m", true));
        assert_eq!(of("as_published.lt_7_5_m_pct").1, Average::Pixels);
        assert_eq!(of("pooled.lt_10_m_pct"), (name("under 10 m"), Average::Pixels, "%", false));
        assert_eq!(of("something"), (name("something"), Average::Other, "", false));
        assert_eq!((score("pooled.mae_m").digits(), score("pooled.lt_2_5_m_pct").digits()), (3, 2));
    }
}
