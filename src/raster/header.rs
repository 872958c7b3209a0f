//! What both readers make of a header in the same way.

use super::sample::{SampleDecoder, SampleType, declared_nodata};
use super::vertical_unit;
use super::{OpenOptions, RasterError, RasterHeader};
use crate::crs::CrsSpec;
use crate::grid::GeoTransform;
use std::fs::Metadata;
use std::path::Path;
use std::time::UNIX_EPOCH;

/// Blocks are handed out in pieces of about this many samples (256 KiB of heights), so that a cache
/// holds neither thousands of single rows nor whole files.
const BLOCK_SAMPLES: u32 = 64 * 1024;
/// Side of a square of that many samples.
const BLOCK_SIDE: u32 = 256;

/// What GDAL reports where a file has no georeference.
const NO_GEOREFERENCE: GeoTransform = GeoTransform([0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);

impl RasterHeader {
    /// Whether the raster can serve as a lidar tile: a north-up grid with a size, in a projected
    /// CRS. Set [`RasterHeader::crs`] first where the user overrides it.
    ///
    /// # Errors
    /// [`RasterError::Unusable`] with the reason and what to do.
    pub fn check_usable(&self) -> Result<(), RasterError> {
        self.check_grid()?;
        let reason = match &self.crs {
            None => "the raster has no coordinate reference system; state it with --crs, or write \
                     it into the file with gdal_edit.py -a_srs"
                .to_owned(),
            Some(crs) if crs.geographic => format!(
                "the raster's pixels are in degrees (CRS `{}`); project it first, for example with \
                 gdalwarp -t_srs to the UTM zone",
                crs.name
            ),
            Some(_) => return Ok(()),
        };
        Err(RasterError::Unusable { path: self.path.clone(), reason })
    }

    /// Whether the raster is a north-up grid with a size, whatever its CRS.
    ///
    /// # Errors
    /// [`RasterError::Unusable`] with the reason and what to do.
    pub fn check_grid(&self) -> Result<(), RasterError> {
        let c = &self.geotransform.0;
        let reason = if self.width == 0 || self.height == 0 {
            format!("the raster has zero size ({} x {} pixels)", self.width, self.height)
        } else if self.geotransform == NO_GEOREFERENCE {
            "the raster has no georeference (no pixel size and origin); write one with gdal_edit.py \
             -a_ullr or gdal_translate -a_ullr"
                .to_owned()
        } else if c.iter().any(|v| !v.is_finite()) {
            format!("the raster's georeference is not finite ({c:?})")
        } else if c[2] != 0.0 || c[4] != 0.0 {
            format!(
                "the raster's grid is rotated (geotransform {c:?}); make it north-up with gdalwarp"
            )
        } else if !self.geotransform.is_north_up() {
            format!(
                "the raster is stored south up or mirrored (pixel size {} x {}); make it north-up \
                 with gdalwarp",
                c[1], c[5]
            )
        } else {
            return Ok(());
        };
        Err(RasterError::Unusable { path: self.path.clone(), reason })
    }

    /// Number of blocks in a row and number of rows of blocks.
    #[must_use]
    pub fn blocks(&self) -> (u32, u32) {
        (
            self.width.div_ceil(self.block_width.max(1)),
            self.height.div_ceil(self.block_height.max(1)),
        )
    }

    /// Columns and rows of block (`bx`, `by`) that lie inside the raster, with its first column and
    /// row; `None` where there is no such block.
    pub(super) fn block_rectangle(&self, bx: u32, by: u32) -> Option<Rectangle> {
        let (across, down) = self.blocks();
        (bx < across && by < down).then(|| {
            let (x, y) = (bx * self.block_width, by * self.block_height);
            Rectangle {
                x: x as usize,
                y: y as usize,
                width: self.block_width.min(self.width - x) as usize,
                height: self.block_height.min(self.height - y) as usize,
            }
        })
    }

    /// The error of a block that is not there.
    pub(super) fn no_such_block(&self, bx: u32, by: u32) -> RasterError {
        let (across, down) = self.blocks();
        self.block_error(bx, by, format!("the raster has {across} x {down} blocks"))
    }

    /// An error of one block.
    pub(super) fn block_error(&self, bx: u32, by: u32, reason: String) -> RasterError {
        RasterError::Block { path: self.path.clone(), column: bx, row: by, reason }
    }
}

/// A part of a raster that lies inside it, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rectangle {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

/// Size of the blocks that a reader hands out, from the size of the file's own: small ones are
/// merged, none is split.
pub(super) fn block_size(raster: (u32, u32), stored: (u32, u32)) -> (u32, u32) {
    let (width, height) = (stored.0.max(1), stored.1.max(1));
    let (columns, rows) = if width >= raster.0 {
        (1, BLOCK_SAMPLES / width.saturating_mul(height).max(1))
    } else {
        (BLOCK_SIDE / width, BLOCK_SIDE / height)
    };
    (
        width.saturating_mul(columns.max(1)).min(raster.0),
        height.saturating_mul(rows.max(1)).min(raster.1),
    )
}

/// Refuses strips and tiles that do not fit into the memory allowed. `stored_bytes` are the bytes
/// of one decompressed strip or tile.
pub(super) fn check_memory(
    path: &Path,
    options: &OpenOptions,
    stored: (u32, u32),
    block: (u32, u32),
    stored_bytes: u64,
) -> Result<(), RasterError> {
    let heights = u64::from(block.0) * u64::from(block.1) * size_of::<f32>() as u64;
    let bytes = stored_bytes.saturating_add(heights);
    let limit = options.memory_limit as u64;
    if bytes <= limit {
        return Ok(());
    }
    let what = format!("strip or tile of {} x {} pixels", stored.0, stored.1);
    Err(RasterError::TooLarge { path: path.to_owned(), what, bytes, limit })
}

/// The operating system's view of the file.
pub(super) fn stat(path: &Path) -> Result<Metadata, RasterError> {
    let unreadable =
        |reason: &str| RasterError::Unreadable { path: path.to_owned(), reason: reason.to_owned() };
    let metadata = std::fs::metadata(path)
        .map_err(|source| RasterError::Io { path: path.to_owned(), source })?;
    if metadata.is_dir() {
        return Err(unreadable("is a folder, not a raster file"));
    }
    if metadata.len() == 0 {
        return Err(unreadable("the file is empty (0 bytes)"));
    }
    Ok(metadata)
}

/// What a backend found, before both are treated alike.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) geotransform: Option<GeoTransform>,
    pub(super) crs: Option<CrsSpec>,
    pub(super) sample_type: SampleType,
    pub(super) nodata: Option<f64>,
    pub(super) scale: f64,
    pub(super) offset: f64,
    pub(super) band_unit: String,
    /// Metadata items of the dataset and of band 1.
    pub(super) metadata: Vec<(String, String)>,
    pub(super) block: (u32, u32),
    pub(super) compression: String,
    pub(super) overviews: u32,
    pub(super) bands: u32,
    pub(super) has_mask: bool,
    pub(super) warnings: Vec<String>,
}

