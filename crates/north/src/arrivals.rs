//! Arrival times of received bytes that are not processed yet: a request has the time of its first byte. Pure.

use std::collections::VecDeque;

use drivegate_core::order::Arrival;

/// Maximum number of chunks whose arrival times are kept separately; later chunks get the time of the last one.
const MOST_PIECES: usize = 64;

/// How and when the unread bytes arrived, the first bytes first.
#[derive(Debug, Default)]
pub(super) struct Arrivals(VecDeque<(usize, Arrival)>);

impl Arrivals {
    /// Adds this number of bytes with their arrival time.
    pub(super) fn add(&mut self, count: usize, arrival: Arrival) {
        if count == 0 {
            return;
        }
        let full = self.0.len() >= MOST_PIECES;
        match self.0.back_mut() {
            Some((last, known)) if *known == arrival => *last += count,
            Some((last, known)) if full => {
                *last += count;
                *known = known.clone().completed(&arrival);
            }
            _ => self.0.push_back((count, arrival)),
        }
    }

    /// Takes out the arrival time of the next `count` bytes: the time of the first of them, with the last stall
    /// among them. `None` if there are no bytes.
    pub(super) fn take(&mut self, mut count: usize) -> Option<Arrival> {
        let mut taken: Option<Arrival> = None;
        while count > 0 {
            let (of_first, arrival) = self.0.front_mut()?;
            taken = Some(match taken {
                None => arrival.clone(),
                Some(taken) => taken.completed(arrival),
            });
            if *of_first > count {
                *of_first -= count;
                break;
            }
            count -= *of_first;
            self.0.pop_front();
        }
        taken
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use drivegate_core::order::Connection;
    use drivegate_core::stalls::Stall;

    fn over(connection: &Connection, asked: Instant) -> Arrival {
        Arrival::over(connection.clone(), asked)
    }

    #[test]
    fn a_request_counts_from_its_first_byte_however_it_is_cut() {
        let began = Instant::now();
        let connection = Connection::opened(began);
        let at = |ms| over(&connection, began + Duration::from_millis(ms));
        let mut arrivals = Arrivals::default();
        assert_eq!(arrivals.take(1), None);
        arrivals.add(3, at(0));
        arrivals.add(0, at(5));
        arrivals.add(7, at(10));
        assert_eq!(arrivals.take(2), Some(at(0)));
        assert_eq!(
            arrivals.take(2),
            Some(at(0)),
            "the last byte of the first piece, and one of the second"
        );
        assert_eq!(arrivals.take(1), Some(at(10)));
        arrivals.add(1, at(20));
        assert_eq!(arrivals.take(5), Some(at(10)));
        assert_eq!(arrivals.take(1), Some(at(20)));
        assert_eq!(arrivals.take(1), None);
    }

    #[test]
    fn one_that_ends_behind_a_pause_has_that_pause() {
        let began = Instant::now();
        let connection = Connection::opened(began);
        let at = |ms| began + Duration::from_millis(ms);
        let stall = Some(Stall::new(at(100), at(3100)));
        let behind = Arrival {
            stall,
            pause: stall,
            ..over(&connection, at(100))
        };
        let mut arrivals = Arrivals::default();
        arrivals.add(5, over(&connection, at(50)));
        arrivals.add(7, behind);
        arrivals.add(12, over(&connection, at(9000)));
        let first = arrivals.take(12).unwrap();
        assert_eq!((first.asked, first.stall, first.pause), (at(50), stall, stall));
        let next = arrivals.take(12).unwrap();
        assert_eq!((next.asked, next.stall, next.pause), (at(9000), None, None));
    }

    #[test]
    fn they_are_bounded_and_never_later_than_it_was() {
        let began = Instant::now();
        let (mut arrivals, connection) = (Arrivals::default(), Connection::opened(began));
        for ms in 0..1000 {
            arrivals.add(1, over(&connection, began + Duration::from_millis(ms)));
        }
        assert_eq!(arrivals.0.len(), MOST_PIECES);
        for ms in 0..1000 {
            assert!(arrivals.take(1).unwrap().asked <= began + Duration::from_millis(ms));
        }
        assert_eq!(arrivals.take(1), None);
    }
}
