//! How often a reason for having no connection is logged. Time is an argument.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Minimum time between two lines with the same reason for having no connection.
const SAME_REASON: Duration = Duration::from_secs(3600);
/// Number of reasons that are distinguished.
const REASONS: usize = 16;

/// Reasons of a missing connection: each is logged once, and again after an hour or a connection.
#[derive(Debug, Default)]
pub(super) struct OutageLog(HashMap<String, Instant>);

impl OutageLog {
    /// Whether to log this reason now. Reasons that differ only in numbers, such as a time of day, count as equal.
    pub(super) fn permit(&mut self, why: &str, now: Instant) -> bool {
        let reason: String = why.chars().filter(|c| !c.is_ascii_digit()).collect();
        let recent = |at: &Instant| now.saturating_duration_since(*at) < SAME_REASON;
        if self.0.get(&reason).is_some_and(recent) {
            return false;
        }
        if self.0.len() >= REASONS {
            self.0.clear();
        }
        self.0.insert(reason, now);
        true
    }

    /// Notes that there is a connection. A client whose certificate is about to expire may connect now and then,
    /// which is not logged each time.
    pub(super) fn end(&mut self) {
        self.0.retain(|reason, _| reason.contains("certificate"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_expired_certificate_is_logged_once_an_hour() {
        let (mut outages, now) = (OutageLog::default(), Instant::now());
        let why = |n: u64| format!("invalid peer certificate: expired: verified at {n}, not after 17");
        assert!(outages.permit(&why(1), now));
        for second in 1..3600 {
            assert!(!outages.permit(&why(second), now + Duration::from_secs(second)));
            assert_eq!(
                outages.permit("refused", now + Duration::from_secs(second)),
                second == 1
            );
        }
        assert!(outages.permit(&why(2), now + SAME_REASON));
        outages.end();
        assert!(outages.permit("refused", now + Duration::from_secs(1)));
    }
}
