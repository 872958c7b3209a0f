//! Which tiles an image may touch: true footprints in an R-tree.

use super::{Lattice, LatticeWindow};
use crate::crs::{CrsError, Projection};
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use geo::{Coord, Intersects, LineString, Polygon};
use rstar::{AABB, RTree, RTreeObject};

/// Points along each edge of a footprint: a State Plane tile of 10 km bends by under a millimetre
/// between them.
const EDGE_POINTS: u32 = 16;

/// A tile's outline on the ground, WGS 84 degrees, edges densified.
#[derive(Clone, Debug)]
pub struct TileFootprint {
    /// Number of the tile.
    pub tile: usize,
    polygon: Polygon<f64>,
    envelope: AABB<[f64; 2]>,
}

impl TileFootprint {
    /// The outline of a window of a lattice.
    ///
    /// # Errors
    /// The tile reaches where the projection is undefined.
    pub fn new(
        tile: usize,
        lattice: &Lattice,
        window: LatticeWindow,
        projection: &dyn Projection,
    ) -> Result<Self, CrsError> {
        let (west, east) = (window.col as f64, window.right() as f64);
        let (north, south) = (window.row as f64, window.bottom() as f64);
        let ring = outline(|u, v| {
            projection.inverse(lattice.position(PixelPoint {
                x: west + u * (east - west),
                y: north + v * (south - north),
            }))
        })?;
        Ok(Self::from_ring(tile, ring))
    }

    /// The outline of an image.
    #[must_use]
    pub fn of_image(grid: &ImageGrid) -> Self {
        let (width, height) = (f64::from(grid.width()), f64::from(grid.height()));
        // Parallels and meridians are straight in Web Mercator: its corners are its outline.
        let corner = |u: f64, v: f64| {
            let at = grid.lonlat(PixelPoint { x: u * width, y: v * height });
            Coord { x: at.lon_deg, y: at.lat_deg }
        };
        let ring = vec![corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)];
        Self::from_ring(usize::MAX, ring)
    }

    fn from_ring(tile: usize, ring: Vec<Coord<f64>>) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for c in &ring {
            low = [low[0].min(c.x), low[1].min(c.y)];
            high = [high[0].max(c.x), high[1].max(c.y)];
        }
        Self {
            tile,
            polygon: Polygon::new(LineString::new(ring), vec![]),
            envelope: AABB::from_corners(low, high),
        }
    }

    /// West, south, east, north, degrees.
    #[must_use]
    pub fn bounds(&self) -> [f64; 4] {
        let (low, high) = (self.envelope.lower(), self.envelope.upper());
        [low[0], low[1], high[0], high[1]]
    }

    /// The outline as longitude, latitude pairs, closed.
    #[must_use]
    pub fn ring(&self) -> Vec<LonLat> {
        self.polygon.exterior().coords().map(|c| LonLat { lon_deg: c.x, lat_deg: c.y }).collect()
    }
}

fn outline(at: impl Fn(f64, f64) -> Result<LonLat, CrsError>) -> Result<Vec<Coord<f64>>, CrsError> {
    let mut ring = Vec::with_capacity(4 * EDGE_POINTS as usize);
    for edge in 0..4 {
        for k in 0..EDGE_POINTS {
            let t = f64::from(k) / f64::from(EDGE_POINTS);
            let (u, v) = match edge {
                0 => (t, 0.0),
                1 => (1.0, t),
                2 => (1.0 - t, 1.0),
                _ => (0.0, 1.0 - t),
            };
            let p = at(u, v)?;
            ring.push(Coord { x: p.lon_deg, y: p.lat_deg });
        }
    }
    Ok(ring)
}

impl RTreeObject for TileFootprint {
    type Envelope = AABB<[f64; 2]>;

    fn envelope(&self) -> Self::Envelope {
        self.envelope
    }
}

/// Footprints of all tiles, for finding those that an image touches.
#[derive(Debug)]
pub struct TileIndex {
    tree: RTree<TileFootprint>,
}

impl TileIndex {
    /// Builds the index in one go.
    #[must_use]
    pub fn new(footprints: Vec<TileFootprint>) -> Self {
        Self { tree: RTree::bulk_load(footprints) }
    }

    /// Numbers of the tiles whose outline meets the image's, ascending.
    #[must_use]
    pub fn touching(&self, grid: &ImageGrid) -> Vec<usize> {
        let image = TileFootprint::of_image(grid);
        let mut tiles: Vec<usize> = self
            .tree
            .locate_in_envelope_intersecting(image.envelope)
            .filter(|tile| tile.polygon.intersects(&image.polygon))
            .map(|tile| tile.tile)
            .collect();
        tiles.sort_unstable();
        tiles
    }

    /// West, south, east, north of all tiles, degrees; `None` without tiles.
    #[must_use]
    pub fn bounds(&self) -> Option<[f64; 4]> {
        self.tree
            .iter()
            .map(TileFootprint::bounds)
            .reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])])
    }
}
