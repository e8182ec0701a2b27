//! Orders, the rules that let them through, process image, events, history, diagnosis and parameters of drivegate.

pub mod diagnosis;
pub mod drill;
pub mod event;
pub mod files;
pub mod hex;
pub mod history;
pub mod order;
pub mod parameters;
pub mod permit;
pub mod plant;
pub mod process_image;
pub mod queue;
pub mod spec;
pub mod stalls;
pub mod start_guard;
pub mod stop_all;
pub mod version;

/// Hand-made plants for tests; the source file is shared with the package `testkit`, which depends on this one.
#[cfg(test)]
#[path = "../../testkit/src/lib.rs"]
pub mod testkit;

#[cfg(test)]
extern crate self as drivegate_core;
