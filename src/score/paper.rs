//! The variants of the paper's ablation, to be held beside those of a training of one's own.

/// Name of a variant, and its RMSE on the paper's benchmark of Seattle (VIGOR-OOD), metres. From the paper's table of
/// geometry; the names are ours.
pub const ABLATION: [(&str, f64); 6] = [
    ("canonical", 6.21),
    ("without-depth", 5.75),
    ("without-gravity", 5.21),
    ("without-tokens", 5.64),
    ("without-perspective", 5.23),
    ("full", 5.20),
];

/// The paper's RMSE of a variant, if it has it.
#[must_use]
pub fn rmse_m(name: &str) -> Option<f64> {
    ABLATION.iter().find(|(known, _)| *known == name).map(|(_, rmse)| *rmse)
}
