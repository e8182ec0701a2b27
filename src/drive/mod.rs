//! What a drive is: points, profiles and the requests that read them. Pure.

pub mod model;
pub mod plan;
pub mod profile;
mod profile_file;

pub use model::{ModelPoint, Quality, Sample, State, Value};
pub use plan::{Plan, PlannedRead};
pub use profile::{Point, PollClass, Profile, Raw, Source};
