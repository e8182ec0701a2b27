//! Reasons why a start must wait. Pure.

use std::time::Duration;

/// Why a start must wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// Too many starts within the last hour.
    StartsPerHour,
    /// The motor has not been stopped for long enough.
    MinOff,
    /// Another drive of the group was started shortly before.
    Stagger,
    /// An interlock does not hold.
    Interlock,
    /// The start cannot be counted on disk.
    StateFile,
}

impl Reason {
    /// All reasons why a start must wait.
    pub const ALL: [Reason; 5] = [
        Reason::StartsPerHour,
        Reason::MinOff,
        Reason::Stagger,
        Reason::Interlock,
        Reason::StateFile,
    ];

    /// The label of metrics: the key of the configuration where there is one.
    pub fn name(self) -> &'static str {
        match self {
            Reason::StartsPerHour => "starts_per_hour",
            Reason::MinOff => "min_off",
            Reason::Stagger => "stagger",
            Reason::Interlock => "interlock",
            Reason::StateFile => "state_file",
        }
    }
}

/// A start that a rule does not permit yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Guarded {
    /// Rule that refused the start.
    pub reason: Reason,
    /// Description for people.
    pub why: String,
    /// Time after which the start may be retried.
    pub retry_after: Duration,
}

impl Guarded {
    /// Whole milliseconds, never less than the time that is left.
    pub fn retry_after_ms(&self) -> u64 {
        u64::try_from(self.retry_after.as_micros().div_ceil(1000)).unwrap_or(u64::MAX)
    }
}

impl std::fmt::Display for Guarded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.why)
    }
}
