//! Results of the master about its drives, for the process image, events and the log.

use std::time::{Duration, Instant};

use super::confirm::Unconfirmed;
use drivegate_core::order::Refusal;
use drivegate_core::queue::Denied;
use drivegate_model::drive::{DriveIndex, PlannedRead};
use drivegate_proto::Exception;

/// A result of the master. Drives are given by their index on the bus.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// A round of the fast class was started, this time after the previous one.
    FastRound(Option<Duration>),
    /// A round of the slow class was started.
    SlowRound(Option<Duration>),
    /// The drive replied to a read of the plan.
    Read {
        /// Index of the drive on the bus.
        drive: DriveIndex,
        /// The read that the drive answered.
        read: PlannedRead,
        /// The reply, a word for each item.
        words: Vec<u16>,
        /// Latest possible time of the reading: earlier than now if the reply may belong to an earlier attempt.
        at: Instant,
    },
    /// The drive replies (again).
    Online(DriveIndex),
    /// The drive no longer replies.
    Offline(DriveIndex),
    /// The drive has restarted, so everything known about it is invalid.
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
        /// Index of the drive on the bus.
        drive: DriveIndex,
        /// The command as one line of text.
        what: String,
        /// Reason of the refusal.
        refusal: Refusal,
    },
    /// An attempt at the action of an expired lease failed; with the reason, unless reported before.
    ActionFailed {
        /// Index of the drive on the bus.
        drive: DriveIndex,
        /// Reason of the failure as text.
        why: Option<String>,
    },
    /// The action of an expired lease was acknowledged after this number of failed tries.
    ActionTaken {
        /// Number of earlier failures.
        drive: DriveIndex,
        /// Number of failures before.
        failures: u32,
    },
    /// A drive whose lease expired does not report whether it runs.
    RunningUnknown(DriveIndex),
    /// The refresh for the drive's own timeout has ended.
    RefreshEnded {
        /// Index of the drive on the bus.
        drive: DriveIndex,
        /// Reason of the end as text.
        why: String,
    },
    /// A waiting or started command was refused.
    Denied(Denied),
    /// An interlock does not hold, and the motor is stopped by that.
    Tripped {
        /// Index of the drive on the bus.
        drive: DriveIndex,
        /// The interlock, and why it is not satisfied.
        why: String,
    },
    /// A supervised drive runs although no client is known to have commanded it; with whether its lease is started
    /// for that.
    RunsUnsupervised(DriveIndex, Adopted),
}

/// Whether the lease was started for a drive that ran when the gateway started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adopted {
    /// The lease of the drive runs from now on.
    Yes,
    /// The lease is not started; the drive waits for a client.
    No,
}
