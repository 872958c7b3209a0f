//! Errors in equal bins: the picture of their distribution.

use crate::eval::summary::ErrorHistogram;
use serde::{Deserialize, Serialize};

/// Counts of errors in equal bins; a bin holds its lower edge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    /// Lower edges of the bins and, last, the upper edge of the last one, metres.
    edges: Vec<f64>,
    bin_m: f64,
    /// Below the first bin, per bin, above the last.
    counts: Vec<u64>,
}

impl Histogram {
    /// `bins` empty bins of width `bin_m` from `low_m` on (metres); edge `i` is
    /// `low_m + i * bin_m`, as `f64` computes it.
    ///
    /// # Panics
    /// When there is no bin, or its width is not above 0 and large enough to tell edges apart.
    #[must_use]
    pub fn new(low_m: f64, bin_m: f64, bins: u32) -> Self {
        let edges: Vec<f64> = (0..=bins).map(|edge| low_m + f64::from(edge) * bin_m).collect();
        assert!(bins > 0 && edges.is_sorted_by(|a, b| a < b), "bins of {bin_m} m from {low_m} m");
        Self { edges, bin_m, counts: vec![0; bins as usize + 2] }
    }

    /// Counts finite errors (metres).
    pub fn add(&mut self, errors: &[f64]) {
        let last = (self.counts.len() - 3) as f64;
        let (low, per_metre) = (self.edges[0], 1.0 / self.bin_m);
        for error in errors {
            // The product may round across an edge, by one bin at most; the edges decide. They also
            // move what is outside from the first or the last bin to the counter beside it.
            let near = ((error - low) * per_metre).clamp(0.0, last) as u32 as usize;
            let above = usize::from(*error >= self.edges[near + 1]);
            let below = usize::from(*error < self.edges[near]);
            self.counts[1 + near + above - below] += 1;
        }
    }

    /// Counts the errors of another part too.
    ///
    /// # Panics
    /// When its bins are others.
    pub fn merge(&mut self, other: &Self) {
        assert!(self.edges == other.edges, "histograms of the same bins");
        for (count, more) in self.counts.iter_mut().zip(&other.counts) {
            *count += more;
        }
    }
}

impl From<Histogram> for ErrorHistogram {
    fn from(histogram: Histogram) -> Self {
        let bins = histogram.counts.len() - 2;
        Self {
            low_m: histogram.edges[0],
            bin_m: histogram.bin_m,
            counts: histogram.counts[1..=bins].to_vec(),
            below: histogram.counts[0],
            above: histogram.counts[bins + 1],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_bin_holds_its_lower_edge_and_what_is_outside_is_counted() {
        let mut histogram = Histogram::new(-25.0, 0.1, 500);
        // Every edge as computed falls into its own bin, and the number before it into the last.
        for bin in 0..500 {
            let edge = -25.0 + f64::from(bin) * 0.1;
            histogram.add(&[edge, edge.next_down()]);
        }
        histogram.add(&[25.0, 7e38, -7e38, f64::MAX]);
        let counts = ErrorHistogram::from(histogram);
        assert_eq!(counts.counts[..499], [2; 499]);
        assert_eq!((counts.counts[499], counts.below, counts.above), (1, 2, 3));
    }

    proptest! {
        #[test]
        fn counts_are_those_of_a_search_among_the_edges(
            errors in proptest::collection::vec(-12.0..12.0_f64, 0..300),
            low in -10.0..0.0_f64,
            bin in 0.01..1.0_f64,
            split in 0..300_usize,
        ) {
            let mut histogram = Histogram::new(low, bin, 20);
            let mut second = histogram.clone();
            let split = split.min(errors.len());
            histogram.add(&errors[..split]);
            second.add(&errors[split..]);
            histogram.merge(&second);
            let edges: Vec<f64> = (0..=20).map(|i| low + f64::from(i) * bin).collect();
            let mut expected = [0_u64; 22];
            for error in &errors {
                expected[edges.partition_point(|edge| edge <= error)] += 1;
            }
            let found = ErrorHistogram::from(histogram);
            prop_assert_eq!(found.below, expected[0]);
            prop_assert_eq!(&found.counts[..], &expected[1..21]);
            prop_assert_eq!(found.above, expected[21]);
        }
    }
}
