//! Tiles with one bounded block cache, shared by all threads.
//!
//! A block that several threads want at once is decoded by one of them; the others wait for it. No
//! lock is held while a block is decoded, and a thread that decodes waits for nobody, so nobody waits
//! for ever. One lock guards the cache: it is held for well under a microsecond per block, and a
//! block takes a thousand times as long to decode.

use crate::raster::{OpenOptions, RasterError, RasterHeader, RasterReader, UndeclaredNodata, open};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Idle readers that are kept open, over all tiles.
const IDLE_READERS: usize = 64;

/// What the cache did.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct CacheStatistics {
    /// Blocks that were decoded, each time counted.
    pub blocks_decoded: u64,
    /// Different blocks that were decoded.
    pub blocks_distinct: u64,
    /// Times that a wanted block was there, or was being decoded by another thread.
    pub hits: u64,
    /// Bytes of heights that were decoded.
    pub bytes_decoded: u64,
    /// Most bytes of heights that were held at once, blocks being decoded included, GDAL's cache not.
    pub peak_bytes: u64,
    /// Seconds spent on decoding, summed over threads.
    pub decode_seconds: f64,
}

/// How tiles are opened: [`open`], or something else in tests.
type Opener = fn(&Path, &OpenOptions) -> Result<Box<dyn RasterReader>, RasterError>;

/// Raster tiles, read through one cache of bounded size.
pub struct TileStore {
    options: OpenOptions,
    opener: Opener,
    tiles: Vec<Tile>,
    cache: Mutex<Cache>,
    idle: Mutex<Vec<(usize, Box<dyn RasterReader>)>>,
    decode_nanos: AtomicU64,
}

impl std::fmt::Debug for TileStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TileStore")
            .field("options", &self.options)
            .field("tiles", &self.tiles)
            .field("statistics", &self.statistics())
            .finish_non_exhaustive()
    }
}

#[derive(Debug)]
struct Tile {
    header: RasterHeader,
    undeclared: AtomicU8,
}

/// Tile number, column and row of a block.
type Key = (usize, u32, u32);
type Block = Arc<[f32]>;

#[derive(Debug)]
struct Cache {
    budget: u64,
    entries: HashMap<Key, Entry>,
    /// When each ready block was last used; the oldest goes first.
    by_age: BTreeMap<u64, Key>,
    clock: u64,
    /// Bytes of ready blocks and of blocks being decoded.
    held: u64,
    /// For each tile, a bit for each block that was ever decoded.
    decoded: Vec<Vec<u64>>,
    statistics: CacheStatistics,
}

#[derive(Debug)]
enum Entry {
    Ready { block: Block, age: u64 },
    Loading(Arc<Slot>),
}

/// Where the threads that wait for a block find it.
#[derive(Debug, Default)]
struct Slot {
    outcome: Mutex<Option<Result<Block, String>>>,
    changed: Condvar,
}

impl TileStore {
    /// A store that holds `budget_bytes` of decoded blocks and of GDAL's own cache. One block per
    /// thread is always held, however small the budget.
    #[must_use]
    pub fn new(budget_bytes: usize, options: OpenOptions) -> Self {
        #[cfg(feature = "gdal")]
        let budget_bytes = {
            // GDAL caches what is no GeoTIFF, and masks; most of the memory is better used here.
            let gdal = (budget_bytes / 8).min(64 << 20);
            crate::raster::limit_gdal_cache(gdal);
            budget_bytes - gdal
        };
        Self::with_opener(budget_bytes, options, open)
    }

    fn with_opener(budget_bytes: usize, options: OpenOptions, opener: Opener) -> Self {
        Self {
            options,
            opener,
            tiles: Vec::new(),
            cache: Mutex::new(Cache::new(budget_bytes as u64)),
            idle: Mutex::default(),
            decode_nanos: AtomicU64::new(0),
        }
    }

    /// Opens a tile, reads its header, and returns its number: 0, 1, ... in the order of adding.
    ///
    /// # Errors
    /// What [`open`] says.
    pub fn add(&mut self, path: &Path) -> Result<usize, RasterError> {
        let reader = (self.opener)(path, &self.options)?;
        let header = reader.header().clone();
        let (across, down) = header.blocks();
        let words = (u64::from(across) * u64::from(down)).div_ceil(64);
        lock(&self.cache).decoded.push(vec![0; words as usize]);
        self.tiles.push(Tile { header, undeclared: AtomicU8::new(0) });
        let tile = self.tiles.len() - 1;
        self.give_back(tile, reader);
        Ok(tile)
    }

    /// Number of tiles.
    #[must_use]
    pub fn len(&self) -> usize {
        self.tiles.len()
    }

