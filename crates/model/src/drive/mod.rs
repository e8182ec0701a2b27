//! Drives as data: points, profiles and the requests that read them. Pure.

mod command_places;
pub mod commissioning;
pub mod control;
pub(crate) mod derive;
#[cfg(test)]
mod families_tests;
#[cfg(test)]
mod family_parameters_tests;
pub mod identify;
pub mod index;
pub mod model;
pub mod parameters;
pub mod plan;
pub mod profile;
mod profile_file;
pub mod raw_writes;
mod refresh;
pub mod why;

pub use commissioning::{Commissioning, Step};
pub use derive::{Bound, Derived};
pub use index::{DriveIndex, IndexVec, PerDrive, PerPoint, PointIndex};
pub use model::tidy;
pub use model::{ModelPoint, Quality, Sample, State, Value};
pub use plan::{Plan, PlannedRead};
pub use profile::{Point, PollClass, Probe, Profile, Raw, Source};
pub use raw_writes::RawWrites;
pub use refresh::{REFRESH, Repeats};

/// Name of the point for the drive's own response to a silent master; 0 is no response. For Vacon NX it is
/// parameter P2.7.22.
pub const FIELDBUS_FAULT_RESPONSE: &str = "fieldbus_fault_response";

/// Name of the command that restarts the communication of a drive that counts messages (function 08, subfunction 01);
/// written like a point.
pub const RESTART_COMMUNICATION: &str = "restart_communication";

/// Name of the point for the reaction of a drive to a communication error; 3 lets the motor run on. For TECO 7300PA
/// it is the first two digits of Sn-08.
pub const COMMUNICATION_ERROR_REACTION: &str = "communication_error_reaction";

/// Name of the point with the time without data, in seconds, after which a drive has a communication fault. For TECO 7300PA Cn-31.
pub const COMMUNICATION_FAULT_TIME: &str = "communication_fault_time";

/// Name of the point with the time without a request, in seconds, after which a drive responds to a silent master; 0 is
/// never. For drives with a register for it.
pub const COMMUNICATION_TIMEOUT: &str = "communication_timeout";
