//! The DSM of a city as one file: a Cloud Optimized GeoTIFF in metres above the bottom of the scene, written
//! from the slabs in bands of rows, so that memory does not grow with the area.

mod grid;
mod preview;

#[cfg(test)]
mod tests;

pub use grid::DsmGrid;
pub(super) use grid::TRANSFORM_BUDGET_M;

use super::city::City;
use super::seams::{SeamCounter, SeamMeasure, Windows};
use super::slabs::Slabs;
use crate::batch::{OutputFile, sync_folder, write_atomic};
use crate::crs::{CrsError, CrsSpec};
use crate::grid::GeoTransform;
use crate::lidar::WarpError;
use crate::plan::runs;
use crate::raster::geotiff::{CogSpec, CogWriter, GeoTiffError};
use crate::units::LinearUnit;
use preview::Preview;
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// Rows that are read and written at once.
const BAND: u32 = 256;

/// How the DSM of a city is written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DsmOptions {
    /// Name of the file in the output folder, for example `city.tif`.
    pub name: String,
    /// The CRS of the file; `None` for the picture's own.
    pub t_srs: Option<CrsSpec>,
    /// Also a hillshaded picture, named by [`preview_name`].
    pub preview: bool,
    /// Windows of the run, to measure its seams.
    pub windows: Option<Windows>,
    /// Metadata items beside those that every DSM has (window, stride, blend, weights).
    pub metadata: Vec<(String, String)>,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DsmFile {
    /// The GeoTIFF.
    pub dsm: OutputFile,
    /// The picture of it.
    pub preview: Option<OutputFile>,
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// From pixels to the CRS, or to metres from the north-west corner.
    pub geotransform: GeoTransform,
    /// The CRS, as messages call it; `None` where the place is not known.
    pub crs: Option<String>,
    /// Ground metres per pixel, across and down, at the centre.
    pub gsd_m: [f64; 2],
    /// Pixels without a height: no surface, no picture, or outside of the city.
    pub empty_px: u64,
    /// Lowest height, metres; `None` where there is none.
    pub min_m: Option<f64>,
    /// Highest height.
    pub max_m: Option<f64>,
    /// Mean height.
    pub mean_m: Option<f64>,
    /// Jumps at the borders of windows, measured on the city's own grid.
    pub seams: Option<SeamMeasure>,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Why a DSM cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum DsmError {
    /// A slab is missing or cannot be read; the text names it.
    #[error("{source}")]
    Slabs {
        /// What the system said.
        source: io::Error,
    },
    /// The GeoTIFF cannot be written.
    #[error(transparent)]
    GeoTiff(#[from] GeoTiffError),
    /// Another file cannot be written, or one that was written cannot be read again.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Another CRS was asked for, and nothing says where the city lies.
    #[error(
        "the picture's place is not known, so its DSM cannot be brought into another coordinate reference system; leave --t_srs out, or give the picture a georeference (gdal_translate -a_srs EPSG:... -a_ullr ...)"
    )]
    NoPlace,
    /// A CRS with a vertical part was asked for.
    #[error(
        "--t_srs {crs} has a vertical datum, and heights above the bottom of a scene have none; name its horizontal part only"
    )]
    Vertical {
        /// The CRS.
        crs: String,
    },
    /// The CRS cannot be served, or is undefined at the city.
    #[error("the DSM cannot be brought into {crs}: {source}")]
    Crs {
        /// The CRS asked for.
        crs: String,
        /// Why.
        source: CrsError,
    },
    /// Resampling failed.
    #[error("the DSM cannot be brought into another coordinate reference system: {source}")]
    Warp {
        /// Why.
        source: WarpError,
    },
}

/// Name of the picture of a DSM: `city.tif` and `city_dsm.tif` have `city_dsm_preview.png`.
#[must_use]
pub fn preview_name(name: &str) -> String {
    let path = Path::new(name);
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let stem = stem.strip_suffix("_dsm").unwrap_or(&stem);
    path.with_file_name(format!("{stem}_dsm_preview.png")).to_string_lossy().into_owned()
}