    /// Whether there is no tile.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.tiles.is_empty()
    }

    /// A tile's header.
    ///
    /// # Panics
    /// When there is no such tile.
    #[must_use]
    pub fn header(&self, tile: usize) -> &RasterHeader {
        &self.tiles[tile].header
    }

    /// Values that the tile does not declare as no-data and that were read as such so far. Which
    /// blocks are read does not depend on threads or cache, so neither does this, once all is read.
    ///
    /// # Panics
    /// When there is no such tile.
    #[must_use]
    pub fn undeclared_nodata(&self, tile: usize) -> UndeclaredNodata {
        UndeclaredNodata::from_bits(self.tiles[tile].undeclared.load(Ordering::Relaxed))
    }

    /// Fills a window of a tile, row-major: `width` x `height` samples from column `col0` and row
    /// `row0` on, in the tile's own vertical unit; NaN outside the tile and where it has no data.
    ///
    /// # Errors
    /// [`RasterError`] when a block cannot be read, when the file changed since it was added, or
    /// when `out` is not `width * height` long.
    ///
    /// # Panics
    /// When there is no such tile.
    pub fn read_window(
        &self,
        tile: usize,
        col0: i64,
        row0: i64,
        width: usize,
        height: usize,
        out: &mut [f32],
    ) -> Result<(), RasterError> {
        let header = &self.tiles[tile].header;
        if width.checked_mul(height) != Some(out.len()) {
            let samples = out.len();
            let reason =
                format!("a window of {width} x {height} was asked for in {samples} samples");
            return Err(RasterError::Unreadable { path: header.path.clone(), reason });
        }
        out.fill(f32::NAN);
        // The part inside the raster, in raster coordinates.
        let inside = |start: i64, length: usize, size: u32| {
            let end = start.saturating_add(i64::try_from(length).unwrap_or(i64::MAX));
            (start.clamp(0, i64::from(size)), end.clamp(0, i64::from(size)))
        };
        let (left, right) = inside(col0, width, header.width);
        let (top, bottom) = inside(row0, height, header.height);
        if left >= right || top >= bottom {
            return Ok(());
        }
        let (block_width, block_height) =
            (i64::from(header.block_width), i64::from(header.block_height));
        for by in top / block_height..=(bottom - 1) / block_height {
            for bx in left / block_width..=(right - 1) / block_width {
                // Both are below the numbers of blocks, which are u32.
                let block = self.block((tile, bx as u32, by as u32))?;
                let (x0, y0) = (bx * block_width, by * block_height);
                let (from, to) = (left.max(x0), right.min(x0 + block_width));
                for y in top.max(y0)..bottom.min(y0 + block_height) {
                    let source = ((y - y0) * block_width + from - x0) as usize;
                    let target = (y - row0) as usize * width + (from - col0) as usize;
                    let length = (to - from) as usize;
                    out[target..target + length].copy_from_slice(&block[source..source + length]);
                }
            }
        }
        Ok(())
    }

    /// What the cache did so far.
    #[must_use]
    pub fn statistics(&self) -> CacheStatistics {
        let mut statistics = lock(&self.cache).statistics;
        statistics.decode_seconds = self.decode_nanos.load(Ordering::Relaxed) as f64 * 1e-9;
        statistics
    }

    /// A block, from the cache, from the thread that is decoding it, or decoded here.
    fn block(&self, key: Key) -> Result<Block, RasterError> {
        let slot = {
            let mut cache = lock(&self.cache);
            match cache.find(key) {
                Some(Entry::Ready { block, .. }) => return Ok(block),
                Some(Entry::Loading(slot)) => {
                    drop(cache);
                    return slot.wait().map_err(|reason| self.error(key, reason));
                }
                None => cache.begin(key, self.block_bytes(key)),
            }
        };
        // Whatever happens in between, the waiting threads get an outcome.
        let mut loading = Loading { store: self, key, slot, outcome: None };
        let start = Instant::now();
        let outcome = self.decode(key);
        let nanos = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.decode_nanos.fetch_add(nanos, Ordering::Relaxed);
        loading.outcome = Some(match &outcome {
            Ok(block) => Ok(Arc::clone(block)),
            Err(RasterError::Block { reason, .. }) => Err(reason.clone()),
            Err(other) => Err(other.to_string()),
        });
        outcome
    }

    fn decode(&self, key: Key) -> Result<Block, RasterError> {
        let (tile, bx, by) = key;
        let mut reader = self.take_reader(tile)?;
        let mut samples = Vec::new();
        reader.read_block(bx, by, &mut samples)?;
        let undeclared = reader.undeclared_nodata().bits();
        let known = self.tiles[tile].undeclared.fetch_or(undeclared, Ordering::Relaxed);
        if undeclared & !known != 0 {
            tracing::warn!(
                "{}: samples of {} are read as no data, though the file does not declare them so; \
                 --nodata states what to do",
                self.tiles[tile].header.path.display(),
                UndeclaredNodata::from_bits(undeclared & !known).values().join(" and ")
            );
        }
        // A reader that failed is not given back: its file may be open in a bad state.
        self.give_back(tile, reader);
        Ok(samples.into())
    }

    /// An idle reader of the tile, or a new one.
    fn take_reader(&self, tile: usize) -> Result<Box<dyn RasterReader>, RasterError> {
        {
            let mut idle = lock(&self.idle);
            if let Some(place) = idle.iter().rposition(|(of, _)| *of == tile) {
                return Ok(idle.remove(place).1);
            }
        }
        let header = &self.tiles[tile].header;
        let reader = (self.opener)(&header.path, &self.options)?;
        let now = reader.header();
        if (now.size_bytes, now.modified) != (header.size_bytes, header.modified) {
            return Err(RasterError::Unreadable {
                path: header.path.clone(),
                reason: "the file changed while it was in use; start again".to_owned(),
            });
        }
        Ok(reader)
    }

    /// Keeps a reader for later; the one that was idle for longest is closed for it.
    fn give_back(&self, tile: usize, reader: Box<dyn RasterReader>) {
        let closed = {
            let mut idle = lock(&self.idle);
            idle.push((tile, reader));
            (idle.len() > IDLE_READERS).then(|| idle.remove(0))
        };
        drop(closed);
    }

    /// Bytes of a block's heights.
    fn block_bytes(&self, (tile, _, by): Key) -> u64 {
        let header = &self.tiles[tile].header;
        let rows = header.block_height.min(header.height - by * header.block_height);
        u64::from(header.block_width) * u64::from(rows) * size_of::<f32>() as u64
    }

    fn block_index(&self, (tile, bx, by): Key) -> usize {
        let (across, _) = self.tiles[tile].header.blocks();
        by as usize * across as usize + bx as usize
    }

    fn error(&self, (tile, column, row): Key, reason: String) -> RasterError {
        RasterError::Block { path: self.tiles[tile].header.path.clone(), column, row, reason }
    }
}

