//! The work on one image: candidates, warp, choice or mosaic, statistics, encoded files.

use super::layers::LayerSource;
use super::options::{BuildOptions, GridKind, TransformChoice};
use super::plan::{Budget, STATED_HEIGHT_M, rounding_m};
use super::record::Record;
use super::tiles::{TileSet, moves_points};
use super::{Coverage, ImageEntry};
use crate::batch::{OutputFile, Product, Status};
use crate::grid::{ImageGrid, PixelPoint};
use crate::lidar::{
    PixelMap, PixelToCrs, TransformForm, WarpError, WarpSettings, WarpStatistics, WindowSource,
    warp,
};
use crate::plan::runs;
use crate::raster::geotiff::{CogSpec, encode_cog};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::raster::preview;
use crate::units::LinearUnit;

/// What a worker needs to know of the run.
pub struct Workshop<'a> {
    pub options: &'a BuildOptions,
    pub budget: Budget,
    pub dsm: &'a TileSet,
    pub dtm: Option<&'a TileSet>,
}

/// Why an image gave nothing: a status and the reason in words.
struct NoDsm(Status, String);

impl<E: std::error::Error> From<E> for NoDsm {
    fn from(error: E) -> Self {
        Self(Status::Failed, error.to_string())
    }
}

/// One warped DSM, before it is judged.
struct Warped {
    heights: Vec<f32>,
    /// Tile of each pixel, where asked for.
    ids: Option<Vec<u16>>,
    valid: u64,
    tiles: Vec<usize>,
    form: TransformForm,
    bound_m: f64,
    steepest: f64,
    /// How much steeper the interpolated surface can be.
    slope_factor: Option<f64>,
    uncertain: u64,
}

