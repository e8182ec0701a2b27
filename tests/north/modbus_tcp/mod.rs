//! The Modbus TCP server with real sockets and simulated buses: every answer and exception of the contract, invalid
//! input of all kinds, and independent clients.

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
