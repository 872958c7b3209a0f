//! The picture of the whole extent and its truth: GeoTIFFs of any size, written band by band.
//!
//! The picture is upright in Web Mercator (EPSG:3857), centred on the scene's place, and lies inside the
//! extent, as the satellite images do. A pixel is rendered by the same code as theirs: where the two grids
//! coincide, so do the colours (antialiased edges to a few levels, because the directions of rows and
//! columns are those of the middle of the part that is rendered at once).

use super::error::SceneError;
use super::object::Epoch;
use super::pixels::PixelPositions;
use super::purpose;
use super::render::Sheet;
use super::spec::PictureSpec;
use super::surface::Scene;
use crate::batch::{Interrupt, Progress};
use crate::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint};
use crate::random::key;
use crate::raster::geotiff::{GeoTiffSpec, GeoTiffWriter, RgbWriter};
use crate::units::{LinearUnit, US_SURVEY_FOOT_M};
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::path::Path;

/// Name of the picture.
pub const PICTURE_FILE: &str = "picture.tif";
/// Name of the heights that are true on it.
pub const TRUTH_FILE: &str = "picture_dsm.tif";
/// CRS of both: WGS 84 / Pseudo-Mercator.
const CRS: u32 = 3857;
/// Zoom of the picture when nothing is said.
const ZOOM: u8 = 20;
/// Sides of the picture are multiples of this, pixels, so that its truth can have 2, 2.5, 4 or 5 pixels in one.
const STEP: u32 = 20;
/// Rows that are held in memory at once: those of a row of tiles.
const BAND_ROWS: u32 = 256;
/// Columns that are rendered at once.
const BLOCK_COLUMNS: u32 = 1024;

impl PictureSpec {
    /// Size of a pixel on the ground at a latitude, metres (EPSG:3857 times the cosine of the latitude).
    #[must_use]
    pub fn pixel_size(&self, latitude_degrees: f64) -> f64 {
        let around = std::f64::consts::TAU * crate::grid::WGS84_A;
        let plane = (256_u64 << self.zoom.unwrap_or(ZOOM).min(30)) as f64;
        self.pixel_metres
            .unwrap_or_else(|| around / plane * libm::cos(latitude_degrees.to_radians()))
    }
}

/// The pixel grid of the picture, or of its truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureGrid {
    /// A grid of two by two pixels around the centre.
    base: ImageGrid,
    /// Side of a pixel, pixels of the base grid.
    pixel: f64,
    /// Columns and rows.
    size: [u32; 2],
    /// North-west corner, pixels of the base grid.
    corner: [f64; 2],
}

impl PictureGrid {
    /// The grid of a scene's picture; `None` if its file asks for none.
    ///
    /// # Errors
    /// [`SceneError::NoPicture`] for one that does not fit, [`SceneError::Crs`] where the projection is
    /// undefined.
    pub fn new(scene: &Scene) -> Result<Option<Self>, SceneError> {
        let Some(spec) = &scene.spec.picture else { return Ok(None) };
        let place = &scene.spec.place;
        let center = LonLat { lon_deg: place.longitude_degrees, lat_deg: place.latitude_degrees };
        let base = ImageGrid::new(center, spec.zoom.unwrap_or(ZOOM), 2, 2)?;
        let pixel_m = spec.pixel_size(place.latitude_degrees);
        let pixel = spec.pixel_metres.map_or(1.0, |metres| metres / base.ground_sample_distance());
        let extent = [scene.spec.extent.width_metres, scene.spec.extent.height_metres];
        let turn = scene.frame.convergence().abs();
        let given = [spec.width_metres, spec.height_metres];
        let mut steps = [0, 1].map(|axis| {
            // The picture's north is not the extent's: both sides lose a little.
            let side = given[axis].unwrap_or(extent[axis] - turn * extent[1 - axis]);
            (side / pixel_m / f64::from(STEP)).floor().max(0.0) as u32
        });
        loop {
            let size = steps.map(|n| n * STEP);
            let corner = size.map(|n| 1.0 - f64::from(n) / 2.0 * pixel);
            let grid = Self { base, pixel, size, corner };
            let empty = size.contains(&0);
            if !empty && grid.fits(scene)? {
                return Ok(Some(grid));
            }
            if empty || given.iter().all(Option::is_some) {
                let [picture_width, picture_height] =
                    size.map(|n| f64::from(n.max(STEP)) * pixel_m);
                return Err(SceneError::NoPicture {
                    picture_width,
                    picture_height,
                    width: extent[0],
                    height: extent[1],
                    turn_degrees: turn.to_degrees(),
                });
            }
            for (steps, given) in steps.iter_mut().zip(given) {
                *steps -= u32::from(given.is_none());
            }
        }
    }

