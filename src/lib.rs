//! drivegate: frequency converters on RS-485 on one side, Modbus TCP, MQTT and HTTP on the other.
//!
//! # The one flow
//!
//! ```text
//!  drives ──line──▶ codec ──▶ bus (transaction, schedule) ──▶ process image ──▶ north (Modbus TCP, MQTT, HTTP)
//!  drives ◀─line─── codec ◀── bus ◀────── command queue ◀────────────── north
//! ```
//!
//! Values go up: the thread of a bus ([`bus`]) owns its [`mod@line`], asks one drive after the other and puts each reply
//! into the process image ([`process_image`]) as a whole. The servers ([`north`]) look at the image whenever they like; no
//! reader costs the line anything. Orders go down: a server gives an order to the drive's handle ([`plant`]), which
//! checks authority, limits and presence ([`mod@command`]) and queues it for the bus; whoever ordered gets exactly one
//! answer. North and bus never name each other.
//!
//! # The parts
//!
//! In the order in which they may use each other, a later one the earlier ones; `tests/repository/layering.rs` holds them to it.
//!
//! - [`version`]: which build this is.
//! - [`document`]: TOML that knows the line of every key and collects all faults.
//! - [`files`]: files that grow or are replaced while the gateway runs.
//! - [`codec`]: requests and replies to and from bytes: Modbus RTU ([`codec::rtu`]) and ASCII ([`codec::ascii`]), Metasys N2
//!   ([`codec::n2`], whose objects lie in the tables of Modbus). Pure.
//! - [`drive`]: points, units and quality; profiles, which are data (`profiles/*.toml`); points made of others
//!   ([`drive::derive`]); which requests read them ([`drive::plan`]); how a family is known ([`drive::identify`]). Pure.
//! - [`event`]: what happened, published once.
//! - [`diagnosis`]: what is wrong with a line, from what is seen on it: counters and rules. Pure.
//! - [`process_image`]: the process image; many readers, one writer a bus.
//! - [`mod@command`]: what may be commanded, the queue, the ticket that answers once.
//! - [`history`]: trends and counters; the trip recorder: what was read and sent before and after a fault, kept on disk.
//! - [`parameters`]: the parameter vault: what a reading asks next, files, differences, restores.
//! - [`plant`]: all images and queues, as the north sides see them.
//! - [`mod@line`]: the half-duplex wire; open, send, receive, wait to tens of microseconds.
//! - [`bus`]: one exchange ([`bus::transaction`]), which poll is next ([`bus::schedule`]), all decisions about drives and
//!   commands ([`bus::master`]), the bus without its thread ([`bus::core`]): pure; and the thread that does the I/O.
//! - [`north`]: the servers, and the public register map.
//! - [`sim`]: simulated drives of every family on a simulated wire, and the broker of the demo.
//! - [`config`]: file and environment to settings, every fault in one run.
//! - [`daemon`]: wiring, reload, the order of stopping.
//! - [`cli`]: one file a command; `read` and `write` are a client of a running gateway's local socket, or a bus of their own without one.
//!
//! # Deliberately absent
//!
//! - A safety function: leases and stops here are conveniences; emergency stop and safe torque off are wired.
//! - Writes that nobody ordered: none at start, at reconnect or at reload. What the gateway writes of itself are the
//!   lease action and the stop at shutdown, and both only where they are configured.
//! - Values without quality, and old values served as good ones.
//! - A database, and plug-ins: profiles are declarative.
//! - The async runtime on the way of the line: 3.5 characters are shorter than its timer's step.
//!
//! `docs/architecture.md` follows one exchange, one command and one value through the files, says which file a change belongs
//! to, and gives the reasons.

pub use drivegate_bus as bus;
pub use drivegate_core::command;
pub use drivegate_core::diagnosis;
pub use drivegate_core::event;
pub use drivegate_core::files;
pub use drivegate_core::history;
pub use drivegate_core::parameters;
pub use drivegate_core::plant;
pub use drivegate_core::process_image;
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
