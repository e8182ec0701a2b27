//! Whether the broker is still there. Time is an argument.

use std::time::{Duration, Instant};

/// Keep-alive interval that the gateway requests, s.
pub(super) const KEEP_ALIVE_S: u16 = 10;
/// Keep-alive interval of the connection.
const KEEP_ALIVE: Duration = Duration::from_secs(KEEP_ALIVE_S as u64);
/// Time without a packet from the broker after which the connection is considered lost.
const LOST: Duration = KEEP_ALIVE.saturating_mul(3);
/// Fraction of the interval within which a ping must be answered.
const OF_INTERVAL: f64 = 0.8;

/// The decision about a broker that may be silent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The broker is fine; nothing has to be done.
    Fine,
    /// Send the broker a request that it must answer.
    Ask,
    /// The connection must be considered lost.
    Lost,
}

/// How long the broker has been silent.
#[derive(Debug)]
pub(super) struct Silence {
    /// Time of the broker's last packet.
    heard: Instant,
    /// Whether a test subscription was sent and has not been answered yet.
    asked: bool,
    /// When the library sent a ping; `None` once the broker has sent anything since.
    pinged: Option<Instant>,
}

impl Silence {
    pub(super) fn new(now: Instant) -> Silence {
        Silence {
            heard: now,
            asked: false,
            pinged: None,
        }
    }

    /// Notes that the broker sent a packet.
    pub(super) fn packet_received(&mut self, now: Instant) {
        (self.heard, self.pinged) = (now, None);
    }

    /// Notes that the library sent a ping.
    pub(super) fn pinged(&mut self, now: Instant) {
        self.pinged.get_or_insert(now);
    }

    /// Notes that a test subscription was sent.
    pub(super) fn test_sent(&mut self) {
        self.asked = true;
    }

    /// The broker answered; returns whether a test subscription was open.
    pub(super) fn answered(&mut self) -> bool {
        std::mem::take(&mut self.asked)
    }

    /// `interval`, in s, is the one that the broker set instead of the gateway's; 0 means no keep-alive. A broker
    /// that is pinged less often than the gateway requires, or never, has no reason to send anything, and gets a
    /// test subscription. If a ping is not answered, the library closes the connection one interval later without a
    /// DISCONNECT; the connection is declared lost slightly before that.
    pub(super) fn judge(&self, interval: Option<u16>, now: Instant) -> Verdict {
        let silent = now.saturating_duration_since(self.heard);
        let interval = interval.unwrap_or(KEEP_ALIVE_S);
        let pinged = (1..=KEEP_ALIVE_S).contains(&interval);
        let patience = Duration::from_secs(interval.into()).mul_f64(OF_INTERVAL);
        let unanswered = self
            .pinged
            .is_some_and(|ping| now.saturating_duration_since(ping) >= patience);
        if silent > LOST || unanswered {
            Verdict::Lost
        } else if silent > KEEP_ALIVE && !pinged && !self.asked {
            Verdict::Ask
        } else {
            Verdict::Fine
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Seconds within an hour at which a silent broker gets a test subscription, and when the connection is
    /// considered lost, if ever. The library pings the broker at the interval `pings`.
    fn hour(interval: Option<u16>, answers: bool, pings: Option<u64>) -> (Vec<u64>, Option<u64>) {
        let start = Instant::now();
        let (mut silence, mut asked) = (Silence::new(start), Vec::new());
        for second in 1..=3600 {
            let now = start + Duration::from_secs(second);
            if pings.is_some_and(|every| second % every == 0) {
                silence.pinged(now);
                if answers {
                    silence.packet_received(now);
                }
            }
            match silence.judge(interval, now) {
                Verdict::Fine => {}
                Verdict::Lost => return (asked, Some(second)),
                Verdict::Ask => {
                    silence.test_sent();
                    asked.push(second);
                    if answers {
                        assert!(silence.answered());
                        silence.packet_received(now);
                    }
                }
            }
        }
        (asked, None)
    }

    #[test]
    fn a_broker_with_a_longer_interval_or_none_is_asked_and_kept() {
        for interval in [0, 11, 60, u16::MAX] {
            let (asked, lost) = hour(Some(interval), true, None);
            assert_eq!((asked.len(), lost), (3600 / 11, None), "{interval}");
            let (asked, lost) = hour(Some(interval), false, None);
            assert_eq!(
                (asked, lost),
                (vec![11], Some(31)),
                "one that hangs is found, {interval}"
            );
        }
    }

    #[test]
    fn a_broker_that_the_library_pings_is_not_asked() {
        for (interval, pings) in [(None, 10), (Some(10), 10), (Some(1), 1)] {
            assert_eq!(hour(interval, true, Some(pings)), (vec![], None));
            assert_eq!(hour(interval, true, None), (vec![], Some(31)));
        }
        // The silence is noticed before the library closes the connection after two intervals.
        for (interval, pings, lost) in [(None, 10, 18), (Some(10), 10, 18), (Some(5), 5, 9), (Some(20), 20, 31)] {
            assert_eq!(hour(interval, false, Some(pings)).1, Some(lost), "{interval:?}");
        }
    }
}
