//! Why a refresh ended, as text.

use std::fmt;

/// Reason for the end of a refresh.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum End {
    Stop,
    Stands,
    Starts,
    Fault,
    Local,
    Foreign,
    Silent,
    Slows,
    Unknown,
    Lease,
    Passed,
    Other,
    Restore,
    Restart,
    Refused(String),
}

impl fmt::Display for End {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            End::Stop => "a stop was accepted",
            End::Stands => "the motor was seen to stand",
            End::Starts => "the motor was seen to start",
            End::Fault => "the drive has a fault",
            End::Local => "the drive is commanded at its local control place",
            End::Foreign => "the drive has another word or reference than the one that was written here",
            End::Silent => "the drive did not answer for three periods",
            End::Slows => "the motor slowed down for three periods although no order here demanded it",
            End::Unknown => "it is not known what the drive took of an order",
            End::Lease => "the lease expired",
            End::Passed => "a tool or a broadcast commanded the drive",
            End::Other => "the gateway itself commanded the drive",
            End::Restore => "parameters of the drive are being restored",
            End::Restart => "the drive has restarted",
            End::Refused(why) => why,
        })
    }
}
