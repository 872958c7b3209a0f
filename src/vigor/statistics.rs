//! Statistics of labels: residuals, reproduction by the formula, neighbours, overlap.

use super::dataset::{Dataset, Pair};
use super::kinds::{LabelKind, Split};
use super::measure::{Measured, Residual, fitted_resolution, ground_pixel_size};
use super::overlap::{Cover, MAX_DEPTH, Rectangle};
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use rstar::RTree;
use rstar::primitives::GeomWithData;
use serde::Serialize;
use std::collections::HashSet;

/// Labels that the formula does not reproduce are listed up to this many.
const EXAMPLES: usize = 20;
/// Two distances are the same within this, pixels: far above the rounding of world pixels (6e-8).
const TIE_PX: f64 = 1e-6;

/// Mean, 95th percentile and maximum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Distribution {
    /// Number of values.
    pub count: u64,
    /// Arithmetic mean.
    pub mean: f64,
    /// 95th percentile, linear between the neighbouring values (numpy's default).
    pub p95: f64,
    /// Largest value.
    pub max: f64,
}

impl Distribution {
    /// Describes values; `None` if there are none. NaN must not occur.
    #[must_use]
    pub fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let (n, max) = (values.len(), *values.last()?);
        let at = 0.95 * (n - 1) as f64;
        let (low, part) = (at.floor() as usize, at.fract());
        let next = values[(low + 1).min(n - 1)];
        Some(Self {
            count: n as u64,
            mean: pairwise_sum(&values) / n as f64,
            p95: values[low] + part * (next - values[low]),
            max,
        })
    }
}

/// A sum whose error grows with the logarithm of the number of values.
fn pairwise_sum(values: &[f64]) -> f64 {
    if values.len() <= 64 {
        values.iter().sum()
    } else {
        let (a, b) = values.split_at(values.len() / 2);
        pairwise_sum(a) + pairwise_sum(b)
    }
}

/// Labels of one role against the exact pixels.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RoleStatistics {
    /// Pairs, with or without a label.
    pub pairs: u64,
    /// Pairs whose panorama lies outside the image.
    pub outside: u64,
    /// Pairs whose label says so.
    pub label_outside: u64,
    /// Length of label minus exact pixel, pixels.
    pub residual_px: Option<Distribution>,
    /// The same on the ground, metres.
    pub residual_m: Option<Distribution>,
}

impl RoleStatistics {
    fn of<'a>(measured: impl Iterator<Item = &'a Measured>) -> Self {
        let measured: Vec<&Measured> = measured.collect();
        let distribution = |of: fn(&Residual) -> f64| {
            Distribution::of(measured.iter().filter_map(|m| m.residual.as_ref().map(of)).collect())
        };
        Self {
            pairs: measured.len() as u64,
            outside: measured.iter().filter(|m| !m.inside).count() as u64,
            label_outside: measured.iter().filter(|m| m.label_inside == Some(false)).count() as u64,
            residual_px: distribution(|r| r.px),
            residual_m: distribution(|r| r.metres),
        }
    }
}

/// A label that the formula does not give.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NotReproduced {
    /// File, from the root.
    pub file: String,
    /// Line, from 1.
    pub line: u32,
    /// Satellite image.
    pub satellite: String,
    /// `[d0, d1]` as written.
    pub label: [f64; 2],
    /// `[d0, d1]` by the formula.
    pub formula: [i64; 2],
}

/// How training and test share images and ground.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainTest {
    /// Panoramas of training.
    pub train_panoramas: u64,
    /// Panoramas of the test.
    pub test_panoramas: u64,
    /// Panoramas in both.
    pub shared_panoramas: u64,
    /// Satellite images of training, in any role.
    pub train_satellites: u64,
    /// Satellite images of the test, in any role.
    pub test_satellites: u64,
    /// Satellite images in both.
    pub shared_satellites: u64,
    /// Positives of training.
    pub train_positives: u64,
    /// Positives of the test.
    pub test_positives: u64,
    /// Satellite images that are positives in both.
    pub shared_positives: u64,
    /// Share of the ground under the test's positives that a positive of training also shows.
    pub test_ground_in_training: Option<f64>,
}

