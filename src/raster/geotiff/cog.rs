//! Cloud Optimized GeoTIFF (OGC 21-026): what it says, and its encoding in memory.

use super::geokeys;
use super::predictor::Compression;
use super::pyramid::{self, Level};
use super::tags::{self, Directory, Format, Value};
use super::writer::set_metadata;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;

/// What GDAL writes between header and first directory: readers may rely on directories before data
/// and fetch a tile with its size in one request.
const STRUCTURE: &str = "GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\n\
    LAYOUT=IFDS_BEFORE_DATA\n\
    BLOCK_ORDER=ROW_MAJOR\n\
    BLOCK_LEADER=SIZE_AS_UINT4\n\
    BLOCK_TRAILER=LAST_4_BYTES_REPEATED\n\
    KNOWN_INCOMPATIBLE_EDITION=NO\n ";

/// What [`encode_cog`] and [`CogWriter`](super::CogWriter) write.
#[derive(Clone, Debug, PartialEq)]
pub struct CogSpec {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixel corner grid in CRS units.
    pub geotransform: GeoTransform,
    /// EPSG code of the horizontal CRS; 0 writes no CRS.
    pub epsg: u32,
    /// EPSG code of the vertical CRS, which makes the CRS a compound one.
    pub vertical_epsg: Option<u32>,
    /// Unit of the heights, written as the band's unit.
    pub unit: Option<LinearUnit>,
    /// Metadata items of the dataset; `TIFFTAG_SOFTWARE` goes into TIFF's own tag.
    pub metadata: Vec<(String, String)>,
}

impl Default for CogSpec {
    fn default() -> Self {
        Self {
            width: 0,
            height: 0,
            geotransform: GeoTransform::north_up(0.0, 0.0, 1.0, 1.0),
            epsg: 0,
            vertical_epsg: None,
            unit: None,
            metadata: Vec::new(),
        }
    }
}

/// Encodes heights (row-major, north first; NaN is no data) as a Cloud Optimized GeoTIFF: tiles of
/// 256 pixels, DEFLATE with predictor 3, overviews by averaging valid pixels down to 256 pixels. Of
/// rasters that do not fit memory [`CogWriter`](super::CogWriter) makes the same bytes.
///
/// # Panics
/// If there are not `width * height` heights, at least one.
#[must_use]
pub fn encode_cog(heights: &[f32], spec: &CogSpec) -> Vec<u8> {
    let format = Format::of_raw(pyramid::raw_bytes(spec.width, spec.height));
    encode_cog_as(heights, spec, format)
}

pub(super) fn encode_cog_as(heights: &[f32], spec: &CogSpec, format: Format) -> Vec<u8> {
    let pixels = spec.width as usize * spec.height as usize;
    assert!(pixels > 0 && heights.len() == pixels, "{} heights for {pixels}", heights.len());
    let made =
        pyramid::levels(spec.width, spec.height, || Ok(Vec::new())).and_then(|mut levels| {
            pyramid::take_rows(&mut levels, heights)?;
            pyramid::finish(&mut levels)?;
            Ok(levels)
        });
    let mut levels = made.expect("writing to memory cannot fail");
    let mut out = head(&mut levels, spec, format);
    out.reserve_exact(levels.iter().map(|level| level.spool.len()).sum());
    while let Some(level) = levels.pop() {
        out.extend(level.spool);
    }
    out
}

/// All that lies before the tiles: header, structure, directories from fine to coarse. The tiles of `levels`,
/// which are finished, follow from coarse to fine; their places become those in the file.
pub(super) fn head<S>(levels: &mut [Level<S>], spec: &CogSpec, format: Format) -> Vec<u8> {
    let header = format.header(0).len() as u64;
    let first = (header + STRUCTURE.len() as u64).next_multiple_of(8);
    let sizes: Vec<u64> = levels
        .iter()
        .enumerate()
        .map(|(i, level)| directory(i, level, spec).size(format))
        .collect();
    let mut end = first + sizes.iter().sum::<u64>();
    for level in levels.iter_mut().rev() {
        level.places.offsets.iter_mut().for_each(|offset| *offset += end);
        end += level.bytes;
    }
    let mut out = format.header(first);
    out.extend(STRUCTURE.as_bytes());
    out.resize(first as usize, 0);
    for (i, level) in levels.iter().enumerate() {
        let start = out.len() as u64;
        let next = if i + 1 < levels.len() { start + sizes[i] } else { 0 };
        out.extend(directory(i, level, spec).encode(format, start, next));
    }
    out
}

/// The directory of resolution `index`, 0 being the full one.
fn directory<S>(index: usize, level: &Level<S>, spec: &CogSpec) -> Directory {
    let mut directory = Directory::default();
    level.cut.set_layout(&mut directory, Compression::Deflate, &level.places);
    directory.set(tags::GDAL_NODATA, tags::nodata(f64::NAN));
    if index > 0 {
        // A reduced image of another one in this file.
        directory.set(tags::NEW_SUBFILE_TYPE, Value::Long(vec![1]));
    } else {
        geokeys::set_geotransform(&mut directory, &spec.geotransform);
        geokeys::set_crs(&mut directory, spec.epsg, spec.vertical_epsg);
        set_metadata(&mut directory, spec.unit, &spec.metadata);
    }
    directory
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_structure_says_its_own_size() {
        let after = STRUCTURE.find('\n').map(|end| STRUCTURE.len() - end - 1);
        assert_eq!(after, Some(140));
    }
}
