//! Parts that the tests of several packages share: hand-made plants, and readers of a queue or the audit.
//!
//! No bus runs in these tests: a test fills the process images and empties the queues. The unit tests of
//! `drivegate-core` compile this source as a module, because this package depends on that one.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "tests may panic")]

mod commands;
mod families;
pub mod mqtt;
mod plant;

pub use commands::{audited, next_command, submit, take_next, ticket, window};
pub use families::{Family, Order, families, number, orders, rows};
pub use plant::{
    STALE_AFTER, bus, bus_spec, controlled, image, monitored, nx, nx_bus, nx_plant, online, profile, read, read_all,
    read_nx, up,
};