/// All labels of one kind in one city; pairs that several files repeat count once.
#[derive(Clone, Debug, Serialize)]
pub struct LabelStatistics {
    /// Which labels.
    pub labels: LabelKind,
    /// Distinct panoramas.
    pub panoramas: u64,
    /// Distinct pairs of a panorama, an image and a label.
    pub pairs: u64,
    /// Pairs without a label (three-field split lines).
    pub without_label: u64,
    /// Ground size of a pixel in the UTM formula, metres.
    pub resolution_m: Option<f64>,
    /// The resolution that fits these labels best, metres.
    pub fitted_resolution_m: Option<f64>,
    /// Labels that the UTM formula gives, both numbers.
    pub reproduced: u64,
    /// Labels that it does not give.
    pub not_reproduced: u64,
    /// The first of those.
    pub not_reproduced_examples: Vec<NotReproduced>,
    /// The first image of each line.
    pub positive: RoleStatistics,
    /// The other three.
    pub semi_positive: RoleStatistics,
    /// Lines whose positive is the nearest of the line's images.
    pub positive_nearest_of_line: u64,
    /// Lines whose positive is the nearest of all known images of the city.
    pub positive_nearest_of_city: u64,
    /// Training against test, if there are both.
    pub train_test: Option<TrainTest>,
}

/// How a city's images overlap.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OverlapStatistics {
    /// Images known: listed, labelled or in the folder.
    pub images: u64,
    /// Mean number of images that show a point of the ground, over the ground that any shows.
    pub mean_images: f64,
    /// Share of that ground shown at least 1, 2, ... times.
    pub share_at_least: Vec<f64>,
    /// Ground that any image shows, square kilometres (with the pixel size at the mean latitude).
    pub union_km2: f64,
}

/// Statistics per kind of label of a city, in the order of [`LabelKind::ALL`].
#[must_use]
pub fn of_labels(
    dataset: &Dataset,
    measured: &[Measured],
    city: u32,
    resolution_m: Option<f64>,
) -> Vec<LabelStatistics> {
    let plane = Plane::new(dataset);
    let tree = RTree::bulk_load(
        dataset
            .satellites
            .iter()
            .enumerate()
            .filter(|(_, s)| s.city == city)
            .map(|(i, s)| GeomWithData::new(plane.at(s.grid.center()), i as u32))
            .collect(),
    );
    let of_kind = |kind| {
        let rows: Vec<(&Pair, &Measured)> = dataset
            .pairs
            .iter()
            .zip(measured)
            .filter(|(pair, _)| {
                dataset.files[pair.file as usize].labels == Some(kind)
                    && dataset.panoramas[pair.panorama as usize].city == city
            })
            .collect();
        (!rows.is_empty()).then(|| {
            let nearest = Nearest { plane: &plane, tree: &tree };
            let train_test = train_test(dataset, &rows);
            let rows = without_repetitions(rows);
            LabelStatistics {
                train_test,
                ..label_statistics(dataset, &rows, kind, resolution_m, &nearest)
            }
        })
    };
    LabelKind::ALL.into_iter().filter_map(of_kind).collect()
}

/// `pano_label_balanced.txt` holds what the train and test files hold: each pair counts once.
fn without_repetitions<'a>(
    mut rows: Vec<(&'a Pair, &'a Measured)>,
) -> Vec<(&'a Pair, &'a Measured)> {
    let mut seen = HashSet::with_capacity(rows.len());
    rows.retain(|(pair, _)| {
        let label = pair.offset.map(|o| o.map(f64::to_bits));
        seen.insert((pair.panorama, pair.satellite, pair.is_positive(), label))
    });
    rows
}

