//! Cloud Optimized GeoTIFF (OGC 21-026) in memory.

use super::geokeys;
use super::predictor::Compression;
use super::tags::{self, Directory, Format, Value};
use super::tiles::{Cut, Places};
use super::writer::set_metadata;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;

const TILE: u32 = 256;
/// What GDAL writes between header and first directory: readers may rely on directories before data
/// and fetch a tile with its size in one request.
const STRUCTURE: &str = "GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\n\
    LAYOUT=IFDS_BEFORE_DATA\n\
    BLOCK_ORDER=ROW_MAJOR\n\
    BLOCK_LEADER=SIZE_AS_UINT4\n\
    BLOCK_TRAILER=LAST_4_BYTES_REPEATED\n\
    KNOWN_INCOMPATIBLE_EDITION=NO\n ";
/// Bytes of a tile's leader and of its trailer.
const AROUND_TILE: u64 = 4;

/// What [`encode_cog`] writes.
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

/// One resolution: its samples, compressed.
struct Level {
    cut: Cut,
    tiles: Vec<Vec<u8>>,
    places: Places,
}

/// Encodes heights (row-major, north first; NaN is no data) as a Cloud Optimized GeoTIFF: tiles of
/// 256 pixels, DEFLATE with predictor 3, overviews by averaging valid pixels down to 256 pixels.
///
/// # Panics
/// If there are not `width * height` heights, at least one.
#[must_use]
pub fn encode_cog(heights: &[f32], spec: &CogSpec) -> Vec<u8> {
    let pixels = spec.width as usize * spec.height as usize;
    assert!(pixels > 0 && heights.len() == pixels, "{} heights for {pixels}", heights.len());
    let mut levels = vec![Level::new(heights, spec.width, spec.height)];
    let (mut width, mut height) = (spec.width, spec.height);
    let mut coarse = Vec::new();
    while width.max(height) > TILE {
        let finer = if levels.len() == 1 { heights } else { &coarse };
        coarse = halve(finer, width as usize, height as usize);
        (width, height) = (width.div_ceil(2), height.div_ceil(2));
        levels.push(Level::new(&coarse, width, height));
    }
    let raw: u64 = levels.iter().map(|level| level.cut.raw_bytes()).sum();
    assemble(&mut levels, spec, if raw >= 3_500_000_000 { Format::Big } else { Format::Classic })
}

/// Header, structure, directories from fine to coarse, tiles from coarse to fine.
fn assemble(levels: &mut [Level], spec: &CogSpec, format: Format) -> Vec<u8> {
    let header = format.header(0).len() as u64;
    let first = (header + STRUCTURE.len() as u64).next_multiple_of(8);
    let sizes: Vec<u64> =
        (0..levels.len()).map(|i| levels[i].directory(i, spec).size(format)).collect();
    let mut end = first + sizes.iter().sum::<u64>();
    for level in levels.iter_mut().rev() {
        for (i, tile) in level.tiles.iter().enumerate() {
            level.places.offsets[i] = end + AROUND_TILE;
            level.places.counts[i] = tile.len() as u32;
            end += AROUND_TILE + tile.len() as u64 + AROUND_TILE;
        }
    }
    let mut out = Vec::with_capacity(end as usize);
    out.extend(format.header(first));
    out.extend(STRUCTURE.as_bytes());
    out.resize(first as usize, 0);
    for (i, level) in levels.iter().enumerate() {
        let start = out.len() as u64;
        let next = if i + 1 < levels.len() { start + sizes[i] } else { 0 };
        out.extend(level.directory(i, spec).encode(format, start, next));
    }
    for tile in levels.iter().rev().flat_map(|level| &level.tiles) {
        out.extend((tile.len() as u32).to_le_bytes());
        out.extend(tile);
        // A zlib stream has 6 bytes at least.
        out.extend_from_within(out.len() - AROUND_TILE as usize..);
    }
    out
}

impl Level {
    fn new(heights: &[f32], width: u32, height: u32) -> Self {
        let cut = Cut { width, height, chunk_width: TILE, chunk_height: TILE, tiled: true };
        let tiles = cut.compress(heights, Compression::Deflate);
        Self { cut, tiles, places: Places::unknown(&cut) }
    }

    /// The directory of resolution `index`, 0 being the full one.
    fn directory(&self, index: usize, spec: &CogSpec) -> Directory {
        let mut directory = Directory::default();
        self.cut.set_layout(&mut directory, Compression::Deflate, &self.places);
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
}

/// Half the resolution, rounded up: each pixel is the mean of the valid area that it covers, NaN if
/// there is none. An odd side of `2n - 1` pixels is spread over `n`, so that the extent stays.
fn halve(heights: &[f32], width: usize, height: usize) -> Vec<f32> {
    let (columns, rows) = (taps(width), taps(height));
    let mut out = Vec::with_capacity(columns.len() * rows.len());
    for row in &rows {
        for column in &columns {
            let (mut sum, mut weight) = (0.0_f64, 0.0_f64);
            for &(y, wy) in row {
                for &(x, wx) in column {
                    let value = heights[y * width + x];
                    if !value.is_nan() {
                        sum += wy * wx * f64::from(value);
                        weight += wy * wx;
                    }
                }
            }
            out.push(if weight > 0.0 { (sum / weight) as f32 } else { f32::NAN });
        }
    }
    out
}

/// The pixels that each pixel of half the resolution covers, with the share of each that it covers,
/// in units of `1 / n`: whole numbers, so that nothing rounds.
fn taps(size: usize) -> Vec<Vec<(usize, f64)>> {
    let n = size.div_ceil(2);
    (0..n)
        .map(|i| {
            let (from, to) = (i * size, (i + 1) * size);
            (from / n..to.div_ceil(n))
                .map(|x| (x, (to.min((x + 1) * n) - from.max(x * n)) as f64))
                .collect()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_even_side_halves_in_pairs_and_an_odd_one_keeps_its_extent() {
        assert_eq!(taps(4), [[(0, 2.0), (1, 2.0)], [(2, 2.0), (3, 2.0)]]);
        assert_eq!(taps(3), [[(0, 2.0), (1, 1.0)], [(1, 1.0), (2, 2.0)]]);
        assert_eq!(taps(1), [[(0, 1.0)]]);
        for size in 1..200 {
            let mut covered = vec![0.0; size];
            taps(size).iter().flatten().for_each(|(x, w)| covered[*x] += w);
            assert!(covered.iter().all(|w| *w == size.div_ceil(2) as f64), "{size}");
        }
    }

    #[test]
    fn averages_leave_out_what_is_not_valid() {
        let nan = f32::NAN;
        let heights = [1.0, 3.0, nan, nan, 5.0, nan, nan, nan];
        let half = halve(&heights, 4, 2);
        assert_eq!(half[0], 3.0);
        assert!(half[1].is_nan());
        // An odd side: (2 a + b) / 3 and (b + 2 c) / 3.
        assert_eq!(halve(&[3.0, 6.0, 9.0], 3, 1), [4.0, 8.0]);
    }

    #[test]
    fn the_structure_says_its_own_size() {
        let after = STRUCTURE.find('\n').map(|end| STRUCTURE.len() - end - 1);
        assert_eq!(after, Some(140));
    }
}
