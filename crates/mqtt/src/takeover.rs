//! Recognises a broker that repeatedly closes connections without a reason, as it does when two clients have one
//! client id. Time is an argument.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Number of closed connections that is reported, within this time.
const CLOSED: usize = 3;
const WITHIN: Duration = Duration::from_secs(60);
/// Minimum time between two log lines about a takeover.
const AGAIN: Duration = Duration::from_secs(600);

/// The last connections that the broker accepted and then closed without a reason.
#[derive(Debug, Default)]
pub(super) struct Takeovers {
    closed: VecDeque<Instant>,
    told: Option<Instant>,
}

impl Takeovers {
    /// Notes that the broker closed an accepted connection without a reason; returns whether to log the suspected cause.
    pub(super) fn closed(&mut self, now: Instant) -> bool {
        self.closed.push_back(now);
        self.closed.retain(|at| now.saturating_duration_since(*at) < WITHIN);
        let recent = |at: Instant| now.saturating_duration_since(at) < AGAIN;
        if self.closed.len() < CLOSED || self.told.is_some_and(recent) {
            return false;
        }
        self.closed.clear();
        self.told = Some(now);
        true
    }

    /// The text about the suspected second client, and what to do about it.
    pub(super) fn log_text(client_id: &str) -> String {
        format!(
            "the broker closed {CLOSED} connections within a minute without giving a reason; this usually means that \
             another client also uses the client id `{client_id}`, and the two disconnect each other; give each \
             gateway its own name or `client_id`"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_third_within_a_minute_is_told_once_in_ten() {
        let (start, mut takeovers) = (Instant::now(), Takeovers::default());
        let mut closed = |seconds: u64| takeovers.closed(start + Duration::from_secs(seconds));
        assert_eq!([0, 40, 65, 101].map(&mut closed), [false; 4], "two within a minute");
        assert!(closed(102));
        assert_eq!((103..700).filter(|s| closed(*s)).count(), 0);
        assert_eq!((700..720).filter(|s| closed(*s)).collect::<Vec<_>>(), [702]);
        // A broker that is restarted now and then closes connections like this.
        assert_eq!((10..100).filter(|n| closed(n * 100)).count(), 0);
    }
}
