//! Tiles of the surface on disk: one file per slab, from which one tile can be read alone.
//!
//! `slabs/00012.surface`, little-endian throughout: a header of 24 bytes (`sat3dsrf`, u32 version 1, u32
//! slab, u32 number of tiles, u32 CRC-32 of the list), the list of the tiles that hold triangles, in ascending
//! order, 32 bytes each (u32 row, u32 column, u32 vertices, u32 triangles, u64 offset from the file's start, u32
//! CRC-32 of the tile's bytes, u32 zero), and behind it each tile's vertices (3 f64) and triangles (3 u32).

use super::super::slabs::{Kind, Slabs};
use super::{MeshTile, TILE, TileIndex};
use crate::tile::city::Along;
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

const MAGIC: &[u8; 8] = b"sat3dsrf";
const VERSION: u32 = 1;
const HEADER: usize = 24;
const ENTRY: usize = 32;
const VERTEX: u64 = 24;
const TRIANGLE: u64 = 12;

/// Why tiles are not read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The slab's file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file is not what this program wrote.
    #[error(
        "{}: {found}; the file is damaged: delete it and run again with --resume",
        path.display()
    )]
    Damaged {
        /// The slab's file.
        path: PathBuf,
        /// What is wrong.
        found: String,
    },
    /// No such tile in this city.
    #[error(
        "no tile in row {row}, column {column}: the city has {rows} rows and {columns} columns of tiles"
    )]
    NoTile {
        /// Row asked for.
        row: u32,
        /// Column asked for.
        column: u32,
        /// Rows of tiles.
        rows: u32,
        /// Columns of tiles.
        columns: u32,
    },
}

/// The bytes of a slab's file. Tiles without triangles are left out.
#[must_use]
pub fn encode(slab: u32, tiles: &[(TileIndex, MeshTile)]) -> Vec<u8> {
    let mut tiles: Vec<&(TileIndex, MeshTile)> =
        tiles.iter().filter(|(_, tile)| !tile.triangles.is_empty()).collect();
    tiles.sort_by_key(|(index, _)| *index);
    let size = |tile: &MeshTile| {
        tile.vertices.len() * VERTEX as usize + tile.triangles.len() * TRIANGLE as usize
    };
    let data: usize = tiles.iter().map(|(_, tile)| size(tile)).sum();
    let first = HEADER + ENTRY * tiles.len();
    let mut bytes = vec![0; first];
    bytes.reserve_exact(data);
    for (number, (index, tile)) in tiles.iter().enumerate() {
        let offset = bytes.len();
        for vertex in &tile.vertices {
            bytes.extend(vertex.iter().flat_map(|value| value.to_le_bytes()));
        }
        for corners in &tile.triangles {
            bytes.extend(corners.iter().flat_map(|corner| corner.to_le_bytes()));
        }
        let sum = crc32fast::hash(&bytes[offset..]);
        let entry = &mut bytes[HEADER + ENTRY * number..][..ENTRY];
        // A tile's vertices are numbered in 32 bits; its triangles are fewer than twice as many and
        // those of a tile of 256 x 256 columns.
        let counts = [tile.vertices.len() as u32, tile.triangles.len() as u32];
        let words = [index.row, index.column, counts[0], counts[1]];
        entry[..16].copy_from_slice(&words.map(u32::to_le_bytes).concat());
        entry[16..24].copy_from_slice(&(offset as u64).to_le_bytes());
        entry[24..28].copy_from_slice(&sum.to_le_bytes());
    }
    let sum = crc32fast::hash(&bytes[HEADER..first]);
    bytes[..8].copy_from_slice(MAGIC);
    let words = [VERSION, slab, tiles.len() as u32, sum].map(u32::to_le_bytes).concat();
    bytes[8..HEADER].copy_from_slice(&words);
    bytes
}

/// A tile that holds triangles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileEntry {
    /// Which one.
    pub index: TileIndex,
    /// Its vertices; those on its sides are its neighbours' too.
    pub vertices: u32,
    /// Its triangles.
    pub triangles: u32,
    slab: u32,
    offset: u64,
    sum: u32,
}

