//! When the status is published again because someone else published another one. Time is an argument.

use std::time::{Duration, Instant};

/// Minimum time between two repairs of the status.
const PACE: Duration = Duration::from_secs(1);

/// Repairs the status that another client published in the gateway's name, at most once in [`PACE`]; an earlier
/// repair is postponed.
#[derive(Debug, Default)]
pub(super) struct Repair {
    wanted: bool,
    last: Option<Instant>,
}

impl Repair {
    /// Notes that another client published a status in the gateway's name.
    pub(super) fn ask(&mut self) {
        self.wanted = true;
    }

    /// A new connection publishes the status anyway.
    pub(super) fn forget(&mut self) {
        self.wanted = false;
    }

    /// Whether the status is to be published again now.
    pub(super) fn take(&mut self, now: Instant) -> bool {
        let soon = |at: Instant| now.saturating_duration_since(at) < PACE;
        let due = self.wanted && !self.last.is_some_and(soon);
        if due {
            (self.wanted, self.last) = (false, Some(now));
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_that_comes_too_early_is_repaired_when_the_second_is_over() {
        let (start, mut repair) = (Instant::now(), Repair::default());
        let at = |ms| start + Duration::from_millis(ms);
        assert!(!repair.take(at(0)), "nobody asked");
        repair.ask();
        assert!(repair.take(at(10)), "the first at once");
        repair.ask();
        repair.ask();
        let due: Vec<u64> = (10..3000).filter(|ms| repair.take(at(*ms))).collect();
        assert_eq!(due, [1010], "then both together, once");
        repair.ask();
        repair.forget();
        assert!(!repair.take(at(5000)));
    }
}
