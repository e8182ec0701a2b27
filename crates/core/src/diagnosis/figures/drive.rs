//! The counters of one drive.

use std::time::{Duration, Instant};

use super::LATE;
use crate::diagnosis::counters::{InPhase, Window};

/// The counters per drive in each step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// Valid replies in time.
    Answered,
    /// Requests without a reply, while the drive is present.
    Silent,
    /// All requests that got no reply, whether the drive is present or not.
    Tried,
    /// Replies damaged at any place.
    Damaged,
    /// Damaged replies that are longer than the reply could be.
    Overlong,
    /// Stray bytes directly before the reply.
    Led,
    /// Stray bytes before the reply that are zeros.
    LedZero,
    /// Replies whose first bytes are missing.
    StartLost,
    /// Echoes of requests whose last bytes are missing.
    CutEcho,
    /// Stray bytes after a reply, while the line should be idle.
    Idle,
    /// Further valid replies to one request.
    Second,
    /// Valid replies after the time limit.
    Late,
    /// Replies that used more than half of the time limit.
    Slow,
    /// Transactions that show whether the adapter receives its own requests or not.
    EchoShown,
    /// Transactions that show that the adapter receives its own requests.
    Echoed,
}

const SIGNS: usize = Sign::Echoed as usize + 1;

/// The counters of one drive.
#[derive(Debug, Clone)]
pub struct Drive {
    pub address: u8,
    pub(super) window: Window<SIGNS>,
    /// Slowest beginning of a reply in each step, tenths of a millisecond.
    pub(super) slowest: Window<1>,
    /// Time limit for the first byte of a reply of the drive.
    pub response_timeout: Duration,
    /// Requests without a reply in a row; of these, the number that closely followed a reply, and the number that
    /// followed a pause.
    pub(super) run: u16,
    pub(super) run_paused: [u16; 2],
    pub(super) silent_at: Option<Instant>,
    pub(super) mains: InPhase,
    /// Number of requests to a drive that has never replied; `None` if the drive has replied.
    pub(super) unanswered: Option<u16>,
}

impl Drive {
    pub(super) fn add(&mut self, sign: Sign) {
        self.window.add(sign as usize, 1);
    }

    /// Count of a sign in the last minute.
    pub fn sum(&self, sign: Sign) -> u32 {
        self.window.sum(sign as usize)
    }

    /// Number of steps in the last minute in which one of these signs was counted.
    pub fn steps(&self, signs: &[Sign]) -> usize {
        let has = |step: &&[u16; SIGNS]| {
            signs
                .iter()
                .any(|sign| step.get(*sign as usize).is_some_and(|count| *count > 0))
        };
        self.window.steps.iter().filter(has).count()
    }

    /// Slowest beginning of a reply in the last minute, ms.
    pub fn slowest_ms(&self) -> f64 {
        f64::from(self.slowest.each(0).max().unwrap_or_default()) / 10.0
    }

    /// Notes that a reply arrived after the time limit, at `at`.
    pub(super) fn replied_late(&mut self, at: Instant) {
        self.add(Sign::Late);
        let over = self.silent_at.map(|silent| at.saturating_duration_since(silent));
        self.replied_after(self.response_timeout + over.unwrap_or_default());
    }

    /// Adds a turnaround: time from a request to the beginning of its reply.
    pub(super) fn replied_after(&mut self, time: Duration) {
        let tenths = u16::try_from(time.as_micros() / 100).unwrap_or(u16::MAX);
        self.slowest.most(0, tenths);
    }

    /// Requests to a drive that has never replied.
    pub fn in_vain(&self) -> Option<u16> {
        self.unanswered
    }

    pub(super) fn was_silent(&self, at: Instant) -> bool {
        self.silent_at
            .is_some_and(|silent| at.saturating_duration_since(silent) <= LATE)
    }
}
