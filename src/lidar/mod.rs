//! Lidar tiles: where they lie, how their blocks are cached, and how they are warped onto an image
//! grid.
//!
//! * [`Lattice`]: the endless pixel lattice that a tile is a window of; tiles on one lattice can act
//!   as one raster.
//! * [`PixelMap`]: image pixel -> lattice coordinate, exactly or by a bounded polynomial.
//! * [`Resampling`] and [`warp()`]: GDAL's resampling rules, NaN-aware.
//! * [`TileIndex`]: footprints in an R-tree.
//! * [`SingleRaster`]: one raster in any CRS, brought onto image grids.
//! * [`TileStore`]: the tiles themselves, read through one bounded block cache.

#[cfg(test)]
mod hard_cases;
mod index;
mod lattice;
mod pixel_map;
mod resample;
mod single;
mod store;
mod warp;

pub use index::{TileFootprint, TileIndex};
pub use lattice::{Lattice, LatticeWindow, PHASE_BITS};
pub use pixel_map::{FitErrors, PixelMap, PixelToCrs, TransformForm};
pub use resample::{EdgeRule, Resampling};
pub use single::{Placement, SingleRaster, SingleRasterError};
pub use store::{CacheStatistics, TileStore};
pub use warp::{WarpError, WarpSettings, WarpStatistics, WindowSource, warp};