/// Everything but `train_test`, over rows without repetitions.
fn label_statistics(
    dataset: &Dataset,
    rows: &[(&Pair, &Measured)],
    labels: LabelKind,
    resolution_m: Option<f64>,
    nearest: &Nearest<'_>,
) -> LabelStatistics {
    let role = |positive: bool| {
        RoleStatistics::of(
            rows.iter().filter(|(p, _)| p.is_positive() == positive).map(|(_, m)| *m),
        )
    };
    let count =
        |wanted: Option<bool>| rows.iter().filter(|(_, m)| m.reproduced == wanted).count() as u64;
    let fitted = resolution_m.and_then(|resolution| {
        fitted_resolution(rows.iter().filter_map(|(p, m)| Some((p.offset?, m.utm?, resolution))))
    });
    let examples = rows
        .iter()
        .filter(|(_, m)| m.reproduced == Some(false))
        .filter_map(|(pair, m)| {
            Some(NotReproduced {
                file: dataset.files[pair.file as usize].file.clone(),
                line: pair.line,
                satellite: dataset.satellites[pair.satellite as usize].name.clone(),
                label: pair.offset?,
                formula: m.utm?,
            })
        })
        .take(EXAMPLES)
        .collect();
    let (of_line, of_city) = nearest.count(dataset, rows);
    let panoramas: HashSet<u32> = rows.iter().map(|(p, _)| p.panorama).collect();
    LabelStatistics {
        labels,
        panoramas: panoramas.len() as u64,
        pairs: rows.len() as u64,
        without_label: rows.iter().filter(|(p, _)| p.offset.is_none()).count() as u64,
        resolution_m,
        fitted_resolution_m: fitted,
        reproduced: count(Some(true)),
        not_reproduced: count(Some(false)),
        not_reproduced_examples: examples,
        positive: role(true),
        semi_positive: role(false),
        positive_nearest_of_line: of_line,
        positive_nearest_of_city: of_city,
        train_test: None,
    }
}

/// World pixels at the images' zoom, relative to longitude and latitude zero.
struct Plane(Option<ImageGrid>);

impl Plane {
    fn new(dataset: &Dataset) -> Self {
        let origin = LonLat { lon_deg: 0.0, lat_deg: 0.0 };
        Self(ImageGrid::new(origin, dataset.size().zoom, 2, 2).ok())
    }

    fn at(&self, position: LonLat) -> [f64; 2] {
        // Every grid that exists has a zoom that this one can have, too.
        let p = self.0.map_or(PixelPoint { x: 0.0, y: 0.0 }, |grid| grid.pixel(position));
        [p.x, p.y]
    }
}

/// Finds whether positives are the nearest images. Pixels of one place are equally long to all
/// sides, so distances in pixels rank as distances on the ground.
struct Nearest<'a> {
    plane: &'a Plane,
    tree: &'a RTree<GeomWithData<[f64; 2], u32>>,
}

impl Nearest<'_> {
    /// Positives that are the nearest of their line, and of the city.
    fn count(&self, dataset: &Dataset, rows: &[(&Pair, &Measured)]) -> (u64, u64) {
        let middle = f64::from(dataset.size().pixels) / 2.0;
        let distance = |m: &Measured| libm::hypot(m.pixel.x - middle, m.pixel.y - middle);
        let (mut of_line, mut of_city) = (0, 0);
        for line in rows.chunk_by(|(a, _), (b, _)| (a.file, a.line) == (b.file, b.line)) {
            let Some((positive, found)) = line.iter().find(|(p, _)| p.is_positive()) else {
                continue;
            };
            let own = distance(found);
            of_line += u64::from(line.iter().all(|(_, m)| own <= distance(m) + TIE_PX));
            let at = self.plane.at(dataset.panoramas[positive.panorama as usize].position);
            let best = self.tree.nearest_neighbor(at).map(|image| {
                let [x, y] = *image.geom();
                libm::hypot(x - at[0], y - at[1])
            });
            of_city += u64::from(best.is_some_and(|best| own <= best + TIE_PX));
        }
        (of_line, of_city)
    }
}

