//! Limits how often one kind of message is logged. Time is an argument.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Minimum time between two log lines of one kind, unless another is given.
const INTERVAL: Duration = Duration::from_secs(10);

/// Lets one log line of a kind pass in each interval and counts the others.
#[derive(Debug)]
pub struct LogThrottle {
    interval: Duration,
    state: Mutex<Throttled>,
}

#[derive(Debug, Default)]
struct Throttled {
    last: Option<Instant>,
    suppressed: u64,
}

impl Default for LogThrottle {
    fn default() -> LogThrottle {
        LogThrottle::every(INTERVAL)
    }
}

impl LogThrottle {
    /// A throttle with at least `interval` between two lines.
    pub fn every(interval: Duration) -> LogThrottle {
        LogThrottle {
            interval,
            state: Mutex::default(),
        }
    }

    /// `None` if the line must not be logged now, otherwise the number of lines suppressed since the last one.
    pub fn permit(&self, now: Instant) -> Option<u64> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let too_soon = |last| now.saturating_duration_since(last) < self.interval;
        if state.last.is_some_and(too_soon) {
            state.suppressed += 1;
            return None;
        }
        state.last = Some(now);
        Some(std::mem::take(&mut state.suppressed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line_in_ten_seconds() {
        let (throttle, now) = (LogThrottle::default(), Instant::now());
        assert_eq!(throttle.permit(now), Some(0));
        assert_eq!(throttle.permit(now), None);
        assert_eq!(throttle.permit(now + Duration::from_secs(9)), None);
        assert_eq!(throttle.permit(now + Duration::from_secs(10)), Some(2));
        let hourly = LogThrottle::every(Duration::from_secs(3600));
        assert_eq!(hourly.permit(now), Some(0));
        assert_eq!(hourly.permit(now + Duration::from_secs(3599)), None);
    }
}
