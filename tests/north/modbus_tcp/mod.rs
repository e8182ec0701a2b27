//! The Modbus TCP server over real sockets, with simulated buses behind it: every answer and exception of the
//! contract, bad input of all kinds, and independent clients.

mod answers;
mod bad_input;
mod commands;
mod connections;
mod load;
mod loopback;
mod map;
mod peers;
mod requests;
mod revocation;
pub(crate) mod rig;
mod second_opinion;
mod tls;
mod views;