fn train_test(dataset: &Dataset, rows: &[(&Pair, &Measured)]) -> Option<TrainTest> {
    let of = |split: Split, value: fn(&Pair) -> u32, positives_only: bool| -> HashSet<u32> {
        rows.iter()
            .filter(|(p, _)| dataset.files[p.file as usize].split == split)
            .filter(|(p, _)| p.is_positive() || !positives_only)
            .map(|(p, _)| value(p))
            .collect()
    };
    let sets = |value, positives_only| {
        let [train, test] = [Split::Train, Split::Test].map(|s| of(s, value, positives_only));
        let shared = train.intersection(&test).count() as u64;
        (train, test, shared)
    };
    let (train, test, shared_panoramas) = sets(|p| p.panorama, false);
    if train.is_empty() || test.is_empty() {
        return None;
    }
    let (train_images, test_images, shared_satellites) = sets(|p| p.satellite, false);
    let (train_positives, test_positives, shared_positives) = sets(|p| p.satellite, true);
    let area = |images: &HashSet<u32>| Cover::of(&rectangles(dataset, images)).union_area();
    let (a, b) = (area(&train_positives), area(&test_positives));
    let both = area(&train_positives.union(&test_positives).copied().collect());
    Some(TrainTest {
        train_panoramas: train.len() as u64,
        test_panoramas: test.len() as u64,
        shared_panoramas,
        train_satellites: train_images.len() as u64,
        test_satellites: test_images.len() as u64,
        shared_satellites,
        train_positives: train_positives.len() as u64,
        test_positives: test_positives.len() as u64,
        shared_positives,
        test_ground_in_training: (b > 0.0).then(|| ((a + b - both) / b).clamp(0.0, 1.0)),
    })
}

/// Footprints in EPSG:3857, in the order of the images' numbers: sums must not depend on hashing.
fn rectangles(dataset: &Dataset, images: &HashSet<u32>) -> Vec<Rectangle> {
    let mut sorted: Vec<u32> = images.iter().copied().collect();
    sorted.sort_unstable();
    sorted.iter().map(|i| footprint(&dataset.satellites[*i as usize].grid)).collect()
}

/// Footprint of an image in EPSG:3857, metres.
fn footprint(grid: &ImageGrid) -> Rectangle {
    let north_west = grid.mercator(PixelPoint { x: 0.0, y: 0.0 });
    let corner = PixelPoint { x: f64::from(grid.width()), y: f64::from(grid.height()) };
    let south_east = grid.mercator(corner);
    Rectangle { x0: north_west.x, y0: south_east.y, x1: south_east.x, y1: north_west.y }
}

/// How a city's images overlap; `None` if it has none.
#[must_use]
pub fn of_overlap(dataset: &Dataset, city: u32) -> Option<OverlapStatistics> {
    let grids: Vec<&ImageGrid> =
        dataset.satellites.iter().filter(|s| s.city == city).map(|s| &s.grid).collect();
    let cover = Cover::of(&grids.iter().map(|grid| footprint(grid)).collect::<Vec<_>>());
    let mean_images = cover.mean_depth()?;
    let latitudes: Vec<f64> = grids.iter().map(|grid| grid.center().lat_deg).collect();
    let mean_latitude = pairwise_sum(&latitudes) / latitudes.len() as f64;
    let zoom = dataset.size().zoom;
    let [east, north] = ground_pixel_size(mean_latitude, zoom);
    let pixel = footprint(grids[0]);
    let pixel_m = (pixel.x1 - pixel.x0) / f64::from(dataset.size().pixels);
    Some(OverlapStatistics {
        images: grids.len() as u64,
        mean_images,
        share_at_least: (1..=MAX_DEPTH).filter_map(|k| cover.share_at_least(k)).collect(),
        union_km2: cover.union_area() / (pixel_m * pixel_m) * east * north / 1e6,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn percentiles_are_numpys() {
        // numpy.percentile([1, 2, 3, 4, 10], 95) is 8.8, of [7] it is 7.
        let d = Distribution::of(vec![10.0, 1.0, 3.0, 2.0, 4.0]).expect("values");
        assert_eq!((d.count, d.mean, d.max), (5, 4.0, 10.0));
        assert!((d.p95 - 8.8).abs() < 1e-12);
        let one = Distribution::of(vec![7.0]).expect("a value");
        assert_eq!((one.mean, one.p95, one.max), (7.0, 7.0, 7.0));
        assert_eq!(Distribution::of(Vec::new()), None);
    }

    proptest! {
        #[test]
        fn the_order_of_values_does_not_matter(mut values in prop::collection::vec(0.0..1e3_f64, 1..300)) {
            let a = Distribution::of(values.clone()).expect("values");
            values.reverse();
            prop_assert_eq!(Distribution::of(values), Some(a));
            prop_assert!(a.p95 <= a.max && a.mean <= a.max);
        }
    }
}