    /// The grid of the points whose true height is written: the same north-west corner, and in the south
    /// and east no less than the picture.
    #[must_use]
    pub fn truth(&self, spacing_pixels: f64) -> Self {
        let size = self.size.map(|n| (f64::from(n) / spacing_pixels).ceil() as u32);
        Self { pixel: self.pixel * spacing_pixels, size, ..*self }
    }

    /// Columns and rows.
    #[must_use]
    pub const fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Position of a pixel coordinate (centres at `+0.5`).
    #[must_use]
    pub fn lonlat(&self, p: PixelPoint) -> LonLat {
        self.base.lonlat(self.in_base(p))
    }

    /// The grid in EPSG:3857, metres.
    #[must_use]
    pub fn geotransform(&self) -> GeoTransform {
        let base = self.base.geotransform();
        let corner = base.to_projected(self.in_base(PixelPoint { x: 0.0, y: 0.0 }));
        let side = self.pixel * base.0[1];
        GeoTransform::north_up(corner.x, corner.y, side, side)
    }

    /// Ground metres per pixel at the centre.
    #[must_use]
    pub fn ground_sample_distance(&self) -> f64 {
        self.pixel * self.base.ground_sample_distance()
    }

    fn in_base(&self, p: PixelPoint) -> PixelPoint {
        PixelPoint { x: self.corner[0] + p.x * self.pixel, y: self.corner[1] + p.y * self.pixel }
    }

