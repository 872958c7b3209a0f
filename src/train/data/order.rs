//! The order of a finite list of items: each pass is a permutation of its own.

use crate::random::Draw;
use std::sync::{Arc, Mutex};

/// Purpose of the permutations' random numbers.
const PURPOSE: u64 = 0x0E0C;
/// Passes whose permutation is held: threads that work ahead stand in two.
const HELD: usize = 3;

/// A permutation by its pass.
type Pass = (u64, Arc<Vec<u32>>);

/// Which item a draw takes: every item once in each pass, in an order that the seed and the pass decide.
#[derive(Debug)]
pub struct Order {
    seed: u64,
    items: usize,
    held: Mutex<Vec<Pass>>,
}

impl Order {
    /// Of `items` items, at least one.
    #[must_use]
    pub fn new(seed: u64, items: usize) -> Self {
        Self { seed, items: items.max(1), held: Mutex::new(Vec::new()) }
    }

    /// The pass and the item of a draw.
    #[must_use]
    pub fn at(&self, draw: u64) -> (u64, usize) {
        let items = self.items as u64;
        let (pass, place) = (draw / items, (draw % items) as usize);
        (pass, self.permutation(pass)[place] as usize)
    }

    fn permutation(&self, pass: u64) -> Arc<Vec<u32>> {
        // What is held is a cache: a thread that panicked leaves it as good as it was.
        let mut held = self.held.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some((_, found)) = held.iter().find(|(known, _)| *known == pass) {
            return Arc::clone(found);
        }
        let made = Arc::new(permutation(self.seed, pass, self.items));
        if held.len() == HELD {
            held.remove(0);
        }
        held.push((pass, Arc::clone(&made)));
        made
    }
}

/// Fisher and Yates' shuffle.
fn permutation(seed: u64, pass: u64, items: usize) -> Vec<u32> {
    let mut draw = Draw::new(&[seed, PURPOSE, pass]);
    let mut list: Vec<u32> = (0..items as u32).collect();
    for last in (1..items).rev() {
        list.swap(last, draw.index(last + 1));
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pass_takes_every_item_once_in_its_own_order() {
        let order = Order::new(7, 100);
        let pass = |pass: u64| -> Vec<usize> {
            (0..100).map(|place| order.at(pass * 100 + place)).map(|(_, item)| item).collect()
        };
        let (first, second) = (pass(0), pass(1));
        for list in [&first, &second] {
            let mut sorted = (*list).clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..100).collect::<Vec<_>>());
        }
        assert_ne!(first, second);
        assert_ne!(first, (0..100).collect::<Vec<_>>());
        // Whatever was asked before.
        assert_eq!(Order::new(7, 100).at(157), order.at(157));
        assert_ne!((0..100).map(|draw| Order::new(8, 100).at(draw).1).collect::<Vec<_>>(), first);
    }

    #[test]
    fn one_item_is_always_the_same() {
        let order = Order::new(1, 1);
        assert_eq!([order.at(0), order.at(1), order.at(9)], [(0, 0), (1, 0), (9, 0)]);
    }
}
