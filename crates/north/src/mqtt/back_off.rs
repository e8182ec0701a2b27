//! The wait between two connection attempts.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// First and longest wait.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// After a connection that lasted this long, the next attempt follows after the shortest wait.
const STABLE: Duration = Duration::from_secs(5);

/// Doubles the wait from attempt to attempt.
#[derive(Debug)]
pub(super) struct BackOff(Duration);

impl Default for BackOff {
    fn default() -> BackOff {
        BackOff(BACK_OFF.0)
    }
}

impl BackOff {
    /// The wait after a connection that was `held` for this long. It differs by chance: gateways that lost their broker at
    /// the same time come back one after the other.
    pub(super) fn after(&mut self, held: Duration) -> Duration {
        if held >= STABLE {
            self.0 = BACK_OFF.0;
        }
        let wait = jittered(self.0, RandomState::new().hash_one(0));
        self.0 = (self.0 * 2).min(BACK_OFF.1);
        wait
    }
}

/// 10 to 100 % of `wait`, by a random number.
fn jittered(wait: Duration, random: u64) -> Duration {
    wait.mul_f64(0.1 + 0.9 * (random as f64 / u64::MAX as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_are_spread() {
        let wait = Duration::from_secs(4);
        assert_eq!(jittered(wait, 0), Duration::from_millis(400));
        assert_eq!(jittered(wait, u64::MAX), wait);
    }

    #[test]
    fn waits_grow_until_a_connection_lasts() {
        let mut back_off = BackOff::default();
        for _ in 0..10 {
            back_off.after(Duration::ZERO);
        }
        assert!(back_off.after(Duration::ZERO) >= Duration::from_millis(500));
        assert!(back_off.after(STABLE) <= BACK_OFF.0);
    }
}
