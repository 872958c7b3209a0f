//! A simulated scene in memory: what studies compare with.

use super::TradeoffError;
use crate::crs::{CrsSpec, Projection, ResolveOptions, resolve};
use crate::grid::ImageGrid;
use crate::lidar::{Lattice, LatticeWindow, PHASE_BITS, WindowSource};
use crate::raster::RasterError;
use crate::scene::frame::LIDAR_CRS;
use crate::scene::lidar::{Layer, Survey, tiles};
use crate::scene::object::Epoch;
use crate::scene::pixels::PixelPositions;
use crate::scene::{Options, Scene, SceneSpec};
use crate::units::US_SURVEY_FOOT_M;
use rayon::prelude::*;
use std::sync::Arc;

/// Zoom of the satellite images.
pub(super) const ZOOM: u8 = 20;
/// Pixels of their sides.
pub(super) const SIDE: u32 = 640;

/// A part of a city with one noiseless lidar tile, and an image in its middle.
pub(super) struct Place {
    pub scene: Scene,
    pub tile: MemoryTile,
    pub lattice: Lattice,
    pub projection: Arc<dyn Projection>,
}

/// One lidar tile in memory, heights in US survey feet.
pub(super) struct MemoryTile {
    window: LatticeWindow,
    feet: Vec<f32>,
}

impl WindowSource for MemoryTile {
    fn extent(&self) -> LatticeWindow {
        self.window
    }

    fn read(
        &self,
        window: LatticeWindow,
        out: &mut [f32],
        ids: Option<&mut [u16]>,
    ) -> Result<(), RasterError> {
        let Some(part) = self.window.intersection(&window) else { return Ok(()) };
        let place = |row: i64, col: i64, of: &LatticeWindow| {
            (row - of.row) as usize * of.width + (col - of.col) as usize
        };
        for row in part.row..part.bottom() {
            let (to, from) = (place(row, part.col, &window), place(row, part.col, &self.window));
            out[to..to + part.width].copy_from_slice(&self.feet[from..from + part.width]);
        }
        if let Some(ids) = ids {
            for row in part.row..part.bottom() {
                ids[place(row, part.col, &window)..][..part.width].fill(0);
            }
        }
        Ok(())
    }
}

/// The scene of most studies: some blocks of a city, nothing but its shape.
pub(super) fn spec(metres: f64) -> SceneSpec {
    let mut spec = SceneSpec { name: "tradeoff".into(), seed: 7, ..SceneSpec::default() };
    spec.extent.width_metres = metres;
    spec.extent.height_metres = metres;
    spec.terrain.relief_metres = 5.0;
    spec.terrain.slope_percent = 2.0;
    spec
}

impl Place {
    /// Lays the scene out and samples its tile.
    ///
    /// # Errors
    /// Those of the scene and of its CRS.
    pub(super) fn new() -> Result<Self, TradeoffError> {
        let scene = Scene::new(spec(200.0), &Options::default())?;
        let tile = tiles(&scene)[0];
        let geotransform = tile.geotransform(&scene);
        let (lattice, col, row) = Lattice::of(&geotransform, PHASE_BITS).ok_or_else(|| {
            TradeoffError::Input("a simulated tile that is not north-up".to_owned())
        })?;
        let (width, height) = (tile.width as usize, tile.height as usize);
        let feet = Survey::new(&scene).rows(Layer::Dsm, &tile, 0..tile.height);
        let crs = CrsSpec::from_user_input(&format!("EPSG:{LIDAR_CRS}"))?;
        let at = scene.frame.to_lonlat(0.0, 0.0)?;
        let area = [at.lon_deg, at.lat_deg, at.lon_deg, at.lat_deg];
        let options = ResolveOptions { area: Some(area), ..ResolveOptions::default() };
        let projection = resolve(&crs, &options)?.projection;
        let window = LatticeWindow { col, row, width, height };
        Ok(Self { scene, tile: MemoryTile { window, feet }, lattice, projection })
    }

    /// An image of `side` pixels in the middle.
    ///
    /// # Errors
    /// As [`ImageGrid::new`].
    pub(super) fn image(&self, zoom: u8, side: u32) -> Result<ImageGrid, TradeoffError> {
        let at = self.scene.frame.to_lonlat(0.0, 0.0)?;
        Ok(ImageGrid::new(at, zoom, side, side).map_err(crate::scene::SceneError::from)?)
    }

    /// True heights at an image's pixel centres, metres.
    ///
    /// # Errors
    /// As [`PixelPositions::new`].
    pub(super) fn heights(&self, grid: &ImageGrid) -> Result<Vec<f32>, TradeoffError> {
        let pixels = PixelPositions::new(grid, &self.scene.frame, 0)?;
        Ok(heights(&self.scene, &pixels))
    }

    /// True mean heights of an image's pixels, each from `parts * parts` points, metres; `parts` is a power
    /// of two.
    ///
    /// # Errors
    /// As [`PixelPositions::new`].
    pub(super) fn means(&self, zoom: u8, side: u32, parts: u32) -> Result<Vec<f32>, TradeoffError> {
        let fine = self.image(zoom + parts.trailing_zeros() as u8, side * parts)?;
        Ok(block_means(&self.heights(&fine)?, (side * parts) as usize, parts as usize))
    }
}

/// True heights at positions, metres.
pub(super) fn heights(scene: &Scene, pixels: &PixelPositions) -> Vec<f32> {
    let [_, rows] = pixels.size();
    let row = |row| {
        let points = pixels.row(row).iter();
        points.map(|p| scene.surface(Epoch::Image, p[0], p[1]).height as f32)
    };
    (0..rows).into_par_iter().flat_map_iter(row).collect()
}

/// Means over blocks of `parts * parts` values of a square raster `side` wide.
pub(super) fn block_means(values: &[f32], side: usize, parts: usize) -> Vec<f32> {
    let to = side / parts;
    let share = 1.0 / (parts * parts) as f64;
    (0..to * to)
        .map(|k| {
            let corner = k / to * parts * side + k % to * parts;
            let lines = (0..parts).map(|r| &values[corner + r * side..][..parts]);
            let sum: f64 = lines.flatten().map(|v| f64::from(*v)).sum();
            (sum * share) as f32
        })
        .collect()
}

/// Root of the mean square of differences, over the pixels that both have.
pub(super) fn rms(a: &[f32], b: &[f32]) -> f64 {
    let (mut sum, mut count) = (0.0, 0_u64);
    for (a, b) in a.iter().zip(b) {
        let apart = f64::from(*a) - f64::from(*b);
        if !apart.is_nan() {
            sum += apart * apart;
            count += 1;
        }
    }
    (sum / count as f64).sqrt()
}

/// The value that a share of the absolute differences does not exceed, over the pixels that both have.
pub(super) fn quantile(a: &[f32], b: &[f32], share: f64) -> f64 {
    let mut apart: Vec<f64> = (a.iter().zip(b))
        .map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs())
        .filter(|apart| !apart.is_nan())
        .collect();
    apart.sort_unstable_by(f64::total_cmp);
    let place = (apart.len().saturating_sub(1)) as f64 * share;
    apart.get(place.round() as usize).copied().unwrap_or(f64::NAN)
}

/// Metres of a US survey foot, the unit of simulated tiles.
pub(super) const FOOT_M: f64 = US_SURVEY_FOOT_M;
