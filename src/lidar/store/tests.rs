use super::*;
use crate::grid::GeoTransform;
use proptest::prelude::*;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

const WIDTH: u32 = 100;
const HEIGHT: u32 = 70;
const SIDE: u32 = 16;
const BLOCK_BYTES: usize = (SIDE * SIDE * 4) as usize;

/// A raster whose file name says what goes wrong in block (1, 1).
struct Fake {
    header: RasterHeader,
}

/// Whether `fails for a while` fails.
static FAILING: AtomicBool = AtomicBool::new(true);

fn value(tile: u32, x: u32, y: u32) -> f32 {
    (tile * 1_000_000 + y * 1000 + x) as f32
}

impl RasterReader for Fake {
    fn header(&self) -> &RasterHeader {
        &self.header
    }

    fn read_block(&mut self, bx: u32, by: u32, out: &mut Vec<f32>) -> Result<(), RasterError> {
        let name = self.header.path.to_string_lossy().into_owned();
        std::thread::sleep(Duration::from_micros(200));
        if (bx, by) == (1, 1) {
            match name.as_str() {
                "panics" => panic!("a reader that panics, as the test wants"),
                "fails for a while" if FAILING.load(Ordering::SeqCst) => {
                    std::thread::sleep(Duration::from_millis(50));
                    return Err(RasterError::Block {
                        path: self.header.path.clone(),
                        column: bx,
                        row: by,
                        reason: "the disk is tired".to_owned(),
                    });
                }
                _ => {}
            }
        }
        let tile = name.parse().unwrap_or(0);
        out.clear();
        let rows = SIDE.min(HEIGHT - by * SIDE);
        for y in by * SIDE..by * SIDE + rows {
            out.extend(
                (bx * SIDE..(bx + 1) * SIDE)
                    .map(|x| if x < WIDTH { value(tile, x, y) } else { f32::NAN }),
            );
        }
        Ok(())
    }

    fn undeclared_nodata(&self) -> UndeclaredNodata {
        UndeclaredNodata::default()
    }
}

fn open_fake(path: &Path, _: &OpenOptions) -> Result<Box<dyn RasterReader>, RasterError> {
    let header = RasterHeader {
        path: path.to_owned(),
        width: WIDTH,
        height: HEIGHT,
        geotransform: GeoTransform::north_up(0.0, 0.0, 1.0, 1.0),
        crs: None,
        sample_type: "Float32".to_owned(),
        nodata: None,
        scale: 1.0,
        offset: 0.0,
        vertical_unit: None,
        block_width: SIDE,
        block_height: SIDE,
        compression: "none".to_owned(),
        overviews: 0,
        bands: 1,
        has_mask: false,
        size_bytes: 1,
        modified: (0, 0),
        warnings: Vec::new(),
    };
    Ok(Box::new(Fake { header }))
}

fn store(budget: usize, names: &[&str]) -> TileStore {
    let mut store = TileStore::with_opener(budget, OpenOptions::default(), open_fake);
    for name in names {
        store.add(&PathBuf::from(name)).unwrap();
    }
    store
}