/// The tiles of all slabs of a finished run.
#[derive(Debug)]
pub struct SurfaceStore<'a> {
    slabs: &'a Slabs<'a>,
    tiles: BTreeMap<TileIndex, TileEntry>,
}

impl<'a> SurfaceStore<'a> {
    /// Reads the lists of all slabs, not their tiles.
    ///
    /// # Errors
    /// [`StoreError::Io`], [`StoreError::Damaged`].
    pub fn open(slabs: &'a Slabs<'a>) -> Result<Self, StoreError> {
        let mut tiles = BTreeMap::new();
        for slab in 0..slabs.city.slabs() {
            tiles.extend(entries(slabs, slab)?.into_iter().map(|entry| (entry.index, entry)));
        }
        Ok(Self { slabs, tiles })
    }

    /// The run that is read.
    #[must_use]
    pub fn slabs(&self) -> &'a Slabs<'a> {
        self.slabs
    }

    /// Tiles that hold triangles, from north to south and in a row from west to east.
    pub fn tiles(&self) -> impl ExactSizeIterator<Item = &TileEntry> {
        self.tiles.values()
    }

    /// The tile's entry; `None` where there are no triangles.
    #[must_use]
    pub fn entry(&self, index: TileIndex) -> Option<&TileEntry> {
        self.tiles.get(&index)
    }

    /// Vertices (those on sides counted in each tile) and triangles of all tiles.
    #[must_use]
    pub fn totals(&self) -> [u64; 2] {
        self.tiles.values().fold([0; 2], |[vertices, triangles], tile| {
            [vertices + u64::from(tile.vertices), triangles + u64::from(tile.triangles)]
        })
    }

    /// A tile, in grid coordinates; an empty one where there are no triangles.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read_tile(&self, index: TileIndex) -> Result<MeshTile, StoreError> {
        check_index(self.slabs, index)?;
        self.entry(index).map_or_else(|| Ok(MeshTile::default()), |entry| read(self.slabs, entry))
    }
}

/// One tile, in grid coordinates; an empty one where there are no triangles. For many tiles:
/// [`SurfaceStore`].
///
/// # Errors
/// [`StoreError`].
pub fn read_tile(slabs: &Slabs<'_>, index: TileIndex) -> Result<MeshTile, StoreError> {
    let slab = check_index(slabs, index)?;
    let found = entries(slabs, slab)?.into_iter().find(|entry| entry.index == index);
    found.map_or_else(|| Ok(MeshTile::default()), |entry| read(slabs, &entry))
}

/// Columns and rows of tiles of a city.
#[must_use]
pub fn tile_counts(slabs: &Slabs<'_>) -> [u32; 2] {
    slabs.city.size.map(|size| size.div_ceil(TILE))
}

/// The slab that a tile lies in.
fn check_index(slabs: &Slabs<'_>, TileIndex { row, column }: TileIndex) -> Result<u32, StoreError> {
    let [columns, rows] = tile_counts(slabs);
    if row >= rows || column >= columns {
        return Err(StoreError::NoTile { row, column, rows, columns });
    }
    Ok(match slabs.city.along {
        Along::X => column,
        Along::Y => row,
    })
}

fn open(path: &Path) -> Result<(File, u64), StoreError> {
    let failed = |source| StoreError::Io { path: path.to_owned(), source };
    let file = File::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    Ok((file, length))
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    let mut word = [0; 4];
    word.copy_from_slice(&bytes[at..at + 4]);
    u32::from_le_bytes(word)
}

