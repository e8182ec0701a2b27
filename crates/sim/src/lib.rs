//! Simulated drives and the simulated wire, for `demo`, `simulate`, tests and benches.
//!
//! The pieces, from the drive to the port:
//!
//! - `motor`, `parameter_set`, `model`: what all drives have, and what a drive is to the line.
//! - [`nx`] (Vacon NX, Eaton SVX and HVX), `cx` (Vacon CX), `teco` (TECO 7300PA): the behaviour of the drives with their boards;
//!   [`by_profile`]: the behaviour of a drive of any other profile. All answer Modbus PDUs and are pure. `autopilot` runs one in a
//!   demo.
//! - [`simulated_drive`]: a drive of any model with its autopilot and its power switch; [`slave`]: all drives of a line, frames
//!   in and replies out.
//! - `n2`: the N2 board that a drive may have in the place of its Modbus board.
//! - [`faults`]: faults on a line, random or scripted.
//! - `framing`: where a frame begins and ends, by protocol (pure).
//! - [`half_duplex`]: the wire itself (pure): when which character is on it, silence, collisions.
//! - [`wire`]: the thread that puts all this behind a pseudo-terminal, a serial port or a TCP listener.
//! - [`broker`]: a small MQTT broker for the demo and for tests.
//!
//! All modules except [`wire`], its endpoints, the lateness statistics and the broker are pure and take the time as
//! an argument, so equal requests at equal times give equal bytes.

use std::time::Duration;

pub(crate) mod autopilot;
pub mod broker;
pub mod by_profile;
pub mod cx;
pub mod endpoint;
pub mod faults;
pub(crate) mod framing;
pub mod half_duplex;
#[cfg(test)]
mod in_time;
pub(crate) mod model;
pub(crate) mod motor;
pub(crate) mod n2;
pub mod nx;
pub(crate) mod parameter_set;
#[cfg(test)]
mod parameter_tests;
pub mod random;
pub mod simulated_drive;
pub mod slave;
pub mod statistics;
pub(crate) mod teco;
pub mod wire;

/// Time since the simulated line was switched on.
pub type SimTime = Duration;
