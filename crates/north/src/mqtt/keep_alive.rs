//! Whether the broker is still there. Time is an argument.

use std::time::{Duration, Instant};

/// Keep-alive interval that the gateway requests, s.
pub(super) const KEEP_ALIVE_S: u16 = 10;
/// Keep-alive interval.
const KEEP_ALIVE: Duration = Duration::from_secs(KEEP_ALIVE_S as u64);
/// Without a packet from the broker for this long, the connection is considered lost.
const LOST: Duration = KEEP_ALIVE.saturating_mul(3);

/// The decision about a broker that may be silent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Nothing.
    Fine,
    /// Send it a request that it must answer.
    Ask,
    /// The connection is lost.
    Lost,
}

/// How long the broker has been silent.
#[derive(Debug)]
pub(super) struct Silence {
    /// Time of its last packet.
    heard: Instant,
    /// Whether it was asked, and the answer is still to come.
    asked: bool,
}

impl Silence {
    pub(super) fn new(now: Instant) -> Silence {
        Silence {
            heard: now,
            asked: false,
        }
    }

    /// The broker sent a packet.
    pub(super) fn heard(&mut self, now: Instant) {
        self.heard = now;
    }

    /// The broker was asked.
    pub(super) fn asked(&mut self) {
        self.asked = true;
    }

    /// The broker answered; whether it was asked.
    pub(super) fn answered(&mut self) -> bool {
        std::mem::take(&mut self.asked)
    }

    /// `interval` is the one that the broker set instead of ours, 0: no keep-alive. A broker that is pinged less often
    /// than we want, or never, has no reason to speak, and is asked.
    pub(super) fn judge(&self, interval: Option<u16>, now: Instant) -> Verdict {
        let silent = now.saturating_duration_since(self.heard);
        let pinged = interval.is_none_or(|seconds| (1..=KEEP_ALIVE_S).contains(&seconds));
        if silent > LOST {
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

    /// Seconds of an hour at which a broker is asked that says nothing else, and when it is lost, if ever.
    fn hour(interval: Option<u16>, answers: bool, pings: Option<u64>) -> (Vec<u64>, Option<u64>) {
        let start = Instant::now();
        let (mut silence, mut asked) = (Silence::new(start), Vec::new());
        for second in 1..=3600 {
            let now = start + Duration::from_secs(second);
            if pings.is_some_and(|every| second % every == 0) {
                silence.heard(now);
            }
            match silence.judge(interval, now) {
                Verdict::Fine => {}
                Verdict::Lost => return (asked, Some(second)),
                Verdict::Ask => {
                    silence.asked();
                    asked.push(second);
                    if answers {
                        assert!(silence.answered());
                        silence.heard(now);
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
    }
}
