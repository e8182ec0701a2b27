//! The receiver of a request on the line.

use drivegate_model::drive::DriveIndex;

/// Receiver of a request on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// The drive that is configured at this position of the bus.
    Drive(DriveIndex),
    /// An address at which no drive is configured; 0 is the broadcast, except on N2.
    Address(u8),
}

impl Target {
    /// The drive; `None` for an address at which none is configured.
    pub fn drive(self) -> Option<DriveIndex> {
        match self {
            Target::Drive(drive) => Some(drive),
            Target::Address(_) => None,
        }
    }
}

impl From<DriveIndex> for Target {
    fn from(drive: DriveIndex) -> Target {
        Target::Drive(drive)
    }
}

impl PartialEq<DriveIndex> for Target {
    fn eq(&self, drive: &DriveIndex) -> bool {
        *self == Target::Drive(*drive)
    }
}