/// Makes the header and the decoder of its samples.
pub(super) fn finish(
    path: &Path,
    metadata: &Metadata,
    options: &OpenOptions,
    found: Found,
) -> Result<(RasterHeader, SampleDecoder), RasterError> {
    let unreadable = |reason: String| RasterError::Unreadable { path: path.to_owned(), reason };
    if !(found.scale.is_finite() && found.scale != 0.0 && found.offset.is_finite()) {
        return Err(unreadable(format!(
            "the band's scale {} and offset {} make no heights",
            found.scale, found.offset
        )));
    }
    let mut warnings = found.warnings;
    let (nodata, impossible) = declared_nodata(found.sample_type, found.nodata);
    warnings.extend(impossible);
    let unit = vertical_unit::detect(found.crs.as_ref(), &found.band_unit, &found.metadata);
    warnings.extend(unit.warnings);

    let modified = metadata
        .modified()
        .ok()
        .and_then(|time| time.duration_since(UNIX_EPOCH).ok())
        .map_or((0, 0), |age| (age.as_secs(), age.subsec_nanos()));
    let decoder = SampleDecoder::new(
        found.sample_type,
        options.nodata,
        found.nodata,
        found.scale,
        found.offset,
    );
    let header = RasterHeader {
        path: path.to_owned(),
        width: found.width,
        height: found.height,
        geotransform: found.geotransform.unwrap_or(NO_GEOREFERENCE),
        crs: found.crs,
        sample_type: found.sample_type.name().to_owned(),
        nodata,
        scale: found.scale,
        offset: found.offset,
        vertical_unit: unit.unit,
        block_width: found.block.0,
        block_height: found.block.1,
        compression: found.compression,
        overviews: found.overviews,
        bands: found.bands,
        has_mask: found.has_mask,
        size_bytes: metadata.len(),
        modified,
        warnings,
    };
    Ok((header, decoder))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_strips_are_merged_and_nothing_is_split() {
        for (raster, stored, expected) in [
            ((1000, 1000), (1000, 2), (1000, 64)),
            ((761, 844), (761, 3), (761, 84)),
            ((381, 1), (381, 1), (381, 1)),
            ((20_000, 20_000), (20_000, 1), (20_000, 3)),
            ((100_000, 10), (100_000, 1), (100_000, 1)),
            ((2000, 2000), (2000, 2000), (2000, 2000)),
            ((1024, 683), (256, 256), (256, 256)),
            ((4000, 4000), (128, 128), (256, 256)),
            ((4000, 4000), (512, 512), (512, 512)),
            ((4000, 4000), (16, 640), (256, 640)),
            ((100, 90), (256, 256), (100, 90)),
            ((300, 90), (256, 256), (256, 90)),
        ] {
            let block = block_size(raster, stored);
            assert_eq!(block, expected, "{raster:?} {stored:?}");
        }
    }
}
