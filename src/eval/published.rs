//! Published numbers to stand beside (`--against paper`).

use super::summary::{PublishedRow, PublishedScores};

/// Where the rows of [`paper_rows`] are from.
pub const PAPER: &str = "Sat3DGen, ICLR 2026, VIGOR-OOD";

/// The rows of the paper's table on DSMs (Sat3DGen, ICLR 2026, VIGOR-OOD: Seattle), in its order.
///
/// They are what the authors state for their own predictions and ground truth; nothing here is
/// computed.
#[must_use]
pub fn paper_rows() -> Vec<PublishedRow> {
    crate::plan::runs("published");
    [
        ("Sat2Density++", [4.72, 6.76, 49.69, 83.65]),
        ("Canonical image-to-3D", [4.23, 6.21, 52.73, 84.54]),
        ("Sat3DGen, no gravity loss", [3.53, 5.21, 61.17, 88.94]),
        ("Sat3DGen, no depth loss", [3.82, 5.75, 59.88, 87.04]),
        ("Sat3DGen, no spatial tokens", [3.87, 5.64, 57.10, 86.46]),
        ("Sat3DGen, no perspective training", [3.52, 5.23, 61.97, 88.52]),
        ("Sat3DGen", [3.47, 5.20, 62.69, 88.68]),
    ]
    .map(|(method, [mae_m, rmse_m, lt_2_5_m_pct, lt_7_5_m_pct])| PublishedRow {
        method,
        source: PAPER,
        scores: PublishedScores { mae_m, rmse_m, lt_2_5_m_pct, lt_7_5_m_pct },
    })
    .into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_the_tables() {
        let rows = paper_rows();
        assert_eq!(rows.len(), 7);
        // Sums of the columns of the published table, added up apart from this list.
        let sum = |of: fn(&PublishedScores) -> f64| rows.iter().map(|r| of(&r.scores)).sum::<f64>();
        assert!((sum(|s| s.mae_m) - 27.16).abs() < 1e-9);
        assert!((sum(|s| s.rmse_m) - 40.00).abs() < 1e-9);
        assert!((sum(|s| s.lt_2_5_m_pct) - 405.23).abs() < 1e-9);
        assert!((sum(|s| s.lt_7_5_m_pct) - 607.83).abs() < 1e-9);
        let last = rows[6].scores;
        assert_eq!((last.mae_m, last.rmse_m), (3.47, 5.20));
        assert_eq!((last.lt_2_5_m_pct, last.lt_7_5_m_pct), (62.69, 88.68));
    }
}
