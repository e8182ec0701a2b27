//! Limits the messages that a connection publishes in any second. Pure: time is an argument.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The span in which messages are counted.
const SECOND: Duration = Duration::from_secs(1);

/// The messages of the last second.
#[derive(Debug, Default)]
pub(super) struct Rate {
    /// Maximum messages per second; 0 is unlimited.
    limit: usize,
    sent: VecDeque<Instant>,
}

impl Rate {
    pub(super) fn new(limit: usize) -> Rate {
        Rate {
            limit,
            sent: VecDeque::new(),
        }
    }

    /// Notes a message written at `now`.
    pub(super) fn sent(&mut self, now: Instant) {
        if self.limit > 0 {
            self.forget(now);
            self.sent.push_back(now);
        }
    }

    /// Whether another message may be given to the connection at `now`, with this many waiting to be written. If
    /// not, when there may be room.
    pub(super) fn take(&mut self, waiting: usize, now: Instant) -> Result<(), Instant> {
        if self.limit == 0 {
            return Ok(());
        }
        self.forget(now);
        if self.sent.len() + waiting < self.limit {
            return Ok(());
        }
        let first = self.sent.front().map_or(now, |first| *first);
        Err(first + SECOND)
    }

    fn forget(&mut self, now: Instant) {
        while self
            .sent
            .front()
            .is_some_and(|at| now.saturating_duration_since(*at) >= SECOND)
        {
            self.sent.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_second_has_more_than_the_limit_however_the_messages_come() {
        let (start, mut rate) = (Instant::now(), Rate::new(7));
        let (mut waiting, mut written) = (0, Vec::new());
        for ms in 0..10_000u64 {
            let now = start + Duration::from_millis(ms);
            while rate.take(waiting, now).is_ok() {
                waiting += 1;
            }
            // The connection stops sending now and then.
            if ms % 900 < 400 && waiting > 0 {
                waiting -= 1;
                rate.sent(now);
                written.push(ms);
            }
        }
        assert!(
            written.windows(8).all(|eight| eight[7] - eight[0] >= 1000),
            "{written:?}"
        );
        assert!(written.len() >= 50, "{}", written.len());
    }

    #[test]
    fn without_a_limit_nothing_is_counted() {
        let mut rate = Rate::new(0);
        rate.sent(Instant::now());
        assert!(rate.sent.is_empty());
        assert!(rate.take(100_000, Instant::now()).is_ok());
    }
}