/// Writes the DSM of finished slabs into their output folder, and what was asked for beside it. `progress` is
/// told the rows that are done, and how many there are in all. The same slabs give the same bytes, for any
/// number of threads.
///
/// # Errors
/// [`DsmError`]; the files are then as they were.
pub fn write_dsm(
    slabs: &Slabs<'_>,
    options: &DsmOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<DsmFile, DsmError> {
    let city = slabs.city;
    runs("dsm");
    runs("storage");
    let grid = DsmGrid::new(city, options.t_srs.as_ref())?;
    if !grid.is_own() {
        runs("warp");
    }
    let target = slabs.out.join(&options.name);
    let mut writer = CogWriter::create(&target, &cog_spec(city, &grid, &options.metadata))?;
    let side = (grid.gsd_m[0] * grid.gsd_m[1]).sqrt();
    let mut preview = options.preview.then(|| Preview::new(grid.size_px, side));
    let mut seams = options.windows.as_ref().map(|windows| SeamCounter::new(city.size, windows));
    let mut heights = Heights::default();

    let again = seams.is_some() && !grid.is_own();
    let height = grid.size_px[1];
    let all = u64::from(height) + if again { u64::from(city.size[1]) } else { 0 };
    for (start, end) in bands(height) {
        let rows = grid.rows(slabs, start..end)?;
        writer.write_rows(&rows)?;
        heights.add(&rows);
        if let Some(preview) = &mut preview {
            preview.add(&rows);
        }
        if let Some(seams) = seams.as_mut().filter(|_| !again) {
            seams.add(&rows);
        }
        progress(u64::from(end), all);
    }
    if let Some(seams) = seams.as_mut().filter(|_| again) {
        // Windows lie on the city's own grid.
        for (start, end) in bands(city.size[1]) {
            let rows = slabs.heights([0..city.size[0], start..end]);
            seams.add(&rows.map_err(|source| DsmError::Slabs { source })?);
            progress(u64::from(height) + u64::from(end), all);
        }
    }

    let wrong = |path: &Path, source| DsmError::Io { path: path.to_owned(), source };
    let preview = match preview {
        Some(preview) => {
            let (name, bytes) = (preview_name(&options.name), preview.finish());
            let path = slabs.out.join(&name);
            write_atomic(&path, &bytes).map_err(|source| wrong(&path, source))?;
            Some(OutputFile::of(&name, &bytes))
        }
        None => None,
    };
    writer.finish()?;
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty());
    sync_folder(folder.unwrap_or(Path::new("."))).map_err(|source| wrong(&target, source))?;
    let dsm =
        OutputFile::measure(slabs.out, &options.name).map_err(|source| wrong(&target, source))?;
    Ok(DsmFile {
        dsm,
        preview,
        size_px: grid.size_px,
        geotransform: grid.geotransform,
        crs: grid.crs.as_ref().map(CrsSpec::label),
        gsd_m: grid.gsd_m,
        empty_px: heights.empty,
        min_m: (heights.count > 0).then_some(f64::from(heights.low)),
        max_m: (heights.count > 0).then_some(f64::from(heights.high)),
        mean_m: (heights.count > 0).then(|| heights.sum / heights.count as f64),
        seams: seams.map(|seams| seams.finish()),
        warnings: grid.warnings,
    })
}

/// First and last row of each band.
fn bands(height: u32) -> impl Iterator<Item = (u32, u32)> {
    (0..height).step_by(BAND as usize).map(move |start| (start, (start + BAND).min(height)))
}

/// What the GeoTIFF says, beginning with what `sat3d infer` says of its own.
fn cog_spec(city: &City, grid: &DsmGrid, more: &[(String, String)]) -> CogSpec {
    let [across, down] = city.gsd_m();
    let own = [
        ("TIFFTAG_SOFTWARE", format!("sat3d {}", env!("CARGO_PKG_VERSION"))),
        (
            "VERTICAL_DATUM",
            "none: heights are above the bottom of the scene, an arbitrary zero".to_owned(),
        ),
        // As `infer` counts: the whole height of the cube.
        ("METRES_PER_UNIT", (2.0 * city.vertical_m).to_string()),
        ("MODEL_PIXEL_M", format!("{across} {down}")),
        ("MODEL_PIXEL_FROM", if city.assumed { "assumed" } else { "picture" }.to_owned()),
    ];
    let own = own.map(|(key, value)| (key.to_owned(), value));
    CogSpec {
        width: grid.size_px[0],
        height: grid.size_px[1],
        geotransform: grid.geotransform,
        epsg: grid.crs.as_ref().and_then(|crs| crs.epsg).unwrap_or(0),
        vertical_epsg: None,
        unit: Some(LinearUnit::Metre),
        metadata: own.into_iter().chain(more.iter().cloned()).collect(),
    }
}

/// Lowest, highest and mean of the heights.
#[derive(Debug)]
struct Heights {
    low: f32,
    high: f32,
    sum: f64,
    count: u64,
    empty: u64,
}

impl Default for Heights {
    fn default() -> Self {
        Self { low: f32::INFINITY, high: f32::NEG_INFINITY, sum: 0.0, count: 0, empty: 0 }
    }
}

impl Heights {
    fn add(&mut self, rows: &[f32]) {
        let (mut sum, mut count) = (0.0_f64, 0);
        for &height in rows.iter().filter(|height| !height.is_nan()) {
            (self.low, self.high) = (self.low.min(height), self.high.max(height));
            sum += f64::from(height);
            count += 1;
        }
        self.sum += sum;
        self.count += count;
        self.empty += rows.len() as u64 - count;
    }
}
