//! The lidar survey: tiles of the surface and of the bare earth, as King County delivers them.
//!
//! All tiles are windows of one lattice of cells, so that neighbours agree where they overlap. A
//! cell's value depends on its place in the lattice alone.

use super::effects::Effect;
use super::error::SceneError;
use super::frame::LIDAR_CRS;
use super::object::{Class, Epoch};
use super::purpose;
use super::spec::{TileCompression, TileSpec, TileStorage};
use super::surface::Scene;
use crate::batch::{Interrupt, Progress};
use crate::grid::GeoTransform;
use crate::plan::runs;
use crate::random::{Draw, key, normal, unit};
use crate::raster::geotiff::{Compression, GeoTiffSpec, GeoTiffWriter, Layout};
use crate::units::{LinearUnit, US_SURVEY_FOOT_M};
use rayon::prelude::*;
use serde::Serialize;
use std::path::Path;

/// Rows that are held in memory at once.
const BAND_ROWS: u32 = 256;
/// Samples along a side of a cell when it is a mean.
const AREA_SAMPLES: u32 = 4;

/// What a tile shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// The highest surface, first returns.
    Dsm,
    /// The bare earth.
    Dtm,
}

impl Layer {
    /// `dsm` or `dtm`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Dsm => "dsm",
            Self::Dtm => "dtm",
        }
    }
}

/// One tile: a window of the lattice.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Tile {
    /// Number in its file name.
    pub number: u32,
    /// Column of its westernmost cells; column 0 begins at the frame's origin.
    pub column: i64,
    /// Row of its northernmost cells; row 0 ends at the frame's origin, rows count to the south.
    pub row: i64,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// The tiles of a scene: together they cover its extent.
#[must_use]
pub fn tiles(scene: &Scene) -> Vec<Tile> {
    let (spec, extent) = (&scene.spec.tiles, &scene.spec.extent);
    let cell = spec.pixel_feet * US_SURVEY_FOOT_M;
    let half = |metres: f64| (metres / 2.0 / cell).ceil() as i64;
    let (half_w, half_h) = (half(extent.width_metres), half(extent.height_metres));
    let (width, step_x) = cut(2 * half_w, spec.columns, spec.overlap_pixels);
    let (height, step_y) = cut(2 * half_h, spec.rows, spec.overlap_pixels);
    let mut tiles = Vec::new();
    for j in 0..i64::from(spec.rows) {
        for i in 0..i64::from(spec.columns) {
            // Numbers run from west to east, then from south to north.
            let from_north = i64::from(spec.rows) - 1 - j;
            tiles.push(Tile {
                number: spec.first_number + tiles.len() as u32,
                column: -half_w + i * step_x,
                row: -half_h + from_north * step_y,
                width,
                height,
            });
        }
    }
    tiles
}

/// Size of one of `count` windows that share `overlap` cells and cover `cells`, and their distance.
fn cut(cells: i64, count: u32, overlap: u32) -> (u32, i64) {
    let (count, overlap) = (i64::from(count), i64::from(overlap));
    let size = (cells + (count - 1) * overlap + count - 1) / count;
    // An overlap wider than the tile would never come to an end of the scene.
    let size = size.max(overlap + 1);
    (size as u32, size - overlap)
}

impl Tile {
    /// The grid of the tile in EPSG:2927, US survey feet.
    #[must_use]
    pub fn geotransform(&self, scene: &Scene) -> GeoTransform {
        let [x, y] = scene.frame.origin_feet();
        let pixel = scene.spec.tiles.pixel_feet;
        GeoTransform::north_up(
            x + self.column as f64 * pixel,
            y - self.row as f64 * pixel,
            pixel,
            pixel,
        )
    }

    /// Name of its file.
    #[must_use]
    pub fn file_name(&self, scene: &Scene, layer: Layer) -> String {
        format!("king_county_west_{}_{}_{}.tif", scene.spec.lidar.year, layer.name(), self.number)
    }
}

/// The survey of a scene: what each cell of the lattice holds.
#[derive(Debug)]
pub struct Survey<'a> {
    scene: &'a Scene,
    cell_m: f64,
    noise_m: f64,
    missing: f64,
    penetration: f64,
    area: bool,
    /// Middles of the gaps, metres east of the origin.
    gaps: Vec<f64>,
}

/// Gaps follow flight lines, which lean a little: metres east per metre north.
const FLIGHT_LEAN: f64 = 0.08;

