//! Configuration and daemon of drivegate.

pub mod config;
pub mod daemon;
