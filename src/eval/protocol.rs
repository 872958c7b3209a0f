//! What is aligned before a prediction is scored.

use serde::{Deserialize, Serialize};

/// What is aligned before a prediction is scored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// The published procedure: shift by phase correlation, rotation by search, vertical offset by
    /// RANSAC.
    #[default]
    Paper,
    /// A vertical offset only.
    Vertical,
    /// Nothing.
    Plain,
    /// Sub-pixel shift and vertical offset after Nuth and Kaab (2011).
    Coregister,
}

impl Protocol {
    /// All of them, in the order in which `--protocol all` prints them.
    pub const ALL: [Self; 4] = [Self::Paper, Self::Vertical, Self::Plain, Self::Coregister];

    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Vertical => "vertical",
            Self::Plain => "plain",
            Self::Coregister => "coregister",
        }
    }
}

/// How a vertical offset is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OffsetMethod {
    /// 150 draws of 50 pixels, median, inliers within 1.5 m, mean of the inliers (the published one).
    Ransac,
    /// Median of truth - prediction.
    Median,
    /// Mean of truth - prediction.
    Mean,
}
