//! Kinds of place: how steep the ground truth is, how far from an edge, how high above ground, of
//! which class.
//!
//! Everything is taken from the aligned ground truth, and lengths are metres on the ground: a pixel
//! is what the latitude makes of it, and need not be square. A bin holds its lower limit.
//!
//! * `slope`: Horn's (1981) third-order difference over the eight neighbours, which is what
//!   `gdaldem slope` and xDEM use unless told otherwise. A pixel with a missing neighbour, and so
//!   the outermost row and column, is in no bin.
//! * `edge_distance`: from the centre of the pixel to the nearest jump: the middle of a side that
//!   two pixels share whose heights differ by more than 2 m. Along a straight wall that is the
//!   distance to the wall, half a pixel for the pixels on either side of it. What lies beyond the
//!   image is not looked at. Next to missing data a nearer jump may be hidden: a pixel is in no bin
//!   where that could change its bin.
//! * `height_above_ground`: ground truth minus bare earth.
//! * `class`: value of the mask.

mod edges;
mod fill;
mod geojson;
mod mask;
mod polygons;
mod slope;

pub use mask::{Mask, MaskError, MaskOptions};

use super::surface::Surface;
use serde::{Deserialize, Serialize};

/// The bin of a pixel that lies in none.
pub const NO_CLASS: u16 = u16::MAX;

/// Limits of the bins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StrataSettings {
    /// Between the bins of slope, degrees, ascending, in (0, 90).
    pub slope_deg: Vec<f64>,
    /// A step between neighbouring pixels beyond this many metres is an edge.
    pub jump_m: f64,
    /// Between the bins of edge distance, metres, ascending, positive.
    pub edge_distance_m: Vec<f64>,
    /// Between the bins of height above ground, metres, ascending. The lowest bin of the defaults,
    /// under -1 m, is where the ground truth and its bare earth contradict each other.
    pub height_above_ground_m: Vec<f64>,
}

impl Default for StrataSettings {
    fn default() -> Self {
        Self {
            slope_deg: vec![5.0, 15.0, 30.0, 60.0],
            jump_m: 2.0,
            edge_distance_m: vec![0.5, 1.0, 2.0, 4.0, 8.0],
            height_above_ground_m: vec![-1.0, 1.0, 3.0, 6.0, 12.0, 25.0],
        }
    }
}

/// Which bin of each group a pixel of one image lies in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Strata {
    /// One per group, in the order of [`StratumSet::groups`].
    pub groups: Vec<PixelClasses>,
}

/// The bins of one group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PixelClasses {
    /// Number of the group in [`StratumSet::groups`].
    pub group: usize,
    /// One per pixel, row-major; [`NO_CLASS`] for pixels in no bin.
    pub classes: Vec<u16>,
}

/// What a group is, in words.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupDefinition {
    /// `slope`, `edge_distance`, `height_above_ground` or `class`.
    pub name: String,
    /// Unit of the limits: `degrees`, `metres` or empty.
    pub unit: String,
    /// What it is, in a sentence.
    pub description: String,
    /// One per bin.
    pub labels: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Slope,
    EdgeDistance,
    HeightAboveGround,
    Class,
}

/// The groups of a run, with everything that does not depend on the image.
#[derive(Clone, Debug)]
pub struct StratumSet {
    groups: Vec<GroupDefinition>,
    kinds: Vec<Kind>,
    /// Squared tangents of the limits of slope.
    slope: Vec<f64>,
    /// Squared limits of edge distance, square metres.
    edge: Vec<f64>,
    height: Vec<f64>,
    jump_m: f64,
}

