//! The lidar tiles of a run: opened, placed on their lattices, indexed, with one vertical unit.

use super::layers::{Layer, LayerSource};
use super::{BenchError, BuildOptions, Coverage};
use crate::crs::{CrsError, CrsSpec, OperationInfo, ResolveOptions, ResolvedCrs, resolve};
use crate::grid::{GeoTransform, ImageGrid, PixelPoint};
use crate::lidar::{Lattice, LatticeWindow, TileFootprint, TileIndex, TileStore};
use crate::raster::{OpenOptions, RasterHeader, list_tiles};
use crate::units::LinearUnit;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// One usable tile.
#[derive(Clone, Debug)]
pub struct Tile {
    /// The file.
    pub path: PathBuf,
    /// Its number in the [`TileStore`] (unusable tiles have one too).
    pub(super) stored: usize,
    /// Number of its CRS in [`TileSet::crs`].
    pub crs: usize,
    /// Its lattice.
    pub lattice: Lattice,
    /// The cells of the lattice that it covers.
    pub window: LatticeWindow,
}

impl Tile {
    /// The file's name, which is how manifests call a tile.
    #[must_use]
    pub fn file_name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

/// A tile that cannot be used, and why.
#[derive(Clone, Debug)]
pub struct BadTile {
    /// The file.
    pub path: PathBuf,
    /// The error in words.
    pub reason: String,
}

/// All tiles of one kind (DSM or DTM), ready to be warped. Tile numbers follow the natural order of
/// names, which is also their rank.
pub struct TileSet {
    store: TileStore,
    tiles: Vec<Tile>,
    index: TileIndex,
    layers: Vec<Layer>,
    /// Tiles that could not be used.
    pub bad: Vec<BadTile>,
    /// The distinct CRSs, each with its one operation.
    pub crs: Vec<ResolvedCrs>,
    /// Unit of the heights.
    pub vertical_unit: LinearUnit,
    /// Where the unit was found, in words.
    pub vertical_evidence: String,
    /// Whether the unit is only assumed.
    pub vertical_assumed: bool,
    /// Warnings for the user, each once.
    pub warnings: Vec<String>,
}

impl TileSet {
    /// Opens the headers of all tiles, resolves their CRSs and builds the index. Tiles that cannot
    /// be used are set aside in [`bad`](Self::bad).
    ///
    /// # Errors
    /// No usable tile; tiles that disagree about the vertical unit; an operation that cannot be had.
    pub fn open(
        inputs: &[PathBuf],
        options: &BuildOptions,
        phase_bits: u32,
    ) -> Result<Self, BenchError> {
        let paths = list_tiles(inputs)?;
        let open = OpenOptions { nodata: options.nodata, memory_limit: options.memory };
        let mut store = TileStore::new(options.memory, open);
        let crs_override = options
            .crs
            .as_deref()
            .map(CrsSpec::from_user_input)
            .transpose()
            .map_err(|error| BenchError::Input(format!("--crs: {error}")))?;
        let mut bad = Vec::new();
        let mut found = Found::default();
        let mut tiles: Vec<Tile> = Vec::new();
        for path in paths {
            let placed = store.add(&path).map_err(BenchError::from).and_then(|number| {
                let header = store.header(number);
                found.place(number, header, crs_override.as_ref(), options, phase_bits)
            });
            match placed {
                Ok(tile) => tiles.push(tile),
                Err(error) => bad.push(BadTile { path, reason: error.to_string() }),
            }
        }
        if tiles.is_empty() {
            let reasons: Vec<String> =
                bad.iter().take(5).map(|b| format!("\n  {}", b.reason)).collect();
            return Err(BenchError::Input(format!(
                "none of the {} lidar tiles can be used:{}",
                bad.len(),
                reasons.concat()
            )));
        }
        let unit = vertical_unit(
            tiles.iter().map(|t| (store.header(t.stored), &found.crs[t.crs].spec)),
            options,
        )?;
        let mut warnings = unit.warnings;
        for crs in &found.crs {
            warnings.extend(crs.warnings.iter().cloned());
        }
        for tile in &tiles {
            let header = store.header(tile.stored);
            let name = header.path.display();
            warnings.extend(header.warnings.iter().map(|w| format!("{name}: {w}")));
        }
        #[cfg(feature = "proj")]
        warnings.extend(proj_warnings(&tiles, &found.crs));
        let mut footprints = Vec::new();
        for (number, tile) in tiles.iter().enumerate() {
            let footprint = TileFootprint::new(
                number,
                &tile.lattice,
                tile.window,
                &*found.crs[tile.crs].projection,
            )
            .map_err(|source| BenchError::Crs { path: tile.path.clone(), source })?;
            footprints.push(footprint);
        }
        let layers = Layer::group(&tiles, options.coverage);
        Ok(Self {
            store,
            index: TileIndex::new(footprints),
            layers,
            tiles,
            bad,
            crs: found.crs,
            vertical_unit: unit.unit,
            vertical_evidence: unit.evidence,
            vertical_assumed: unit.assumed,
            warnings,
        })
    }