/// The duty to tell the outcome of a decoding, also when it panics.
struct Loading<'a> {
    store: &'a TileStore,
    key: Key,
    slot: Arc<Slot>,
    outcome: Option<Result<Block, String>>,
}

impl Drop for Loading<'_> {
    fn drop(&mut self) {
        let outcome =
            self.outcome.take().unwrap_or_else(|| Err("reading it was broken off".to_owned()));
        let bytes = self.store.block_bytes(self.key);
        let index = self.store.block_index(self.key);
        lock(&self.store.cache).end(self.key, index, bytes, outcome.as_ref().ok());
        self.slot.tell(outcome);
    }
}

impl Slot {
    fn wait(&self) -> Result<Block, String> {
        let mut outcome = lock(&self.outcome);
        loop {
            match &*outcome {
                Some(done) => return done.clone(),
                None => {
                    outcome = self.changed.wait(outcome).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
    }

    fn tell(&self, outcome: Result<Block, String>) {
        *lock(&self.outcome) = Some(outcome);
        self.changed.notify_all();
    }
}

impl Cache {
    fn new(budget: u64) -> Self {
        Self {
            budget,
            entries: HashMap::new(),
            by_age: BTreeMap::new(),
            clock: 0,
            held: 0,
            decoded: Vec::new(),
            statistics: CacheStatistics::default(),
        }
    }

    /// A block that is there or on its way; using it makes it the youngest.
    fn find(&mut self, key: Key) -> Option<Entry> {
        let entry = self.entries.get_mut(&key)?;
        self.statistics.hits += 1;
        Some(match entry {
            Entry::Loading(slot) => Entry::Loading(Arc::clone(slot)),
            Entry::Ready { block, age } => {
                self.by_age.remove(age);
                self.clock += 1;
                *age = self.clock;
                self.by_age.insert(self.clock, key);
                Entry::Ready { block: Arc::clone(block), age: self.clock }
            }
        })
    }

    /// Makes room for a block and marks it as on its way.
    fn begin(&mut self, key: Key, bytes: u64) -> Arc<Slot> {
        while self.held + bytes > self.budget
            && let Some((_, oldest)) = self.by_age.pop_first()
        {
            if let Some(Entry::Ready { block, .. }) = self.entries.remove(&oldest) {
                self.held -= size_of_val(&*block) as u64;
            }
        }
        self.held += bytes;
        self.statistics.peak_bytes = self.statistics.peak_bytes.max(self.held);
        let slot = Arc::new(Slot::default());
        self.entries.insert(key, Entry::Loading(Arc::clone(&slot)));
        slot
    }

    /// Takes a decoded block over, or forgets one that failed, so that it is tried again.
    fn end(&mut self, key: Key, index: usize, bytes: u64, block: Option<&Block>) {
        let Some(block) = block else {
            self.entries.remove(&key);
            self.held -= bytes;
            return;
        };
        self.statistics.blocks_decoded += 1;
        self.statistics.bytes_decoded += bytes;
        if let Some(word) = self.decoded.get_mut(key.0).and_then(|d| d.get_mut(index / 64)) {
            let bit = 1 << (index % 64);
            self.statistics.blocks_distinct += u64::from(*word & bit == 0);
            *word |= bit;
        }
        if self.held > self.budget {
            // Other threads' blocks fill the budget: this one goes to whoever waits for it.
            self.entries.remove(&key);
            self.held -= bytes;
            return;
        }
        self.clock += 1;
        self.by_age.insert(self.clock, key);
        self.entries.insert(key, Entry::Ready { block: Arc::clone(block), age: self.clock });
    }
}

/// What the locks guard is whole between statements, so a panic elsewhere does no harm to it.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests;
