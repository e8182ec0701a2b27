//! Keeps the last items of many sources so that no source displaces the items of others.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Keeps a limited number of items, numbered by the caller in rising order. When the ring is full, a new item
/// replaces the oldest item of the source that has most, or of its own source if that has as many.
#[derive(Debug)]
pub struct FairRing<K, T> {
    capacity: usize,
    kept: usize,
    sources: BTreeMap<K, VecDeque<(u64, T)>>,
    /// Number of items, number of the oldest, source: the largest share is last, with the oldest items if there are several.
    shares: BTreeSet<(usize, Reverse<u64>, K)>,
}

impl<K: Ord + Clone, T> FairRing<K, T> {
    /// An empty ring for `capacity` items.
    pub fn new(capacity: usize) -> FairRing<K, T> {
        FairRing {
            capacity,
            kept: 0,
            sources: BTreeMap::new(),
            shares: BTreeSet::new(),
        }
    }

    /// Keeps an item of `source`.
    pub fn push(&mut self, source: K, number: u64, item: T) {
        // The existing key is used, since its clones share memory.
        let source = match self.sources.get_key_value(&source) {
            Some((known, _)) => known.clone(),
            None => source,
        };
        if self.kept >= self.capacity {
            let largest = self.shares.last().map(|(share, _, of)| (*share, of.clone()));
            let own = self.sources.get(&source).map_or(0, VecDeque::len);
            if let Some((share, of)) = largest {
                let from = if own >= share { &source } else { &of };
                self.change(from, |items| {
                    items.pop_front();
                    // A source that once had most of the ring gives back memory that it no longer needs.
                    if items.capacity() > items.len() + 2 * spare(items) {
                        items.shrink_to(items.len() + spare(items));
                    }
                });
                self.kept -= 1;
            }
        }
        self.change(&source, |items| {
            if items.len() == items.capacity() {
                items.reserve_exact(spare(items));
            }
            items.push_back((number, item));
        });
        self.kept += 1;
    }

    fn change(&mut self, source: &K, change: impl FnOnce(&mut VecDeque<(u64, T)>)) {
        let items = self.sources.entry(source.clone()).or_default();
        if let Some((oldest, _)) = items.front() {
            self.shares.remove(&(items.len(), Reverse(*oldest), source.clone()));
        }
        change(items);
        if let Some((oldest, _)) = items.front() {
            self.shares.insert((items.len(), Reverse(*oldest), source.clone()));
        } else {
            self.sources.remove(source);
        }
    }

    /// All kept items with their numbers, source by source.
    pub fn iter(&self) -> impl Iterator<Item = &(u64, T)> {
        self.sources.values().flatten()
    }
}

/// Spare places of a source beyond its items. Doubling the memory instead would leave each source the largest size
/// that it ever had.
fn spare<T>(items: &VecDeque<T>) -> usize {
    items.len() / 8 + 4
}

/// The items of two rings that share one numbering, merged by their numbers.
pub fn in_order<K1: Ord + Clone, K2: Ord + Clone, T: Clone>(
    one: &FairRing<K1, T>,
    other: &FairRing<K2, T>,
) -> Vec<(u64, T)> {
    let mut all: Vec<_> = one.iter().chain(other.iter()).cloned().collect();
    all.sort_unstable_by_key(|(number, _)| *number);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(ring: &FairRing<&str, ()>, source: &str) -> Vec<u64> {
        let items = ring.sources.get(source).into_iter().flatten();
        items.map(|(number, ())| *number).collect()
    }

    #[test]
    fn a_flood_pushes_out_its_own() {
        let mut ring = FairRing::new(100);
        (0..50).for_each(|n| ring.push("quiet", n, ()));
        (50..10_000).for_each(|n| ring.push("flood", n, ()));
        assert_eq!(numbers(&ring, "quiet"), (0..50).collect::<Vec<_>>());
        assert_eq!(numbers(&ring, "flood"), (9950..10_000).collect::<Vec<_>>());
        assert_eq!(ring.iter().count(), 100);
        (10_000..10_010).for_each(|n| ring.push("third", n, ()));
        assert_eq!(numbers(&ring, "third").len(), 10);
        assert_eq!((numbers(&ring, "quiet").len(), numbers(&ring, "flood").len()), (45, 45));
    }

    #[test]
    fn sources_with_one_item_each_leave_in_their_order() {
        let mut ring = FairRing::new(3);
        ["d", "a", "c", "b", "e"]
            .iter()
            .enumerate()
            .for_each(|(n, source)| ring.push(*source, n as u64, ()));
        let mut kept: Vec<u64> = ring.iter().map(|(number, ())| *number).collect();
        kept.sort_unstable();
        assert_eq!(kept, [2, 3, 4]);
        assert_eq!(ring.sources.len(), 3, "a source without items is forgotten");
    }

    #[test]
    fn memory_is_for_what_is_kept() {
        let mut ring = FairRing::new(1000);
        for n in 0..40_000 {
            // Each of twenty sources floods the ring in turn.
            ring.push(n / 2000, n, ());
            let places: usize = ring.sources.values().map(VecDeque::capacity).sum();
            assert!(
                places <= ring.kept * 5 / 4 + 8 * ring.sources.len(),
                "{places} for {}",
                ring.kept
            );
        }
        assert_eq!((ring.kept, ring.sources.len()), (1000, 20));
    }
}
