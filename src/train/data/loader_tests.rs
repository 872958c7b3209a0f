//! Tests of the loader with sources that are no good in various ways.

use super::super::SkipReason;
use super::*;
use crate::model::Image8;
use rayon::prelude::*;
use serde_json::Value;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Items by number; some are missing, and some take their time.
struct Numbers {
    items: usize,
    bad: fn(usize) -> bool,
    panics_at: Option<u64>,
    /// The highest draw that was asked for.
    highest: AtomicU64,
}

fn numbers(items: usize, bad: fn(usize) -> bool) -> Numbers {
    Numbers { items, bad, panics_at: None, highest: AtomicU64::new(0) }
}

impl Source for Numbers {
    fn len(&self) -> usize {
        self.items
    }

    fn example(&self, draw: u64, attempt: usize) -> Result<Example, Skip> {
        self.highest.fetch_max(draw, Ordering::SeqCst);
        assert_ne!(Some(draw), self.panics_at, "this source panics");
        // Later draws are often done first.
        std::thread::sleep(Duration::from_micros(300 * (7 - draw % 7)));
        let item = (draw as usize + attempt) % self.items;
        if (self.bad)(item) {
            let reason = SkipReason::Missing { what: "panorama", path: "x.jpg".into() };
            return Err(Skip { item: item.to_string(), reason });
        }
        let satellite = Image8 { width: 1, height: 1, channels: 3, data: vec![0; 3] };
        let name = format!("{draw}:{item}");
        Ok(Example { name, satellite, truth: None, street: None, depth: None })
    }

    fn held_out(&self, _: usize) -> Vec<Example> {
        Vec::new()
    }

    fn identity(&self) -> Value {
        Value::Null
    }

    fn describe(&self) -> String {
        "numbers".to_owned()
    }
}

fn names(batch: &Batch) -> Vec<&str> {
    batch.examples.iter().map(|example| example.name.as_str()).collect()
}

#[test]
fn batches_come_in_order_for_any_number_of_threads_and_from_any_step() {
    let collect = |step: u64, threads: usize, ahead: usize| -> Vec<Batch> {
        let source = Arc::new(numbers(10, |item| item == 3));
        let mut loader = Loader::start(source, step, 12, 4, threads, ahead).expect("starts");
        (step..12).map(|_| loader.take().expect("a batch")).collect()
    };
    let one = collect(0, 1, 0);
    assert_eq!(names(&one[0]), ["0:0", "1:1", "2:2", "3:4"]);
    assert_eq!(one[0].skips.len(), 1);
    assert_eq!(one[0].skips[0].item, "3");
    assert_eq!(collect(0, 5, 3), one);
    assert_eq!(collect(7, 3, 1), one[7..]);
}

#[test]
fn no_more_is_made_than_the_queue_holds() {
    let source = Arc::new(numbers(100, |_| false));
    let shared: Arc<dyn Source> = Arc::<Numbers>::clone(&source);
    let mut loader = Loader::start(shared, 0, 1000, 5, 2, 2).expect("starts");
    loader.take().expect("a batch");
    std::thread::sleep(Duration::from_millis(200));
    // Five are taken; three batches of five may be made beyond them.
    assert!(source.highest.load(Ordering::SeqCst) < 20, "{:?}", source.highest);
    drop(loader);
}

#[test]
fn a_source_without_anything_good_is_an_error_that_counts_the_reasons() {
    let source = Arc::new(numbers(6, |_| true));
    let error = Loader::start(source, 0, 2, 2, 2, 1).expect("starts").take().expect_err("nothing");
    let text = error.to_string();
    assert!(text.contains("none of 6 items is any good (6 panorama missing)"), "{text}");
    assert!(text.contains("x.jpg"), "{text}");
}

#[test]
fn a_panic_is_an_error_and_not_a_wait_for_ever() {
    let source = Numbers { panics_at: Some(3), ..numbers(9, |_| false) };
    let mut loader = Loader::start(Arc::new(source), 0, 9, 2, 2, 1).expect("starts");
    loader.take().expect("the first is fine");
    let text = loader.take().expect_err("panics").to_string();
    assert!(text.contains("example 3") && text.contains("this source panics"), "{text}");
}

/// Holds a lock while it works in parallel, as a pool of scenes does.
struct Locking(Mutex<()>);

impl Source for Locking {
    fn len(&self) -> usize {
        1
    }

    fn example(&self, draw: u64, _: usize) -> Result<Example, Skip> {
        let _scene = lock(&self.0);
        (0..64).into_par_iter().for_each(|_| std::thread::sleep(Duration::from_micros(50)));
        let satellite = Image8 { width: 1, height: 1, channels: 3, data: vec![0; 3] };
        let name = draw.to_string();
        Ok(Example { name, satellite, truth: None, street: None, depth: None })
    }

    fn held_out(&self, _: usize) -> Vec<Example> {
        Vec::new()
    }

    fn identity(&self) -> Value {
        Value::Null
    }

    fn describe(&self) -> String {
        "a lock".to_owned()
    }
}

#[test]
fn parallel_work_under_a_lock_does_not_hang() {
    let (done, waits) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let source = Arc::new(Locking(Mutex::new(())));
        let mut loader = Loader::start(source, 0, 20, 4, 3, 2).expect("starts");
        let batches: Vec<Batch> = (0..20).map(|_| loader.take().expect("a batch")).collect();
        done.send(batches).expect("is waited for");
    });
    let batches =
        waits.recv_timeout(Duration::from_secs(120)).expect("threads wait for each other");
    assert_eq!(names(&batches[19]), ["76", "77", "78", "79"]);
}
