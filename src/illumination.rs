//! Where the light of a street view comes from: a panorama with its sky mask, a stored histogram, or a name.

/// The illumination input of the network, with where it came from.
#[derive(Clone, Debug, PartialEq)]
pub struct Illumination {
    /// What the manifest says: a name of the bundled set, or the files.
    pub origin: String,
    /// 270 values; see [`crate::model::illumination::sky_histogram`].
    pub histogram: Vec<f32>,
}
