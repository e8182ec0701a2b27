//! drivegate: RS-485 frequency converters on one side, Modbus TCP, MQTT, BACnet/IP and HTTP on the other.
//!
//! ```text
//!  drives ──line──▶ proto ──▶ bus (transaction, schedule) ──▶ process image ──▶ servers (Modbus TCP, MQTT, HTTP)
//!  drives ◀─line─── proto ◀── bus ◀────── command queue ◀────────────── servers
//! ```
//!
//! Values go up: the thread of a bus (`drivegate_bus`) owns its port (`drivegate_line`), sends one request after the other and
//! puts each reply into the process image (`drivegate_core::process_image`) as a whole. The servers (`drivegate_north`,
//! `drivegate_mqtt`, `drivegate_http`) read the image at any time. Commands go down: a server gives a command to the drive's
//! handle (`drivegate_core::plant`), which asks the gate (`drivegate_core::permit`) and queues the command for the bus; the
//! client gets exactly one result.
//!
//! This package holds `main`, the tests of the whole program and the benchmarks. Everything else is in the packages of `crates/`;
//! Cargo enforces which may use which. From the bottom: `proto`, `line` and `model`, `core`, `bus`, `bacnet` and `north`, `mqtt`
//! and `http`, `sim`, `gateway` (configuration and daemon), `tools` (the commands).
//!
//! Deliberately absent from drivegate:
//!
//! - A safety function: leases and stops are conveniences; emergency stop and safe torque off are wired.
//! - Writes without a command: none at start, at reconnect or at reload. The gateway itself writes only the action of a lease
//!   and stops (of interlocks, at local control, at shutdown), where they are configured, and repeats (`refresh`) what a
//!   client has ordered.
//! - Values without quality, and old values served as good ones.
//! - A database, and plug-ins: profiles are data.
//! - The async runtime on the line: 3.5 characters are shorter than its timer's step.
//!
//! `docs/architecture.md` follows one transaction, one command and one value through the files.

use std::process::ExitCode;

fn main() -> ExitCode {
    drivegate_core::version::set_commit(option_env!("DRIVEGATE_COMMIT"));
    drivegate_tools::main()
}
