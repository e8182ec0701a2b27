//! What the master has to say of its drives: for the process image, events and the log.

use std::time::{Duration, Instant};

use super::confirm::Unconfirmed;
use crate::codec::Exception;
use crate::command::{Origin, Refusal};
use crate::drive::{DriveIndex, PlannedRead};

/// One piece of news. Drives are named by their place on the bus.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A round of the fast class was started, so long after the one before.
    FastRound(Option<Duration>),
    /// A round of the slow class was started.
    SlowRound(Option<Duration>),
    /// The drive answered a read of the plan.
    Read {
        /// Which drive.
        drive: DriveIndex,
        /// What was read.
        read: PlannedRead,
        /// What it said, a word for each item.
        words: Vec<u16>,
        /// When, at the latest: earlier than now where it may have been the reply to an earlier try.
        at: Instant,
    },
    /// The drive answers (again).
    Online(DriveIndex),
    /// The drive does not answer any more.
    Offline(DriveIndex),
    /// The drive has started anew: nothing that is known of it holds.
    Restarted(DriveIndex),
    /// The drive says that it is a device of that N2 type, not the one that its profile expects.
    Unlike(DriveIndex, u8),
    /// The drive refuses these addresses.
    Unavailable(DriveIndex, PlannedRead, Exception),
    /// An acknowledged command showed no effect in time.
    NotConfirmed(DriveIndex, Unconfirmed),
    /// The lease of a drive that runs ran out.
    LeaseRanOut(DriveIndex),
    /// The action of a lease that ran out cannot be written.
    ActionRefused {
        /// Which drive.
        drive: DriveIndex,
        /// The command in one line.
        what: String,
        /// Why not.
        refusal: Refusal,
    },
    /// The action of a lease that ran out was tried, and failed; why, unless that was told before.
    ActionFailed {
        /// Which drive.
        drive: DriveIndex,
        /// Why, for people.
        why: Option<String>,
    },
    /// The action of a lease that ran out was acknowledged after so many tries that failed.
    ActionTaken {
        /// Which drive.
        drive: DriveIndex,
        /// How many.
        failures: u32,
    },
    /// A drive whose lease ran out does not say whether it runs.
    RunningUnknown(DriveIndex),
    /// A command that waited, or was begun, is refused: it may not start its motor.
    StartRefused {
        /// Which drive.
        drive: DriveIndex,
        /// Who gave it.
        origin: Origin,
        /// The command in one line.
        what: String,
        /// Why not.
        refusal: Refusal,
    },
    /// An interlock does not hold, and the motor is stopped by that.
    Tripped {
        /// Which drive.
        drive: DriveIndex,
        /// Which interlock, and why it does not hold.
        why: String,
    },
    /// A supervised drive runs, and no client is known to have commanded it; whether its lease starts by that.
    RunsUnsupervised(DriveIndex, Adopted),
}

/// Whether a drive that ran when the gateway started got its lease started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adopted {
    /// Its lease runs from now on.
    Yes,
    /// It waits for a client.
    No,
}
