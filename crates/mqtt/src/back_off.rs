//! Chooses the next broker, and the wait before the attempt.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// First and longest wait before a connection attempt.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// After a connection that lasted this long, the next attempt follows after the shortest wait.
const STABLE: Duration = Duration::from_secs(5);

/// The brokers in turn: the next one after the shortest wait; when all were tried, after a wait that doubles from round to round.
#[derive(Debug)]
pub(super) struct Rotation {
    count: usize,
    current: usize,
    /// Brokers tried since the last wait that duplicate.
    tried: usize,
    /// Number of times that the rotation has returned to the first broker.
    round: usize,
    wait: Duration,
}

impl Rotation {
    /// A rotation of `count` brokers that starts with `current`.
    pub(super) fn new(count: usize, current: usize) -> Rotation {
        Rotation {
            count: count.max(1),
            current,
            tried: 0,
            round: 0,
            wait: BACK_OFF.0,
        }
    }

    pub(super) fn current(&self) -> usize {
        self.current
    }

    /// Number of times that the rotation has returned to the first broker.
    pub(super) fn round(&self) -> usize {
        self.round
    }

    pub(super) fn is_single(&self) -> bool {
        self.count == 1
    }

    /// Selects the next broker, and returns the wait before it after a connection that lasted for `held`. The wait
    /// is random, so that gateways that lost their broker at the same time reconnect one after the other.
    pub(super) fn next(&mut self, held: Duration) -> Duration {
        if held >= STABLE {
            (self.tried, self.wait) = (0, BACK_OFF.0);
        }
        self.current = (self.current + 1) % self.count;
        self.round += usize::from(self.current == 0);
        self.tried += 1;
        if self.tried < self.count {
            return spread(BACK_OFF.0);
        }
        self.tried = 0;
        let wait = spread(self.wait);
        self.wait = (self.wait * 2).min(BACK_OFF.1);
        wait
    }
}

/// 10 to 100 % of `wait`, by chance.
fn spread(wait: Duration) -> Duration {
    wait.mul_f64(0.1 + 0.9 * chance())
}

/// A random number from 0 to 1.
pub(super) fn chance() -> f64 {
    RandomState::new().hash_one(0) as f64 / u64::MAX as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_are_spread() {
        let (least, most) = (Duration::from_millis(400), Duration::from_secs(4));
        let waits: Vec<Duration> = (0..100).map(|_| spread(most)).collect();
        assert!(waits.iter().all(|wait| (least..=most).contains(wait)));
        assert!(waits.iter().max() > waits.iter().min().map(|wait| *wait * 2).as_ref());
    }

    #[test]
    fn waits_grow_until_a_connection_lasts() {
        let mut rotation = Rotation::new(1, 0);
        for _ in 0..10 {
            rotation.next(Duration::ZERO);
        }
        assert!(rotation.next(Duration::ZERO) >= Duration::from_millis(500));
        assert!(rotation.next(STABLE) <= BACK_OFF.0);
        assert_eq!((rotation.current(), rotation.round()), (0, 12));
    }

    #[test]
    fn all_brokers_are_tried_before_the_wait_grows() {
        let mut rotation = Rotation::new(3, 1);
        let mut turns = Vec::new();
        for _ in 0..7 {
            for place in 0..3 {
                let wait = rotation.next(Duration::ZERO);
                assert!(place == 2 || wait <= BACK_OFF.0, "{wait:?}");
                turns.push(rotation.current());
            }
        }
        assert_eq!(turns.get(..6), Some(&[2, 0, 1, 2, 0, 1][..]));
        assert_eq!(rotation.wait, BACK_OFF.1);
        // If a broker kept the connection, the next attempts to the others follow at once.
        let waits = [STABLE, Duration::ZERO].map(|held| rotation.next(held));
        assert!(waits.iter().all(|wait| *wait <= BACK_OFF.0), "{waits:?}");
    }

    #[test]
    fn brokers_that_close_at_once_are_not_besieged() {
        let mut rotation = Rotation::new(2, 0);
        let short = Duration::from_secs(1);
        let waits: Duration = (0..40).map(|_| rotation.next(short)).sum();
        assert!(waits >= Duration::from_secs(8), "{waits:?}");
    }
}
