//! drivegate.
pub mod codec;
pub mod document;
pub mod drive;
pub mod event;
