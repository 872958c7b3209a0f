//! A Cloud Optimized GeoTIFF of one grid of heights.

use super::block::{self, Window};
use super::georeference::{self, CrsKeys};
use super::tags::{Directory, Flavour, NEW_SUBFILE_TYPE, TILE_BYTE_COUNTS, TILE_OFFSETS, Value};
use super::{Image, Layout, SampleType, TiffCompression};
use crate::grid::GeoTransform;
use crate::units::LinearUnit;

/// What a Cloud Optimized GeoTIFF shall be.
#[derive(Clone, Debug, PartialEq)]
pub struct CogSpec {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The pixel corner grid in CRS units (PixelIsArea).
    pub geotransform: GeoTransform,
    /// EPSG code of the projected CRS.
    pub epsg: u32,
    /// Unit of its axes, written beside the code where given.
    pub linear_unit: Option<LinearUnit>,
    /// EPSG code of the vertical CRS, which makes the CRS a compound one.
    pub vertical_epsg: Option<u32>,
    /// Unit of the heights.
    pub unit: Option<LinearUnit>,
    /// Width and height of a tile: a multiple of 16, 256 or 512 by custom.
    pub tile_size: u32,
    /// Free metadata; GDAL's `TIFFTAG_SOFTWARE` and its like become TIFF's own tags.
    pub metadata: Vec<(String, String)>,
}

impl Default for CogSpec {
    fn default() -> Self {
        Self {
            width: 0,
            height: 0,
            geotransform: GeoTransform::north_up(0.0, 0.0, 1.0, 1.0),
            epsg: 3857,
            linear_unit: None,
            vertical_epsg: None,
            unit: None,
            tile_size: 256,
            metadata: Vec::new(),
        }
    }
}

/// What GDAL's reader learns from the bytes after the header: directories come first, tiles follow
/// in row order, each after its size (4 bytes) and before a copy of its last 4 bytes.
const STRUCTURE: &str = "LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\n\
    BLOCK_LEADER=SIZE_AS_UINT4\nBLOCK_TRAILER=LAST_4_BYTES_REPEATED\n\
    KNOWN_INCOMPATIBLE_EDITION=NO\n ";
const LEADER: u64 = 4;
const TRAILER: u64 = 4;

/// One resolution, its tiles packed.
struct Level {
    width: u32,
    height: u32,
    tiles: Vec<Vec<u8>>,
}

/// Encodes heights (row-major, NaN = no data) as a Cloud Optimized GeoTIFF: DEFLATE with predictor
/// 3, NaN as the no-data value, and overviews of half the size each, down to one tile. A pixel of an
/// overview is the mean of the valid pixels of the full resolution that it covers, NaN where there
/// are none.
///
/// # Panics
/// Where `heights` are not `width * height` values, at least one, or the tile size is no positive
/// multiple of 16: mistakes of the caller, never of the data.
#[must_use]
pub fn encode_cog(heights: &[f32], spec: &CogSpec) -> Vec<u8> {
    let (width, height) = (spec.width as usize, spec.height as usize);
    assert!(!heights.is_empty() && heights.len() == width * height, "{width} x {height} heights");
    assert!(spec.tile_size > 0 && spec.tile_size.is_multiple_of(16), "tile size");

    let mut levels = vec![pack(heights, spec.width, spec.height, spec.tile_size)];
    let mut sums = Sums::of(heights, width, height);
    while sums.width.max(sums.height) > spec.tile_size as usize {
        sums = sums.halved();
        levels.push(pack(&sums.means(), sums.width as u32, sums.height as u32, spec.tile_size));
    }

    // A classic TIFF ends at 4 GB; directories take far less than a tenth of what they describe.
    let data: u64 = levels.iter().flat_map(|l| &l.tiles).map(|t| t.len() as u64 + 8).sum();
    let flavour = if data > 3 << 30 { Flavour::Big } else { Flavour::Classic };
    assemble(spec, &levels, flavour)
}

fn pack(heights: &[f32], width: u32, height: u32, tile: u32) -> Level {
    let size = tile as usize;
    let mut tiles = Vec::new();
    for row in (0..height as usize).step_by(size) {
        for column in (0..width as usize).step_by(size) {
            let window = Window { column, row, width: size, height: size };
            let deflate = TiffCompression::Deflate;
            tiles.push(block::encode(heights, width as usize, 1, window, None, deflate));
        }
    }
    Level { width, height, tiles }
}

