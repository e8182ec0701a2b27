//! Arrival times of received bytes that are not processed yet: a request dates from its first byte. Pure.

use std::collections::VecDeque;

use crate::order::Arrival;

/// Most chunks with separate dates; later ones count as the last.
const MOST_PIECES: usize = 64;

/// How the bytes came, the first ones first.
#[derive(Debug, Default)]
pub(super) struct Arrivals(VecDeque<(usize, Arrival)>);

impl Arrivals {
    /// That number of bytes came so.
    pub(super) fn came(&mut self, count: usize, arrival: Arrival) {
        if count == 0 {
            return;
        }
        let full = self.0.len() >= MOST_PIECES;
        match self.0.back_mut() {
            Some((last, known)) if full || *known == arrival => *last += count,
            _ => self.0.push_back((count, arrival)),
        }
    }

    /// How the first byte came.
    pub(super) fn first(&self) -> Option<&Arrival> {
        self.0.front().map(|(_, arrival)| arrival)
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
    use std::time::{Duration, Instant};

    use super::*;
    use crate::order::Connection;

    fn over(connection: &Connection, asked: Instant) -> Arrival {
        Arrival::over(connection.clone(), asked)
    }

    #[test]
    fn a_request_counts_from_its_first_byte_however_it_is_cut() {
        let began = Instant::now();
        let connection = Connection::opened(began);
        let at = |ms| over(&connection, began + Duration::from_millis(ms));
        let mut arrivals = Arrivals::default();
        assert_eq!(arrivals.first(), None);
        arrivals.came(3, at(0));
        arrivals.came(0, at(5));
        arrivals.came(7, at(10));
        assert_eq!(arrivals.first(), Some(&at(0)));
        arrivals.taken(2);
        assert_eq!(arrivals.first(), Some(&at(0)));
        arrivals.taken(1);
        assert_eq!(arrivals.first(), Some(&at(10)));
        arrivals.came(1, at(20));
        arrivals.taken(7);
        assert_eq!(arrivals.first(), Some(&at(20)));
        arrivals.taken(9);
        assert_eq!(arrivals.first(), None);
    }

    #[test]
    fn they_are_bounded_and_never_later_than_it_was() {
        let began = Instant::now();
        let (mut arrivals, connection) = (Arrivals::default(), Connection::opened(began));
        for ms in 0..1000 {
            arrivals.came(1, over(&connection, began + Duration::from_millis(ms)));
        }
        assert_eq!(arrivals.0.len(), MOST_PIECES);
        for ms in 0..1000 {
            assert!(arrivals.first().unwrap().asked <= began + Duration::from_millis(ms));
            arrivals.taken(1);
        }
        assert_eq!(arrivals.first(), None);
    }
}