    /// Values that tiles do not declare as no-data and that were read as such so far, as warnings.
    #[must_use]
    pub fn undeclared_nodata(&self) -> Vec<String> {
        let met = |tile: &Tile| {
            let undeclared = self.store.undeclared_nodata(tile.stored);
            (!undeclared.is_empty()).then(|| {
                format!(
                    "{}: samples of {} were read as no-data although the file does not declare them; say --nodata V, or --nodata none if they are heights",
                    tile.path.display(),
                    undeclared.values().join(" and ")
                )
            })
        };
        self.tiles.iter().filter_map(met).collect()
    }

    /// The usable tiles, by number.
    #[must_use]
    pub fn tiles(&self) -> &[Tile] {
        &self.tiles
    }

    /// Header of a tile.
    #[must_use]
    pub fn header(&self, tile: usize) -> &RasterHeader {
        self.store.header(self.tiles[tile].stored)
    }

    /// The block cache, for its statistics.
    #[must_use]
    pub fn store(&self) -> &TileStore {
        &self.store
    }

    /// The operation that serves a tile.
    #[must_use]
    pub fn crs_of(&self, tile: usize) -> &ResolvedCrs {
        &self.crs[self.tiles[tile].crs]
    }

    /// Numbers of the tiles that an image may touch, by rank.
    #[must_use]
    pub fn candidates(&self, grid: &ImageGrid) -> Vec<usize> {
        self.index.touching(grid)
    }

    /// West, south, east, north of all tiles, degrees.
    #[must_use]
    pub fn bounds(&self) -> Option<[f64; 4]> {
        self.index.bounds()
    }

    /// The layers that hold some of the candidates, each reduced to those, by rank.
    pub(super) fn layers_of(&self, candidates: &[usize]) -> Vec<LayerSource<'_>> {
        LayerSource::of_candidates(&self.layers, candidates, &self.tiles, &self.store)
    }

    /// Each candidate by itself, or joined by lattice, whatever the run's coverage rule is.
    pub(super) fn regrouped(
        &self,
        candidates: &[usize],
        coverage: Coverage,
    ) -> Vec<LayerSource<'_>> {
        let layers = Layer::group(&self.tiles, coverage);
        LayerSource::of_candidates(&layers, candidates, &self.tiles, &self.store)
    }

    /// Fingerprint of an image's candidates: name, size and time of each.
    #[must_use]
    pub fn fingerprint(&self, candidates: &[usize]) -> String {
        let mut hash = Sha256::new();
        for &tile in candidates {
            let header = self.header(tile);
            let (seconds, nanoseconds) = header.modified;
            hash.update(self.tiles[tile].file_name().as_bytes());
            hash.update(format!("|{}|{seconds}.{nanoseconds:09}\n", header.size_bytes).as_bytes());
        }
        crate::plan::hex(&hash.finalize()[..12])
    }
}

/// Compares the closed form of each CRS with PROJ, at the corners and the middle of every tile that
/// has it: a disagreement is a warning that names the metres.
#[cfg(feature = "proj")]
fn proj_warnings(tiles: &[Tile], found: &[ResolvedCrs]) -> Vec<String> {
    let mut warnings = Vec::new();
    for (number, crs) in found.iter().enumerate() {
        let points: Vec<_> = tiles
            .iter()
            .filter(|tile| tile.crs == number)
            .flat_map(|tile| {
                let w = tile.window;
                let (left, right) = (w.col as f64, w.right() as f64);
                let (top, bottom) = (w.row as f64, w.bottom() as f64);
                let middle = ((left + right) / 2.0, (top + bottom) / 2.0);
                [(left, top), (right, top), (left, bottom), (right, bottom), middle]
                    .map(|(x, y)| tile.lattice.position(PixelPoint { x, y }))
            })
            .filter_map(|at| crs.projection.inverse(at).ok())
            .collect();
        match crate::crs::check_against_proj(crs, &points) {
            Ok(report) => warnings.extend(report.warnings(crs)),
            Err(error) => warnings.push(format!("PROJ could not check {}: {error}", crs.spec.name)),
        }
    }
    warnings
}

/// The distinct CRSs met so far, and the lattices in each.
#[derive(Default)]
struct Found {
    specs: Vec<CrsSpec>,
    crs: Vec<ResolvedCrs>,
    lattices: Vec<(usize, Lattice)>,
}