impl Workshop<'_> {
    /// Builds one image. Never fails as a whole: the record says what happened.
    pub fn build(&self, entry: &ImageEntry) -> Product<Record> {
        let mut record = Record::without_output(&entry.stem, Status::Done, String::new());
        let mut files = Vec::new();
        if let Err(NoDsm(status, reason)) = self.fill(entry, &mut record, &mut files) {
            record.status = status;
            record.reason = reason;
            files.clear();
        }
        record.outputs = files.iter().map(|(file, bytes)| OutputFile::of(file, bytes)).collect();
        Product { record, files }
    }

    /// Fingerprint of the inputs of an image; empty where the name has no grid.
    pub fn fingerprint(&self, entry: &ImageEntry) -> String {
        self.grid_of(entry).map_or_else(
            |_| String::new(),
            |grid| {
                let dtm = self.dtm.map(|tiles| tiles.fingerprint(&tiles.candidates(&grid)));
                self.dsm.fingerprint(&self.dsm.candidates(&grid)) + &dtm.unwrap_or_default()
            },
        )
    }

    fn grid_of(&self, entry: &ImageEntry) -> Result<ImageGrid, NoDsm> {
        let name = entry.name.as_ref().map_err(|error| NoDsm(Status::Failed, error.to_string()))?;
        let size = self.options.size;
        Ok(ImageGrid::new(name.center(), self.options.zoom, size, size)?)
    }

    fn fill(
        &self,
        entry: &ImageEntry,
        record: &mut Record,
        files: &mut Vec<(String, Vec<u8>)>,
    ) -> Result<(), NoDsm> {
        if let Ok(name) = &entry.name {
            record.lat_deg = Some(name.center().lat_deg);
            record.lon_deg = Some(name.center().lon_deg);
        }
        let grid = self.grid_of(entry)?;
        self.check_image(entry)?;
        let candidates = self.dsm.candidates(&grid);
        record.candidates = candidates.len() as u64;
        record.inputs = self.fingerprint(entry);
        if candidates.is_empty() {
            return Err(NoDsm(Status::Skipped, "no lidar tile covers this image".into()));
        }
        let layers = self.dsm.layers_of(&candidates);
        let ids = self.options.source_tile;
        let warped = self.cover(&grid, self.dsm, layers, self.options.coverage, ids)?;
        let pixels = warped.heights.len() as u64;
        let nan_pct = |valid: u64| 100.0 * (pixels - valid) as f64 / pixels as f64;
        let missing = nan_pct(warped.valid);
        record.nan_pct = Some(missing);
        record.transform = Some(warped.form.name().to_owned());
        record.transform_bound_m = Some(warped.bound_m);
        if missing > self.options.max_nan_pct {
            let mut reason = format!(
                "{missing:.2} % of the pixels have no data, more than {} %",
                self.options.max_nan_pct
            );
            if self.options.coverage == Coverage::BestTile && candidates.len() > 1 {
                let layers = self.dsm.regrouped(&candidates, Coverage::Mosaic);
                let mosaic = self.cover(&grid, self.dsm, layers, Coverage::Mosaic, false)?;
                let left = nan_pct(mosaic.valid);
                record.mosaic_nan_pct = Some(left);
                if left <= self.options.max_nan_pct {
                    reason += &format!("; --coverage mosaic would leave {left:.2} %");
                }
            }
            return Err(NoDsm(Status::Skipped, reason));
        }
        record.tiles =
            warped.tiles.iter().map(|&tile| self.dsm.tiles()[tile].file_name()).collect();
        record.uncertain_px = Some(warped.uncertain);
        let mut heights = warped.heights;
        self.quantise(&mut heights);
        let gradient = warped.slope_factor.map(|factor| factor * warped.steepest);
        record.steepest = Some(warped.steepest);
        self.describe(record, &heights, gradient, warped.bound_m);
        let dtm = self.dtm.map(|tiles| self.bare_earth(&grid, tiles, record)).transpose()?;
        self.encode(&grid, record, &heights, dtm.as_deref(), warped.ids.as_deref(), files);
        Ok(())
    }

    /// The image file, where there is one, must have the grid's size.
    fn check_image(&self, entry: &ImageEntry) -> Result<(), NoDsm> {
        let Some(file) = &entry.file else { return Ok(()) };
        let failed = |reason: String| NoDsm(Status::Failed, reason);
        let (width, height) = image::ImageReader::open(file)
            .and_then(image::ImageReader::with_guessed_format)
            .map_err(|error| failed(format!("{}: {error}", file.display())))?
            .into_dimensions()
            .map_err(|error| {
                failed(format!("{}: not a readable image: {error}", file.display()))
            })?;
        if (width, height) != (self.options.size, self.options.size) {
            return Err(failed(format!(
                "{}: the image is {width} x {height} pixels, the grid {size} x {size}; say --size if all images have another size",
                file.display(),
                size = self.options.size,
            )));
        }
        Ok(())
    }

    fn cover(
        &self,
        grid: &ImageGrid,
        tiles: &TileSet,
        layers: Vec<LayerSource<'_>>,
        coverage: Coverage,
        ids: bool,
    ) -> Result<Warped, NoDsm> {
        runs("coverage");
        let mut prepared = Vec::with_capacity(layers.len());
        let mut first_crs = None;
        for layer in layers {
            // The reference grid is a box in the CRS of the first candidate; others cannot share it.
            if self.options.grid == GridKind::Reference
                && *first_crs.get_or_insert(layer.crs) != layer.crs
            {
                continue;
            }
            let (map, form) = self.map(grid, tiles, &layer)?;
            let most = most_pixels(&map, layer.extent())?;
            prepared.push(Candidate { rank: prepared.len(), layer, map, form, most });
        }
        let warped = match coverage {
            Coverage::BestTile => self.best(tiles, prepared, ids)?,
            Coverage::Mosaic => self.mosaic(tiles, prepared, ids)?,
        };
        warped.ok_or_else(|| NoDsm(Status::Skipped, "no lidar tile covers this image".into()))
    }

    /// The map of an image onto a layer, in the form that the plan asks for.
    fn map(
        &self,
        grid: &ImageGrid,
        tiles: &TileSet,
        layer: &LayerSource<'_>,
    ) -> Result<(PixelMap, TransformForm), NoDsm> {
        let crs = &tiles.crs[layer.crs];
        runs("projection");
        runs("lattice");
        runs("transform");
        if moves_points(&crs.operation, self.options) {
            runs("datum");
        }
        if crs.metres_per_unit != 1.0 {
            runs("horizontal-unit");
        }
        let (exact, forced) = match (self.options.grid, self.options.transform) {
            (GridKind::Reference, _) => {
                (PixelToCrs::reference_box(grid, &*crs.projection)?, Some(TransformForm::Affine))
            }
            (GridKind::WebMercator, choice) => (
                PixelToCrs::WebMercator { grid: *grid, projection: crs.projection.clone() },
                match choice {
                    TransformChoice::Auto => None,
                    TransformChoice::Forced(form) => Some(form),
                },
            ),
        };
        if let Some(form) = forced {
            return Ok((PixelMap::fit(exact, layer.lattice, form)?, form));
        }
        let map = PixelMap::fit(exact, layer.lattice, TransformForm::Chebyshev)?;
        let form = map.errors().cheapest(self.budget.transform_m / crs.metres_per_unit);
        let map = if form == TransformForm::Chebyshev { map } else { map.with_form(form)? };
        Ok((map, form))
    }

    fn settings(&self, tiles: &TileSet, candidate: &Candidate<'_>) -> WarpSettings {
        let metres_per_unit = tiles.crs[candidate.layer.crs].metres_per_unit;
        WarpSettings {
            resampling: self.options.resampling,
            edge: self.options.edge,
            metres_per_unit: tiles.vertical_unit.metres_per_unit(),
            // The image's own bound: a forced form may err more than the tolerance leaves, and the
            // chosen one errs less.
            horizontal_bound: self.budget.other_m / metres_per_unit
                + candidate.map.errors().of(candidate.form),
        }
    }

    fn warp_one(
        &self,
        tiles: &TileSet,
        candidate: &Candidate<'_>,
        ids: bool,
    ) -> Result<Warped, WarpError> {
        let pixels = self.options.size as usize * self.options.size as usize;
        let mut heights = vec![f32::NAN; pixels];
        let mut tile_ids = ids.then(|| vec![u16::MAX; pixels]);
        let settings = self.settings(tiles, candidate);
        runs("kernel");
        if settings.metres_per_unit != 1.0 {
            runs("vertical-unit");
        }
        if ids {
            runs("source-tile");
        }
        let statistics = warp(
            &candidate.map,
            &candidate.layer,
            &settings,
            &mut heights,
            tile_ids.as_deref_mut(),
        )?;
        let crs = &tiles.crs[candidate.layer.crs];
        let WarpStatistics { valid, uncertain, steepest, slope_factor } = statistics;
        Ok(Warped {
            heights,
            ids: tile_ids,
            valid,
            tiles: candidate.layer.members.clone(),
            form: candidate.form,
            bound_m: candidate.map.errors().of(candidate.form) * crs.metres_per_unit,
            // Height units per CRS unit -> metres per metre.
            steepest: steepest * tiles.vertical_unit.metres_per_unit() / crs.metres_per_unit,
            slope_factor,
            uncertain,
        })
    }

    /// The candidate with the most valid pixels; ties go to the first. Candidates that cannot win
    /// by the area that they cover are not warped.
    fn best(
        &self,
        tiles: &TileSet,
        mut candidates: Vec<Candidate<'_>>,
        ids: bool,
    ) -> Result<Option<Warped>, NoDsm> {
        candidates.sort_by_key(|c| (std::cmp::Reverse(c.most), c.rank));
        let mut best: Option<(u64, usize, Warped)> = None;
        for candidate in &candidates {
            if let Some((valid, rank, _)) = &best {
                if candidate.most < *valid {
                    break;
                }
                if candidate.most == *valid && candidate.rank > *rank {
                    continue;
                }
            }
            let warped = self.warp_one(tiles, candidate, ids)?;
            let wins = best.as_ref().is_none_or(|(valid, rank, _)| {
                warped.valid > *valid || (warped.valid == *valid && candidate.rank < *rank)
            });
            if wins {
                best = Some((warped.valid, candidate.rank, warped));
            }
        }
        Ok(best.map(|(_, _, warped)| warped))
    }

    /// Layers by rank, each filling what is left.
    fn mosaic(
        &self,
        tiles: &TileSet,
        candidates: Vec<Candidate<'_>>,
        ids: bool,
    ) -> Result<Option<Warped>, NoDsm> {
        let mut whole: Option<Warped> = None;
        for candidate in &candidates {
            let Some(sum) = &mut whole else {
                whole = Some(self.warp_one(tiles, candidate, ids)?);
                continue;
            };
            if sum.valid == sum.heights.len() as u64 {
                break;
            }
            let next = self.warp_one(tiles, candidate, ids)?;
            let before = sum.valid;
            for (k, height) in next.heights.into_iter().enumerate() {
                if sum.heights[k].is_nan() && !height.is_nan() {
                    sum.heights[k] = height;
                    sum.valid += 1;
                    if let (Some(all), Some(ids)) = (&mut sum.ids, &next.ids) {
                        all[k] = ids[k];
                    }
                }
            }
            if sum.valid > before {
                sum.tiles.extend(next.tiles);
                sum.uncertain += next.uncertain;
                sum.steepest = sum.steepest.max(next.steepest);
                sum.slope_factor = sum.slope_factor.zip(next.slope_factor).map(|(a, b)| a.max(b));
                if next.bound_m > sum.bound_m {
                    (sum.bound_m, sum.form) = (next.bound_m, next.form);
                }
            }
        }
        if let Some(sum) = &mut whole {
            sum.tiles.sort_unstable();
        }
        Ok(whole)
    }

    fn bare_earth(
        &self,
        grid: &ImageGrid,
        tiles: &TileSet,
        record: &mut Record,
    ) -> Result<Vec<f32>, NoDsm> {
        runs("bare-earth");
        let pixels = self.options.size as usize * self.options.size as usize;
        let candidates = tiles.candidates(grid);
        let mut heights = if candidates.is_empty() {
            vec![f32::NAN; pixels]
        } else {
            let layers = tiles.layers_of(&candidates);
            self.cover(grid, tiles, layers, self.options.coverage, false)?.heights
        };
        self.quantise(&mut heights);
        let missing = heights.iter().filter(|h| h.is_nan()).count();
        record.dtm_nan_pct = Some(100.0 * missing as f64 / pixels as f64);
        Ok(heights)
    }

    fn quantise(&self, heights: &mut [f32]) {
        if let Some(quantisation) = self.options.quantise {
            runs("quantise");
            let step = quantisation.step_m;
            for height in heights {
                *height = ((f64::from(*height) / step).round() * step) as f32;
            }
        }
    }

    fn describe(
        &self,
        record: &mut Record,
        heights: &[f32],
        gradient: Option<f64>,
        transform_m: f64,
    ) {
        let Extent { low, high, mean } = Extent::of(heights);
        record.min_m = Some(f64::from(low));
        record.max_m = Some(f64::from(high));
        record.mean_m = Some(mean);
        // The plan's rounding is stated for ordinary heights; these may be higher.
        let highest = f64::from(low.abs().max(high.abs()));
        // To 32 bits where a tile has more, on writing, and after quantising.
        let roundings = if self.options.quantise.is_some() { 3.0 } else { 2.0 };
        let rounding_m = rounding_m(roundings * highest) - rounding_m(STATED_HEIGHT_M);
        // What one image can lose: every horizontal bound times the steepest gradient.
        record.height_bound_m = gradient.map(|gradient| {
            (self.budget.other_m + transform_m) * gradient
                + self.budget.vertical_m
                + rounding_m.max(0.0)
        });
        if !(-440.0..=9700.0).contains(&low) || !(-440.0..=9700.0).contains(&high) {
            record.flags.push(format!(
                "heights from {low:.1} to {high:.1} m lie outside what stands on Earth: wrong unit or no-data value?"
            ));
        } else if f64::from(high - low) > 1000.0 {
            record.flags.push(format!(
                "heights span {:.0} m within one image: wrong unit or no-data value?",
                high - low
            ));
        }
    }

    fn encode(
        &self,
        grid: &ImageGrid,
        record: &Record,
        heights: &[f32],
        dtm: Option<&[f32]>,
        ids: Option<&[u16]>,
        files: &mut Vec<(String, Vec<u8>)>,
    ) {
        runs("storage");
        let size = self.options.size as usize;
        let shape = [size, size];
        let mut arrays = vec![NpyArray { name: "dsm", shape: &shape, data: NpyData::F32(heights) }];
        if let Some(dtm) = dtm {
            arrays.push(NpyArray { name: "dtm", shape: &shape, data: NpyData::F32(dtm) });
        }
        if let Some(ids) = ids {
            arrays.push(NpyArray { name: "source_tile", shape: &shape, data: NpyData::U16(ids) });
        }
        let stem = &record.name;
        files.push((format!("{stem}_dsm.npz"), npz::encode(&arrays, Compression::Fast)));
        if self.options.geotiff {
            runs("geotiff");
            let metadata = vec![
                ("TIFFTAG_SOFTWARE".to_owned(), format!("sat3d {}", env!("CARGO_PKG_VERSION"))),
                ("SOURCE_TILES".to_owned(), record.tiles.join(";")),
                ("COORDINATE_OPERATION".to_owned(), self.operation_of(record)),
                ("VERTICAL_DATUM".to_owned(), self.vertical_datum()),
            ];
            let spec = CogSpec {
                width: self.options.size,
                height: self.options.size,
                geotransform: grid.geotransform(),
                epsg: 3857,
                vertical_epsg: self.options.vertical_crs,
                unit: Some(LinearUnit::Metre),
                metadata,
            };
            files.push((format!("{stem}_dsm.tif"), encode_cog(heights, &spec)));
        }
        if self.options.preview {
            runs("preview");
            let pixel = grid.ground_sample_distance();
            files.push((
                format!("{stem}_dsm.png"),
                preview::hillshade_png(heights, size, size, pixel),
            ));
        }
    }

    fn operation_of(&self, record: &Record) -> String {
        let used = self.dsm.tiles().iter().find(|tile| record.tiles.contains(&tile.file_name()));
        used.map_or_else(String::new, |tile| self.dsm.crs[tile.crs].operation.name.clone())
    }

    fn vertical_datum(&self) -> String {
        let stated = self.dsm.crs.iter().find_map(|crs| crs.spec.vertical.as_ref());
        match (self.options.vertical_crs, stated) {
            (Some(code), _) => format!("EPSG:{code}"),
            (None, Some(vertical)) => {
                format!("as the lidar tiles: {} (converted to metres)", vertical.name)
            }
            (None, None) => "as the lidar tiles, which do not name it".to_owned(),
        }
    }
}