/// Sums and counts of valid heights, so that every overview is a mean of full-resolution pixels.
struct Sums {
    width: usize,
    height: usize,
    cells: Vec<(f64, u32)>,
}

impl Sums {
    fn of(heights: &[f32], width: usize, height: usize) -> Self {
        let cell = |&h: &f32| if h.is_nan() { (0.0, 0) } else { (f64::from(h), 1) };
        Self { width, height, cells: heights.iter().map(cell).collect() }
    }

    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut cells = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let mut cell = (0.0, 0);
                for row in 2 * y..(2 * y + 2).min(self.height) {
                    for column in 2 * x..(2 * x + 2).min(self.width) {
                        let (sum, count) = self.cells[row * self.width + column];
                        cell.0 += sum;
                        cell.1 += count;
                    }
                }
                cells.push(cell);
            }
        }
        Self { width, height, cells }
    }

    fn means(&self) -> Vec<f32> {
        let mean = |&(sum, count): &(f64, u32)| {
            if count == 0 { f32::NAN } else { (sum / f64::from(count)) as f32 }
        };
        self.cells.iter().map(mean).collect()
    }
}

fn assemble(spec: &CogSpec, levels: &[Level], flavour: Flavour) -> Vec<u8> {
    let ghost = format!("GDAL_STRUCTURAL_METADATA_SIZE={:06} bytes\n{STRUCTURE}", STRUCTURE.len());
    let mut directories: Vec<Directory> =
        levels.iter().enumerate().map(|(n, level)| directory(spec, n, level)).collect();

    let first = ((flavour.header(0).len() + ghost.len()) as u64).next_multiple_of(8);
    let mut positions = Vec::with_capacity(levels.len());
    let mut at = first;
    for directory in &directories {
        positions.push(at);
        at += directory.byte_len(flavour);
    }
    // The data of the smallest overview comes first, so that a reader of the file's beginning sees
    // the whole picture.
    for (level, directory) in levels.iter().zip(&mut directories).rev() {
        let mut offsets = Vec::with_capacity(level.tiles.len());
        for tile in &level.tiles {
            offsets.push(at + LEADER);
            at += LEADER + tile.len() as u64 + TRAILER;
        }
        directory.set(TILE_OFFSETS, Value::Words(offsets));
    }

    let mut out = Vec::with_capacity(at as usize);
    out.extend_from_slice(&flavour.header(first));
    out.extend_from_slice(ghost.as_bytes());
    out.resize(first as usize, 0);
    for (n, directory) in directories.iter().enumerate() {
        let next = positions.get(n + 1).copied().unwrap_or(0);
        directory.append(flavour, positions[n], next, &mut out);
    }
    for tile in levels.iter().rev().flat_map(|level| &level.tiles) {
        out.extend_from_slice(&(tile.len() as u32).to_le_bytes());
        out.extend_from_slice(tile);
        // A zlib stream has at least 8 bytes.
        out.extend_from_slice(&tile[tile.len() - 4..]);
    }
    out
}

/// The directory of a level, with offsets still unknown: their number decides its length.
fn directory(spec: &CogSpec, number: usize, level: &Level) -> Directory {
    let image = Image {
        width: level.width,
        height: level.height,
        bands: 1,
        sample: SampleType::F32,
        compression: TiffCompression::Deflate,
        layout: Layout::Tiles(spec.tile_size),
    };
    let sizes = level.tiles.iter().map(|tile| tile.len() as u64).collect();
    let mut directory = image.directory(vec![0; level.tiles.len()], sizes);
    debug_assert!(directory.0.contains_key(&TILE_BYTE_COUNTS));
    georeference::set_nodata(&mut directory, f64::NAN);
    if number == 0 {
        let crs = CrsKeys {
            epsg: spec.epsg,
            geographic: false,
            linear_unit: spec.linear_unit,
            vertical_epsg: spec.vertical_epsg,
            vertical_unit: spec.unit,
        };
        georeference::set_georeference(&mut directory, &spec.geotransform, &crs);
        georeference::set_metadata(&mut directory, &spec.metadata, spec.unit, 1);
    } else {
        // A reduced-resolution version of the first image.
        directory.set(NEW_SUBFILE_TYPE, Value::long(1));
    }
    directory
}
