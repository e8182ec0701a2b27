//! Arrival times of received bytes that are not processed yet: a request dates from its first byte. Pure.

use std::collections::VecDeque;
use std::time::Instant;

/// Most chunks with separate times; later ones count as the last.
const MOST_PIECES: usize = 64;

/// The times of the bytes, the first ones first.
#[derive(Debug, Default)]
pub(super) struct Arrivals(VecDeque<(usize, Instant)>);

impl Arrivals {
    /// That number of bytes arrived at that time.
    pub(super) fn came(&mut self, count: usize, at: Instant) {
        if count == 0 {
            return;
        }
        let full = self.0.len() >= MOST_PIECES;
        match self.0.back_mut() {
            Some((last, since)) if full || *since == at => *last += count,
            _ => self.0.push_back((count, at)),
        }
    }

    /// When the first byte arrived.
    pub(super) fn first(&self) -> Option<Instant> {
        self.0.front().map(|(_, at)| *at)
    }

    /// The first bytes are taken.
    pub(super) fn taken(&mut self, mut count: usize) {
        while let Some((of_first, _)) = self.0.front_mut() {
            if *of_first > count {
                *of_first -= count;
                return;
            }
            count -= *of_first;
            self.0.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_request_counts_from_its_first_byte_however_it_is_cut() {
        let began = Instant::now();
        let at = |ms| began + Duration::from_millis(ms);
        let mut arrivals = Arrivals::default();
        assert_eq!(arrivals.first(), None);
        arrivals.came(3, at(0));
        arrivals.came(0, at(5));
        arrivals.came(7, at(10));
        assert_eq!(arrivals.first(), Some(at(0)));
        arrivals.taken(2);
        assert_eq!(arrivals.first(), Some(at(0)));
        arrivals.taken(1);
        assert_eq!(arrivals.first(), Some(at(10)));
        arrivals.came(1, at(20));
        arrivals.taken(7);
        assert_eq!(arrivals.first(), Some(at(20)));
        arrivals.taken(9);
        assert_eq!(arrivals.first(), None);
    }

    #[test]
    fn they_are_bounded_and_never_later_than_it_was() {
        let began = Instant::now();
        let mut arrivals = Arrivals::default();
        for ms in 0..1000 {
            arrivals.came(1, began + Duration::from_millis(ms));
        }
        assert_eq!(arrivals.0.len(), MOST_PIECES);
        for ms in 0..1000 {
            assert!(arrivals.first().unwrap() <= began + Duration::from_millis(ms));
            arrivals.taken(1);
        }
        assert_eq!(arrivals.first(), None);
    }
}
