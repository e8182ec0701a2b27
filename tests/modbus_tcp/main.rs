//! The Modbus TCP server over real sockets, with simulated buses behind it: every answer and exception of the
//! contract, bad input of all kinds, and independent clients.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::indexing_slicing)]

mod answers;
mod bad_input;
mod commands;
mod connections;
mod load;
mod map;
mod offline;
mod peers;
#[path = "../gateway/process.rs"]
#[allow(dead_code, reason = "the tests of the whole gateway take the rest")]
mod process;
mod requests;
mod rig;
mod second_opinion;
mod tls;
#[path = "../tools/mod.rs"]
mod tools;