impl StratumSet {
    /// Slope and edge distance always, height above ground and class where there is something to
    /// take them from. Limits are put in order; those that are no number, and limits of slope and
    /// distance that no value can lie on either side of, are left out.
    #[must_use]
    pub fn new(has_ground: bool, mask: Option<&Mask>, settings: &StrataSettings) -> Self {
        let slope = ascending(&settings.slope_deg, |v| v > 0.0 && v < 90.0);
        let edge = ascending(&settings.edge_distance_m, |v| v > 0.0);
        let height = ascending(&settings.height_above_ground_m, |_| true);
        let jump_m = settings.jump_m;
        let mut groups = Vec::new();
        let mut kinds = Vec::new();
        let mut add = |kind, name: &str, unit: &str, description: String, labels| {
            kinds.push(kind);
            groups.push(GroupDefinition {
                name: name.to_owned(),
                unit: unit.to_owned(),
                description,
                labels,
            });
        };
        add(
            Kind::Slope,
            "slope",
            "degrees",
            "Slope of the ground truth (Horn), degrees on ground metres.".to_owned(),
            labels(&slope, Some("0"), Some("90")),
        );
        add(
            Kind::EdgeDistance,
            "edge_distance",
            "metres",
            format!(
                "Distance on the ground to the nearest jump of more than {jump_m} m between neighbouring pixels of the ground truth."
            ),
            labels(&edge, Some("0"), None),
        );
        if has_ground {
            add(
                Kind::HeightAboveGround,
                "height_above_ground",
                "metres",
                "Height of the ground truth above its bare earth (`dtm`).".to_owned(),
                labels(&height, None, None),
            );
        }
        if let Some(mask) = mask {
            add(Kind::Class, "class", "", mask.description(), mask.labels().to_vec());
        }
        Self {
            groups,
            kinds,
            slope: slope.iter().map(|v| square(libm::tan(v.to_radians()))).collect(),
            edge: edge.iter().copied().map(square).collect(),
            height,
            jump_m,
        }
    }

    /// The groups, in a fixed order.
    #[must_use]
    pub fn groups(&self) -> &[GroupDefinition] {
        &self.groups
    }

    /// The bins of every pixel. `truth` is the aligned ground truth on the prediction's grid,
    /// `ground` its bare earth and `classes` the mask's classes, both aligned the same way;
    /// `pixel_m` is the size of a pixel on the ground, metres east-west and north-south.
    ///
    /// # Panics
    /// When the layers differ in size.
    #[must_use]
    pub fn classify(
        &self,
        truth: &Surface,
        ground: Option<&Surface>,
        classes: Option<&[u16]>,
        pixel_m: (f64, f64),
    ) -> Strata {
        let pixels = truth.values.len();
        let none = || vec![NO_CLASS; pixels];
        let groups = self
            .kinds
            .iter()
            .enumerate()
            .map(|(group, kind)| {
                let classes = match kind {
                    Kind::Slope => slope::classes(truth, pixel_m, &self.slope),
                    Kind::EdgeDistance => edges::classes(truth, pixel_m, self.jump_m, &self.edge),
                    Kind::HeightAboveGround => {
                        ground.map_or_else(none, |ground| self.heights(truth, ground))
                    }
                    Kind::Class => classes.map_or_else(none, |classes| {
                        assert_eq!(classes.len(), pixels, "a mask of another size");
                        classes.to_vec()
                    }),
                };
                PixelClasses { group, classes }
            })
            .collect();
        Strata { groups }
    }

    fn heights(&self, truth: &Surface, ground: &Surface) -> Vec<u16> {
        assert_eq!(truth.size(), ground.size(), "bare earth of another size");
        let above =
            truth.values.iter().zip(&ground.values).map(|(t, g)| f64::from(*t) - f64::from(*g));
        above.map(|h| if h.is_finite() { bin(&self.height, h) } else { NO_CLASS }).collect()
    }
}

/// The bin of a value that is not NaN: how many limits it has reached.
fn bin(limits: &[f64], value: f64) -> u16 {
    limits.iter().map(|limit| u16::from(value >= *limit)).sum()
}

const fn square(v: f64) -> f64 {
    v * v
}

fn ascending(limits: &[f64], possible: impl Fn(f64) -> bool) -> Vec<f64> {
    let mut limits: Vec<f64> =
        limits.iter().copied().filter(|v| v.is_finite() && possible(*v)).collect();
    limits.sort_by(f64::total_cmp);
    limits.dedup();
    limits
}

/// `0 to 5`, `under 1`, `over 25`: one more than there are limits.
fn labels(limits: &[f64], low: Option<&str>, high: Option<&str>) -> Vec<String> {
    let text: Vec<String> = limits.iter().map(f64::to_string).collect();
    let end = |k: usize| text.get(k).map(String::as_str);
    (0..=limits.len())
        .map(|k| {
            let from = if k == 0 { low } else { end(k - 1) };
            match (from, end(k).or(high)) {
                (Some(from), Some(to)) => format!("{from} to {to}"),
                (None, Some(to)) => format!("under {to}"),
                (Some(from), None) => format!("over {from}"),
                (None, None) => "all".to_owned(),
            }
        })
        .collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests;
