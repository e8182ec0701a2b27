//! drivegate: RS-485 frequency converters on one side, Modbus TCP, MQTT, BACnet/IP and HTTP on the other.
//!
//! ```text
//!  drives ──line──▶ codec ──▶ bus (transaction, schedule) ──▶ process image ──▶ north (Modbus TCP, MQTT, HTTP)
//!  drives ◀─line─── codec ◀── bus ◀────── command queue ◀────────────── north
//! ```
//!
//! Values go up: the thread of a bus ([`bus`]) owns its [`mod@line`], sends one request after the other and puts
//! each reply into the process image ([`process_image`]) as a whole. The servers ([`north`]) read the image at any
//! time. Commands go down: a server gives a command to the drive's handle ([`plant`]), which checks authority,
//! limits and presence ([`mod@command`]) and queues it for the bus; the client gets exactly one result.
//!
//! The package holds `main` and gives every crate of `crates/` the name of its room; Cargo enforces which may use which. From the bottom:
//! [`codec`] (`drivegate-proto`), [`bacnet`] (`-bacnet`), [`drive`] and [`document`] (`-model`), [`command`], [`process_image`],
//! [`history`], [`parameters`], [`diagnosis`], [`event`], [`files`], [`plant`], [`spec`], [`start_guard`], [`stop_all`], [`version`]
//! (`-core`), [`mod@line`], [`bus`], [`north`], [`sim`], [`config`] and [`daemon`] (`-gateway`), [`cli`] (`-tools`).
//!
//! Deliberately absent from drivegate:
//!
//! - A safety function: leases and stops are conveniences; emergency stop and safe torque off are wired.
//! - Writes without a command: none at start, at reconnect or at reload. The gateway itself writes only the action of a lease
//!   and the stop at shutdown, where they are configured.
//! - Values without quality, and old values served as good ones.
//! - A database, and plug-ins: profiles are data.
//! - The async runtime on the line: 3.5 characters are shorter than its timer's step.
//!
//! `docs/architecture.md` follows one transaction, one command and one value through the files.

pub use drivegate_bacnet as bacnet;
pub use drivegate_bus as bus;
pub use drivegate_core::diagnosis;
pub use drivegate_core::drill;
pub use drivegate_core::event;
pub use drivegate_core::files;
pub use drivegate_core::history;
pub use drivegate_core::order;
pub use drivegate_core::parameters;
pub use drivegate_core::plant;
pub use drivegate_core::process_image;
pub use drivegate_core::queue;
pub use drivegate_core::spec;
pub use drivegate_core::start_guard;
pub use drivegate_core::stop_all;
pub use drivegate_core::version;
pub use drivegate_gateway::config;
pub use drivegate_gateway::daemon;
pub use drivegate_line as line;
pub use drivegate_model::document;
pub use drivegate_model::drive;
pub use drivegate_north as north;
pub use drivegate_proto as codec;
pub use drivegate_sim as sim;
pub use drivegate_tools as cli;