/// What a window must hold, sample by sample.
fn check(tile: u32, (col0, row0): (i64, i64), width: usize, out: &[f32]) {
    for (i, v) in out.iter().enumerate() {
        let (x, y) = (col0 + (i % width) as i64, row0 + (i / width) as i64);
        let inside = (0..i64::from(WIDTH)).contains(&x) && (0..i64::from(HEIGHT)).contains(&y);
        if inside {
            assert_eq!(*v, value(tile, x as u32, y as u32), "({x}, {y})");
        } else {
            assert!(v.is_nan(), "({x}, {y}) is {v}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn any_window_holds_the_raster_and_nan_around_it(
        col0 in -40_i64..140, row0 in -40_i64..140, width in 0_usize..60, height in 0_usize..60,
        blocks in 0_usize..4,
    ) {
        let store = store(blocks * BLOCK_BYTES, &["3"]);
        let mut out = vec![0.0; width * height];
        store.read_window(0, col0, row0, width, height, &mut out).unwrap();
        check(3, (col0, row0), width, &out);
    }
}

#[test]
fn far_away_windows_are_nan_and_wrong_buffers_are_errors() {
    let store = store(1 << 20, &["0"]);
    let mut out = [0.0; 4];
    for start in [i64::MIN, i64::MAX, -2, 100] {
        out.fill(0.0);
        store.read_window(0, start, start, 2, 2, &mut out).unwrap();
        assert!(out.iter().all(|v| v.is_nan()), "{start}");
    }
    assert!(store.read_window(0, 0, 0, 3, 2, &mut out).is_err());
    assert_eq!(store.statistics(), CacheStatistics::default());
}

#[test]
fn the_budget_holds_and_the_oldest_block_goes() {
    let store = store(3 * BLOCK_BYTES, &["0"]);
    let mut out = [0.0; 1];
    let mut pixel = |bx: i64| {
        store.read_window(0, bx * 16, 0, 1, 1, &mut out).unwrap();
        store.statistics().blocks_decoded
    };
    assert_eq!([pixel(0), pixel(1), pixel(2)], [1, 2, 3]);
    assert_eq!(pixel(0), 3, "0 is there, and the youngest now");
    assert_eq!(pixel(3), 4, "1 goes");
    assert_eq!([pixel(0), pixel(2), pixel(3)], [4; 3]);
    assert_eq!(pixel(1), 5);
    let statistics = store.statistics();
    assert_eq!((statistics.blocks_distinct, statistics.hits), (4, 4));
    assert_eq!(statistics.peak_bytes, 3 * BLOCK_BYTES as u64);
    assert_eq!(statistics.bytes_decoded, 5 * BLOCK_BYTES as u64);
}

#[test]
fn threads_get_the_same_samples_under_any_budget() {
    for budget in [0, BLOCK_BYTES, 10 * BLOCK_BYTES, 1 << 20] {
        let store = store(budget, &["0", "1", "2"]);
        std::thread::scope(|scope| {
            for thread in 0..8_i64 {
                let store = &store;
                scope.spawn(move || {
                    let mut out = vec![0.0; 37 * 29];
                    for step in 0..25 {
                        let tile = (thread + step) % 3;
                        let at = ((step * 13 + thread) % 90 - 10, (step * 7) % 60 - 5);
                        store.read_window(tile as usize, at.0, at.1, 37, 29, &mut out).unwrap();
                        check(tile as u32, at, 37, &out);
                    }
                });
            }
        });
        let statistics = store.statistics();
        assert!(lock(&store.idle).len() <= 8 * 3, "at most a reader per thread and tile");
        if budget == 1 << 20 {
            assert_eq!(statistics.blocks_decoded, statistics.blocks_distinct);
        } else {
            // What is being decoded is counted, at most a block per thread over the budget.
            assert!(statistics.peak_bytes <= (budget + 8 * BLOCK_BYTES) as u64);
        }
    }
}

#[test]
fn a_block_that_many_threads_want_is_decoded_once() {
    let store = store(1 << 20, &["0"]);
    let barrier = std::sync::Barrier::new(8);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                let mut out = [0.0; 16];
                barrier.wait();
                store.read_window(0, 0, 0, 4, 4, &mut out).unwrap();
                check(0, (0, 0), 4, &out);
            });
        }
    });
    let statistics = store.statistics();
    assert_eq!((statistics.blocks_decoded, statistics.hits), (1, 7));
}

#[test]
fn an_error_reaches_everyone_who_waits_and_is_forgotten() {
    let store = store(1 << 20, &["fails for a while"]);
    let barrier = std::sync::Barrier::new(4);
    let messages: Vec<String> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..4)
            .map(|_| {
                scope.spawn(|| {
                    barrier.wait();
                    let read = store.read_window(0, 20, 20, 2, 2, &mut [0.0; 4]);
                    read.unwrap_err().to_string()
                })
            })
            .collect();
        threads.into_iter().map(|t| t.join().unwrap()).collect()
    });
    for message in messages {
        assert_eq!(message, "fails for a while: block (1, 1) cannot be read: the disk is tired");
    }
    FAILING.store(false, Ordering::SeqCst);
    let mut out = [0.0; 4];
    store.read_window(0, 20, 20, 2, 2, &mut out).unwrap();
    check(0, (20, 20), 2, &out);
}

#[test]
fn a_panic_in_a_reader_leaves_no_one_waiting() {
    let store = store(1 << 20, &["panics"]);
    let outcomes: Vec<bool> = std::thread::scope(|scope| {
        let read = || store.read_window(0, 20, 20, 2, 2, &mut [0.0; 4]).is_err();
        let threads: Vec<_> = (0..4).map(|_| scope.spawn(read)).collect();
        // A thread either panicked itself or got an error from the one that did.
        threads.into_iter().map(|t| t.join().unwrap_or(true)).collect()
    });
    assert_eq!(outcomes, [true; 4]);
    let mut out = [0.0; 4];
    store.read_window(0, 0, 0, 2, 2, &mut out).unwrap();
    check(0, (0, 0), 2, &out);
    assert_eq!(lock(&store.cache).held, BLOCK_BYTES as u64);
}
