//! The bus: one owner of the line, one transaction at a time.
//!
//! - `line_loop`: the thread, the port, the clock; it carries out the actions of the core. [`prober`] does this for
//!   `scan`.
//! - [`core`](self::core): the bus without its thread: bytes and time in, what to do with the port out.
//! - [`line_state`]: how long the line has been silent, and the transaction that is in progress, a [`transaction`].
//! - `closing_server`: when a device server is about to close its connection, and nothing is sent over it.
//! - [`master`]: the next request for the line (`choose`), the result (`results`), the stops at shutdown (`shutdown`).
//!   [`schedule`] knows which poll is due, [`predict`] the resulting times on a given line.
//! - `drive_state`: what is known of one drive besides its samples, polls and N2 session: its started commands
//!   ([`command_run`]), what they still have to show ([`confirm`]), its lease ([`supervision`]), the replies that it may
//!   still send ([`late_replies`]).
//! - [`refresh`]: what is written again for a drive whose own timeout counts writes only.
//! - `start_gate`: which commands to guarded drives may start them, and the stops of interlocks.
//! - [`n2_session`] and [`n2_late_replies`]: what N2 needs beyond that, for the whole line.
//! - [`listener`]: the bus without its thread on a line that another master owns: it decodes and never sends.
//! - `longest_transaction`: how long the line may be in use before a stop.
//! - `line_diagnosis`: feeds [`drivegate_core::diagnosis`] and shows the result.
//! - [`proof`]: whether the commands of a profile are safe, tried with the commands of the bus itself.
//! - [`news`]: the results of the master; `report` applies them to the process image, to events and to the log.
//!
//! Only `line_loop` and [`prober`] do I/O and read the clock; all other modules take time as an argument. `report`
//! and `tap`, which feeds the trace, add the time of day to their reports.

mod closing_server;
pub mod command_run;
pub mod confirm;
pub mod core;
mod drive_counters;
mod drive_state;
pub mod late_replies;
mod line_diagnosis;
mod line_loop;
pub mod line_state;
pub mod listener;
mod longest_transaction;
pub mod master;
pub mod n2_late_replies;
pub mod n2_session;
pub mod news;
mod per_rank;
pub mod predict;
pub mod prober;
pub mod proof;
pub mod refresh;
pub mod repeated_stops;
mod report;
pub mod schedule;
mod selection;
mod start_gate;
pub mod supervision;
mod tap;
pub mod transaction;
mod unanswered_stops;

pub use drivegate_core::stop_all::stop_of_line;

pub use line_loop::BusTask;
pub use longest_transaction::longest_transaction;

use std::time::Duration;

use ipnet::IpNet;

use drivegate_line::LineOptions;
use drivegate_proto::wire::Silence;

/// Settings of a bus for its line, besides [`drivegate_core::process_image::BusSpec`].
#[derive(Debug, Clone, PartialEq)]
pub struct BusOptions {
    /// Time for the first byte of a reply; wire time is added.
    pub response_timeout: Duration,
    /// Number of retries after a failed attempt.
    pub retries: u32,
    /// Silence before each request.
    pub silence: Silence,
    /// How the port is set up and waited for.
    pub line: LineOptions,
    /// Role of the gateway on the line.
    pub mode: Mode,
    /// Networks from which the device of the bus may connect.
    pub allow: Vec<IpNet>,
}

/// Role of the gateway on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Mode {
    /// The gateway is the master of the line.
    #[default]
    Master,
    /// The bus belongs to another master: the gateway listens and never sends.
    Listen,
}