impl<'a> Survey<'a> {
    /// The survey that the scene's plan calls for.
    #[must_use]
    pub fn new(scene: &'a Scene) -> Self {
        let (lidar, extent) = (&scene.spec.lidar, &scene.spec.extent);
        let when = |effect, value: f64| if scene.effects.runs(effect) { value } else { 0.0 };
        let gaps = if scene.effects.runs(Effect::Gaps) { lidar.gap_count } else { 0 };
        Self {
            scene,
            cell_m: scene.spec.tiles.pixel_feet * US_SURVEY_FOOT_M,
            noise_m: when(Effect::Noise, lidar.noise_sigma_metres),
            missing: when(Effect::MissingPulses, lidar.missing_pulse_share),
            penetration: when(Effect::CrownPenetration, lidar.crown_penetration_share),
            area: scene.effects.runs(Effect::AreaSampling) && scene.spec.samples_areas(),
            gaps: (0..gaps)
                .map(|k| {
                    let mut draw = Draw::new(&[scene.spec.seed, purpose::GAPS, u64::from(k)]);
                    let share = (f64::from(k) + draw.range(0.2, 0.8)) / f64::from(gaps) - 0.5;
                    share * extent.width_metres
                })
                .collect(),
        }
    }

    /// Height of a cell in metres; `None` where the survey has none.
    #[must_use]
    pub fn height(&self, layer: Layer, column: i64, row: i64) -> Option<f64> {
        let x = (column as f64 + 0.5) * self.cell_m;
        let y = -(row as f64 + 0.5) * self.cell_m;
        let half_gap = self.scene.spec.lidar.gap_width_metres / 2.0;
        if self.gaps.iter().any(|gap| (x - gap - FLIGHT_LEAN * y).abs() < half_gap) {
            return None;
        }
        let lot = |purpose: u64| {
            key(&[self.scene.spec.seed, purpose, column.cast_unsigned(), row.cast_unsigned()])
        };
        let (z, noise_seed) = match layer {
            Layer::Dtm => {
                let ground = self.scene.terrain.at(x, y);
                ((!ground.water).then_some(ground.z)?, 1)
            }
            Layer::Dsm => {
                if self.missing > 0.0 && unit(lot(purpose::PULSES)) < self.missing {
                    return None;
                }
                let through =
                    self.penetration > 0.0 && unit(lot(purpose::CROWNS)) < self.penetration;
                (if self.area { self.mean(x, y, through) } else { self.sample(x, y, through) }?, 0)
            }
        };
        if self.noise_m == 0.0 {
            return Some(z);
        }
        Some(z + self.noise_m * normal(lot(purpose::NOISE) ^ noise_seed))
    }

    /// First return at a point, or below the crowns; none over open water.
    fn sample(&self, x: f64, y: f64, through_crowns: bool) -> Option<f64> {
        let ground = self.scene.terrain.at(x, y);
        let keep = |class| !(through_crowns && class == Class::Tree);
        match self.scene.world(Epoch::Lidar).top(x, y, keep) {
            Some((_, z, _)) if z > ground.z => Some(z),
            _ => (!ground.water).then_some(ground.z),
        }
    }

    /// Mean over a cell's points that have a height, if most have.
    fn mean(&self, x: f64, y: f64, through_crowns: bool) -> Option<f64> {
        let n = AREA_SAMPLES;
        let offset = |k: u32| ((f64::from(k) + 0.5) / f64::from(n) - 0.5) * self.cell_m;
        let points = (0..n * n).map(|k| (x + offset(k % n), y + offset(k / n)));
        let (mut sum, mut count) = (0.0, 0_u32);
        for z in points.filter_map(|(px, py)| self.sample(px, py, through_crowns)) {
            sum += z;
            count += 1;
        }
        (2 * count > n * n).then(|| sum / f64::from(count))
    }

    /// Rows of a tile as they are stored: US survey feet, the nodata value where there is no height.
    #[must_use]
    pub fn rows(&self, layer: Layer, tile: &Tile, rows: std::ops::Range<u32>) -> Vec<f32> {
        runs("units");
        let nodata = self.scene.spec.tiles.nodata as f32;
        let width = tile.width as usize;
        let mut out = vec![0.0_f32; width * rows.len()];
        out.par_chunks_mut(width).zip(rows.into_par_iter()).for_each(|(line, row)| {
            for (cell, column) in line.iter_mut().zip(0_i64..) {
                *cell = self
                    .height(layer, tile.column + column, tile.row + i64::from(row))
                    .map_or(nodata, |z| (z / US_SURVEY_FOOT_M) as f32);
            }
        });
        out
    }

