//! drivegate.
pub mod codec;
pub mod document;
