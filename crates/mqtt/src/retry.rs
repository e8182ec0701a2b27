//! When messages that the broker did not take are published again. Time is an argument.

use std::time::{Duration, Instant};

/// First and longest wait before a refused message is published again.
const WAIT: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));

/// A single wait for all messages refused meanwhile; it doubles while refusals continue.
#[derive(Debug)]
pub(super) struct Retry {
    wait: Duration,
    at: Option<Instant>,
    refused: Option<Instant>,
}

impl Default for Retry {
    fn default() -> Retry {
        Retry {
            wait: WAIT.0,
            at: None,
            refused: None,
        }
    }
}

impl Retry {
    /// The broker refused a message; returns when all such messages are published again.
    pub(super) fn refused(&mut self, now: Instant) -> Instant {
        let goes_on = |at: Instant| now.saturating_duration_since(at) <= self.wait * 2;
        if !self.refused.is_some_and(goes_on) {
            self.wait = WAIT.0;
        }
        self.refused = Some(now);
        if let Some(at) = self.at {
            return at;
        }
        let at = now + self.wait;
        self.at = Some(at);
        self.wait = (self.wait * 2).min(WAIT.1);
        at
    }

    /// Whether the wait has ended.
    pub(super) fn is_due(&mut self, now: Instant) -> bool {
        self.at.take_if(|at| *at <= now).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wait_doubles_while_refusals_go_on() {
        let (start, mut retry) = (Instant::now(), Retry::default());
        let at = |ms: u64| start + Duration::from_millis(ms);
        assert!(!retry.is_due(at(0)), "nothing was refused");
        assert_eq!(retry.refused(at(0)), at(1000));
        assert_eq!(retry.refused(at(900)), at(1000), "one wait for both");
        assert!(!retry.is_due(at(999)));
        assert!(retry.is_due(at(1000)) && !retry.is_due(at(1000)));
        let (mut now, mut waits) = (at(1010), Vec::new());
        for _ in 0..8 {
            let next = retry.refused(now);
            waits.push((next - now).as_secs());
            assert!(retry.is_due(next));
            now = next;
        }
        assert_eq!(waits, [2, 4, 8, 16, 32, 60, 60, 60]);
        now += Duration::from_secs(121);
        assert_eq!(retry.refused(now), now + WAIT.0, "it was taken meanwhile");
    }
}
