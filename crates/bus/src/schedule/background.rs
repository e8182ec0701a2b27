//! The line share of background transactions: idle time, and otherwise a small share of wire time.

use std::time::{Duration, Instant};

use super::{PollReason, Schedule};
use drivegate_core::order::Pace;

/// Time that the shares have earned and not used, in seconds of wire time; negative after a transaction that took
/// longer than it had earned.
#[derive(Debug, Default)]
pub(super) struct BackgroundShare {
    balance: Balance,
    /// The longest transaction that was requested. This time limits the credit.
    longest: Duration,
    /// By how much recent transactions took longer than calculated, because drives are slower than their profiles state.
    overrun: Duration,
}

/// Time that the share of each pace has earned and not used, in seconds.
#[derive(Debug, Default)]
struct Balance {
    brisk: f64,
    slow: f64,
}

impl Balance {
    fn of(&self, pace: Pace) -> f64 {
        match pace {
            Pace::Brisk => self.brisk,
            Pace::Slow => self.slow,
        }
    }

    fn of_mut(&mut self, pace: Pace) -> &mut f64 {
        match pace {
            Pace::Brisk => &mut self.brisk,
            Pace::Slow => &mut self.slow,
        }
    }
}

/// Whether a background transaction may be sent now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Admission {
    /// The request uses idle time: its share only pays for time beyond the calculated one.
    InIdleTime(Duration),
    /// The request replaces a due poll: its share pays for it.
    InShare,
    /// The request is not admitted before this time, unless the line rests earlier.
    NotBefore(Instant),
}

impl BackgroundShare {
    /// Earns shares from the time of process data, so that they are proportional to it: time of commands and slow
    /// polls does not count.
    pub(super) fn earn(&mut self, passed: Duration) {
        for pace in Pace::ALL {
            let balance = self.balance.of_mut(pace);
            // Share not used in an hour does not become a burst later.
            let most = self.longest.as_secs_f64().max(*balance);
            *balance = (*balance + passed.as_secs_f64() * pace.share()).min(most);
        }
    }

    /// Time until the share of this pace has earned `wanted`.
    fn missing(&self, pace: Pace, wanted: f64) -> Duration {
        Duration::from_secs_f64(((wanted - self.balance.of(pace)) / pace.share()).max(0.0))
    }
}

impl Schedule {
    /// Whether a transaction of this pace that takes about `cost` may be sent at `now`. `idle` means that nothing
    /// else is due. In idle time it must not delay the next round of process data, and is sent only if its share
    /// has no debt; in place of a due poll it is sent once its share has earned it.
    pub(crate) fn admits_background(&mut self, pace: Pace, cost: Duration, idle: bool, now: Instant) -> Admission {
        let share = &mut self.background;
        let cost = cost + share.overrun;
        share.longest = share.longest.max(cost);
        let fits = self.round_started.is_none() || now + cost <= self.round_due;
        let owes_nothing = share.balance.of(pace) >= 0.0;
        if idle && fits && owes_nothing {
            return Admission::InIdleTime(cost);
        }
        // Reads for commands and probes are few, and slow polls on credit pay for themselves.
        let instead_of_process_data = idle || self.turn == PollReason::Due;
        let missing = share.missing(pace, cost.as_secs_f64() * (1.0 - 1e-9));
        if missing.is_zero() && instead_of_process_data {
            return Admission::InShare;
        }
        Admission::NotBefore(now + missing.max(Duration::from_millis(1)))
    }

    /// Charges a transaction that was not a background one to the share of this pace.
    pub(crate) fn background_owes(&mut self, pace: Pace, took: Duration) {
        *self.background.balance.of_mut(pace) -= took.as_secs_f64();
    }

    /// A background transaction has ended, for which the line was taken for `took`. `answered`: the drive replied.
    pub(crate) fn background_done(&mut self, pace: Pace, admission: Admission, answered: bool, took: Duration) {
        let share = &mut self.background;
        let paid = match admission {
            Admission::InIdleTime(cost) => took.saturating_sub(cost),
            Admission::InShare | Admission::NotBefore(_) => took,
        };
        if matches!(admission, Admission::InShare) {
            // The transaction replaced a poll, so polls count as served once.
            self.share.polled(Duration::ZERO);
        }
        if answered && let Admission::InIdleTime(cost) = admission {
            let over = (took + share.overrun).saturating_sub(cost);
            share.overrun = over.max(share.overrun.mul_f64(0.9));
        }
        let balance = share.balance.of_mut(pace);
        // There was room for this request, so there will be room for the next one too.
        let before = match admission {
            Admission::InIdleTime(_) => balance.min(0.0),
            Admission::InShare | Admission::NotBefore(_) => *balance,
        };
        *balance = before - paid.as_secs_f64();
    }
}
