//! The resolutions of a Cloud Optimized GeoTIFF, made while rows arrive: overviews are averaged from the
//! rows of the finer resolution, tiles compressed in batches and handed on in the file's own bytes.

use super::predictor::Compression;
use super::tiles::{Cut, Places};
use rayon::prelude::*;
use std::io::{self, Write};

/// Side of a tile, pixels; the coarsest resolution has one tile.
const TILE: u32 = 256;
/// Tiles that are compressed at once at least, so that narrow rasters keep all cores busy too.
const BATCH_TILES: usize = 16;
/// Bytes of a tile's leader and of its trailer.
const AROUND_TILE: u64 = 4;

/// Columns and rows of every resolution, from fine to coarse.
pub(super) fn sizes(width: u32, height: u32) -> Vec<[u32; 2]> {
    let half = |[width, height]: &[u32; 2]| {
        (*width.max(height) > TILE).then(|| [width.div_ceil(2), height.div_ceil(2)])
    };
    std::iter::successors(Some([width, height]), half).collect()
}

/// Bytes of all resolutions as stored without compression, padding included.
pub(super) fn raw_bytes(width: u32, height: u32) -> u64 {
    sizes(width, height).into_iter().map(|size| cut(size).raw_bytes()).sum()
}

const fn cut([width, height]: [u32; 2]) -> Cut {
    Cut { width, height, chunk_width: TILE, chunk_height: TILE, tiled: true }
}

/// One resolution: rows go in, compressed tiles come out in `spool`, each between its size and its last
/// bytes, as they lie in the file.
#[derive(Debug)]
pub(super) struct Level<S> {
    pub(super) cut: Cut,
    /// Where the tiles lie in `spool`, their leaders not counted.
    pub(super) places: Places,
    /// The tiles.
    pub(super) spool: S,
    /// Bytes in `spool`.
    pub(super) bytes: u64,
    /// Rows that wait for a batch to be full.
    pending: Vec<f32>,
    /// The way to the next coarser resolution; the coarsest has none.
    halving: Option<Halving>,
}

impl<S: Write> Level<S> {
    fn new(size: [u32; 2], coarsest: bool, spool: S) -> Self {
        let [width, height] = size;
        Self {
            cut: cut(size),
            places: Places::default(),
            spool,
            bytes: 0,
            pending: Vec::new(),
            halving: (!coarsest).then(|| Halving::new(width as usize, height as usize)),
        }
    }

    /// Samples of the rows that are compressed at once: whole rows of tiles.
    fn batch(&self) -> usize {
        let rows_of_tiles = BATCH_TILES.div_ceil(self.cut.chunks_across());
        self.cut.width as usize * TILE as usize * rows_of_tiles
    }

    fn compress(&mut self, rows: &[f32]) -> io::Result<()> {
        for tile in self.cut.compress(rows, Compression::Deflate) {
            self.places.offsets.push(self.bytes + AROUND_TILE);
            // 256 x 256 samples.
            self.places.counts.push(tile.len() as u32);
            self.spool.write_all(&(tile.len() as u32).to_le_bytes())?;
            self.spool.write_all(&tile)?;
            // A zlib stream has 6 bytes at least.
            self.spool.write_all(&tile[tile.len() - AROUND_TILE as usize..])?;
            self.bytes += AROUND_TILE + tile.len() as u64 + AROUND_TILE;
        }
        Ok(())
    }
}

/// All resolutions, from fine to coarse. The bytes do not depend on how the rows came.
pub(super) fn levels<S: Write>(
    width: u32,
    height: u32,
    mut spool: impl FnMut() -> io::Result<S>,
) -> io::Result<Vec<Level<S>>> {
    let sizes = sizes(width, height);
    let coarsest = sizes.len() - 1;
    sizes
        .into_iter()
        .enumerate()
        .map(|(i, size)| Ok(Level::new(size, i == coarsest, spool()?)))
        .collect()
}

/// Takes the next rows of the finest of `levels` (whole ones) and makes of them what can be made.
pub(super) fn take_rows<S: Write>(levels: &mut [Level<S>], mut samples: &[f32]) -> io::Result<()> {
    let Some(level) = levels.first_mut() else { return Ok(()) };
    let batch = level.batch();
    while !samples.is_empty() {
        if levels[0].pending.is_empty() && samples.len() >= batch {
            // Nothing waits: no copy.
            let (now, later) = samples.split_at(batch);
            process(levels, now)?;
            samples = later;
            continue;
        }
        let level = &mut levels[0];
        let (now, later) = samples.split_at(samples.len().min(batch - level.pending.len()));
        level.pending.extend_from_slice(now);
        samples = later;
        if level.pending.len() == batch {
            flush(levels)?;
        }
    }
    Ok(())
}

/// Makes tiles of the rows that still wait, from fine to coarse; to be called after the last row.
pub(super) fn finish<S: Write>(levels: &mut [Level<S>]) -> io::Result<()> {
    for from in 0..levels.len() {
        flush(&mut levels[from..])?;
        levels[from].spool.flush()?;
    }
    Ok(())
}

/// The rows that wait in the finest level.
fn flush<S: Write>(levels: &mut [Level<S>]) -> io::Result<()> {
    let mut rows = std::mem::take(&mut levels[0].pending);
    if !rows.is_empty() {
        process(levels, &rows)?;
    }
    rows.clear();
    levels[0].pending = rows;
    Ok(())
}

/// Rows of the finest level that begin with a row of tiles.
fn process<S: Write>(levels: &mut [Level<S>], rows: &[f32]) -> io::Result<()> {
    let Some((level, coarser)) = levels.split_first_mut() else { return Ok(()) };
    level.compress(rows)?;
    match &mut level.halving {
        Some(halving) => take_rows(coarser, &halving.push(rows)),
        None => Ok(()),
    }
}