/// The list of a slab's file.
fn entries(slabs: &Slabs<'_>, slab: u32) -> Result<Vec<TileEntry>, StoreError> {
    let path = slabs.path(slab, Kind::Surface);
    let damaged = |found: String| StoreError::Damaged { path: path.clone(), found };
    let (file, length) = open(&path)?;
    let get = |at: u64, bytes: &mut [u8]| {
        let failed = |source| StoreError::Io { path: path.clone(), source };
        file.read_exact_at(bytes, at).map_err(failed)
    };
    if length < HEADER as u64 {
        return Err(damaged(format!("{length} bytes, less than its header")));
    }
    let mut header = [0; HEADER];
    get(0, &mut header)?;
    if &header[..8] != MAGIC {
        return Err(damaged("it does not begin with `sat3dsrf`".to_owned()));
    }
    let [version, found, count, sum] = [8, 12, 16, 20].map(|at| u32_at(&header, at));
    if version != VERSION {
        return Err(damaged(format!("format version {version}, this program reads {VERSION}")));
    }
    if found != slab {
        return Err(damaged(format!("it holds slab {found} instead of {slab}")));
    }
    let first = HEADER as u64 + ENTRY as u64 * u64::from(count);
    if length < first {
        return Err(damaged(format!(
            "{length} bytes, and the list of {count} tiles ends at {first}"
        )));
    }
    let mut list = vec![0; (first - HEADER as u64) as usize];
    get(HEADER as u64, &mut list)?;
    if crc32fast::hash(&list) != sum {
        return Err(damaged("the list of tiles has another checksum than was written".to_owned()));
    }
    let mut offset = first;
    let mut tiles: Vec<TileEntry> = Vec::with_capacity(count as usize);
    for bytes in list.chunks_exact(ENTRY) {
        let index = TileIndex { row: u32_at(bytes, 0), column: u32_at(bytes, 4) };
        let entry = TileEntry {
            index,
            vertices: u32_at(bytes, 8),
            triangles: u32_at(bytes, 12),
            slab,
            offset: u64::from(u32_at(bytes, 16)) | u64::from(u32_at(bytes, 20)) << 32,
            sum: u32_at(bytes, 24),
        };
        let TileIndex { row, column } = index;
        let belongs = check_index(slabs, index).is_ok_and(|found| found == slab);
        let ascends = tiles.last().is_none_or(|last| last.index < index);
        if !belongs || !ascends || entry.offset != offset {
            return Err(damaged(format!("the tile in row {row}, column {column} is out of place")));
        }
        offset += entry.size();
        tiles.push(entry);
    }
    if length != offset {
        return Err(damaged(format!("{length} bytes, and its tiles end at {offset}")));
    }
    Ok(tiles)
}

impl TileEntry {
    /// Bytes of the tile.
    const fn size(&self) -> u64 {
        self.vertices as u64 * VERTEX + self.triangles as u64 * TRIANGLE
    }
}

fn read(slabs: &Slabs<'_>, entry: &TileEntry) -> Result<MeshTile, StoreError> {
    let path = slabs.path(entry.slab, Kind::Surface);
    let (file, length) = open(&path)?;
    let TileIndex { row, column } = entry.index;
    let damaged = |found: &str| StoreError::Damaged {
        path: path.clone(),
        found: format!("the tile in row {row}, column {column} {found}"),
    };
    // Before so much memory is taken.
    if length < entry.offset + entry.size() {
        return Err(damaged("ends behind the file"));
    }
    let mut bytes = vec![0; entry.size() as usize];
    let failed = |source| StoreError::Io { path: path.clone(), source };
    file.read_exact_at(&mut bytes, entry.offset).map_err(failed)?;
    if crc32fast::hash(&bytes) != entry.sum {
        return Err(damaged("has another checksum than was written"));
    }
    let (vertices, triangles) = bytes.split_at(entry.vertices as usize * VERTEX as usize);
    let value = |bytes: &[u8; 24], k: usize| {
        let mut word = [0; 8];
        word.copy_from_slice(&bytes[8 * k..8 * k + 8]);
        f64::from_le_bytes(word)
    };
    let vertices = vertices.as_chunks::<24>().0;
    let triangles = triangles.as_chunks::<12>().0;
    let tile = MeshTile {
        vertices: vertices.iter().map(|bytes| [0, 1, 2].map(|k| value(bytes, k))).collect(),
        triangles: triangles.iter().map(|bytes| [0, 4, 8].map(|at| u32_at(bytes, at))).collect(),
    };
    if tile.triangles.iter().flatten().any(|corner| *corner >= entry.vertices) {
        return Err(damaged("has a triangle of a vertex that it lacks"));
    }
    Ok(tile)
}
