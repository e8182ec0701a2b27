//! Results of the master about its drives, for the process image, events and the log.

use std::time::{Duration, Instant};

use super::confirm::Unconfirmed;
use crate::codec::Exception;
use crate::drive::{DriveIndex, PlannedRead};
use crate::order::Refusal;
use crate::queue::Denied;

/// A result of the master. Drives are named by their place on the bus.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A round of the fast class was started, this time after the previous one.
    FastRound(Option<Duration>),
    /// A round of the slow class was started.
    SlowRound(Option<Duration>),
    /// The drive replied to a read of the plan.
    Read {
        /// Place of the drive.
        drive: DriveIndex,
        /// The read.
        read: PlannedRead,
        /// The reply, a word for each item.
        words: Vec<u16>,
        /// When, at the latest: earlier than now where it may have been the reply to an earlier try.
        at: Instant,
    },
    /// The drive replies (again).
    Online(DriveIndex),
    /// The drive no longer replies.
    Offline(DriveIndex),
    /// The drive has restarted: everything known about it is void.
    Restarted(DriveIndex),
    /// The drive reports an N2 device type other than its profile expects.
    Unlike(DriveIndex, u8),
    /// The drive refuses these addresses.
    Unavailable(DriveIndex, PlannedRead, Exception),
    /// An acknowledged command showed no effect in time.
    NotConfirmed(DriveIndex, Unconfirmed),
    /// The lease of a drive that runs expired.
    LeaseRanOut(DriveIndex),
    /// The action of a lease that expired cannot be written.
    ActionRefused {
        /// Place of the drive.
        drive: DriveIndex,
        /// The command in one line.
        what: String,
        /// Reason of the refusal.
        refusal: Refusal,
    },
    /// An attempt at the action of an expired lease failed; with the reason, unless reported before.
    ActionFailed {
        /// Place of the drive.
        drive: DriveIndex,
        /// Reason of the failure, as text.
        why: Option<String>,
    },
    /// The action of an expired lease was acknowledged after this number of failed tries.
    ActionTaken {
        /// Place of the drive.
        drive: DriveIndex,
        /// Number of failures before.
        failures: u32,
    },
    /// A drive whose lease expired does not report whether it runs.
    RunningUnknown(DriveIndex),
    /// The refresh for the drive's own timeout has ended.
    RefreshEnded {
        /// Place of the drive.
        drive: DriveIndex,
        /// Reason of the end, as text.
        why: String,
    },
    /// A waiting or started command was refused.
    Denied(Denied),
    /// An interlock does not hold, and the motor is stopped by that.
    Tripped {
        /// Place of the drive.
        drive: DriveIndex,
        /// The interlock, and why it does not hold.
        why: String,
    },
    /// A supervised drive runs, and no client is known to have commanded it; whether its lease starts by that.
    RunsUnsupervised(DriveIndex, Adopted),
}

/// Whether a drive that ran when the gateway started got its lease started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adopted {
    /// The lease of the drive runs from now on.
    Yes,
    /// The drive waits for a client.
    No,
}