/// Half the resolution, rounded up: each pixel is the mean of the valid area that it covers, NaN if
/// there is none. An odd side of `2n - 1` pixels is spread over `n`, so that the extent stays.
#[derive(Debug)]
struct Halving {
    width: usize,
    height: usize,
    columns: Vec<Vec<(usize, f64)>>,
    /// Rows taken before this call's.
    taken: usize,
    /// Rows given.
    given: usize,
    /// The last of the rows taken, which rows to come need too.
    kept: Vec<f32>,
}

impl Halving {
    fn new(width: usize, height: usize) -> Self {
        let columns = (0..width.div_ceil(2)).map(|i| taps(width, i)).collect();
        Self { width, height, columns, taken: 0, given: 0, kept: Vec::new() }
    }

    /// Takes the next rows; gives the rows of half the resolution that they complete.
    fn push(&mut self, rows: &[f32]) -> Vec<f32> {
        let first_kept = self.taken - self.kept.len() / self.width;
        let available = self.taken + rows.len() / self.width;
        let line = |y: usize| match y.checked_sub(self.taken) {
            Some(y) => &rows[y * self.width..][..self.width],
            None => &self.kept[(y - first_kept) * self.width..][..self.width],
        };
        let half = self.height.div_ceil(2);
        let mut complete = Vec::new();
        let mut next = None;
        for i in self.given..half {
            let row = taps(self.height, i);
            if row.last().is_some_and(|(y, _)| *y >= available) {
                next = row.first().map(|(y, _)| *y);
                break;
            }
            complete.push(row);
        }
        let out: Vec<Vec<f32>> = complete.par_iter().map(|row| self.mean_of(row, line)).collect();
        // One row or two: what the next one covers of those that are there.
        let keep = next.unwrap_or(available).min(available);
        self.kept = (keep..available).flat_map(line).copied().collect();
        self.taken = available;
        self.given += complete.len();
        out.concat()
    }

    /// One row of half the resolution from the rows that it covers.
    fn mean_of<'a>(&self, row: &[(usize, f64)], line: impl Fn(usize) -> &'a [f32]) -> Vec<f32> {
        let lines: Vec<(&[f32], f64)> = row.iter().map(|&(y, wy)| (line(y), wy)).collect();
        let mean = |column: &Vec<(usize, f64)>| {
            let (mut sum, mut weight) = (0.0_f64, 0.0_f64);
            for &(line, wy) in &lines {
                for &(x, wx) in column {
                    let value = line[x];
                    if !value.is_nan() {
                        sum += wy * wx * f64::from(value);
                        weight += wy * wx;
                    }
                }
            }
            if weight > 0.0 { (sum / weight) as f32 } else { f32::NAN }
        };
        self.columns.iter().map(mean).collect()
    }
}

/// The pixels of `size` that pixel `i` of half the resolution covers, with the share of each that it
/// covers, in units of `1 / n`: whole numbers, so that nothing rounds.
fn taps(size: usize, i: usize) -> Vec<(usize, f64)> {
    let n = size.div_ceil(2);
    let (from, to) = (i * size, (i + 1) * size);
    (from / n..to.div_ceil(n))
        .map(|x| (x, (to.min((x + 1) * n) - from.max(x * n)) as f64))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all_taps(size: usize) -> Vec<Vec<(usize, f64)>> {
        (0..size.div_ceil(2)).map(|i| taps(size, i)).collect()
    }

    #[test]
    fn an_even_side_halves_in_pairs_and_an_odd_one_keeps_its_extent() {
        assert_eq!(all_taps(4), [[(0, 2.0), (1, 2.0)], [(2, 2.0), (3, 2.0)]]);
        assert_eq!(all_taps(3), [[(0, 2.0), (1, 1.0)], [(1, 1.0), (2, 2.0)]]);
        assert_eq!(all_taps(1), [[(0, 1.0)]]);
        for size in 1..200 {
            let mut covered = vec![0.0; size];
            all_taps(size).iter().flatten().for_each(|(x, w)| covered[*x] += w);
            assert!(covered.iter().all(|w| *w == size.div_ceil(2) as f64), "{size}");
        }
    }

    #[test]
    fn averages_leave_out_what_is_not_valid() {
        let nan = f32::NAN;
        let heights = [1.0, 3.0, nan, nan, 5.0, nan, nan, nan];
        let half = Halving::new(4, 2).push(&heights);
        assert_eq!(half[0], 3.0);
        assert!(half[1].is_nan());
        // An odd side: (2 a + b) / 3 and (b + 2 c) / 3.
        assert_eq!(Halving::new(3, 1).push(&[3.0, 6.0, 9.0]), [4.0, 8.0]);
    }

    #[test]
    fn rows_are_halved_alike_however_they_come() {
        for height in 1..24 {
            let heights: Vec<f32> = (0..height * 3).map(|i| (i * i % 17) as f32).collect();
            let whole = Halving::new(3, height).push(&heights);
            assert_eq!(whole.len(), height.div_ceil(2) * 2);
            for rows in 1..height {
                let mut halving = Halving::new(3, height);
                let parts: Vec<f32> =
                    heights.chunks(rows * 3).flat_map(|part| halving.push(part)).collect();
                assert_eq!(parts, whole, "{height} rows by {rows}");
                assert!(halving.kept.is_empty());
            }
        }
    }

    #[test]
    fn sizes_end_at_one_tile() {
        assert_eq!(sizes(256, 1), [[256, 1]]);
        assert_eq!(sizes(1025, 3), [[1025, 3], [513, 2], [257, 1], [129, 1]]);
    }
}
