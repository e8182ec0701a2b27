//! Start guards: how often, how soon and how close together motors may be started, and under which conditions.
//!
//! A start is one passage of a motor from standing to running, by whomever. One [`Guards`] for the whole gateway counts
//! them, since drives of several buses can belong to one group; every bus has its view of it, [`BusGuards`]. A command
//! is judged when it is accepted ([`BusGuards::refuses`]), when its turn comes ([`BusGuards::clear`]), and before each
//! of its writes ([`BusGuards::may_write`]). A start that is cleared counts from that moment, and is not written before
//! it is on disk ([`keep`]). Stops are not checked here, except those that `min_run` delays.
//!
//! - `motor`: what is known of one motor, and the rules. `passage`: its last start by an order. `ledger`: all motors, and what is
//!   to be written.
//! - `interlock`: whether the points hold that a start needs. `around`: the drives that have these points. `view`: the judgement.
//! - `file`: the form of the file. `keeper`: the thread that writes it; the only place here with I/O and a clock.

mod around;
mod file;
mod interlock;
mod keeper;
mod ledger;
mod motor;
mod passage;
mod view;

use std::time::Duration;

pub use self::file::Saved;
pub use self::interlock::Unmet;
pub use self::keeper::keep;
pub use self::ledger::Guards;
pub use self::motor::Seen;
pub use self::passage::Unable;
pub use self::view::{BusGuards, Clearance};

/// Most starts an hour that can be configured.
pub const MOST_STARTS: u32 = 120;

/// `guard` of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Guard {
    /// Starts within any hour.
    pub starts_per_hour: Option<u32>,
    /// Time that the motor stands before it is started again.
    pub min_off: Duration,
    /// Time that the motor runs before an ordinary stop.
    pub min_run: Duration,
    /// Time between two starts of drives of the same group.
    pub stagger: Duration,
}

/// A condition for starting a motor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interlock {
    /// The drive that shows it.
    pub drive: String,
    /// A point of it that is true or false.
    pub point: String,
    /// Its required value.
    pub is: bool,
    /// Whether the running motor is stopped where it does not hold.
    pub trip: bool,
}

/// Why a start must wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// Too many starts within the last hour.
    StartsPerHour,
    /// The motor has not stood long enough.
    MinOff,
    /// Another drive of the group was started just now.
    Stagger,
    /// An interlock does not hold.
    Interlock,
    /// The start cannot be counted on disk.
    StateFile,
}

impl Reason {
    /// All of them.
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

/// A start that must wait.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Guarded {
    /// By which rule.
    pub reason: Reason,
    /// For people.
    pub why: String,
    /// After which it may be tried again.
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

/// A time as text: tenths below ten seconds, never 0 where something is left.
fn shown(time: Duration) -> String {
    let tenths = time.as_millis().div_ceil(100);
    match tenths {
        0..100 => format!("{}.{} s", tenths / 10, tenths % 10),
        100..1200 => format!("{} s", tenths.div_ceil(10)),
        _ => format!("{} min", tenths.div_ceil(600)),
    }
}

#[cfg(test)]
mod tests;