    /// Whether the picture, and two lidar cells around it, lie in the extent.
    fn fits(&self, scene: &Scene) -> Result<bool, SceneError> {
        let border = 2.0 * scene.spec.tiles.pixel_feet * US_SURVEY_FOOT_M;
        let extent = &scene.spec.extent;
        let half = [extent.width_metres, extent.height_metres].map(|side| side / 2.0 - border);
        // Sides are bowed in the scene's frame, by metres in the largest scenes.
        for (i, j) in (0..9).map(|k| (k % 3, k / 3)) {
            let [x, y] = [(i, self.size[0]), (j, self.size[1])]
                .map(|(k, n)| f64::from(k) / 2.0 * f64::from(n));
            let at = scene.frame.to_local(self.lonlat(PixelPoint { x, y }))?;
            if at[0].abs() > half[0] || at[1].abs() > half[1] {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn spec(&self, scene: &Scene, unit: Option<LinearUnit>) -> GeoTiffSpec {
        GeoTiffSpec {
            width: self.size[0],
            height: self.size[1],
            geotransform: self.geotransform(),
            epsg: CRS,
            unit,
            metadata: vec![(
                "TIFFTAG_IMAGEDESCRIPTION".to_owned(),
                format!("simulated by sat3d, scene {}", scene.spec.name),
            )],
            ..GeoTiffSpec::default()
        }
    }

    /// Bands of rows from north to south.
    fn bands(&self) -> impl Iterator<Item = Range<u32>> {
        let height = self.size[1];
        (0..height).step_by(BAND_ROWS as usize).map(move |row| row..(row + BAND_ROWS).min(height))
    }
}

/// What `scene.json` says of the picture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PictureFiles {
    /// Both files: `EPSG:3857`.
    pub crs: String,
    /// The picture.
    pub picture: PictureFile,
    /// Its truth: heights of the surface at the images' time (NAVD88), metres.
    pub dsm: PictureFile,
}

/// One file of the picture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PictureFile {
    /// Name in the scene's folder.
    pub file: &'static str,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixel corner grid, metres of EPSG:3857.
    pub geotransform: GeoTransform,
    /// Ground metres per pixel at the centre.
    pub pixel_metres: f64,
}

impl PictureFiles {
    /// The files of a scene whose picture has this grid.
    #[must_use]
    pub fn new(scene: &Scene, grid: &PictureGrid) -> Self {
        let file = |file, grid: &PictureGrid| PictureFile {
            file,
            width: grid.size[0],
            height: grid.size[1],
            geotransform: grid.geotransform(),
            pixel_metres: grid.ground_sample_distance(),
        };
        Self {
            crs: format!("EPSG:{CRS}"),
            picture: file(PICTURE_FILE, grid),
            dsm: file(TRUTH_FILE, &truth_grid(scene, grid)),
        }
    }
}

fn truth_grid(scene: &Scene, grid: &PictureGrid) -> PictureGrid {
    grid.truth(scene.spec.picture.map_or(1.0, |spec| spec.truth_spacing_pixels))
}

/// Writes the picture and its truth into a folder; memory is that of some bands of 256 rows.
///
/// # Errors
/// [`SceneError`] when a file cannot be written, or the run is interrupted.
pub fn write(
    scene: &Scene,
    grid: &PictureGrid,
    folder: &Path,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<(), SceneError> {
    crate::plan::runs("picture");
    let truth = truth_grid(scene, grid);
    let rows = (grid.size[1] + truth.size[1]) as usize;
    let progress = Progress::new("picture", "rows", rows, quiet);
    let mut writer = RgbWriter::create(&folder.join(PICTURE_FILE), &grid.spec(scene, None))?;
    for band in grid.bands() {
        writer.write_rows(&colours(scene, grid, &band, interrupt)?)?;
        progress.add(band.len() as u64);
    }
    writer.finish()?;
    let spec = truth.spec(scene, Some(LinearUnit::Metre));
    let mut writer = GeoTiffWriter::create(&folder.join(TRUTH_FILE), &spec)?;
    for band in truth.bands() {
        if interrupt.requested() {
            return Err(SceneError::Interrupted);
        }
        writer.write_rows(&heights(scene, &truth, &band)?)?;
        progress.add(band.len() as u64);
    }
    writer.finish()?;
    progress.finish();
    Ok(())
}

/// Colours of whole rows, three bytes a pixel.
fn colours(
    scene: &Scene,
    grid: &PictureGrid,
    rows: &Range<u32>,
    interrupt: &Interrupt,
) -> Result<Vec<u8>, SceneError> {
    let width = grid.size[0];
    let line = width as usize * 3;
    let mut out = vec![0; line * rows.len()];
    let seed = key(&[scene.spec.seed, purpose::PICTURE]);
    for start in (0..width).step_by(BLOCK_COLUMNS as usize) {
        if interrupt.requested() {
            return Err(SceneError::Interrupted);
        }
        let columns = start..(start + BLOCK_COLUMNS).min(width);
        let first = u64::from(rows.start) * u64::from(width) + u64::from(start);
        let sheet = Sheet { halo: 1, seed, first, pitch: u64::from(width) };
        let part = columns.len() * 3;
        let window = [columns, rows.clone()];
        let pixels = PixelPositions::of_window(&window, &scene.frame, 1, |p| grid.lonlat(p))?;
        let block = scene.render_sheet(&pixels, &sheet);
        for (from, to) in block.chunks_exact(part).zip(out.chunks_exact_mut(line)) {
            to[start as usize * 3..][..part].copy_from_slice(from);
        }
    }
    Ok(out)
}

/// Heights of the surface at the pixel centres of whole rows, metres.
fn heights(scene: &Scene, grid: &PictureGrid, rows: &Range<u32>) -> Result<Vec<f32>, SceneError> {
    let mut out = vec![0.0_f32; grid.size[0] as usize * rows.len()];
    out.par_chunks_mut(grid.size[0] as usize).zip(rows.clone()).try_for_each(|(line, row)| {
        let y = f64::from(row) + 0.5;
        for (column, height) in line.iter_mut().enumerate() {
            let x = column as f64 + 0.5;
            let at = scene.frame.to_local(grid.lonlat(PixelPoint { x, y }))?;
            *height = scene.surface(Epoch::Image, at[0], at[1]).height as f32;
        }
        Ok::<(), SceneError>(())
    })?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::effects::Options;
    use crate::scene::lidar::{Layer, Survey};
    use crate::scene::spec::{SceneSpec, SunSpec};
    use crate::scene::truth::Truth;

    fn scene(change: impl FnOnce(&mut SceneSpec)) -> Scene {
        let mut spec = SceneSpec::default();
        spec.extent.width_metres = 60.0;
        spec.extent.height_metres = 40.0;
        spec.sun = Some(SunSpec { azimuth_degrees: 200.0, elevation_degrees: 50.0 });
        spec.picture = Some(PictureSpec::default());
        change(&mut spec);
        Scene::new(spec, &Options::default()).expect("a scene")
    }

    fn grid(scene: &Scene) -> PictureGrid {
        PictureGrid::new(scene).expect("fits").expect("a picture")
    }

    fn all(scene: &Scene, grid: &PictureGrid) -> Vec<u8> {
        grid.bands()
            .flat_map(|rows| colours(scene, grid, &rows, &Interrupt::default()).expect("renders"))
            .collect()
    }

    /// Share of equal bytes, and the largest difference.
    fn compare(a: &[u8], b: &[u8]) -> (f64, u8) {
        assert_eq!(a.len(), b.len());
        let pairs = || a.iter().zip(b);
        let same = pairs().filter(|(a, b)| a == b).count() as f64 / a.len() as f64;
        (same, pairs().map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0))
    }

    #[test]
    fn the_picture_is_the_satellite_image_where_both_lie() {
        let scene = scene(|_| {});
        let grid = grid(&scene);
        let [width, height] = grid.size().map(|n| n as usize);
        // 60 x 40 m less what the turned corners and two lidar cells around take.
        assert!((540..=580).contains(&width) && (340..=380).contains(&height), "{width} {height}");
        let picture = all(&scene, &grid);
        let side = 200;
        let image =
            ImageGrid::new(grid.base.center(), 20, side as u32, side as u32).expect("a grid");
        let pixels = PixelPositions::new(&image, &scene.frame, 2).expect("projects");
        let rendered = scene.render(&pixels, 1);
        let (x, y) = ((width - side) / 2, (height - side) / 2);
        let inner = |rgb: &[u8], width: usize, x: usize, y: usize| -> Vec<u8> {
            // The image's outermost pixels have no neighbours to tell an edge by.
            (1..side - 1)
                .flat_map(|row| rgb[((y + row) * width + x + 1) * 3..][..(side - 2) * 3].to_vec())
                .collect()
        };
        let (same, worst) = compare(&inner(&picture, width, x, y), &inner(&rendered, side, 0, 0));
        assert!(same > 0.999, "{same} {worst}");
        // It is a picture: neighbours by one pixel are not the same.
        let (shifted, _) =
            compare(&inner(&picture, width, x + 1, y), &inner(&rendered, side, 0, 0));
        assert!(shifted < 0.9, "{shifted}");
        let truth = Truth::new(&scene, &pixels).dsm;
        let rows = y as u32..(y + side) as u32;
        let heights = heights(&scene, &grid, &rows).expect("projects");
        let mut other = 0;
        for (ours, theirs) in heights.chunks_exact(width).zip(truth.chunks_exact(side)) {
            let pairs = ours[x..x + side].iter().zip(theirs);
            other += pairs.filter(|(a, b)| (*a - *b).abs() > 1e-5).count();
        }
        assert!(other <= side * side / 1000, "{other}");
    }

    #[test]
    fn the_truth_is_the_survey_at_the_same_place() {
        let scene = scene(|_| {});
        let truth = grid(&scene).truth(2.5);
        let [width, height] = truth.size();
        assert_eq!(grid(&scene).size(), [width, height].map(|n| n * 5 / 2));
        let heights = heights(&scene, &truth, &(0..height)).expect("projects");
        let survey = Survey::new(&scene);
        let cell = 1.5 * US_SURVEY_FOOT_M;
        let to_pixel = truth.geotransform();
        let (mut near, mut count) = (0, 0);
        for (column, row) in (-30_i64..30).flat_map(|c| (-30_i64..30).map(move |r| (c, r))) {
            let (x, y) = ((column as f64 + 0.5) * cell, -(row as f64 + 0.5) * cell);
            let at = scene.frame.to_lonlat(x, y).expect("inverse");
            // By EPSG:3857's own formula and the geotransform that is in the file.
            let radius = crate::grid::WGS84_A;
            let projected = crate::grid::Projected {
                x: radius * at.lon_deg.to_radians(),
                y: radius * libm::asinh(libm::tan(at.lat_deg.to_radians())),
            };
            let p = to_pixel.to_pixel(projected);
            let i = p.y.floor() as usize * width as usize + p.x.floor() as usize;
            let z = survey.height(Layer::Dsm, column, row).expect("a height");
            count += 1;
            // Half a truth pixel of 0.25 m off, but for edges and crowns.
            near += usize::from((f64::from(heights[i]) - z).abs() < 0.1);
        }
        assert!(near as f64 > 0.75 * f64::from(count), "{near} of {count}");
    }

    #[test]
    fn parts_that_are_rendered_apart_join_without_a_seam() {
        // 1140 pixels: more than one block.
        let scene = scene(|s| {
            let size = PictureSpec { pixel_metres: Some(0.05), ..PictureSpec::default() };
            s.picture = Some(PictureSpec { height_metres: Some(16.0), ..size });
        });
        let grid = grid(&scene);
        let [width, height] = grid.size();
        assert!(width > BLOCK_COLUMNS + 20 && height > BAND_ROWS + 20, "{width} {height}");
        let picture = all(&scene, &grid);
        let window = [BLOCK_COLUMNS - 20..BLOCK_COLUMNS + 20, BAND_ROWS - 20..BAND_ROWS + 20];
        let pixels = PixelPositions::of_window(&window, &scene.frame, 1, |p| grid.lonlat(p))
            .expect("projects");
        let sheet = Sheet { halo: 1, seed: 0, first: 0, pitch: 0 };
        let part = scene.render_sheet(&pixels, &sheet);
        let [columns, rows] = window;
        let joined: Vec<u8> = rows
            .flat_map(|row| {
                let start = (row * width + columns.start) as usize * 3;
                picture[start..start + columns.len() * 3].to_vec()
            })
            .collect();
        let (same, worst) = compare(&joined, &part);
        assert!(same > 0.998, "{same} {worst}");
    }

    #[test]
    fn noise_is_of_its_place_in_the_picture_and_of_the_seed() {
        let noisy = |seed| {
            let scene = scene(|s| {
                s.images.sensor_noise_levels = 4.0;
                s.seed = seed;
                s.picture = Some(PictureSpec { zoom: Some(18), ..PictureSpec::default() });
            });
            all(&scene, &grid(&scene))
        };
        let first = noisy(1);
        assert_eq!(first, noisy(1));
        assert_ne!(first, noisy(2));
        let clean = scene(|s| {
            s.picture = Some(PictureSpec { zoom: Some(18), ..PictureSpec::default() });
        });
        let (same, _) = compare(&first, &all(&clean, &grid(&clean)));
        assert!(same < 0.3, "{same}");
    }

    #[test]
    fn sizes_are_as_asked_or_refused() {
        let asked = |width, height, metres| {
            let scene = scene(|s| {
                s.picture = Some(PictureSpec {
                    width_metres: width,
                    height_metres: height,
                    pixel_metres: metres,
                    ..PictureSpec::default()
                });
            });
            PictureGrid::new(&scene).map(|grid| grid.expect("a picture"))
        };
        let grid = asked(Some(30.0), Some(20.0), Some(0.25)).expect("fits");
        assert_eq!(grid.size(), [120, 80]);
        assert!((grid.ground_sample_distance() - 0.25).abs() < 1e-12);
        let corner = grid.geotransform();
        assert!((corner.0[1] * libm::cos(47.6097_f64.to_radians()) - 0.25).abs() < 1e-12);
        // Only the side that is not given gives way.
        let grid = asked(Some(30.0), None, Some(0.1)).expect("fits");
        assert!(grid.size()[0] == 300 && grid.size()[1] >= 340, "{:?}", grid.size());
        for (width, height, metres) in [
            (Some(60.0), Some(40.0), Some(0.1)),
            (Some(60.0), None, Some(0.1)),
            (None, None, Some(3.0)),
        ] {
            let error = asked(width, height, metres).expect_err("does not fit").to_string();
            assert!(error.contains("60 x 40 m") && error.contains("[extent] larger"), "{error}");
        }
        assert_eq!(PictureGrid::new(&scene(|s| s.picture = None)).expect("no picture"), None);
    }
}
