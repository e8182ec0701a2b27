//! Start guards: how often, how soon and how close together motors may be started, and under which conditions.
//!
//! A start is a change of a motor from standing to running, by any cause. One [`Guards`] for the whole gateway
//! counts them, since drives of several buses can belong to one group; every bus has its view of it, [`BusGuards`].
//! The rules of [`crate::permit`] decide whether an order may start a motor. A cleared start ([`BusGuards::clear`])
//! counts from that moment, and is not written before it is on disk ([`keep`]). Stops are not checked here, except
//! those that `min_run` delays.
//!
//! - `motor`: the state of one motor. `start_attempt`: its last start by an order. `ledger`: all motors, and the data to
//!   save.
//! - `interlock`: whether the points that a start needs have the required values. `drives_by_name`: the drives that
//!   have these points. `view`: the results of the guards of one bus.
//! - `file`: the file format. `keeper`: the thread that writes the file; the only part with I/O and a clock.

mod drives_by_name;
mod file;
mod interlock;
mod keeper;
mod ledger;
mod motor;
mod start_attempt;
mod view;

use std::time::Duration;

pub use self::file::Saved;
pub use self::interlock::Unmet;
pub use self::keeper::{WhileTaken, keep, observe};
pub use self::ledger::Guards;
pub use self::motor::MotorReading;
pub use self::start_attempt::ByRun;
pub use self::start_attempt::Unable;
pub use self::view::{BusGuards, Clearance};
pub use crate::order::{Guarded, Reason};
pub use crate::spec::{Guard, Interlock, MOST_STARTS};

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
