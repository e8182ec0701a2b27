//! The bus: one owner of the line, one transaction at a time.

pub mod asker;
pub mod confirm;
pub mod debts;
pub mod desk;
mod exchange;
pub mod execute;
pub mod leases;
pub mod predict;
mod report;
pub mod schedule;
pub mod session;
mod tap;
mod task;
pub mod transaction;
mod watchdog;

pub use task::BusTask;

use std::time::Duration;

use crate::codec::wire::Silence;
use crate::line::Rs485;

/// How a bus treats its line, beside what [`crate::cache::BusSpec`] says.
#[derive(Debug, Clone, PartialEq)]
pub struct BusOptions {
    /// Time for the first byte of a reply; wire time is added.
    pub response_timeout: Duration,
    /// Tries after the first.
    pub retries: u32,
    /// Silence before each request.
    pub silence: Silence,
    /// Who switches the direction.
    pub rs485: Rs485,
}
