//! 3D Tiles 1.1 (OGC 22-025r4): the city as a tree of tiles, coarse ones first, at its place on Earth.
//!
//! A quadtree over the tiles of the surface ([`super::surface`]). **Level 0** is the finest: one tile of
//! 256 x 256 model pixels, simplified to the error asked for. A tile of **level k** covers 2^k x 2^k of them: its
//! four children's meshes joined, and simplified to 2^k times that error. It replaces its children when the
//! camera is far enough.
//!
//! **No cracks.** A simplification keeps the open edges of its mesh with all their vertices, so the border
//! between two tiles is the same line at every level, and stays until both lie in one tile. Positions are whole
//! multiples of [`Tiles3dSummary::step_m`], a power of two, and so is the middle of a tile from which its file
//! counts: their sum is exact, so that a vertex on a border has the same bits in the tiles on both sides, however
//! far the Earth's centre.
//!
//! **Errors.** The distance between a mesh and the one it was made from is measured, and a tile's error is
//! the sum down to the whole surface: its own and the largest of its children's.
//!
//! Tiles are made depth first, over all cores, and each is written and forgotten but for the mesh and the picture
//! that its parent is made of: memory is some meshes per level and core, whatever the area.

mod content;
mod texture;
mod tileset;
mod tree;

use super::frame::LocalFrame;
use super::slabs::Slabs;
use super::surface::TileIndex;
use super::surface::simplify::SimplifyError;
use super::surface::store::{StoreError, SurfaceStore};
use crate::batch::{AtomicFolder, Interrupt, Progress};
use crate::plan::runs;
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// Name of the file that a viewer opens.
pub const TILESET: &str = "tileset.json";

/// What of 3D Tiles can be chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tiles3dOptions {
    /// Largest distance between the finest tiles and the whole surface, metres.
    pub error_m: f64,
}

impl Default for Tiles3dOptions {
    /// A quarter of a metre: about a pixel of the model.
    fn default() -> Self {
        Self { error_m: 0.25 }
    }
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tiles3dSummary {
    /// Tiles of each level, the finest first.
    pub tiles: Vec<u64>,
    /// Triangles of each level, the finest first.
    pub triangles: Vec<u64>,
    /// Largest geometric error of each level, metres, the finest first.
    pub error_m: Vec<f64>,
    /// Positions are multiples of this, metres.
    pub step_m: f64,
    /// Bytes of all files.
    pub bytes: u64,
}

/// Why 3D Tiles are not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Tiles3dError {
    /// The error is no length.
    #[error("an error of {0} m for the finest tiles; it must be a number above 0")]
    ErrorM(f64),
    /// There is no triangle.
    #[error("the city has no surface: no density reaches the isovalue; try a lower one")]
    Empty,
    /// Something else stands where the folder should.
    #[error("{} {reason}", path.display())]
    Occupied {
        /// The place.
        path: PathBuf,
        /// What is there, and what to do.
        reason: String,
    },
    /// A tile of the surface is not read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A mesh is not simplified.
    #[error("tile {column} of row {row} at level {level}: {source}")]
    Simplify {
        /// Level, 0 the finest.
        level: u32,
        /// Row of tiles.
        row: u32,
        /// Column of tiles.
        column: u32,
        /// Why.
        source: SimplifyError,
    },
    /// A tile is too large for a file, or its picture cannot be stored.
    #[error("tile {column} of row {row} at level {level}: {reason}")]
    Content {
        /// Level, 0 the finest.
        level: u32,
        /// Row of tiles.
        row: u32,
        /// Column of tiles.
        column: u32,
        /// Why.
        reason: String,
    },
    /// Reading colours or writing failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder that was read or written.
        path: PathBuf,
        /// What the system says, with the file's name.
        source: io::Error,
    },
    /// Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
}

impl Tiles3dError {
    fn io(path: &Path) -> impl Fn(io::Error) -> Self {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}

/// A tile of the tree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Node {
    /// 0 is the finest.
    level: u32,
    /// Which tile of the level.
    index: TileIndex,
}