/// Lowest, highest and mean height over the valid pixels.
struct Extent {
    low: f32,
    high: f32,
    mean: f64,
}

impl Extent {
    /// In `f64` over eight interleaved lanes, merged in order: the same result on every machine, and
    /// no addition waits for the one before.
    fn of(heights: &[f32]) -> Self {
        const LANES: usize = 8;
        let (mut low, mut high) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
        let (mut sum, mut count) = ([0.0_f64; LANES], [0_u32; LANES]);
        for group in heights.chunks(LANES) {
            for (lane, &height) in group.iter().enumerate() {
                // Comparisons with NaN are false, so that an empty pixel changes nothing.
                low[lane] = if height < low[lane] { height } else { low[lane] };
                high[lane] = if height > high[lane] { height } else { high[lane] };
                sum[lane] += if height.is_nan() { 0.0 } else { f64::from(height) };
                count[lane] += u32::from(!height.is_nan());
            }
        }
        Self {
            low: low.into_iter().fold(f32::INFINITY, f32::min),
            high: high.into_iter().fold(f32::NEG_INFINITY, f32::max),
            mean: sum.iter().sum::<f64>() / f64::from(count.iter().sum::<u32>()),
        }
    }
}

struct Candidate<'a> {
    rank: usize,
    layer: LayerSource<'a>,
    map: PixelMap,
    form: TransformForm,
    /// Upper bound on its valid pixels.
    most: u64,
}

/// Pixels whose own cell lies in the layer's extent: no more can be valid.
fn most_pixels(
    map: &PixelMap,
    extent: crate::lidar::LatticeWindow,
) -> Result<u64, crate::crs::CrsError> {
    let (width, height) = map.size();
    let all = u64::from(width) * u64::from(height);
    let (w, h) = (f64::from(width), f64::from(height));
    let mut inside = true;
    for (x, y) in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)] {
        // One cell of margin covers the bend of the edges between corners.
        inside &= extent.contains(map.coordinate(PixelPoint { x, y })?, 1.0);
    }
    if inside {
        return Ok(all);
    }
    let (mut cols, mut rows) = (Vec::new(), Vec::new());
    let mut most = 0;
    for y in 0..height {
        cols.clear();
        rows.clear();
        map.fill_row(y, 0..width, 0.5, &mut cols, &mut rows)?;
        let points = cols.iter().zip(&rows);
        most +=
            points.filter(|&(&x, &y)| extent.contains(PixelPoint { x, y }, -1.0)).count() as u64;
    }
    Ok(most.min(all))
}
