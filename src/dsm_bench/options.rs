//! What a user can ask of a benchmark build.

use super::{Coverage, ImageSource};
use crate::batch::{Shard, Verify};
use crate::lidar::{EdgeRule, Resampling, TransformForm};
use crate::raster::NodataRule;
use crate::units::LinearUnit;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Which grid an image has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GridKind {
    /// The exact pixel centres of the Web-Mercator image.
    WebMercator,
    /// The reference implementation's axis-aligned box in the tiles' CRS, for comparison with
    /// published numbers only: up to 21 px (2.1 m) off.
    Reference,
}

impl GridKind {
    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::WebMercator => "web-mercator",
            Self::Reference => "reference",
        }
    }
}

/// How pixels are taken to the tiles' CRS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TransformChoice {
    /// The cheapest form whose bound is within the tolerance, image by image.
    Auto,
    /// This form, whatever its bound.
    Forced(TransformForm),
}

impl TransformChoice {
    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Forced(form) => form.name(),
        }
    }
}

/// Rounding of heights to multiples of a step, for smaller files.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantisation {
    /// Step in metres; the error is at most half of it.
    pub step_m: f64,
}

/// Everything that `sat3d dsm-bench build` can be asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct BuildOptions {
    /// Lidar DSM tiles: folders, files or VRTs.
    pub lidar: Vec<PathBuf>,
    /// Bare-earth tiles for the key `dtm`.
    pub dtm: Vec<PathBuf>,
    /// The images.
    pub images: ImageSource,
    /// Output folder.
    pub out: PathBuf,
    /// Zoom of the images.
    pub zoom: u8,
    /// Pixels across and down.
    pub size: u32,
    /// Largest share of pixels without data, per cent.
    pub max_nan_pct: f64,
    /// Grid of an image.
    pub grid: GridKind,
    /// Transform.
    pub transform: TransformChoice,
    /// Horizontal budget, metres.
    pub tolerance_m: f64,
    /// `--operation`.
    pub operation: Option<String>,
    /// `--proj-network`.
    pub proj_network: bool,
    /// `--crs`: overrides what tiles say.
    pub crs: Option<String>,
    /// Kernel.
    pub resampling: Resampling,
    /// Rule at the border of valid data.
    pub edge: EdgeRule,
    /// No-data rule.
    pub nodata: NodataRule,
    /// `--vertical-unit`: overrides what tiles say.
    pub vertical_unit: Option<LinearUnit>,
    /// How several tiles make one DSM.
    pub coverage: Coverage,
    /// Also writes which tile each pixel came from.
    pub source_tile: bool,
    /// Rounding of heights.
    pub quantise: Option<Quantisation>,
    /// Also a Cloud Optimized GeoTIFF per image.
    pub geotiff: bool,
    /// EPSG code of the heights' vertical CRS, for the GeoTIFF and the metadata.
    pub vertical_crs: Option<u32>,
    /// Also a hillshaded picture per image.
    pub preview: bool,
    /// Also a STAC collection.
    pub stac: bool,
    /// Bytes for cached blocks.
    pub memory: usize,
    /// Worker threads.
    pub threads: usize,
    /// Part of the batch.
    pub shard: Shard,
    /// How earlier results are checked.
    pub verify: Verify,
    /// Replaces results of another plan.
    pub overwrite: bool,
    /// No progress output.
    pub quiet: bool,
}

impl BuildOptions {
    /// The defaults of the command line.
    #[must_use]
    pub fn new(lidar: Vec<PathBuf>, images: ImageSource, out: PathBuf) -> Self {
        Self {
            lidar,
            dtm: Vec::new(),
            images,
            out,
            zoom: 20,
            size: 640,
            max_nan_pct: 5.0,
            grid: GridKind::WebMercator,
            transform: TransformChoice::Auto,
            tolerance_m: 1e-6,
            operation: None,
            proj_network: false,
            crs: None,
            resampling: Resampling::Bilinear,
            edge: EdgeRule::Renormalise,
            nodata: NodataRule::FromFile,
            vertical_unit: None,
            coverage: Coverage::BestTile,
            source_tile: false,
            quantise: None,
            geotiff: false,
            vertical_crs: None,
            preview: false,
            stac: false,
            memory: 256 << 20,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            shard: Shard::WHOLE,
            verify: Verify::Quick,
            overwrite: false,
            quiet: false,
        }
    }
}