impl Node {
    /// The four tiles of the next finer level: north-west, north-east, south-west, south-east.
    fn children(self) -> [Self; 4] {
        let TileIndex { row, column } = self.index;
        [[0, 0], [0, 1], [1, 0], [1, 1]].map(|[down, right]| Self {
            level: self.level - 1,
            index: TileIndex { row: 2 * row + down, column: 2 * column + right },
        })
    }

    fn file(self) -> String {
        let Self { level, index: TileIndex { row, column } } = self;
        format!("tiles/{level}/{row}/{column}.glb")
    }
}

/// Levels of the tree over so many columns and rows of finest tiles.
fn levels([columns, rows]: [u32; 2]) -> u32 {
    columns.max(rows).max(1).next_power_of_two().trailing_zeros() + 1
}

/// Number of tiles of the finest level that [`write_tiles3d`] makes and counts as progress.
///
/// # Errors
/// [`StoreError`].
pub fn finest_tiles(slabs: &Slabs<'_>) -> Result<usize, StoreError> {
    Ok(SurfaceStore::open(slabs)?.tiles().len())
}

/// Writes a finished run as 3D Tiles into the folder `out`, which appears whole or not at all; older 3D Tiles
/// there are replaced. The same run gives the same bytes, for any number of threads. `progress` counts
/// tiles of the finest level ([`finest_tiles`]).
///
/// # Errors
/// [`Tiles3dError`].
pub fn write_tiles3d(
    slabs: &Slabs<'_>,
    frame: &LocalFrame,
    options: &Tiles3dOptions,
    out: &Path,
    progress: &Progress,
    interrupt: &Interrupt,
) -> Result<Tiles3dSummary, Tiles3dError> {
    write_cut(slabs, frame, options, out, progress, interrupt, tree::LEVELS_PER_FILE)
}

/// [`write_tiles3d`] with so many levels in one file.
fn write_cut(
    slabs: &Slabs<'_>,
    frame: &LocalFrame,
    options: &Tiles3dOptions,
    out: &Path,
    progress: &Progress,
    interrupt: &Interrupt,
    levels_per_file: u32,
) -> Result<Tiles3dSummary, Tiles3dError> {
    if !(options.error_m > 0.0 && options.error_m.is_finite()) {
        return Err(Tiles3dError::ErrorM(options.error_m));
    }
    runs("tiles3d");
    runs("colour");
    check_target(out)?;
    let store = SurfaceStore::open(slabs)?;
    if store.tiles().len() == 0 {
        return Err(Tiles3dError::Empty);
    }
    let folder = AtomicFolder::create(out).map_err(Tiles3dError::io(out))?;
    let mut forest = tree::Forest::new(&store, frame, options, &folder, progress, interrupt);
    forest.levels_per_file = levels_per_file;
    let root = forest.build()?.ok_or(Tiles3dError::Empty)?;
    let document = tileset::document(slabs.city, frame, options, forest.step_m(), &root);
    let bytes = tileset::text(&document);
    folder.write(TILESET, &bytes).map_err(Tiles3dError::io(out))?;
    let summary = root.summary(forest.step_m(), bytes.len() as u64);
    folder.commit().map_err(Tiles3dError::io(out))?;
    Ok(summary)
}

/// Only older 3D Tiles may stand where new ones will.
fn check_target(target: &Path) -> Result<(), Tiles3dError> {
    let occupied = |reason: &str| {
        Err(Tiles3dError::Occupied { path: target.to_owned(), reason: reason.to_owned() })
    };
    if target.file_name().is_none() {
        return occupied("is no name for a folder");
    }
    let Ok(metadata) = std::fs::metadata(target) else { return Ok(()) };
    if !metadata.is_dir() {
        return occupied("is a file; 3D Tiles are a folder: give another name or remove it");
    }
    let empty = std::fs::read_dir(target).is_ok_and(|mut entries| entries.next().is_none());
    if empty || target.join(TILESET).is_file() {
        return Ok(());
    }
    occupied("is a folder that holds no 3D Tiles; give another name or remove it")
}

#[cfg(test)]
pub(crate) mod test_city;
#[cfg(test)]
mod tests;
