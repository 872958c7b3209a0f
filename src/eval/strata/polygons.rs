//! Polygons with classes on the Web-Mercator plane, found by an R-tree.

use super::NO_CLASS;
use super::fill::fill;
use crate::crs::CrsError;
use crate::grid::{ImageGrid, PixelPoint, Projected};
use rstar::{AABB, RTree, RTreeObject};

/// How far an edge may lie from the true course of a straight line of the file's CRS, metres of
/// EPSG:3857: under a hundredth of a pixel up to zoom 21 (0.0067 px).
pub(super) const DEVIATION_M: f64 = 5e-4;
/// Edges longer than this, in EPSG:3857 metres, are looked at in three places, because a long line
/// may bend both ways.
const LONG_M: f64 = 1000.0;
/// An edge is cut in two at most this many times over.
const MAX_CUTS: u32 = 20;

/// A polygon, its vertices in EPSG:3857 metres.
#[derive(Clone, Debug)]
pub(super) struct ClassPolygon {
    /// Number of the class.
    pub class: u16,
    /// Rank: later ones win.
    pub order: usize,
    /// Closed rings.
    pub rings: Vec<Vec<[f64; 2]>>,
}

#[derive(Debug)]
struct Entry {
    polygon: ClassPolygon,
    envelope: AABB<[f64; 2]>,
}

impl RTreeObject for Entry {
    type Envelope = AABB<[f64; 2]>;

    fn envelope(&self) -> Self::Envelope {
        self.envelope
    }
}

/// All polygons of a mask.
#[derive(Debug)]
pub(super) struct PolygonSet {
    tree: RTree<Entry>,
}

impl PolygonSet {
    pub fn new(polygons: Vec<ClassPolygon>) -> Self {
        let entries = polygons.into_iter().map(|polygon| {
            let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
            for [x, y] in polygon.rings.iter().flatten() {
                low = [low[0].min(*x), low[1].min(*y)];
                high = [high[0].max(*x), high[1].max(*y)];
            }
            Entry { polygon, envelope: AABB::from_corners(low, high) }
        });
        Self { tree: RTree::bulk_load(entries.collect()) }
    }

    /// Writes the class of every pixel whose centre lies in a polygon; where several do, of the
    /// last.
    pub fn paint(&self, grid: &ImageGrid, classes: &mut [u16]) {
        let (width, height) = (grid.width() as usize, grid.height() as usize);
        let at = |x: f64, y: f64| grid.mercator(PixelPoint { x, y });
        let (low, high) = (at(0.0, height as f64), at(width as f64, 0.0));
        let envelope = AABB::from_corners([low.x, low.y], [high.x, high.y]);
        let mut found: Vec<&ClassPolygon> = self
            .tree
            .locate_in_envelope_intersecting(envelope)
            .map(|entry| &entry.polygon)
            .collect();
        found.sort_by_key(|polygon| polygon.order);
        let transform = grid.geotransform();
        let mut crossings = Vec::new();
        for polygon in found {
            let rings: Vec<Vec<[f64; 2]>> = polygon
                .rings
                .iter()
                .map(|ring| {
                    let pixel = |[x, y]: &[f64; 2]| {
                        let p = transform.to_pixel(Projected { x: *x, y: *y });
                        [p.x, p.y]
                    };
                    ring.iter().map(pixel).collect()
                })
                .collect();
            let rings = rings.iter().map(Vec::as_slice);
            fill(rings, (width, height), &mut crossings, |y, from, to| {
                classes[y * width + from..y * width + to].fill(polygon.class);
            });
        }
    }
}

/// All pixels in no class.
pub(super) fn nothing(grid: &ImageGrid) -> Vec<u16> {
    vec![NO_CLASS; grid.width() as usize * grid.height() as usize]
}

/// A ring of the file's CRS on the plane, its edges cut until they deviate by less than
/// [`DEVIATION_M`] from the straight lines of that CRS.
///
/// # Errors
/// A vertex, by number, that cannot be placed.
pub(super) fn densify(
    ring: &[[f64; 2]],
    place: &impl Fn([f64; 2]) -> Result<[f64; 2], CrsError>,
) -> Result<Vec<[f64; 2]>, (usize, CrsError)> {
    let mut out: Vec<[f64; 2]> = Vec::with_capacity(ring.len());
    let mut before: Option<([f64; 2], [f64; 2])> = None;
    for (number, vertex) in ring.iter().enumerate() {
        let placed = place(*vertex).map_err(|error| (number, error))?;
        if let Some(before) = before {
            cut(before, (*vertex, placed), place, MAX_CUTS, &mut out)
                .map_err(|error| (number, error))?;
        }
        out.push(placed);
        before = Some((*vertex, placed));
    }
    Ok(out)
}

/// Adds the points between two vertices, each given in the file's CRS and on the plane.
fn cut(
    a: ([f64; 2], [f64; 2]),
    b: ([f64; 2], [f64; 2]),
    place: &impl Fn([f64; 2]) -> Result<[f64; 2], CrsError>,
    cuts: u32,
    out: &mut Vec<[f64; 2]>,
) -> Result<(), CrsError> {
    if cuts == 0 {
        return Ok(());
    }
    let between =
        |a: [f64; 2], b: [f64; 2], t: f64| [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
    let middle = between(a.0, b.0, 0.5);
    let placed = place(middle)?;
    let deviation = |placed: [f64; 2], t: f64| {
        let chord = between(a.1, b.1, t);
        libm::hypot(placed[0] - chord[0], placed[1] - chord[1])
    };
    let mut worst = deviation(placed, 0.5);
    if libm::hypot(a.1[0] - b.1[0], a.1[1] - b.1[1]) > LONG_M {
        for t in [0.25, 0.75] {
            worst = worst.max(deviation(place(between(a.0, b.0, t))?, t));
        }
    }
    if worst <= DEVIATION_M {
        return Ok(());
    }
    cut(a, (middle, placed), place, cuts - 1, out)?;
    out.push(placed);
    cut((middle, placed), b, place, cuts - 1, out)
}
