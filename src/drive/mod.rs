//! What a drive is: points, profiles and the requests that read them. Pure.

pub mod derive;
#[cfg(test)]
mod families_tests;
pub mod identify;
pub mod model;
pub mod plan;
pub mod profile;
mod profile_file;

pub use derive::{Bound, Derived};
pub use model::{ModelPoint, Quality, Sample, State, Value};
pub use plan::{Plan, PlannedRead};
pub use profile::{Point, PollClass, Profile, Raw, Source};

/// Name of the point that tells how a drive itself responds to a silent master; 0 is no response. For Vacon NX
/// parameter P2.7.22.
pub const FIELDBUS_FAULT_RESPONSE: &str = "fieldbus_fault_response";

/// Name of the point that tells after how many seconds without a request a drive responds to a silent master; 0 is
/// never. For drives that have a register for it.
pub const COMMUNICATION_TIMEOUT: &str = "communication_timeout";
