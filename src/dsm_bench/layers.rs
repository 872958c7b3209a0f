//! How several tiles make one DSM: each by itself, or joined where they share a lattice.

use super::tiles::Tile;
use crate::lidar::{Lattice, LatticeWindow, TileStore, WindowSource};
use crate::raster::RasterError;
use serde::{Deserialize, Serialize};
use std::cell::RefCell;

/// How several tiles make one DSM.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Coverage {
    /// The tile with the most valid pixels (Algorithm 1 of the paper); ties go to the first.
    BestTile,
    /// Tiles on one lattice act as one raster, so that interpolation crosses their borders; tiles
    /// off that lattice fill what is left, by rank.
    Mosaic,
}

impl Coverage {
    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::BestTile => "best-tile",
            Self::Mosaic => "mosaic",
        }
    }
}

/// Tiles that act as one raster: one CRS, one lattice. In rank order.
#[derive(Clone, Debug)]
pub struct Layer {
    crs: usize,
    lattice: Lattice,
    tiles: Vec<usize>,
}

impl Layer {
    /// One layer per tile, or one per lattice, in the rank order of their first tiles.
    pub fn group(tiles: &[Tile], coverage: Coverage) -> Vec<Self> {
        let mut layers: Vec<Self> = Vec::new();
        for (number, tile) in tiles.iter().enumerate() {
            let joined = match coverage {
                Coverage::BestTile => None,
                Coverage::Mosaic => {
                    layers.iter_mut().find(|l| l.crs == tile.crs && l.lattice == tile.lattice)
                }
            };
            match joined {
                Some(layer) => layer.tiles.push(number),
                None => {
                    let tiles = vec![number];
                    layers.push(Self { crs: tile.crs, lattice: tile.lattice, tiles });
                }
            }
        }
        layers
    }
}

/// A layer reduced to the candidates of one image, ready to be read.
pub struct LayerSource<'a> {
    /// Number of its CRS.
    pub crs: usize,
    /// Its lattice.
    pub lattice: Lattice,
    /// Its tiles that the image may touch, by rank.
    pub members: Vec<usize>,
    tiles: &'a [Tile],
    store: &'a TileStore,
    scratch: RefCell<Vec<f32>>,
}

impl<'a> LayerSource<'a> {
    /// Layers with at least one candidate, in rank order.
    pub fn of_candidates(
        layers: &[Layer],
        candidates: &[usize],
        tiles: &'a [Tile],
        store: &'a TileStore,
    ) -> Vec<Self> {
        layers
            .iter()
            .filter_map(|layer| {
                let members: Vec<usize> =
                    layer.tiles.iter().copied().filter(|tile| candidates.contains(tile)).collect();
                (!members.is_empty()).then(|| Self {
                    crs: layer.crs,
                    lattice: layer.lattice,
                    members,
                    tiles,
                    store,
                    scratch: RefCell::default(),
                })
            })
            .collect()
    }
}

impl WindowSource for LayerSource<'_> {
    fn extent(&self) -> LatticeWindow {
        let windows = || self.members.iter().map(|&tile| self.tiles[tile].window);
        let col = windows().map(|w| w.col).min().unwrap_or(0);
        let row = windows().map(|w| w.row).min().unwrap_or(0);
        let right = windows().map(|w| w.right()).max().unwrap_or(0);
        let bottom = windows().map(|w| w.bottom()).max().unwrap_or(0);
        LatticeWindow { col, row, width: (right - col) as usize, height: (bottom - row) as usize }
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        mut ids: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        out.fill(f32::NAN);
        if let Some(ids) = ids.as_deref_mut() {
            ids.fill(u16::MAX);
        }
        for &number in &self.members {
            let tile = &self.tiles[number];
            let Some(part) = tile.window.intersection(&window) else { continue };
            let mut cells = self.scratch.borrow_mut();
            cells.clear();
            cells.resize(part.width * part.height, f32::NAN);
            let (col, row) = (part.col - tile.window.col, part.row - tile.window.row);
            self.store.read_window(tile.stored, col, row, part.width, part.height, &mut cells)?;
            // The first tile by rank that has a value gives it.
            for (k, line) in cells.chunks_exact(part.width).enumerate() {
                let start = (part.row - window.row) as usize * window.width
                    + k * window.width
                    + (part.col - window.col) as usize;
                let target = &mut out[start..start + part.width];
                match ids.as_deref_mut() {
                    None => {
                        for (target, &value) in target.iter_mut().zip(line) {
                            if target.is_nan() {
                                *target = value;
                            }
                        }
                    }
                    Some(ids) => {
                        let ids = &mut ids[start..start + part.width];
                        for ((target, id), &value) in target.iter_mut().zip(ids).zip(line) {
                            if target.is_nan() && !value.is_nan() {
                                *target = value;
                                *id = number as u16;
                            }
                        }
                    }
                }
            }
        }
        Ok(())
    }
}