impl Found {
    fn place(
        &mut self,
        stored: usize,
        header: &RasterHeader,
        crs_override: Option<&CrsSpec>,
        options: &BuildOptions,
        phase_bits: u32,
    ) -> Result<Tile, BenchError> {
        let spec = match crs_override {
            Some(spec) => {
                header.check_grid()?;
                spec
            }
            None => {
                header.check_usable()?;
                header.crs.as_ref().ok_or_else(|| no_crs(&header.path))?
            }
        };
        let crs = match self.specs.iter().position(|known| same_horizontal(known, spec)) {
            Some(known) => {
                // A step that is left out is left out everywhere: its bound is that of the tile where
                // it is largest, and where it is above the tolerance it is taken after all.
                let shift_m = self.crs[known].operation.datum_shift_m;
                if leaves_out(shift_m, options) {
                    let here = resolve_for(header, spec, options, shift_m)
                        .map_err(|source| BenchError::Crs { path: header.path.clone(), source })?;
                    self.crs[known] = here;
                }
                known
            }
            None => {
                let resolved = resolve_for(header, spec, options, 0.0)
                    .map_err(|source| BenchError::Crs { path: header.path.clone(), source })?;
                self.specs.push(spec.clone());
                self.crs.push(resolved);
                self.crs.len() - 1
            }
        };
        let (lattice, col, row) =
            self.on_lattice(crs, &header.geotransform, phase_bits).ok_or_else(|| {
                BenchError::Input(format!("{}: the raster is rotated", header.path.display()))
            })?;
        Ok(Tile {
            path: header.path.clone(),
            stored,
            crs,
            lattice,
            window: LatticeWindow {
                col,
                row,
                width: header.width as usize,
                height: header.height as usize,
            },
        })
    }
}

impl Found {
    /// The lattice of a tile, which is that of an earlier tile where both are parts of one raster, and
    /// the tile's first cell; `None` for a grid that is not north-up.
    fn on_lattice(
        &mut self,
        crs: usize,
        grid: &GeoTransform,
        phase_bits: u32,
    ) -> Option<(Lattice, i64, i64)> {
        let known =
            self.lattices.iter().filter(|(of, _)| *of == crs).find_map(|(_, lattice)| {
                lattice.cell_of(grid).map(|(col, row)| (*lattice, col, row))
            });
        known.or_else(|| {
            let made = Lattice::of(grid, phase_bits)?;
            self.lattices.push((crs, made.0));
            Some(made)
        })
    }
}

fn no_crs(path: &Path) -> BenchError {
    BenchError::Input(format!(
        "{}: the tile has no coordinate system; say which with --crs, for example --crs EPSG:2927",
        path.display()
    ))
}

fn same_horizontal(a: &CrsSpec, b: &CrsSpec) -> bool {
    match (a.epsg, b.epsg) {
        (Some(a), Some(b)) => a == b,
        (None, None) => a.wkt == b.wkt && a.name == b.name,
        _ => false,
    }
}

/// Whether a datum step that moves positions so far is left out: its bound is under the tolerance,
/// which takes one of metres.
fn leaves_out(shift_m: f64, options: &BuildOptions) -> bool {
    shift_m > 0.0 && datum_bound_m(shift_m) < options.tolerance_m && options.operation.is_none()
}

/// Error of leaving a datum step out, metres: 5 % covers the change of the shift around a tile.
pub(super) fn datum_bound_m(shift_m: f64) -> f64 {
    1.05 * shift_m
}

/// Whether an operation's datum step is applied.
pub(super) fn moves_points(operation: &OperationInfo, options: &BuildOptions) -> bool {
    operation.datum_shift_m > 0.0 && !leaves_out(operation.datum_shift_m, options)
}

/// Resolves a CRS for the area of a tile that has it; `least_shift_m` is what its datum step moves
/// positions elsewhere.
fn resolve_for(
    header: &RasterHeader,
    spec: &CrsSpec,
    options: &BuildOptions,
    least_shift_m: f64,
) -> Result<ResolvedCrs, CrsError> {
    let mut asked = ResolveOptions {
        operation: options.operation.clone(),
        proj_network: options.proj_network,
        ..ResolveOptions::default()
    };
    let resolved = resolve(spec, &asked)?;
    let corner = |x: f64, y: f64| {
        let at = header.geotransform.to_projected(PixelPoint { x, y });
        resolved.projection.inverse(at)
    };
    let (width, height) = (f64::from(header.width), f64::from(header.height));
    let (Ok(a), Ok(b)) = (corner(0.0, height), corner(width, 0.0)) else { return Ok(resolved) };
    asked.area = Some([
        a.lon_deg.min(b.lon_deg),
        a.lat_deg.min(b.lat_deg),
        a.lon_deg.max(b.lon_deg),
        a.lat_deg.max(b.lat_deg),
    ]);
    let resolved = resolve(spec, &asked)?;
    let shift_m = resolved.operation.datum_shift_m.max(least_shift_m);
    if leaves_out(shift_m, options) {
        asked.without_datum_step = true;
        let mut without = resolve(spec, &asked)?;
        without.operation.datum_shift_m = shift_m;
        return Ok(without);
    }
    Ok(resolved)
}

