//! The bus: one owner of the line, one transaction at a time.

pub mod command_run;
pub mod confirm;
pub mod core;
mod drive_state;
pub mod late_replies;
mod line_loop;
pub mod line_state;
pub mod master;
pub mod n2_late_replies;
pub mod n2_session;
pub mod news;
pub mod predict;
pub mod prober;
mod report;
pub mod schedule;
pub mod supervision;
mod tap;
pub mod transaction;

pub use line_loop::BusTask;

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