    /// Writes a tile, a band of rows at a time.
    ///
    /// # Errors
    /// [`SceneError`] when the file cannot be written, or the run is interrupted.
    pub fn write(
        &self,
        layer: Layer,
        tile: &Tile,
        folder: &Path,
        interrupt: &Interrupt,
        progress: &Progress,
    ) -> Result<(), SceneError> {
        let path = folder.join(tile.file_name(self.scene, layer));
        let mut writer = GeoTiffWriter::create(&path, &self.geotiff(tile))?;
        let mut row = 0;
        while row < tile.height {
            if interrupt.requested() {
                return Err(SceneError::Interrupted);
            }
            let end = (row + BAND_ROWS).min(tile.height);
            writer.write_rows(&self.rows(layer, tile, row..end))?;
            progress.add(u64::from(end - row));
            row = end;
        }
        Ok(writer.finish()?)
    }

    fn geotiff(&self, tile: &Tile) -> GeoTiffSpec {
        let TileSpec { nodata, compression, storage, block_pixels, state_vertical_unit, .. } =
            self.scene.spec.tiles;
        GeoTiffSpec {
            width: tile.width,
            height: tile.height,
            geotransform: tile.geotransform(self.scene),
            epsg: LIDAR_CRS,
            vertical_epsg: None,
            nodata: Some(nodata),
            unit: state_vertical_unit.then_some(LinearUnit::UsSurveyFoot),
            layout: match storage {
                TileStorage::Strips => Layout::Strips(block_pixels),
                TileStorage::Blocks => Layout::Tiles(block_pixels),
            },
            compression: match compression {
                TileCompression::None => Compression::None,
                TileCompression::Deflate => Compression::Deflate,
            },
            metadata: vec![(
                "TIFFTAG_IMAGEDESCRIPTION".to_owned(),
                format!("simulated by sat3d, scene {}", self.scene.spec.name),
            )],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::effects::Options;
    use crate::scene::spec::{SceneSpec, WaterSpec};
    use std::collections::BTreeSet;

    fn scene(change: impl FnOnce(&mut SceneSpec)) -> Scene {
        scene_with(change, &Options::default())
    }

    fn scene_with(change: impl FnOnce(&mut SceneSpec), options: &Options) -> Scene {
        let mut spec = SceneSpec::default();
        spec.extent.width_metres = 90.0;
        spec.extent.height_metres = 70.0;
        change(&mut spec);
        Scene::new(spec, options).expect("a scene")
    }

    fn whole(scene: &Scene, layer: Layer) -> Vec<u32> {
        let tile = Tile { number: 0, column: -90, row: -70, width: 180, height: 140 };
        Survey::new(scene).rows(layer, &tile, 0..140).iter().map(|v| v.to_bits()).collect()
    }

    #[test]
    fn cells_are_point_samples_of_the_truth() {
        let scene = scene(|_| {});
        let survey = Survey::new(&scene);
        for tile in tiles(&scene) {
            let values = survey.rows(Layer::Dsm, &tile, 0..tile.height);
            let grid = tile.geotransform(&scene);
            for (i, value) in values.iter().enumerate().step_by(53) {
                let (row, column) = (i / tile.width as usize, i % tile.width as usize);
                let at = grid.to_projected(crate::grid::PixelPoint {
                    x: column as f64 + 0.5,
                    y: row as f64 + 0.5,
                });
                let [x, y] = scene.frame.from_feet(at);
                let truth = scene.surface(Epoch::Lidar, x, y).height;
                assert!((f64::from(*value) * US_SURVEY_FOOT_M - truth).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn tiles_cover_the_extent_overlap_as_asked_and_agree() {
        let scene = scene(|s| s.lidar.noise_sigma_metres = 0.05);
        let survey = Survey::new(&scene);
        let all = tiles(&scene);
        assert_eq!(all.len(), 4);
        assert_eq!(all.iter().map(|t| t.number).collect::<Vec<_>>(), [87, 88, 89, 90]);
        let (sw, se, nw) = (all[0], all[1], all[2]);
        assert_eq!(sw.column + i64::from(sw.width) - se.column, 48);
        assert_eq!(nw.row + i64::from(nw.height) - sw.row, 48);
        let cell = 1.5 * US_SURVEY_FOOT_M;
        assert!(sw.column as f64 * cell <= -45.0 && nw.row as f64 * cell <= -35.0);
        assert!((se.column + i64::from(se.width)) as f64 * cell >= 45.0);
        let a = survey.rows(Layer::Dsm, &sw, 10..11);
        let b = survey.rows(Layer::Dsm, &se, 10..11);
        assert_eq!(a[a.len() - 48..], b[..48]);
    }

    #[test]
    fn water_has_no_height_but_docks_do() {
        let scene = scene(|s| {
            s.terrain.base_height_metres = 15.0;
            s.water =
                Some(WaterSpec { share: 0.5, docks_per_100_metres: 4.0, ..WaterSpec::default() });
        });
        let survey = Survey::new(&scene);
        let (mut open, mut docks) = (0, 0);
        for row in -60..60 {
            for column in -90..0 {
                let (x, y) =
                    ((column as f64 + 0.5) * survey.cell_m, -(row as f64 + 0.5) * survey.cell_m);
                if scene.terrain.inland(x, y) < 0.0 {
                    assert_eq!(survey.height(Layer::Dtm, column, row), None);
                    match scene.class(Epoch::Lidar, x, y) {
                        Class::Water => {
                            assert_eq!(survey.height(Layer::Dsm, column, row), None);
                            open += 1;
                        }
                        _ => {
                            docks +=
                                usize::from(survey.height(Layer::Dsm, column, row) > Some(5.0));
                        }
                    }
                }
            }
        }
        assert!(open > 500 && docks > 20, "{open} {docks}");
    }

    #[test]
    fn each_flaw_does_what_it_says_and_nothing_when_it_has_no_cause() {
        let clean = scene(|_| {});
        let reference = whole(&clean, Layer::Dsm);
        let flaws = [
            Effect::Noise,
            Effect::MissingPulses,
            Effect::CrownPenetration,
            Effect::Gaps,
            Effect::AreaSampling,
            Effect::Season,
            Effect::Change,
        ];
        for effect in flaws {
            // Forced on without a cause: the same bits as when it is left out.
            let only = BTreeSet::from([effect]);
            let forced = Options { force: only.clone(), ..Options::default() };
            let without = Options { without: only, ..Options::default() };
            assert_eq!(whole(&scene_with(|_| {}, &forced), Layer::Dsm), reference, "{effect}");
            assert_eq!(whole(&scene_with(|_| {}, &without), Layer::Dsm), reference, "{effect}");
        }
        let differs = |change: fn(&mut SceneSpec)| {
            let other = whole(&scene(change), Layer::Dsm);
            other.iter().zip(&reference).filter(|(a, b)| a != b).count() as f64
                / reference.len() as f64
        };
        assert!(differs(|s| s.lidar.noise_sigma_metres = 0.1) > 0.99);
        let missing = differs(|s| s.lidar.missing_pulse_share = 0.2);
        assert!((missing - 0.2).abs() < 0.01, "{missing}");
        let gaps = differs(|s| {
            s.lidar.gap_count = 2;
            s.lidar.gap_width_metres = 5.0;
        });
        assert!((gaps - 2.0 * 5.0 / 82.3).abs() < 0.03, "{gaps}");
        let seen_through = differs(|s| s.lidar.crown_penetration_share = 1.0);
        assert!(seen_through > 0.01 && seen_through < 0.6, "{seen_through}");
        assert!(differs(|s| s.lidar.season = crate::scene::spec::Season::Winter) > 0.005);
    }

    #[test]
    fn noise_left_out_by_the_tolerance_would_change_less_than_its_bound() {
        let noisy = |s: &mut SceneSpec| s.lidar.noise_sigma_metres = 0.002;
        let coarse = Options { tolerance: crate::units::Metres(0.01), ..Options::default() };
        let left_out = scene_with(noisy, &coarse);
        let bound = left_out.plan.step("noise").expect("a step").clone();
        assert!(!bound.on && bound.bound.vertical_m == 0.008);
        let forced = Options { force: BTreeSet::from([Effect::Noise]), ..coarse };
        let with = scene_with(noisy, &forced);
        let (a, b) = (Survey::new(&left_out), Survey::new(&with));
        let mut largest: f64 = 0.0;
        for row in -70..70 {
            for column in -90..90 {
                let z = |s: &Survey<'_>| s.height(Layer::Dsm, column, row).expect("a height");
                largest = largest.max((z(&a) - z(&b)).abs());
            }
        }
        assert!(largest > 0.004 && largest <= bound.bound.vertical_m + 1e-12, "{largest}");
    }

    #[test]
    fn the_mean_of_a_cell_on_a_plane_is_its_centre() {
        let flat = |s: &mut SceneSpec| {
            s.terrain.relief_metres = 0.0;
            s.terrain.slope_percent = 7.0;
        };
        let (points, means) = (
            scene(flat),
            scene(|s| {
                flat(s);
                s.lidar.sampling = crate::scene::spec::Sampling::Area;
            }),
        );
        let (a, b) = (Survey::new(&points), Survey::new(&means));
        let same = (0..20_000_i64)
            .filter(|k| {
                let (column, row) = (k % 180 - 90, k / 180 - 55);
                let z = |s: &Survey<'_>| s.height(Layer::Dsm, column, row).expect("a height");
                (z(&a) - z(&b)).abs() < 1e-9
            })
            .count();
        // All but edges, crowns and steep roofs.
        assert!(same > 8000 && same < 20_000, "{same}");
    }
}