struct VerticalUnit {
    unit: LinearUnit,
    evidence: String,
    assumed: bool,
    warnings: Vec<String>,
}

fn vertical_unit<'a>(
    tiles: impl Iterator<Item = (&'a RasterHeader, &'a CrsSpec)>,
    options: &BuildOptions,
) -> Result<VerticalUnit, BenchError> {
    if let Some(unit) = options.vertical_unit {
        return Ok(VerticalUnit {
            unit,
            evidence: "--vertical-unit".into(),
            assumed: false,
            warnings: vec![],
        });
    }
    let mut first: Option<(LinearUnit, String, bool, String)> = None;
    for (header, crs) in tiles {
        let name = header.path.display().to_string();
        let compound = || {
            let unit = crs.vertical.as_ref()?.unit?;
            Some((unit, "vertical part of the CRS".to_owned()))
        };
        let (unit, evidence, assumed) = match header.vertical_unit.clone().or_else(compound) {
            Some((unit, evidence)) => (unit, evidence, false),
            None => {
                let unit = crs.linear_unit.ok_or_else(|| {
                    BenchError::Input(format!("{name}: neither the heights nor the coordinates state a unit; say it with --vertical-unit us-survey-foot|foot|metre"))
                })?;
                (unit, format!("assumed: the horizontal unit of {}", crs.name), true)
            }
        };
        match &first {
            None => first = Some((unit, evidence, assumed, name)),
            Some((known, _, _, first_name)) if *known != unit => {
                return Err(BenchError::Input(format!(
                    "tiles disagree about the unit of their heights: {first_name} is in {known}, {name} in {unit} ({evidence}); build them apart, or say it with --vertical-unit us-survey-foot|foot|metre"
                )));
            }
            Some(_) => {}
        }
    }
    let (unit, evidence, assumed, name) =
        first.ok_or_else(|| BenchError::Input("no tile to take a vertical unit from".into()))?;
    let mut warnings = Vec::new();
    if assumed {
        warnings.push(format!(
            "VERTICAL UNIT ASSUMED: {name} does not say in what unit its heights are; taken as {unit}, the unit of its coordinates. A wrong unit scales every height by up to 3.28: check one known height, and say it with --vertical-unit."
        ));
    }
    Ok(VerticalUnit { unit, evidence, assumed, warnings })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lidar::PHASE_BITS;
    use crate::random::Draw;

    #[test]
    fn tiles_of_one_raster_are_on_one_lattice_though_their_phases_round_apart() {
        let mut draw = Draw::new(&[2]);
        let mut unlucky = 0;
        for _ in 0..2000 {
            let (west, north) = (draw.range(3e5, 7e5), draw.range(3e6, 6e6));
            let whole = GeoTransform::north_up(west, north, 0.3, draw.range(0.1, 0.6));
            let mut part = whole;
            part.0[3] += 5000.0 * whole.0[5];
            let mut found = Found::default();
            let (lattice, col, row) =
                found.on_lattice(0, &whole, PHASE_BITS).expect("a north-up grid");
            let placed = found.on_lattice(0, &part, PHASE_BITS);
            assert_eq!(placed, Some((lattice, col, row + 5000)));
            let own = Lattice::of(&part, PHASE_BITS);
            unlucky += u32::from(own != placed);
            // In another CRS the same numbers are another place.
            assert_eq!(found.on_lattice(1, &part, PHASE_BITS), own);
            assert_eq!(found.lattices.len(), 2);
        }
        assert!(unlucky > 2, "{unlucky}");
    }

    #[test]
    fn a_raster_off_the_lattice_has_its_own() {
        let grid = GeoTransform::north_up(500_000.3, 5_000_000.7, 0.5, 0.5);
        let mut moved = grid;
        moved.0[3] += 0.2;
        let mut found = Found::default();
        let first = found.on_lattice(0, &grid, PHASE_BITS).expect("a north-up grid");
        let second = found.on_lattice(0, &moved, PHASE_BITS).expect("a north-up grid");
        assert_ne!(first.0, second.0);
        assert_eq!(Some(second), Lattice::of(&moved, PHASE_BITS));
        let rotated = GeoTransform([0.0, 1.0, 0.1, 0.0, 0.1, -1.0]);
        assert!(found.on_lattice(0, &rotated, PHASE_BITS).is_none());
    }
}
